# SPDX-License-Identifier: Apache-2.0
"""Grading: voxels are larger where points lie farther apart, as halfway between the tripods of several scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel
from pcgraph.voxels.cells import cell_keys

BLOCK = 16
"""Edge of a block, in voxel edges of level 0; all its voxels are of one level, 4 at most. Chosen: 8 was given up."""


@dataclass(frozen=True, eq=False)
class Grading:
    """Blocks of a grid in which the edges of voxels are doubled.

    Attributes
    ----------
    blocks : (b, 3) float64
        Grid coordinates of the blocks, whole numbers, in edges of blocks.
    levels : (b,) int8, 1..4
        Number of times that the voxel edges in each block are doubled.
    """

    blocks: NDArray[np.float64]
    levels: NDArray[np.int8]

    def levels_of(self, scaled: NDArray[np.float64]) -> NDArray[np.int8]:
        """Level of each of n places, (n,) int8; places, (n, 3), are in voxel edges of level 0."""
        keys = cell_keys(np.concatenate((self.blocks, np.floor(scaled / BLOCK))), float(BLOCK))[0]
        order = np.argsort(keys[: len(self.blocks)])
        levels = np.empty(len(scaled), np.int8)
        in_blocks(_look_up, len(scaled), keys[len(order) :], keys[order], self.levels[order], levels)
        return levels


def enlarged(edges: NDArray[np.float64], levels: NDArray[np.int8] | None) -> NDArray[np.float64]:
    """Edges of voxels, (v,), doubled as often as their levels say, (v,); unchanged if there are no levels."""
    return edges if levels is None else edges * np.exp2(levels.astype(np.float64))


@kernel
def _look_up(
    start: int,
    stop: int,
    keys: NDArray[np.int64],
    known: NDArray[np.int64],
    levels: NDArray[np.int8],
    found: NDArray[np.int8],
) -> None:
    """Set the level of each key: that of the same key among the known ones, which ascend, or 0 if it is not there."""
    for p in range(start, stop):
        low, high = 0, len(known)
        while low < high:
            middle = (low + high) // 2
            if known[middle] < keys[p]:
                low = middle + 1
            else:
                high = middle
        found[p] = levels[low] if low < len(known) and known[low] == keys[p] else 0
