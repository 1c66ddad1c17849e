# SPDX-License-Identifier: Apache-2.0
"""What is seen from a place: the nearest voxel in every direction, and where along lines of that image depth jumps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.voxels.grid import Neighbourhood
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.visibility import occluder_subset

_MAX_CELLS = 4e6
_MAX_CELLS_PER_VOXEL = 16  # to either side; only voxels that nearly touch the sensor are wider
_OF_VOXEL = 0.25  # at median distance, a cell through which things are seen; between two voxels
_MIDDLE, _BEHIND = 0.3, 1.5  # of the way between them, from its middle; and voxel edges farther than both, at least
_OFF_PLANE, _OFF_SLOPE = 0.75, 0.05  # voxel edges, and of the distance, at least, that it lies off the planes of both
_MAX_DEPTH = 32  # things one behind the other along a line


class Surfels(NamedTuple):
    """Surfels by which visibility is computed: one per voxel, or larger ones for some where voxels are many.

    Attributes
    ----------
    voxels : (s,) int64
        All that follows has a row for each.
    centroids, normals : (s, 3) float64
    edge_lengths, widths : (s,) float64, metres
        Of the voxels, and of the surfels, which are wider where they stand for voxels beside them.
    supervoxels : (s,) int32
    neighbourhood : Neighbourhood of s voxels
        Which of them touch; none where some stand for others.
    """

    voxels: NDArray[np.int64]
    centroids: NDArray[np.float64]
    normals: NDArray[np.float64]
    edge_lengths: NDArray[np.float64]
    widths: NDArray[np.float64]
    supervoxels: NDArray[np.int32]
    neighbourhood: Neighbourhood


def surfels_of(surface: Surface, some: bool = False) -> Surfels:
    """All voxels of a surface, or, if they are many, some."""
    grid, normals, labels = surface.grid, surface.normals, surface.supervoxels
    voxels, stretch = occluder_subset(grid) if some else (np.arange(grid.n_voxels), 1.0)
    edges = grid.edge_lengths
    if len(voxels) == grid.n_voxels:
        return Surfels(voxels, grid.centroids, normals, edges, edges, labels, grid.neighbourhood)
    none_touch = Neighbourhood(np.zeros(len(voxels) + 1, np.uint64), np.empty(0, np.uint32))
    edges = edges[voxels]
    return Surfels(voxels, grid.centroids[voxels], normals[voxels], edges, stretch * edges, labels[voxels], none_touch)


class View(NamedTuple):
    """Surfels as they are seen from a place: unit directions to them, (s, 3), and distances, (s,) float64, metres."""

    surfels: Surfels
    bearings: NDArray[np.float64]
    ranges: NDArray[np.float64]


def view_from(place: NDArray[np.float64], surfels: Surfels) -> View:
    """Surfels as they are seen from a place, (3,) float64, metres."""
    s = len(surfels.voxels)
    bearings, ranges = np.empty((s, 3)), np.empty(s)
    in_blocks(_look, s, place, surfels.centroids, bearings, ranges)
    return View(surfels, bearings, ranges)


@kernel
def _look(
    start: int,
    stop: int,
    place: NDArray[np.float64],
    centroids: NDArray[np.float64],
    bearings: NDArray[np.float64],
    ranges: NDArray[np.float64],
) -> None:
    """Set the unit direction and the distance from the place to each centroid."""
    for i in range(start, stop):
        x, y, z = centroids[i, 0] - place[0], centroids[i, 1] - place[1], centroids[i, 2] - place[2]
        ranges[i] = max(math.sqrt(x * x + y * y + z * z), 1e-300)
        bearings[i, 0], bearings[i, 1], bearings[i, 2] = x / ranges[i], y / ranges[i], z / ranges[i]


# --- the nearest voxel in every direction ---


@dataclass(frozen=True, eq=False)
class SphericalImage:
    """A lattice of directions with the voxel seen in each.

    Attributes
    ----------
    voxels : (h, w) int32
        Surfel that is seen, -1 where none. Cells that touch are neighbouring directions.
    wraps : bool
        Whether what lies between the last column and the first is a gap like any other, as in a panorama.
    """

    voxels: NDArray[np.int32]
    wraps: bool = False

    @cached_property
    def lines(self) -> tuple[tuple[NDArray[np.int32], bool], tuple[NDArray[np.int32], bool]]:
        """Its rows, and its columns as rows, and whether they wrap."""
        return (self.voxels, self.wraps), (np.ascontiguousarray(self.voxels.T), False)


def spherical_image(view: View) -> SphericalImage:
    """Spherical image in which a voxel at median distance fills about one cell.

    Notes
    -----
    The poles lie in the direction and counter-direction in which there is least to see, the seam behind the middle of
    the view, so that a camera's image has neither. Nearer voxels hide farther ones and fill as many cells as their
    width needs.
    """
    found = _lattice(view, 1.0)
    if found is None:
        return SphericalImage(np.full((1, 1), -1, np.int32))
    lattice, seen, angles = found
    voxels = np.full(lattice.shape, -1, np.int32)
    _set_nearest(view.ranges, view.surfels.widths, seen, angles, lattice.first, lattice.cell, voxels)
    return SphericalImage(voxels, bool(angles[0].max() - lattice.first[0] > math.pi))


class _Lattice(NamedTuple):
    """Directions in rows and columns, a cell apart (radians), the first at azimuth and elevation `first`, (2,), in a
    frame, (3, 3), whose rows point forward, sideways and to the pole."""

    frame: NDArray[np.float64]
    first: NDArray[np.float64]
    cell: float
    shape: tuple[int, int]


def _lattice(view: View, of_width: float) -> tuple[_Lattice, NDArray[np.int64], NDArray[np.float64]] | None:
    """A lattice of cells of so many widths of a surfel at median distance; the surfels that lie in a direction, (s,),
    and their azimuths and elevations in its frame, (2, s). None if all lie at the place."""
    surfels = view.surfels
    seen = np.flatnonzero(view.ranges > 0.5 * surfels.edge_lengths)  # the sensor's own voxel lies in no direction
    if not len(seen):
        return None
    cell = of_width * float(np.median(surfels.widths[seen] / view.ranges[seen]))
    cell = max(cell, math.sqrt(4.0 * math.pi / _MAX_CELLS))
    frame, angles = _frame(view.bearings, seen), np.empty((2, len(seen)))
    in_blocks(_set_angles, len(seen), view.bearings, seen, frame, angles)
    first, last = angles.min(axis=1), angles.max(axis=1)
    width, height = ((last - first) / cell).astype(np.int64) + 1
    return _Lattice(frame, first, cell, (int(height), int(width))), seen, angles


def _frame(bearings: NDArray[np.float64], seen: NDArray[np.int64]) -> NDArray[np.float64]:
    """Forward, sideways and polar direction, rows of (3, 3)."""
    along = np.ascontiguousarray(bearings[seen].T)
    mean = along.mean(axis=1)
    pole = np.linalg.eigh(np.einsum("ik,jk->ij", along, along))[1][:, 0]
    forward = mean - pole * (pole @ mean)
    if np.linalg.norm(forward) < 1e-6:  # as much on one side as on the other: any forward will do
        forward = np.cross(pole, np.eye(3)[np.abs(pole).argmin()])
    forward /= np.linalg.norm(forward)
    return np.stack((forward, np.cross(pole, forward), pole))


@kernel
def _set_angles(
    start: int,
    stop: int,
    bearings: NDArray[np.float64],
    seen: NDArray[np.int64],
    frame: NDArray[np.float64],
    angles: NDArray[np.float64],
) -> None:
    """Set azimuth and elevation of some directions, (2, s)."""
    for at in range(start, stop):
        along = aside = height = 0.0
        for axis in range(3):
            part = bearings[seen[at], axis]
            along += frame[0, axis] * part
            aside += frame[1, axis] * part
            height += frame[2, axis] * part
        angles[0, at], angles[1, at] = math.atan2(aside, along), math.asin(min(max(height, -1.0), 1.0))


@kernel
def _set_nearest(
    ranges: NDArray[np.float64],
    widths: NDArray[np.float64],
    seen: NDArray[np.int64],
    angles: NDArray[np.float64],
    first: NDArray[np.float64],
    cell: float,
    image: NDArray[np.int32],
) -> None:
    """Set the nearest surfel of each cell; `first` is the angles of the image's corner."""
    height, width = image.shape
    for at in range(len(seen)):
        i = np.int32(seen[at])
        cells = 0.5 * widths[i] / (ranges[i] * cell)
        up = int(min(math.ceil(cells - 0.5), _MAX_CELLS_PER_VOXEL))
        aside = int(min(math.ceil(cells / max(math.cos(angles[1, at]), 1e-3) - 0.5), _MAX_CELLS_PER_VOXEL))
        column, row = int((angles[0, at] - first[0]) / cell), int((angles[1, at] - first[1]) / cell)
        for r in range(max(row - up, 0), min(row + up + 1, height)):
            for c in range(max(column - aside, 0), min(column + aside + 1, width)):
                if image[r, c] < 0 or ranges[i] < ranges[image[r, c]]:
                    image[r, c] = i


