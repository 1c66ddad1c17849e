# SPDX-License-Identifier: Apache-2.0
"""Stages of a computation: their progress, which a caller may watch, and the time that each takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[str, float], None]
"""A function that is called with the name of the stage and the fraction of the whole job that is done, 0..1."""


def unwatched(stage: str, fraction: float) -> None:
    """Ignore the progress, for a caller that does not ask for it."""


@contextmanager
def timed(times_s: dict[str, float], stage: str) -> Iterator[None]:
    """Add the seconds that the block takes to `times_s[stage]`.

    Examples
    --------
    >>> times_s = {}
    >>> with timed(times_s, "load"):
    ...     pass
    >>> 0 <= times_s["load"] < 1
    True
    """
    start = time.monotonic()
    yield
    times_s[stage] = times_s.get(stage, 0.0) + time.monotonic() - start
