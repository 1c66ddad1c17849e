# SPDX-License-Identifier: Apache-2.0
"""Occlusions: one supervoxel hides another from the sensor without touching it, and what may go on behind.

The voxels are seen in an image of directions; depth edges are sought along its rows and columns, and gathered by pairs
of supervoxels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.continuations import Continuations, continuations_of
from pcgraph.pairs import distinct_pairs
from pcgraph.parallel import kernel, routine
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.grid import Neighbourhood
from pcgraph.voxels.surface import Surface

_MAX_DEPTH = 32
"""Most things one behind the other along a line, a count: more than there are, so that the innermost are kept."""
_MAX_CELLS = 4e6
"""Most cells of the image, if it is of all directions, a count, so that it takes 16 megabytes."""
_MAX_CELLS_PER_VOXEL = 16
"""Most cells to either side of a voxel that it covers, a count, because one near the sensor covers all."""
_NO_MIDDLE = 1e-6
"""Length of a mean of unit vectors, a ratio, below which a panorama has no middle. Chosen above rounding."""
_TINY = 1e-300
"""Least range in metres, so that nothing is divided by zero."""
_REACH = 8.0
"""Widest gap without data that is looked across, voxel edges, because structured light leaves some."""
_MIN_GAP = 3.0
"""Least difference of range above which surfaces are apart, voxel edges. Chosen by eye."""


@dataclass(frozen=True, eq=False)
class Occlusions(ShortRepr):
    """Pairs of supervoxels next to each other as the sensor sees them, but apart in depth.

    A pair may touch elsewhere, and then has a contact edge as well; each may hide the other, in different places.

    Attributes
    ----------
    pairs : (q, 2) int32
        Supervoxel in front, supervoxel behind; rows in ascending order, once each.
    gap : (q,) float64, metres, > 0
        Mean difference of their ranges from the viewpoint along the boundary.
    length : (q,) float64, metres
        Sum of the edge lengths of the front's voxels along the boundary.
    direction : (q, 3) float64
        Unit mean direction from the front across the boundary, square to the line of sight; zero if it cancels.
    continuations : Continuations
        What may go on behind.
    """

    pairs: NDArray[np.int32]
    gap: NDArray[np.float64]
    length: NDArray[np.float64]
    direction: NDArray[np.float64]
    continuations: Continuations

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """Features of the pairs by name, in the order of the attributes."""
        return {field.name: getattr(self, field.name) for field in fields(self)[1:4]}


def occlusions(
    surface: Surface,
    nodes: NodeFeatures,
    viewpoint: ArrayLike,
    image: ArrayLike | None = None,
    *,
    reach: float = _REACH,
    least_gap: float = _MIN_GAP,
) -> Occlusions:
    """Occlusions between supervoxels, as seen from the viewpoint.

    Parameters
    ----------
    surface : Surface of v voxels
    nodes : NodeFeatures of the k supervoxels
    viewpoint : (3,) float, metres, the points' frame
        Where the sensor stood.
    image : (h, w) integers, optional
        For organised clouds: voxel of each pixel, -1 where there is none. Default: a spherical image of the voxels
        themselves, about one cell per voxel, which serves any cloud seen from one place.
    reach : float, voxels, > 0
        How wide a gap without data, as structured light leaves one along depth edges, is looked across.
    least_gap : float, voxels, > 0
        Difference of range above which surfaces are apart. The front has to stand off the plane of what is behind by
        half as much, since a slanted surface gets deeper as well.

    Raises
    ------
    ValueError
        Something is not as above.

    Notes
    -----
    Features are means over pairs of neighbouring cells along the image's rows and columns.
    """
    position = np.asarray(viewpoint, dtype=np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise ValueError(f"expected a viewpoint of three finite coordinates in metres, got {viewpoint!r}")
    for name, value in (("reach", reach), ("least_gap", least_gap)):
        if not 0.0 < value < np.inf:
            raise ValueError(f"expected {name} as a finite number of voxels above 0, got {value!r}")
    view = view_from(position, surface)
    seen = spherical_image(view) if image is None else SphericalImage(_checked(image, surface.grid.n_voxels), False)
    jumps = _depth_jumps(view, seen, reach, least_gap)
    return _collected(surface, view, jumps.edges, continuations_of(surface, nodes, jumps.occluded_spans))


def _checked(image: ArrayLike, n_voxels: int) -> NDArray[np.int32]:
    voxels = np.asarray(image)
    if voxels.ndim != 2 or voxels.dtype.kind not in "iu":
        raise ValueError(f"expected image as (h, w) integers, got {voxels.dtype} of shape {voxels.shape}")
    if voxels.size and not -1 <= voxels.min() <= voxels.max() < n_voxels:
        raise ValueError(f"expected image with voxels -1..{n_voxels - 1}, got {voxels.min()}..{voxels.max()}")
    return voxels.astype(np.int32)


def _collected(
    surface: Surface, view: _View, depth_edges: NDArray[np.int32], continuations: Continuations
) -> Occlusions:
    """Depth edges by pair of supervoxels."""
    front, behind = depth_edges.T
    pairs, pair = distinct_pairs(surface.supervoxels[front], surface.supervoxels[behind])
    q, bearings, ranges = len(pairs), view.bearings, view.ranges
    gap = np.bincount(pair, ranges[behind] - ranges[front], q) / np.bincount(pair, minlength=q)
    boundary = np.unique(pair * np.int64(surface.grid.n_voxels) + front)
    boundary_pair, boundary_voxel = np.divmod(boundary, surface.grid.n_voxels)
    edge_lengths = surface.grid.edge_lengths[boundary_voxel]
    length = np.bincount(boundary_pair, edge_lengths, q).astype(np.float64)  # int64 if q is 0
    across = bearings[behind] - bearings[front]
    sums = np.stack([np.bincount(pair, across[:, axis], q) for axis in range(3)], axis=1)
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    return Occlusions(pairs, gap, length, sums / np.maximum(norms, 1e-12), continuations)


# --- the nearest voxel in every direction -----------------------------------------------------------------------------


class _View(NamedTuple):
    """Voxels as they are seen from a place.

    Attributes
    ----------
    bearings : (v, 3) float64
        Unit directions to them.
    ranges, edge_lengths : (v,) float64, metres
    normals : (v, 3) float64
    supervoxels : (v,) int32
    neighbourhood : Neighbourhood
    """

    bearings: NDArray[np.float64]
    ranges: NDArray[np.float64]
    edge_lengths: NDArray[np.float64]
    normals: NDArray[np.float64]
    supervoxels: NDArray[np.int32]
    neighbourhood: Neighbourhood


def view_from(place: NDArray[np.float64], surface: Surface) -> _View:
    """The voxels of a surface as they are seen from a place, (3,) metres."""
    grid = surface.grid
    ways = grid.centroids - place
    ranges = np.maximum(np.linalg.norm(ways, axis=1), _TINY)
    bearings = ways / ranges[:, None]
    return _View(bearings, ranges, grid.edge_lengths, surface.normals, surface.supervoxels, grid.neighbourhood)


class SphericalImage(NamedTuple):
    """Directions in rows and columns, with the voxel seen in each; cells that touch are neighbouring directions.

    Attributes
    ----------
    voxels : (h, w) int32
        The voxel that is seen in each cell, -1 where there is none.
    wraps : bool
        Whether rows go round: what lies between last column and first is a gap like any other, as in a panorama.
    """

    voxels: NDArray[np.int32]
    wraps: bool


def spherical_image(view: _View) -> SphericalImage:
    """The nearest voxel in every direction, by azimuth and elevation; one at median distance fills about one cell.

    The poles lie in the direction and counter-direction in which there is least to see, the seam behind the middle of
    the view, so that a camera's image has neither. Lines of the octahedral map of `depth_buffer` would not do: they
    turn by up to 45 degrees, so that what vanishes at one side of a thing would come out at the next.
    """
    seen = np.flatnonzero(view.ranges > 0.5 * view.edge_lengths)  # the sensor's own voxel lies in no direction
    if not len(seen):
        return SphericalImage(np.full((1, 1), -1, np.int32), False)
    cell = max(float(np.median(view.edge_lengths[seen] / view.ranges[seen])), math.sqrt(4.0 * math.pi / _MAX_CELLS))
    along, aside, up = np.einsum("ij,kj->ki", view.bearings[seen], _frame(view.bearings[seen]))
    angles = np.stack((np.arcsin(np.clip(up, -1.0, 1.0)), np.arctan2(aside, along)))
    first, last = angles.min(axis=1), angles.max(axis=1)
    voxels = np.full(((last - first) / cell).astype(np.int64) + 1, -1, np.int32)
    _draw(view, seen, angles, first, cell, voxels)
    return SphericalImage(voxels, bool(last[1] - first[1] > math.pi))


def _frame(bearings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Forward, sideways and polar direction, rows of (3, 3)."""
    mean = bearings.mean(axis=0)
    pole = np.linalg.eigh(np.einsum("ij,ik->jk", bearings, bearings))[1][:, 0]
    forward = mean - pole * (pole @ mean)
    if np.linalg.norm(forward) < _NO_MIDDLE:  # as much on one side as on the other: any forward will do
        forward = np.cross(pole, np.eye(3)[np.abs(pole).argmin()])
    forward /= np.linalg.norm(forward)
    return np.stack((forward, np.cross(pole, forward), pole))


