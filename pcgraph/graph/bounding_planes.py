# SPDX-License-Identifier: Apache-2.0
"""Bounding planes: floors, ceilings and walls, whose pieces are one where something stands before the gap."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments, grouped_moments
from pcgraph.features.nodes import NodeFeatures, node_features
from pcgraph.graph.continuations import Continuations, continuations_of
from pcgraph.pairs import distinct_pairs
from pcgraph.parallel import in_blocks, kernel
from pcgraph.voxels.directions import plane_basis
from pcgraph.voxels.surface import Surface

_MIN_VOXELS = 40  # of a piece, some two supervoxels
_MAX_RESIDUAL = 0.7  # voxel edges, RMS distance of a piece to its plane
_OFF_PLANE = 2.5  # voxel edges from which on something is behind or in front of a plane
_MAX_BEHIND, _MIN_IN_FRONT = 0.005, 0.2  # fraction of all voxels, for a plane that bounds the scene
_SAMPLED_SUPERVOXELS = 20_000  # on which that is judged
_MIN_COSINE, _MAX_OFFSET = 0.98, 1.0  # between two pieces of one plane; the offset in voxel edges
_MAX_GAP = 0.75  # widths of the larger piece
_FACING = 2.0  # borders face each other where they are at most so many times as far apart as at the nearest
MIN_HIDDEN = 0.5
"""Fraction of the lines across a gap that must be hidden."""
_MAX_HEIGHT = 2.0  # of what hides such a line, in lengths of the line
_MIN_ALONG = 0.5  # cosine between the normals of plane and of what hides it, either way
_INTERIOR_NEIGHBOURS = 8  # of the same piece, from which on a voxel is on no border
_MIN_TRIANGULATED = 4  # places
_NEAREST = 8  # supervoxels in front of a gap that are looked at


def bounding_planes(surface: Surface, nodes: NodeFeatures, faces: NDArray[np.int32]) -> Continuations:
    """Supervoxels on the borders that pieces of one bounding plane turn to each other.

    A plane bounds the scene if nothing lies behind it, and much before it: the floor of a room, its ceiling, its outer
    walls, a street. Two pieces of it are one if what is missing between them is hidden: something lies before most of
    the gap, as the top of a desk above a floor does, and nothing shows behind it. From where it was hidden need not be
    known, as it has to be for other continuations. What parts rooms, a partition, lies across the plane, not along it;
    and what faces as the pieces do and is larger is what they are set in, as doors and windows are in a wall. Between
    them lies at most three quarters of the width of the larger one, by the root of its area, which grows as they join.

    Parameters
    ----------
    surface : Surface of v voxels
    nodes : NodeFeatures of the k supervoxels
    faces : (k,) int32
        Which of them lie on one face.

    Returns
    -------
    Continuations
        All coplanar, as their pieces are, whatever their own normals. Crossings are ways across the gap, edges of the
        Delaunay triangulation of all borders on the plane. What lies so near that gaps join it
        (`pcgraph.graph.gaps.gaps`) is left to these.
    """
    scene = _scene(surface, nodes)
    pieces = _bounding_pieces(scene, nodes, faces)
    planes = list(_on_one_plane(pieces))
    borders = borders_of(surface, pieces.of_supervoxel, planes)
    ways = [_hidden_ways(surface, scene, pieces, some[0], border) for some, border in zip(planes, borders, strict=True)]
    occluded_spans = np.concatenate((np.empty((0, 2), np.int64), *ways))
    ends = surface.grid.warped[occluded_spans]
    edges = surface.grid.warped_edges[occluded_spans].max(axis=1)
    far = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > surface.grid.warp.max_gap * edges
    found = continuations_of(surface, nodes, occluded_spans[far])
    return replace(found, coplanar=np.ones(len(found.pairs), np.bool_))


class _Scene(NamedTuple):
    """The k supervoxels: places, outer normals, number of voxels, their mean edge length, and areas."""

    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    voxels: NDArray[np.int64]
    edges: NDArray[np.float64]
    areas: NDArray[np.float64]


class _Pieces(NamedTuple):
    """Faces that lie on bounding planes.

    Attributes
    ----------
    planes : NodeFeatures of p pieces
        All voxels count the same.
    edges : (p,) float64, metres
        Mean edge length of their voxels.
    areas : (p,) float64, square metres
    of_supervoxel : (k,) int64
        Piece of each supervoxel, -1 of those on none.
    """

    planes: NodeFeatures
    edges: NDArray[np.float64]
    areas: NDArray[np.float64]
    of_supervoxel: NDArray[np.int64]


def _scene(surface: Surface, nodes: NodeFeatures) -> _Scene:
    k = len(nodes.size)
    voxels = np.bincount(surface.supervoxels, minlength=k)
    edges = surface.mean_edge_lengths(k)
    return _Scene(nodes.centroid, nodes.normal, voxels, edges, voxels * edges * edges)


def _bounding_pieces(scene: _Scene, nodes: NodeFeatures, faces: NDArray[np.int32]) -> _Pieces:
    """Faces that are large and flat and bound the scene."""
    large = np.bincount(faces, scene.voxels) >= _MIN_VOXELS
    on, n = np.flatnonzero(large[faces]), int(large.sum())
    face = (np.cumsum(large) - 1)[faces[on]]
    voxels = scene.voxels[on]
    parts = Moments(voxels, nodes.centroid[on], voxels[:, None, None] * nodes.covariance[on], None)
    moments = grouped_moments(replace(parts, normals=nodes.normal[on]), face, n)
    planes = node_features(moments)
    edges = np.bincount(face, voxels * scene.edges[on], n) / planes.size
    flat = np.flatnonzero(planes.residual <= _MAX_RESIDUAL * edges)
    bounding = np.empty(len(flat), np.bool_)
    scattered = np.random.default_rng(0).permutation(len(faces))[:_SAMPLED_SUPERVOXELS]
    held = scene.voxels[scattered]
    others = scene.places[scattered], _OFF_PLANE * scene.edges[scattered], held, int(held.sum())
    in_blocks(_bound, len(flat), planes.centroid[flat], planes.normal[flat], *others, bounding)
    kept = flat[bounding]
    number, areas = np.full(n, -1), np.bincount(face, scene.areas[on], n).astype(np.float64)
    number[kept] = np.arange(len(kept))
    of_supervoxel = np.full(len(faces), -1)
    of_supervoxel[on] = number[face]
    return _Pieces(node_features(moments[kept]), edges[kept], areas[kept], of_supervoxel)


@kernel
def _bound(
    start: int,
    stop: int,
    centroids: NDArray[np.float64],
    normals: NDArray[np.float64],
    places: NDArray[np.float64],
    beyond: NDArray[np.float64],
    voxels: NDArray[np.int64],
    total: int,
    found: NDArray[np.bool_],
) -> None:
    """Set which planes have nearly nothing behind them and much before them, given the supervoxels and the total of
    their voxels."""
    for plane in range(start, stop):
        behind = before = 0
        for s in range(len(places)):
            height = 0.0
            for axis in range(3):
                height += (places[s, axis] - centroids[plane, axis]) * normals[plane, axis]
            behind += voxels[s] if height < -beyond[s] else 0
            before += voxels[s] if height > beyond[s] else 0
            if behind > _MAX_BEHIND * total:
                break
        found[plane] = behind <= _MAX_BEHIND * total and before >= _MIN_IN_FRONT * total


def _on_one_plane(pieces: _Pieces) -> Iterator[NDArray[np.int64]]:
    """Pieces, two or more, that lie on the plane of the largest of them."""
    planes, left = pieces.planes, np.argsort(-pieces.areas, kind="stable")
    while len(left) > 1:
        first = left[0]
        cosine = np.einsum("ij,j->i", planes.normal[left], planes.normal[first])
        off = np.maximum(_offset(planes, left, first), _offset(planes, first, left))
        on_it = (cosine >= _MIN_COSINE) & (off <= _MAX_OFFSET * np.maximum(pieces.edges[left], pieces.edges[first]))
        on_it[0] = True
        if on_it.sum() > 1:
            yield left[on_it]
        left = left[~on_it]


def _offset(planes: NodeFeatures, ones: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.float64]:
    """Root mean square distances of the ones' voxels to the others' planes, metres."""
    normals = planes.normal[others]
    shift = ((planes.centroid[ones] - planes.centroid[others]) * normals).sum(axis=-1)
    spread = np.einsum("...i,...ij,...j->...", normals, planes.covariance[ones], normals)
    return np.sqrt(shift * shift + np.maximum(spread, 0.0))


def borders_of(
    surface: Surface, of_supervoxel: NDArray[np.int64], groups: list[NDArray[np.int64]]
) -> list[NDArray[np.int64]]:
    """Voxels of the pieces of each group that have fewer than eight of the same piece around them.

    Parameters
    ----------
    surface : Surface
    of_supervoxel : (k,) int64
        Piece of each supervoxel, -1 of those on none.
    groups : list of (p,) int64
        Pieces.
    """
    if not groups:
        return []
    grid, on = surface.grid, np.full(int(of_supervoxel.max()) + 2, -1)  # the last is of what lies on no piece
    for number, some in enumerate(groups):
        on[some] = number
    piece = of_supervoxel[surface.supervoxels]
    voxels = np.flatnonzero(on[piece] >= 0)
    row, neighbours = grid.around(voxels)
    around = np.bincount(row, piece[neighbours] == piece[voxels[row]], len(voxels))
    voxels = voxels[around < _INTERIOR_NEIGHBOURS]
    order = np.argsort(on[piece[voxels]], kind="stable")
    counts = np.bincount(on[piece[voxels]], minlength=len(groups))
    return np.split(voxels[order], np.cumsum(counts)[:-1])


class FacingWays(NamedTuple):
    """Ways between borders of pieces that face each other: edges of the Delaunay triangulation of all borders.

    Attributes
    ----------
    ends : (c, 2) int64
        Numbers of the places on two borders.
    lengths : (c,) float64, metres
    pair : (c,) int64
        The pair of pieces of each.
    pairs : (q, 2) int32
        Pieces, the smaller number first.
    widths : (q,) float64, metres
        Least length of their ways.
    """

    ends: NDArray[np.int64]
    lengths: NDArray[np.float64]
    pair: NDArray[np.int64]
    pairs: NDArray[np.int32]
    widths: NDArray[np.float64]


def facing_ways(places: NDArray[np.float64], projected: NDArray[np.float64], piece: NDArray[np.int64]) -> FacingWays:
    """Ways between places on borders, (b, 3) metres, whose projections on a plane, (b, 2) in voxel edges, are
    triangulated, and which are on a piece each, (b,).

    The projections are joggled, so that places on a lattice or a line are no error.
    """
    triangles = np.empty((0, 3), np.int32)
    if len(places) >= _MIN_TRIANGULATED:
        from scipy.spatial import Delaunay

        triangles = Delaunay(projected, qhull_options="QJ").simplices
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    ends, _ = distinct_pairs(*np.sort(sides[piece[sides[:, 0]] != piece[sides[:, 1]]], axis=1).T)
    lengths = np.linalg.norm(places[ends[:, 1]] - places[ends[:, 0]], axis=1)
    pairs, pair = distinct_pairs(*np.sort(piece[ends], axis=1).T)
    widths = np.full(len(pairs), np.inf)
    np.minimum.at(widths, pair, lengths)
    facing = lengths <= _FACING * widths[pair]
    return FacingWays(ends[facing], lengths[facing], pair[facing], pairs, widths)


def _hidden_ways(
    surface: Surface, scene: _Scene, pieces: _Pieces, first: np.int64, border: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Voxels at both ends of the ways across gaps, (c, 2), between pieces of one plane that are one.

    Of the pieces the first says where the plane lies.
    """
    piece = pieces.of_supervoxel[surface.supervoxels[border]]
    places = surface.grid.centroids[border]
    normal = pieces.planes.normal[first]
    plane = Plane(pieces.planes.centroid[first], normal, plane_basis(normal))
    ways = facing_ways(places, plane.project(places) / pieces.edges[first], piece)  # no unit is too small
    middles, larger = plane.project(places[ways.ends].mean(axis=1)), pieces.areas[ways.pairs].max(axis=1)[ways.pair]
    heights, n_pairs = plane.heights(scene.places), len(ways.pairs)
    hidden = np.bincount(ways.pair, _is_hidden(scene, plane, heights, middles, ways.lengths, larger), n_pairs)
    opened = np.bincount(ways.pair, _is_open(scene, plane, heights, middles, ways.lengths), n_pairs)
    may_join = (hidden >= MIN_HIDDEN * np.bincount(ways.pair, minlength=n_pairs)) & (opened == 0)
    return border[ways.ends[joining(ways, may_join, pieces.areas)[ways.pair]]]


