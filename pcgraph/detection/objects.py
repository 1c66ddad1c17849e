# SPDX-License-Identifier: Apache-2.0
"""Objects on a support: what stands on a table, a floor or a shelf.

`objects_on` is the whole search. Supervoxels above the support fall into pieces, connected parts of one segment each;
pieces that are parts of one object although nothing seen connects them are linked; objects are described last.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from pcgraph.detection.boxes import OrientedBox, inside_outline, outline, standing_box, tight_box
from pcgraph.detection.plane_detection import Planes, find_planes, members
from pcgraph.detection.revolution import revolution_axis
from pcgraph.detection.shapes import Shape, fit_shape
from pcgraph.disjoint_sets import connected_components
from pcgraph.inputs import non_negative
from pcgraph.plumbing.plain_dict import PlainDict
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.segmentation import Segmentation, check_segmentation
from pcgraph.voxels.directions import plane_basis

MIN_HEIGHT = 3.0
"""Least height of an object in voxel edges, unless given, because what is lower is mostly the support's noise and
sag."""
MIN_SUPERVOXELS = 0.5
"""Least number of points of an object in those of the median supervoxel, unless given, so that one supervoxel is
enough."""
MIN_CLEARANCE = 0.5
"""Least height in voxel edges of a supervoxel's centroid above the support, because rounding to voxels may lift the
support's own by half of one."""


@dataclass(frozen=True, eq=False)
class DetectedObject(ShortRepr, PlainDict):
    """One thing on a support.

    Attributes
    ----------
    supervoxels : (s,) int32
        Ascending.
    count : int
        Number of points.
    box : OrientedBox
        Standing on the support: smallest rectangle around the footprint (its longer side first) times the
        height (third axis, away from the support).
    free_box : OrientedBox
        Small box in any pose, longest axis first.
    shape : Shape
        Which of plane, box, sphere and cylinder fits its voxels.
    """

    supervoxels: NDArray[np.int32]
    count: int
    box: OrientedBox
    free_box: OrientedBox
    shape: Shape

    @property
    def height(self) -> float:
        """Height of its highest point above the support, metres."""
        return float(self.box.size[2])

    def to_dict(self) -> dict[str, Any]:
        """The attributes, and ``height``, by name as `OrientedBox.to_dict` gives them: metres, None if not finite."""
        return {**super().to_dict(), "height": self.height}


