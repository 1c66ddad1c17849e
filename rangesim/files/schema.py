# SPDX-License-Identifier: Apache-2.0
"""Schemas of the files that this package writes and reads back: typed, versioned, checked before they are used.

A file of settings is a `Record`: a msgspec structure without unknown fields, whose format and version are constants. A
file of arrays has one `ArraySpec` for each array. Whoever reads gets what the types promise, or one sentence that names
file and place.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np

from rangesim.errors import FileFormatError
from rangesim.files.array_files import read_arrays
from rangesim.files.text_files import read_json
from rangesim.settings import limits
from rangesim.settings.config import shown

Count = Annotated[int, msgspec.Meta(ge=0, le=1 << 53)]
Photons = Annotated[float, msgspec.Meta(ge=0, le=1e300)]
"""A mean number of photons."""
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
MAX_METRES = 1e9
Metres = Annotated[float, msgspec.Meta(ge=-MAX_METRES, le=MAX_METRES)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=1000)]


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of what a JSON file holds."""


R = TypeVar("R", bound=Record)


def read_record(path: Path, kind: type[R]) -> R:
    """What a JSON file holds, as `kind`.

    Raises
    ------
    FileFormatError
        The file is missing, broken, of another format or version, or a value is not what `kind` says.
    """
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise FileFormatError(f"{path} is no plain file.")
    data = read_json(path)
    expected = {f.name: f.type for f in msgspec.structs.fields(kind) if f.name in ("format", "format_version")}
    for name, constant in expected.items():  # before all other fields: they may be those of another version
        (value,) = constant.__args__
        found = data.get(name) if isinstance(data, dict) else None
        if type(found) is not type(value) or found != value:
            raise FileFormatError(
                f"{path}: expected {name.replace('_', ' ')} {value!r}, got {shown(found)}; write it anew with this "
                "version of rangesim."
            )
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        what, _, place = str(error).partition(" - at `$")
        place = place.rstrip("`").lstrip(".") or "the top"
        raise FileFormatError(f"{path}: {_plain(what)}, at {place[:200]}.") from error


def write_record(path: Path, record: Record) -> None:
    """Write a record as JSON, indented; `read_record` reads it back equal."""
    try:
        content = msgspec.json.encode(record)
    except UnicodeEncodeError:  # a file's name that is no UTF-8: json spells half surrogate pairs out
        write_json(path, msgspec.to_builtins(record))
    else:
        path.write_bytes(msgspec.json.format(content, indent=1) + b"\n")


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write plain data, indented."""
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _plain(sentence: str) -> str:
    return sentence.replace("`", "").replace("Expected", "expected").replace("Object", "the table", 1)


@dataclass(frozen=True)
class ArraySpec:
    """What an array of a file has to be.

    dtype : name of the NumPy type; "str" for text. shape : numbers, or letters that stand for the same number wherever
    they occur. low, high : bounds of its finite values. per_pixel : how many values there are at most for each of h x w
    pixels; 0: no bound. nan, inf : whether it may hold these. required : whether the
    file has to have it.
    """

    dtype: str
    shape: tuple[int | str, ...] = ("h", "w")
    low: float = -1e30
    high: float = 1e30
    nan: bool = False
    inf: bool = False
    required: bool = True
    per_pixel: int = 0


def read_checked_arrays(path: Path, specs: Mapping[str, ArraySpec], sizes: dict[str, int]) -> dict[str, np.ndarray]:
    """Arrays of an .npz file by name.

    sizes : numbers that letters in shapes stand for, h and w among them; completed by those that occur here for the
        first time. Types and shapes are checked before memory is allocated.

    Raises
    ------
    FileFormatError
        The file is missing or broken, lacks an array or has one too many, or one is not what its spec says.
    """
    if not path.is_file():
        raise FileFormatError(f"{path} is missing.")

    def check(name: str, place: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if name not in specs:
            raise FileFormatError(f"{path}: expected the arrays {', '.join(specs)}, got {shown(name)} as well.")
        _check_header(shape, dtype, specs[name], sizes, place)

    arrays = read_arrays(path, check=check)
    for name, spec in specs.items():
        if name in arrays:
            _check_values(arrays[name], spec, f"{path}: array {name!r}")
        elif spec.required:
            raise FileFormatError(f"{path}: expected an array {name!r}, found none of that name.")
    return arrays


SETTINGS = ArraySpec("uint8", ("settings",))
"""An array of settings in a file of arrays; see `settings_array`."""


def settings_array(data: Mapping[str, Any]) -> np.ndarray:
    """Plain data as an array of bytes, JSON, to stand beside others in a file of arrays."""
    return np.frombuffer(json.dumps(data).encode(), np.uint8)


def settings_of(array: np.ndarray, path: Path) -> dict[str, Any]:
    """The plain data that `settings_array` made an array of; FileFormatError if it is no table."""
    try:
        settings = json.loads(array.tobytes().decode())
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: expected settings as JSON: {shown(str(error))}.") from error
    if not isinstance(settings, dict):
        raise FileFormatError(f"{path}: expected settings as a table, got {shown(settings)}.")
    return settings


MAX_TEXT = 1000
"""Characters of a name in an array of text."""


def _check_header(
    shape: tuple[int, ...], dtype: np.dtype[Any], spec: ArraySpec, sizes: dict[str, int], place: str
) -> None:
    """Check what is known before memory is allocated; completes `sizes`."""
    is_text = spec.dtype == "str" and dtype.kind == "U" and dtype.itemsize <= 4 * MAX_TEXT
    if not is_text and dtype != np.dtype(spec.dtype if spec.dtype != "str" else object):
        raise FileFormatError(f"{place}: expected {spec.dtype}, got {str(dtype)[:100]}.")
    known = tuple(sizes.get(n, -1) if isinstance(n, str) else n for n in spec.shape)
    if len(shape) != len(known) or any(k not in (-1, n) for k, n in zip(known, shape, strict=True)):
        words = " x ".join("any" if k == -1 else str(k) for k in known) or "a single value"
        raise FileFormatError(f"{place}: expected shape {words}, got {' x '.join(map(str, shape)) or 'a value'}.")
    for letter, n in zip(spec.shape, shape, strict=True):
        if isinstance(letter, str):
            sizes[letter] = n
    if spec.per_pixel and math.prod(shape) > spec.per_pixel * sizes["h"] * sizes["w"]:
        raise FileFormatError(f"{place}: expected at most {spec.per_pixel} values per pixel, got {math.prod(shape)}.")
    if is_text:
        limits.check("shapes", math.prod(shape), f"names in {place}", FileFormatError)


def _check_values(array: np.ndarray, spec: ArraySpec, place: str) -> None:
    if array.dtype.kind not in "iuf" or array.size == 0:
        return
    if array.dtype.kind == "f":
        if not spec.nan and np.isnan(array).any():
            raise FileFormatError(f"{place}: expected numbers, got NaN.")
        finite = array[np.isfinite(array)]
        if not spec.inf and finite.size + np.isnan(array).sum() < array.size:
            raise FileFormatError(f"{place}: expected finite values, got infinity.")
    else:
        finite = array
    if finite.size and not (spec.low <= finite.min() and finite.max() <= spec.high):
        raise FileFormatError(
            f"{place}: expected values from {spec.low:g} to {spec.high:g}, got {finite.min():g} to {finite.max():g}."
        )
