# SPDX-License-Identifier: Apache-2.0
"""Which side of a surface is its outside, where nobody said from where it was seen: what can be seen from free places.

A scanner stood where nothing was, and what it measured it saw from there. So places around and within the cloud are
tried: those from which much of it is visible, always from the same side, tell which side that is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.parallel import in_blocks, kernel, routine, summing_routine
from pcgraph.short_repr import ShortRepr
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.directions import densest_plane, farthest_first, sphere_directions
from pcgraph.voxels.grid import Neighbourhood, VoxelGrid, voxel_grid
from pcgraph.voxels.surface import fitted_windows
from pcgraph.voxels.warp import Warp

_CELLS = 5000  # of the coarse grid on which places are compared, about
_OUTSIDE = 42  # places around the cloud, and
_DISTANCE = 1.3  # how far they stand off its middle, in half diagonals of its bounding box
_INSIDE = 64  # free places within the bounding box, of a lattice of
_LATTICE = 12  # along each side
_CLEARANCE = 2.0  # cells between a free place and the next surface
_SOME = 1500  # cells are looked for in all directions from a place, about
_AMONG = 0.8  # of the directions in which a place among the surfaces has something, of the most that any place has
_BLOCKS, _PARTS, _OF_PART = 16, 3, 0.05  # along the box of all, by which parts are told; parts; of the cells in each
_NEARLY_WHOLE, _SMALL = (0.05, 0.95), 0.5  # quantiles of a part's cells; and how long their box is, of that of all
_SPREAD = 0.75  # of the free places lie far from each other, the others far from surfaces
_ROUNDS = 12  # of agreement between places and orientations
_HALVES = 14  # of space, whose outer places agreement starts from; and from all of them, all those inside, in rooms,
_LEADERS = 6  # single places
_WELL_SEEN = 0.3  # sum of the cosines under which a cell is seen, weighted
_EDGE_ON, _LITTLE = 0.02, 0.3  # cosine below which a surface is seen edge-on, and fraction of the voxels that may be
_NEARLY_EDGE_ON, _SEEN_WELL = 0.1, 0.2  # cosines between normals and rays, less and more
_NEARLY_LEVEL, _LEVEL_INDEED, _FEW_LEVEL = 0.9, 0.97, 20  # cosines to the axis, and to what is level; voxels
_TOLD = 40.0  # votes of the viewpoint for one of the places
_CLOSED = 0.96  # of all directions hit by something, from places inside: all was seen from within, or from around it
_BOTH_SIDES = 0.2  # cosine under which places closed in see either side of a partition, at least
_FINER = 1, 2, 4  # times as many cells and places, if some are closed in, until one agreement shows
_SHOWS_MOST, _SHOWS_NEARLY_ALL = 0.85, 0.95  # of the surface; where rooms are low
_FEW, _LAYERS, _LOW = 16, 1.7, 8.0  # places in rooms; cells over each other on average, and in height: rooms too low
_AS_MUCH = 0.004  # of it by which an agreement shows less than another, and yet as much
_DECIDED, _OUTSIDE_IN, _BEFORE, _FROM_VIEWPOINT = 0.02, 0.003, 0.002, 0.02  # what counts where as much is seen
_ABOVE_GROUND = 0.05  # in place of _BEFORE where it is plain what is the ground
_WIDE = 1.2  # tangent of the angle off the optical axis at which a camera still sees, along x and y,
_NARROW = 0.2  # and beyond which it sees a tenth of all, at least
_OFF_PLANE, _NEARLY_ALL = 1.5, 0.8  # cells off a plane, and how much of what lies so far off is on one side of it
_LEVEL = 0.996  # cosine between a plane's normal and z: 5 degrees
_BEARS, _OF_GROUND = 0.1, 0.25  # of the cells lie on a plane that bears something, and on one that is the ground
_ANYTHING = 0.02  # of the cells lies off the ground at least, and of those, under it at most
_NEARLY_EVERYTHING = 0.02, 0.98  # quantiles
_WITHIN_GROUND = 0.6  # of the ground's area is at most that of all that stands on it
_MUCH_MORE = 1.25  # times as much visible from one place as from another: enough to tell which of the two it was
_VIEWS, _MOST_VIEWS = 12, 48  # places that the voxels themselves are looked at from; and more, each of which
_NEWS = 0.005  # of all cells is seen by first
_MANY = ((100_000, 7.0), (30_000, 3.0))  # voxels: of more a seventh or a third is looked at
_SMOOTHING = 4  # rounds of votes by the voxels around
_CLEAR = 0.3  # votes for a side that need no others, where all voxels are looked at
_PATCH, _CREASE = 10, 0.5  # voxels of a patch, at least, and the cosine between normals at its edges, at most
_OFF_PATCH = 0.7  # edge lengths between planes of touching voxels: so many, and they are two surfaces
_HARDLY, _MOSTLY = 0.05, 0.3  # what votes that are not clear count beside edges; and how much more must agree than not
_SAME = np.float32(0.8)  # cosine between normals on one surface, and more
_BINS_PER_RADIAN = 0.35  # of the octahedral map, over its width, on average
_MAX_BINS = 512  # along each side: a map that stays in the cache
_SLANTED = np.float32(8.0)  # widths between squares of one surface of which one may seem to hide the other
_STEEPEST = np.float32(4.0)  # of a square that is seen at a slant: tangent of its angle
_TINY = 1e-12
_NOTHING = np.iinfo(np.int64).max
_NUMBER = (1 << 32) - 1
_FAR = np.float32(np.inf)


@dataclass(frozen=True, eq=False)
class VisibleSides(ShortRepr):
    """Which side of its surface each of v voxels shows.

    Attributes
    ----------
    places : (k, 3) float64, metres
        From which the outside is seen, the most telling first; or the viewpoint, where that is known.
    normals : (v, 3) float64
        Unit normals, outwards.
    """

    places: NDArray[np.float64]
    normals: NDArray[np.float64]


class TellingPlaces(NamedTuple):
    """Places from which the outside is seen, the most telling first.

    Attributes
    ----------
    places : (k, 3) float64, in half extents of the voxels' centroids from the middle of their bounding box
    weights : (k,) float64, 0..1
        How much each counts.
    parts : (k,) int64
        The part of the cloud whose outside each is asked about; one place may be there for several.
    cells : (c, 3) float64
        Places of coarse cells, in the same frame.
    part_of_cell : (c,) int64
    """

    places: NDArray[np.float64]
    weights: NDArray[np.float64]
    parts: NDArray[np.int64]
    cells: NDArray[np.float64]
    part_of_cell: NDArray[np.int64]

    def part_of(self, centres: NDArray[np.float64]) -> NDArray[np.int64]:
        """The part of each of n places in the same frame, (n,)."""
        from scipy.spatial import cKDTree

        return self.part_of_cell[cKDTree(self.cells).query(centres)[1]]


def visible_sides(
    grid: VoxelGrid,
    normals: NDArray[np.float64],
    viewpoint: NDArray[np.float64] | None = None,
    telling: TellingPlaces | None = None,
    axis: NDArray[np.float64] | None = None,
) -> VisibleSides:
    """The outer side of the surface at each voxel, found from what is visible.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
        Unit normals of the surface, towards either side.
    viewpoint : (3,) float64, metres, optional
        About where all was seen from. What lies edge-on from there, as ground does from a place on it, is decided by
        what is visible; if little does, nothing else is asked.
    telling : TellingPlaces, optional
        `telling_places(grid, viewpoint)`, where that is known.
    axis : (3,) float64, optional
        Of a scanner at the viewpoint, as for `sides_towards`.

    Notes
    -----
    Places all around the cloud, and free places within its bounding box, see the cells of a coarse copy of the grid,
    by a depth buffer over directions. A place counts as far as it agrees with others which side of what it sees is the
    outside; so if those above the floor are right, one under it, which sees it from below, counts nothing. There are
    several such agreements: within a room, around it, above it, below. All that was measured was seen from somewhere,
    so the right one is that whose places see all of the surface, where others have furniture hidden by walls. Where
    two show as much, as of a hollow shell, or of things on a table from below, what counts is that no place sees both
    sides, then how much of what is seen from outside has its outside there, and how much of what is seen from those of
    these places before the plane that bears most, as the ground or a table does, on which things stand (above it, if it
    is level); or from the origin, if that lies there and all before it, as before a camera that looks along z. Where a
    level plane reaches beyond all that stands on it, that it is seen from above counts more than what is shown. The
    voxels then take the mean direction to the places that see them, those that none sees, and of many voxels most, from
    the voxels around. A surface that no place sees well, as an underside or the back of a cabinet near a wall, takes
    its side from what it meets at its edges: what lies behind one of two faces has the other behind itself.

    Visibility of points without a surface: Katz et al. 2007, here by a depth buffer, as voxels have a size.
    """
    middle, reach = _unit_frame(grid, grid.centroids)
    told = np.zeros(grid.n_voxels)
    if viewpoint is not None:
        told = _cosines(grid, normals, viewpoint, axis, reach)
        if np.mean(np.abs(told) < _EDGE_ON) < _LITTLE:
            return VisibleSides(viewpoint[None], _turned(normals, told))
    telling = telling_places(grid, viewpoint) if telling is None else telling
    places, weights = telling.places, telling.weights
    votes, (looked_at, stretch) = _TOLD * told, standing_for_all(grid)
    centres, widths = (grid.centroids[looked_at] - middle) / reach, stretch * grid.edge_lengths[looked_at] / reach
    sides = normals[looked_at]
    seen, towards = seen_from(places, centres, widths, sides, stretch), np.empty((len(centres), 3))
    if telling.part_of_cell.any():
        seen &= telling.parts[:, None] == telling.part_of(centres)
    in_blocks(_look_around, len(centres), places, weights, seen, centres, towards)
    votes[looked_at] += np.einsum("ij,ij->i", towards, sides) / _lengths(towards)
    seen_from_places = middle + reach * places if viewpoint is None else viewpoint[None]
    votes = _smoothed_votes(grid, normals, votes)
    _carry_over(grid.neighbourhood, grid.centroids, grid.edge_lengths, normals, votes, _CLEAR / stretch**2)
    return VisibleSides(seen_from_places, _turned(normals, votes))


def standing_for_all(grid: VoxelGrid) -> tuple[NDArray[np.int64], float]:
    """Some of many voxels, evenly spread on any plane, and how many times as wide they hide as much as all do."""
    step = next((step for many, step in _MANY if grid.n_voxels > many), 1.0)
    if step == 1.0:
        return np.arange(grid.n_voxels), 1.0
    return np.concatenate(in_blocks(_in_step, grid.n_voxels, grid.cells, step)), math.sqrt(step)


@kernel
def _in_step(start: int, stop: int, cells: NDArray[np.float64], step: float) -> NDArray[np.int64]:
    """Which of some cells lie a whole number of steps out along (1, 2, 4): for 3 and 7, spread evenly on any plane."""
    found, n = np.empty(stop - start + 1, np.int64), 0
    for i in range(start, stop):
        steps = (cells[i, 0] + 2.0 * cells[i, 1] + 4.0 * cells[i, 2]) / step
        found[n] = i
        n += steps == np.rint(steps)
    return found[:n]


def sides_towards(
    grid: VoxelGrid, normals: NDArray[np.float64], place: NDArray[np.float64], axis: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit normals, (v, 3) float64, towards the place, (3,), of a scanner that turned about an axis, (3,) of length 1.

    What is nearly level and seen edge-on, as the ground far from a sweep's scanner, and that between rings of which one
    alone runs through a voxel, faces as what is level and seen well does, if that is the side of the scanner: normals
    that are two degrees off turned a tenth of it upside down. Level is what lies across the mean normal of that, as
    scanners may be tilted. The other way, as ground that rises above the scanner, its own normals decide.
    """
    reach = _unit_frame(grid, grid.centroids)[1]
    return _turned(normals, _cosines(grid, normals, place, axis, reach))


