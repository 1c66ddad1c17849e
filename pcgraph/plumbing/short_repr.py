# SPDX-License-Identifier: Apache-2.0
"""A short `repr`, of one to five lines, for dataclasses of arrays."""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Mapping
from typing import Any

import numpy as np

MAX_LINES = 5
"""Most lines of one `repr`, count; fields that do not fit are counted: "and 4 more". Chosen by eye."""
MAX_COLUMNS = 100
"""Most characters of a line, count, so that lines fit on a terminal; a longer `repr` is broken into several lines.
Chosen by eye."""
MAX_ENTRIES = 3
"""Most entries of a dictionary of arrays that are shown, count; the others are counted. Chosen by eye."""


class ShortRepr:
    """A mixin for dataclasses of arrays: its `repr` names shapes and types in place of a thousand numbers.

    Examples
    --------
    >>> @dataclasses.dataclass
    ... class Planes(ShortRepr):
    ...     normals: np.ndarray
    >>> Planes(np.zeros((500, 3)))
    Planes(normals=float64[500, 3])
    """

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if cls.__repr__ is ShortRepr.__repr__:
            cls.__repr__ = ShortRepr.__repr__  # type: ignore[method-assign]  # @dataclass keeps a `repr` of the class itself

    def _counts(self) -> str:
        """A few words at the beginning, such as "3 regions"; empty unless a subclass overrides this."""
        return ""

    def __repr__(self) -> str:
        name, counts = type(self).__name__, self._counts()
        parts = [counts] if counts else []
        parts += [f"{f.name}={in_short(getattr(self, f.name))}" for f in dataclasses.fields(self)]  # type: ignore[arg-type]
        line = f"{name}({', '.join(parts)})"
        return line if len(line) <= MAX_COLUMNS else f"{name}(\n" + "\n".join(_filled(parts)) + ")"


def in_short(value: Any) -> str:
    """A short `repr`: type and shape of an array, or length and type of the first entry of a long list."""
    if isinstance(value, np.ndarray) and value.size > 1:
        if value.ndim == 1 and value.size <= 4 and value.dtype.kind in "iufb":
            return np.array2string(value, precision=4, separator=", ")
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, ShortRepr):
        return f"{type(value).__name__}(...)"
    if isinstance(value, Mapping) and any(isinstance(v, np.ndarray) for v in value.values()):
        shown = [f"{str(k)[:20]}: {in_short(v)}" for k, v in list(value.items())[:MAX_ENTRIES]]
        return (
            "{" + ", ".join(shown) + (f" and {len(value) - len(shown)} more" if len(value) > len(shown) else "") + "}"
        )
    many = isinstance(value, (tuple, list)) and (len(value) > 3 or any(isinstance(v, np.ndarray) for v in value))
    if many and value:
        return f"{len(value)} of {type(value[0]).__name__}"
    return SHORT.repr(value) if not dataclasses.is_dataclass(value) else f"{type(value).__name__}(...)"


def _plain_repr() -> reprlib.Repr:
    """`repr` of plain values, cut to a readable length: 100 characters, 8 entries, 3 levels; chosen by eye."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 100
    short.maxlist = short.maxtuple = short.maxarray = 8
    short.maxlevel = 3
    return short


SHORT = _plain_repr()


def _filled(parts: list[str]) -> list[str]:
    """The parts on at most `MAX_LINES` indented lines; parts that do not fit are counted."""
    lines = ["   "]
    for number, part in enumerate(parts):
        if lines[-1].strip() and len(lines[-1]) + len(part) + 2 > MAX_COLUMNS:
            if len(lines) == MAX_LINES - 1:
                lines[-1] += f" and {len(parts) - number} more"
                return lines
            lines.append("   ")
        lines[-1] += f" {part}" + ("," if number < len(parts) - 1 else "")
    return lines
