# SPDX-License-Identifier: Apache-2.0
"""Surface growth: supervoxels that keep to edges to within a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import check_non_negative
from pcgraph.parallel import in_blocks, kernel, side_by_side
from pcgraph.supervoxels.clustering import (
    EARLY_SWEEPS,
    Metric,
    VoxelGraph,
    enforce_connectivity,
    expand,
    refine,
    seed_voxels,
    voxel_graph,
)
from pcgraph.supervoxels.method import SupervoxelMethod
from pcgraph.voxels.cells import fetch_batch
from pcgraph.voxels.column_evidence import color_evidence
from pcgraph.voxels.grid import Neighbourhood, VoxelGrid, most_around
from pcgraph.voxels.surface import LocalPlanes, local_planes

_NOISE_OFF_PLANE = 0.5
"""Distance from a supervoxel's plane, voxel edges, that noise may be: below it Huber's loss is quadratic, because in
proportion it parts noisy flat ground in ragged pieces (8.3 for 6.9 neighbours per supervoxel). Half an edge is what
voxels make of a plane."""
_PLACE_WEIGHT = 0.3
"""Weight of a metre along the surface over one off the plane, a ratio, when a point chooses a voxel. Chosen by eye; not
varied."""


@dataclass(frozen=True)
class SurfaceGrowth(SupervoxelMethod):
    """Supervoxels that keep to edges to within a point: the default.

    Attributes
    ----------
    color_weight, spatial_weight, normal_weight : float, >= 0
        Weights in the distance of a voxel to a supervoxel, of colours in 0..1, metres over the seed size, and one minus
        the cosine of normals: w_c, w_s and w_n of Papon et al. 2013, equation 7. The weight of colours is multiplied by
        how far they change where surfaces do, so noise and patterns do not count (`pcgraph.voxels.column_evidence`).
    plane_weight : float, >= 0
        Weight of the distance h, in voxel edges, of a voxel from the plane through the supervoxel's mean, by Huber's
        loss: h^2 up to half an edge, which noise may be, and h - 1/4 beyond. It separates parallel surfaces that are a
        voxel or two from each other, which normals do not. Weights of 0.3 to 0.5 are alike to 0.002.
    feature_weight : float, >= 0
        Weight of one robust spread of the features given to `pcgraph.segment`, multiplied by their spatial
        autocorrelation, so noise does not count (`pcgraph.voxels.column_evidence.autocorrelation`).

    Notes
    -----
    Expansion, seeds and distance are those of VCCS (Papon et al. 2013) with five changes. Normals do not round off
    edges (`local_planes`). Their cosine keeps its sign, so the two faces of a thin plate stay apart. Voxels off a
    supervoxel's plane are farther from it than voxels in the plane (distance to a proxy's plane, Cohen-Steiner et al.
    2004), and two parallel surfaces in one seed cell have a seed each. After the expansion a few k-means sweeps refine
    the boundaries. At last each point of a voxel on a boundary goes to the surface, its voxel's or one that touches it,
    on whose plane it lies.
    """

    color_weight: float = 1.0
    spatial_weight: float = 0.2
    normal_weight: float = 1.0
    plane_weight: float = 0.4
    feature_weight: float = 0.1

    def __post_init__(self) -> None:
        check_non_negative(self)

    def planes(self, grid: VoxelGrid, viewpoints: NDArray[np.float64]) -> LocalPlanes:
        """Planes of windows that do not straddle edges."""
        return local_planes(grid, viewpoints, reach=3)

    def supervoxels(
        self, grid: VoxelGrid, normals: NDArray[np.float64], seed_size: float, initial: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxels by expansion and k-means sweeps along their boundaries."""

        def graph() -> VoxelGraph:
            color = self.color_weight * color_evidence(grid, normals)
            weights = self.spatial_weight / seed_size, self.normal_weight, color
            plane, per_slack = _NOISE_OFF_PLANE * self.plane_weight, 1.0 / (_NOISE_OFF_PLANE * grid.size)
            metric = Metric(*weights, False, plane, per_slack, self.feature_weight)
            return voxel_graph(grid, normals, metric)

        voxels, seeds = side_by_side(graph, lambda: seed_voxels(grid, normals, seed_size, two_sided=False))
        labels = expand(voxels, seeds, EARLY_SWEEPS * seed_size / grid.size, initial)
        refine(voxels, labels, initial >= 0)
        return enforce_connectivity(voxels, labels, initial)

    def supervoxel_of_point(
        self, points: NDArray[np.float64], grid: VoxelGrid, planes: LocalPlanes, supervoxels: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Supervoxel of each point: that of its voxel, or of a voxel that touches it."""
        return assign_points(points, grid, planes, supervoxels)


class PointsOfVoxels(NamedTuple):
    """Points (n, 3) by voxel: ``points[order[starts[i]:starts[i + 1]]]`` are those of voxel i."""

    points: NDArray[np.float64]
    order: NDArray[np.int64]
    starts: NDArray[np.int64]


def assign_points(
    points: NDArray[np.float64], grid: VoxelGrid, planes: LocalPlanes, supervoxels: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Supervoxel of each point, (n,) int32: that of its voxel, or of a voxel that touches it.

    A point p takes the supervoxel of the voxel i with the least (n_i . (p - o_i))^2 + (0.3 |p - x_i|)^2. Candidates are
    its own voxel, and those around it of other supervoxels; n_i and o_i are the plane, and x_i the centroid, of voxel
    i. Voxels that would lose all their points keep them, so every supervoxel stays connected, and none vanishes.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Points of the grid, in its order.
    grid : VoxelGrid of v voxels
    planes : LocalPlanes of v voxels
    supervoxels : (v,) int32
    """
    chosen = np.empty(len(points), np.int32)
    # Rows of centroid, normal, and how far along the normal the plane lies off the centroid; one fills a cache line.
    surface = np.zeros((grid.n_voxels, 8))
    surface[:, :3], surface[:, 3:6] = grid.centroids, planes.normals
    for axis in range(3):
        surface[:, 6] += planes.normals[:, axis] * (planes.origins[:, axis] - grid.centroids[:, axis])
    members = PointsOfVoxels(points, grid.order, grid.starts)
    in_blocks(_assign, grid.n_voxels, members, grid.neighbourhood, surface, supervoxels, chosen)
    return chosen


@kernel
def _assign(
    start: int,
    stop: int,
    members: PointsOfVoxels,
    around: Neighbourhood,
    surface: NDArray[np.float64],
    supervoxels: NDArray[np.int32],
    chosen: NDArray[np.int32],
) -> None:
    """Set the supervoxel of each point as `assign_points` says; of equal candidates its own voxel's."""
    points, order, starts = members
    indptr, neighbours = around
    weight = _PLACE_WEIGHT * _PLACE_WEIGHT
    most = most_around(indptr)
    near, others, labels = np.empty((most, 8)), np.empty(most + 1, np.uint32), np.empty(most + 1, np.int32)
    places, nearest = np.empty((0, 3)), np.empty(0, np.int32)
    first = start
    while first < stop:
        last, places = fetch_batch(points, order, starts, first, stop, places)
        begin = starts[first]
        if len(places) > len(nearest):
            nearest = np.empty(len(places), np.int32)
        for v in range(first, last):
            own, n = supervoxels[v], 0
            # Voxels around of other supervoxels, without a branch, which would often be mispredicted.
            for a in range(indptr[v], indptr[v + 1]):
                others[n], labels[n] = neighbours[a], supervoxels[neighbours[a]]
                n += labels[n] != own
            for i in range(n):
                for column in range(7):
                    near[i, column] = surface[others[i], column]
            own_points, stay = range(starts[v] - begin, starts[v + 1] - begin), n == 0
            for m in own_points:
                px, py, pz = places[m, 0], places[m, 1], places[m, 2]
                x, y, z = px - surface[v, 0], py - surface[v, 1], pz - surface[v, 2]
                off = surface[v, 3] * x + surface[v, 4] * y + surface[v, 5] * z - surface[v, 6]
                least, label = off * off + weight * (x * x + y * y + z * z), own
                for i in range(n):
                    x, y, z = px - near[i, 0], py - near[i, 1], pz - near[i, 2]
                    away = weight * (x * x + y * y + z * z)
                    if away < least:
                        off = near[i, 3] * x + near[i, 4] * y + near[i, 5] * z - near[i, 6]
                        if off * off + away < least:
                            least, label = off * off + away, labels[i]
                nearest[m] = label
                stay = stay or label == own
            if not stay:
                for m in own_points:
                    nearest[m] = own
        for m in range(starts[last] - begin):
            chosen[order[begin + m]] = nearest[m]
        first = last
