# SPDX-License-Identifier: Apache-2.0
"""The extent of a cloud, and how densely it samples its surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcgraph.parallel import in_blocks, kernel

_SAMPLE = 4096  # points whose nearest neighbour is sought
_CROWD = 1 << 16  # points among which it is sought, about
_BLOCKS = 16  # of space, along each axis
_NO_SPACING_M = 0.01


def bounding_box(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest coordinates, (3,) each, of points (n, 3), n >= 1.

    Column by column: NumPy reduces rows of three some ten times more slowly.
    """
    low = np.array([points[:, axis].min() for axis in range(3)])
    high = np.array([points[:, axis].max() for axis in range(3)])
    return low, high


def median_spacing(points: NDArray[np.float64]) -> float:
    """Median distance to the nearest point elsewhere, metres, over a sample free of the points' order.

    Parameters
    ----------
    points : (n, 3) float64, metres
        Finite, n >= 1. Duplicates count as one point.

    Returns
    -------
    float
        > 0; 0.01 if all points coincide.

    Notes
    -----
    Source: Lin et al. 2018 start from the same median, their lambda_0. Of large clouds only some blocks of space
    are looked at, all points of each.
    """
    drawn = _some_places(points)
    crowd, hashes = _each_place_once(drawn)
    if 2 * len(crowd) < len(drawn) < len(points):  # duplicates took the room of others
        crowd, hashes = _each_place_once(_some_places(_each_place_once(points)[0]))
    if len(crowd) == 1:
        return _NO_SPACING_M
    sample = np.arange(len(crowd))
    if len(crowd) > _SAMPLE:  # the smallest hashes: as good as random, yet a property of the points
        sample = np.argpartition(hashes, _SAMPLE)[:_SAMPLE]
    tree = cKDTree(crowd, balanced_tree=False, compact_nodes=False)
    distances = tree.query(crowd[sample], k=2)[0][:, 1]
    distances = distances[(distances > 0.0) & np.isfinite(distances)]
    return float(np.median(distances)) if len(distances) else _NO_SPACING_M


def _each_place_once(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.uint64]]:
    """One point per place, in the order of their hashes, and these."""
    hashes, first = np.unique(_hashes(points), return_index=True)
    return points[first], hashes


def _hashes(points: NDArray[np.float64]) -> NDArray[np.uint64]:
    """A whole number per point that depends on its place alone, and differs between places."""
    bits = (points + 0.0).view(np.uint64)  # + 0.0 makes one zero of the two
    odd = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    mixed = _mixed(bits * odd)
    return _mixed(mixed[:, 0] ^ (mixed[:, 1] >> np.uint64(1)) ^ (mixed[:, 2] >> np.uint64(2)))


def _some_places(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """All points, or of large clouds those in some blocks of space."""
    while len(points) > 2 * _CROWD and len(smaller := some_blocks(points)) < len(points):
        points = smaller
    return points


def some_blocks(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points of as many blocks of space as it takes for a crowd, the blocks by their hashes."""
    low, high = bounding_box(points)
    edge = float((high - low).max()) / _BLOCKS
    if not edge > 0.0:
        return points
    block = np.empty(len(points), np.int32)
    in_blocks(_find_block, len(points), points, low, edge, block)
    counts = np.bincount(block, minlength=_BLOCKS**3)
    numbers: NDArray[np.uint64] = np.arange(_BLOCKS**3, dtype=np.uint64)
    order = np.argsort(_mixed(numbers), kind="stable")
    taken = np.zeros(_BLOCKS**3, bool)
    taken[order] = np.concatenate(([0], np.cumsum(counts[order])[:-1])) < _CROWD
    return points[np.flatnonzero(taken[block])]


@kernel
def _find_block(
    start: int, stop: int, points: NDArray[np.float64], low: NDArray[np.float64], edge: float, block: NDArray[np.int32]
) -> None:
    """Set the number of the block of space in which each point lies."""
    last = _BLOCKS - 1
    for p in range(start, stop):
        x = min(int((points[p, 0] - low[0]) / edge), last)
        y = min(int((points[p, 1] - low[1]) / edge), last)
        z = min(int((points[p, 2] - low[2]) / edge), last)
        block[p] = (x * _BLOCKS + y) * _BLOCKS + z


def _mixed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Whole numbers without a pattern, by one step of a multiplicative hash."""
    spread = values * np.uint64(0xD6E8FEB86659FD93)
    return (spread ^ (spread >> np.uint64(32))) * np.uint64(0xD6E8FEB86659FD93)
