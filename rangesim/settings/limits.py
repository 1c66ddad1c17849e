# SPDX-License-Identifier: Apache-2.0
"""Limits of the sizes of inputs: one table, checked before memory is allocated.

The limits are far above the sizes of real sensors. They keep a typing error or a hostile file from taking the machine
down. A larger limit can be set for a command, `RANGESIM_LIMITS="pixels=1e9,bins=1e5" rangesim run ...`, or in Python
for a block. docs/limits.md lists all limits.

Examples
--------
>>> with raised(bins=100_000):
...     current().bins
100000
>>> current().bins
65536
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, fields, replace
from functools import lru_cache

from rangesim.settings.config import check_keys, shown

VARIABLE = "RANGESIM_LIMITS"
"""Name of the environment variable with limits for the whole process, such as "pixels=1e9,bins=1e5"."""


@dataclass(frozen=True)
class Limits:
    """Largest sizes that are accepted.

    Parameters
    ----------
    pixels : pixels of one image: camera, projector, film, texture or image file.
    projector : pixels along one side of a projector that shows coded patterns.
    frames : frames of one capture.
    bins : bins of one time-of-flight histogram; if the light transport uses finer bins for a short pulse, those.
    steps : phase shifts of a fringe pattern.
    frequencies : modulation frequencies of one sensor.
    wraps : candidates of phase unwrapping: the longest path that is searched, divided by the shortest wavelength.
    spp : light paths per pixel.
    depth : segments of a light path.
    passes : light-transport passes of one sensor in a moving scene; also bands of rows, and samples of an exposure.
    instruments : instruments of one experiment.
    points : vertices, or faces, of one mesh file.
    voxels : voxels of one grid in which views are fused, or the seen volume is compared with the true one.
    shapes : shapes of one scene.
    memory : bytes that a run may need by its estimate; unless it is set, the available memory is the limit.
    bytes : bytes of the arrays of one file after decompression.
    text : bytes of one JSON, TOML or XML file.
    nesting : nested levels of JSON, TOML, XML and scene dictionaries.
    """

    pixels: int = 100_000_000
    projector: int = 65_536
    frames: int = 65_536
    bins: int = 65_536
    steps: int = 1_000
    frequencies: int = 64
    wraps: int = 10_000
    spp: int = 1_000_000
    depth: int = 10_000
    passes: int = 10_000
    instruments: int = 100
    points: int = 100_000_000
    voxels: int = 200_000_000
    shapes: int = 100_000
    memory: int = 1 << 50
    bytes: int = 4 << 30
    text: int = 64 << 20
    nesting: int = 100


_raised: ContextVar[Limits | None] = ContextVar("limits", default=None)


def current() -> Limits:
    """The limits that apply now: those that `raised` has set, else those of `RANGESIM_LIMITS`, else the defaults."""
    return _raised.get() or _of_environment(os.environ.get(VARIABLE, ""))


@contextmanager
def raised(**limits: int) -> Iterator[None]:
    """Set some limits while the block runs, in this thread (or asyncio task).

    Raises
    ------
    ValueError
        A limit is unknown, or its value is not a whole number of at least 1.
    """
    token = _raised.set(_with(current(), limits, "limits"))
    try:
        yield
    finally:
        _raised.reset(token)


def check(name: str, value: int, what: str, error: type[Exception] = ValueError) -> None:
    """Raise an error if a size is above a limit.

    Parameters
    ----------
    name : name of the limit. value : the size.
    what : what is counted, for the message, such as "pixels of an image".
    error : type of the error.
    """
    most = getattr(current(), name)
    if value > most:
        raise error(
            f"expected at most {most} {what}, got {shown(value)}; if this is meant, raise the limit with "
            f"{VARIABLE}={name}=N or rangesim.settings.limits.raised({name}=N)."
        )


@lru_cache(maxsize=16)
def _of_environment(text: str) -> Limits:
    given: dict[str, float] = {}
    for entry in filter(None, (part.strip() for part in text.split(","))):
        name, _, number = (part.strip() for part in entry.partition("="))
        try:
            given[name] = float(number)
        except ValueError:
            raise ValueError(f"{VARIABLE}: expected NAME=NUMBER, such as pixels=1e9, got {shown(entry)}.") from None
    return _with(Limits(), given, VARIABLE)


def _with(limits: Limits, given: dict[str, int] | dict[str, float], place: str) -> Limits:
    check_keys(given, [f.name for f in fields(Limits)], place)
    for name, value in given.items():
        if isinstance(value, bool) or not (isinstance(value, (int, float)) and 1 <= value < math.inf):
            raise ValueError(f"{place}: expected {name} to be a whole number of at least 1, got {shown(value)}.")
        if value != int(value):
            raise ValueError(f"{place}: expected {name} to be a whole number of at least 1, got {shown(value)}.")
    return replace(limits, **{name: int(value) for name, value in given.items()})
