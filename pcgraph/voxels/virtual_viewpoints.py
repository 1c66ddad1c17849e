# SPDX-License-Identifier: Apache-2.0
"""Virtual viewpoints around and within a cloud, and which of them agree on the outer side of its surfaces.

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
from pcgraph.voxels.depth_buffer import facing_cosines, hit_fractions, visibility_from
from pcgraph.voxels.directions import sphere_directions
from pcgraph.voxels.grid import Neighbourhood, VoxelGrid, voxel_grid
from pcgraph.voxels.ground_and_rooms import LEVEL, is_scanned_room, supporting_plane
from pcgraph.voxels.sampling import farthest_points
from pcgraph.voxels.surface import Windows, fitted_windows
from pcgraph.voxels.warp import Shift

# Lengths are edges of coarse cells, and places those of viewpoints, where nothing else is said.
_CELLS = 5000  # of the coarse grid on which viewpoints are compared, about
_MIN_ON_SURFACES = 0.5  # fraction of the voxels that are joined; else those that are not count as well
_FINER = (
    1,
    2,
    4,
)  # times as many cells and viewpoints, where there are rooms, until one agreement shows
_SHOWS_MOST, _SHOWS_NEARLY_ALL = 0.85, 0.95  # of the surface; the latter where rooms are low,
_MIN_LAYERS, _MAX_HEIGHT = 1.7, 8.0  # of so many cells over each other on average, and no higher than so many in all
# Candidates
_N_OUTSIDE = 42  # places around the cloud
_OUTSIDE_DISTANCE = 1.3  # from its middle, in half diagonals of its bounding box
_N_INSIDE = 64  # free places within it, of a lattice of
_LATTICE_SIDE = 12  # places along each side
_MIN_CLEARANCE = 2.0  # of a free place from the next surface
_SPREAD_FRACTION = 0.75  # of the free places are far from each other, the others far from surfaces
_MIN_SURROUNDED = 0.8  # of the directions that hit something, over the most of any place
_SAMPLED_CELLS = 1500  # which these are tested against, about
_MAX_TURNED_BOX = 0.2  # volume of a box along the principal axes, over the bounding box's, for it to be used
_CLOSED = 0.96  # fraction of the directions that hit something, of a place in a room
_MIN_IN_ROOMS = 16  # such places, for there to be rooms
# Parts far from each other
_BLOCKS_ALONG = 16  # blocks along the bounding box: parts have an empty one between them
_MIN_PART = 0.05  # fraction of the cells
_MAX_PARTS, _MAX_ROOMS = 3, 8  # of any kind; and if all beyond these are rooms
_PART_QUANTILES = 0.05, 0.95  # of a part's cells, between which candidates are placed
_MAX_PART_LENGTH = 0.5  # of the bounding box's length, for a part to have candidates of its own
# Agreements
_ROUNDS = 12  # of voting and weighting, at most
_N_HALVES = 14  # half spaces, whose outer candidates are first opinions
_BOTH_SIDES = 0.2  # cosine under which candidates in rooms see both sides of a partition
_WELL_SEEN = 0.3  # weighted sum of cosines from which on a cell is seen well
_MAX_OFF_PLANE = 0.1  # RMS distance of a flat cell and those around it from their plane
_CELLS_PER_BLOCK = 512  # for speed: of many rooms a candidate sees few blocks
# Score of an agreement: the fraction of the surface that it shows, differences up to _SHOWN_TOLERANCE ignored, plus
_SHOWN_TOLERANCE = 0.004
_W_UNANIMOUS = 0.02  # times how unanimous its viewpoints are
_W_OUTSIDE = 0.003  # times how much those around the cloud see from its outer side
_W_ORIGIN, _W_ABOVE_GROUND, _W_FREE_SIDE = 0.02, 0.05, 0.002  # times the same of the likely ones: the origin; those
# above the ground; or those on the free side of another supporting plane
_W_ROOM = 0.2  # times the fraction of the cells in a room (in a passage 1), if its viewpoints are closed in:
_ENCLOSED_FOR_ROOM = 0.8  # weighted mean of the fraction of directions that hit something
_MIN_SHOWN_FROM_INSIDE = 0.001  # fraction of the surface that such viewpoints show more, to count so in a passage
_MAX_FROM_BEHIND = 0.02  # fraction of what it sees that may be planes from behind; what is more is taken off
# The origin as a camera's place
_MAX_SLOPE = 1.2  # tangent off the optical axis, along x and y, within which all lies,
_MIN_SLOPE = 0.2  # and beyond which a tenth lies
_MIN_SEEN_OF_OPPOSITE = 0.93  # what it sees over what its mirror image sees, on the other side of the supporting plane
# Viewpoints that are chosen
_MIN_CHOSEN, _MAX_CHOSEN = 12, 128  # the latter while each
_MIN_GAIN = 0.005  # of all cells is first to see, or second to see four times as much
_TINY = 1e-12


class VirtualViewpoints(NamedTuple):
    """Viewpoints from which the outside is seen, by decreasing weight.

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


