# SPDX-License-Identifier: Apache-2.0
"""What values a setting may have: types and bounds are stated on the fields of its dataclass, and checked here.

A field says what it is, `spp: Annotated[int, whole(1, "spp")]` or `baseline_m: Metres`, and `check_fields(self)` in
`__post_init__` holds every field to it. No number may be NaN or infinite, or a bool. The ranges are wide: they exclude
what single precision, or physics, has no place for.
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
    """The closed interval in which a number has to lie.

    words : what the number has to be, for messages: "positive".
    or_zero : whether 0 is accepted too.
    limit : name of the entry of `rangesim.settings.limits` that is the upper bound.
    """

    words: str
    low: float = -math.inf
    high: float = math.inf
    or_zero: bool = False
    limit: str = ""

    def __contains__(self, value: float) -> bool:
        finite = isinstance(value, int) or math.isfinite(value)  # the longest whole numbers are beyond a float
        return finite and (self.low <= value <= self.high or (self.or_zero and value == 0))

    def __str__(self) -> str:
        if math.isinf(self.high):
            return self.words
        return f"{self.words}, {self.low:g} to {self.high:g}"


def whole(low: int, limit: str = "") -> Bounds:
    """Bounds of a whole number: at least `low`, at most the entry `limit` of `rangesim.settings.limits`."""
    return Bounds(f"a whole number of at least {low}", low, limit=limit)


MAX_COORDINATE_M = 1e7
"""Metres: room for coordinates of maps, and of the globe; beyond, double precision has no nanometres."""
Metres = Annotated[float, Bounds("positive and finite", 1e-9, MAX_COORDINATE_M)]
Watts = Annotated[float, Bounds("positive and finite", 1e-12, 1e9)]
HERTZ = Bounds("positive and finite", 1.0, 1e12)
Hertz = Annotated[float, HERTZ]
SECONDS = Bounds("positive and finite", 1e-15, 1e6)
Seconds = Annotated[float, SECONDS]
Pause = Annotated[float, Bounds("0 or positive", 1e-15, 1e6, or_zero=True)]
Wavelength = Annotated[float, Bounds("positive and finite", 1e-8, 1e-2)]
Exponent = Annotated[float, Bounds("an exponent of at least 0", 0, 100)]
Coordinate = Annotated[float, Bounds("a coordinate", -MAX_COORDINATE_M, MAX_COORDINATE_M)]
Fraction = Annotated[float, Bounds("a fraction", 0, 1)]
PositiveFraction = Annotated[float, Bounds("a positive fraction", 1e-9, 1)]


def check_fields(setting: Any) -> None:
    """Raise ValueError on the first field of a dataclass whose value is not of its type, or out of its bounds.

    NumPy scalars become Python's, and lists in place of tuples become tuples; the dataclass may be frozen. Fields that
    hold arrays or mappings are left to the class itself.
    """
    for field in dataclasses.fields(setting):
        if field.init:
            value = getattr(setting, field.name)
            checked = _checked(_hints(type(setting))[field.name], value, field.name)  # type: ignore[arg-type]
            if checked is not value:
                object.__setattr__(setting, field.name, checked)


def check_number(name: str, value: Any, bounds: Bounds) -> None:
    """Raise ValueError unless `value` is a number, and within its bounds."""
    kind = int if bounds.words.startswith("a whole number") else float
    _number(kind, value.item() if isinstance(value, np.generic) else value, name, bounds)


@lru_cache(maxsize=256)
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls, include_extras=True)


def _checked(hint: Any, value: Any, name: str) -> Any:
    """`value`, as a plain Python value if it is a NumPy scalar or a list; ValueError if it does not fit `hint`."""
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
