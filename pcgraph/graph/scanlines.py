# SPDX-License-Identifier: Apache-2.0
"""Depth edges along the lines of a bearing image, and what goes on behind what stands in front."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

_DEEPEST = 32  # things one behind the other along a line


@njit(cache=True, nogil=True)
def scan(  # type: ignore[no-untyped-def]
    image: NDArray[np.int32],
    wraps: bool,
    bearings: NDArray[np.float64],
    ranges: NDArray[np.float64],
    normals: NDArray[np.float64],
    edge_lengths: NDArray[np.float64],
    supervoxels: NDArray[np.int32],
    indptr: NDArray[np.int64],
    neighbours: NDArray[np.int32],
    reach: float,
    least_gap: float,
):
    """Depth edges (e, 2), front and behind, and continuations (c, 2), both int32 voxels, along the image's rows.

    Where a line passes from far to near, the far surface goes into hiding; where it passes from near to far, what
    comes out is paired with what went in last. A hole in the data ends all hiding.
    """
    depth_edges = np.empty((image.size, 2), np.int32)
    continuations = np.empty((image.size, 2), np.int32)
    hidden, line = np.empty(_DEEPEST, np.int32), np.empty(image.shape[1] + 4, np.int32)
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
            if _apart(front, behind, bearings, ranges, edge_lengths, reach):
                depth = 0
                continue
            if beyond >= 0 and _apart(behind, beyond, bearings, ranges, edge_lengths, reach):
                beyond = -1
            edge = max(edge_lengths[front], edge_lengths[behind])
            if not _stands_off(front, behind, beyond, bearings, ranges, normals, least_gap * edge) or np.any(
                neighbours[indptr[front] : indptr[front + 1]] == behind
            ):
                continue
            depth_edges[n_edges, 0], depth_edges[n_edges, 1] = front, behind
            n_edges += 1
            if not comes_out:
                hidden[depth % _DEEPEST] = behind
                depth += 1
            elif depth > 0:
                depth -= 1
                entered = hidden[depth % _DEEPEST]
                if ranges[entered] > ranges[front] and supervoxels[entered] != supervoxels[behind]:
                    continuations[n_continuations, 0], continuations[n_continuations, 1] = entered, behind
                    n_continuations += 1
    return depth_edges[:n_edges].copy(), continuations[:n_continuations].copy()


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _apart(front, behind, bearings, ranges, edge_lengths, reach):  # type: ignore[no-untyped-def]
    """Whether two bearings lie further apart than `reach` voxels."""
    squares = 0.0
    for axis in range(3):
        squares += (bearings[front, axis] - bearings[behind, axis]) ** 2
    return squares > (reach * max(edge_lengths[front] / ranges[front], edge_lengths[behind] / ranges[behind])) ** 2


@njit(cache=True, nogil=True)
def _stands_off(front, behind, beyond, bearings, ranges, normals, gap):  # type: ignore[no-untyped-def]
    """Whether `front` is nearer than `behind` by the gap, and half as far off the surface to which that belongs.

    A surface seen at a slant gets deeper, too, but stays in its plane (the normal's), and in its line (to the voxel
    beyond): the latter holds where lines are too far apart for normals, as the rings of a spinning scanner.
    """
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