def virtual_viewpoints(grid: VoxelGrid) -> VirtualViewpoints:
    """Viewpoints that tell which side of the voxels' surface is its outside.

    Of many rooms, whose partitions are thin and which hold few places each, more are looked at, through smaller cells;
    and where floors and ceilings lie near to each other for cells of that size, so that hardly a place is in a room.
    """
    middle, reach = unit_frame(grid, grid.centroids)
    surfaces = _surfaces(grid, middle, reach)
    for finer in _FINER:
        coarse, points = _in_cells(surfaces, finer * _CELLS)
        may_be_finer = finer < _FINER[-1] and coarse.n_voxels <= grid.n_voxels // 2
        windows = _windows(coarse)
        candidates, part_of_cell = _candidates(coarse, points, windows.normals, -middle / reach, finer)
        is_layered, n_in_rooms = _is_layered(coarse), np.count_nonzero(candidates.enclosure >= _CLOSED)
        if may_be_finer and is_layered and n_in_rooms < _MIN_IN_ROOMS:
            continue  # low rooms have few places at first, and the outside of all of them shows much
        viewpoints, shown = _vote(coarse, points, windows, candidates, part_of_cell)
        shows_most = shown >= (_SHOWS_NEARLY_ALL if is_layered else _SHOWS_MOST) or not (is_layered or n_in_rooms)
        if shows_most or not may_be_finer:
            break
    return viewpoints


def _vote(
    coarse: VoxelGrid,
    points: NDArray[np.float64],
    windows: Windows,
    candidates: _Candidates,
    part_of_cell: NDArray[np.int64],
) -> tuple[VirtualViewpoints, float]:
    """The candidates that agree best, and how much of the surface any agreement of them shows."""
    normals, is_flat = windows.normals, windows.residuals <= (_MAX_OFF_PLANE * coarse.size) ** 2
    seen = visibility_from(candidates.places, coarse.centroids, coarse.edge_lengths, normals)
    sides = facing_cosines(candidates.places, coarse.centroids, normals, seen)
    in_rooms = candidates.enclosure >= _CLOSED
    voting = _without_partitions(sides, sides[in_rooms])
    starts = _starts(candidates.places[:_N_OUTSIDE], candidates.likely, in_rooms)
    of_place, of_part = _looks_at_parts(seen, part_of_cell)
    if of_part.any():
        asked = of_part[:, None] == part_of_cell
        seen, sides, voting = (np.where(asked, every[of_place], every.dtype.type(0)) for every in (seen, sides, voting))
    found = _agreements(voting, np.ascontiguousarray(starts[:, of_place]))
    from_outside, likely, enclosure = of_place < _N_OUTSIDE, candidates.likely[of_place], candidates.enclosure[of_place]
    looks = _Looks(sides, from_outside, likely, enclosure, of_part, part_of_cell, is_flat)
    room_scores, has_rooms = np.zeros(int(part_of_cell.max()) + 1), np.count_nonzero(in_rooms) >= _MIN_IN_ROOMS
    for part in range(len(room_scores) if has_rooms else 0):
        cells = part_of_cell == part
        room_scores[part] = _W_ROOM * np.mean(cells) * _is_room(cells, coarse, normals, points)
    may_be_passage = bool(has_rooms) and len(room_scores) == 1 and not room_scores.any()
    around, likely_weight = coarse.neighbourhood, candidates.likely_weight
    weights, shown = _best_agreement(found, looks, around, likely_weight, room_scores, may_be_passage)
    chosen = _spread_choice(seen, weights)
    places = candidates.places[of_place[chosen]]
    return VirtualViewpoints(places, weights[chosen], of_part[chosen], coarse.centroids, part_of_cell), shown


