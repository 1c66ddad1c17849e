# SPDX-License-Identifier: Apache-2.0
"""Strict conversion between frozen dataclasses and plain data (TOML, JSON).

Every setting of the package is a frozen dataclass, and files of settings are read and written through this module only.
It refuses unknown keys and names the nearest valid one, and checks the types of values. What it reads back is equal to
what it wrote. Lengths, whose names end in `_m`, are in metres, or texts with a unit (`rangesim.settings.lengths`).

Examples
--------
>>> from rangesim.rig import Lens
>>> table = to_dict(Lens(aperture_radius_m=2e-3))
>>> table
{'aperture_radius_m': 0.002, 'focus_m': None, 'vignetting': 0.0, 'stray_light': 0.0}
>>> from_dict(Lens, table) == Lens(aperture_radius_m=2e-3)
True
>>> from_dict(Lens, {"aperture_radius_m": "2 mm"}) == Lens(aperture_radius_m=2e-3)
True
>>> from_dict(Lens, {"aperture_radius_m": 2e-3, "focus": 1.0})
Traceback (most recent call last):
ValueError: Lens: unknown key 'focus' (did you mean 'focus_m'?); valid are aperture_radius_m, ...
"""

from __future__ import annotations

import dataclasses
import difflib
import sys
import types
import typing
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from pcgraph.plumbing.short_repr import SHORT
from pcgraph.plumbing.short_repr import ShortRepr as ShortRepr
from rangesim.settings.lengths import metres

T = TypeVar("T")


def to_dict(setting: Any) -> Any:
    """Plain data (dict, list, str, number, bool, None) of a dataclass.

    For a class with a `type_name`, the table begins with the key `type`, so that `from_dict` finds the class again.
    """
    if isinstance(setting, Plain):
        return setting.to_plain()
    if dataclasses.is_dataclass(setting) and not isinstance(setting, type):
        fields = {f.name: to_dict(getattr(setting, f.name)) for f in dataclasses.fields(setting) if f.init}
        tag = getattr(setting, "type_name", None)
        return {"type": tag, **fields} if tag else fields
    if isinstance(setting, np.ndarray):
        return setting.tolist()
    if isinstance(setting, Mapping):
        return {key: to_dict(value) for key, value in setting.items()}
    if isinstance(setting, (tuple, list)):
        return [to_dict(value) for value in setting]
    return setting


def from_dict(cls: type[T], data: Any, where: str = "") -> T:
    """An instance of the dataclass `cls` made from plain data.

    Parameters
    ----------
    cls : dataclass type. If it is the abstract base of a family (`Named`), `data["type"]` is the `type_name` of the
        subclass to make.
    data : mapping of field names to plain values. If the default value of a field is a dataclass, a table for it need
        only hold the fields that differ from that default.
    where : name of the place in the file, for messages, for example "sensors[0].rig".

    Raises
    ------
    ValueError
        Unknown or missing key, wrong type, or a value that the dataclass refuses; the message names the place.
    """
    place = where or cls.__name__
    if not isinstance(data, Mapping):
        raise ValueError(f"{place}: expected a table of settings, got {type(data).__name__} {shown(data)}.")
    values = dict(data)
    cls = _concrete(cls, values, place)
    hints = _hints(cls)  # type: ignore[arg-type]
    names = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    check_keys(values, names, place)
    missing = [n for n, f in names.items() if n not in values and _required(f)]
    if missing:
        raise ValueError(f"{place}: missing {', '.join(map(repr, missing))}.")
    try:
        values = {key: _in_metres(key, on_top_of(names[key].default, value)) for key, value in values.items()}
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error
    arguments = {key: _value(hints[key], value, f"{where}.{key}".lstrip(".")) for key, value in values.items()}
    try:
        return cls(**arguments)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def _in_metres(key: str, value: Any) -> Any:
    """The value of a field; a length (its name ends in "_m") with a unit is converted to metres."""
    if key.endswith("_m") and isinstance(value, str):
        return metres(value, key)
    if key.endswith("_m") and isinstance(value, list):
        return [_in_metres(key, each) for each in value]
    return value