# --- what is seen between two voxels ---


def seen_through(view: View, source: NDArray[np.int64], target: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether something behind both is seen between two voxels, for each of m pairs of all that a view has, (m,).

    Returns
    -------
    (m,) bool
        Whether a voxel is farther off than both by one and a half edges, in a direction no farther from the middle
        between them than three tenths of the way, and lies off both planes: ground farther off is the same ground.
    """
    through, found = np.zeros(len(source), np.bool_), _lattice(view, _OF_VOXEL)
    if found is not None:
        lattice, seen, angles = found
        farthest = np.full(lattice.shape, -1, np.int32)
        _set_farthest(view.ranges, seen, angles, lattice, farthest)
        in_blocks(_see_through, len(source), source, target, view, lattice, farthest, through)
    return through


@kernel
def _set_farthest(
    ranges: NDArray[np.float64],
    seen: NDArray[np.int64],
    angles: NDArray[np.float64],
    lattice: _Lattice,
    farthest: NDArray[np.int32],
) -> None:
    """Set the farthest voxel whose centroid is in each cell of the lattice."""
    for at in range(len(seen)):
        column = int((angles[0, at] - lattice.first[0]) / lattice.cell)
        row = int((angles[1, at] - lattice.first[1]) / lattice.cell)
        if farthest[row, column] < 0 or ranges[seen[at]] > ranges[farthest[row, column]]:
            farthest[row, column] = seen[at]


@kernel
def _see_through(
    start: int,
    stop: int,
    source: NDArray[np.int64],
    target: NDArray[np.int64],
    view: View,
    lattice: _Lattice,
    farthest: NDArray[np.int32],
    through: NDArray[np.bool_],
) -> None:
    """Set what `seen_through` returns, given the farthest voxel in each cell of the lattice."""
    (height, width), cell, corner = farthest.shape, lattice.cell, lattice.first
    frame, bearings, ranges, edge_lengths = lattice.frame, view.bearings, view.ranges, view.surfels.edge_lengths
    for i in range(start, stop):
        p, q = source[i], target[i]
        behind = max(ranges[p], ranges[q]) + _BEHIND * max(edge_lengths[p], edge_lengths[q])
        along = aside = up = square = across = 0.0
        for axis in range(3):
            middle = 0.5 * (ranges[p] * bearings[p, axis] + ranges[q] * bearings[q, axis])
            along += frame[0, axis] * middle
            aside += frame[1, axis] * middle
            up += frame[2, axis] * middle
            square += middle * middle
            across += (bearings[p, axis] - bearings[q, axis]) ** 2
        azimuth = math.atan2(aside, along) - corner[0]
        elevation = math.asin(min(max(up / math.sqrt(max(square, 1e-300)), -1.0), 1.0)) - corner[1]
        radius = min(_MIDDLE * math.sqrt(across), _MAX_CELLS_PER_VOXEL * cell)
        narrowing = max(math.cos(elevation + corner[1]), 1e-3)
        reach = radius / narrowing
        for row in range(max(int((elevation - radius) / cell), 0), min(int((elevation + radius) / cell) + 1, height)):
            for column in range(max(int((azimuth - reach) / cell), 0), min(int((azimuth + reach) / cell) + 1, width)):
                far = farthest[row, column]
                x, y = ((column + 0.5) * cell - azimuth) * narrowing, (row + 0.5) * cell - elevation
                if far >= 0 and x * x + y * y <= radius * radius and ranges[far] > behind:
                    through[i] = through[i] or (_is_off(far, p, view.surfels) and _is_off(far, q, view.surfels))


@routine
def _is_off(far: int, near: int, surfels: Surfels) -> bool:
    """Whether one voxel lies off the plane of another."""
    height = square = 0.0
    for axis in range(3):
        way = surfels.centroids[far, axis] - surfels.centroids[near, axis]
        height += way * surfels.normals[near, axis]
        square += way * way
    return abs(height) > max(_OFF_PLANE * surfels.edge_lengths[near], _OFF_SLOPE * math.sqrt(square))


# --- depth edges along the lines of that image ---


class Jumps(NamedTuple):
    """Where depth jumps along the lines of an image.

    Attributes
    ----------
    edges : (e, 2) int32
        Surfels in front and behind, next to each other.
    occluded_spans : (c, 2) int32
        Ends of the spans that something hides: the surfel where a surface disappears, and that which appears beyond.
    """

    edges: NDArray[np.int32]
    occluded_spans: NDArray[np.int32]


def depth_jumps(view: View, image: SphericalImage, reach: float, least_gap: float) -> Jumps:
    """Where depth jumps along the rows and columns of an image.

    Parameters
    ----------
    view : View
    image : SphericalImage of it
    reach : float, widths
        How wide a gap without data is looked across.
    least_gap : float, voxel edges
        Difference of range above which surfaces are apart.
    """
    found = []
    for voxels, wraps in image.lines:
        jumps = Jumps(np.empty((voxels.size, 2), np.int32), np.empty((voxels.size, 2), np.int32))
        n_edges, n_spans = _scan(voxels, wraps, view, reach, least_gap, line_buffers(voxels), jumps)
        found.append((jumps.edges[:n_edges], jumps.occluded_spans[:n_spans]))
    edges, occluded_spans = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Jumps(edges, occluded_spans)


@kernel
def _scan(
    image: NDArray[np.int32],
    wraps: bool,
    view: View,
    reach: float,
    least_gap: float,
    buffers: NDArray[np.int32],
    jumps: Jumps,
) -> tuple[int, int]:
    """Set the jumps along the image's rows; how many depth edges and occluded spans there are.

    Where a line passes from far to near, the far surface goes into hiding; where it passes from near to far, what
    comes out is paired with what went in last. A hole in the data ends all hiding.
    """
    ranges, edge_lengths, supervoxels = view.ranges, view.surfels.edge_lengths, view.surfels.supervoxels
    indptr, neighbours = view.surfels.neighbourhood
    depth_edges, occluded_spans = jumps
    line, columns, hidden = buffers[0], buffers[1], buffers[2]  # a line is longer than what is hidden at once
    n_edges = n_spans = 0
    for row in range(image.shape[0]):
        stop, lap = surfels_along(image[row], wraps, line, columns)
        depth = 0
        for at in range(1, stop - 1):
            before, i = line[at], line[at + 1]
            if supervoxels[before] == supervoxels[i]:
                continue
            comes_out = ranges[before] < ranges[i]
            front, behind, beyond = (before, i, line[at + 2]) if comes_out else (i, before, line[at - 1])
            if apart(front, behind, view, reach):
                depth = 0
                continue
            edge = max(edge_lengths[front], edge_lengths[behind])
            if ranges[behind] - ranges[front] < least_gap * edge:
                continue
            if beyond >= 0 and apart(behind, beyond, view, reach):
                beyond = -1
            touches = False
            for a in range(indptr[front], indptr[front + 1]):
                touches = touches or neighbours[a] == behind
            if touches or not _stands_off(front, behind, beyond, view, least_gap * edge):
                continue
            if at < lap or not wraps:
                depth_edges[n_edges, 0], depth_edges[n_edges, 1] = front, behind
                n_edges += 1
            if not comes_out:
                hidden[depth % _MAX_DEPTH] = behind
                depth += 1
            elif depth > 0:
                depth -= 1
                entered = hidden[depth % _MAX_DEPTH]
                known = at >= lap or not wraps  # of a panorama's first lap it is not known what is hidden at its start
                if known and ranges[entered] > ranges[front] and supervoxels[entered] != supervoxels[behind]:
                    occluded_spans[n_spans, 0], occluded_spans[n_spans, 1] = entered, behind
                    n_spans += 1
    return n_edges, n_spans


def line_buffers(image: NDArray[np.int32]) -> NDArray[np.int32]:
    """Buffers for what `surfels_along` sets, and one more as long, as rows."""
    return np.empty((3, max(2 * image.shape[1] + 4, _MAX_DEPTH)), np.int32)


@routine
def surfels_along(
    cells: NDArray[np.int32], wraps: bool, line: NDArray[np.int32], columns: NDArray[np.int32]
) -> tuple[int, int]:
    """Set the surfels in these cells, each once in a row, from ``line[1]`` on, and where they begin; -1 is around them.

    Returns their end and where the second lap starts: of a panorama they are there twice, as lines go round.
    """
    n = 1
    line[0] = line[1] = -1
    for column in range(len(cells)):
        cell = cells[column]
        if cell >= 0 and cell != line[n]:
            n += line[n] >= 0
            line[n], columns[n] = cell, column
    n += line[n] >= 0
    lap = n
    if wraps and lap > 2:
        n -= line[n - 1] == line[1]
        lap = n
        for at in range(1, lap):
            line[n], columns[n] = line[at], columns[at] + len(cells)
            n += 1
    line[n] = -1
    return n, lap


@routine
def apart(front: int, behind: int, view: View, reach: float) -> bool:
    """Whether two bearings lie further apart than `reach` widths."""
    bearings, ranges, widths = view.bearings, view.ranges, view.surfels.widths
    total = 0.0
    for axis in range(3):
        total += (bearings[front, axis] - bearings[behind, axis]) ** 2
    return total > (reach * max(widths[front] / ranges[front], widths[behind] / ranges[behind])) ** 2


@routine
def _stands_off(front: int, behind: int, beyond: int, view: View, gap: float) -> bool:
    """Whether `front`, nearer than `behind` by the gap, is half as far off the surface to which that belongs.

    A surface seen at a slant gets deeper, too, but stays in its plane (the normal's), and in its line (to the voxel
    beyond): the latter holds where lines are too far apart for normals, as the rings of a spinning scanner.
    """
    bearings, ranges, normals = view.bearings, view.ranges, view.surfels.normals
    height = offsets = along = lengths = 0.0
    for axis in range(3):
        at = ranges[behind] * bearings[behind, axis]
        offset = ranges[front] * bearings[front, axis] - at
        height += offset * normals[behind, axis]
        if beyond >= 0:
            further = ranges[beyond] * bearings[beyond, axis] - at
            offsets, along, lengths = offsets + offset * offset, along + offset * further, lengths + further * further
    if height < 0.5 * gap:
        return False
    return lengths == 0.0 or offsets - along * along / lengths > (0.5 * gap) ** 2
