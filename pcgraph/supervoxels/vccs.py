# SPDX-License-Identifier: Apache-2.0
"""VCCS: voxel cloud connectivity segmentation, Papon et al. 2013."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import check_non_negative
from pcgraph.supervoxels.clustering import EARLY_SWEEPS, Metric, enforce_connectivity, expand, seed_voxels, voxel_graph
from pcgraph.supervoxels.method import SupervoxelMethod
from pcgraph.voxels.grid import VoxelGrid
from pcgraph.voxels.surface import LocalPlanes, local_planes


@dataclass(frozen=True)
class Vccs(SupervoxelMethod):
    """Voxel cloud connectivity segmentation with the distance, seeds and defaults of PCL's header.

    Attributes
    ----------
    color_weight, spatial_weight, normal_weight : float, >= 0
        Weights in the distance of a voxel to a supervoxel: their w_c (colours in 0..1), w_s (metres over the seed size)
        and w_n (one minus the cosine), equation 7. The defaults are those of PCL's header.
    feature_weight : float, >= 0
        Weight of the features given to `pcgraph.segment`, as in `SurfaceGrowth`; PCL has none.

    Notes
    -----
    Source: Papon et al. 2013. D = w_n (1 - |n . n'|) + w_c |c - c'| + w_s |x - x'| / R_seed. There are two changes.
    Expansion does not stop at a number of steps, and pieces that are cut off go to a neighbour, so all voxels are
    covered, and supervoxels are connected. Sweeps first propose all changes and then make them, so no result depends on
    the order in which supervoxels are visited.
    """

    color_weight: float = 0.1
    spatial_weight: float = 0.4
    normal_weight: float = 1.0
    feature_weight: float = 0.1

    def __post_init__(self) -> None:
        check_non_negative(self)

    def planes(self, grid: VoxelGrid, viewpoints: NDArray[np.float64]) -> LocalPlanes:
        """Planes of the windows of voxels and the two rings around them."""
        return local_planes(grid, viewpoints, reach=0)

    def supervoxels(
        self, grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, initial: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxels by expansion from seeds."""
        weights = self.spatial_weight / seed_size, self.normal_weight, self.color_weight
        metric = Metric(*weights, two_sided=True, feature=self.feature_weight)
        voxels = voxel_graph(grid, normals, metric)
        seeds = seed_voxels(grid, normals, seed_size, two_sided=True)
        labels = expand(voxels, seeds, EARLY_SWEEPS * seed_size / grid.size, initial)
        return enforce_connectivity(voxels, labels, initial)
