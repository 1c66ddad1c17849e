# SPDX-License-Identifier: Apache-2.0
"""Places from which the outside of a cloud is seen: those that agree, of many around and within it.

A scanner stood where nothing was, and what it measured it saw from there. So places around and within the cloud are
tried: those from which much of it is visible, always from the same side, tell which side that is.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.parallel import in_blocks, kernel, routine, summing_routine
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.depth_buffer import facing_cosines, hit_fractions, seen_from
from pcgraph.voxels.directions import farthest_first, sphere_directions
from pcgraph.voxels.grid import Neighbourhood, VoxelGrid, voxel_grid
from pcgraph.voxels.ground_and_rooms import LEVEL, bearing_plane, is_scanned_room
from pcgraph.voxels.surface import Windows, fitted_windows
from pcgraph.voxels.warp import Shift

_CELLS = 5000  # of the coarse grid on which places are compared, about
_MOSTLY_SURFACES = 0.5  # of the voxels are joined as on a surface, at least
_OUTSIDE = 42  # places around the cloud, and
_DISTANCE = 1.3  # how far they stand off its middle, in half diagonals of its bounding box
_INSIDE = 64  # free places within the bounding box, of a lattice of
_LATTICE = 12  # along each side
_MUCH_SMALLER = 0.2  # than the bounding box: a box along the principal axes
_CLEARANCE = 2.0  # cells between a free place and the next surface
_SOME = 1500  # cells are looked for in all directions from a place, about
_AMONG = 0.8  # of the directions in which a place among the surfaces has something, of the most that any place has
_BLOCKS, _OF_PART = 16, 0.05  # along the box of all, by which parts are told; of the cells in each
_PARTS_OF_ANY, _PARTS = 3, 8  # at most, and if they are rooms
_NEARLY_WHOLE, _SMALL = (0.05, 0.95), 0.5  # quantiles of a part's cells; and how long their box is, of that of all
_SPREAD = 0.75  # of the free places lie far from each other, the others far from surfaces
_BLOCK = 512  # cells: of many rooms a place sees a few such blocks of them
_ROUNDS = 12  # of agreement between places and orientations
_HALVES = 14  # of space, whose outer places agreement starts from; and from all of them, all those inside, in rooms,
_LEADERS = 6  # single places
_WELL_SEEN = 0.3  # sum of the cosines under which a cell is seen, weighted
_FLAT, _LEFT_OPEN = 0.1, 0.02  # cells off its plane is a cell with those around, at most; and of what the places of an
# agreement see, as much may be planes from behind as cells are coarse, noise thick and things thin
_CLOSED = 0.96  # of all directions hit by something, from places inside: all was seen from within, or from around it
_BOTH_SIDES = 0.2  # cosine under which places closed in see either side of a partition, at least
_FINER = 1, 2, 4  # times as many cells and places, if some are closed in, until one agreement shows
_SHOWS_MOST, _SHOWS_NEARLY_ALL = 0.85, 0.95  # of the surface; where rooms are low
_FEW, _LAYERS, _LOW = 16, 1.7, 8.0  # places in rooms; cells over each other on average, and in height: rooms too low
_AS_MUCH = 0.004  # of it by which an agreement shows less than another, and yet as much
_DECIDED, _OUTSIDE_IN, _BEFORE, _FROM_VIEWPOINT = 0.02, 0.003, 0.002, 0.02  # what counts where as much is seen
_OF_ROOM, _NEARLY_CLOSED = 0.2, 0.8  # counts that places are closed in, nearly, where floor and ceiling bound all,
_SEEN_WITHIN_ALONE = 0.001  # or so much of it is seen from none but such places
_ABOVE_GROUND = 0.05  # in place of _BEFORE where it is plain what is the ground
_WIDE = 1.2  # tangent of the angle off the optical axis at which a camera still sees, along x and y,
_NARROW = 0.2  # and beyond which it sees a tenth of all, at least;
_FROM_CAMERA = 0.93  # of what is visible from the other side of a pit, or table, is from a camera over it, at least
_VIEWS, _MOST_VIEWS = 12, 128  # places that the voxels themselves are looked at from; and more, each of which
_NEWS = 0.005  # of all cells is seen by first, or four times as much by second
_TINY = 1e-12


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


def unit_frame(grid: VoxelGrid, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Middle, (3,), and half extent of places, a voxel edge at least: lengths there are of the order of 1."""
    low, high = bounding_box(places)
    return (low + high) / 2.0, max(float((high - low).max()) / 2.0, float(grid.edge_lengths.min()))