@kernel
def _draw(
    view: _View,
    seen: NDArray[np.int64],
    angles: NDArray[np.float64],
    first: NDArray[np.float64],
    cell: float,
    image: NDArray[np.int32],
) -> None:
    """Set the nearest voxel of each cell; `first` is elevation and azimuth, radians, of the image's corner."""
    height, width = image.shape
    for at in range(len(seen)):
        i = np.int32(seen[at])
        cells = 0.5 * view.edge_lengths[i] / (view.ranges[i] * cell)
        up = int(min(math.ceil(cells - 0.5), _MAX_CELLS_PER_VOXEL))
        aside = int(min(math.ceil(cells / max(math.cos(angles[0, at]), 1e-3) - 0.5), _MAX_CELLS_PER_VOXEL))
        row, column = int((angles[0, at] - first[0]) / cell), int((angles[1, at] - first[1]) / cell)
        for r in range(max(row - up, 0), min(row + up + 1, height)):
            for c in range(max(column - aside, 0), min(column + aside + 1, width)):
                if image[r, c] < 0 or view.ranges[i] < view.ranges[image[r, c]]:
                    image[r, c] = i


# --- depth edges along lines ------------------------------------------------------------------------------------------


class _Jumps(NamedTuple):
    """Jumps of depth along the lines of an image.

    Attributes
    ----------
    edges : (e, 2) int32
        Voxels in front and behind, next to each other.
    occluded_spans : (c, 2) int32
        Ends of the spans that something hides: the voxel where a surface disappears, and that which appears beyond.
    """

    edges: NDArray[np.int32]
    occluded_spans: NDArray[np.int32]


