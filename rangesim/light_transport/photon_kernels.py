# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over photons."""

from __future__ import annotations

import numpy as np

from pcgraph.kernel_cache import cached_njit


@cached_njit(nogil=True, error_model="numpy")
def sorted_by(key, starts):  # type: ignore[no-untyped-def]
    """(n,) int64, indices of the keys (n,) int64 in ascending order; equal keys stay in their order.

    starts : (k + 1,) int64, number of keys below each value.
    """
    order, place = np.empty(len(key), np.int64), starts.copy()
    for i in range(len(key)):
        order[place[key[i]]] = i
        place[key[i]] += 1
    return order


@cached_njit(nogil=True, error_model="numpy")
def mark(position, edge, factors, kind, of_map, occupied):  # type: ignore[no-untyped-def]
    """Set the bits of the cells that hold the corners of a box around each photon, whose edges are those of a cell.

    position : (n, 3) float32, metres. edge : (n,) float64, metres, edge of the cells of each photon.
    factors : (3,) int64, factors of the spatial hash.
    kind : (n,) int64, what the class of a photon adds to the hash. of_map : (n,) int, map of each photon.
    occupied : (cells, words) uint32, the output, with a bit for each map; the number of cells is a power of two.
    """
    mask = len(occupied) - 1
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for i in range(len(of_map)):
        word, bit, width = of_map[i] >> 5, 1 << (of_map[i] & 31), np.float64(np.float32(edge[i]))
        for k in range(3):
            low[k] = np.int64(np.floor((position[i, k] - 0.5 * edge[i]) / width)) * factors[k]
            high[k] = np.int64(np.floor((position[i, k] + 0.5 * edge[i]) / width)) * factors[k]
        for corner in range(8):
            x = high[0] if corner & 1 else low[0]
            y = high[1] if corner & 2 else low[1]
            z = high[2] if corner & 4 else low[2]
            occupied[(x + y + z + kind[i]) & mask, word] |= bit
