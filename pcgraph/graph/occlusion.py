# SPDX-License-Identifier: Apache-2.0
"""Where one supervoxel hides another from the sensor without touching it, and what may go on behind.

The voxels are seen in an image of directions; depth edges are sought along its rows and columns, and gathered by pairs
of supervoxels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.contacts import angle_between
from pcgraph.parallel import kernel, routine
from pcgraph.short_repr import ShortRepr
from pcgraph.voxels.surface import Surface

_SMOOTH_RAD = 0.2  # surfaces at most this far apart in angle
_SMOOTH_VOXELS = 2.0  # and in height may be one
_MAX_CELLS = 4e6
_MAX_CELLS_PER_VOXEL = 16  # to either side; only voxels that nearly touch the sensor are wider
_MAX_DEPTH = 32  # things one behind the other along a line


@dataclass(frozen=True, eq=False)
class Continuations(ShortRepr):
    """Pairs of supervoxels that vanish behind something on one side and appear from behind it on the other.

    Attributes
    ----------
    pairs : (r, 2) int32
        Supervoxels i < j, rows in ascending order, once each.
    crossings : (r,) int64
        Lines of the bearing image along which that happens.
    width : (r,) float64, metres
        Mean distance across what hides the surface between.
    angle : (r,) float64, radians, 0..pi
        Angle between the supervoxels' normals.
    offset : (r,) float64, metres
        Mean distance of either's boundary from the other's plane, the larger of the two.
    color_contrast : (r,) float64, 0..sqrt(3)
        Distance of mean colours; 0 if the cloud has none.
    coplanar : (r,) bool
        Whether the two could be one flat surface: angle of at most 0.2 rad, and offset of at most two voxels or a
        tenth of the width.
    """

    pairs: NDArray[np.int32]
    crossings: NDArray[np.int64]
    width: NDArray[np.float64]
    angle: NDArray[np.float64]
    offset: NDArray[np.float64]
    color_contrast: NDArray[np.float64]
    coplanar: NDArray[np.bool_]


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
    reach: float = 8.0,
    least_gap: float = 3.0,
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
    grid = surface.grid
    seen = bearing_image(surface, position) if image is None else BearingImage(_checked(image, grid.n_voxels))
    rays = grid.centroids - position
    ranges = np.maximum(np.sqrt(np.einsum("ij,ij->i", rays, rays)), 1e-300)
    bearings = rays / ranges[:, None]
    view = View(bearings, ranges, surface.normals, grid.edge_lengths, surface.supervoxels, *grid.neighbourhood)
    found = [
        _scan(np.ascontiguousarray(lines), wraps, view, reach, least_gap)
        for lines, wraps in ((seen.voxels, seen.wraps), (seen.voxels.T, False))
    ]
    depth_edges, hidings = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _collected(surface, bearings, ranges, depth_edges, _continuations(surface, nodes, hidings))


def _checked(image: ArrayLike, n_voxels: int) -> NDArray[np.int32]:
    voxels = np.asarray(image)
    if voxels.ndim != 2 or voxels.dtype.kind not in "iu":
        raise ValueError(f"expected image as (h, w) integers, got {voxels.dtype} of shape {voxels.shape}")
    if voxels.size and not -1 <= voxels.min() <= voxels.max() < n_voxels:
        raise ValueError(f"expected image with voxels -1..{n_voxels - 1}, got {voxels.min()}..{voxels.max()}")
    return voxels.astype(np.int32)


def _collected(
    surface: Surface,
    bearings: NDArray[np.float64],
    ranges: NDArray[np.float64],
    depth_edges: NDArray[np.int32],
    continuations: Continuations,
) -> Occlusions:
    """Depth edges by pair of supervoxels."""
    front, behind = depth_edges.T
    pairs, pair = _pairs(surface.supervoxels[front], surface.supervoxels[behind])
    q = len(pairs)
    gap = np.bincount(pair, ranges[behind] - ranges[front], q) / np.bincount(pair, minlength=q)
    boundary = np.unique(pair * np.int64(surface.grid.n_voxels) + front)
    boundary_pair, boundary_voxel = np.divmod(boundary, surface.grid.n_voxels)
    edge_lengths = surface.grid.edge_lengths[boundary_voxel]
    length = np.bincount(boundary_pair, edge_lengths, q).astype(np.float64)  # int64 if q is 0
    across = bearings[behind] - bearings[front]
    sums = np.stack([np.bincount(pair, across[:, axis], q) for axis in range(3)], axis=1)
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    return Occlusions(pairs, gap, length, sums / np.maximum(norms, 1e-12), continuations)


def _continuations(surface: Surface, nodes: NodeFeatures, hidings: NDArray[np.int32]) -> Continuations:
    """Hidings by pair of supervoxels."""
    owners = surface.supervoxels[hidings]
    swap = owners[:, 0] > owners[:, 1]
    hidings, owners = (np.where(swap[:, None], both[:, ::-1], both) for both in (hidings, owners))
    pairs, pair = _pairs(owners[:, 0], owners[:, 1])
    r, (i, j) = len(pairs), pairs.T
    crossings = np.bincount(pair, minlength=r)
    ends = surface.grid.centroids[hidings]
    width = np.bincount(pair, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), r) / crossings
    heights = [
        np.bincount(pair, np.abs(_heights(ends[:, 1 - side], owners[:, side], nodes)), r) / crossings for side in (0, 1)
    ]
    edge = np.bincount(pair, surface.grid.edge_lengths[hidings].mean(axis=1), r) / crossings
    angle, offset = angle_between(nodes.normal[i], nodes.normal[j]), np.maximum(*heights)
    contrast = np.nan_to_num(np.linalg.norm(nodes.color[j] - nodes.color[i], axis=1))
    coplanar = (angle <= _SMOOTH_RAD) & (offset <= np.maximum(_SMOOTH_VOXELS * edge, 0.1 * width))
    return Continuations(pairs, crossings, width, angle, offset, contrast, coplanar)


def _heights(points: NDArray[np.float64], owners: NDArray[np.int32], nodes: NodeFeatures) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", points - nodes.centroid[owners], nodes.normal[owners])


def _pairs(first: NDArray[np.int32], second: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Distinct pairs in ascending order, (q, 2) int32, and the pair of each row."""
    keys, inverse = np.unique((first.astype(np.int64) << 32) + second, return_inverse=True)
    return np.stack((keys >> 32, keys & 0xFFFFFFFF), axis=1).astype(np.int32), inverse