class _Candidates(NamedTuple):
    """Places from which a cloud may have been seen: k of them, the first around it.

    Attributes
    ----------
    places : (k, 3) float64, in the frame of `unit_frame`
    enclosure : (k,) float64
        Fraction of the directions in which a place within has something; 0 of others.
    likely : (k,) bool
        The origin, if all was seen from about there; else those around that are before what bears things.
    likely_weight : float
        What it counts where as much is seen.
    """

    places: NDArray[np.float64]
    enclosure: NDArray[np.float64]
    likely: NDArray[np.bool_]
    likely_weight: float


def _candidates(
    coarse: VoxelGrid,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    origin: NDArray[np.float64],
    finer: int,
) -> tuple[_Candidates, NDArray[np.int64]]:
    """Places around the coarse grid, and within, there so many times as many as usual; and the part of each cell."""
    low, high = bounding_box(coarse.centroids)
    part_of_cell, boxes = _parts(coarse, normals, points)
    share, upright = max(finer // (len(boxes) + 1), 1), np.eye(3)
    in_boxes = np.concatenate([low[None][:0], *(_free_viewpoints(coarse, *box, upright, share) for box in boxes)])
    in_boxes = in_boxes[hit_fractions(in_boxes, coarse.centroids) >= _CLOSED]
    if len(in_boxes) < _MIN_IN_ROOMS:  # none of the parts is a room
        part_of_cell[:], in_boxes = 0, in_boxes[:0]
    inside = np.concatenate((_free_viewpoints(coarse, *_smallest_box(coarse.centroids), share), in_boxes))
    directions = sphere_directions(_N_OUTSIDE)
    outside = (low + high) / 2.0 + _OUTSIDE_DISTANCE * lengths((high - low)[None]) / 2.0 * directions
    if not (high > low).any():
        outside = low + directions
    upwards, offset, is_ground = supporting_plane(coarse, normals)
    sees = origin @ upwards >= offset and _has_in_view(origin, coarse.centroids)
    is_camera = sees and (abs(upwards[2]) < LEVEL or _sees_as_much(origin, upwards, coarse, normals))
    if not is_camera and upwards[2] < -LEVEL:  # no accident: the frame stands upright, and things lie in a pit
        upwards = -upwards
    places = np.concatenate((outside, inside))
    enclosure = np.concatenate((np.zeros(_N_OUTSIDE), hit_fractions(inside, coarse.centroids)))
    if is_camera:
        places, enclosure = np.concatenate((places, origin[None])), np.append(enclosure, 0.0)
        likely = np.arange(len(places)) == len(places) - 1
        return _Candidates(places, enclosure, likely, _W_ORIGIN), part_of_cell
    likely = np.zeros(len(places), np.bool_)
    likely[:_N_OUTSIDE] = directions @ upwards > 0.0
    return _Candidates(places, enclosure, likely, _W_ABOVE_GROUND if is_ground else _W_FREE_SIDE), part_of_cell


class _Looks(NamedTuple):
    """Looks of k places at n cells, or at those of one part.

    Attributes
    ----------
    sides : (k, n) float32
        Signed cosines, 0 hidden.
    from_outside, likely : (k,) bool
        Whether they are those of places around the cloud, and of places before what bears things or of the origin.
    enclosure : (k,) float64
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
    enclosure: NDArray[np.float64]
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
    return bool(coarse.n_voxels >= _MIN_LAYERS * len(columns) and (high - low)[thin] < _MAX_HEIGHT * coarse.size)


def _without_partitions(sides: NDArray[np.float32], of_rooms: NDArray[np.float32]) -> NDArray[np.float32]:
    """The sides that places see, (k, n), but of partitions: cells of which those in rooms see both.

    A cell is thicker than a partition, so that the rooms on either side of it would contradict each other.
    """
    if not len(of_rooms):
        return sides
    front, back = np.maximum(of_rooms, 0.0).max(axis=0), np.maximum(-of_rooms, 0.0).max(axis=0)
    return np.where(np.minimum(front, back) > _BOTH_SIDES, np.float32(0.0), sides)


def _starts(
    outside: NDArray[np.float64], likely: NDArray[np.bool_], in_rooms: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Weights of the places, (s, k), from which agreement may start: first opinions as different as there are."""
    starts = np.zeros((_N_HALVES + 4, len(likely)), np.float32)
    starts[:_N_HALVES, :_N_OUTSIDE] = sphere_directions(_N_HALVES) @ (outside - outside.mean(axis=0)).T > 0.0
    starts[_N_HALVES, :_N_OUTSIDE] = 1.0
    starts[_N_HALVES + 1, _N_OUTSIDE:] = 1.0
    starts[_N_HALVES + 2] = likely
    starts[_N_HALVES + 3] = in_rooms if np.count_nonzero(in_rooms) >= _MIN_IN_ROOMS else 0.0
    return starts[starts.any(axis=1)]


def _has_in_view(place: NDArray[np.float64], centres: NDArray[np.float64]) -> bool:
    """Whether all lies before a camera at a place, (3,), that looks along z, around its axis, and not all near that."""
    rays = centres - place
    if not (rays[:, 2] > 0.0).all():
        return False
    slopes = rays[:, :2] / rays[:, 2:]
    is_around = (slopes.min(axis=0) < 0.0).all() and (slopes.max(axis=0) > 0.0).all()
    aside = np.abs(slopes).max(axis=1)
    return bool(is_around and aside.max() < _MAX_SLOPE and np.mean(aside > _MIN_SLOPE) > 0.1)


def _sees_as_much(
    place: NDArray[np.float64], upwards: NDArray[np.float64], coarse: VoxelGrid, normals: NDArray[np.float64]
) -> bool:
    """Whether nearly as much is visible from a place as from its mirror image on the other side of all.

    Below a pit, that is seen from above, its floor hides its walls.
    """
    low, high = bounding_box(coarse.centroids)
    opposite = place - 2.0 * ((place - (low + high) / 2.0) @ upwards) * upwards
    seen = visibility_from(np.stack((place, opposite)), coarse.centroids, coarse.edge_lengths, normals).mean(axis=1)
    return bool(seen[0] >= _MIN_SEEN_OF_OPPOSITE * seen[1])


@kernel
def _see_blocks(start: int, stop: int, sides: NDArray[np.float32], sees: NDArray[np.bool_]) -> None:
    """Set whether each place sees any cell of each block."""
    n, nothing = sides.shape[1], np.float32(0.0)
    for k in range(start, stop):
        for block in range(sees.shape[1]):
            some = False
            for i in range(block * _CELLS_PER_BLOCK, min((block + 1) * _CELLS_PER_BLOCK, n)):
                some |= sides[k, i] != nothing
            sees[k, block] = some


def _seen_blocks(sides: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether k places, whose sides of n cells are 0 where hidden, (k, n), see any cell of each block, (k, b)."""
    sees = np.empty((len(sides), -(-sides.shape[1] // _CELLS_PER_BLOCK)), np.bool_)
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


@routine
def _vote_on_sides(
    weights: NDArray[np.float32],
    sides: NDArray[np.float32],
    sees: NDArray[np.bool_],
    total: NDArray[np.float32],
    outward: NDArray[np.float32],
) -> bool:
    """Let viewpoints vote, by their weights, on the side on which the outside of each cell lies; whether any changed.

    `total` is scratch.
    """
    n_places, n_blocks = sees.shape
    for i in range(len(total)):
        total[i] = 0.0
    for k in range(n_places):
        if weights[k] > 0.0:
            for block in range(n_blocks):
                if sees[k, block]:
                    of_block = slice(block * _CELLS_PER_BLOCK, (block + 1) * _CELLS_PER_BLOCK)
                    _add(weights[k], sides[k, of_block], total[of_block])
    changed = False
    for i in range(len(total)):
        side = np.float32(total[i] > 0.0) - np.float32(total[i] < 0.0)
        changed |= side != outward[i]
        outward[i] = side
    return changed


@routine
def _weigh_by_agreement(
    sides: NDArray[np.float32], sees: NDArray[np.bool_], outward: NDArray[np.float32], found: _Agreements, s: int
) -> None:
    """Weigh each viewpoint by how much it sees and how far that agrees with the vote, the largest weight being 1."""
    n_places, n_blocks = sees.shape
    weights, largest = found.weights[s], np.float32(_TINY)
    for k in range(n_places):
        net = known = np.float32(0.0)
        for block in range(n_blocks):
            if sees[k, block]:
                of_block = slice(block * _CELLS_PER_BLOCK, (block + 1) * _CELLS_PER_BLOCK)
                more, more_known = _balance(sides[k, of_block], outward[of_block])
                net, known = net + more, known + more_known
        found.agreed[s, k], found.known[s, k] = (net + known) / 2.0, known
        net = max(net, np.float32(0.0))
        weights[k] = math.sqrt(net) * (net / max(known, np.float32(_TINY))) ** 4
        largest = max(largest, weights[k])
    for k in range(n_places):
        weights[k] /= largest


@kernel
def _agree(start: int, stop: int, sides: NDArray[np.float32], sees: NDArray[np.bool_], found: _Agreements) -> None:
    """Alternate until nothing changes: viewpoints vote on the outer side of each cell, then each is weighed by how far
    it agrees with the vote."""
    n = sides.shape[1]
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
            changed = _vote_on_sides(weights, sides, sees, total, outward)
            for i in range(n):
                paths.outward[s - start, this_round, i] = np.int8(outward[i])
            if not changed:
                paths.rounds[s - start] = this_round
                break
            other = _path_met(paths, s - start, this_round)
            if other >= 0:
                found.weights[s], found.outward[s] = found.weights[start + other], found.outward[start + other]
                found.agreed[s], found.known[s] = found.agreed[start + other], found.known[start + other]
                break
            paths.told[s - start] = this_round + 1
            _weigh_by_agreement(sides, sees, outward, found, s)


def _best_agreement(
    found: _Agreements,
    looks: _Looks,
    around: Neighbourhood,
    likely_weight: float,
    room_scores: NDArray[np.float64],
    may_be_passage: bool,
) -> tuple[NDArray[np.float64], float]:
    """Weights of the viewpoints, (k,) float64, in the agreement of the highest score; how much any agreement shows.

    Crevices between things are crests from behind, which are seen the better: what little that is decides nothing.
    A crease is hidden by what is beside it, so cells count as shown beside shown ones; but not where an agreement is
    one of viewpoints in a room: of that part all but narrow gaps is seen from within. A room's floor and ceiling tell
    that it is one. A passage, such as a tunnel or a gallery, has none that tell, and is one if viewpoints within show,
    creases and all, what others do not: what was scanned had been seen, and what stands in a pipe is hidden from all
    who are outside.
    """
    different = np.array(list({outward.tobytes(): s for s, outward in enumerate(found.outward)}.values()))
    weights = found.weights[different].astype(np.float64)
    of_parts = (looks.of_part == np.arange(looks.part_of_cell.max() + 1)[:, None]).T.astype(np.float64)
    total, enclosure = weights @ of_parts, weights @ (of_parts * looks.enclosure[:, None])
    is_closed = ((enclosure >= _CLOSED * total) & (total > 0.0)).any(axis=0)[looks.part_of_cell]
    is_within = (enclosure >= _ENCLOSED_FOR_ROOM * total) & (total > 0.0)
    show = partial(_shown, different, looks, _seen_blocks(looks.sides), found, around)
    shown, from_behind = show(is_closed)
    within = is_within @ room_scores
    if may_be_passage:
        with_creases, inside = show(np.zeros_like(is_closed))[0], is_within[:, 0]
        alone = with_creases[inside].max(initial=0.0) > with_creases[~inside].max(initial=0.0) + _MIN_SHOWN_FROM_INSIDE
        within = _W_ROOM * inside * alone
    most_shown = float(shown.max())
    scores = np.minimum(shown, most_shown - _SHOWN_TOLERANCE) + within - np.maximum(from_behind - _MAX_FROM_BEHIND, 0.0)
    visible = np.abs(looks.sides).sum(axis=1)
    if not visible.any():
        return weights[0], most_shown
    agreed, known = found.agreed[different], found.known[different]
    unanimous = np.abs(2.0 * agreed / np.maximum(known, _TINY) - 1.0)
    scores += _W_UNANIMOUS * unanimous[:, visible > 0.0].mean(axis=1)
    for some, weight in ((looks.from_outside, _W_OUTSIDE), (looks.likely, likely_weight)):
        scores += weight * agreed[:, some].sum(axis=1) / max(float(visible[some].sum()), _TINY)
    return weights[int(np.argmax(scores))], most_shown


def _shown(
    different: NDArray[np.int64],
    looks: _Looks,
    sees: NDArray[np.bool_],
    found: _Agreements,
    around: Neighbourhood,
    is_closed: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What `_show` sets for some of the agreements, (d,) each."""
    shown, from_behind = np.empty(len(different)), np.empty(len(different))
    in_blocks(_show, len(different), different, looks, sees, found, around, is_closed, shown, from_behind, smallest=1)
    return shown, from_behind


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
                        of_block = slice(block * _CELLS_PER_BLOCK, (block + 1) * _CELLS_PER_BLOCK)
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
    while len(chosen) < _MAX_CHOSEN and left.any():
        best = int(np.argmax(left * np.einsum("kn,n->k", sees, interest)))
        if len(chosen) >= _MIN_CHOSEN and sees[best] @ interest < _MIN_GAIN * len(interest):
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
    if np.mean(counts) < _MIN_ON_SURFACES:
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
    blocks = voxel_grid(centres, length / _BLOCKS_ALONG, Shift(low))
    piece = connected_components(blocks.touching_pairs(), blocks.n_voxels)[blocks.voxel_of_point]
    counts, part = np.bincount(piece), 0
    for number in np.argsort(-counts, kind="stable")[:_MAX_ROOMS]:
        cells = piece == number
        if counts[number] < _MIN_PART * len(centres):
            break
        if part >= _MAX_PARTS and not _is_room(cells, coarse, normals, points):
            continue
        part_of_cell[cells] = part
        part += 1
        lowest, highest = np.quantile(centres[cells], _PART_QUANTILES, axis=0)
        if (highest - lowest).max() < _MAX_PART_LENGTH * length:
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
    if np.prod(highest - lowest) < _MAX_TURNED_BOX * np.prod(high - low):
        return lowest, highest, axes
    return low, high, np.eye(3)


def _free_viewpoints(
    coarse: VoxelGrid, low: NDArray[np.float64], high: NDArray[np.float64], axes: NDArray[np.float64], finer: int
) -> NDArray[np.float64]:
    """Places within a box along axes, the farthest off all surfaces first, (k, 3); so many times as many as usual."""
    from scipy.spatial import cKDTree

    n, lattice_side = finer * _N_INSIDE, round(_LATTICE_SIDE * finer ** (1.0 / 3.0))
    steps = (np.arange(lattice_side) + 0.5) / lattice_side
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    places = np.einsum("ij,jk->ik", low + lattice * (high - low), axes)
    tree = cKDTree(coarse.centroids, 64, balanced_tree=False, compact_nodes=False)  # for few places
    clearance = tree.query(places)[0] / coarse.size
    free = np.flatnonzero(clearance > _MIN_CLEARANCE)
    if not len(free):
        return places[:0]
    places, clearance = places[free], clearance[free]
    hits = hit_fractions(places, coarse.centroids[:: max(1, coarse.n_voxels // _SAMPLED_CELLS)])
    among = np.flatnonzero(hits >= _MIN_SURROUNDED * hits.max())  # not the corners of the box around a room askew to it
    chosen = among[farthest_points(places[among], int(np.argmax(clearance[among])), int(_SPREAD_FRACTION * n))]
    order = np.argsort(-clearance, kind="stable")
    rest = order[~np.isin(order, chosen)][: n - len(chosen)]
    return places[np.concatenate((chosen, rest))]