@lru_cache(maxsize=256)  # evaluating the annotations takes longer than everything else that is done for a table
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def on_top_of(default: Any, table: Any) -> Any:
    """A default value as plain data, updated with the entries of a table.

    The table is returned unchanged if the default is no dataclass or has another `type`, or if the table is a whole
    member of the family whose tables have no `type`. A value that is no table is returned unchanged too.
    """
    if not isinstance(table, Mapping) or not dataclasses.is_dataclass(default) or isinstance(default, (type, Plain)):
        return table
    untagged = getattr(default, "untagged", None)
    if untagged is not None and {f.name for f in dataclasses.fields(untagged) if _required(f)} <= set(table):
        return table
    settings = to_dict(default)
    return {**settings, **table} if table.get("type", settings.get("type")) == settings.get("type") else table


def shown(value: Any) -> str:
    """Text of a value for a message: its `repr`, shortened to a readable length."""
    if isinstance(value, int) and abs(value) >= 10**30:
        # Python refuses to print integers of more than 4300 digits
        return f"{'-' if value < 0 else ''}2^{value.bit_length() - 1} or more"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and type {value.dtype}"
    return SHORT.repr(value)


def brief(error: BaseException) -> str:
    """Message of a library's error on one line, cut after `MAX_REASON` characters."""
    return " ".join(str(error).split())[:MAX_REASON]


MAX_REASON = 200
"""Largest number of characters that are quoted of a library's message: two lines of a terminal, because some libraries
put whole files into their messages."""


def check_keys(given: Mapping[str, Any], valid: typing.Iterable[str], place: str) -> None:
    """Raise ValueError on the first key that is not valid; the message names the nearest valid one."""
    valid = list(valid)
    for key in given:
        if key not in valid:
            raise ValueError(f"{place}: unknown key {shown(key)}{nearest(key, valid)}; valid are {', '.join(valid)}.")


def nearest(name: str, valid: typing.Iterable[str]) -> str:
    """The text " (did you mean ...?)" with the valid name closest to `name`; empty if none is close."""
    close = difflib.get_close_matches(str(name)[:100], list(valid), n=1, cutoff=0.5)
    return f" (did you mean {close[0]!r}?)" if close else ""


def has_defaults(cls: type[Any]) -> bool:
    """Whether an instance of a dataclass can be made without naming a setting."""
    return not any(f.init and _required(f) for f in dataclasses.fields(cls))


def _required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _concrete(cls: type[T], values: dict[str, Any], place: str) -> type[T]:
    """The class to make: `cls`, or the member of its family that the key `type` names. Removes the key."""
    if not issubclass(cls, Named):
        return cls
    own = getattr(cls, "type_name", None)
    if not own and dataclasses.is_dataclass(cls):  # the untagged member itself
        return cls
    if not own and "type" not in values and cls.untagged is not None:
        return cls.untagged
    choices: dict[str, type[Any]] = {own: cls} if own else {k: v for k, v in cls.known.items() if issubclass(v, cls)}
    tag = values.pop("type", own)
    if not isinstance(tag, str) or tag not in choices:
        raise ValueError(
            f"{place}: expected 'type' to be one of {', '.join(choices)}, got {shown(tag)}{nearest(str(tag), choices)}."
        )
    return choices[tag]


class Plain(ABC):
    """Base of a setting whose plain form is no table of its fields, such as a number that may be drawn at random."""

    @abstractmethod
    def to_plain(self) -> Any:
        """The setting as plain data."""

    @classmethod
    @abstractmethod
    def from_plain(cls, value: Any, where: str) -> typing.Self:
        """The setting that plain data describe; ValueError with the place `where` if they describe none."""


