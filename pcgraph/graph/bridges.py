# SPDX-License-Identifier: Apache-2.0
"""Bridges: ways from specks, which touch nothing, to the components around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.graph.adjacency import Bridges
from pcgraph.pairs import nearest
from pcgraph.parallel import kernel, routine
from pcgraph.voxels.surface import Surface


@dataclass(frozen=True)
class BridgeThresholds:
    """Thresholds that choose the components around a speck, and bridges within a thinly sampled surface.

    Attributes
    ----------
    n_nearest : int, count
        Nearest supervoxels of each supervoxel of a speck; the components around the speck hold one of them. Chosen by
        eye; not varied.
    max_width : float, voxel edges
        Width that is recorded at most, so that costs stay finite where a component is very far off.
    max_points : int, points
        Points of a speck, at most, that may be a part of a surface sampled too thinly for the voxels. Chosen on a house
        seen through a window, which fell into thousands of objects; the same of the next two.
    times_nearest : float, times
        Width, at most, over the way from one of the two specks to anything.
    max_width_of_surface : float, voxel edges
        Width, at most, between two points of one surface.
    """

    n_nearest: int = 8
    max_width: float = 1e6
    max_points: int = 4
    times_nearest: float = 2.0
    max_width_of_surface: float = 30.0


_THRESHOLDS = BridgeThresholds()


def bridges(surface: Surface, counts: NDArray[np.int64], joined: NDArray[np.int32]) -> Bridges:
    """Edges from specks, components of fewer points than a mean supervoxel, to the components around them.

    The components around a speck are those that hold one of the eight supervoxels nearest to one of the speck's own. A
    bridge joins the two supervoxels of both components that are nearest to each other.

    Parameters
    ----------
    surface : Surface
    counts : (k,) int64
        Points of each supervoxel.
    joined : (m, 2) int32
        Pairs of supervoxels that touch or nearly touch (`pcgraph.graph.adjacency.AdjacencyGraph.joined`).

    Notes
    -----
    Distances are in the warped space, in voxel edges. To find a pair they are measured between means of supervoxels;
    the width is the distance of two of their voxels, each the other's nearest.
    """
    grid, supervoxels, k = surface.grid, surface.supervoxels, len(counts)
    component = connected_components(joined, k)
    sizes = np.bincount(component, counts)
    specks = np.flatnonzero((sizes < counts.mean())[component])
    if not component.any() or not len(specks):
        return Bridges(np.empty((0, 2), np.int32), np.empty(0), np.empty(0), np.empty(0, np.bool_))
    places = grid.warped / grid.size
    n_voxels = np.bincount(supervoxels, minlength=k)
    means = np.stack([np.bincount(supervoxels, x, k) / n_voxels for x in places.T], axis=1)
    means -= means[0]
    means /= max(float(np.abs(means).max()), 1.0)  # squares stay finite, and only the order of distances counts
    distance, found = nearest(means, means[specks], min(_THRESHOLDS.n_nearest + 1, k))
    row, column = np.nonzero(component[found] != component[specks][:, None])
    edges = _closest_pairs(component, specks[row], found[row, column].astype(np.int64), distance[row, column])
    involved = np.zeros(k, np.bool_)
    involved[edges] = True
    voxels = np.flatnonzero(involved[supervoxels])
    voxels = voxels[np.argsort(supervoxels[voxels], kind="stable")]
    starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(np.where(involved, n_voxels, 0))))
    larger = np.ones(k)
    np.maximum.at(larger, supervoxels[voxels], (grid.warped_edges / grid.size)[voxels])
    widths = _widths(edges, starts, places[voxels]) / larger[edges].max(axis=1)
    widths = np.minimum(widths, _THRESHOLDS.max_width)
    edge_lengths = surface.mean_edge_lengths(k)
    of_few = (sizes <= _THRESHOLDS.max_points)[component[edges]].all(axis=1)
    return Bridges(edges, widths, edge_lengths[edges].mean(axis=1), of_few & _are_near(component[edges], widths))


def _are_near(pairs: NDArray[np.int32], widths: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the components of each pair, (b, 2), lie about as near to each other as one of them to anything."""
    nearest = np.full(int(pairs.max(initial=-1)) + 1, np.inf)
    np.minimum.at(nearest, pairs, widths[:, None])
    limit = _THRESHOLDS.times_nearest * nearest[pairs].max(axis=1)
    return np.asarray(widths <= np.minimum(limit, _THRESHOLDS.max_width_of_surface))


def _closest_pairs(
    component: NDArray[np.int32], source: NDArray[np.int64], target: NDArray[np.int64], distance: NDArray[np.float64]
) -> NDArray[np.int32]:
    """Ends of the shortest way between each pair of components, (b, 2) int32, ascending, the smaller first."""
    a, b = np.minimum(source, target), np.maximum(source, target)
    low, high = np.minimum(component[a], component[b]).astype(np.int64), np.maximum(component[a], component[b])
    pair = low * len(component) + high
    order = np.lexsort((b, a, distance, pair))
    first = order[np.flatnonzero(np.diff(pair[order], prepend=-1))]
    first = first[np.lexsort((b[first], a[first]))]
    return np.stack((a[first], b[first]), axis=1).astype(np.int32)


@kernel
def _widths(edges: NDArray[np.int32], starts: NDArray[np.int64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of two places of each pair of supervoxels, each the other's nearest, (b,).

    ``places[starts[i]:starts[i + 1]]`` are those of supervoxel i. The search begins at the first place of one
    supervoxel, and goes to the nearest place of the other, and back, as long as that is nearer.
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
    """Squared distance from a place to the nearest of those from start to stop, and the number of that one."""
    least, found = np.inf, start
    for other in range(start, stop):
        x, y, z = places[at, 0] - places[other, 0], places[at, 1] - places[other, 1], places[at, 2] - places[other, 2]
        square = x * x + y * y + z * z
        if square < least:
            least, found = square, other
    return least, found
