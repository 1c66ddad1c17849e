# SPDX-License-Identifier: Apache-2.0
"""Continuations: pieces of one surface that do not touch, as something hides what lies between them.

`continuations` joins them: pieces of one plane, and pieces of the ground as it is seen from far above. Both are judged
on the ways that lead across the gap, from border to border.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.kinds import Acquisition
from pcgraph.disjoint_sets import connected_components
from pcgraph.features.moments import Moments, grouped_moments
from pcgraph.features.nodes import NodeFeatures, node_features
from pcgraph.graph.adjacency import EdgeFeatures
from pcgraph.graph.contacts import angle_between
from pcgraph.pairs import distinct_pairs, nearest, not_among, pair_keys
from pcgraph.parallel import in_blocks, kernel
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.directions import plane_basis
from pcgraph.voxels.grid import VoxelGrid, at_ends, voxel_grid
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.visibility import depth_order_along
from pcgraph.voxels.warp import Warp

# Two parts of one smooth surface
_MAX_ANGLE = 0.2
"""Largest angle between the normals, radians, 0.98 as a cosine. Chosen, not varied."""
_MAX_OFFSET = 1.0
"""Largest distance of one from the plane of the other, voxel edges, because the grid tells no less."""
MAX_RESIDUAL = 0.5
"""Largest RMS distance of what is flat from its own plane, voxel edges: half an edge is what voxels make of a plane.
Measured: with 0.4 for gaps and 0.7 for pieces no score differs by 0.003."""

# Ways across a gap
_MIN_TRIANGULATED = 4
"""Fewest voxels on the borders of a group that are triangulated, because Qhull refuses fewer."""
_FACING = 2.0
"""Longest way that faces the other border, over the shortest of its pair, a ratio. Chosen by eye."""
_MIN_HIDDEN = 0.5
"""Least fraction of the ways that are hidden, for a pair to join: most of them."""
_MAX_GAP = 0.75
"""Widest gap over the width of the larger piece, a ratio: in a row of equal things, nothing else tells that they are
several, if something stands before each gap."""
_MIN_CROSSINGS = 2
"""Fewest ways between two supervoxels on one plane, a count. Measured: with one, ISPRS 31 loses 0.015 of ground."""
_NEAREST = 8
"""Supervoxels nearest to the middle of a way that are asked whether they hide it, a count. Chosen, not varied."""

# Pieces of one plane
_MIN_VOXELS = 40
"""Fewest voxels of a piece, some two supervoxels. Chosen, not varied."""
_MIN_NOISE = 0.05
"""Least noise of a supervoxel, voxel edges, because simulated planes have none."""
_ALONG_WAY = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Places along a way that are asked, each a fraction of its length, because any thin pole hides its middle."""
_MIN_DEPTH = 3.0
"""Depth by which what hides a way lies nearer, voxel edges. Measured: with one, tops of equal cartons in a row join in
one draw of four."""
_OFF_PLANE = 2.5
"""Distance from which on something lies behind or before a plane, or above the ground, voxel edges. Chosen by eye."""
_MAX_BEHIND = 0.005
"""Largest fraction of the voxels behind a plane that bounds the scene. Chosen by eye."""
_MIN_IN_FRONT = 0.2
"""Least fraction of the voxels in front of it. Chosen by eye: boards with little before them are several."""
_SAMPLED_SUPERVOXELS = 20_000
"""Supervoxels on which that is judged, a count, because each is compared with each plane."""
_MAX_HEIGHT = 2.0
"""Largest height of what hides a way straight before it, over the length of the way, a ratio, because a ceiling
hides no floor."""
_MIN_ALONG = 0.5
"""Least cosine between its normal and the plane's, because a partition, across the floor, parts it."""