class Named:
    """Base of a family of classes such as sensors, detectors or responses. Files name each class by its `type_name`.

    The base of a family derives from `Named` and sets ``known = {}``. Every subclass with a `type_name` then joins the
    family when it is defined, also a subclass from outside the package. If the same lines are run again, as in a
    notebook, the new class replaces the older one.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> class Shape(Named):
    ...     known = {}
    >>> @dataclass(frozen=True)
    ... class Ball(Shape):
    ...     radius_m: float = 1.0
    ...     type_name = "ball"
    >>> Shape.known["ball"] is Ball
    True
    >>> from_dict(Shape, {"type": "ball", "radius_m": 2.0})
    Ball(radius_m=2.0)
    """

    type_name: typing.ClassVar[str]
    known: typing.ClassVar[dict[str, type[Any]]]
    """Classes of the family by `type_name`, in the order of their definition; every family has its own."""
    untagged: typing.ClassVar[type[Any] | None] = None
    """The member whose tables have no key `type`, because files with such tables are older than the family."""

    def __init_subclass__(cls, untagged: bool = False) -> None:
        super().__init_subclass__()
        if untagged:
            family = next(kind for kind in cls.__mro__ if "known" in vars(kind))
            family.untagged = cls  # type: ignore[attr-defined]
        if "known" in vars(cls) or not hasattr(cls, "type_name"):
            return
        name = cls.type_name
        if "type_name" not in vars(cls):
            raise TypeError(f"expected {cls.__name__} to have a type_name of its own, other than {name!r}.")
        older = cls.known.get(name)
        if older is not None and (older.__qualname__, _source(older)) != (cls.__qualname__, _source(cls)):
            raise TypeError(f"expected {cls.__name__} to have a type_name of its own; {name!r} is taken.")
        cls.known[name] = cls

    @staticmethod
    def families() -> list[type[Named]]:
        """The bases of all families that are loaded, such as `Sensor`, `Decoder` and `Response`.

        Examples
        --------
        >>> from rangesim.response import Response
        >>> Response in Named.families()
        True
        """
        found, waiting = [], list(Named.__subclasses__())
        while waiting:
            kind = waiting.pop()
            if "known" in vars(kind):
                found.append(kind)
            else:
                waiting += kind.__subclasses__()
        return found


def _source(kind: type[Any]) -> str:
    """File in which a class is defined, or the name of its module if there is no file."""
    module = sys.modules.get(kind.__module__)
    return getattr(module, "__file__", None) or kind.__module__


def _value(hint: Any, value: Any, where: str) -> Any:
    """A plain value converted to the annotated type; ValueError if it does not match."""
    if get_origin(hint) in (Union, types.UnionType):
        if value is None and type(None) in get_args(hint):
            return None
        hint = next(arg for arg in get_args(hint) if arg is not type(None))
    if get_origin(hint) is typing.Literal and not (isinstance(value, str) and value in get_args(hint)):
        valid = get_args(hint)
        raise ValueError(
            f"{where}: expected one of {', '.join(valid)}, got {shown(value)}{nearest(str(value), valid)}."
        )
    if isinstance(hint, type) and issubclass(hint, Plain):
        return hint.from_plain(value, where)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return from_dict(hint, value, where)
    if isinstance(hint, type) and issubclass(hint, Named) and isinstance(value, (Mapping, str)):
        return from_dict(hint, {"type": value} if isinstance(value, str) else value, where)
    if get_origin(hint) is tuple and dataclasses.is_dataclass(get_args(hint)[0]):
        return tuple(from_dict(get_args(hint)[0], v, f"{where}[{i}]") for i, v in enumerate(value))
    if hint is np.ndarray or get_origin(hint) is np.ndarray:
        try:
            return np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{where}: expected an array of numbers, got {shown(value)}.") from error
    try:
        return msgspec.convert(value, hint)
    except msgspec.ValidationError as error:
        expected, _, rest = str(error).partition(", got ")
        inner = rest.partition(" - at `$")[2].rstrip("`")  # such as [1]
        wanted = expected.replace("`", "").replace("Expected", "expected")
        raise ValueError(f"{where}{inner}: {wanted}, got {shown(value)}.") from error
