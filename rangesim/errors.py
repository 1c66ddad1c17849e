# SPDX-License-Identifier: Apache-2.0
"""Errors about files and about the machine, and warnings. Bad arguments raise a plain ValueError instead.

Every message is one clear sentence that names what was found, what is needed, and how to fix it. The command line
prints it unchanged.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from pcgraph.errors import one_line, visible, without_long_words

__all__ = [
    "AlignmentWarning",
    "DoubtWarning",
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
"""Largest number of characters of a message, about six lines of a terminal, so that it stays readable even if a file
holds names of a megabyte. A longer message loses its middle."""


class RangesimError(Exception):
    """Base of all errors that rangesim raises, except ValueError for bad arguments.

    Examples
    --------
    >>> str(FileFormatError("scene.xml is\\nno scene"))  # always one line
    'scene.xml is no scene'
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(sentence(message))


class FileFormatError(RangesimError):
    """A file is missing, is broken, or holds something other than expected."""


class EnvironmentProblem(RangesimError):
    """The machine lacks something that rangesim needs, such as a recent LLVM."""


class RangesimWarning(UserWarning):
    """A result leaves something out, or rests on an assumption that may be wrong."""


class TruncationWarning(RangesimWarning):
    """Light paths ended so early that a noticeable part of the projector's light is missing.

    fraction : the missing part, 0 to 1.
    """

    def __init__(self, message: str, fraction: float) -> None:
        super().__init__(message)
        self.fraction = fraction


class AlignmentWarning(RangesimWarning):
    """The poses of some views are not confirmed by the data."""


class DoubtWarning(RangesimWarning):
    """A capture contradicts itself. `RangeImage.doubts` holds the same sentence."""


class SamplingWarning(RangesimWarning):
    """The sampling error of the light transport is not small compared with the detector's noise."""


def warn(message: str, kind: type[RangesimWarning] = RangesimWarning) -> None:
    """Issue a warning of one sentence; the command line prints it on a line of its own."""
    warnings.warn(sentence(message), kind, stacklevel=3)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Suppress `RangesimWarning` while the block runs, where a computation is repeated that has warned already."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RangesimWarning)
        yield


def sentence(message: str) -> str:
    """A message as one printable line; one longer than `MAX_SENTENCE` loses its middle."""
    line = visible(without_long_words(message))
    if len(line) <= MAX_SENTENCE:
        return line
    return f"{line[: 2 * MAX_SENTENCE // 3]} ... {line[5 - MAX_SENTENCE // 3 :]}"
