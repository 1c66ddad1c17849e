# SPDX-License-Identifier: Apache-2.0
"""Bridges: ways from specks to what is around them, as nothing near joins them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.graph.adjacency import Bridges
from pcgraph.pairs import nearest
from pcgraph.parallel import kernel, routine
from pcgraph.voxels.surface import Surface

_NEAR = 8  # supervoxels around one
_MAX_WIDTH = 1e6  # voxel edges
_FEW, _AS_NEAR, _MAX_WIDTH_BETWEEN = 4, 2.0, 30.0  # points, times the nearest of all, voxel edges: of one thin surface


def bridges(surface: Surface, counts: NDArray[np.int64], joined: NDArray[np.int32]) -> Bridges:
    """Edges from specks, components of fewer points than a mean supervoxel, to those around them.

    Around a speck are those that hold one of the eight supervoxels nearest to one of its own; the way is that
    between the two supervoxels of both nearest to each other.

    Parameters
    ----------
    surface : Surface
    counts : (k,) int64
        Points of each supervoxel.
    joined : (m, 2) int32
        Pairs of supervoxels that touch or nearly touch (`pcgraph.graph.adjacency.AdjacencyGraph.joined`).

    Notes
    -----
    Distances are those of the warped space, in voxel edges: between means of supervoxels to find a pair, between two
    of their voxels, each the other's nearest, for its width.
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
    means /= max(float(np.abs(means).max()), 1.0)  # which are nearer is all that counts, and squares stay finite
    distance, found = nearest(means, means[specks], min(_NEAR + 1, k))
    row, column = np.nonzero(component[found] != component[specks][:, None])
    edges = _closest_pairs(component, specks[row], found[row, column].astype(np.int64), distance[row, column])
    involved = np.zeros(k, np.bool_)
    involved[edges] = True
    voxels = np.flatnonzero(involved[supervoxels])
    voxels = voxels[np.argsort(supervoxels[voxels], kind="stable")]
    starts = np.concatenate((np.zeros(1, np.int64), np.cumsum(np.where(involved, n_voxels, 0))))
    larger = np.ones(k)
    np.maximum.at(larger, supervoxels[voxels], (grid.warped_edges / grid.size)[voxels])
    widths = np.minimum(_widths(edges, starts, places[voxels]) / larger[edges].max(axis=1), _MAX_WIDTH)
    edge_lengths = surface.mean_edge_lengths(k)
    of_few = (sizes <= _FEW)[component[edges]].all(axis=1)
    return Bridges(edges, widths, edge_lengths[edges].mean(axis=1), of_few & _are_near(component[edges], widths))


def _are_near(pairs: NDArray[np.int32], widths: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the components of each pair, (b, 2), lie about as near to each other as one of them to any other."""
    nearest = np.full(int(pairs.max(initial=-1)) + 1, np.inf)
    np.minimum.at(nearest, pairs, widths[:, None])
    return np.asarray(widths <= np.minimum(_AS_NEAR * nearest[pairs].max(axis=1), _MAX_WIDTH_BETWEEN))


def _closest_pairs(
    component: NDArray[np.int32], source: NDArray[np.int64], target: NDArray[np.int64], distance: NDArray[np.float64]
) -> NDArray[np.int32]:
    """The shortest way of each pair of components, (b, 2) int32, the smaller supervoxel first, ascending."""
    a, b = np.minimum(source, target), np.maximum(source, target)
    low, high = np.minimum(component[a], component[b]).astype(np.int64), np.maximum(component[a], component[b])
    pair = low * len(component) + high
    order = np.lexsort((b, a, distance, pair))
    first = order[np.flatnonzero(np.diff(pair[order], prepend=-1))]
    first = first[np.lexsort((b[first], a[first]))]
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