class Plane(NamedTuple):
    """A plane: a place on it, its unit normal, and two directions along it, (2, 3)."""

    origin: NDArray[np.float64]
    normal: NDArray[np.float64]
    axes: NDArray[np.float64]

    def heights(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distances of places, (n, 3), to the plane, (n,)."""
        return np.einsum("ij,j->i", places - self.origin, self.normal)

    def project(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where on the plane the places lie, (n, 2)."""
        return np.einsum("ij,kj->ik", places - self.origin, self.axes)


def _is_hidden(
    scene: _Scene,
    plane: Plane,
    heights: NDArray[np.float64],
    middles: NDArray[np.float64],
    lengths: NDArray[np.float64],
    larger: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether something lies before the middle of each way, (c,), and not what the pieces are set in.

    That is: what faces as they do, and takes more of a plane parallel to theirs than the larger one of them theirs.
    """
    cosines = np.einsum("ij,j->i", scene.normals, plane.normal)
    before = np.flatnonzero((heights > scene.edges) & (np.abs(cosines) >= _MIN_ALONG))
    if not len(before):
        return np.zeros(len(middles), np.bool_)
    parallel = np.flatnonzero(cosines >= _MIN_COSINE)
    parallel = parallel[np.argsort(heights[parallel], kind="stable")]
    areas = np.concatenate((np.zeros(1), np.cumsum(scene.areas[parallel])))
    bands = heights[before] + np.array([[-1.0], [1.0]]) * scene.edges[before]
    low, high = areas[np.searchsorted(heights[parallel], bands)]
    sets_in = np.where(cosines[before] >= _MIN_COSINE, high - low, 0.0)
    from scipy.spatial import cKDTree

    some = np.arange(1, min(_NEAREST, len(before)) + 1)
    distance, number = cKDTree(plane.project(scene.places[before])).query(middles, k=some)
    nearest, ways = before[number], lengths[:, None]
    over = distance <= np.maximum(0.5 * ways, _OFF_PLANE * scene.edges[nearest])
    hides = over & (heights[nearest] > _OFF_PLANE * scene.edges[nearest]) & (heights[nearest] <= _MAX_HEIGHT * ways)
    return hides.any(axis=1) & ~(over & (sets_in[number] > larger[:, None])).any(axis=1)


def _is_open(
    scene: _Scene,
    plane: Plane,
    heights: NDArray[np.float64],
    middles: NDArray[np.float64],
    lengths: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether something shows behind the plane at the middle of each way, (c,)."""
    behind = scene.places[heights < -_OFF_PLANE * scene.edges]
    if not len(behind):
        return np.zeros(len(middles), np.bool_)
    from scipy.spatial import cKDTree

    return cKDTree(plane.project(behind)).query(middles)[0] <= 0.5 * lengths


def joining(ways: FacingWays, may_join: NDArray[np.bool_], areas: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which pairs, (q,) bool, join pieces, of so many square metres, that are not one yet: of those that may, the
    nearest first; as what is one grows, wider gaps are bridged."""
    pairs, widths = ways.pairs, ways.widths
    whole, areas = np.arange(len(areas)), areas.copy()
    joins, order, joined = np.zeros(len(pairs), np.bool_), np.argsort(widths, kind="stable"), True
    order = order[may_join[order]]
    while joined:
        joined, order = False, order[whole[pairs[order, 0]] != whole[pairs[order, 1]]]
        for pair in order.tolist():
            a, b = whole[pairs[pair]]
            if a != b and widths[pair] <= _MAX_GAP * np.sqrt(max(areas[a], areas[b])):
                joins[pair] = joined = True
                areas[a] += areas[b]
                whole[whole == b] = a
    return joins
