# SPDX-License-Identifier: Apache-2.0
"""How many pixels a check of a whole capture looks at: at least so many that it can conclude, at most so many that it
takes little time."""

from __future__ import annotations

import numpy as np

MIN_PIXELS = 200
"""Least number of pixels from which a check draws a conclusion. A fraction of 200 pixels has a standard error of at
most 3.5 %, below what the checks compare."""

MAX_PIXELS = 200_000
"""Largest number of pixels that a check looks at, evenly spread over the image. It bounds the time for large images;
the standard error of a fraction of that many pixels is 0.1 % at most."""


def evenly_spread(indices: np.ndarray) -> np.ndarray:
    """At most `MAX_PIXELS` of the indices (n,), evenly spread.

    Examples
    --------
    >>> import numpy as np
    >>> len(evenly_spread(np.arange(500_000)))
    166667
    """
    return indices[:: 1 + len(indices) // MAX_PIXELS]