# Ground from far above
_SAMPLED_VOXELS = 20_000
"""Voxels that are asked whether all was seen from far above, a count. Chosen for speed."""
_UPRIGHT = 0.5
"""Least cosine of an upright normal to the axis from which all was seen: within 60 degrees."""
_MIN_UPRIGHT = 0.93
"""Least fraction of the voxels with such normals. Measured: airborne clouds have 0.94 to 0.99, bins 0.78
to 0.91."""
_STEEP = 0.3
"""Largest cosine of what lies across the axis, as walls do, of a normal to it. Chosen by eye."""
_MAX_STEEP = 0.05
"""Largest fraction of the voxels across it. Measured: airborne clouds have 0.004 to 0.04."""
_MIN_GROUND_VOXELS = 20
"""Fewest voxels of a piece of the ground, some supervoxel. Chosen, not varied."""
_MIN_MEAN_COSINE = 0.7
"""Least mean cosine of its normals to the axis: level on average, within 45 degrees."""
_COLUMN = 1.5
"""Width of columns whose tops are compared with those beside them, voxel edges. Chosen by eye."""
_STEP = 2.0
"""Least height of a step between two tops, voxel edges. Chosen by eye."""
_MIN_STEPS_UP = 5
"""Fewest steps that lead up from a piece of the ground, a count. Chosen by eye."""
_MAX_STEPS_DOWN = 0.1
"""Largest fraction of the steps that lead down from it. Chosen by eye."""
_BORDER_CELL = 3.0
"""Edge of the cells of a border of which one voxel counts, voxel edges. Chosen for speed."""
_MIN_WIDTH = 6.0
"""Least width of what ground goes on under, voxel edges, because the rim of a crate is narrower. Measured: with 4.5 its
bottom is the table, though ISPRS 23 gains 0.02 of ground."""
_MAX_LEVELS = 0.25
"""Largest difference of height of two pieces, over that height, a ratio, because a terrace differs more."""


@dataclass(frozen=True, eq=False)
class Continuations(ShortRepr):
    """Pairs of supervoxels on one surface, of which something hides what lies between them.

    Attributes
    ----------
    pairs : (r, 2) int32
        Supervoxels i < j, rows in ascending order, once each.
    crossings : (r,) int64
        Ways across the gap from one to the other; of `occlusions` lines of the image along which one vanishes behind
        something and the other appears from behind it.
    width : (r,) float64, metres
        Mean distance across what hides the surface between.
    angle : (r,) float64, radians, 0..pi
        Angle between the supervoxels' normals.
    offset : (r,) float64, metres
        Mean distance of either's boundary from the other's plane, the larger of the two.
    color_contrast : (r,) float64, 0..sqrt(3)
        Distance of mean colours; 0 if the cloud has none.
    coplanar : (r,) bool
        Whether the two could be one flat surface: angle of at most 0.2 rad, and offset of at most a voxel edge or a
        tenth of the width; or they are on pieces of one plane. Those that are not are pieces of one terrain.
    """

    pairs: NDArray[np.int32]
    crossings: NDArray[np.int64]
    width: NDArray[np.float64]
    angle: NDArray[np.float64]
    offset: NDArray[np.float64]
    color_contrast: NDArray[np.float64]
    coplanar: NDArray[np.bool_]

    def chosen(self, some: NDArray[np.bool_]) -> Continuations:
        """Some of the rows."""
        return Continuations(*(getattr(self, name)[some] for name in self.__dataclass_fields__))

    def with_others(self, others: Continuations) -> Continuations:
        """The rows of both, of others without the pairs that are here."""
        columns = self.__dataclass_fields__
        others = others.without(self.pairs)
        both = Continuations(*(np.concatenate((getattr(self, name), getattr(others, name))) for name in columns))
        order = np.argsort(pair_keys(*both.pairs.T), kind="stable")
        return Continuations(*(getattr(both, name)[order] for name in columns))

    def without(self, pairs: NDArray[np.int32]) -> Continuations:
        """The rows that are not among these pairs, (m, 2) int32, the smaller first, in ascending order."""
        return self.chosen(not_among(self.pairs, pairs))

    def without_coplanar(self, pairs: NDArray[np.int32]) -> Continuations:
        """The same, but what is not coplanar stays: pieces of one terrain may touch."""
        return self.chosen(~self.coplanar | not_among(self.pairs, pairs))


