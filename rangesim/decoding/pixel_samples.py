# SPDX-License-Identifier: Apache-2.0
"""Pixels and frames that checks of a whole capture compare.

A check looks at so many pixels that it can conclude, and at so few that it takes little time.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

MIN_PIXELS = 200
"""Least number of pixels from which a check draws a conclusion. A fraction of 200 pixels has a standard error of at
most 3.5 %, below what the checks compare."""

MAX_PIXELS = 200_000
"""Largest number of pixels that a check looks at, evenly spread over the image. It bounds the time for large images;
the standard error of a fraction of that many pixels is 0.1 % at most."""

MAX_COMPARED = 20_000
"""Number of pixels, at most, by which frames are first compared with each other; frames that agree at these are then
compared at all pixels."""

MAX_UNIFORM_FRACTION = 0.98
"""Largest fraction of the pixels at which a frame may be as dark as the darkest frame, or as bright as the brightest,
and still count as a picture of something."""


def evenly_spread(indices: np.ndarray, most: int = MAX_PIXELS) -> np.ndarray:
    """At most `most` of the indices (n,), evenly spread.

    Examples
    --------
    >>> import numpy as np
    >>> len(evenly_spread(np.arange(500_000)))
    166667
    """
    return indices[:: 1 + len(indices) // most]


def equal_frames(frames: np.ndarray) -> Iterator[tuple[int, int]]:
    """Pairs of frames (k, h, w) of digital numbers that are the same to the last digit, the earlier one first.

    The noise of a camera makes two images of the same scene differ. Where patterns lie outside the view, noise-free
    images are all black or all white, so frames that hardly change are left out.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.random.default_rng(0).integers(0, 9, (3, 8, 8))
    >>> list(equal_frames(frames[[0, 1, 2, 1]]))
    [(1, 3)]
    """
    few = frames.reshape(len(frames), -1)[:, :: 1 + frames[0].size // MAX_COMPARED]
    low, high = few.min(axis=0), few.max(axis=0)
    seen: dict[bytes, int] = {}
    for i, values in enumerate(few):
        j = seen.setdefault(values.tobytes(), i)
        if j == i or any(float((values == edge).mean()) > MAX_UNIFORM_FRACTION for edge in (low, high)):
            continue
        if np.array_equal(frames[i], frames[j]):
            yield j, i


def same_images(first: str, second: str) -> str:
    """The sentence that two frames, given by their names, are the same to the last digit."""
    return (
        f"frames {first} and {second} are the same image to the last digit, which no camera takes twice: check that no "
        "file is there twice or in place of another."
    )
