# SPDX-License-Identifier: Apache-2.0
"""Bands of rows: images are worked on part by part, so that intermediate arrays stay in the processor's cache."""

from __future__ import annotations

from collections.abc import Iterator

BAND_ROWS = 32
"""Number of rows in a band. With 1280 float32 values each, an array of a band takes 160 kB, so that the few arrays of a
decoder fit into a core's cache; with fewer rows, more time would go into calls."""


def bands(height: int) -> Iterator[slice]:
    """Bands of rows that cover an image of `height` rows, from the top.

    Examples
    --------
    >>> list(bands(70))
    [slice(0, 32, None), slice(32, 64, None), slice(64, 70, None)]
    """
    for start in range(0, height, BAND_ROWS):
        yield slice(start, min(start + BAND_ROWS, height))
