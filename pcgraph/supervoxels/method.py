# SPDX-License-Identifier: Apache-2.0
"""Methods of grouping voxels: the interface, and the two there are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import non_negative
from pcgraph.supervoxels.boundaries import settle_boundaries
from pcgraph.supervoxels.connect import connect
from pcgraph.supervoxels.distance import Metric, voxel_features
from pcgraph.supervoxels.growth import grow
from pcgraph.supervoxels.rims import settle_points
from pcgraph.supervoxels.seeds import seed_voxels
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.planes import LocalPlanes, local_planes


@dataclass(frozen=True)
class SupervoxelMethod(ABC):
    """How voxels become supervoxels.

    Attributes
    ----------
    color_weight, spatial_weight, normal_weight : float, >= 0
        What counts in the distance of a voxel to a supervoxel: their w_c (colours in 0..1), w_s (metres over the
        seed size) and w_n (one minus the cosine) in Papon et al. 2013, equation 7.
    """

    color_weight: float = 0.1
    spatial_weight: float = 0.4
    normal_weight: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            non_negative(field.name, getattr(self, field.name))

    @abstractmethod
    def planes(self, grid: VoxelGrid, viewpoints: NDArray[np.float64]) -> LocalPlanes:
        """The plane on which each voxel lies, seen from (3,) or (v, 3) float64, metres."""

    @abstractmethod
    def supervoxels(
        self, grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, known: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxel of each voxel, (v,) int32, numbered from 0 without gaps.

        Those known keep their numbers and voxels; others follow in the order of their first voxel.

        Every voxel has one, and every supervoxel is connected in the 26-neighbourhood.

        Parameters
        ----------
        grid : VoxelGrid of v voxels
        normals : (v, 3) float64
            Unit normals.
        seed_size : float, metres
            Spacing of supervoxels, their R_seed.
        known : (v,) int32
            Supervoxels from an earlier scan, numbered from 0 without gaps; -1 elsewhere.
        """

    @abstractmethod
    def supervoxel_of_point(
        self, points: NDArray[np.float64], grid: VoxelGrid, planes: LocalPlanes, supervoxels: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxel of each point, (n,) int32, given that of each voxel, (v,) int32."""


@dataclass(frozen=True)
class SurfaceGrowth(SupervoxelMethod):
    """Supervoxels that keep to edges to within a point: the default.

    Notes
    -----
    Growth, seeds and distance are those of VCCS (Papon et al. 2013) with four changes. Normals do not round off
    edges (see `local_planes`). Their cosine keeps its sign, so the two faces of a thin plate stay apart. After the
    growth a few k-means sweeps run along the boundaries. At last each point of a voxel on a boundary goes to the
    surface, its voxel's or one that touches it, on whose plane it lies.
    """

    spatial_weight: float = 0.2

    def planes(self, grid: VoxelGrid, viewpoints: NDArray[np.float64]) -> LocalPlanes:
        """Planes of windows that do not reach over an edge."""
        return local_planes(grid, viewpoints, reach=3)

    def supervoxels(
        self, grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, known: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxels by growth and k-means sweeps along their boundaries."""
        metric = Metric(self.spatial_weight / seed_size, self.normal_weight, self.color_weight, two_sided=False)
        features = voxel_features(grid, normals)
        seeds = seed_voxels(grid, normals, seed_size, two_sided=False)
        owner = grow(grid, features, metric, seeds, seed_size, known)
        settle_boundaries(grid, features, metric, owner, known >= 0)
        return connect(grid, features, metric, owner, known)

    def supervoxel_of_point(
        self, points: NDArray[np.float64], grid: VoxelGrid, planes: LocalPlanes, supervoxels: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Each point's surface, among those of its voxel and of the voxels that touch it."""
        return settle_points(points, grid, planes, supervoxels)


@dataclass(frozen=True)
class Vccs(SupervoxelMethod):
    """Voxel cloud connectivity segmentation with the distance, seeds and defaults of PCL's header.

    Notes
    -----
    Source: Papon et al. 2013. D = w_n (1 - |n . n'|) + w_c |c - c'| + w_s |x - x'| / R_seed. Two changes: growth
    does not stop at a number of steps, and what is cut off goes to a neighbour, so that all voxels are covered
    and supervoxels connected; sweeps propose first and commit afterwards, so that no result depends on the order
    in which supervoxels are visited.
    """

    def planes(self, grid: VoxelGrid, viewpoints: NDArray[np.float64]) -> LocalPlanes:
        """Planes of the windows around the voxels, two rings wide."""
        return local_planes(grid, viewpoints, reach=0)

    def supervoxels(
        self, grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, known: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxels by growth from seeds."""
        metric = Metric(self.spatial_weight / seed_size, self.normal_weight, self.color_weight, two_sided=True)
        features = voxel_features(grid, normals)
        seeds = seed_voxels(grid, normals, seed_size, two_sided=True)
        owner = grow(grid, features, metric, seeds, seed_size, known)
        return connect(grid, features, metric, owner, known)

    def supervoxel_of_point(
        self, points: NDArray[np.float64], grid: VoxelGrid, planes: LocalPlanes, supervoxels: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """The supervoxel of each point's voxel."""
        return supervoxels[grid.voxel_of_point]
