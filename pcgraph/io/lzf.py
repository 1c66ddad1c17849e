# SPDX-License-Identifier: Apache-2.0
"""LZF decompression, the coding of PCD's ``binary_compressed`` data."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def decompress(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> int:
    """Number of bytes written to `target`, or -1 if the stream is broken or does not fit.

    Parameters
    ----------
    source : (c,) uint8
        LZF stream: a control byte below 32 announces that many + 1 literal bytes; any other one a copy of
        ``(control >> 5) + 2`` bytes (length 7 takes one byte more) from up to 8191 bytes back.
    target : (u,) uint8
        Filled from the front.

    Notes
    -----
    Every read and write is bounds-checked and every step consumes input, so no stream can crash or hang it.
    Source: M. Lehmann, liblzf, format as documented there; written anew.
    """
    read, wrote = 0, 0
    n_source, n_target = source.size, target.size
    while read < n_source:
        control = int(source[read])
        read += 1
        if control < 32:
            length = control + 1
            if read + length > n_source or wrote + length > n_target:
                return -1
            for offset in range(length):  # as a loop, for slices take the compiler seconds
                target[wrote + offset] = source[read + offset]
            read += length
        else:
            length = control >> 5
            if read + (2 if length == 7 else 1) > n_source:
                return -1
            if length == 7:
                length += int(source[read])
                read += 1
            start = wrote - ((control & 31) << 8) - int(source[read]) - 1
            read += 1
            length += 2
            if start < 0 or wrote + length > n_target:
                return -1
            for offset in range(length):  # copies may overlap themselves, so byte by byte
                target[wrote + offset] = target[start + offset]
        wrote += length
    return wrote
