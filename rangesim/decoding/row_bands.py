# SPDX-License-Identifier: Apache-2.0
"""Work on images in bands of rows, so that intermediate arrays stay in the processor's cache."""

from __future__ import annotations

from collections.abc import Iterator

BAND_ROWS = 32


def bands(height: int) -> Iterator[slice]:
    """Runs of rows that cover an image, from the top."""
    for start in range(0, height, BAND_ROWS):
        yield slice(start, min(start + BAND_ROWS, height))
