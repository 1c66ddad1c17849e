# SPDX-License-Identifier: Apache-2.0
"""Bands of rows: images are worked on part by part, so that intermediate arrays stay in the processor's cache."""

from __future__ import annotations

from collections.abc import Callable, Iterator

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


def in_bands(work: Callable[[slice], object], height: int) -> None:
    """Call `work` on each band of rows of an image, in as many threads as numba uses.

    `work` writes only the rows of its band, so that no result depends on the number of threads.

    Examples
    --------
    >>> import numpy as np
    >>> image = np.arange(70.0)
    >>> def halve(rows: slice) -> None:
    ...     image[rows] /= 2
    >>> in_bands(halve, len(image))
    >>> float(image[69])
    34.5
    """
    from pcgraph.parallel import in_blocks

    every = list(bands(height))

    def run(start: int, stop: int) -> None:
        for rows in every[start:stop]:
            work(rows)

    in_blocks(run, len(every), smallest=2)
