# SPDX-License-Identifier: Apache-2.0
"""Gaps: supervoxels that do not touch but lie close by, where a surface was sampled too thinly or is hidden in part."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.kinds import Acquisition
from pcgraph.disjoint_sets import connected_components
from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.adjacency import Gaps
from pcgraph.graph.contacts import edge_features, facing_sides
from pcgraph.graph.continuations import MAX_RESIDUAL
from pcgraph.parallel import in_blocks, kernel
from pcgraph.voxels.grid import VoxelGrid, at_ends, boundary_voxels, voxels_within
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.visibility import depth_order_along

_SHORTEST = 8
"""Most ways across a gap that are looked through, the shortest ones, a count, because a long boundary has thousands."""
_SEEN_THROUGH = 0.5
"""Least fraction of these through which something is seen, where nothing is missing: half of them."""
_BEHIND = 1.5
"""Least depth by which what is seen through a gap lies behind it, voxel edges. Chosen by eye."""
_MIDDLE = (0.3, 0.4, 0.5, 0.6, 0.7)
"""Places along a way, each a fraction of its length, because its ends cover what is seen near them."""
_FINER = 2.5
"""Finer bins, and smaller surfels, times, because ways are as short as two widths. Measured: from 2 to 3 equal cartons
in a row stay apart in all of five draws; at 4 two join in one of them."""


def gaps(
    surface: Surface,
    nodes: NodeFeatures,
    touching: NDArray[np.int32],
    acquisition: Acquisition,
) -> Gaps:
    """Pairs of supervoxels that do not touch, but whose boundary voxels come near each other.

    Near is three voxel edges, or six where voxels grow with range from a scanner, whose rows lie far apart
    (`pcgraph.voxels.warp.Warp.max_gap`); with more, cars that are parked side by side are one thing.

    Parameters
    ----------
    surface : Surface
    nodes : NodeFeatures of k supervoxels
    touching : (m, 2) int32
        Pairs of supervoxels that touch, the smaller first, ascending.
    acquisition : Acquisition
        If it is one scan from one place, and something behind is seen from there between two smooth supervoxels, as the
        floor between equal desks in a row, nothing of either is hidden or missing: they are apart.

    Notes
    -----
    Only voxels at the ends of surfaces are looked at: those with fewer than eight around them and, beside the largest
    component, those in strips. A row of points that lies on a border between cells has voxels on either side, and two
    such rows up to eleven around each: a scan whose rows lie far apart is hundreds of such strips.
    """
    grid, supervoxels, k = surface.grid, surface.supervoxels, np.int64(len(nodes.size))
    boundary = _ends_of_surfaces(grid, supervoxels, touching, int(k))
    near = voxels_within(grid, boundary, grid.warp.max_gap, boundary, later=True)
    source: NDArray[np.int64] = np.repeat(boundary, np.diff(near.indptr))
    target = near.neighbours
    starts = np.searchsorted(touching[:, 0], np.arange(k + 1))
    apart = np.empty(len(source), np.bool_)
    in_blocks(_find_apart, len(source), source, target, supervoxels, starts, touching[:, 1].copy(), apart)
    source, target = source[apart], target[apart]
    key = _keys(supervoxels[source], supervoxels[target], k)
    larger = grid.warped_edges
    larger = np.maximum(larger[source], larger[target])
    width = np.linalg.norm((grid.warped[source] - grid.warped[target]) / larger[:, None], axis=1)
    place = acquisition.one_viewpoint
    if place is not None and acquisition.is_one_scan and len(source):
        closed = ~_open_ways(surface, nodes, place, source, target.astype(np.int64), key, width)
        source, target, key, width = source[closed], target[closed], key[closed], width[closed]
    key, width = np.tile(key, 2), np.tile(width, 2)  # each side of each pair
    voxel: NDArray[np.int64] = np.concatenate((source, target))
    other = np.concatenate((supervoxels[target], supervoxels[source]))
    ways = voxel * k + other
    order = np.argsort(ways, kind="stable")
    starts = np.flatnonzero(np.diff(ways[order], prepend=-1))
    if len(starts):
        width = np.minimum.reduceat(width[order], starts)  # of each voxel the shortest way to each other supervoxel
    first = order[starts]
    voxel, other, key = voxel[first], other[first], key[first]
    own = supervoxels[voxel]
    keys, edge = np.unique(key, return_inverse=True)
    edges = np.stack((keys // k, keys % k), axis=1).astype(np.int32)
    facing = facing_sides(surface, edges, voxel, 2 * edge + (own > other))
    shortest = np.full(len(edges), np.inf)
    np.minimum.at(shortest, edge, width)
    weights = np.bincount(edge, np.exp(1.0 - width), len(edges)).astype(np.float64)
    return Gaps(edges, edge_features(nodes, facing), shortest, weights)


def _open_ways(
    surface: Surface,
    nodes: NodeFeatures,
    place: NDArray[np.float64],
    source: NDArray[np.int64],
    target: NDArray[np.int64],
    key: NDArray[np.int64],
    width: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether each of m pairs of voxels belongs to two smooth supervoxels between which something is seen, (m,).

    The key numbers pairs of supervoxels, and the shortest of the ways between two tell. Of a crown, which is not
    smooth, something is seen through everywhere.
    """
    order = np.lexsort((width, key))
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    pair = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(key)))
    shortest = np.arange(len(key)) - starts[pair] < _SHORTEST
    some, of_pair = order[shortest], pair[shortest]
    through = seen_between(surface, place, np.stack((source[some], target[some]), axis=1))
    supervoxels = surface.supervoxels
    is_smooth = nodes.residual <= MAX_RESIDUAL * surface.mean_edge_lengths(len(nodes.size))
    is_open = np.bincount(of_pair, through) >= _SEEN_THROUGH * np.bincount(of_pair)
    is_open &= (is_smooth[supervoxels[source]] & is_smooth[supervoxels[target]])[order[starts]]
    opened = np.empty(len(key), np.bool_)
    opened[order] = is_open[pair]
    return opened


