# SPDX-License-Identifier: Apache-2.0
"""Best overlap of each true segment with any segment of a cut, kept up to date from merge to merge."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.metrics.hierarchy import children
from pcgraph.metrics.node_table import NodeTable


def overlap_of_cuts(table: NodeTable, order: NDArray[np.int64]) -> NDArray[np.float64]:
    """Weighted overlap for no merge done, one, two, ... in the given order, (t + 1,)."""
    n_first = table.starts[table.n_leaves]
    segments = table.segments[:n_first]
    rank = np.empty(n_first, np.int64)
    rank[np.argsort(segments, kind="stable")] = np.arange(n_first)
    begins = np.searchsorted(np.sort(segments), np.arange(len(table.true_sizes) + 1))
    sums = _tournament(
        order, *children(table.parents), table.starts, table.segments, table.above, table.overlaps,
        table.true_sizes, rank, begins,
    )  # fmt: skip
    return sums / table.true_sizes.sum()


@njit(cache=True)
def _tournament(
    order: NDArray[np.int64],
    child_starts: NDArray[np.int64],
    child_row: NDArray[np.int64],
    starts: NDArray[np.int64],
    segments: NDArray[np.int32],
    above: NDArray[np.int64],
    overlaps: NDArray[np.float64],
    true_sizes: NDArray[np.int64],
    rank: NDArray[np.int64],
    begins: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Sum of size times best overlap over the true segments, after each merge.

    Each true segment keeps a tournament of its overlaps with the nodes of the cut; a leaf's cell has the place
    `rank`, those of a true segment lie from `begins` on, and a merged cell takes the place of one it came from.
    """
    place = np.full(len(above), -1)
    place[: len(rank)] = rank
    rounds = np.zeros(2 * len(rank))
    total = 0.0
    for cell in range(len(rank)):
        total += _enter(rounds, begins, segments[cell], place[cell], overlaps[cell]) * true_sizes[segments[cell]]
    sums = np.empty(len(order) + 1)
    sums[0] = total
    for i, node in enumerate(order):
        for child in child_row[child_starts[node] : child_starts[node + 1]]:
            for cell in range(starts[child], starts[child + 1]):
                if place[above[cell]] < 0:
                    place[above[cell]] = place[cell]
                else:
                    total += _enter(rounds, begins, segments[cell], place[cell], 0.0) * true_sizes[segments[cell]]
        for cell in range(starts[node], starts[node + 1]):
            total += _enter(rounds, begins, segments[cell], place[cell], overlaps[cell]) * true_sizes[segments[cell]]
        sums[i + 1] = total
    return sums


@njit(cache=True)
def _enter(rounds: NDArray[np.float64], begins: NDArray[np.int64], segment: int, place: int, overlap: float) -> float:
    """Change of the best overlap of a true segment when this place takes this overlap."""
    n = begins[segment + 1] - begins[segment]
    base = 2 * begins[segment]
    at = n + place - begins[segment]
    best = rounds[base + 1]
    rounds[base + at] = overlap
    while at > 1:
        at //= 2
        rounds[base + at] = max(rounds[base + 2 * at], rounds[base + 2 * at + 1])
    return rounds[base + 1] - best
