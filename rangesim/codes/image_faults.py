# SPDX-License-Identifier: Apache-2.0
"""Faults that images of fringes may have: a convention other than stated, an image repeated, two images exchanged."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from rangesim.codes.fringes import STARTS, FringeConvention

CHECKED_PIXELS = 2000
"""Largest number of pixels that are checked. A fraction of them has a standard error of at most 1.1 %."""

MAX_REPEATED = 0.05
"""Largest root mean square of the difference of two images, as a fraction of the amplitude, at which they count as one
image shown twice. Between images of two periods it is about 1."""


def repeated_image(frames: np.ndarray, names: list[str]) -> str | None:
    """A clause on two of the images (k, 1, m) that are the same one; None if there are none."""
    values = frames[:, 0].astype(np.float32)
    amplitude = np.sqrt(2) * np.median(values.std(axis=0))
    for i, j in combinations(range(len(values)), 2):
        if np.sqrt(np.mean((values[i] - values[j]) ** 2)) < MAX_REPEATED * amplitude:
            return f"frame {names[j]} repeats {names[i]}"
    return None


def other_conventions(given: FringeConvention) -> Iterator[tuple[str, FringeConvention]]:
    """Conventions that differ from the given one, each with a clause on what fringes do that follow it."""
    for direction in (given.direction, "backward" if given.direction == "forward" else "forward"):
        for start in STARTS:
            if (start, direction) == (given.start, given.direction):
                continue
            words = [f"start at {start} instead of {given.start}"] if start != given.start else []
            if direction != given.direction:
                words.append("be shifted in the opposite direction")
            other = FringeConvention(start, direction, given.origin_px)  # type: ignore[arg-type]
            yield f"the fringes seem to {' and to '.join(words)}", other


def exchanged_images(frames: np.ndarray, names: list[str]) -> Iterator[tuple[str, np.ndarray]]:
    """The images (k, ...) with each two of them exchanged, each time with a clause that says which."""
    order = np.arange(len(frames))
    for i, j in combinations(order, 2):
        swapped = order.copy()
        swapped[[i, j]] = j, i
        yield f"frames {names[i]} and {names[j]} seem to be exchanged", frames[swapped]
