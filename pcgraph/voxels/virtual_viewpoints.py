# SPDX-License-Identifier: Apache-2.0
"""Virtual viewpoints around and within a cloud, and which of them agree on the outer side of its surfaces.

A scanner stood in free space, and it saw all that it measured. So candidate viewpoints (here: places) around and within
the cloud are tried. Places from which much of the cloud is visible, always from the same side, tell the outer side.

Words of this module:

cell
    A voxel of a coarse grid. Places are compared by the cells that they see.
side
    Signed cosine between the normal of a cell and the direction to a place; 0 where the place does not see the cell.
agreement
    A weight for each place, and an outer side for each cell, that fit each other: the weighted places vote for these
    outer sides, and each weight follows from how well its place agrees with the vote.
enclosure
    Fraction of all directions in which a place sees something; nearly 1 in a closed room.
partition
    A thin wall between two rooms, of which both sides were scanned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.parallel import in_blocks, kernel, routine, summing_routine
from pcgraph.rounding import NEARLY_ZERO
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.depth_buffer import facing_cosines, hit_fractions, visibility_from
from pcgraph.voxels.directions import sphere_directions
from pcgraph.voxels.grid import Neighbourhood, VoxelGrid, voxel_grid
from pcgraph.voxels.ground_and_rooms import LEVEL, is_scanned_room, supporting_plane
from pcgraph.voxels.sampling import farthest_points
from pcgraph.voxels.surface import Windows, fitted_windows
from pcgraph.voxels.warp import Shift

# Thresholds without a reason were chosen by eye and not varied. A gain is the mean of all scores, less the mean without
# the term (docs/pcgraph_experiments.md).


@dataclass(frozen=True)
class ResolutionThresholds:
    """Resolution of the coarse grid on which places are compared.

    Cells are thicker than partitions, and as high as low rooms. So where there are rooms, a finer grid with more places
    is tried until one agreement shows most of the surface. Without this a law fails: floors and ceilings of rooms side
    by side face inwards.
    """

    cells: int = 5000  # count, about: time grows with it
    finer: tuple[int, ...] = (1, 2, 4)  # times as many cells and inner places, one after the other
    shows_most: float = 0.85  # fraction of the surface: no finer grid is tried from here on
    shows_nearly_all: float = 0.95  # the same for layered clouds, whose outside alone shows much
    min_layers: float = 1.7  # mean number of cells over each other from which on a cloud may be layered
    max_height: float = 8.0  # cell edges: a higher cloud is not layered
    min_joined: float = 0.5  # fraction of the voxels: if fewer are joined, voxels that are not joined count as well


@dataclass(frozen=True)
class CandidateThresholds:
    """Numbers and positions of candidate viewpoints."""

    n_outside: int = 42  # places around the cloud; three times as many mend trucks, but turn reliefs and trenches
    outside_distance: float = 1.3  # from the middle of the bounding box, in half diagonals of it
    n_inside: int = 64  # free places within the bounding box
    lattice_side: int = 12  # places along each side of the lattice of which these are chosen
    min_clearance: float = 2.0  # cell edges from a free place to the next surface, at least
    spread_fraction: float = 0.75  # fraction of them that lie far from each other; the others lie far from surfaces
    min_surrounded: float = 0.8  # least enclosure over the largest of any place: others lie in corners; gain 0.0091
    sampled_cells: int = 1500  # cells by which enclosure is measured then, about
    max_turned_box: float = 0.2  # a box along the principal axes is used below this fraction of the volume; gain 0.0049
    min_enclosure: float = 0.96  # of a place that is closed in: at most 2 of the 64 bins of directions are empty
    min_in_rooms: int = 16  # closed-in places from which on the cloud has rooms


@dataclass(frozen=True)
class PartThresholds:
    """Conditions for parts of a cloud to lie far from each other, so that each has places of its own."""

    blocks_along: int = 16  # blocks along the bounding box: parts have an empty one between them
    min_fraction: float = 0.05  # fraction of the cells
    max_parts: int = 3  # parts of any kind, at most
    max_rooms: int = 8  # pieces that are asked: beyond `max_parts` they are parts only if they are rooms
    quantiles: tuple[float, float] = (0.05, 0.95)  # of a part's cells along each axis: its candidates lie between
    max_length: float = 0.5  # a longer part, in lengths of the bounding box, has no candidates of its own


@dataclass(frozen=True)
class AgreementThresholds:
    """Starts of agreements, and conditions for the cells that their places judge."""

    n_halves: int = 14  # half spaces; the places around the cloud in one of them start together
    both_sides: float = 0.2  # cosine from which on closed-in places see either side of a cell: it is a partition
    max_off_plane: float = 0.1  # cell edges, rms distance of a cell and those around it from their plane: it is flat


@dataclass(frozen=True)
class ScoreThresholds:
    """Weights and thresholds of an agreement's score, which starts with the fraction of the surface that it shows.

    All weights are fractions of the surface, too.
    """

    shown_tolerance: float = 0.004  # a difference below that does not count; gain 0.0060, all of it on one street
    unanimous: float = 0.02  # weight of how far each place sees one side only; gain 0.0076
    outside: float = 0.003  # weight of how much the places around the cloud see from its outer side
    origin: float = 0.02  # weight of how much likely places see so, if the frame's origin is likely
    above_ground: float = 0.05  # the same for places above the ground; more than what a pit and a mound differ in shown
    free_side: float = 0.002  # the same for places on the free side of another supporting plane; gain 0.0042
    room: float = 0.2  # weight of the fraction of the cells in a room (1 in a passage), for an enclosed agreement
    enclosed_for_room: float = 0.8  # weighted mean enclosure of the places of an enclosed agreement, at least
    min_shown_from_inside: float = 0.001  # fraction of the surface that enclosed agreements show more, in a passage
    max_from_behind: float = 0.02  # fraction of flat cells seen from behind: right ones have 0.014, wrong ones 0.045


@dataclass(frozen=True)
class CameraThresholds:
    """Conditions for the frame's origin to be the place of a camera that looks along z."""

    max_slope: float = 1.2  # tangent of the angle off the axis, along x and y: all lies within
    min_slope: float = 0.2  # the same tangent: some of the cells lie beyond, else the origin is merely far off
    min_beyond: float = 0.1  # fraction of the cells: so many lie beyond
    min_seen_of_opposite: float = 0.93  # visible there over visible from its mirror image: pits 0.70-0.92, walls 0.94


