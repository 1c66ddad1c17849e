# SPDX-License-Identifier: Apache-2.0
"""Which side of a surface is its outside, where nobody said from where it was seen: the side that is visible from
virtual viewpoints (`pcgraph.voxels.virtual_viewpoints`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.plumbing.short_repr import ShortRepr
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

_NEARLY_EDGE_ON, _SEEN_WELL = 0.1, 0.2  # cosines between normals and rays, less and more
_NEARLY_LEVEL, _LEVEL_INDEED, _FEW_LEVEL = 0.9, 0.97, 20  # cosines to the axis, and to what is level; voxels
_MANY = ((100_000, 7.0), (30_000, 3.0))  # voxels: of more a seventh or a third is looked at
_SMOOTHING = 4  # rounds of votes by the voxels around
_CLEAR = 0.3  # votes for a side that need no others, where all voxels are looked at
_PATCH = 10  # voxels of a patch, at least
_OFF_PATCH = 0.7  # edge lengths between planes of touching voxels: so many, and they are two surfaces
_HARDLY, _MOSTLY = 0.05, 0.3  # what votes that are not clear count beside edges; and how much more must agree than not


@dataclass(frozen=True, eq=False)
class VisibleSides(ShortRepr):
    """Outward normals of v voxels, and the viewpoints from which the outside is seen.

    Attributes
    ----------
    places : (k, 3) float64, metres
        From which the outside is seen, by decreasing weight.
    normals : (v, 3) float64
        Unit normals, outwards.
    """

    places: NDArray[np.float64]
    normals: NDArray[np.float64]


def visible_sides(
    grid: VoxelGrid,
    normals: NDArray[np.float64],
    virtual: VirtualViewpoints | None = None,
) -> VisibleSides:
    """The outer side of the surface at each voxel, found from what is visible.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
        Unit normals of the surface, towards either side.
    virtual : VirtualViewpoints, optional
        `virtual_viewpoints(grid)`, where that is known.

    Notes
    -----
    Places all around the cloud, and free places within its bounding box, see the cells of a coarse copy of the grid,
    by a depth buffer over directions. A place counts as far as it agrees with others which side of what it sees is the
    outside; so if those above the floor are right, one under it, which sees it from below, counts nothing. There are
    several such agreements: within a room, around it, above it, below. All that was measured was seen from somewhere,
    so the right one is that whose places see all of the surface, where others have furniture hidden by walls, and no
    plane from behind, as those within a hall see the walls that others take for the sides of a box. Where two show as
    much, as of a hollow shell, or of things on a table from below, what counts is that no place sees both
    sides, then how much of what is seen from outside has its outside there, and how much of what is seen from those of
    these places before the plane that bears most, as the ground or a table does, on which things stand (above it, if it
    is level); or from the origin, if that lies there and all before it, as before a camera that looks along z. Where a
    level plane reaches beyond all that stands on it, that it is seen from above counts more than what is shown. The
    voxels then take the mean direction to the places that see them, those that none sees, and of many voxels most, from
    the voxels around. A surface that no place sees well, as an underside or the back of a cabinet near a wall, takes
    its side from what it meets at its edges: what lies behind one of two faces has the other behind itself.

    Visibility of points without a surface: Katz et al. 2007, here by a depth buffer, as voxels have a size.
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
    _carry_over(grid.neighbourhood, grid.centroids, grid.edge_lengths, normals, votes, _CLEAR / stretch**2)
    return VisibleSides(middle + reach * places, _turned(normals, votes))


def occluder_subset(grid: VoxelGrid) -> tuple[NDArray[np.int64], float]:
    """Indices of an evenly spread subset of the voxels, (s,), and the factor to widen them so that it hides as much."""
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
    reach = unit_frame(grid, grid.centroids)[1]
    cosines = cosines_towards(place, reach, grid.centroids, normals)
    upwards = _upwards(normals, cosines, axis)
    along = np.einsum("ij,j->i", normals, upwards)
    level = np.flatnonzero((np.abs(cosines) < _NEARLY_EDGE_ON) & (np.abs(along) > _NEARLY_LEVEL))
    ways = (place - grid.centroids[level]) / reach
    heights = np.einsum("ij,j->i", ways, upwards) / lengths(ways)
    below = heights > 0.0
    cosines[level[below]] = (np.sign(along[level]) * heights)[below]
    return _turned(normals, cosines)


