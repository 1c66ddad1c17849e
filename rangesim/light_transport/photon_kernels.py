# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over photons."""

from __future__ import annotations

from pcgraph.kernel_cache import cached_njit


@cached_njit(nogil=True, error_model="numpy")
def mark(low, high, kind, of_map, occupied):  # type: ignore[no-untyped-def]
    """Set the bits of the cells that hold the corners of a box around each photon.

    low, high : (n, 3) int64, cells of the lowest and the highest corner, times the factors of the spatial hash.
    kind : (n,) int64, what the class of a photon adds to the hash. of_map : (n,) int, map of each photon.
    occupied : (cells, words) uint32, the output, with a bit for each map; the number of cells is a power of two.
    """
    mask = len(occupied) - 1
    for i in range(len(of_map)):
        word, bit = of_map[i] >> 5, 1 << (of_map[i] & 31)
        for corner in range(8):
            x = high[i, 0] if corner & 1 else low[i, 0]
            y = high[i, 1] if corner & 2 else low[i, 1]
            z = high[i, 2] if corner & 4 else low[i, 2]
            occupied[(x + y + z + kind[i]) & mask, word] |= bit
