# SPDX-License-Identifier: Apache-2.0
"""How large an input may be: one table of limits, checked before memory is allocated.

The limits keep a typing error or a hostile file from taking the machine down; they are far above what a sensor
has. Whoever needs more raises them, in Python

    with limits.raised(pixels=10**9):
        ...

or for a command, `RANGESIM_LIMITS="pixels=1e9,bins=1e5" rangesim run ...`. docs/limits.md lists them.
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
"""Environment variable with limits for the whole process, such as "pixels=1e9,bins=1e5"."""


@dataclass(frozen=True)
class Limits:
    """Largest sizes that are accepted.

    Parameters
    ----------
    pixels : of one image: camera, projector, film, texture, or image file.
    projector : pixels along one side of a projector that shows coded patterns.
    frames : of one capture.
    bins : of one time-of-flight histogram; with a pulse, the finer bins of the light transport count.
    steps : phase shifts of a fringe pattern.
    frequencies : modulation frequencies of one sensor.
    wraps : candidates that phase unwrapping compares: the longest path searched over the shortest wavelength.
    spp : light paths per pixel.
    depth : segments of a light path.
    photons : caustic photons of a pass.
    passes : light-transport passes of one sensor in a scene that moves; bands and samples of its exposures.
    instruments : of one experiment.
    points : vertices, or faces, of one mesh file.
    voxels : of one grid that views are fused in, or seen and true volume are compared on.
    shapes : of one scene.
    memory : bytes that a run may take by its estimate; unless it is set, what the machine has available.
    bytes : of the arrays that one file holds once it is decompressed.
    text : bytes of one JSON, TOML or XML file.
    nesting : levels of JSON, TOML, XML and scene dictionaries.
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
    photons: int = 1_000_000_000
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
    """The limits in force here: those of `raised`, else of the environment, else the defaults."""
    return _raised.get() or _of_environment(os.environ.get(VARIABLE, ""))


@contextmanager
def raised(**limits: int) -> Iterator[None]:
    """Set limits while the block runs, in this thread (or task); the others stay.

    Raises
    ------
    ValueError
        An unknown limit, or one that is no whole number of at least 1.
    """
    token = _raised.set(_with(current(), limits, "limits"))
    try:
        yield
    finally:
        _raised.reset(token)


def check(name: str, value: int, what: str, error: type[Exception] = ValueError) -> None:
    """Raise `error` if `value`, the size of `what`, is beyond the limit `name`.

    what : names the thing and its unit, such as "pixels of an image".
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