def sides_towards_each(
    grid: VoxelGrid, normals: NDArray[np.float64], places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit normals, (v, 3) float64, towards the place from which each voxel was seen, (v, 3).

    What was seen edge-on, as ground far from a tripod, faces as the voxels around on one surface do: normals that are
    a degree off turned a thirtieth of it upside down. What was seen well keeps its side, as those of a thin wall do.
    """
    ways = places - grid.centroids
    ways /= max(float(np.abs(ways).max()), np.finfo(np.float64).tiny)
    cosines = np.einsum("ij,ij->i", normals, ways) / lengths(ways)
    edge_on = np.abs(cosines) < _SEEN_WELL
    return _turned(normals, np.where(edge_on, _smoothed_votes(grid, normals, cosines.copy()), cosines))


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
    return _spread_votes(grid, _neighbours_on_one_surface(grid, normals), votes)


def _neighbours_on_one_surface(grid: VoxelGrid, normals: NDArray[np.float64]) -> NDArray[np.int8]:
    """Whether each voxel and each of those around it are on one surface: 1, -1 with opposite normals, or 0."""
    alike = np.empty(len(grid.neighbours), np.int8)
    in_blocks(_compare_normals, grid.n_voxels, grid.neighbourhood, normals, alike)
    return alike


def _spread_votes(grid: VoxelGrid, alike: NDArray[np.int8], votes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Votes of the voxels, (v,), overwritten, with those of the voxels around that are alike."""
    smoothed = np.empty_like(votes)
    for _ in range(_SMOOTHING):
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


def visible_fraction(grid: VoxelGrid, place: NDArray[np.float64]) -> float:
    """Fraction of the voxels that are visible from a place, (3,) float64, metres."""
    return _visible_fraction(grid, place, either_normals(grid))


def shown_fraction(grid: VoxelGrid, place: NDArray[np.float64]) -> float:
    """Fraction of the surface that a place, (3,) float64, metres, shows: of the voxels that are joined as on a surface,
    those that are visible from there, or on one surface with such a one a few voxels away.

    All that one scan holds is shown by its place, but for what coarse voxels hide of what lies beside them; the far
    side of what a moving scanner passed is not.
    """
    normals, joined = either_normals(grid), grid.joined
    visible = _visible(grid, place, normals).astype(np.float64)
    shown = _spread_votes(grid, np.abs(_neighbours_on_one_surface(grid, normals)), visible) > 0.0
    return float(np.mean(shown[joined])) if joined.any() else 1.0


def _visible_fraction(grid: VoxelGrid, place: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    return float(_visible(grid, place, normals).mean())


def _visible(grid: VoxelGrid, place: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each voxel is visible from a place, (v,) bool."""
    middle, reach = unit_frame(grid, np.concatenate((grid.centroids, place[None])))
    centres, widths = (grid.centroids - middle) / reach, grid.edge_lengths / reach
    return visibility_from((place - middle)[None] / reach, centres, widths, normals)[0]


def likelier_viewpoint(grid: VoxelGrid, place: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """The likelier of two scanner positions, (3,) float64, metres: that from which more is visible."""
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
    if abs(cosine) > SAME_SURFACE_COSINE and most <= _OFF_PATCH:
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
    """Set the votes for the side of each voxel's normal, with those of the voxels around on the same surface."""
    indptr, neighbours = around
    for i in range(start, stop):
        total = votes[i]
        for a in range(indptr[i], indptr[i + 1]):
            total += alike[a] * votes[neighbours[a]]
        smoothed[i] = total / (indptr[i + 1] - indptr[i] + 1)
