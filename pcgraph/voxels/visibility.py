# SPDX-License-Identifier: Apache-2.0
"""The outer side of a surface, found from what is visible.

If nobody says from where the surface was seen, its outer side is the one that is visible from virtual viewpoints
(`pcgraph.voxels.virtual_viewpoints`). A vote is a number for each voxel: above 0 if its normal points outwards, below 0
if it points inwards, and near 0 if hardly anything tells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.rounding import TINY
from pcgraph.voxels.depth_buffer import cosines_towards, depth_order, visibility_from
from pcgraph.voxels.directions import CREASE_COSINE, SAME_SURFACE_COSINE
from pcgraph.voxels.grid import Neighbourhood, VoxelGrid
from pcgraph.voxels.virtual_viewpoints import (
    VirtualViewpoints,
    either_normals,
    lengths,
    unit_frame,
    virtual_viewpoints,
)


@dataclass(frozen=True)
class SideThresholds:
    """Conditions for a voxel to tell its outer side itself, or by those around it. Chosen by eye; none was varied."""

    edge_on: float = 0.1  # cosine between normal and ray: a level surface is seen edge-on below it
    seen_well: float = 0.2  # cosine between normal and ray: above it a normal that is some degrees off tells its side
    nearly_level: float = 0.9  # cosine between a normal and the scanner's axis: 26 degrees, as scanners may be tilted
    level: float = 0.97  # cosine to the mean normal of what is nearly level: 14 degrees
    min_level: int = 20  # voxels whose mean normal tells the vertical, at least
    thinned: tuple[tuple[int, float], ...] = ((100_000, 7.0), (30_000, 3.0))  # of more voxels one in so many is seen
    smoothing_rounds: int = 4  # rounds of votes by the voxels around, each of which reaches one voxel farther
    clear: float = 0.3  # cosine, mean over the voxels around: such a vote needs no others, if all voxels are looked at


_SIDES = SideThresholds()

# Kernels read these.
_MIN_PATCH = 10
"""Voxels of a patch: a smaller one keeps its votes. Chosen by eye; without this and `_MIN_MAJORITY` woods turn over."""
_MAX_OFF_PATCH = 0.7
"""Voxel edges between the planes of touching voxels of one patch, at most; chosen by eye, not varied."""
_WEIGHT_OF_UNCLEAR = 0.05
"""Weight of votes that are not clear, as a fraction of what edges tell; chosen by eye, not varied."""
_MIN_MAJORITY = 0.3
"""Fraction of all evidence by which one side has to exceed the other. Chosen by eye; see `_MIN_PATCH`."""


@dataclass(frozen=True, eq=False)
class VisibleSides(ShortRepr):
    """Outward normals of v voxels, and the viewpoints from which the outside is seen.

    Attributes
    ----------
    places : (k, 3) float64, metres
        The viewpoints, by decreasing weight.
    normals : (v, 3) float64
        Unit normals that point outwards.
    """

    places: NDArray[np.float64]
    normals: NDArray[np.float64]


def visible_sides(
    grid: VoxelGrid,
    normals: NDArray[np.float64],
    virtual: VirtualViewpoints | None = None,
) -> VisibleSides:
    """Outward normals of the voxels, found from what is visible.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
        Unit normals of the surface; which of its two sides they point to is arbitrary.
    virtual : VirtualViewpoints, optional
        `virtual_viewpoints(grid)`, if it is at hand.

    Notes
    -----
    1. Places around the cloud, and free places within its bounding box, see the cells of a coarse copy of the grid. A
       depth buffer over all directions tells which. Each place counts as far as it agrees with the others on the outer
       sides. So if the places above a floor are right, one under the floor counts nothing.
    2. There are several such agreements: of the places within a room, around it, above it, below it. All that was
       measured was seen from somewhere. So the right agreement shows the whole surface: from others, walls hide the
       furniture. And it sees no plane from behind.
    3. Two agreements may show as much, as of a hollow shell. Then these count, by decreasing weight: that no place sees
       both sides of what it sees; that the places around the cloud see it from its outer side; that the likely places
       do. Likely are the places on the free side of the plane that bears most, such as the ground or a table, or the
       origin, if the cloud lies before it as before a camera. Over a level plane that reaches beyond all that stands on
       it, the view from above counts more than what is shown.
    4. The normal of a voxel faces the mean direction to the places that see it. The vote of a voxel that no place sees
       comes from those around it; so does that of most voxels of a large grid, of which some are looked at.
    5. A patch of the surface that no place sees well, such as an underside, takes its side from the faces it meets at
       its edges (`_alike_sides`).

    Source: Katz et al. 2007 ask for the visibility of points without a size. Voxels have a size, hence a depth buffer.
    """
    middle, reach = unit_frame(grid, grid.centroids)
    virtual = virtual_viewpoints(grid) if virtual is None else virtual
    places, weights = virtual.places, virtual.weights
    votes, (looked_at, stretch) = np.zeros(grid.n_voxels), occluder_subset(grid)
    centres, widths = (grid.centroids[looked_at] - middle) / reach, stretch * grid.edge_lengths[looked_at] / reach
    sides = normals[looked_at]
    seen, towards = visibility_from(places, centres, widths, sides, stretch), np.empty((len(centres), 3))
    if virtual.part_of_cell.any():
        seen &= virtual.parts[:, None] == virtual.part_of(centres)
    in_blocks(_look_around, len(centres), places, weights, seen, centres, towards)
    votes[looked_at] = np.einsum("ij,ij->i", towards, sides) / lengths(towards)
    votes = _smoothed_votes(grid, normals, votes)
    _carry_over(grid.neighbourhood, grid.centroids, grid.edge_lengths, normals, votes, _SIDES.clear / stretch**2)
    return VisibleSides(middle + reach * places, _turned(normals, votes))


def occluder_subset(grid: VoxelGrid) -> tuple[NDArray[np.int64], float]:
    """Numbers of evenly spread voxels, (s,), and the factor by which to widen them so that they hide as much as all."""
    step = next((step for many, step in _SIDES.thinned if grid.n_voxels > many), 1.0)
    if step == 1.0:
        return np.arange(grid.n_voxels), 1.0
    return np.concatenate(in_blocks(_in_step, grid.n_voxels, grid.cells, step)), math.sqrt(step)


@kernel
def _in_step(start: int, stop: int, cells: NDArray[np.float64], step: float) -> NDArray[np.int64]:
    """Numbers of the cells (x, y, z) of which x + 2 y + 4 z is a multiple of `step`.

    With steps of 3 and 7 these are spread evenly on every plane along two axes.
    """
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

    Far from the scanner, level ground is seen edge-on, and a normal that is two degrees off would turn it upside down:
    a tenth of the ground was. So a voxel that is nearly level and seen edge-on faces as the level voxels that are seen
    well, provided that the scanner lies on that side. Else, as on ground that rises above the scanner, its own normal
    decides. Vertical is the mean normal of the level voxels that are seen well, as the axis may be tilted.
    """
    reach = unit_frame(grid, grid.centroids)[1]
    cosines = cosines_towards(place, reach, grid.centroids, normals)
    upwards = _upwards(normals, cosines, axis)
    along = np.einsum("ij,j->i", normals, upwards)
    level = np.flatnonzero((np.abs(cosines) < _SIDES.edge_on) & (np.abs(along) > _SIDES.nearly_level))
    ways = (place - grid.centroids[level]) / reach
    heights = np.einsum("ij,j->i", ways, upwards) / lengths(ways)
    below = heights > 0.0
    cosines[level[below]] = (np.sign(along[level]) * heights)[below]
    return _turned(normals, cosines)


