# SPDX-License-Identifier: Apache-2.0
"""Errors that are about files and the environment, and warnings; bad arguments are a plain ValueError.

The message of each is one clear sentence that names what was found, what is needed and the fix: the
command line prints it as it stands.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from pcgraph.errors import one_line, visible, without_long_words

__all__ = [
    "AlignmentWarning",
    "EnvironmentProblem",
    "FileFormatError",
    "RangesimError",
    "RangesimWarning",
    "SamplingWarning",
    "TruncationWarning",
    "one_line",
    "sentence",
    "visible",
    "warn",
    "without_warnings",
]

MAX_SENTENCE = 480
"""Characters of a message. Files may hold names of a megabyte."""


class RangesimError(Exception):
    """Base of every error that rangesim raises itself, except ValueError for bad arguments."""

    def __init__(self, message: str = "") -> None:
        super().__init__(sentence(message))


class FileFormatError(RangesimError):
    """A file is missing, broken, or does not hold what its place asks for."""


class EnvironmentProblem(RangesimError):
    """This machine lacks something that rangesim needs, such as a new enough LLVM."""


class RangesimWarning(UserWarning):
    """Something is left out of a result, or read as what it may not be."""


class TruncationWarning(RangesimWarning):
    """Light paths were ended so early that a noticeable part of the projector's light, `fraction`, is missing."""

    def __init__(self, message: str, fraction: float) -> None:
        super().__init__(message)
        self.fraction = fraction


class AlignmentWarning(RangesimWarning):
    """Poses of views that nothing confirms."""


class SamplingWarning(RangesimWarning):
    """The noise that the sampling of light paths makes is not small against the detector's."""


def warn(message: str) -> None:
    """Warn with one sentence; the command line prints it on a line of its own."""
    warnings.warn(sentence(message), RangesimWarning, stacklevel=3)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Suppress `RangesimWarning`: what is decoded again for comparison has warned already."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RangesimWarning)
        yield


def sentence(message: str) -> str:
    """A message on one printable line, without its middle if it is too long to read."""
    line = visible(without_long_words(message))
    if len(line) <= MAX_SENTENCE:
        return line
    return f"{line[: 2 * MAX_SENTENCE // 3]} ... {line[5 - MAX_SENTENCE // 3 :]}"