# --- what the sensor sees where: the nearest voxel in every direction ---


@dataclass(frozen=True, eq=False)
class BearingImage:
    """A lattice of directions with the voxel seen in each.

    Attributes
    ----------
    voxels : (h, w) int32
        Voxel seen, -1 where none. Cells that touch are neighbouring directions.
    wraps : bool
        Whether what lies between the last column and the first is a gap like any other, as in a panorama.
    """

    voxels: NDArray[np.int32]
    wraps: bool = False


def bearing_image(surface: Surface, viewpoint: NDArray[np.float64]) -> BearingImage:
    """Spherical image around the viewpoint in which a voxel at median distance fills about one cell.

    Parameters
    ----------
    surface : Surface of v voxels
    viewpoint : (3,) float64, metres, the points' frame

    Notes
    -----
    The poles lie in the direction and counter-direction in which there is least to see, the seam behind the middle of
    the view, so that a camera's image has neither. Nearer voxels hide farther ones and fill as many cells as their
    width needs.
    """
    grid = surface.grid
    rays = grid.centroids - viewpoint
    ranges = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    seen = np.flatnonzero(ranges > 0.5 * grid.edge_lengths)  # the sensor's own voxel lies in no direction
    if not len(seen):
        return BearingImage(np.full((1, 1), -1, np.int32))
    bearings = rays[seen] / ranges[seen, None]
    width = grid.edge_lengths[seen] / ranges[seen]
    cell = max(float(np.median(width)), np.sqrt(4.0 * np.pi / _MAX_CELLS))
    frame = _frame(bearings)
    azimuth = np.arctan2(bearings @ frame[1], bearings @ frame[0])
    height = bearings @ frame[2]
    elevation = np.arcsin(np.clip(height, -1.0, 1.0))
    row = ((elevation - elevation.min()) / cell).astype(np.int64)
    column = ((azimuth - azimuth.min()) / cell).astype(np.int64)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    half = np.ceil(0.5 * width / cell - 0.5)
    stretched = np.ceil(0.5 * width / (cell * np.sqrt(np.maximum(1.0 - height * height, 1e-6))) - 0.5)
    halves = np.minimum(np.stack((half, stretched), axis=1), _MAX_CELLS_PER_VOXEL).astype(np.int64)
    voxels = _nearest(row, column, halves, seen.astype(np.int32), ranges, *shape)
    return BearingImage(voxels, bool(np.ptp(azimuth) > np.pi))