def sides_towards_each(
    grid: VoxelGrid, normals: NDArray[np.float64], places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit normals, (v, 3) float64, towards the place from which each voxel was seen, (v, 3).

    A voxel that was seen edge-on, such as ground far from a tripod, faces as the voxels around it on one surface do:
    normals that are a degree off turned a thirtieth of such ground upside down. A voxel that was seen well keeps its
    side, as on a thin wall the voxels around may belong to the other face.
    """
    ways = places - grid.centroids
    ways /= max(float(np.abs(ways).max()), TINY)
    cosines = np.einsum("ij,ij->i", normals, ways) / lengths(ways)
    edge_on = np.abs(cosines) < _SIDES.seen_well
    return _turned(normals, np.where(edge_on, _smoothed_votes(grid, normals, cosines.copy()), cosines))


def _upwards(
    normals: NDArray[np.float64], cosines: NDArray[np.float64], axis: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The vertical near an axis that may be tilted, (3,) of length 1.

    It is the mean normal of what is nearly level and seen well, towards the side to which most of that faces. `cosines`
    are those between normals and rays.
    """
    clear = np.abs(cosines) > _SIDES.seen_well
    facing = normals[clear] * np.sign(cosines[clear])[:, None]
    upwards = axis
    for least in (_SIDES.nearly_level, _SIDES.level):
        along = np.einsum("ij,j->i", facing, upwards)
        near = np.abs(along) > least
        if np.count_nonzero(near) < _SIDES.min_level:
            break
        mean = np.sign(along[near]) @ facing[near]
        upwards = mean / np.linalg.norm(mean) * (1.0 if np.sign(along[near]).sum() >= 0.0 else -1.0)
    return upwards


def _turned(normals: NDArray[np.float64], votes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The normals, (v, 3), reversed where the vote for their side, (v,), is below zero."""
    turned = np.empty_like(normals)
    in_blocks(_turn, len(normals), normals, votes, turned)
    return turned


def _smoothed_votes(grid: VoxelGrid, normals: NDArray[np.float64], votes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Votes for the side of each voxel's normal, (v,), averaged with those around it on one surface.

    `votes` is overwritten.
    """
    return _spread_votes(grid, _neighbours_on_one_surface(grid, normals), votes)


def _neighbours_on_one_surface(grid: VoxelGrid, normals: NDArray[np.float64]) -> NDArray[np.int8]:
    """Whether each voxel and each of those around it are on one surface: 1, -1 with opposite normals, or 0."""
    alike = np.empty(len(grid.neighbours), np.int8)
    in_blocks(_compare_normals, grid.n_voxels, grid.neighbourhood, normals, alike)
    return alike


def _spread_votes(grid: VoxelGrid, alike: NDArray[np.int8], votes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Votes, (v,), averaged with those of the voxels around that are on one surface, as `alike` says, in some rounds.

    `votes` is overwritten.
    """
    smoothed = np.empty_like(votes)
    for _ in range(_SIDES.smoothing_rounds):
        in_blocks(_vote_along, grid.n_voxels, grid.neighbourhood, alike, votes, smoothed)
        votes, smoothed = smoothed, votes
    return votes


def depth_order_along(
    grid: VoxelGrid,
    normals: NDArray[np.float64],
    places: NDArray[np.float64],
    ends: NDArray[np.integer],
    fractions: tuple[float, ...],
    depth: float,
    finer: float = 1.0,
) -> NDArray[np.int8]:
    """Whether what is seen past ways between voxels is nearer, -1, farther, 1, or neither, 0; (k, n, c) int8.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
    places : (k, 3) float64, metres
        From where it is seen.
    ends : (c, 2) int
        Voxels at both ends of each way. A surface from one to the other would not hide itself.
    fractions : n floats, 0..1
        Where along the ways it is asked.
    depth : float, voxel edges
        Difference of depth from which on something is nearer or farther.
    finer : float, >= 1
        Times by which voxels are drawn smaller than they are, in as many more bins, to see what lies between them.
    """
    start, stop = np.moveaxis(grid.centroids[ends], 1, 0)
    points = start + np.array(fractions)[:, None, None] * (stop - start)
    k, n, c = len(places), len(fractions), len(ends)
    centres = np.concatenate((grid.centroids, points.reshape(-1, 3), places))
    middle, reach = unit_frame(grid, centres)
    centres -= middle  # in place: there may be many
    centres /= reach
    depths = np.tile(depth * grid.edge_lengths[ends].max(axis=1), n)
    widths = np.concatenate((grid.edge_lengths / finer, depths)) / reach
    facing = np.concatenate((normals, np.tile(normals[ends[:, 0]], (n, 1))))
    return depth_order(centres[-k:], centres[:-k], widths, facing, n * c, finer).reshape(k, n, c)


def depth_order_of(
    grid: VoxelGrid, normals: NDArray[np.float64], place: NDArray[np.float64], shown: VoxelGrid, depth: float
) -> NDArray[np.int8]:
    """Order of each voxel and another grid along the ray from a place, (v,) int8.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
    place : (3,) float64, metres
        Viewpoint.
    shown : VoxelGrid
        The other grid.
    depth : float, voxel edges
        Least difference of depth that counts.

    Returns
    -------
    (v,) int8
        -1: the other grid is nearer than the voxel. 1: it is farther. 0: neither, or it has nothing in that direction.
    """
    middle, reach = unit_frame(shown, np.concatenate((grid.centroids, shown.centroids, place[None])))
    centres = (np.concatenate((shown.centroids, grid.centroids)) - middle) / reach
    widths = np.concatenate((shown.edge_lengths, depth * grid.edge_lengths)) / reach
    facing = np.concatenate((either_normals(shown), normals))
    return depth_order((place - middle)[None] / reach, centres, widths, facing, grid.n_voxels)[0]


def visible_fraction(grid: VoxelGrid, place: NDArray[np.float64]) -> float:
    """Fraction of the voxels that are visible from a place, (3,) float64, metres."""
    return _visible_fraction(grid, place, either_normals(grid))


def shown_fraction(grid: VoxelGrid, place: NDArray[np.float64]) -> float:
    """Fraction of the surface that a place, (3,) float64, metres, shows, 0..1.

    The surface is the joined voxels. A place shows those that are visible from it, and those on one surface with a
    visible one a few voxels away, as coarse voxels hide some of what lies beside them. The place of a single scan shows
    nearly all of it. The middle of a moving scanner's way does not show the far sides of what the scanner passed.
    """
    normals, joined = either_normals(grid), grid.joined
    visible = _visible(grid, place, normals).astype(np.float64)
    shown = _spread_votes(grid, np.abs(_neighbours_on_one_surface(grid, normals)), visible) > 0.0
    return float(np.mean(shown[joined])) if joined.any() else 1.0


def _visible_fraction(grid: VoxelGrid, place: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    """`visible_fraction`, given the normals of the voxels, of either sign."""
    return float(_visible(grid, place, normals).mean())


def _visible(grid: VoxelGrid, place: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each voxel is visible from a place, (v,) bool."""
    middle, reach = unit_frame(grid, np.concatenate((grid.centroids, place[None])))
    centres, widths = (grid.centroids - middle) / reach, grid.edge_lengths / reach
    return visibility_from((place - middle)[None] / reach, centres, widths, normals)[0]


def likelier_viewpoint(grid: VoxelGrid, place: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """The one of two places, (3,) float64, metres, from which more is visible; the first if it is as much."""
    normals = either_normals(grid)
    return place if _visible_fraction(grid, place, normals) >= _visible_fraction(grid, other, normals) else other


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
    """Set the weighted sum of the unit vectors from each centre to the places that see it."""
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
    """Set the votes of patches without clear votes by what they meet at their edges, if most of that agrees.

    A patch is connected voxels on one surface whose votes are all below `clear`. The surfaces that it meets have clear
    votes, or got them in an earlier round.
    """
    known, visited = np.abs(votes) >= clear, np.empty(len(votes), np.bool_)
    patch, way = np.empty(len(votes), np.int64), np.empty(len(votes))  # way: 1, or -1 if opposite to the first normal
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
            own *= _WEIGHT_OF_UNCLEAR / clear
            if size >= _MIN_PATCH and said > 0.0 and abs(total + own) >= _MIN_MAJORITY * (said + abs(own)):
                changed, side = True, clear if total + own > 0.0 else -clear
                for i in patch[:size]:
                    known[i], votes[i] = True, side * way[i]


@routine
def _walk_patch(around, centroids, edge_lengths, normals, votes, known, visited, patch, way):  # type: ignore[no-untyped-def]
    """Complete a patch, given its first voxel: set `patch`, its voxels, and `way`, their directions along the first.

    Return its size; the evidence at its edges for the side of the first normal, summed with signs; and without signs.
    """
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
    """Whether two touching voxels' normals point to the same side: 1 if both point outwards or both inwards, -1 if not.

    Nearer to 0 the answer is less sure. Also whether they are on one surface. There the sign of the cosine tells. At an
    edge between two faces, both normals point outwards or both inwards if each voxel lies behind the other's plane, or
    each before it.
    """
    cosine = ahead_of_i = ahead_of_j = 0.0
    for axis in range(3):
        way = centroids[j, axis] - centroids[i, axis]
        cosine += normals[i, axis] * normals[j, axis]
        ahead_of_i += way * normals[i, axis]
        ahead_of_j -= way * normals[j, axis]
    least, most = min(abs(ahead_of_i), abs(ahead_of_j)) / edge, max(abs(ahead_of_i), abs(ahead_of_j)) / edge
    if abs(cosine) > SAME_SURFACE_COSINE and most <= _MAX_OFF_PATCH:
        return 1.0 if cosine > 0.0 else -1.0, True
    if abs(cosine) < CREASE_COSINE:
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
            alike[a] = np.int8(cosine > SAME_SURFACE_COSINE) - np.int8(cosine < -SAME_SURFACE_COSINE)  # branch-free


@kernel
def _vote_along(
    start: int,
    stop: int,
    around: Neighbourhood,
    alike: NDArray[np.int8],
    votes: NDArray[np.float64],
    smoothed: NDArray[np.float64],
) -> None:
    """Set the mean vote of each voxel and those around it on one surface, for the side of its own normal."""
    indptr, neighbours = around
    for i in range(start, stop):
        total = votes[i]
        for a in range(indptr[i], indptr[i + 1]):
            total += alike[a] * votes[neighbours[a]]
        smoothed[i] = total / (indptr[i + 1] - indptr[i] + 1)