def continuations(
    surface: Surface,
    nodes: NodeFeatures,
    faces: NDArray[np.int32],
    acquisition: Acquisition,
    places: NDArray[np.float64],
) -> Continuations:
    """Pairs of supervoxels between which one surface goes on, behind something that hides it.

    Parameters
    ----------
    surface : Surface of v voxels
    nodes : NodeFeatures of the k supervoxels
    faces : (k,) int32
        Face of each supervoxel (`faces_of`).
    acquisition : Acquisition
    places : (p, 3) float64, metres
        Places from which the cloud was seen. They count only if the acquisition knows a viewpoint.

    Notes
    -----
    Pieces that may be one lie on one plane, or are ground. Ways lead from the border of one to that of the other: edges
    of the Delaunay triangulation of both borders. The two pieces are one if at least half of the ways are hidden, and
    the gap is at most three quarters as wide as the larger piece. Its width is the root of its area, which grows as
    pieces join.

    Completion behind what hides a surface: Kellman and Shipley 1991.
    """
    places = places[:0] if acquisition.viewpoint is None else places
    of_planes = _of_planes(surface, nodes, faces, places)
    # The place of one scanner tells what it did not see, so that terrain is not looked for.
    return of_planes if acquisition.is_one_scan else _of_terrain(surface, nodes, faces).with_others(of_planes)


def faces_of(edges: NDArray[np.int32], features: EdgeFeatures, k: int) -> NDArray[np.int32]:
    """Face of each of k supervoxels, (k,) int32. Supervoxels that touch and go on smoothly lie on one face."""
    smooth = _on_one_surface(features.normal_angle, features.step, features.voxel_edge)
    return connected_components(edges[smooth], k)


