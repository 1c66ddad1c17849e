# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers in ascii files."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.errors import CloudReadError


def numbers_from_text(body: bytes, n_rows: int, n_columns: int) -> NDArray[np.float64]:
    """First `n_rows` x `n_columns` numbers of a text, in reading order.

    Returns
    -------
    (n_rows, n_columns) float64
        ``nan`` and ``inf`` in any case are numbers too.

    Raises
    ------
    CloudReadError
        Too few numbers, or a word that is not a number.
    """
    needed = n_rows * n_columns
    if needed > len(body):  # a number takes a byte at least: refuse before allocating what a header invents
        raise CloudReadError(f"the header promises {needed} numbers, but only {len(body)} bytes follow")
    words = body.split(None, needed)[:needed]
    if len(words) < needed:
        raise CloudReadError(f"the header promises {n_rows} points ({needed} numbers), but {len(words)} follow")
    try:
        # Not through an array of the words: each would take as many bytes as the longest.
        return np.fromiter(map(float, words), np.float64, needed).reshape(n_rows, n_columns)
    except ValueError as error:
        raise CloudReadError(f"expected numbers only in the ascii data: {str(error)[:120]}") from None