@dataclass(frozen=True)
class ChoiceThresholds:
    """Choice of the places of the best agreement from which the voxels are looked at."""

    min_chosen: int = 12  # places
    max_chosen: int = 128  # places: time grows with it
    min_gain: float = 0.005  # fraction of the cells that the next place has to see anew
    seen_again: float = 0.25  # factor by which a cell counts less each time it is seen: so each room has a place


_RESOLUTION = ResolutionThresholds()
_CANDIDATES = CandidateThresholds()
_PART = PartThresholds()
_AGREEMENT = AgreementThresholds()
_SCORE = ScoreThresholds()
_CAMERA = CameraThresholds()
_CHOICE = ChoiceThresholds()

_ROUNDS = 12
"""Count of rounds of voting and weighting, at most; chosen by eye, not varied."""
_WELL_SEEN = 0.3
"""Weighted sum of cosines from which on a cell counts as shown in full; chosen by eye, not varied."""
_CELLS_PER_BLOCK = 512
"""Count of cells passed over at once if a place sees none, as in one of many rooms; chosen by eye, for speed."""


class VirtualViewpoints(NamedTuple):
    """Viewpoints from which the outside is seen, by decreasing weight.

    Attributes
    ----------
    places : (k, 3) float64, in half extents of the voxels' centroids from the middle of their bounding box
    weights : (k,) float64, 0..1
        Weight of each viewpoint in the vote on the outer side.
    parts : (k,) int64
        Part of the cloud that each viewpoint is used for. A place that is used for several parts is listed once for
        each.
    cells : (c, 3) float64
        Centres of the coarse cells, in the frame of `places`.
    part_of_cell : (c,) int64
        Part of the cloud that each cell belongs to.
    """

    places: NDArray[np.float64]
    weights: NDArray[np.float64]
    parts: NDArray[np.int64]
    cells: NDArray[np.float64]
    part_of_cell: NDArray[np.int64]

    def part_of(self, centres: NDArray[np.float64]) -> NDArray[np.int64]:
        """Part of the cloud that each of n places, (n, 3) in the same frame, belongs to, (n,): its nearest cell's."""
        from scipy.spatial import cKDTree

        return self.part_of_cell[cKDTree(self.cells).query(centres)[1]]


def unit_frame(grid: VoxelGrid, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Origin, (3,), and unit of length of a frame in which the coordinates of places lie within -1..1.

    The origin is the middle of their bounding box; the unit is half of its longest side, or a voxel edge if that is
    more.
    """
    low, high = bounding_box(places)
    return (low + high) / 2.0, max(float((high - low).max()) / 2.0, float(grid.edge_lengths.min()))


def either_normals(grid: VoxelGrid) -> NDArray[np.float64]:
    """Unit normal of the surface at each voxel, (v, 3); which of its two sides it points to is arbitrary."""
    return _windows(grid).normals


def _windows(grid: VoxelGrid) -> Windows:
    """The plane through each voxel and those around it; which side its normal points to is arbitrary."""
    upwards = np.zeros((grid.n_voxels, 3))
    upwards[:, 2] = 1.0
    return fitted_windows(grid, upwards)


def lengths(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of n rows, (n,), which are of the order of 1; at least `NEARLY_ZERO`, so that they can be divided by."""
    return np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), NEARLY_ZERO)


