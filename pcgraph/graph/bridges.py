# SPDX-License-Identifier: Apache-2.0
"""Bridges: ways between the components of a graph, so that a tree can weigh what nothing near joins."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcgraph.disjoint_sets import connected_components
from pcgraph.graph.adjacency import Bridges
from pcgraph.parallel import kernel, routine
from pcgraph.voxels.grid import VoxelGrid

_NEAR = 8  # supervoxels around one that are looked at first
_WIDEST = 1e6  # voxel edges
_SOME = 32  # supervoxels of a component, about, that tell how far the others need to look


def bridges(grid: VoxelGrid, supervoxels: NDArray[np.int32], joined: NDArray[np.int32]) -> Bridges:
    """Ways from components to those around them: of each two the pair of supervoxels nearest to each other.

    Around a component are those that hold one of the eight supervoxels nearest to one of its own. Where these ways do
    not join all, each component of what they join, but the largest, is bridged to the nearest, until all is one
    (Boruvka 1926).

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    supervoxels : (v,) int32
        Supervoxel of each voxel.
    joined : (m, 2) int32
        Pairs of supervoxels that touch or nearly touch (`pcgraph.graph.adjacency.AdjacencyGraph.joined`).

    Notes
    -----
    Distances are those of the warped space, in voxel edges: between means of supervoxels to find a pair, between two
    of their voxels, each the other's nearest, for its width.
    """
    k = int(supervoxels.max()) + 1
    component = connected_components(joined, k)
    edges = np.empty((0, 2), np.int32)
    if not component.any():
        return Bridges(edges, np.empty(0))
    places = grid.warped / grid.size
    counts = np.bincount(supervoxels, minlength=k)
    means = np.stack([np.bincount(supervoxels, x, k) / counts for x in places.T], axis=1)
    means -= means[0]
    means /= max(float(np.abs(means).max()), 1.0)  # which are nearer is all that counts, and squares stay finite
    edges = _closest_pairs(component, *_around(component, means))
    while (group := connected_components(np.concatenate((joined, edges)), k)).any():
        edges = np.concatenate((edges, _closest_pairs(group, *_nearest_outside(group, means))))
    edges = edges[np.lexsort((edges[:, 1], edges[:, 0]))]
    involved = np.zeros(k, np.bool_)
    involved[edges] = True
    voxels = np.flatnonzero(involved[supervoxels])
    voxels = voxels[np.argsort(supervoxels[voxels], kind="stable")]
    starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(np.where(involved, counts, 0))))
    return Bridges(edges, np.minimum(_widths(edges, starts, places[voxels]), _WIDEST))


_Ways = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]
"""Supervoxels from and to which they lead, and distances."""


def _around(component: NDArray[np.int32], means: NDArray[np.float64]) -> _Ways:
    """From supervoxels of all components but the largest to those near them in others."""
    seeking = _outside_largest(component)
    distance, found = cKDTree(means).query(means[seeking], k=min(_NEAR + 1, len(means)))
    row, column = np.nonzero(component[found] != component[seeking][:, None])
    return seeking[row], found[row, column].astype(np.int64), distance[row, column]


def _nearest_outside(component: NDArray[np.int32], means: NDArray[np.float64]) -> _Ways:
    """From each component but the largest the shortest way to a supervoxel of another.

    Two differ in a digit of their binary numbers: it leads to the nearest of all that differ in one of them. Some
    supervoxels tell how far the others need to look.
    """
    count, order = int(component.max()) + 1, np.argsort(component, kind="stable")
    starts = np.searchsorted(component[order], np.arange(count + 1))
    outside = []
    for digit in range((count - 1).bit_length()):
        one = (component >> digit & 1).astype(np.bool_)
        differ = np.flatnonzero(one), np.flatnonzero(~one)  # from those whose digit is 0, and 1
        outside.append([(cKDTree(means[side], balanced_tree=False, compact_nodes=False), side) for side in differ])
    ways = []
    for name in np.delete(np.arange(count), np.argmax(np.diff(starts))).tolist():
        own, best = order[starts[name] : starts[name + 1]], (np.inf, 0, 0)
        for some in (own[:: len(own) // _SOME + 1], own):
            for digit, sides in enumerate(outside):
                tree, others = sides[name >> digit & 1]
                distance, found = tree.query(means[some], distance_upper_bound=best[0])
                nearest = int(np.argmin(distance))
                if distance[nearest] < best[0]:
                    best = float(distance[nearest]), int(some[nearest]), int(others[found[nearest]])
        ways.append(best)
    distance, source, target = zip(*ways, strict=True)
    return np.array(source), np.array(target), np.array(distance)


def _outside_largest(component: NDArray[np.int32]) -> NDArray[np.int64]:
    return np.flatnonzero(component != np.bincount(component).argmax())


def _closest_pairs(
    component: NDArray[np.int32], source: NDArray[np.int64], target: NDArray[np.int64], distance: NDArray[np.float64]
) -> NDArray[np.int32]:
    """The shortest way of each pair of components, (b, 2) int32, the smaller supervoxel first."""
    a, b = np.minimum(source, target), np.maximum(source, target)
    low, high = np.minimum(component[a], component[b]).astype(np.int64), np.maximum(component[a], component[b])
    pair = low * len(component) + high
    order = np.lexsort((b, a, distance, pair))
    first = order[np.flatnonzero(np.diff(pair[order], prepend=-1))]
    return np.stack((a[first], b[first]), axis=1).astype(np.int32)


@kernel
def _widths(edges: NDArray[np.int32], starts: NDArray[np.int64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance, for each pair, of two places that are nearest to each other, (b,).

    ``places[starts[i]:starts[i + 1]]`` are those of supervoxel i. It starts from the one nearest to the other's first.
    """
    widths = np.empty(len(edges))
    for edge in range(len(edges)):
        least, at, side = np.inf, starts[edges[edge, 0]], 1
        while True:
            nearer, found = _nearest(places, at, starts[edges[edge, side]], starts[edges[edge, side] + 1])
            if nearer >= least:
                break
            least, at, side = nearer, found, 1 - side
        widths[edge] = np.sqrt(least)
    return widths


@routine
def _nearest(places: NDArray[np.float64], at: int, start: int, stop: int) -> tuple[float, int]:
    """Squared distance of a place to the nearest of some, and that one."""
    least, found = np.inf, start
    for other in range(start, stop):
        x, y, z = places[at, 0] - places[other, 0], places[at, 1] - places[other, 1], places[at, 2] - places[other, 2]
        square = x * x + y * y + z * z
        if square < least:
            least, found = square, other
    return least, found