def either_normals(grid: VoxelGrid) -> NDArray[np.float64]:
    """Unit normals of the surface at each voxel, (v, 3), towards either side."""
    return _windows(grid).normals


def _windows(grid: VoxelGrid) -> Windows:
    """Planes through each voxel and those around it, their normals towards either side."""
    upwards = np.zeros((grid.n_voxels, 3))
    upwards[:, 2] = 1.0
    return fitted_windows(grid, upwards)


def lengths(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of rows, (n,), of the order of 1; of zeros nearly nothing."""
    return np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), _TINY)


def telling_places(grid: VoxelGrid, viewpoint: NDArray[np.float64] | None = None) -> TellingPlaces:
    """The places that tell which side of the voxels' surface is its outside; arguments as for `visible_sides`.

    Of many rooms, whose partitions are thin and which hold few places each, more are looked at, through smaller cells;
    and where floors and ceilings lie near to each other for cells of that size, so that hardly a place is in a room.
    """
    middle, reach = unit_frame(grid, grid.centroids)
    surfaces = _surfaces(grid, middle, reach)
    origin, viewpoint = -middle / reach, None if viewpoint is None else (viewpoint - middle) / reach
    for finer in _FINER:
        coarse, points = _in_cells(surfaces, finer * _CELLS)
        may_be_finer = finer < _FINER[-1] and coarse.n_voxels <= grid.n_voxels // 2
        windows = _windows(coarse)
        tried, part_of_cell = _places_to_try(coarse, points, windows.normals, origin, viewpoint, finer)
        is_layered, n_in_rooms = _is_layered(coarse), np.count_nonzero(tried.closed >= _CLOSED)
        if may_be_finer and is_layered and n_in_rooms < _FEW:
            continue  # low rooms have few places at first, and the outside of all of them shows much
        telling, shown = _telling_places(coarse, points, windows, tried, part_of_cell)
        shows_most = shown >= (_SHOWS_NEARLY_ALL if is_layered else _SHOWS_MOST) or not (is_layered or n_in_rooms)
        if shows_most or not may_be_finer:
            break
    return telling


def _telling_places(
    coarse: VoxelGrid, points: NDArray[np.float64], windows: Windows, tried: _Tried, part_of_cell: NDArray[np.int64]
) -> tuple[TellingPlaces, float]:
    """The most telling of places that were tried, and how much of the surface any agreement of them shows."""
    normals, is_flat = windows.normals, windows.residuals <= (_FLAT * coarse.size) ** 2
    seen = seen_from(tried.places, coarse.centroids, coarse.edge_lengths, normals)
    sides = facing_cosines(tried.places, coarse.centroids, normals, seen)
    in_rooms = tried.closed >= _CLOSED
    voting = _without_partitions(sides, sides[in_rooms])
    starts = _starts(voting, tried.places[:_OUTSIDE], tried.likely, in_rooms)
    of_place, of_part = _looks_at_parts(seen, part_of_cell)
    if of_part.any():
        asked = of_part[:, None] == part_of_cell
        seen, sides, voting = (np.where(asked, every[of_place], every.dtype.type(0)) for every in (seen, sides, voting))
    found = _agreements(voting, np.ascontiguousarray(starts[:, of_place]))
    from_outside, likely, closed = of_place < _OUTSIDE, tried.likely[of_place], tried.closed[of_place]
    looks = _Looks(sides, from_outside, likely, closed, of_part, part_of_cell, is_flat)
    room_counts, has_rooms = np.zeros(int(part_of_cell.max()) + 1), np.count_nonzero(in_rooms) >= _FEW
    for part in range(len(room_counts) if has_rooms else 0):
        cells = part_of_cell == part
        room_counts[part] = _OF_ROOM * np.mean(cells) * _is_room(cells, coarse, normals, points)
    weights, shown = _most_telling(found, looks, coarse.neighbourhood, tried.likely_counts, room_counts)
    chosen = _spread_choice(seen, weights)
    places = tried.places[of_place[chosen]]
    return TellingPlaces(places, weights[chosen], of_part[chosen], coarse.centroids, part_of_cell), shown


class _Tried(NamedTuple):
    """Places from which a cloud may have been seen: k of them, the first around it.

    Attributes
    ----------
    places : (k, 3) float64, in the frame of `unit_frame`
    closed : (k,) float64
        Fraction of the directions in which a place within has something; 0 of others.
    likely : (k,) bool
        The viewpoint or origin, if all was seen from about there; else those around that are before what bears things.
    likely_counts : float
        What it counts where as much is seen.
    """

    places: NDArray[np.float64]
    closed: NDArray[np.float64]
    likely: NDArray[np.bool_]
    likely_counts: float


def _places_to_try(
    coarse: VoxelGrid,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    origin: NDArray[np.float64],
    viewpoint: NDArray[np.float64] | None,
    finer: int,
) -> tuple[_Tried, NDArray[np.int64]]:
    """Places around the coarse grid, and within, there so many times as many as usual; and the part of each cell."""
    low, high = bounding_box(coarse.centroids)
    part_of_cell, boxes = _parts(coarse, normals, points)
    share, upright = max(finer // (len(boxes) + 1), 1), np.eye(3)
    in_boxes = np.concatenate([low[None][:0], *(_free_places(coarse, *box, upright, share) for box in boxes)])
    in_boxes = in_boxes[hit_fractions(in_boxes, coarse.centroids) >= _CLOSED]
    if len(in_boxes) < _FEW:  # none of the parts is a room
        part_of_cell[:], in_boxes = 0, in_boxes[:0]
    inside = np.concatenate((_free_places(coarse, *_smallest_box(coarse.centroids), share), in_boxes))
    directions = sphere_directions(_OUTSIDE)
    outside = (low + high) / 2.0 + _DISTANCE * lengths((high - low)[None]) / 2.0 * directions
    if not (high > low).any():
        outside = low + directions
    upwards, offset, is_ground = bearing_plane(coarse, normals)
    sees = viewpoint is None and origin @ upwards >= offset and _has_in_view(origin, coarse.centroids)
    if sees and (abs(upwards[2]) < LEVEL or _sees_as_much(origin, upwards, coarse, normals)):
        viewpoint = origin
    elif upwards[2] < -LEVEL:  # no accident: the frame stands upright, and things lie in a pit
        upwards = -upwards
    places = np.concatenate((outside, inside))
    closed = np.concatenate((np.zeros(_OUTSIDE), hit_fractions(inside, coarse.centroids)))
    if viewpoint is not None:
        places, closed = np.concatenate((places, viewpoint[None])), np.append(closed, 0.0)
        likely = np.arange(len(places)) == len(places) - 1
        return _Tried(places, closed, likely, _FROM_VIEWPOINT), part_of_cell
    likely = np.zeros(len(places), np.bool_)
    likely[:_OUTSIDE] = directions @ upwards > 0.0
    return _Tried(places, closed, likely, _ABOVE_GROUND if is_ground else _BEFORE), part_of_cell


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
    is_flat : (n,) bool
        Whether cells lie on planes with those around. Places beyond an edge see what is on it from its back.
    """

    sides: NDArray[np.float32]
    from_outside: NDArray[np.bool_]
    likely: NDArray[np.bool_]
    closed: NDArray[np.float64]
    of_part: NDArray[np.int64]
    part_of_cell: NDArray[np.int64]
    is_flat: NDArray[np.bool_]


def _looks_at_parts(
    seen: NDArray[np.bool_], part_of_cell: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number of the place, of k that see cells, (k, n), and of the part, for each look at a part of which it sees some.

    Parts are asked about one by one where one of them is a room, as a place before a house sees its front from the
    right side and the room opposite, into which its sensor looked through a window, from the wrong one.
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
    across, along = (np.unique(cells, return_inverse=True)[1] for cells in np.delete(coarse.cells, thin, axis=1).T)
    columns = np.unique(across * coarse.n_voxels + along)
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
    starts[_HALVES + 3] = in_rooms if np.count_nonzero(in_rooms) >= _FEW else 0.0
    unseen = np.ones((2, sides.shape[1]), np.float32)  # of each side
    news = np.empty(len(sides), np.float32)
    for start in starts[_HALVES + 4 :]:
        in_blocks(_tell_news, len(sides), sides, unseen, news, smallest=1)
        leader = int(np.argmax(news))
        start[leader] = 1.0
        unseen[0, sides[leader] > 0.0] = 0.0
        unseen[1, sides[leader] < 0.0] = 0.0
    return starts[starts.any(axis=1)]


def _has_in_view(place: NDArray[np.float64], centres: NDArray[np.float64]) -> bool:
    """Whether all lies before a camera at a place, (3,), that looks along z, around its axis, and not all near that."""
    rays = centres - place
    if not (rays[:, 2] > 0.0).all():
        return False
    slopes = rays[:, :2] / rays[:, 2:]
    is_around = (slopes.min(axis=0) < 0.0).all() and (slopes.max(axis=0) > 0.0).all()
    aside = np.abs(slopes).max(axis=1)
    return bool(is_around and aside.max() < _WIDE and np.mean(aside > _NARROW) > 0.1)


def _sees_as_much(
    place: NDArray[np.float64], upwards: NDArray[np.float64], coarse: VoxelGrid, normals: NDArray[np.float64]
) -> bool:
    """Whether nearly as much is visible from a place as from its mirror image on the other side of all.

    Below a pit, that is seen from above, its floor hides its walls.
    """
    low, high = bounding_box(coarse.centroids)
    opposite = place - 2.0 * ((place - (low + high) / 2.0) @ upwards) * upwards
    seen = seen_from(np.stack((place, opposite)), coarse.centroids, coarse.edge_lengths, normals).mean(axis=1)
    return bool(seen[0] >= _FROM_CAMERA * seen[1])


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


@kernel
def _see_blocks(start: int, stop: int, sides: NDArray[np.float32], sees: NDArray[np.bool_]) -> None:
    """Set whether each place sees any cell of each block."""
    n, nothing = sides.shape[1], np.float32(0.0)
    for k in range(start, stop):
        for block in range(sees.shape[1]):
            some = False
            for i in range(block * _BLOCK, min((block + 1) * _BLOCK, n)):
                some |= sides[k, i] != nothing
            sees[k, block] = some


def _seen_blocks(sides: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether k places, whose sides of n cells are 0 where hidden, (k, n), see any cell of each block, (k, b)."""
    sees = np.empty((len(sides), -(-sides.shape[1] // _BLOCK)), np.bool_)
    in_blocks(_see_blocks, len(sides), sides, sees, smallest=1)
    return sees


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
    in_blocks(_agree, len(starts), sides, _seen_blocks(sides), found, smallest=1)
    return found


@routine
def _add(weight: np.float32, sides: NDArray[np.float32], total: NDArray[np.float32]) -> None:
    """Add the sides that a place sees, so many times, to a sum of them."""
    for i in range(len(sides)):
        total[i] += weight * sides[i]


@summing_routine
def _balance(sides: NDArray[np.float32], outward: NDArray[np.float32]) -> tuple[np.float32, np.float32]:
    """Sums of the cosines that a place sees, less those on the wrong side, and of all whose outside is known."""
    net = known = np.float32(0.0)
    for i in range(len(sides)):
        value = sides[i] * outward[i]
        net += value
        known += abs(value)
    return net, known


class _Paths(NamedTuple):
    """What s first opinions came to about n cells, round by round, until each stood or met the path of one before it.

    Attributes
    ----------
    outward : (s, _ROUNDS, n) int8
    told : (s,) int64
        How many of the rounds are here.
    rounds : (s,) int64
        The round in which nothing changed any more; 0 if there was none.
    """

    outward: NDArray[np.int8]
    told: NDArray[np.int64]
    rounds: NDArray[np.int64]


@routine
def _path_met(paths: _Paths, s: int, this_round: int) -> int:
    """Which opinion before one came by what this one comes to in a round, so that both end alike; -1 if none did.

    Rounds that are left have to be enough: else it depended on the others what is found.
    """
    outward, told, rounds = paths
    n = outward.shape[2]
    for other in range(s):
        for its_round in range(told[other]):
            stands = this_round + rounds[other] - its_round
            if rounds[other] > 0 and stands < _ROUNDS:
                i = 0
                while i < n and outward[other, its_round, i] == outward[s, this_round, i]:
                    i += 1
                if i == n:
                    rounds[s] = stands
                    return other
    return -1


@kernel
def _agree(start: int, stop: int, sides: NDArray[np.float32], sees: NDArray[np.bool_], found: _Agreements) -> None:
    """Places that agree decide where the outside lies, and those that see it there count, by turns until it stands."""
    (n_places, n), n_blocks = sides.shape, sees.shape[1]
    total = np.empty(n, np.float32)
    paths = _Paths(
        np.empty((stop - start, _ROUNDS, n), np.int8),
        np.zeros(stop - start, np.int64),
        np.zeros(stop - start, np.int64),
    )
    for s in range(start, stop):
        weights, outward = found.weights[s], found.outward[s]
        for i in range(n):
            outward[i] = 0.0
        for this_round in range(_ROUNDS):
            for i in range(n):
                total[i] = 0.0
            for k in range(n_places):
                if weights[k] > 0.0:
                    for block in range(n_blocks):
                        if sees[k, block]:
                            of_block = slice(block * _BLOCK, (block + 1) * _BLOCK)
                            _add(weights[k], sides[k, of_block], total[of_block])
            changed = False
            for i in range(n):
                side = np.int8(total[i] > 0.0) - np.int8(total[i] < 0.0)
                changed |= side != outward[i]
                outward[i] = paths.outward[s - start, this_round, i] = side
            if not changed:
                paths.rounds[s - start] = this_round
                break
            other = _path_met(paths, s - start, this_round)
            if other >= 0:
                found.weights[s], found.outward[s] = found.weights[start + other], found.outward[start + other]
                found.agreed[s], found.known[s] = found.agreed[start + other], found.known[start + other]
                break
            paths.told[s - start] = this_round + 1
            largest = np.float32(_TINY)
            for k in range(n_places):
                net = known = np.float32(0.0)
                for block in range(n_blocks):
                    if sees[k, block]:
                        of_block = slice(block * _BLOCK, (block + 1) * _BLOCK)
                        more, more_known = _balance(sides[k, of_block], outward[of_block])
                        net, known = net + more, known + more_known
                found.agreed[s, k], found.known[s, k] = (net + known) / 2.0, known
                net = max(net, np.float32(0.0))
                weights[k] = math.sqrt(net) * (net / max(known, np.float32(_TINY))) ** 4
                largest = max(largest, weights[k])
            for k in range(n_places):
                weights[k] /= largest


def _most_telling(
    found: _Agreements,
    looks: _Looks,
    around: Neighbourhood,
    likely_counts: float,
    room_counts: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Weights of the places, (k,) float64, in the agreement that shows most of the surface; how much any shows.

    Crevices between things are crests from behind, which are seen the better: what little that is decides nothing.
    A crease is hidden by what is beside it, so cells count as shown beside shown ones; but not where an agreement is
    one of places closed in, as in a room: of that part all but narrow gaps is seen from within. Where that is no plain
    room, of which floor and ceiling tell, it is a tunnel or a gallery if its places show, creases and all, what others
    do not show: what was scanned had been seen, and whatever stands in a pipe is hidden from all who are outside.
    """
    visible = np.abs(looks.sides).sum(axis=1)
    different = np.array(list({outward.tobytes(): s for s, outward in enumerate(found.outward)}.values()))
    of_looks = found.weights[different].astype(np.float64)
    of_parts = (looks.of_part == np.arange(looks.part_of_cell.max() + 1)[:, None]).T.astype(np.float64)
    every, closed = of_looks @ of_parts, of_looks @ (of_parts * looks.closed[:, None])
    is_closed = ((closed >= _CLOSED * every) & (every > 0.0)).any(axis=0)[looks.part_of_cell]
    within = (closed >= _NEARLY_CLOSED * every) & (every > 0.0)
    rooms_count = within @ room_counts
    shown, contradicted = np.empty(len(different)), np.empty(len(different))
    sees, show = _seen_blocks(looks.sides), partial(in_blocks, _show, len(different), different, looks, smallest=1)
    if len(room_counts) == 1 and not room_counts.any() and np.count_nonzero(looks.closed >= _CLOSED) >= _FEW:
        show(sees, found, around, np.zeros_like(is_closed), shown, contradicted)
        by_places_within, by_others = (shown[some].max(initial=0.0) for some in (within[:, 0], ~within[:, 0]))
        rooms_count = _OF_ROOM * within[:, 0] * (by_places_within > by_others + _SEEN_WITHIN_ALONE)
    show(sees, found, around, is_closed, shown, contradicted)
    most_shown, most, best = float(shown.max()), -np.inf, found.weights[0]
    for s, fraction, of_rooms, against in zip(different, shown, rooms_count, contradicted, strict=True):
        weights, agreed, known = found.weights[s], found.agreed[s], found.known[s]
        score = min(float(fraction), most_shown - _AS_MUCH) + float(of_rooms) - max(float(against) - _LEFT_OPEN, 0.0)
        decided = np.abs(2.0 * agreed / np.maximum(known, _TINY) - 1.0)
        score += _DECIDED * float(decided[visible > 0.0].mean())
        for some, counts in ((looks.from_outside, _OUTSIDE_IN), (looks.likely, likely_counts)):
            score += counts * float(agreed[some].sum() / max(float(visible[some].sum()), _TINY))
        if score > most:
            most, best = score, weights
    return best.astype(np.float64), most_shown


@summing_routine
def _add_shown(
    weight: np.float32,
    sides: NDArray[np.float32],
    outward: NDArray[np.float32],
    is_flat: NDArray[np.bool_],
    shown: NDArray[np.float32],
) -> tuple[np.float32, np.float32]:
    """Add what a place sees of cells from their outer side, so many times, to a sum of that; and sums of what it sees,
    and of planes from behind."""
    seen = against = nothing = np.float32(0.0)
    for i in range(len(sides)):
        value = sides[i] * outward[i] if outward[i] != nothing else abs(sides[i])
        shown[i] += weight * max(value, nothing)
        seen += abs(value)
        against += max(-value, nothing) if is_flat[i] else nothing
    return seen, against


@kernel
def _show(
    start: int,
    stop: int,
    different: NDArray[np.int64],
    looks: _Looks,
    sees: NDArray[np.bool_],
    found: _Agreements,
    around: Neighbourhood,
    is_closed: NDArray[np.bool_],
    shown: NDArray[np.float64],
    contradicted: NDArray[np.float64],
) -> None:
    """Set the fraction of the cells that each of some agreements shows, or shows beside them unless closed in; and how
    much of what its places see are planes from behind.

    Of partitions, on which no place has a vote, either side counts.
    """
    sides, is_flat = looks.sides, looks.is_flat
    n_places, n = sides.shape
    of_cells, nothing = np.empty(n, np.float32), np.float32(0.0)
    for d in range(start, stop):
        weights, outward = found.weights[different[d]], found.outward[different[d]]
        for i in range(n):
            of_cells[i] = nothing
        seen = against = nothing
        for k in range(n_places):
            if weights[k] > 0.0:
                for block in range(sees.shape[1]):
                    if sees[k, block]:
                        of_block = slice(block * _BLOCK, (block + 1) * _BLOCK)
                        of_place, against_it = _add_shown(
                            weights[k], sides[k, of_block], outward[of_block], is_flat[of_block], of_cells[of_block]
                        )
                        seen, against = seen + weights[k] * of_place, against + weights[k] * against_it
        contradicted[d] = against / max(seen, np.float32(_TINY))
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

    So each of many rooms has one, also where its neighbours have places that see much of it through doors.
    """
    places = np.flatnonzero(weights > 0.0)
    left, sees = weights[places], seen[places].astype(np.float32)
    interest = np.ones(seen.shape[1], np.float32)
    chosen: list[int] = []
    while len(chosen) < _MOST_VIEWS and left.any():
        best = int(np.argmax(left * np.einsum("kn,n->k", sees, interest)))
        if len(chosen) >= _VIEWS and sees[best] @ interest < _NEWS * len(interest):
            break
        chosen.append(best)
        interest[sees[best] > 0.0] *= np.float32(0.25)
        left[best] = 0.0
    return places[chosen]


class CoarseGrid(NamedTuple):
    """Voxels in larger ones, c of them.

    Attributes
    ----------
    cells : VoxelGrid
        In the frame of `unit_frame`.
    points : (c,) float64
        How many points each holds.
    """

    cells: VoxelGrid
    points: NDArray[np.float64]


def coarse_grid(grid: VoxelGrid, middle: NDArray[np.float64], reach: float) -> CoarseGrid:
    """Voxels on surfaces in larger ones, as few as still show their shape, in the frame of `unit_frame`."""
    return _in_cells(_surfaces(grid, middle, reach), _CELLS)


class _Surfaces(NamedTuple):
    """Places on surfaces, about as far from each other as voxels of level 0 are.

    Attributes
    ----------
    places : (n, 3) float64, in the frame of `unit_frame`
    points : (n,) float64
        For how many each stands.
    width : float
        Edge of a voxel of level 0.
    """

    places: NDArray[np.float64]
    points: NDArray[np.float64]
    width: float


def _in_cells(surfaces: _Surfaces, cells: int) -> CoarseGrid:
    """Places on surfaces in about so many cells, twice as many at most, the outermost surfaces amid a layer of them."""
    places, points, width = surfaces
    size = width * max(1.0, math.sqrt(np.minimum(points, 1.0).sum() / (1.5 * cells)))  # as many as a surface would have
    low = bounding_box(places)[0]
    while True:
        coarse = voxel_grid(places, size, Shift(low - 0.5 * size))
        if coarse.n_voxels <= 2 * cells:
            return CoarseGrid(coarse, np.bincount(coarse.voxel_of_point, points, coarse.n_voxels).astype(np.float64))
        size *= 1.4


def _surfaces(grid: VoxelGrid, middle: NDArray[np.float64], reach: float) -> _Surfaces:
    """Means of voxels, and of larger ones as many places as these cover on their planes.

    Voxels that are not joined as on a surface have no sides to be seen, and ghosts far off would stretch the box in
    which places are tried: they do not count, unless most are such.
    """
    points, edges = np.diff(grid.starts).astype(np.float64), grid.edge_lengths
    counts = grid.joined
    if np.mean(counts) < _MOSTLY_SURFACES:
        counts[:] = True
    if grid.levels is None:
        size, some = float(edges[0] if edges.min() == edges.max() else np.median(edges)), np.flatnonzero(counts)
        return _Surfaces((grid.centroids.take(some, axis=0) - middle) / reach, points[some], size / reach)
    normals, places, held = either_normals(grid), [], []
    for level in np.unique(grid.levels):
        some, across = np.flatnonzero((grid.levels == level) & counts), 1 << int(level)
        ones, others = _along_planes(normals[some])
        steps = ((np.arange(across) + 0.5) / across - 0.5) * math.ldexp(grid.size, int(level))
        for one in steps:
            for other in steps:
                places.append(grid.centroids[some] + one * ones + other * others)
                held.append(points[some] / across**2)
    return _Surfaces((np.concatenate(places) - middle) / reach, np.concatenate(held), grid.size / reach)


def _along_planes(normals: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two unit vectors at right angles to each other and to each of n unit normals, (n, 3) each."""
    beside = np.zeros_like(normals)
    beside[np.arange(len(normals)), np.argmin(np.abs(normals), axis=1)] = 1.0
    ones = np.cross(normals, beside)
    ones /= lengths(ones)[:, None]
    return ones, np.cross(normals, ones)


def _parts(
    coarse: VoxelGrid, normals: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], list[tuple[NDArray[np.float64], NDArray[np.float64]]]]:
    """Parts of a cloud that are far from each other, the number of each cell's, (n,), the largest first, which has what
    belongs to none; and boxes in which nearly all of them lies, where the box of all is twice as long.

    A room of whose surroundings little was seen through its windows, or scans of places far apart: the three largest
    parts, and others that are rooms.
    """
    centres = coarse.centroids
    low, high = bounding_box(centres)
    part_of_cell, length = np.zeros(len(centres), np.int64), float((high - low).max())
    boxes: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    if not length > 0.0:
        return part_of_cell, boxes
    blocks = voxel_grid(centres, length / _BLOCKS, Shift(low))
    piece = connected_components(blocks.touching_pairs(), blocks.n_voxels)[blocks.voxel_of_point]
    counts, part = np.bincount(piece), 0
    for number in np.argsort(-counts, kind="stable")[:_PARTS]:
        cells = piece == number
        if counts[number] < _OF_PART * len(centres):
            break
        if part >= _PARTS_OF_ANY and not _is_room(cells, coarse, normals, points):
            continue
        part_of_cell[cells] = part
        part += 1
        lowest, highest = np.quantile(centres[cells], _NEARLY_WHOLE, axis=0)
        if (highest - lowest).max() < _SMALL * length:
            boxes.append((lowest, highest))
    return part_of_cell, boxes


def _is_room(
    cells: NDArray[np.bool_], coarse: VoxelGrid, normals: NDArray[np.float64], points: NDArray[np.float64]
) -> bool:
    """Whether some cells of the coarse grid are a room that tripods stood in."""
    return is_scanned_room(coarse.centroids[cells], normals[cells], points[cells], coarse.size)


def _smallest_box(
    centres: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner of a box around places, in its own frame, and its axes, rows of (3, 3).

    The bounding box; or one along the principal axes, where that is much smaller, as around a corridor askew.
    """
    low, high = bounding_box(centres)
    offsets = centres - centres.mean(axis=0)
    axes = np.linalg.eigh(np.einsum("ij,ik->jk", offsets, offsets))[1].T
    lowest, highest = bounding_box(np.einsum("ij,kj->ik", centres, axes))
    if np.prod(highest - lowest) < _MUCH_SMALLER * np.prod(high - low):
        return lowest, highest, axes
    return low, high, np.eye(3)


def _free_places(
    coarse: VoxelGrid, low: NDArray[np.float64], high: NDArray[np.float64], axes: NDArray[np.float64], finer: int
) -> NDArray[np.float64]:
    """Places within a box along axes, the farthest off all surfaces first, (k, 3); so many times as many as usual."""
    from scipy.spatial import cKDTree

    n, lattice_side = finer * _INSIDE, round(_LATTICE * finer ** (1.0 / 3.0))
    steps = (np.arange(lattice_side) + 0.5) / lattice_side
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    places = np.einsum("ij,jk->ik", low + lattice * (high - low), axes)
    tree = cKDTree(coarse.centroids, 64, balanced_tree=False, compact_nodes=False)  # for few places
    clearance = tree.query(places)[0] / coarse.size
    free = np.flatnonzero(clearance > _CLEARANCE)
    if not len(free):
        return places[:0]
    places, clearance = places[free], clearance[free]
    hits = hit_fractions(places, coarse.centroids[:: max(1, coarse.n_voxels // _SOME)])
    among = np.flatnonzero(hits >= _AMONG * hits.max())  # not the corners of the box around a room askew to it
    chosen = among[farthest_first(places[among], int(np.argmax(clearance[among])), int(_SPREAD * n))]
    order = np.argsort(-clearance, kind="stable")
    rest = order[~np.isin(order, chosen)][: n - len(chosen)]
    return places[np.concatenate((chosen, rest))]
