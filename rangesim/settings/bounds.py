# SPDX-License-Identifier: Apache-2.0
"""Types and bounds of the numbers in settings, stated on the fields of a dataclass and checked when it is made.

A field states what it may hold, as in `spp: Annotated[int, whole(1, "spp")]` or `baseline_m: Metres`, and the class
calls `check_fields(self)` in `__post_init__`. No number may be NaN or infinite, and a bool is not a number. The bounds
are wide: they exclude only values that single precision cannot represent or that make no physical sense.

Examples
--------
>>> from dataclasses import dataclass
>>> @dataclass(frozen=True)
... class Shutter:
...     exposure_s: Seconds
...     def __post_init__(self):
...         check_fields(self)
>>> Shutter(0.01)
Shutter(exposure_s=0.01)
>>> Shutter(-1)
Traceback (most recent call last):
ValueError: expected exposure_s to be positive and finite, 1e-15 to 1e+06, got -1.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from rangesim.settings import limits
from rangesim.settings.config import nearest, shown


@dataclass(frozen=True)
class Bounds:
    """A closed interval of numbers.

    Parameters
    ----------
    words : description of the allowed numbers, for messages: "positive and finite".
    low, high : the smallest and the largest allowed number.
    or_zero : whether 0 is allowed too, although it lies outside the interval.
    limit : name of the entry of `rangesim.settings.limits` that is the upper bound; "": none.
    kind : `int` if only whole numbers are allowed. Only `check_number` reads it; for a field of a dataclass, the type
        in the field's annotation decides.

    Examples
    --------
    >>> duty = Bounds("a fraction", 0, 1)
    >>> 0.5 in duty, 2 in duty
    (True, False)
    >>> str(duty)
    'a fraction, 0 to 1'
    """

    words: str
    low: float = -math.inf
    high: float = math.inf
    or_zero: bool = False
    limit: str = ""
    kind: type[int] | type[float] = float

    def __contains__(self, value: float) -> bool:
        finite = isinstance(value, int) or math.isfinite(value)  # an int may be too large for a float
        return finite and (self.low <= value <= self.high or (self.or_zero and value == 0))

    def __str__(self) -> str:
        if math.isinf(self.high):
            return self.words
        return f"{self.words}, {self.low:g} to {self.high:g}"


def whole(low: int, limit: str = "") -> Bounds:
    """Bounds of a whole number: at least `low`, and at most the entry `limit` of `rangesim.settings.limits`.

    Examples
    --------
    >>> check_number("spp", 16, whole(1, "spp"))
    >>> check_number("spp", 0.5, whole(1, "spp"))
    Traceback (most recent call last):
    ValueError: expected spp to be a whole number of at least 1, got 0.5.
    """
    return Bounds(f"a whole number of at least {low}", low, limit=limit, kind=int)


MAX_COORDINATE_M = 1e7
"""Largest coordinate of the world, in metres: the Earth's radius is 6.4e6 m, so coordinates of maps and of the globe
fit. At this distance from the origin, double precision still resolves 2 nm; farther away it would not."""
Metres = Annotated[float, Bounds("positive and finite", 1e-9, MAX_COORDINATE_M)]
"""A length in metres, from 1 nm."""
Watts = Annotated[float, Bounds("positive and finite", 1e-12, 1e9)]
"""A radiant power in watts, from 1 pW to 1 GW."""
HERTZ = Bounds("positive and finite", 1.0, 1e12)
"""Bounds of a frequency in hertz: from 1 Hz to 1 THz, which is a wavelength of 0.3 mm."""
Hertz = Annotated[float, HERTZ]
"""A frequency in hertz."""
SECONDS = Bounds("positive and finite", 1e-15, 1e6)
"""Bounds of a duration in seconds: from 1 fs, in which light travels 0.3 um, to eleven days."""
Seconds = Annotated[float, SECONDS]
"""A duration in seconds."""
Pause = Annotated[float, Bounds("0 or positive", 1e-15, 1e6, or_zero=True)]
"""A duration in seconds that may be 0; if it is not, the bounds of `SECONDS` hold."""
Wavelength = Annotated[float, Bounds("positive and finite", 1e-8, 1e-2)]
"""A wavelength of light in metres, from extreme ultraviolet (10 nm) to microwaves (10 mm)."""
Exponent = Annotated[float, Bounds("an exponent of at least 0", 0, 100)]
"""An exponent of a fall-off with the angle, dimensionless: at 100, light falls to half within 7 degrees."""
Coordinate = Annotated[float, Bounds("a coordinate", -MAX_COORDINATE_M, MAX_COORDINATE_M)]
"""A coordinate of the world in metres."""
Fraction = Annotated[float, Bounds("a fraction", 0, 1)]
"""A fraction from 0 to 1."""
PositiveFraction = Annotated[float, Bounds("a positive fraction", 1e-9, 1)]
"""A fraction from 1e-9 to 1; it may not be 0, because something is divided by it."""


def check_fields(setting: Any) -> None:
    """Raise ValueError on the first field of a dataclass whose value does not match its type or its bounds.

    NumPy scalars are replaced by Python numbers, and lists by tuples where the field holds a tuple; this works for
    frozen dataclasses too. Fields that hold arrays or mappings are not checked: the class does that itself.
    """
    for name, hint, kind, bounds in _fields(type(setting)):  # type: ignore[arg-type]
        value = getattr(setting, name)
        if type(value) is kind and value in bounds:  # most fields are such numbers, and settings are made often
            continue
        checked = _checked(hint, value, name)
        if checked is not value:
            object.__setattr__(setting, name, checked)


def check_number(name: str, value: Any, bounds: Bounds) -> None:
    """Raise ValueError unless `value` is a number of the kind and within the bounds that `bounds` states.

    name : the name of the argument, for the message.
    """
    _number(bounds.kind, value.item() if isinstance(value, np.generic) else value, name, bounds)


@lru_cache(maxsize=256)
def _fields(cls: type) -> list[tuple[str, Any, type | None, Any]]:
    """Name and type of each field of a dataclass that is to be checked; and kind and bounds, if any value of that kind
    within these bounds is right as it is. If not, kind and bounds are None and ()."""
    hints, found = get_type_hints(cls, include_extras=True), []
    for field in dataclasses.fields(cls):
        if field.init:
            hint = hints[field.name]
            kind, bounds = get_args(hint)[:2] if get_origin(hint) is Annotated else (None, None)
            is_plain = kind in (int, float) and isinstance(bounds, Bounds) and not bounds.limit
            found.append((field.name, hint, *((kind, bounds) if is_plain else (None, ()))))
    return found


def _checked(hint: Any, value: Any, name: str) -> Any:
    """The value, with NumPy scalars and lists made plain Python; raises ValueError if it does not match `hint`."""
    if get_origin(hint) in (Union, types.UnionType):
        if value is None and type(None) in get_args(hint):
            return None
        hint, *others = (arg for arg in get_args(hint) if arg is not type(None))
        for other in others:
            is_literal = get_origin(other) is typing.Literal
            if (isinstance(value, str) and value in get_args(other)) if is_literal else _is_member(value, other):
                return value
    bounds = None
    if get_origin(hint) is Annotated:
        hint, bounds = get_args(hint)[:2]
    if isinstance(value, np.generic):
        value = value.item()
    if hint in (int, float):
        return _number(hint, value, name, bounds)
    if get_origin(hint) is tuple:
        return _items(hint, value, name)
    if get_origin(hint) is typing.Literal:
        if not isinstance(value, str) or value not in get_args(hint):
            valid = get_args(hint)
            raise ValueError(
                f"expected {name} to be one of {', '.join(valid)}, got {shown(value)}{nearest(str(value), valid)}."
            )
    elif isinstance(hint, type) and hint is not np.ndarray and not isinstance(value, hint):
        words = {bool: "true or false", str: "a text"}.get(hint, f"a {hint.__name__}")
        raise ValueError(f"expected {name} to be {words}, got {shown(value)}.")
    return value


def _is_member(value: Any, kind: Any) -> bool:
    """Whether a value is of a class or of a subclass; a bool is no number."""
    return isinstance(kind, type) and isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


def _number(kind: type, value: Any, name: str, bounds: Bounds | None) -> Any:
    bounds = bounds or Bounds("a whole number" if kind is int else "a finite number")
    if not _is_number(value) or (kind is int and not isinstance(value, int)) or value not in bounds:
        raise ValueError(f"expected {name} to be {bounds}, got {shown(value)}.")
    if bounds.limit:
        limits.check(bounds.limit, value, f"for {name}")
    return value


def _items(hint: Any, value: Any, name: str) -> tuple[Any, ...]:
    if not isinstance(value, (tuple, list, np.ndarray)) or (isinstance(value, np.ndarray) and value.ndim != 1):
        raise ValueError(f"expected {name} to be a list of values, got {shown(value)}.")
    kinds = get_args(hint)
    if kinds[-1] is not Ellipsis and len(value) != len(kinds):
        raise ValueError(f"expected {name} to be {len(kinds)} values, got {shown(value)}.")
    limits.check("frames", len(value), f"values in {name}")
    kind = kinds[0]
    items = tuple(_checked(kind, item, f"{name}[{i}]") for i, item in enumerate(value))
    return value if isinstance(value, tuple) and all(a is b for a, b in zip(items, value, strict=True)) else items


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