def virtual_viewpoints(grid: VoxelGrid) -> VirtualViewpoints:
    """Viewpoints that tell which side of the voxels' surface is its outside.

    In a cloud of many rooms, partitions are thinner than a cell and few places lie in each room; in a low storey, few
    places lie between floor and ceiling. Such clouds are looked at again with smaller cells and more places, until one
    agreement shows most of the surface.
    """
    middle, reach = unit_frame(grid, grid.centroids)
    surfaces = _surfaces(grid, middle, reach)
    for finer in _RESOLUTION.finer:
        coarse, points = _in_cells(surfaces, finer * _RESOLUTION.cells)
        may_be_finer = finer < _RESOLUTION.finer[-1] and coarse.n_voxels <= grid.n_voxels // 2
        windows = _windows(coarse)
        candidates, part_of_cell = _candidates(coarse, points, windows.normals, -middle / reach, finer)
        is_layered, n_in_rooms = _is_layered(coarse), np.count_nonzero(candidates.is_closed_in)
        if may_be_finer and is_layered and n_in_rooms < _CANDIDATES.min_in_rooms:
            continue  # low rooms hold few places in large cells, and places around all of them see much
        viewpoints, shown = _vote(coarse, points, windows, candidates, part_of_cell)
        enough = _RESOLUTION.shows_nearly_all if is_layered else _RESOLUTION.shows_most
        if shown >= enough or not (is_layered or n_in_rooms) or not may_be_finer:
            break
    return viewpoints


def _vote(
    coarse: VoxelGrid,
    points: NDArray[np.float64],
    windows: Windows,
    candidates: _Candidates,
    part_of_cell: NDArray[np.int64],
) -> tuple[VirtualViewpoints, float]:
    """The viewpoints of the best agreement, and the largest fraction of the surface that any agreement shows."""
    normals, is_flat = windows.normals, windows.residuals <= (_AGREEMENT.max_off_plane * coarse.size) ** 2
    seen = visibility_from(candidates.places, coarse.centroids, coarse.edge_lengths, normals)
    sides = facing_cosines(candidates.places, coarse.centroids, normals, seen)
    in_rooms = candidates.is_closed_in
    voting = _without_partitions(sides, sides[in_rooms])
    starts = _starts(candidates.places[: _CANDIDATES.n_outside], candidates.likely, in_rooms)
    of_place, of_part = _looks_at_parts(seen, part_of_cell)
    if of_part.any():
        asked = of_part[:, None] == part_of_cell
        seen, sides, voting = (np.where(asked, every[of_place], every.dtype.type(0)) for every in (seen, sides, voting))
    found = _agreements(voting, np.ascontiguousarray(starts[:, of_place]))
    looks = _Looks(
        sides=sides,
        from_outside=of_place < _CANDIDATES.n_outside,
        likely=candidates.likely[of_place],
        enclosure=candidates.enclosure[of_place],
        of_part=of_part,
        part_of_cell=part_of_cell,
        is_flat=is_flat,
    )
    room_scores = np.zeros(int(part_of_cell.max()) + 1)
    has_rooms = np.count_nonzero(in_rooms) >= _CANDIDATES.min_in_rooms
    for part in range(len(room_scores) if has_rooms else 0):
        cells = part_of_cell == part
        room_scores[part] = _SCORE.room * np.mean(cells) * _is_room(cells, coarse, normals, points)
    may_be_passage = bool(has_rooms) and len(room_scores) == 1 and not room_scores.any()
    around, likely_weight = coarse.neighbourhood, candidates.likely_weight
    weights, shown = _best_agreement(found, looks, around, likely_weight, room_scores, may_be_passage)
    chosen = _spread_choice(seen, weights)
    places = candidates.places[of_place[chosen]]
    return VirtualViewpoints(places, weights[chosen], of_part[chosen], coarse.centroids, part_of_cell), shown


class _Candidates(NamedTuple):
    """The k places from which a cloud may have been seen, those around it first.

    Attributes
    ----------
    places : (k, 3) float64, in the frame of `unit_frame`
    enclosure : (k,) float64, 0..1
        Fraction of the directions in which a place within the cloud sees something; 0 for the places around it.
    likely : (k,) bool
        Whether the sensor is likely to have stood there. That is the origin, if a camera at the origin would see the
        whole cloud; else the places around the cloud on the free side of its supporting plane.
    likely_weight : float
        Weight in the score of what the likely places see.
    """

    places: NDArray[np.float64]
    enclosure: NDArray[np.float64]
    likely: NDArray[np.bool_]
    likely_weight: float

    @property
    def is_closed_in(self) -> NDArray[np.bool_]:
        """Whether each place sees something in nearly all directions, as in a closed room, (k,) bool."""
        return self.enclosure >= _CANDIDATES.min_enclosure