def _depth_jumps(view: _View, image: SphericalImage, reach: float, least_gap: float) -> _Jumps:
    """Jumps of depth along the rows and columns of an image.

    `reach` and `least_gap` are in voxel edges, as for `occlusions`.
    """
    lines = (image.voxels, image.wraps), (np.ascontiguousarray(image.voxels.T), False)
    found = [_scan(voxels, wraps, view, reach, least_gap) for voxels, wraps in lines]
    edges, occluded_spans = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _Jumps(edges, occluded_spans)


@kernel
def _scan(  # type: ignore[no-untyped-def]
    image: NDArray[np.int32], wraps: bool, view: _View, reach: float, least_gap: float
):
    """Depth edges (e, 2), front and behind, and occluded spans (c, 2), both int32 voxels, along the image's rows.

    Where a line passes from far to near, the far surface goes into hiding; where it passes from near to far, what
    comes out is paired with what went in last. A hole in the data ends all hiding.
    """
    ranges, edge_lengths, supervoxels = view.ranges, view.edge_lengths, view.supervoxels
    indptr, neighbours = view.neighbourhood
    depth_edges = np.empty((image.size, 2), np.int32)
    occluded_spans = np.empty((image.size, 2), np.int32)
    hidden, line = np.empty(_MAX_DEPTH, np.int32), np.empty(2 * image.shape[1] + 4, np.int32)
    n_edges = n_spans = 0
    for row in range(image.shape[0]):
        stop, lap = _voxels_along(image[row], wraps, line)
        depth = 0
        for at in range(1, stop - 1):
            before, i = line[at], line[at + 1]
            if supervoxels[before] == supervoxels[i]:
                continue
            comes_out = ranges[before] < ranges[i]
            front, behind, beyond = (before, i, line[at + 2]) if comes_out else (i, before, line[at - 1])
            if _apart(front, behind, view, reach):
                depth = 0
                continue
            edge = max(edge_lengths[front], edge_lengths[behind])
            if ranges[behind] - ranges[front] < least_gap * edge:
                continue
            if beyond >= 0 and _apart(behind, beyond, view, reach):
                beyond = -1
            first, last = np.int64(indptr[front]), np.int64(indptr[front + 1])
            stands_off = _stands_off(front, behind, beyond, view, least_gap * edge)
            if not stands_off or np.any(neighbours[first:last] == behind):
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
    return depth_edges[:n_edges].copy(), occluded_spans[:n_spans].copy()


@routine
def _voxels_along(cells: NDArray[np.int32], wraps: bool, line: NDArray[np.int32]) -> tuple[int, int]:
    """Set the voxels in these cells, each once in a row, from ``line[1]`` on; -1 is around them.

    Returns their end and where the second lap starts: of a panorama they are there twice, as lines go round.
    """
    n = 1
    line[0] = line[1] = -1
    for cell in cells:
        if cell >= 0 and cell != line[n]:
            n += line[n] >= 0
            line[n] = cell
    n += line[n] >= 0
    lap = n
    if wraps and lap > 2:
        n -= line[n - 1] == line[1]
        lap = n
        line[n : 2 * n - 1] = line[1:n]
        n = 2 * n - 1
    line[n] = -1
    return n, lap


@routine
def _apart(front: int, behind: int, view: _View, reach: float) -> bool:
    """Whether two bearings lie further apart than `reach` voxel edges."""
    bearings, ranges, widths = view.bearings, view.ranges, view.edge_lengths
    total = 0.0
    for axis in range(3):
        total += (bearings[front, axis] - bearings[behind, axis]) ** 2
    return total > (reach * max(widths[front] / ranges[front], widths[behind] / ranges[behind])) ** 2


@routine
def _stands_off(front: int, behind: int, beyond: int, view: _View, gap: float) -> bool:
    """Whether `front`, nearer than `behind` by the gap, is half as far off the surface to which that belongs.

    A surface seen at a slant gets deeper, too, but stays in its plane (the normal's), and in its line (to the voxel
    beyond): the latter holds where lines are too far apart for normals, as the rings of a spinning scanner.
    """
    bearings, ranges, normals = view.bearings, view.ranges, view.normals
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