def _frame(bearings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Forward, sideways and polar direction, rows of (3, 3)."""
    pole = np.linalg.eigh(bearings.T @ bearings)[1][:, 0]
    mean = bearings.mean(axis=0)
    forward = mean - pole * (pole @ mean)
    if np.linalg.norm(forward) < 1e-6:  # as much on one side as on the other: any forward will do
        forward = np.cross(pole, np.eye(3)[np.abs(pole).argmin()])
    forward /= np.linalg.norm(forward)
    return np.stack((forward, np.cross(pole, forward), pole))


@kernel
def _nearest(row, column, halves, voxel, ranges, height, width):  # type: ignore[no-untyped-def]
    """The nearest voxel of each cell, -1 where there is none."""
    image = np.full((height, width), -1, np.int32)
    for i in range(len(voxel)):
        for r in range(max(row[i] - halves[i, 0], 0), min(row[i] + halves[i, 0] + 1, height)):
            for c in range(max(column[i] - halves[i, 1], 0), min(column[i] + halves[i, 1] + 1, width)):
                if image[r, c] < 0 or ranges[voxel[i]] < ranges[image[r, c]]:
                    image[r, c] = voxel[i]
    return image


# --- depth edges along the lines of that image ---


class View(NamedTuple):
    """Voxels as the sensor sees them, unit bearings (v, 3) and ranges (v,) in metres, and their surface."""

    bearings: NDArray[np.float64]
    ranges: NDArray[np.float64]
    normals: NDArray[np.float64]
    edge_lengths: NDArray[np.float64]
    supervoxels: NDArray[np.int32]
    indptr: NDArray[np.int64]
    neighbours: NDArray[np.int32]


@kernel
def _scan(  # type: ignore[no-untyped-def]
    image: NDArray[np.int32], wraps: bool, view: View, reach: float, least_gap: float
):
    """Depth edges (e, 2), front and behind, and continuations (c, 2), both int32 voxels, along the image's rows.

    Where a line passes from far to near, the far surface goes into hiding; where it passes from near to far, what
    comes out is paired with what went in last. A hole in the data ends all hiding.
    """
    ranges, edge_lengths, supervoxels = view.ranges, view.edge_lengths, view.supervoxels
    neighbours, indptr = view.neighbours, view.indptr
    depth_edges = np.empty((image.size, 2), np.int32)
    continuations = np.empty((image.size, 2), np.int32)
    hidden, line = np.empty(_MAX_DEPTH, np.int32), np.empty(image.shape[1] + 4, np.int32)
    n_edges = n_continuations = 0
    for row in range(image.shape[0]):
        first, last = _voxels_of(image[row], wraps, line)
        depth = 0
        for at in range(first, last):
            before, voxel = line[at], line[at + 1]
            if supervoxels[before] == supervoxels[voxel]:
                continue
            comes_out = ranges[before] < ranges[voxel]
            front, behind, beyond = (before, voxel, line[at + 2]) if comes_out else (voxel, before, line[at - 1])
            if _apart(front, behind, view, reach):
                depth = 0
                continue
            if beyond >= 0 and _apart(behind, beyond, view, reach):
                beyond = -1
            edge = max(edge_lengths[front], edge_lengths[behind])
            if not _stands_off(front, behind, beyond, view, least_gap * edge) or np.any(
                neighbours[indptr[front] : indptr[front + 1]] == behind
            ):
                continue
            depth_edges[n_edges, 0], depth_edges[n_edges, 1] = front, behind
            n_edges += 1
            if not comes_out:
                hidden[depth % _MAX_DEPTH] = behind
                depth += 1
            elif depth > 0:
                depth -= 1
                entered = hidden[depth % _MAX_DEPTH]
                if ranges[entered] > ranges[front] and supervoxels[entered] != supervoxels[behind]:
                    continuations[n_continuations, 0], continuations[n_continuations, 1] = entered, behind
                    n_continuations += 1
    return depth_edges[:n_edges].copy(), continuations[:n_continuations].copy()


@routine
def _voxels_of(cells: NDArray[np.int32], wraps: bool, line: NDArray[np.int32]) -> tuple[int, int]:
    """First and last place in `line` of the voxels in these cells, each once in a row; -1 is before and after them."""
    n = 1
    line[0] = line[1] = -1
    for cell in cells:
        if cell >= 0 and cell != line[n]:
            n += line[n] >= 0
            line[n] = cell
    if wraps and n > 1:  # go on to the first voxel again
        line[n + 1] = line[1]
        n += 1
    line[n + 1] = -1
    return 1, n


@routine
def _apart(front, behind, view, reach):  # type: ignore[no-untyped-def]
    """Whether two bearings lie further apart than `reach` voxels."""
    bearings, ranges, edge_lengths = view.bearings, view.ranges, view.edge_lengths
    squares = 0.0
    for axis in range(3):
        squares += (bearings[front, axis] - bearings[behind, axis]) ** 2
    return squares > (reach * max(edge_lengths[front] / ranges[front], edge_lengths[behind] / ranges[behind])) ** 2


@routine
def _stands_off(front, behind, beyond, view, gap):  # type: ignore[no-untyped-def]
    """Whether `front` is nearer than `behind` by the gap, and half as far off the surface to which that belongs.

    A surface seen at a slant gets deeper, too, but stays in its plane (the normal's), and in its line (to the voxel
    beyond): the latter holds where lines are too far apart for normals, as the rings of a spinning scanner.
    """
    bearings, ranges, normals = view.bearings, view.ranges, view.normals
    if ranges[behind] - ranges[front] < gap:
        return False
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