def _on_one_surface(
    angle: NDArray[np.float64], offset: NDArray[np.float64], edge: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether pairs lie on one smooth surface, by the angle of their normals, radians, and their offset, metres."""
    return (angle <= _MAX_ANGLE) & (offset <= _MAX_OFFSET * edge)


def continuations_of(surface: Surface, nodes: NodeFeatures, spans: NDArray[np.integer]) -> Continuations:
    """Continuations by pair of supervoxels, given the voxels at both ends of what is hidden, (c, 2)."""
    owners = surface.supervoxels[spans]
    swap = owners[:, 0] > owners[:, 1]
    spans, owners = (np.where(swap[:, None], both[:, ::-1], both) for both in (spans, owners))
    pairs, pair = distinct_pairs(owners[:, 0], owners[:, 1])
    r, (i, j) = len(pairs), pairs.T
    crossings = np.bincount(pair, minlength=r)
    ends = surface.grid.centroids[spans]
    width = np.bincount(pair, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), r) / crossings
    heights = [
        np.bincount(pair, np.abs(_heights(ends[:, 1 - side], owners[:, side], nodes)), r) / crossings for side in (0, 1)
    ]
    edge = np.bincount(pair, surface.grid.edge_lengths[spans].mean(axis=1), r) / crossings
    angle, offset = angle_between(nodes.normal[i], nodes.normal[j]), np.maximum(*heights)
    contrast = np.nan_to_num(np.linalg.norm(nodes.color[j] - nodes.color[i], axis=1))
    coplanar = _on_one_surface(angle, offset, np.maximum(edge, 0.1 * width))
    return Continuations(pairs, crossings, width, angle, offset, contrast, coplanar)


def _heights(points: NDArray[np.float64], owners: NDArray[np.int32], nodes: NodeFeatures) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", points - nodes.centroid[owners], nodes.normal[owners])


# --- ways across gaps -------------------------------------------------------------------------------------------------


class _Plane(NamedTuple):
    """A plane: a place on it, its unit normal, and two directions along it, (2, 3)."""

    origin: NDArray[np.float64]
    normal: NDArray[np.float64]
    axes: NDArray[np.float64]

    @classmethod
    def through(cls, origin: NDArray[np.float64], normal: NDArray[np.float64]) -> _Plane:
        return cls(origin, normal, plane_basis(normal))

    def heights(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distances of places, (n, 3), to the plane, (n,)."""
        return np.einsum("ij,j->i", places - self.origin, self.normal)

    def project(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Coordinates of places, (n, 3), on the plane, (n, 2)."""
        return np.einsum("ij,kj->ik", places - self.origin, self.axes)


class _Ways(NamedTuple):
    """Ways between borders of pieces that face each other.

    Attributes
    ----------
    ends : (c, 2) int64
        Voxels on two borders.
    pieces : (c, 2) int64
        Pieces at the ends.
    pair : (c,) int64
        The pair of pieces of each.
    pairs : (q, 2) int32
        Pieces, the smaller number first.
    lengths : (c,) float64, metres
    widths : (q,) float64, metres
        Least length of their ways.
    """

    ends: NDArray[np.int64]
    pieces: NDArray[np.int64]
    pair: NDArray[np.int64]
    pairs: NDArray[np.int32]
    lengths: NDArray[np.float64]
    widths: NDArray[np.float64]

    def means(self, values: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Means over the ways of each pair, (q,), of values of the ways, (c,)."""
        n_pairs = len(self.pairs)
        return np.bincount(self.pair, values, n_pairs) / np.bincount(self.pair, minlength=n_pairs)

    def joined(self, may_join: NDArray[np.bool_], areas: NDArray[np.float64]) -> NDArray[np.int64]:
        """Voxels at the ends of the ways, (j, 2), between pieces that become one.

        Pairs that may join, (q,), join in the order of their widths. `areas` are those of the pieces, square metres: as
        joined pieces grow, wider gaps are bridged. In the end all pairs count that may join and whose pieces are one.
        """
        pairs, widths = self.pairs, self.widths
        whole, areas = np.arange(len(areas)), areas.copy()
        order, grows = np.argsort(widths, kind="stable"), True
        order = order[may_join[order]]
        while grows:
            grows, order = False, order[whole[pairs[order, 0]] != whole[pairs[order, 1]]]
            for pair in order.tolist():
                a, b = whole[pairs[pair]]
                if a != b and widths[pair] <= _MAX_GAP * np.sqrt(max(areas[a], areas[b])):
                    grows = True
                    areas[a] += areas[b]
                    whole[whole == b] = a
        joins = may_join & (whole[pairs[:, 0]] == whole[pairs[:, 1]])
        return self.ends[joins[self.pair]]


def _borders(
    surface: Surface, of_supervoxel: NDArray[np.int64], groups: list[NDArray[np.int64]]
) -> list[NDArray[np.int64]]:
    """Voxels at the ends of the pieces of each group.

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
    voxels = voxels[at_ends(grid, voxels, piece)]
    order = np.argsort(on[piece[voxels]], kind="stable")
    counts = np.bincount(on[piece[voxels]], minlength=len(groups))
    return np.split(voxels[order], np.cumsum(counts)[:-1])


def _facing_ways(grid: VoxelGrid, plane: _Plane, border: NDArray[np.int64], piece: NDArray[np.int64]) -> _Ways:
    """Ways between voxels on borders, (b,), which are on a piece each, (b,).

    They are edges of the Delaunay triangulation on the plane. Places are joggled, so that some on a lattice or a line
    are no error.
    """
    triangles, places = np.empty((0, 3), np.int32), grid.centroids[border]
    if len(places) >= _MIN_TRIANGULATED:  # in voxel edges: no unit is too small
        from scipy.spatial import Delaunay

        triangles = Delaunay(plane.project(places) / grid.size, qhull_options="QJ").simplices
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    ends, _ = distinct_pairs(*np.sort(sides[piece[sides[:, 0]] != piece[sides[:, 1]]], axis=1).T)
    lengths = np.linalg.norm(places[ends[:, 1]] - places[ends[:, 0]], axis=1)
    pairs, pair = distinct_pairs(*np.sort(piece[ends], axis=1).T)
    widths = np.full(len(pairs), np.inf)
    np.minimum.at(widths, pair, lengths)
    facing = lengths <= _FACING * widths[pair]
    ends, pair = ends[facing], pair[facing]
    return _Ways(border[ends], piece[ends], pair, pairs, lengths[facing], widths)


# --- pieces of one plane ----------------------------------------------------------------------------------------------


class _Scene(NamedTuple):
    """The k supervoxels: places, outer normals, number of voxels, their mean edge length, and areas."""

    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    voxels: NDArray[np.int64]
    edges: NDArray[np.float64]
    areas: NDArray[np.float64]


class _Pieces(NamedTuple):
    """Flat faces.

    Attributes
    ----------
    planes : NodeFeatures of p pieces
        All voxels count the same.
    edges : (p,) float64, metres
        Mean edge length of their voxels.
    areas : (p,) float64, square metres
    noise : (p,) float64, metres
        RMS distance of points from the planes of their supervoxels.
    of_supervoxel : (k,) int64
        Piece of each supervoxel, -1 of those on none.
    """

    planes: NodeFeatures
    edges: NDArray[np.float64]
    areas: NDArray[np.float64]
    noise: NDArray[np.float64]
    of_supervoxel: NDArray[np.int64]


def _of_planes(
    surface: Surface, nodes: NodeFeatures, faces: NDArray[np.int32], places: NDArray[np.float64]
) -> Continuations:
    """Continuations between pieces of one plane: flat faces, half of whose ways, at least, are hidden and level.

    A way is hidden from where the cloud was seen. Where nobody knows, planes tell that bound the scene: nothing lies
    behind a floor, a ceiling, an outer wall or a street, and much before it.
    """
    grid, scene = surface.grid, _scene(surface, nodes)
    pieces = _flat_pieces(scene, nodes, faces)
    of_voxel, groups = pieces.of_supervoxel[surface.supervoxels], list(_on_one_plane(pieces))
    if not len(places):
        groups = _bounding(scene, pieces, groups)
    planes = [_Plane.through(pieces.planes.centroid[group[0]], pieces.planes.normal[group[0]]) for group in groups]
    borders = _borders(surface, pieces.of_supervoxel, groups)
    ways = [_facing_ways(grid, *one, of_voxel[one[1]]) for one in zip(planes, borders, strict=True)]
    if len(places):
        hidden = _unseen(surface, places, ways)
    else:
        hidden = [_behind_something(surface, scene, *one, pieces.areas) for one in zip(planes, ways, strict=True)]
    spans = [np.empty((0, 2), np.int64)]
    for some, some_hidden in zip(ways, hidden, strict=True):
        may_join = some.means(some_hidden & _are_level(grid, pieces, some)) >= _MIN_HIDDEN
        spans.append(some.joined(may_join, pieces.areas))
    spans_of_all = np.concatenate(spans)
    ends, edges = grid.warped[spans_of_all], grid.warped_edges[spans_of_all].max(axis=1)
    far = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > grid.warp.max_gap * edges  # else gaps join them
    found = continuations_of(surface, nodes, spans_of_all[far])
    found = found.chosen(found.crossings >= _MIN_CROSSINGS)
    return replace(found, coplanar=np.ones(len(found.pairs), np.bool_))


def _scene(surface: Surface, nodes: NodeFeatures) -> _Scene:
    k = len(nodes.size)
    voxels = np.bincount(surface.supervoxels, minlength=k)
    edges = surface.mean_edge_lengths(k)
    return _Scene(nodes.centroid, nodes.normal, voxels, edges, voxels * edges * edges)


def _flat_pieces(scene: _Scene, nodes: NodeFeatures, faces: NDArray[np.int32]) -> _Pieces:
    """Faces that are large and flat."""
    large = np.bincount(faces, scene.voxels) >= _MIN_VOXELS
    on, n = np.flatnonzero(large[faces]), int(large.sum())
    face = (np.cumsum(large) - 1)[faces[on]]
    voxels = scene.voxels[on]
    parts = Moments(voxels, nodes.centroid[on], voxels[:, None, None] * nodes.covariance[on], None)
    planes = node_features(grouped_moments(replace(parts, normals=nodes.normal[on]), face, n))
    edges = np.bincount(face, voxels * scene.edges[on], n) / planes.size
    variances = np.square(nodes.residual[on]) + np.square(_MIN_NOISE * scene.edges[on])
    noise = np.sqrt(np.bincount(face, voxels * variances, n) / planes.size)
    areas = np.bincount(face, scene.areas[on], n).astype(np.float64)
    of_supervoxel = np.full(len(faces), -1)
    of_supervoxel[on] = np.where(planes.residual <= MAX_RESIDUAL * edges, np.arange(n), -1)[face]
    return _Pieces(planes, edges, areas, noise, of_supervoxel)


def _bounding(scene: _Scene, pieces: _Pieces, groups: list[NDArray[np.int64]]) -> list[NDArray[np.int64]]:
    """The groups of pieces whose planes bound the scene."""
    first, bounding = np.array([group[0] for group in groups], np.int64), np.empty(len(groups), np.bool_)
    some = np.random.default_rng(0).permutation(len(scene.places))[:_SAMPLED_SUPERVOXELS]
    voxels = scene.voxels[some]
    others = scene.places[some], _OFF_PLANE * scene.edges[some], voxels, int(voxels.sum())
    in_blocks(_bound, len(groups), pieces.planes.centroid[first], pieces.planes.normal[first], *others, bounding)
    return [group for group, bounds in zip(groups, bounding.tolist(), strict=True) if bounds]


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
    """Pieces, two or more, on one plane with the largest of them, which comes first.

    One of two lies near the plane of the other. The other need not lie near its plane: far from a small piece, that is
    off by much for a little tilt, as of a bent table.
    """
    planes = pieces.planes
    left = np.unique(pieces.of_supervoxel[pieces.of_supervoxel >= 0])
    left = left[np.argsort(-pieces.areas[left], kind="stable")]
    while len(left) > 1:
        first = left[:1]
        angle = angle_between(planes.normal[left], np.repeat(planes.normal[first], len(left), axis=0))
        off = np.minimum(_offset(planes, left, first), _offset(planes, first, left))
        on_it = _on_one_surface(angle, off, np.maximum(pieces.edges[left], pieces.edges[first]))
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


def _are_level(grid: VoxelGrid, pieces: _Pieces, ways: _Ways) -> NDArray[np.bool_]:
    """Whether both ends of each way lie as near to the plane of the piece at the other as that can tell, (c,) bool.

    What noise leaves open grows with the way from the middle of a piece, what curvature does with the square of it.
    Measured: with three times as much, a table (mOSD) takes in the bottom of what stands on it.
    """
    planes, level = pieces.planes, np.ones(len(ways.ends), np.bool_)
    for side in (0, 1):
        own, other = ways.pieces[:, side], ways.pieces[:, 1 - side]
        spreads, across = np.linalg.eigh(planes.covariance[own])
        off = np.einsum("ij,ijk->ik", grid.centroids[ways.ends[:, 1 - side]] - planes.centroid[own], across)
        variances = np.square(pieces.noise[own])
        reach = (np.square(off) / np.maximum(spreads, variances[:, None]))[:, 1:].sum(axis=1)
        curvature = np.sqrt(np.maximum(spreads[:, 0] - variances, 0.0))
        uneven = pieces.noise[own] * (1.0 + np.sqrt(reach)) + curvature * (1.0 + reach) + pieces.noise[other]
        level &= np.abs(off[:, 0]) <= uneven
    return level


def _unseen(surface: Surface, places: NDArray[np.float64], ways: list[_Ways]) -> list[NDArray[np.bool_]]:
    """Whether the cloud hides each way from all places before it, (c,) for each of the groups of ways."""
    grid, ends = surface.grid, np.concatenate([np.empty((0, 2), np.int64), *(some.ends for some in ways)])
    if not len(ends):
        return [np.empty(0, np.bool_) for _ in ways]
    seen = depth_order_along(grid, surface.normals, places, ends, _ALONG_WAY, _MIN_DEPTH) >= 0
    ways_to = places[:, None] - grid.centroids[ends[:, 0]]
    before = np.einsum("kcj,cj->kc", ways_to, surface.normals[ends[:, 0]]) > 0.0
    hidden = ~(seen & before[:, None]).any(axis=(0, 1)) & before.any(axis=0)
    return np.split(hidden, np.cumsum([len(some.ends) for some in ways])[:-1])


def _beside_middles(
    scene: _Scene,
    some: NDArray[np.int64],
    plane: _Plane,
    middles: NDArray[np.float64],
    lengths: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Supervoxels near the middle of each way, as projected on a plane: the nearest of some, (c, q) rows of `some`, and
    whether each is within half the length of the way."""
    distance, found = nearest(plane.project(scene.places[some]), middles, min(_NEAREST, len(some)))
    return found, distance <= np.maximum(0.5 * lengths[:, None], _OFF_PLANE * scene.edges[some[found]])


def _behind_something(
    surface: Surface, scene: _Scene, plane: _Plane, ways: _Ways, areas: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether something lies before the middle of each way, (c,), and nothing shows behind the plane in the gap.

    A surface that is parallel to the pieces, and larger than both, is the wall in which they are set, as doors are. It
    hides nothing between them.
    """
    heights, middles = plane.heights(scene.places), plane.project(surface.grid.centroids[ways.ends].mean(axis=1))
    cosines, lengths = np.einsum("ij,j->i", scene.normals, plane.normal), ways.lengths[:, None]
    before = np.flatnonzero((heights > scene.edges) & (np.abs(cosines) >= _MIN_ALONG))
    if not len(before) or not len(middles):
        return np.zeros(len(middles), np.bool_)
    parallel = np.flatnonzero(cosines >= np.cos(_MAX_ANGLE))
    parallel = parallel[np.argsort(heights[parallel], kind="stable")]
    sums = np.concatenate((np.zeros(1), np.cumsum(scene.areas[parallel])))
    bands = heights[before] + np.array([[-1.0], [1.0]]) * scene.edges[before]
    low, high = sums[np.searchsorted(heights[parallel], bands)]
    sets_in = np.where(cosines[before] >= np.cos(_MAX_ANGLE), high - low, 0.0)
    number, over = _beside_middles(scene, before, plane, middles, ways.lengths)
    above, larger = before[number], areas[ways.pieces].max(axis=1)[:, None]
    hides = over & (heights[above] > _OFF_PLANE * scene.edges[above]) & (heights[above] <= _MAX_HEIGHT * lengths)
    hidden = hides.any(axis=1) & ~(over & (sets_in[number] > larger)).any(axis=1)
    behind = scene.places[heights < -_OFF_PLANE * scene.edges]
    if len(behind):
        shows = nearest(plane.project(behind), middles, 1)[0][:, 0] <= 0.5 * ways.lengths
        hidden &= (ways.means(shows) == 0.0)[ways.pair]
    return hidden


# --- pieces of the ground ---------------------------------------------------------------------------------------------


def _of_terrain(surface: Surface, nodes: NodeFeatures, faces: NDArray[np.int32]) -> Continuations:
    """Continuations between pieces of the ground, none coplanar, which may touch.

    From far above, as from an aircraft, roofs and streets are seen, but no walls. So the ground of a courtyard touches
    nothing, and it may lie lower than the street. A face is ground if it is about level, and if steps at its border
    lead up and hardly ever down. The largest face of all must be ground, too; else the cloud stands on its head, or is
    a plateau. Two pieces are one if they touch, as at a bank. They are also one if something stands on at least half of
    the ways between their borders, and rises above the higher piece by four times the difference of their heights.

    A low roof within higher walls, as in a court, looks like the ground there, and is taken for it. There are no
    continuations unless nearly all normals lie along one axis.
    """
    spans, found = np.empty((0, 2), np.int64), _ground_from_far_above(surface, faces)
    if found is not None:
        upwards, ground = found
        of_supervoxel = np.where(ground, np.cumsum(ground) - 1, -1)[faces]
        border = _borders(surface, of_supervoxel, [np.arange(np.count_nonzero(ground))])[0]
        touching = _touching(surface, of_supervoxel, border)
        spans = np.concatenate((touching, _under(surface, nodes, of_supervoxel, border, upwards)))
    terrain = continuations_of(surface, nodes, spans)
    return replace(terrain, coplanar=np.zeros(len(terrain.pairs), np.bool_))


def _ground_from_far_above(
    surface: Surface, faces: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]] | None:
    """Direction from which all was seen, (3,) of length 1, and whether each face is ground, (f,).

    None if the cloud was not seen from far off on one side, or has less than two pieces of ground. Normals may point
    either way, because pieces that touch nothing do not tell each other's sides.
    """
    some = surface.normals[:: max(1, surface.grid.n_voxels // _SAMPLED_VOXELS)]
    axis = np.linalg.eigh(np.einsum("ij,ik->jk", some, some))[1][:, 2]
    cosines = np.einsum("ij,j->i", some, axis)
    if np.mean(np.abs(cosines) > _UPRIGHT) < _MIN_UPRIGHT or np.mean(np.abs(cosines) < _STEEP) > _MAX_STEEP:
        return None
    cosines = np.einsum("ij,j->i", surface.normals, axis)
    axis = axis * (1.0 if cosines.sum() >= 0.0 else -1.0)
    face, n_faces = faces[surface.supervoxels], int(faces.max()) + 1
    voxels = np.bincount(face, minlength=n_faces)
    level = np.bincount(face, np.abs(cosines), n_faces) >= _MIN_MEAN_COSINE * voxels
    down, up = _steps(surface, face, axis)  # the other way along it but for columns of several layers
    for upwards, to_lower, to_higher in ((axis, down, up), (-axis, up, down)):
        ground = level & (to_higher >= _MIN_STEPS_UP) & (to_lower <= _MAX_STEPS_DOWN * (to_lower + to_higher))
        if ground[np.argmax(voxels)]:
            ground &= voxels >= _MIN_GROUND_VOXELS
            return (upwards, ground) if np.count_nonzero(ground) > 1 else None
    return None


def _steps(
    surface: Surface, face: NDArray[np.int32], axis: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of steps at the border of each face, between tops of columns beside each other, that lead down and up
    along an axis, (f,) each."""
    plane, edge = _Plane.through(surface.grid.centroids[0], axis), surface.grid.size
    heights, flat = plane.heights(surface.grid.centroids), np.zeros((surface.grid.n_voxels, 3))
    flat[:, :2] = plane.project(surface.grid.centroids)
    columns = voxel_grid(flat, _COLUMN * edge, Warp())
    order = np.lexsort((heights, columns.voxel_of_point))
    tops = order[np.cumsum(np.bincount(columns.voxel_of_point)) - 1]
    above, below = tops[columns.touching_pairs()].T
    steps = (heights[above] - heights[below] > _STEP * edge) & (face[above] != face[below])
    down, up = (np.bincount(face[ends[steps]], minlength=int(face.max()) + 1) for ends in (above, below))
    return down, up


def _touching(surface: Surface, of_supervoxel: NDArray[np.int64], border: NDArray[np.int64]) -> NDArray[np.int64]:
    """Voxels of two pieces that touch, (t, 2)."""
    piece = of_supervoxel[surface.supervoxels]
    row, neighbours = surface.grid.around(border)
    others = np.flatnonzero(piece[neighbours] > piece[border][row])
    return np.stack((border[row[others]], neighbours[others]), axis=1)


def _under(
    surface: Surface,
    nodes: NodeFeatures,
    of_supervoxel: NDArray[np.int64],
    border: NDArray[np.int64],
    upwards: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Voxels at both ends of the ways, (c, 2), under what stands between pieces that are one."""
    grid, of_voxel = surface.grid, of_supervoxel[surface.supervoxels]
    edge, plane = grid.size, _Plane.through(grid.centroids[0], upwards)
    projected = plane.project(grid.centroids[border]) / (_BORDER_CELL * edge)
    cells = voxel_grid(np.column_stack((projected, of_voxel[border].astype(np.float64))), 1.0, Warp())
    border = border[np.sort(cells.order[cells.starts[:-1]])]
    ways = _facing_ways(grid, plane, border, of_voxel[border])
    ends, others, scene = grid.centroids[ways.ends], np.flatnonzero(of_supervoxel < 0), _scene(surface, nodes)
    hidden = np.zeros(len(ends), np.bool_)
    if len(others) and len(ends):
        heights = plane.heights(ends.reshape(-1, 3)).reshape(-1, 2)
        number, over = _beside_middles(scene, others, plane, plane.project(ends.mean(axis=1)), ways.lengths)
        rise = plane.heights(scene.places)[others[number]] - heights.max(axis=1)[:, None]
        over &= (rise > _OFF_PLANE * edge) & (np.ptp(heights, axis=1)[:, None] < _MAX_LEVELS * rise)
        hidden[:] = over.any(axis=1)
    areas = np.bincount(of_voxel + 1, np.square(grid.edge_lengths))[1:].astype(np.float64)
    return ways.joined((ways.means(hidden) >= _MIN_HIDDEN) & (ways.widths >= _MIN_WIDTH * edge), areas)