def objects_on(
    segmentation: Segmentation,
    planes: Planes | None = None,
    support: int | None = None,
    *,
    points: ArrayLike | None = None,
    margin: float | None = None,
    min_height: float | None = None,
    min_points: int | None = None,
) -> list[DetectedObject]:
    """Objects on a plane, the one with most points first.

    Parameters
    ----------
    segmentation : Segmentation
    planes : Planes, optional
        Default: `find_planes(segmentation)`.
    support : int, optional
        Index of the plane they stand on. Default: the largest horizontal one.
    points : (n, 3) or (h, w, 3) float, metres, the array given to `pcgraph.segment`, optional
        Boxes are drawn around these; without them around the centroids of voxels, so up to half a voxel per side
        too small.
    margin : float, metres, optional
        How far beyond the convex outline of the plane a supervoxel's centroid may lie. Default: 1 voxel.
    min_height : float, metres, optional
        Least height of an object above the plane. Default: 3 voxels.
    min_points : int, optional
        Least number of points. Default: half that of the median supervoxel.

    Returns
    -------
    list of DetectedObject
        Empty if there is no horizontal plane, or nothing on it. A box covers what was seen: hidden sides are not
        guessed, except that it reaches down to the support.

    Raises
    ------
    ValueError
        An argument is not as above, the planes are another segmentation's, or there is none of that index.

    Notes
    -----
    An object is a connected part of one segment (`Segmentation.objects`) that does not belong to the support and
    lies above it. A piece that lies mostly within the box of a larger one goes to it, and so does one that hangs
    beside another without reaching the support, such as the inside of a cup (`linked_pieces`). Pieces that touch and
    together are a surface of revolution are one object, such as the parts of a bottle (`is_turned_body`).
    """
    check_segmentation(segmentation)
    planes = find_planes(segmentation) if planes is None else planes
    if not isinstance(planes, Planes):
        raise ValueError(f"expected planes as find_planes returns them, got {type(planes).__name__}")
    if len(planes.plane_of_supervoxel) != segmentation.tree.n_leaves:
        raise ValueError(
            f"expected planes of this segmentation, of {segmentation.tree.n_leaves} supervoxels, got planes of "
            f"{len(planes.plane_of_supervoxel)}; call find_planes again"
        )
    index = _support_index(planes, support)
    if index is None:
        return []
    sizes = segmentation.graph.node_features.size
    ground = _support(segmentation, planes, index)
    beyond = ground.edge if margin is None else non_negative("margin", margin)
    lowest = MIN_HEIGHT * ground.edge if min_height is None else non_negative("min_height", min_height)
    fewest = MIN_SUPERVOXELS * float(np.median(sizes)) if min_points is None else non_negative("min_points", min_points)
    places, leaf_of_place = _places(segmentation, points)
    pieces = connected_pieces(segmentation, ground, supervoxels_above(segmentation, ground, beyond))
    touching = touching_pieces(segmentation, pieces)
    object_of_piece = linked_pieces(pieces, ground.edge, touching)
    n_objects = int(object_of_piece.max(initial=-1)) + 1
    object_of_leaf = np.full(segmentation.tree.n_leaves, -1, np.int32)
    for piece, number in zip(pieces, object_of_piece, strict=True):
        object_of_leaf[piece.supervoxels] = number
    own_places = members(object_of_leaf[leaf_of_place], n_objects)
    own_voxels = members(object_of_leaf[segmentation.surface.supervoxels], n_objects)
    found = []
    for number, leaves in enumerate(members(object_of_leaf, n_objects)):
        here, count = places[own_places[number]], int(sizes[leaves].sum())
        if count < fewest or max(float((here @ ground.up).max()), ground.level) - ground.level < lowest:
            continue
        box, voxels = standing_box(here, ground.up, ground.level), own_voxels[number]
        shape = fit_shape(segmentation.surface.grid.centroids[voxels], segmentation.surface.normals[voxels], ground.up)
        found.append(DetectedObject(leaves.astype(np.int32), count, box, tight_box(here), shape))
    return sorted(found, key=lambda thing: (-thing.count, int(thing.supervoxels[0])))


def object_labels(segmentation: Segmentation, objects: list[DetectedObject]) -> NDArray[np.int32]:
    """Index of each point's object in the points' shape, int32; -1 where it belongs to none."""
    check_segmentation(segmentation)
    of_leaf = np.full(segmentation.tree.n_leaves, -1, np.int32)
    for i, thing in enumerate(objects):
        of_leaf[thing.supervoxels] = i
    return segmentation.on_points(of_leaf)


def _support_index(planes: Planes, support: int | None) -> int | None:
    if support is not None:
        if not isinstance(support, int | np.integer) or not 0 <= support < len(planes):
            raise ValueError(f"expected support as one of the {len(planes)} planes, a whole number, got {support!r}")
        return int(support)
    level = np.flatnonzero(planes.roles == "horizontal")
    return int(level[0]) if len(level) else None