def seen_between(surface: Surface, place: NDArray[np.float64], ends: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether something farther off is seen from a place in the middle between two voxels, (m, 2); (m,) bool."""
    order = depth_order_along(surface.grid, surface.normals, place[None], ends, _MIDDLE, _BEHIND, _FINER)
    return np.asarray((order[0] > 0).any(axis=0))


def _ends_of_surfaces(
    grid: VoxelGrid, supervoxels: NDArray[np.int32], touching: NDArray[np.int32], k: int
) -> NDArray[np.int64]:
    """Voxels at the ends of surfaces, ascending; of the largest component, if that is most of all, those with few
    around them alone, as there is no time to look at others."""
    ends, of_nodes = boundary_voxels(grid), connected_components(touching, k)
    if of_nodes.any():
        components = of_nodes[supervoxels].astype(np.int64)
        sizes, looked_at = np.bincount(components), ~ends
        if 2 * sizes.max() > len(components):
            looked_at &= components != sizes.argmax()
        others = np.flatnonzero(looked_at)
        ends[others] = at_ends(grid, others, components)
    return np.flatnonzero(ends)


@kernel
def _find_apart(
    start: int,
    stop: int,
    source: NDArray[np.int64],
    target: NDArray[np.int32],
    supervoxels: NDArray[np.int32],
    starts: NDArray[np.int64],
    touching: NDArray[np.int32],
    apart: NDArray[np.bool_],
) -> None:
    """Set which pairs of voxels belong to two supervoxels that do not touch.

    ``touching[starts[a]:starts[a + 1]]`` are the larger supervoxels that supervoxel a touches.
    """
    for i in range(start, stop):
        a, b = supervoxels[source[i]], supervoxels[target[i]]
        smaller, larger = min(a, b), max(a, b)
        apart[i] = a != b
        for at in range(starts[smaller], starts[smaller + 1]):
            if touching[at] == larger:
                apart[i] = False
                break


def _keys(a: NDArray[np.int32], b: NDArray[np.int32], k: np.int64) -> NDArray[np.int64]:
    """One number per pair of supervoxels below k, (m,), in either order."""
    return np.minimum(a, b).astype(np.int64) * k + np.maximum(a, b)
