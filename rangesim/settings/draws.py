# SPDX-License-Identifier: Apache-2.0
"""Settings that are drawn at random: one notation for all of them, in TOML and in Python.

| notation | value |
| --- | --- |
| `0.5`, `"steel"` | always this one |
| `[0.1, 0.2]`, `{choice = [0.1, 0.2]}` | one of the list, each as likely; an entry may be a distribution itself |
| `{uniform = [a, b]}` | uniform from a to b; whole numbers, both ends included, where the setting is a whole number |
| `{log_uniform = [a, b]}` | the logarithm is uniform from log a to log b, both positive |
| `{normal = [m, s]}` | normal of mean m and standard deviation s, drawn again while it is out of the setting's bounds |

The unit is that of the setting's name.

Examples
--------
>>> import numpy as np
>>> power_w = Draw.of({"log_uniform": [0.01, 1.0]})
>>> 0.01 <= power_w.value(np.random.default_rng(0)) <= 1.0
True
>>> power_w.to_plain()
{'log_uniform': [0.01, 1.0]}
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Annotated, Any, Self, get_args, get_origin, get_type_hints

import numpy as np

from rangesim.settings.bounds import Bounds
from rangesim.settings.config import Plain, nearest, shown

DISTRIBUTIONS = ("choice", "uniform", "log_uniform", "normal")
"""Keys of the tables that stand for a distribution."""
MAX_TRIES = 1000
"""Largest number of times that a normal number is drawn again. The mean lies within the bounds, so at least about half
of all numbers do, unless the standard deviation is a hundred times the width of the bounds."""


@dataclass(frozen=True)
class Of:
    """Values that a field of type `Draw` may hold, as annotated: `count: Annotated[Draw, Of(int, bounds)]`.

    kind : `float`, `int`, `str` or `bool`. bounds : those of a number; None: any finite one.
    """

    kind: type
    bounds: Bounds | None = None


ANY_NUMBER = Of(float)
"""A finite number."""


@dataclass(frozen=True)
class Draw(Plain):
    """A setting that is constant or drawn at random.

    Parameters
    ----------
    kind : "constant", or one of `DISTRIBUTIONS`.
    values : the constant; the draws of a choice; the two ends; or mean and standard deviation.

    Examples
    --------
    >>> import numpy as np
    >>> Draw.of(["red", "red"]).value(np.random.default_rng(0))
    'red'
    """

    kind: str
    values: tuple[Any, ...]

    @classmethod
    def of(cls, value: Any, where: str = "value") -> Self:
        """The draw that plain data describe, or the given draw itself.

        Raises
        ------
        ValueError
            An unknown distribution, or numbers that do not describe one.
        """
        if isinstance(value, cls):
            return value
        if isinstance(value, (list, tuple)):
            value = {"choice": value}
        if not isinstance(value, Mapping):
            return cls("constant", (value,))
        if len(value) != 1 or (kind := next(iter(value))) not in DISTRIBUTIONS:
            hint = nearest(str(next(iter(value), "")), DISTRIBUTIONS)
            raise ValueError(
                f"expected {where} to be a value, a list, or a table with one of {', '.join(DISTRIBUTIONS)}, "
                f"got {shown(dict(value))}{hint}."
            )
        given = value[kind]
        if not isinstance(given, (list, tuple)) or not given:
            raise ValueError(f"expected {kind} of {where} to be a list of values, got {shown(given)}.")
        if kind == "choice":
            return cls(kind, tuple(cls.of(entry, f"{where}[{i}]") for i, entry in enumerate(given)))
        if len(given) != 2 or not all(_is_number(number) for number in given):
            raise ValueError(f"expected {kind} of {where} to be two numbers, got {shown(given)}.")
        first, second = given
        if kind == "normal" and second < 0:
            raise ValueError(f"expected a standard deviation of at least 0 for {where}, got {shown(second)}.")
        if kind != "normal" and not first <= second:
            raise ValueError(f"expected {kind} of {where} from the lower to the higher end, got {shown(given)}.")
        if kind == "log_uniform" and not first > 0:
            raise ValueError(f"expected positive ends of log_uniform for {where}, got {shown(given)}.")
        return cls(kind, (first, second))

    @classmethod
    def from_plain(cls, value: Any, where: str) -> Self:
        return cls.of(value, where)

    def to_plain(self) -> Any:
        if self.kind == "constant":
            return self.values[0]
        entries = [entry.to_plain() if isinstance(entry, Draw) else entry for entry in self.values]
        return entries if self.kind == "choice" else {self.kind: entries}

    def leaves(self) -> Iterator[Draw]:
        """The draw itself, or the leaves of all entries of a choice."""
        if self.kind != "choice":
            yield self
        for entry in self.values if self.kind == "choice" else ():
            yield from entry.leaves()

    def check(self, name: str, of: Of) -> None:
        """Raise ValueError if a value that may be drawn is not one that the field `name` may hold.

        Of a normal distribution the mean must be in bounds, because values outside are drawn again.
        """
        kind, bounds = of.kind, of.bounds
        words = {str: "a text", bool: "true or false", int: "a whole number", float: "a finite number"}[kind]
        for leaf in self.leaves():
            if leaf.kind != "constant" and kind not in (int, float):
                raise ValueError(f"expected {name} to be {words} or a list of such, got {shown(leaf.to_plain())}.")
            if kind is int and leaf.kind not in ("constant", "uniform"):
                raise ValueError(f"expected {name} as a whole number, a list or uniform, got {shown(leaf.to_plain())}.")
            for value in leaf.values[:1] if leaf.kind == "normal" else leaf.values:
                is_kind = _is_number(value) if kind is float else isinstance(value, kind)
                if not is_kind or (kind is int and isinstance(value, bool)) or (bounds and value not in bounds):
                    raise ValueError(f"expected {name} to be {bounds or words}, got {shown(value)}.")

    def value(self, random: np.random.Generator, of: Of = ANY_NUMBER) -> Any:
        """A value of the distribution.

        Parameters
        ----------
        of : whether a uniform number is whole, and the bounds in which a normal number is accepted.

        Raises
        ------
        ValueError
            A normal distribution whose values are practically never in bounds.
        """
        if self.kind == "constant":
            return self.values[0]
        if self.kind == "choice":
            return self.values[int(random.integers(len(self.values)))].value(random, of)
        first, second = self.values
        if self.kind == "uniform":
            if of.kind is int:
                return int(random.integers(first, second, endpoint=True))
            return float(random.uniform(first, second))
        if self.kind == "log_uniform":
            return float(np.clip(np.exp(random.uniform(math.log(first), math.log(second))), first, second))
        for _ in range(MAX_TRIES):
            drawn = float(random.normal(first, second))
            if of.bounds is None or drawn in of.bounds:
                return drawn
        raise ValueError(f"expected a normal distribution with values that are {of.bounds}, got {self.to_plain()}.")

    def __repr__(self) -> str:
        return f"Draw({shown(self.to_plain())})"


def _is_number(value: Any) -> bool:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and abs(value) <= sys.float_info.max  # an int may be too large for a float; NaN fails


@lru_cache(maxsize=256)
def _draws(cls: type) -> dict[str, Of]:
    """The fields of a dataclass that are draws, and what each may hold."""
    found = {}
    for name, hint in get_type_hints(cls, include_extras=True).items():
        for part in (hint, *get_args(hint)):
            if get_origin(part) is Annotated and isinstance(get_args(part)[1], Of):
                found[name] = get_args(part)[1]
    return found


def check_draws(setting: Any) -> None:
    """Make draws of the plain values in the fields that are annotated with `Of`; raise ValueError on wrong ones."""
    defaults = {field.name: field.default for field in fields(setting)}
    for name, of in _draws(type(setting)).items():  # type: ignore[arg-type]
        value = getattr(setting, name)
        if value is not None or defaults[name] is not None:  # a default of None is allowed
            draw = Draw.of(value, name)
            draw.check(name, of)
            object.__setattr__(setting, name, draw)


def drawn(setting: Any, random: np.random.Generator) -> dict[str, Any]:
    """A value of each field of a dataclass that is a draw, in the order of the fields; None where the field is None."""
    values, of_fields = dict[str, Any](), _draws(type(setting))  # type: ignore[arg-type]
    for field in fields(setting):
        of = of_fields.get(field.name)
        if of is not None:
            draw = getattr(setting, field.name)
            values[field.name] = None if draw is None else draw.value(random, of)
    return values


def draw_table(table: Any, random: np.random.Generator) -> Any:
    """Plain data in which every table that stands for a distribution is replaced by a value of it.

    A list stays a list here, because settings that hold lists are among them; a choice is `{choice = [...]}`.

    Examples
    --------
    >>> draw_table({"power_w": {"uniform": [2.0, 2.0]}, "sizes": [1, 2]}, np.random.default_rng(0))
    {'power_w': 2.0, 'sizes': [1, 2]}
    """
    if isinstance(table, Mapping):
        if len(table) == 1 and next(iter(table)) in DISTRIBUTIONS:
            return Draw.of(table).value(random)
        return {key: draw_table(value, random) for key, value in table.items()}
    return [draw_table(value, random) for value in table] if isinstance(table, list) else table