def sides_towards_each(
    grid: VoxelGrid, normals: NDArray[np.float64], places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit normals, (v, 3) float64, towards the place from which each voxel was seen, (v, 3).

    What was seen edge-on, as ground far from a tripod, faces as the voxels around on one surface do: normals that are
    a degree off turned a thirtieth of it upside down. What was seen well keeps its side, as those of a thin wall do.
    """
    ways = places - grid.centroids
    ways /= max(float(np.abs(ways).max()), np.finfo(np.float64).tiny)
    cosines = np.einsum("ij,ij->i", normals, ways) / _lengths(ways)
    edge_on = np.abs(cosines) < _SEEN_WELL
    return _turned(normals, np.where(edge_on, _smoothed_votes(grid, normals, cosines.copy()), cosines))


def _cosines(
    grid: VoxelGrid,
    normals: NDArray[np.float64],
    place: NDArray[np.float64],
    axis: NDArray[np.float64] | None,
    reach: float,
) -> NDArray[np.float64]:
    """Cosine between each normal and the way to a place, (v,); about an axis, as `sides_towards` says."""
    cosines = np.empty(grid.n_voxels)
    in_blocks(_face, grid.n_voxels, place, reach, grid.centroids, normals, cosines)
    if axis is None:
        return cosines
    upwards = _upwards(normals, cosines, axis)
    along = np.einsum("ij,j->i", normals, upwards)
    level = np.flatnonzero((np.abs(cosines) < _NEARLY_EDGE_ON) & (np.abs(along) > _NEARLY_LEVEL))
    ways = (place - grid.centroids[level]) / reach
    heights = np.einsum("ij,j->i", ways, upwards) / _lengths(ways)
    below = heights > 0.0
    cosines[level[below]] = (np.sign(along[level]) * heights)[below]
    return cosines


def _upwards(
    normals: NDArray[np.float64], cosines: NDArray[np.float64], axis: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Where most of what is nearly level and seen well faces, (3,) of length 1: near an axis, which may be tilted."""
    clear = np.abs(cosines) > _SEEN_WELL
    facing = normals[clear] * np.sign(cosines[clear])[:, None]
    upwards = axis
    for least in (_NEARLY_LEVEL, _LEVEL_INDEED):
        along = np.einsum("ij,j->i", facing, upwards)
        near = np.abs(along) > least
        if np.count_nonzero(near) < _FEW_LEVEL:
            break
        mean = np.sign(along[near]) @ facing[near]
        upwards = mean / np.linalg.norm(mean) * (1.0 if np.sign(along[near]).sum() >= 0.0 else -1.0)
    return upwards


def _turned(normals: NDArray[np.float64], votes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normals, (v, 3), turned round where votes for their side, (v,), are below zero."""
    turned = np.empty_like(normals)
    in_blocks(_turn, len(normals), normals, votes, turned)
    return turned


def _smoothed_votes(grid: VoxelGrid, normals: NDArray[np.float64], votes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Votes for the side of each voxel's normal, (v,), overwritten, with those of the voxels around on one surface."""
    smoothed, alike = np.empty_like(votes), np.empty(len(grid.neighbours), np.int8)
    in_blocks(_compare_normals, grid.n_voxels, grid.neighbourhood, normals, alike)
    for _ in range(_SMOOTHING):
        in_blocks(_vote_along, grid.n_voxels, grid.neighbourhood, alike, votes, smoothed)
        votes, smoothed = smoothed, votes
    return votes


def visible_fraction(grid: VoxelGrid, place: NDArray[np.float64]) -> float:
    """Fraction of the voxels that are visible from a place, (3,) float64, metres."""
    return _visible_fraction(grid, place, _either_normals(grid))


def _visible_fraction(grid: VoxelGrid, place: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    middle, reach = _unit_frame(grid, np.concatenate((grid.centroids, place[None])))
    centres, widths = (grid.centroids - middle) / reach, grid.edge_lengths / reach
    return float(seen_from((place - middle)[None] / reach, centres, widths, normals).mean())


def likelier_place(grid: VoxelGrid, place: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of two places, (3,) float64, metres, that from which a quarter more is visible; else that before which things
    stand on what bears them; else that from which more is visible."""
    normals = _either_normals(grid)
    visible, other_is = _visible_fraction(grid, place, normals), _visible_fraction(grid, other, normals)
    if max(visible, other_is) <= _MUCH_MORE * min(visible, other_is):
        middle, reach = _unit_frame(grid, grid.centroids)
        coarse = _coarse(grid, middle, reach)
        upwards, offset, _ = _support(coarse, _either_normals(coarse))
        before = [bool((one - middle) / reach @ upwards >= offset) for one in (place, other)]
        if before[0] != before[1]:
            return place if before[0] else other
    return place if visible >= other_is else other


def seen_from(
    places: NDArray[np.float64],
    centres: NDArray[np.float64],
    widths: NDArray[np.float64],
    normals: NDArray[np.float64],
    stretch: float = 1.0,
) -> NDArray[np.bool_]:
    """Whether each of n squares is visible from each of k places, (k, n) bool: none is in front by more than its depth.

    Parameters
    ----------
    places : (k, 3) float64
        In a frame where all are of the order of 1, as single precision is enough there.
    centres : (n, 3) float64
    widths : (n,) float64
    normals : (n, 3) float64
        Towards either side. A square that is seen at a slant hides little of what lies beside it on the same surface.
    stretch : float, >= 1
        Widths over depths: squares that stand for others beside them are wider, but no deeper.
    """
    seen = np.empty((len(places), len(centres)), np.bool_)
    some = slice(None, None, max(1, len(centres) // 200))  # to know how fine a map it takes
    ranges = np.linalg.norm(places[:, None] - centres[None, some], axis=2)
    typical = np.median(widths[some] / np.maximum(ranges, 1e-12), axis=1)
    bins = np.clip(1.0 / (_BINS_PER_RADIAN * typical), 64, _MAX_BINS).astype(np.int64)
    squares = _Squares(_columns(centres), _columns(normals), widths.astype(np.float32), np.float32(1.0 / stretch))
    in_blocks(_look, len(places), places.astype(np.float32), bins, squares, seen, smallest=1)
    return seen


class _Squares(NamedTuple):
    """Squares that stand for a surface, in columns, as loops take them in lanes: (3, n) float32, and widths, (n,).

    They are so many times as deep as wide.
    """

    centres: NDArray[np.float32]
    normals: NDArray[np.float32]
    widths: NDArray[np.float32]
    depth: np.float32


def _columns(rows: NDArray[np.float64]) -> NDArray[np.float32]:
    """The columns of (n, 3) rows, each in one piece, (3, n)."""
    return np.ascontiguousarray(rows.T, np.float32)


def _unit_frame(grid: VoxelGrid, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Middle, (3,), and half extent of places, a voxel edge at least: lengths there are of the order of 1."""
    low, high = bounding_box(places)
    return (low + high) / 2.0, max(float((high - low).max()) / 2.0, float(grid.edge_lengths.min()))


def _either_normals(grid: VoxelGrid) -> NDArray[np.float64]:
    """Unit normals of the surface at each voxel, (v, 3), towards either side."""
    upwards = np.zeros((grid.n_voxels, 3))
    upwards[:, 2] = 1.0
    return fitted_windows(grid, upwards).normals


def _lengths(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of rows, (n,), of the order of 1; of zeros nearly nothing."""
    return np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), _TINY)


def telling_places(grid: VoxelGrid, viewpoint: NDArray[np.float64] | None = None) -> TellingPlaces:
    """The places that tell which side of the voxels' surface is its outside; arguments as for `visible_sides`.

    Of many rooms, whose partitions are thin and which hold few places each, more are looked at, through smaller cells;
    and where floors and ceilings lie near to each other for cells of that size, so that hardly a place is in a room.
    """
    for finer in _FINER:
        telling, shows_most = _telling_places(grid, viewpoint, finer)
        if shows_most:
            break
    return telling


def _telling_places(grid: VoxelGrid, viewpoint: NDArray[np.float64] | None, finer: int) -> tuple[TellingPlaces, bool]:
    """The places, with so many times as many cells, and whether more of them would hardly show more."""
    middle, reach = _unit_frame(grid, grid.centroids)
    origin = -middle / reach
    viewpoint = None if viewpoint is None else (viewpoint - middle) / reach
    coarse = _coarse(grid, middle, reach, finer * _CELLS)
    low, high = bounding_box(coarse.centroids)
    part_of_cell, boxes = _parts(coarse.centroids, low, high)
    boxes = [(low, high), *boxes]
    inside = np.concatenate([_free_places(coarse, *box, max(finer // len(boxes), 1)) for box in boxes])
    outside = (low + high) / 2.0 + _DISTANCE * _lengths((high - low)[None]) / 2.0 * sphere_directions(_OUTSIDE)
    if not (high > low).any():
        outside = low + sphere_directions(_OUTSIDE)
    normals = _either_normals(coarse)
    upwards, offset, is_ground = _support(coarse, normals)
    from_viewpoint = [] if viewpoint is None else [viewpoint]
    if viewpoint is None and origin @ upwards >= offset and _has_in_view(origin, coarse.centroids):
        from_viewpoint = [origin]
    elif upwards[2] < -_LEVEL:  # no accident: the frame stands upright, and things lie in a pit
        upwards = -upwards
    places = np.concatenate((outside, inside, *(place[None] for place in from_viewpoint)))
    likely = np.zeros(len(places), np.bool_)
    if from_viewpoint:
        likely[-1] = True
    else:
        likely[:_OUTSIDE] = sphere_directions(_OUTSIDE) @ upwards > 0.0
    seen = seen_from(places, coarse.centroids, coarse.edge_lengths, normals)
    sides = np.empty(seen.shape, np.float32)
    in_blocks(_find_sides, len(places), places, coarse.centroids, normals, seen, sides, smallest=1)
    closed = np.zeros(len(places))
    hits = closed[_OUTSIDE : _OUTSIDE + len(inside)]
    in_blocks(_count_hits, len(inside), inside.astype(np.float32), _columns(coarse.centroids), hits, smallest=1)
    in_rooms = closed >= _CLOSED
    voting = _without_partitions(sides, sides[in_rooms])
    starts = _starts(voting, outside, likely, in_rooms)
    of_place, of_part = _looks_at_parts(seen, part_of_cell)
    if of_part.any():
        asked = of_part[:, None] == part_of_cell
        seen, sides, voting = (np.where(asked, every[of_place], every.dtype.type(0)) for every in (seen, sides, voting))
    found = _agreements(voting, np.ascontiguousarray(starts[:, of_place]))
    likely_counts = _FROM_VIEWPOINT if from_viewpoint else _ABOVE_GROUND if is_ground else _BEFORE
    looks = _Looks(sides, of_place < _OUTSIDE, likely[of_place], closed[of_place], of_part, part_of_cell)
    weights, shown = _most_telling(found, looks, coarse.neighbourhood, likely_counts)
    chosen = _spread_choice(seen, weights)
    if _is_layered(
        coarse
    ):  # rooms too low to have many places show little at first, and the outside of all of them much
        shows_most = np.count_nonzero(in_rooms) >= _FEW and shown >= _SHOWS_NEARLY_ALL
    else:
        shows_most = shown >= _SHOWS_MOST or not in_rooms.any()
    shows_most = shows_most or coarse.n_voxels > grid.n_voxels // 2
    telling = TellingPlaces(places[of_place[chosen]], weights[chosen], of_part[chosen], coarse.centroids, part_of_cell)
    return telling, shows_most


class _Looks(NamedTuple):
    """Looks of k places at n cells, or at those of one part.

    Attributes
    ----------
    sides : (k, n) float32
        Signed cosines, 0 hidden.
    from_outside, likely : (k,) bool
        Whether they are those of places around the cloud, and of places before what bears things or of the viewpoint.
    closed : (k,) float64
        Fraction of the directions in which a place has something.
    of_part : (k,) int64
        The part at which each is.
    part_of_cell : (n,) int64
    """

    sides: NDArray[np.float32]
    from_outside: NDArray[np.bool_]
    likely: NDArray[np.bool_]
    closed: NDArray[np.float64]
    of_part: NDArray[np.int64]
    part_of_cell: NDArray[np.int64]


def _looks_at_parts(
    seen: NDArray[np.bool_], part_of_cell: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number of the place, of k that see cells, (k, n), and of the part, for each look at a part of which it sees some.

    Parts are asked about one by one, as a place before a house sees its front from the right side and the room
    opposite, into which its sensor looked through a window, from the wrong one.
    """
    n_parts = int(part_of_cell.max()) + 1
    if n_parts == 1:
        return np.arange(len(seen)), np.zeros(len(seen), np.int64)
    sees_some = np.stack([seen[:, part_of_cell == part].any(axis=1) for part in range(n_parts)])
    of_part, of_place = np.nonzero(sees_some)
    return of_place, of_part


def _is_layered(coarse: VoxelGrid) -> bool:
    """Whether floors and ceilings may lie one over another across the thinnest side, too near for a place between."""
    low, high = bounding_box(coarse.centroids)
    thin = int(np.argmin(high - low))
    across, along = np.delete(coarse.cells, thin, axis=1).T
    columns = np.unique(across * (float(np.ptp(along)) + 1.0) + along)
    return bool(coarse.n_voxels >= _LAYERS * len(columns) and (high - low)[thin] < _LOW * coarse.size)


def _without_partitions(sides: NDArray[np.float32], of_rooms: NDArray[np.float32]) -> NDArray[np.float32]:
    """The sides that places see, (k, n), but of partitions: cells of which those in rooms see both.

    A cell is thicker than a partition, so that the rooms on either side of it would contradict each other.
    """
    if not len(of_rooms):
        return sides
    front, back = np.maximum(of_rooms, 0.0).max(axis=0), np.maximum(-of_rooms, 0.0).max(axis=0)
    return np.where(np.minimum(front, back) > _BOTH_SIDES, np.float32(0.0), sides)


def _starts(
    sides: NDArray[np.float32], outside: NDArray[np.float64], likely: NDArray[np.bool_], in_rooms: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Weights of the places, (s, k), from which agreement may start: first opinions as different as there are."""
    starts = np.zeros((_HALVES + 4 + _LEADERS, len(sides)), np.float32)
    starts[:_HALVES, :_OUTSIDE] = sphere_directions(_HALVES) @ (outside - outside.mean(axis=0)).T > 0.0
    starts[_HALVES, :_OUTSIDE] = 1.0
    starts[_HALVES + 1, _OUTSIDE:] = 1.0
    starts[_HALVES + 2] = likely
    starts[_HALVES + 3] = in_rooms
    unseen = np.ones((2, sides.shape[1]), np.float32)  # of each side
    news = np.empty(len(sides), np.float32)
    for start in starts[_HALVES + 4 :]:
        in_blocks(_tell_news, len(sides), sides, unseen, news, smallest=1)
        leader = int(np.argmax(news))
        start[leader] = 1.0
        unseen[0, sides[leader] > 0.0] = 0.0
        unseen[1, sides[leader] < 0.0] = 0.0
    return starts[starts.any(axis=1)]


class _Support(NamedTuple):
    """The plane that bears most: the ground, a table, or a wall behind things.

    Attributes
    ----------
    upwards : (3,) float64, unit
        Its normal, to where nearly all the rest stands; or z, where that lies on both sides of each plane.
    offset : float
        Of the plane along it; -inf where there is none.
    is_ground : bool
        Whether it is level, and reaches beyond all that stands on it, or lies in a hollow of it.
    """

    upwards: NDArray[np.float64]
    offset: float
    is_ground: bool


def _support(coarse: VoxelGrid, normals: NDArray[np.float64]) -> _Support:
    """The plane on which most cells lie, if nearly all the rest is on one side of it."""
    normal, offset, fraction = densest_plane(coarse.centroids, normals)
    heights = np.einsum("ij,j->i", coarse.centroids, normal) - offset
    is_rest = np.abs(heights) > _OFF_PLANE * coarse.size
    above, below = heights[is_rest & (heights > 0.0)].sum(), -heights[is_rest & (heights < 0.0)].sum()
    if fraction < _BEARS or max(above, below) <= _NEARLY_ALL * (above + below):
        return _Support(np.array([0.0, 0.0, 1.0]), -np.inf, False)
    if above < below:
        normal, offset, heights = -normal, -offset, -heights
    is_ground = (
        abs(normal[2]) >= _LEVEL
        and fraction >= _OF_GROUND
        and np.mean(is_rest) >= _ANYTHING
        and np.mean(heights[is_rest] < 0.0) <= _ANYTHING
        and _level_area(coarse.centroids[is_rest]) < _WITHIN_GROUND * _level_area(coarse.centroids[~is_rest])
    )
    return _Support(normal, offset, bool(is_ground))


def _level_area(places: NDArray[np.float64]) -> float:
    """Area of the rectangle along x and y that holds nearly all places."""
    low, high = np.quantile(places[:, :2], _NEARLY_EVERYTHING, axis=0)
    return float(np.prod(high - low))


def _has_in_view(place: NDArray[np.float64], centres: NDArray[np.float64]) -> bool:
    """Whether all lies before a camera at a place, (3,), that looks along z, around its axis, and not all near that."""
    rays = centres - place
    if not (rays[:, 2] > 0.0).all():
        return False
    slopes = rays[:, :2] / rays[:, 2:]
    is_around = (slopes.min(axis=0) < 0.0).all() and (slopes.max(axis=0) > 0.0).all()
    aside = np.abs(slopes).max(axis=1)
    return bool(is_around and aside.max() < _WIDE and np.mean(aside > _NARROW) > 0.1)


@summing_routine
def _news(sides: NDArray[np.float32], unseen: NDArray[np.float32]) -> np.float32:
    """Sum of the cosines that a place sees of sides that no leader has seen."""
    total = np.float32(0.0)
    for i in range(len(sides)):
        total += sides[i] * unseen[0, i] if sides[i] > 0.0 else -sides[i] * unseen[1, i]
    return total


@kernel
def _tell_news(
    start: int, stop: int, sides: NDArray[np.float32], unseen: NDArray[np.float32], news: NDArray[np.float32]
) -> None:
    """Set what each place sees that no leader has seen."""
    for k in range(start, stop):
        news[k] = _news(sides[k], unseen)


class _Agreements(NamedTuple):
    """What s first opinions come to, of k places about the sides of n cells.

    Attributes
    ----------
    weights : (s, k) float32, 0..1
        How much each place counts.
    outward : (s, n) float32
        The side on which the outside lies, as seen along the normals: -1, 1, or 0 where no place says.
    agreed, known : (s, k) float32
        Sums of the cosines that each place sees on the right side, and on either side of cells whose outside is known.
    """

    weights: NDArray[np.float32]
    outward: NDArray[np.float32]
    agreed: NDArray[np.float32]
    known: NDArray[np.float32]


def _agreements(sides: NDArray[np.float32], starts: NDArray[np.float32]) -> _Agreements:
    """What first opinions, weights of the places (s, k), come to, given the sides that each sees, (k, n).

    Sides are signed cosines, 0 hidden. What is found, by turns, is nearly a pair of singular vectors, but no place
    counts against what it sees.
    """
    outward = np.empty((len(starts), sides.shape[1]), np.float32)
    found = _Agreements(starts.copy(), outward, np.zeros_like(starts), np.zeros_like(starts))
    in_blocks(_agree, len(starts), sides, found, smallest=1)
    return found


@summing_routine
def _balance(sides: NDArray[np.float32], outward: NDArray[np.float32]) -> tuple[np.float32, np.float32]:
    """Sums of the cosines that a place sees, less those on the wrong side, and of all whose outside is known."""
    net = known = np.float32(0.0)
    for i in range(len(sides)):
        value = sides[i] * outward[i]
        net += value
        known += abs(value)
    return net, known


@kernel
def _agree(start: int, stop: int, sides: NDArray[np.float32], found: _Agreements) -> None:
    """Places that agree decide where the outside lies, and those that see it there count, by turns until it stands."""
    n_places, n = sides.shape
    total = np.empty(n, np.float32)
    for s in range(start, stop):
        weights, outward = found.weights[s], found.outward[s]
        for i in range(n):
            outward[i] = 0.0
        for _ in range(_ROUNDS):
            for i in range(n):
                total[i] = 0.0
            for k in range(n_places):
                if weights[k] > 0.0:
                    for i in range(n):
                        total[i] += weights[k] * sides[k, i]
            changed = False
            for i in range(n):
                side = np.float32(1.0 if total[i] > 0.0 else (-1.0 if total[i] < 0.0 else 0.0))
                changed = changed or side != outward[i]
                outward[i] = side
            if not changed:
                break
            largest = np.float32(_TINY)
            for k in range(n_places):
                net, known = _balance(sides[k], outward)
                found.agreed[s, k], found.known[s, k] = (net + known) / 2.0, known
                net = max(net, np.float32(0.0))
                weights[k] = math.sqrt(net) * (net / max(known, np.float32(_TINY))) ** 4
                largest = max(largest, weights[k])
            for k in range(n_places):
                weights[k] /= largest


def _most_telling(
    found: _Agreements, looks: _Looks, around: Neighbourhood, likely_counts: float
) -> tuple[NDArray[np.float64], float]:
    """Weights of the places, (k,) float64, in the agreement that shows most of the surface; how much any shows.

    Crevices between things are crests from behind, which are seen the better: what little that is decides nothing.
    A crease is hidden by what is beside it, so cells count as shown beside shown ones; but not where an agreement is
    one of places closed in, as in a room: of that part all but narrow gaps is seen from within.
    """
    visible = np.abs(looks.sides).sum(axis=1)
    different = np.array(list({outward.tobytes(): s for s, outward in enumerate(found.outward)}.values()))
    counts = found.weights[different].astype(np.float64)
    of_parts = (looks.of_part == np.arange(looks.part_of_cell.max() + 1)[:, None]).T.astype(np.float64)
    every, closed = counts @ of_parts, counts @ (of_parts * looks.closed[:, None])
    is_closed = ((closed >= _CLOSED * every) & (every > 0.0)).any(axis=0)[looks.part_of_cell]
    shown = np.empty(len(different))
    in_blocks(_show, len(different), different, looks.sides, found, around, is_closed, shown, smallest=1)
    most_shown, most, best = float(shown.max()), -np.inf, found.weights[0]
    for s, fraction in zip(different, shown, strict=True):
        weights, agreed, known = found.weights[s], found.agreed[s], found.known[s]
        score = min(float(fraction), most_shown - _AS_MUCH)
        decided = np.abs(2.0 * agreed / np.maximum(known, _TINY) - 1.0)
        score += _DECIDED * float(decided[visible > 0.0].mean())
        for some, counts in ((looks.from_outside, _OUTSIDE_IN), (looks.likely, likely_counts)):
            score += counts * float(agreed[some].sum() / max(float(visible[some].sum()), _TINY))
        if score > most:
            most, best = score, weights
    return best.astype(np.float64), most_shown


@kernel
def _show(
    start: int,
    stop: int,
    different: NDArray[np.int64],
    sides: NDArray[np.float32],
    found: _Agreements,
    around: Neighbourhood,
    is_closed: NDArray[np.bool_],
    shown: NDArray[np.float64],
) -> None:
    """Set the fraction of the cells that each of some agreements shows, or shows beside them unless closed in.

    Of partitions, on which no place has a vote, either side counts.
    """
    n_places, n = sides.shape
    of_cells, nothing = np.empty(n, np.float32), np.float32(0.0)
    for d in range(start, stop):
        weights, outward = found.weights[different[d]], found.outward[different[d]]
        for i in range(n):
            of_cells[i] = nothing
        for k in range(n_places):
            if weights[k] > 0.0:
                for i in range(n):
                    value = sides[k, i] * outward[i] if outward[i] != nothing else abs(sides[k, i])
                    of_cells[i] += weights[k] * max(value, nothing)
        total = 0.0
        for i in range(n):
            most = of_cells[i]
            if not is_closed[i]:
                for a in range(around.indptr[i], around.indptr[i + 1]):
                    most = max(most, of_cells[around.neighbours[a]])
            total += min(most / _WELL_SEEN, 1.0)
        shown[d] = total / n


def _spread_choice(seen: NDArray[np.bool_], weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Some of the places, by weight and by how much each sees, (k, n) bool, that those before see seldom or never.

    So each of many rooms has one.
    """
    places = np.flatnonzero(weights > 0.0)
    left, sees = weights[places], seen[places].astype(np.float32)
    interest = np.ones(seen.shape[1], np.float32)
    chosen: list[int] = []
    while len(chosen) < _MOST_VIEWS and left.any():
        best = int(np.argmax(left * np.einsum("kn,n->k", sees, interest)))
        if len(chosen) >= _VIEWS and (sees[best] @ (interest == 1.0)) < _NEWS * len(interest):
            break
        chosen.append(best)
        interest[sees[best] > 0.0] *= np.float32(0.25)
        left[best] = 0.0
    return places[chosen]


def _coarse(grid: VoxelGrid, middle: NDArray[np.float64], reach: float, cells: int = _CELLS) -> VoxelGrid:
    """Voxels in larger ones, as few as still show their shape, in the frame of `_unit_frame`; the outermost surfaces
    amid a layer of them."""
    edges = grid.edge_lengths
    width = float(edges[0] if edges.min() == edges.max() else np.median(edges)) / reach
    centres = (grid.centroids - middle) / reach
    size = width * max(1.0, math.sqrt(len(centres) / (1.5 * cells)))  # as many as a surface would have
    low = bounding_box(centres)[0]
    while True:
        shift = 0.5 * size - low
        coarse = voxel_grid(centres + shift, None, size, Warp())
        if coarse.n_voxels <= 2 * cells:
            return replace(coarse, centroids=coarse.centroids - shift)
        size *= 1.4


def _parts(
    centres: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.int64], list[tuple[NDArray[np.float64], NDArray[np.float64]]]]:
    """Parts of a cloud that are far from each other, the number of each cell's, (n,), the largest first, which has what
    belongs to none; and boxes in which nearly all of them lies, where the box of all is twice as long.

    A room of whose surroundings little was seen through its windows, or scans of places far apart.
    """
    part_of_cell, length = np.zeros(len(centres), np.int64), float((high - low).max())
    boxes: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    if not length > 0.0:
        return part_of_cell, boxes
    blocks = voxel_grid(centres - low, None, length / _BLOCKS, Warp())
    source = np.repeat(np.arange(blocks.n_voxels), np.diff(blocks.indptr))
    touching = np.stack((source, blocks.neighbours.astype(np.int64)), axis=1)
    piece = connected_components(touching, blocks.n_voxels)[blocks.voxel_of_point]
    counts = np.bincount(piece)
    for part, number in enumerate(np.argsort(-counts, kind="stable")[:_PARTS]):
        if counts[number] < _OF_PART * len(centres):
            break
        part_of_cell[piece == number] = part
        lowest, highest = np.quantile(centres[piece == number], _NEARLY_WHOLE, axis=0)
        if (highest - lowest).max() < _SMALL * length:
            boxes.append((lowest, highest))
    return part_of_cell, boxes


def _free_places(
    coarse: VoxelGrid, low: NDArray[np.float64], high: NDArray[np.float64], finer: int
) -> NDArray[np.float64]:
    """Places within the bounding box, the farthest off all surfaces first, (k, 3); so many times as many as usual."""
    from scipy.spatial import cKDTree

    n, lattice_side = finer * _INSIDE, round(_LATTICE * finer ** (1.0 / 3.0))
    steps = (np.arange(lattice_side) + 0.5) / lattice_side
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    places = low + lattice * (high - low)
    clearance = cKDTree(coarse.centroids).query(places)[0] / coarse.size
    free = np.flatnonzero(clearance > _CLEARANCE)
    if not len(free):
        return places[:0]
    places, clearance, hits = places[free], clearance[free], np.empty(len(free))
    some = _columns(coarse.centroids[:: max(1, coarse.n_voxels // _SOME)])
    in_blocks(_count_hits, len(free), places.astype(np.float32), some, hits, smallest=1)
    among = np.flatnonzero(hits >= _AMONG * hits.max())  # not the corners of the box around a room askew to it
    chosen = among[farthest_first(places[among], int(np.argmax(clearance[among])), int(_SPREAD * n))]
    order = np.argsort(-clearance, kind="stable")
    rest = order[~np.isin(order, chosen)][: n - len(chosen)]
    return places[np.concatenate((chosen, rest))]


# --- depth buffers over directions ------------------------------------------------------------------------------------


@routine
def _on_map(x: np.float32, y: np.float32, z: np.float32, total: np.float32) -> tuple[np.float32, np.float32]:
    """Place of a direction on the octahedral map, -1..1 each; `total` is the sum of its sizes along the axes."""
    nothing, one = np.float32(0.0), np.float32(1.0)
    u, v = x / total, y / total
    folded_u, folded_v = one - abs(v), one - abs(u)
    folded_u = folded_u if u >= nothing else -folded_u
    folded_v = folded_v if v >= nothing else -folded_v
    return (folded_u if z < nothing else u), (folded_v if z < nothing else v)


@kernel
def _count_hits(
    start: int, stop: int, places: NDArray[np.float32], centres: NDArray[np.float32], hits: NDArray[np.float64]
) -> None:
    """Set the fraction of directions in which there is something, from each place, on a map of 8 x 8 bins."""
    bins = np.empty(centres.shape[1], np.uint64)
    for k in range(start, stop):
        _find_bins(places[k], centres, bins)
        hit = np.uint64(0)  # one bit per bin
        for i in range(len(bins)):
            hit |= np.uint64(1) << bins[i]
        n_hits = 0
        while hit:
            hit &= hit - np.uint64(1)
            n_hits += 1
        hits[k] = n_hits / 64


@routine
def _find_bins(place: NDArray[np.float32], centres: NDArray[np.float32], bins: NDArray[np.uint64]) -> None:
    """Set in which of 8 x 8 bins each centre lies, seen from a place."""
    px, py, pz = place
    one, four, last = np.float32(1.0), np.float32(4.0), np.float32(7.0)
    for i in range(centres.shape[1]):
        x, y, z = centres[0, i] - px, centres[1, i] - py, centres[2, i] - pz
        u, v = _on_map(x, y, z, abs(x) + abs(y) + abs(z))
        u, v = (u + one) * four, (v + one) * four
        bins[i] = np.int32(u if u < last else last) * 8 + np.int32(v if v < last else last)


@kernel
def _find_sides(
    start: int,
    stop: int,
    places: NDArray[np.float64],
    centres: NDArray[np.float64],
    normals: NDArray[np.float64],
    seen: NDArray[np.bool_],
    sides: NDArray[np.float32],
) -> None:
    """Set the cosine between each normal and the direction to each place, 0 where hidden."""
    for k in range(start, stop):
        for i in range(len(centres)):
            sides[k, i] = _facing(places[k], 1.0, centres, normals, i) if seen[k, i] else 0.0


class _Views(NamedTuple):
    """How squares look from a place, (n,) float32 each.

    Attributes
    ----------
    u, v : on the octahedral map, in bins
    halves : half widths on it, a little more, in bins
    ranges : of their centres
    slopes : how much farther a square is per bin beside its centre, as it is deeper than wide if seen at a slant
    limits : what is nearer than this hides the square
    """

    u: NDArray[np.float32]
    v: NDArray[np.float32]
    halves: NDArray[np.float32]
    ranges: NDArray[np.float32]
    slopes: NDArray[np.float32]
    limits: NDArray[np.float32]


@kernel
def _look(
    start: int,
    stop: int,
    places: NDArray[np.float32],
    bins_of: NDArray[np.int64],
    squares: _Squares,
    seen: NDArray[np.bool_],
) -> None:
    """Set what is seen from each place, by the least range in each bin of directions that a square may cover.

    A bin holds the range, whose bits as a float32 sort as it does, above the number of the square that has it.
    """
    n, nothing, half_bin = squares.centres.shape[1], np.float32(0.0), np.float32(0.5)
    depth = squares.depth  # read here: a field read where squares are compared costs that loop half its time again
    at, doubtful = np.empty(n, np.int64), np.empty(n + 1, np.int64)
    views = _Views(
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
    )
    for k in range(start, stop):
        bins, last = bins_of[k], bins_of[k] - 1
        nearest = np.full(bins * bins, _NOTHING)
        _view(places[k], bins, squares, views)
        for i in range(n):
            at[i] = 0
            if views.ranges[i] <= nothing:
                continue
            u, v, half = views.u[i], views.v[i], views.halves[i]
            at[i] = min(int(u), last) * bins + min(int(v), last)
            first, final = min(int(max(v - half, nothing)), last), min(int(v + half), last)
            for p in range(min(int(max(u - half, nothing)), last), min(int(u + half), last) + 1):
                off = max(abs(np.float32(p) + half_bin - u) - half_bin, nothing)
                for q in range(first, final + 1):
                    beside = max(off, abs(np.float32(q) + half_bin - v) - half_bin)
                    bits = np.float32(views.ranges[i] + views.slopes[i] * beside).view(np.int32)
                    nearest[p * bins + q] = min(nearest[p * bins + q], np.int64(bits) << 32 | i)
        n_doubtful = 0
        for i in range(n):  # without a branch, which would often be guessed wrongly
            too_far = views.limits[i] - np.int32(nearest[at[i]] >> 32).view(np.float32)
            seen[k, i] = too_far <= nothing
            doubtful[n_doubtful] = i
            n_doubtful += (too_far > nothing) & (too_far < _SLANTED * squares.widths[i])
        for i in doubtful[:n_doubtful]:
            seen[k, i] = _on_one_surface(i, nearest[at[i]] & _NUMBER, squares, depth)


@routine
def _view(place: NDArray[np.float32], bins: int, squares: _Squares, views: _Views) -> None:
    """Set how squares look from a place, on a map of bins x bins. One at the place has range 0 and is not seen."""
    centres, normals, widths, depth_of_width = squares
    px, py, pz = place
    nothing, one, halves, bin_size = np.float32(0.0), np.float32(1.0), np.float32(0.5 * bins), np.float32(2.0 / bins)
    margin, widest = np.float32(0.6), np.float32(24.0)
    for i in range(len(widths)):
        x, y, z = centres[0, i] - px, centres[1, i] - py, centres[2, i] - pz
        total = abs(x) + abs(y) + abs(z)
        u, v = _on_map(x, y, z, total)
        views.u[i], views.v[i] = (u + one) * halves, (v + one) * halves
        square = x * x + y * y + z * z
        distance = math.sqrt(square)
        bin_width = bin_size * total  # across the direction, at least, as of the square
        half = margin * widths[i] / bin_width
        half = half if half < widest else widest
        views.halves[i] = half
        depth = abs(x * normals[0, i] + y * normals[1, i] + z * normals[2, i])
        across = square - depth * depth
        across = math.sqrt(across if across > nothing else nothing)
        slope = across / depth
        slope = bin_width * (slope if across < _STEEPEST * depth else _STEEPEST)
        views.slopes[i] = slope
        views.ranges[i] = distance
        deep = depth_of_width * widths[i] + slope * half  # from edge to edge
        limit = distance - (deep if deep < widths[i] else widths[i]) - np.float32(0.5) * bin_width
        views.limits[i] = limit if distance > nothing else _FAR


@routine
def _on_one_surface(i: int, j: int, squares: _Squares, depth: np.float32) -> bool:
    """Whether two squares lie on each other's planes and near: at a slant one may seem to hide the other."""
    centres, normals, width = squares.centres, squares.normals, squares.widths[i]
    cosine = off = off_other = square = np.float32(0.0)
    for axis in range(3):
        way = centres[axis, i] - centres[axis, j]
        square += way * way
        cosine += normals[axis, i] * normals[axis, j]
        off += way * normals[axis, i]
        off_other += way * normals[axis, j]
    reach, flat = _SLANTED * width, depth * width
    return bool(abs(cosine) >= _SAME and max(abs(off), abs(off_other)) < flat and square < reach * reach)


@kernel
def _face(
    start: int,
    stop: int,
    place: NDArray[np.float64],
    unit: float,
    centres: NDArray[np.float64],
    normals: NDArray[np.float64],
    cosines: NDArray[np.float64],
) -> None:
    """Set the cosine between each normal and the way to a place, given a unit of about that length."""
    for i in range(start, stop):
        cosines[i] = _facing(place, unit, centres, normals, i)


@routine
def _facing(
    place: NDArray[np.float64], unit: float, centres: NDArray[np.float64], normals: NDArray[np.float64], i: int
) -> float:
    """Cosine between a normal and the way to a place; in units, as squares of tiny lengths are zero."""
    x, y, z = (place[0] - centres[i, 0]) / unit, (place[1] - centres[i, 1]) / unit, (place[2] - centres[i, 2]) / unit
    length = max(math.sqrt(x * x + y * y + z * z), _TINY)
    return (x * normals[i, 0] + y * normals[i, 1] + z * normals[i, 2]) / length


@kernel
def _turn(
    start: int, stop: int, normals: NDArray[np.float64], votes: NDArray[np.float64], turned: NDArray[np.float64]
) -> None:
    """Set what `_turned` returns."""
    for i in range(start, stop):
        sign = -1.0 if votes[i] < 0.0 else 1.0
        for axis in range(3):
            turned[i, axis] = sign * normals[i, axis]


@kernel
def _look_around(
    start: int,
    stop: int,
    places: NDArray[np.float64],
    weights: NDArray[np.float64],
    seen: NDArray[np.bool_],
    centres: NDArray[np.float64],
    towards: NDArray[np.float64],
) -> None:
    """Set the weighted sum of the unit vectors from each square to the places that see it."""
    for i in range(start, stop):
        towards[i, 0] = towards[i, 1] = towards[i, 2] = 0.0
        for k in range(len(places)):
            if seen[k, i]:
                x, y, z = places[k, 0] - centres[i, 0], places[k, 1] - centres[i, 1], places[k, 2] - centres[i, 2]
                scale = weights[k] / math.sqrt(x * x + y * y + z * z)
                towards[i, 0] += scale * x
                towards[i, 1] += scale * y
                towards[i, 2] += scale * z


@kernel
def _carry_over(
    around: Neighbourhood,
    centroids: NDArray[np.float64],
    edge_lengths: NDArray[np.float64],
    normals: NDArray[np.float64],
    votes: NDArray[np.float64],
    clear: float,
) -> None:
    """Set votes of patches that have no clear ones by what they meet at their edges, if most of that agrees.

    A patch is voxels on one surface. What it meets has clear votes, or got them in an earlier round.
    """
    known, visited = np.abs(votes) >= clear, np.empty(len(votes), np.bool_)
    patch, way = np.empty(len(votes), np.int64), np.empty(len(votes))  # 1 or -1 along the first one's normal
    changed = True
    while changed:
        changed, visited[:] = False, known
        for first in range(len(votes)):
            if visited[first]:
                continue
            patch[0], way[first], visited[first] = first, 1.0, True
            size, total, said = _walk_patch(around, centroids, edge_lengths, normals, votes, known, visited, patch, way)
            own = 0.0
            for i in patch[:size]:
                own += way[i] * votes[i]
            own *= _HARDLY / clear
            if size >= _PATCH and said > 0.0 and abs(total + own) >= _MOSTLY * (said + abs(own)):
                changed, side = True, clear if total + own > 0.0 else -clear
                for i in patch[:size]:
                    known[i], votes[i] = True, side * way[i]


@routine
def _walk_patch(around, centroids, edge_lengths, normals, votes, known, visited, patch, way):  # type: ignore[no-untyped-def]
    """Set `patch`, which holds its first voxel, and `way` of all of it; its size, what it meets, summed for the side of
    the first one's normal, and how sure that is in sum."""
    indptr, neighbours = around
    done, size, total, said = 0, 1, 0.0, 0.0
    while done < size:
        i = patch[done]
        done += 1
        for a in range(indptr[i], indptr[i + 1]):
            j = np.int64(neighbours[a])
            if visited[j] and not known[j]:
                continue
            alike, is_one = _alike_sides(i, j, centroids, normals, edge_lengths[i])
            if known[j]:
                total += way[i] * alike if votes[j] > 0.0 else -way[i] * alike
                said += abs(alike)
            elif is_one:
                patch[size], way[j], visited[j] = j, way[i] * alike, True
                size += 1
    return size, total, said


@routine
def _alike_sides(
    i: int, j: int, centroids: NDArray[np.float64], normals: NDArray[np.float64], edge: float
) -> tuple[float, bool]:
    """Whether the outer side of two touching voxels is that of both normals (or of neither), 1, or of one of them, -1,
    the nearer to 0 the less it is sure; and whether they are on one surface."""
    cosine = ahead_of_i = ahead_of_j = 0.0
    for axis in range(3):
        way = centroids[j, axis] - centroids[i, axis]
        cosine += normals[i, axis] * normals[j, axis]
        ahead_of_i += way * normals[i, axis]
        ahead_of_j -= way * normals[j, axis]
    least, most = min(abs(ahead_of_i), abs(ahead_of_j)) / edge, max(abs(ahead_of_i), abs(ahead_of_j)) / edge
    if abs(cosine) > _SAME and most <= _OFF_PATCH:
        return 1.0 if cosine > 0.0 else -1.0, True
    if abs(cosine) < _CREASE:
        return min(least, 1.0) * (1.0 if (ahead_of_i > 0.0) == (ahead_of_j > 0.0) else -1.0), False
    return 0.0, False


@kernel
def _compare_normals(
    start: int, stop: int, around: Neighbourhood, normals: NDArray[np.float64], alike: NDArray[np.int8]
) -> None:
    """Set whether each voxel and each of those around it are on one surface: 1, -1 with opposite normals, or 0."""
    for i in range(start, stop):
        for a in range(around.indptr[i], around.indptr[i + 1]):
            j = around.neighbours[a]
            cosine = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1] + normals[i, 2] * normals[j, 2]
            alike[a] = np.int8(cosine > _SAME) - np.int8(cosine < -_SAME)  # without a branch


@kernel
def _vote_along(
    start: int,
    stop: int,
    around: Neighbourhood,
    alike: NDArray[np.int8],
    votes: NDArray[np.float64],
    smoothed: NDArray[np.float64],
) -> None:
    """Set the votes for the side of each voxel's normal, with those of the voxels around on the same surface."""
    indptr, neighbours = around
    for i in range(start, stop):
        total = votes[i]
        for a in range(indptr[i], indptr[i + 1]):
            total += alike[a] * votes[neighbours[a]]
        smoothed[i] = total / (indptr[i + 1] - indptr[i] + 1)