def _candidates(
    coarse: VoxelGrid,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    origin: NDArray[np.float64],
    finer: int,
) -> tuple[_Candidates, NDArray[np.int64]]:
    """Candidate places around the cells and among them, and the part of the cloud that each cell belongs to, (c,).

    Among the cells there are `finer` times as many places as usual. `origin` is that of the points' frame.
    """
    low, high = bounding_box(coarse.centroids)
    part_of_cell, boxes = _parts(coarse, normals, points)
    n_times, upright = max(finer // (len(boxes) + 1), 1), np.eye(3)
    in_boxes = np.concatenate([low[None][:0], *(_free_viewpoints(coarse, *box, upright, n_times) for box in boxes)])
    in_boxes = in_boxes[hit_fractions(in_boxes, coarse.centroids) >= _CANDIDATES.min_enclosure]
    if len(in_boxes) < _CANDIDATES.min_in_rooms:  # none of the parts is a room
        part_of_cell[:], in_boxes = 0, in_boxes[:0]
    inside = np.concatenate((_free_viewpoints(coarse, *_smallest_box(coarse.centroids), n_times), in_boxes))
    directions = sphere_directions(_CANDIDATES.n_outside)
    outside = (low + high) / 2.0 + _CANDIDATES.outside_distance * lengths((high - low)[None]) / 2.0 * directions
    if not (high > low).any():
        outside = low + directions
    upwards, offset, is_ground = supporting_plane(coarse, normals)
    sees = origin @ upwards >= offset and _has_in_view(origin, coarse.centroids)
    is_camera = sees and (abs(upwards[2]) < LEVEL or _sees_as_much(origin, upwards, coarse, normals))
    if not is_camera and upwards[2] < -LEVEL:  # a level plane is no accident: z is up, and things lie in a pit
        upwards = -upwards
    places = np.concatenate((outside, inside))
    enclosure = np.concatenate((np.zeros(_CANDIDATES.n_outside), hit_fractions(inside, coarse.centroids)))
    if is_camera:
        places, enclosure = np.concatenate((places, origin[None])), np.append(enclosure, 0.0)
        likely = np.arange(len(places)) == len(places) - 1
        return _Candidates(places, enclosure, likely, _SCORE.origin), part_of_cell
    likely = np.zeros(len(places), np.bool_)
    likely[: _CANDIDATES.n_outside] = directions @ upwards > 0.0
    return _Candidates(places, enclosure, likely, _SCORE.above_ground if is_ground else _SCORE.free_side), part_of_cell


class _Looks(NamedTuple):
    """The sides of n cells that k looks see. A look is one place with one part of the cloud, whose cells alone it sees.

    Attributes
    ----------
    sides : (k, n) float32
        Signed cosine between each cell's normal and the direction to the place; 0 where the cell is hidden.
    from_outside, likely : (k,) bool
        Whether the place lies around the cloud; whether it is a likely one (`_Candidates.likely`).
    enclosure : (k,) float64, 0..1
        Enclosure of the place.
    of_part : (k,) int64
        Part of the cloud at which each looks.
    part_of_cell : (n,) int64
        Part of the cloud that each cell belongs to.
    is_flat : (n,) bool
        Whether a cell lies on one plane with those around it. On edges, places just beyond see the cell from its back.
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
    """Place and part of each look, (m,) int64 both: every place with every part of which it sees a cell.

    `seen`, (k, n), tells which of n cells each of k places sees.

    Each part has votes of its own, because one place may see two parts from different sides: a sensor in a room saw a
    house through the window; a place before the house sees the house from its outer side, but the room from its back.
    """
    n_parts = int(part_of_cell.max()) + 1
    if n_parts == 1:
        return np.arange(len(seen)), np.zeros(len(seen), np.int64)
    sees_some = np.stack([seen[:, part_of_cell == part].any(axis=1) for part in range(n_parts)])
    of_part, of_place = np.nonzero(sees_some)
    return of_place, of_part


def _is_layered(coarse: VoxelGrid) -> bool:
    """Whether the cloud may be a low storey, whose floor and ceiling are too near each other for a place between them.

    That is so if its thinnest side is only some cells high, and several cells lie over each other in most columns.
    """
    low, high = bounding_box(coarse.centroids)
    thin = int(np.argmin(high - low))
    across, along = (np.unique(cells, return_inverse=True)[1] for cells in np.delete(coarse.cells, thin, axis=1).T)
    columns = np.unique(across * coarse.n_voxels + along)
    is_low = (high - low)[thin] < _RESOLUTION.max_height * coarse.size
    return bool(is_low and coarse.n_voxels >= _RESOLUTION.min_layers * len(columns))


def _without_partitions(sides: NDArray[np.float32], of_rooms: NDArray[np.float32]) -> NDArray[np.float32]:
    """The sides that k places see of n cells, (k, n), with 0 for partitions.

    `of_rooms` are the sides that closed-in places see. A cell is a partition if they see both of its sides. It is
    thicker than the wall, so the places of the two rooms would contradict each other about its outer side.
    """
    if not len(of_rooms):
        return sides
    front, back = np.maximum(of_rooms, 0.0).max(axis=0), np.maximum(-of_rooms, 0.0).max(axis=0)
    return np.where(np.minimum(front, back) > _AGREEMENT.both_sides, np.float32(0.0), sides)


def _starts(
    outside: NDArray[np.float64], likely: NDArray[np.bool_], in_rooms: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Weights of k places, (s, k), from which s agreements start.

    They are as different as possible: the places around the cloud in each of some half spaces; all places around it;
    all others; the likely ones; and those closed in, if there are rooms.
    """
    n, n_outside = _AGREEMENT.n_halves, len(outside)
    starts = np.zeros((n + 4, len(likely)), np.float32)
    starts[:n, :n_outside] = sphere_directions(n) @ (outside - outside.mean(axis=0)).T > 0.0
    starts[n, :n_outside] = 1.0
    starts[n + 1, n_outside:] = 1.0
    starts[n + 2] = likely
    starts[n + 3] = in_rooms if np.count_nonzero(in_rooms) >= _CANDIDATES.min_in_rooms else 0.0
    return starts[starts.any(axis=1)]


def _has_in_view(place: NDArray[np.float64], centres: NDArray[np.float64]) -> bool:
    """Whether a camera at a place, (3,), that looks along z would have all the centres, (n, 3), in its view.

    They have to lie before it, on all sides of its axis, and some of them well off the axis.
    """
    rays = centres - place
    if not (rays[:, 2] > 0.0).all():
        return False
    slopes = rays[:, :2] / rays[:, 2:]
    is_around = (slopes.min(axis=0) < 0.0).all() and (slopes.max(axis=0) > 0.0).all()
    aside = np.abs(slopes).max(axis=1)
    return bool(
        is_around and aside.max() < _CAMERA.max_slope and np.mean(aside > _CAMERA.min_slope) > _CAMERA.min_beyond
    )


def _sees_as_much(
    place: NDArray[np.float64], upwards: NDArray[np.float64], coarse: VoxelGrid, normals: NDArray[np.float64]
) -> bool:
    """Whether nearly as many cells are visible from a place as from its mirror image on the other side of the cloud.

    They are not if the place lies below a pit that was scanned from above: there the pit's floor hides its walls.
    """
    low, high = bounding_box(coarse.centroids)
    opposite = place - 2.0 * ((place - (low + high) / 2.0) @ upwards) * upwards
    seen = visibility_from(np.stack((place, opposite)), coarse.centroids, coarse.edge_lengths, normals).mean(axis=1)
    return bool(seen[0] >= _CAMERA.min_seen_of_opposite * seen[1])


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
    """Whether each of k places sees any cell of each of b blocks, (k, b) bool, given the sides of n cells, (k, n)."""
    sees = np.empty((len(sides), -(-sides.shape[1] // _CELLS_PER_BLOCK)), np.bool_)
    in_blocks(_see_blocks, len(sides), sides, sees, smallest=1)
    return sees


class _Agreements(NamedTuple):
    """The agreements of k places about the outer sides of n cells, one for each of s starting weights.

    Attributes
    ----------
    weights : (s, k) float32, 0..1
        Weight of each place.
    outward : (s, n) float32
        Outer side of each cell: 1 if its normal points outwards, -1 if inwards, 0 if no place tells.
    agreed, known : (s, k) float32
        Sums of the cosines, without signs, under which each place sees cells from their outer side (`agreed`), and of
        those under which it sees any cell whose outer side is told (`known`).
    """

    weights: NDArray[np.float32]
    outward: NDArray[np.float32]
    agreed: NDArray[np.float32]
    known: NDArray[np.float32]


def _agreements(sides: NDArray[np.float32], starts: NDArray[np.float32]) -> _Agreements:
    """The agreements to which s starting weights of k places lead, (s, k), given the sides of n cells they see, (k, n).

    Voting and weighting by turns is nearly the power iteration for a pair of singular vectors of `sides`, but no weight
    is negative.
    """
    outward = np.empty((len(starts), sides.shape[1]), np.float32)
    found = _Agreements(starts.copy(), outward, np.zeros_like(starts), np.zeros_like(starts))
    in_blocks(_agree, len(starts), sides, _seen_blocks(sides), found, smallest=1)
    return found


@routine
def _add(weight: np.float32, sides: NDArray[np.float32], total: NDArray[np.float32]) -> None:
    """Add the sides that a place sees, times its weight, to the vote on each cell."""
    for i in range(len(sides)):
        total[i] += weight * sides[i]


@summing_routine
def _balance(sides: NDArray[np.float32], outward: NDArray[np.float32]) -> tuple[np.float32, np.float32]:
    """Agreement of a place with a vote: the sum of its cosines on the outer sides, less that on the inner sides.

    Also the sum of all its cosines, without signs, on cells whose outer side is told.
    """
    net = known = np.float32(0.0)
    for i in range(len(sides)):
        value = sides[i] * outward[i]
        net += value
        known += abs(value)
    return net, known


class _Paths(NamedTuple):
    """The outer sides of n cells after each round of s agreements, up to the round from which each is known.

    Attributes
    ----------
    outward : (s, _ROUNDS, n) int8
        Outer sides after each round: 1, -1 or 0, as in `_Agreements`.
    told : (s,) int64
        Number of rounds that are stored.
    rounds : (s,) int64
        The round in which nothing changed any more; 0 if there was none.
    """

    outward: NDArray[np.int8]
    told: NDArray[np.int64]
    rounds: NDArray[np.int64]


@routine
def _path_met(paths: _Paths, s: int, this_round: int) -> int:
    """The number of an earlier agreement that had the same outer sides in some round as agreement s has in this one.

    From there on both go the same way, so the end of the earlier one is the end of this one. -1 if there is none, or if
    this one would need more than `_ROUNDS` rounds to get there, as then the result would depend on which are computed
    together.
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
    """Set the outer side of each cell by a weighted vote of the places; whether the side of any cell changed.

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
    """Set the weight of each place: the more it sees, and the better that agrees with the vote, the larger it is.

    The largest weight is 1.
    """
    n_places, n_blocks = sees.shape
    weights, largest = found.weights[s], np.float32(NEARLY_ZERO)
    for k in range(n_places):
        net = known = np.float32(0.0)
        for block in range(n_blocks):
            if sees[k, block]:
                of_block = slice(block * _CELLS_PER_BLOCK, (block + 1) * _CELLS_PER_BLOCK)
                more, more_known = _balance(sides[k, of_block], outward[of_block])
                net, known = net + more, known + more_known
        found.agreed[s, k], found.known[s, k] = (net + known) / 2.0, known
        net = max(net, np.float32(0.0))
        weights[k] = math.sqrt(net) * (net / max(known, np.float32(NEARLY_ZERO))) ** 4
        largest = max(largest, weights[k])
    for k in range(n_places):
        weights[k] /= largest


@kernel
def _agree(start: int, stop: int, sides: NDArray[np.float32], sees: NDArray[np.bool_], found: _Agreements) -> None:
    """Set each agreement: by turns the places vote on the outer sides, and are weighted by how well they agree with the
    vote, until nothing changes."""
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
    """Weights of the looks, (k,) float64, in the agreement of the highest score; the largest fraction shown by any.

    The score is the fraction of the surface that the agreement shows, and the terms of `ScoreThresholds`.

    - Small differences in what is shown do not count: from behind, a crevice between things is a crest, so the wrong
      side may show a little more than the right one.
    - A crease is hidden by what is beside it. So a cell counts as shown if one beside it is shown. This does not hold
      for a part about which closed-in places agree: a room is seen from within but for narrow gaps.
    - An agreement of enclosed places is preferred in a room, which its floor and ceiling tell (`is_scanned_room`).
    - It is preferred in a passage, too, such as a tunnel or a gallery. A cloud without such a floor and ceiling is a
      passage if enclosed places show some of the surface that all other agreements miss: all that was scanned had been
      seen, and what stands in a pipe is hidden from outside.
    """
    different = np.array(list({outward.tobytes(): s for s, outward in enumerate(found.outward)}.values()))
    weights = found.weights[different].astype(np.float64)
    of_parts = (looks.of_part == np.arange(looks.part_of_cell.max() + 1)[:, None]).T.astype(np.float64)
    total, enclosure = weights @ of_parts, weights @ (of_parts * looks.enclosure[:, None])
    is_closed = ((enclosure >= _CANDIDATES.min_enclosure * total) & (total > 0.0)).any(axis=0)[looks.part_of_cell]
    is_within = (enclosure >= _SCORE.enclosed_for_room * total) & (total > 0.0)
    show = partial(_shown, different, looks, _seen_blocks(looks.sides), found, around)
    shown, from_behind = show(is_closed)
    within = is_within @ room_scores
    if may_be_passage:
        with_creases, inside = show(np.zeros_like(is_closed))[0], is_within[:, 0]
        by_others = with_creases[~inside].max(initial=0.0)
        is_passage = with_creases[inside].max(initial=0.0) > by_others + _SCORE.min_shown_from_inside
        within = _SCORE.room * inside * is_passage
    most_shown = float(shown.max())
    scores = np.minimum(shown, most_shown - _SCORE.shown_tolerance) + within
    scores -= np.maximum(from_behind - _SCORE.max_from_behind, 0.0)
    visible = np.abs(looks.sides).sum(axis=1)
    if not visible.any():
        return weights[0], most_shown
    agreed, known = found.agreed[different], found.known[different]
    unanimous = np.abs(2.0 * agreed / np.maximum(known, NEARLY_ZERO) - 1.0)
    scores += _SCORE.unanimous * unanimous[:, visible > 0.0].mean(axis=1)
    for some, weight in ((looks.from_outside, _SCORE.outside), (looks.likely, likely_weight)):
        scores += weight * agreed[:, some].sum(axis=1) / max(float(visible[some].sum()), NEARLY_ZERO)
    return weights[int(np.argmax(scores))], most_shown


def _shown(
    different: NDArray[np.int64],
    looks: _Looks,
    sees: NDArray[np.bool_],
    found: _Agreements,
    around: Neighbourhood,
    is_closed: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fraction of the surface that each of d agreements shows, and the fraction that it sees from behind, (d,) each."""
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
    """Add the cosines under which a place sees cells from their outer side, times its weight, to `shown`.

    Return the sum of all its cosines, without signs, and of those under which it sees flat cells from behind.
    """
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
    """Set the fraction of the surface that each agreement shows, and the fraction of what it sees that is from behind.

    A cell that is not closed in also counts as shown if one beside it is. Of a partition, whose outer side is not told,
    either side counts. Only flat cells count as seen from behind.
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
        contradicted[d] = against / max(seen, np.float32(NEARLY_ZERO))
        total = 0.0
        for i in range(n):
            most = of_cells[i]
            if not is_closed[i]:
                for a in range(around.indptr[i], around.indptr[i + 1]):
                    most = max(most, of_cells[around.neighbours[a]])
            total += min(most / _WELL_SEEN, 1.0)
        shown[d] = total / n


def _spread_choice(seen: NDArray[np.bool_], weights: NDArray[np.float64]) -> NDArray[np.int64]:
    """Numbers of the places to look from, chosen one by one: always that of the largest weight times what it sees anew.

    `seen`, (k, n) bool, tells which of n cells each of k places sees. What an earlier choice saw counts less. So each
    of many rooms has a place, also if its neighbours have places that see much of it through doors.
    """
    places = np.flatnonzero(weights > 0.0)
    left, sees = weights[places], seen[places].astype(np.float32)
    interest = np.ones(seen.shape[1], np.float32)
    chosen: list[int] = []
    while len(chosen) < _CHOICE.max_chosen and left.any():
        best = int(np.argmax(left * np.einsum("kn,n->k", sees, interest)))
        if len(chosen) >= _CHOICE.min_chosen and sees[best] @ interest < _CHOICE.min_gain * len(interest):
            break
        chosen.append(best)
        interest[sees[best] > 0.0] *= np.float32(_CHOICE.seen_again)
        left[best] = 0.0
    return places[chosen]


class CoarseGrid(NamedTuple):
    """The coarse grid, of c cells.

    Attributes
    ----------
    cells : VoxelGrid
        In the frame of `unit_frame`.
    points : (c,) float64
        Number of points in each cell.
    """

    cells: VoxelGrid
    points: NDArray[np.float64]


class _Surfaces(NamedTuple):
    """A sample of the surfaces: n places, about as far from each other as voxels of level 0 are.

    Attributes
    ----------
    places : (n, 3) float64, in the frame of `unit_frame`
    points : (n,) float64
        Number of points of the cloud that each place stands for; a fraction where a large voxel gives several places.
    width : float
        Edge length of a voxel of level 0 in that frame.
    """

    places: NDArray[np.float64]
    points: NDArray[np.float64]
    width: float


def _in_cells(surfaces: _Surfaces, cells: int) -> CoarseGrid:
    """The coarse grid of about as many cells as asked for, at most twice as many.

    It starts half a cell before the lowest corner, so that the outermost surfaces lie in the middle of a cell.
    """
    places, points, width = surfaces
    size = width * max(1.0, math.sqrt(np.minimum(points, 1.0).sum() / (1.5 * cells)))  # of a surface, n ~ 1 / size^2
    low = bounding_box(places)[0]
    while True:
        coarse = voxel_grid(places, size, Shift(low - 0.5 * size))
        if coarse.n_voxels <= 2 * cells:
            return CoarseGrid(coarse, np.bincount(coarse.voxel_of_point, points, coarse.n_voxels).astype(np.float64))
        size *= 1.4


def _surfaces(grid: VoxelGrid, middle: NDArray[np.float64], reach: float) -> _Surfaces:
    """The means of the voxels, as a sample of the surfaces. A larger voxel gives several places, evenly on its plane.

    Voxels that are not joined do not count, unless most are such: they are on no surface, and ghosts far off would
    stretch the box in which places are tried.
    """
    points, edges = np.diff(grid.starts).astype(np.float64), grid.edge_lengths
    counts = grid.joined
    if np.mean(counts) < _RESOLUTION.min_joined:
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
    """The part of the cloud that each of n cells belongs to, (n,), and the boxes in which small parts lie.

    Parts lie far from each other: a room and the houses that were seen through its windows, or scans of places far
    apart. They are the three largest pieces, and other pieces that are rooms. Cells of no part count to the first. A
    part has a box, lowest and highest corner, if it is less than half as long as the cloud.
    """
    centres = coarse.centroids
    low, high = bounding_box(centres)
    part_of_cell, length = np.zeros(len(centres), np.int64), float((high - low).max())
    boxes: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    if not length > 0.0:
        return part_of_cell, boxes
    blocks = voxel_grid(centres, length / _PART.blocks_along, Shift(low))
    piece = connected_components(blocks.touching_pairs(), blocks.n_voxels)[blocks.voxel_of_point]
    counts, part = np.bincount(piece), 0
    for number in np.argsort(-counts, kind="stable")[: _PART.max_rooms]:
        cells = piece == number
        if counts[number] < _PART.min_fraction * len(centres):
            break
        if part >= _PART.max_parts and not _is_room(cells, coarse, normals, points):
            continue
        part_of_cell[cells] = part
        part += 1
        lowest, highest = np.quantile(centres[cells], _PART.quantiles, axis=0)
        if (highest - lowest).max() < _PART.max_length * length:
            boxes.append((lowest, highest))
    return part_of_cell, boxes


def _is_room(
    cells: NDArray[np.bool_], coarse: VoxelGrid, normals: NDArray[np.float64], points: NDArray[np.float64]
) -> bool:
    """Whether some of n cells, (n,) bool, are a room in which scanners on tripods stood."""
    return is_scanned_room(coarse.centroids[cells], normals[cells], points[cells], coarse.size)


def _smallest_box(
    centres: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A box around centres, (n, 3): its lowest and highest corner along its own axes, and these axes, rows of (3, 3).

    It is the bounding box, or the box along the principal axes if that is much smaller, as around a corridor that lies
    askew to the frame.
    """
    low, high = bounding_box(centres)
    offsets = centres - centres.mean(axis=0)
    axes = np.linalg.eigh(np.einsum("ij,ik->jk", offsets, offsets))[1].T
    lowest, highest = bounding_box(np.einsum("ij,kj->ik", centres, axes))
    if np.prod(highest - lowest) < _CANDIDATES.max_turned_box * np.prod(high - low):
        return lowest, highest, axes
    return low, high, np.eye(3)


def _free_viewpoints(
    coarse: VoxelGrid, low: NDArray[np.float64], high: NDArray[np.float64], axes: NDArray[np.float64], finer: int
) -> NDArray[np.float64]:
    """Free places within a box, (k, 3): those of a lattice that lie off all surfaces and not in corners of the box.

    There are `finer` times as many as usual. Most are spread out by farthest point sampling; the rest are those
    farthest from all surfaces.
    """
    from scipy.spatial import cKDTree

    n, lattice_side = finer * _CANDIDATES.n_inside, round(_CANDIDATES.lattice_side * finer ** (1.0 / 3.0))
    steps = (np.arange(lattice_side) + 0.5) / lattice_side
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    places = np.einsum("ij,jk->ik", low + lattice * (high - low), axes)
    tree = cKDTree(coarse.centroids, 64, balanced_tree=False, compact_nodes=False)  # for few places
    clearance = tree.query(places)[0] / coarse.size
    free = np.flatnonzero(clearance > _CANDIDATES.min_clearance)
    if not len(free):
        return places[:0]
    places, clearance = places[free], clearance[free]
    hits = hit_fractions(places, coarse.centroids[:: max(1, coarse.n_voxels // _CANDIDATES.sampled_cells)])
    among = np.flatnonzero(hits >= _CANDIDATES.min_surrounded * hits.max())
    n_spread = int(_CANDIDATES.spread_fraction * n)
    chosen = among[farthest_points(places[among], int(np.argmax(clearance[among])), n_spread)]
    order = np.argsort(-clearance, kind="stable")
    rest = order[~np.isin(order, chosen)][: n - len(chosen)]
    return places[np.concatenate((chosen, rest))]