def _places(segmentation: Segmentation, points: ArrayLike | None) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Points, or centroids of voxels, (q, 3), with their supervoxels."""
    if points is None:
        return segmentation.surface.grid.centroids, segmentation.surface.supervoxels
    array = np.asarray(points)
    if array.shape != (*segmentation.supervoxels.shape, 3):
        raise ValueError(f"expected points of shape {(*segmentation.supervoxels.shape, 3)}, got {array.shape}")
    finite = segmentation.supervoxels >= 0
    return array[finite].astype(np.float64), segmentation.supervoxels[finite]


# -------------------------------------------------------------------------------------------------- above the support


@dataclass(frozen=True, eq=False)
class _Support:
    """The plane on which objects stand.

    Attributes
    ----------
    member : (n_leaves,) bool
        Its supervoxels.
    outline : (h, 3) float64, metres
        Convex outline.
    up : (3,) float64
        Unit normal, on the side of the planes' `up`.
    level : float, metres
        Its position along `up`.
    edge : float, metres
        Median edge of the voxels.
    """

    member: NDArray[np.bool_]
    outline: NDArray[np.float64]
    up: NDArray[np.float64]
    level: float
    edge: float


def _support(segmentation: Segmentation, planes: Planes, index: int) -> _Support:
    up = planes.normals[index] * (-1.0 if planes.normals[index] @ planes.up < -0.5 else 1.0)
    edge = float(np.median(segmentation.surface.grid.edge_lengths))
    level = float(up @ planes.centroids[index])
    return _Support(planes.plane_of_supervoxel == index, planes.outlines[index], up, level, edge)


def supervoxels_above(segmentation: Segmentation, support: _Support, margin: float) -> NDArray[np.bool_]:
    """Whether each supervoxel lies above the support within its outline, and a margin in metres, but not in it."""
    basis = plane_basis(support.up)
    centroids = segmentation.graph.node_features.centroid
    inside = inside_outline(centroids @ basis.T, outline(support.outline @ basis.T), margin)
    edges = segmentation.surface.mean_edge_lengths(segmentation.tree.n_leaves)
    clear = centroids @ support.up - support.level > MIN_CLEARANCE * edges
    return inside & clear & ~support.member


@dataclass(frozen=True, eq=False)
class Piece:
    """Connected part of one segment above a support.

    Attributes
    ----------
    supervoxels : (s,) int32
        Ascending.
    places, normals : (n, 3) float64
        Centroids, metres, and unit normals of its voxels.
    floating : bool
        Whether it nowhere touches the support.
    up, level
        Of the support.
    """

    supervoxels: NDArray[np.int32]
    places: NDArray[np.float64]
    normals: NDArray[np.float64]
    floating: bool
    up: NDArray[np.float64]
    level: float

    @cached_property
    def box(self) -> OrientedBox:
        """Standing on the support."""
        return standing_box(self.places, self.up, self.level)

    @cached_property
    def neighbours(self) -> cKDTree:
        """Index of its places."""
        return cKDTree(self.places)

    @cached_property
    def convexity(self) -> float:
        """Spread of the normals with their places over the root mean square radius, -1..1.

        About 0.5 to 1 for what is seen of a sphere or a box, 0 for a plane, negative where hollow.
        """
        local = self.places - self.places.mean(axis=0)
        radius = float(np.sqrt((local**2).sum(axis=1).mean()))
        return float((local * self.normals).sum(axis=1).mean()) / radius if radius > 0.0 else 0.0


def connected_pieces(segmentation: Segmentation, support: _Support, above: NDArray[np.bool_]) -> list[Piece]:
    """Connected parts of segments among the chosen supervoxels, (n_leaves,) bool, most points first."""
    n, segment, surface = segmentation.tree.n_leaves, segmentation.objects, segmentation.surface
    i, j = segmentation.graph.edges.T
    kept = above[i] & above[j] & (segment[i] == segment[j])
    part = connected_components(segmentation.graph.edges[kept], n)
    chosen, part_of_leaf = np.flatnonzero(above), np.full(n, -1, np.int32)
    numbers, part_of_leaf[chosen] = np.unique(part[chosen], return_inverse=True)
    touches = np.zeros(n, bool)
    touches[i[support.member[j]]] = touches[j[support.member[i]]] = True
    leaves, voxels = members(part_of_leaf, len(numbers)), members(part_of_leaf[surface.supervoxels], len(numbers))
    sizes = np.bincount(part_of_leaf[chosen], segmentation.graph.node_features.size[chosen], len(numbers))
    return [
        Piece(
            leaves[p].astype(np.int32),
            surface.grid.centroids[voxels[p]],
            surface.normals[voxels[p]],
            not touches[leaves[p]].any(),
            support.up,
            support.level,
        )
        for p in sorted(range(len(numbers)), key=lambda p: (-sizes[p], leaves[p][0]))
    ]


# ------------------------------------------------------------------------------------------------ parts of one object

MIN_INSIDE = 0.5
"""Least fraction of a piece within the box of a larger one for it to belong to that, because the box holds most of
it."""


@dataclass(frozen=True)
class CupLimits:
    """Conditions on which the inside of a cup, which a depth edge separates from its outside, joins it."""

    max_gap: float = 8.0
    """Voxel edges between the two: what the wall and a depth edge take. On mOSD from 8 to 32 nothing changes; at 4
    three cups of 32 objects fall apart."""
    max_gap_fraction: float = 0.5
    """Lengths of the larger one's footprint between the two, for things of few voxels: an opening reaches to half the
    cup at most. On mOSD from 0.25 to 2 nothing changes; at 0.125 cups fall apart."""
    max_top_difference: float = 2.0
    """Voxel edges by which their tops may differ: a voxel of each. On mOSD from 1 to 4 nothing changes."""
    min_convexity: float = 0.05
    """Convexity below which a piece is hollow or flat: between the 0 of a plane, with what noise does to it, and the
    0.5 of a sphere. On mOSD from -0.1 to 0.2 nothing changes."""


CUP = CupLimits()


@dataclass(frozen=True)
class TurnedBodyLimits:
    """Conditions on which two pieces are parts of one surface of revolution."""

    max_miss: float = 0.35
    """Distance from the axis by which half of the normals of each part may miss it, as a fraction of the root mean
    square distance of that part's places from it. Those of a hexagon, as the head of a bolt, miss it by 0.27, those of
    a square by 0.43 (closed forms)."""
    min_around: float = 0.25
    """Least fraction of a piece whose normals point away from the axis, because tops of boxes, which have no such axis,
    are parallel planes and fit any axis across them. Not varied."""
    max_cosine: float = 0.5
    """Cosine between axis and normal up to which a normal points away from the axis: 60 degrees. Not varied."""


TURNED_BODY = TurnedBodyLimits()


def touching_pieces(segmentation: Segmentation, pieces: list[Piece]) -> NDArray[np.int64]:
    """Pairs of pieces, (m, 2) int64, that touch, or nearly touch, by the edges of the graph."""
    of_leaf = np.full(segmentation.tree.n_leaves, -1, np.int64)
    for number, piece in enumerate(pieces):
        of_leaf[piece.supervoxels] = number
    pairs = np.sort(of_leaf[segmentation.graph.joined], axis=1)
    return np.unique(pairs[(pairs[:, 0] >= 0) & (pairs[:, 0] != pairs[:, 1])], axis=0)


def is_turned_body(first: Piece, second: Piece) -> bool:
    """Whether two pieces together are one surface of revolution, as the parts of a bottle, a lamp or a bolt are."""
    places, normals = (np.concatenate((getattr(first, n), getattr(second, n))) for n in ("places", "normals"))
    axis = revolution_axis(places, normals)
    off = np.linalg.norm(np.cross(places - axis.origin, axis.direction), axis=1)
    is_around = np.abs(normals @ axis.direction) < TURNED_BODY.max_cosine
    for part in np.split(np.arange(len(places)), [len(first.places)]):
        around = part[is_around[part]]
        if len(around) < TURNED_BODY.min_around * len(part):
            return False
        if np.median(axis.misses[around]) > TURNED_BODY.max_miss * np.sqrt(np.mean(off[around] ** 2)):
            return False
    return True


def linked_pieces(pieces: list[Piece], edge: float, touching: NDArray[np.int64]) -> NDArray[np.int32]:
    """Object of each of q pieces, (q,) int32, numbered from 0 in the order of their first piece.

    Parameters
    ----------
    pieces : list of Piece
        Largest first.
    edge : float, metres
        Of a voxel.
    touching : (m, 2) int64
        Pairs of pieces that touch.

    Notes
    -----
    A piece that lies mostly within the box of a larger one belongs to it. Two that touch and together are a surface of
    revolution (`is_turned_body`) belong together. What stands on a support reaches down to it.
    A piece that does not is the inside of a cup (or its outside, if the inside is seen to the bottom), or stands on
    another, or is hidden behind one. Only in the first case the two end at one height, the rim, and one of them is
    hollow or, as a narrow strip of it, flat. So a floating piece joins the nearest one for which both hold.
    """
    q = len(pieces)
    if not q:
        return np.empty(0, np.int32)
    around = _containing_pieces(pieces, edge)
    top = np.array([float((piece.places @ piece.up).max()) for piece in pieces])
    floating = np.array([piece.floating for piece in pieces])
    hollow = np.array([piece.convexity < CUP.min_convexity for piece in pieces])
    low = np.array([piece.places.min(axis=0) for piece in pieces])
    high = np.array([piece.places.max(axis=0) for piece in pieces])
    links = [(i, j) for i, j in enumerate(around) if j >= 0]
    links += [(int(i), int(j)) for i, j in touching if is_turned_body(pieces[i], pieces[j])]
    free = around < 0
    for i in np.flatnonzero(free):
        level = np.abs(top - top[i]) <= CUP.max_top_difference * edge
        cup = free & level & (hollow[i] | hollow) & (floating[i] | floating)
        cup[i] = False
        others = np.flatnonzero(cup)
        apart = np.maximum(np.maximum(low[others] - high[i], low[i] - high[others]), 0.0)
        others = others[np.linalg.norm(apart, axis=1) <= 1.001 * CUP.max_gap * edge]  # the others are too far off
        gaps = [_gap(pieces[i], pieces[j], edge) for j in others]
        if gaps and np.isfinite(min(gaps)):
            links.append((int(i), int(others[int(np.argmin(gaps))])))
    return connected_components(np.array(links, np.int64).reshape(-1, 2), q)


def _containing_pieces(pieces: list[Piece], edge: float) -> NDArray[np.int64]:
    """First, and so largest, piece whose box contains most of each piece, (q,) int64; -1 for none.

    A box that contains most of a piece contains the median of its coordinates along any direction, or would if it were
    extended along that direction. So boxes are drawn, and points looked at, only where the medians lie within reach: a
    box reaches no further from its footprint's bounds than the footprint is long.
    """
    up = pieces[0].up
    frame = np.vstack((plane_basis(up), up))
    local = [piece.places @ frame.T for piece in pieces]
    low, high = np.array([x.min(axis=0) for x in local]), np.array([x.max(axis=0) for x in local])
    reach = np.linalg.norm((high - low)[:, :2], axis=1)[:, None]
    reach = np.hstack((reach, reach, np.zeros_like(reach))) + 1.01 * edge
    low[:, 2] = np.minimum(low[:, 2], pieces[0].level)
    high[:, 2] = np.maximum(high[:, 2], pieces[0].level)
    low, high = low - reach, high + reach
    median = np.array([np.median(x, axis=0) for x in local])
    around = np.full(len(pieces), -1, np.int64)
    for i in range(1, len(pieces)):
        near = (low[:i] <= median[i]) & (median[i] <= high[:i])
        for j in np.flatnonzero(near.all(axis=1)):
            if pieces[j].box.contains(pieces[i].places, edge).mean() > MIN_INSIDE:
                around[i] = j
                break
    return around


def _gap(first: Piece, second: Piece, edge: float) -> float:
    """Distance of two pieces, metres; infinite where it is too wide for two parts of one object."""
    length = max(first.box.size[0], second.box.size[0])
    limit = min(CUP.max_gap * edge, CUP.max_gap_fraction * length)
    return float(second.neighbours.query(first.places, distance_upper_bound=limit)[0].min())
