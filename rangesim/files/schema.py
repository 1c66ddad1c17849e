# SPDX-License-Identifier: Apache-2.0
"""Schemas of the files that this package writes and reads back. Files are checked against them before they are used.

A JSON file is a `Record`: a msgspec structure that refuses unknown fields, and whose format and version are constants.
A file of arrays has an `ArraySpec` for each array. Reading returns data that agree with the schema, or raises an error
whose message names the file and the place in it.
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
from rangesim.files.array_files import Check, arrays_from_bytes, read_arrays
from rangesim.files.text_files import read_json
from rangesim.settings import limits
from rangesim.settings.config import shown

Count = Annotated[int, msgspec.Meta(ge=0, le=1 << 53)]
"""A count, at most 2^53, because JSON readers with double precision cannot hold every integer above it."""
Photons = Annotated[float, msgspec.Meta(ge=0, le=1e300)]
"""A mean count of photons; the upper bound only excludes infinity."""
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
"""A fraction from 0 to 1."""
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
"""A duration in seconds, at most 30 years; the upper bound only excludes nonsense."""
Positive = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
"""A positive number in whatever unit; the upper bound only excludes nonsense."""
MAX_METRES = 1e9
"""Largest distance in a file, in metres: a hundred times `rangesim.settings.bounds.MAX_COORDINATE_M`. It only excludes
damaged numbers; a wrong measurement may lie far outside the scene."""
Metres = Annotated[float, msgspec.Meta(ge=-MAX_METRES, le=MAX_METRES)]
"""A length in metres, of either sign."""
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=1000)]
"""A name of 1 to 1000 characters; see `MAX_TEXT` for the reason."""


class Record(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the contents of a JSON file: a structure that refuses unknown fields."""


R = TypeVar("R", bound=Record)


def read_record(path: Path, kind: type[R]) -> R:
    """The contents of a JSON file as a structure of type `kind`.

    Raises
    ------
    FileFormatError
        The file is missing, broken, of another format or version, or does not match `kind`.
    """
    if path.exists() and not path.is_file():  # reading a pipe would wait
        raise FileFormatError(f"{path} is no plain file.")
    data = read_json(path)
    expected = {f.name: f.type for f in msgspec.structs.fields(kind) if f.name in ("format", "format_version")}
    for name, constant in expected.items():  # first, because another version has other fields
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
    """Write a record as indented JSON; `read_record` reads it back equal."""
    path.write_bytes(record_bytes(record))


def record_bytes(record: Record) -> bytes:
    """The bytes of the file that `write_record` writes."""
    try:
        content = msgspec.json.encode(record)
    except UnicodeEncodeError:  # a file name that is not UTF-8 has lone surrogates, which `json` escapes
        return json_bytes(msgspec.to_builtins(record))
    return msgspec.json.format(content, indent=1) + b"\n"


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write plain data as indented JSON."""
    path.write_bytes(json_bytes(data))


def json_bytes(data: Mapping[str, Any]) -> bytes:
    """The bytes of the file that `write_json` writes."""
    return f"{json.dumps(data, indent=1)}\n".encode()


def _plain(sentence: str) -> str:
    return sentence.replace("`", "").replace("Expected", "expected").replace("Object", "the table", 1)


@dataclass(frozen=True)
class ArraySpec:
    """Requirements on an array in a file.

    Parameters
    ----------
    dtype : name of the NumPy type; "str" for text.
    shape : sizes of the axes, as numbers or as letters. A letter stands for the same number in all arrays of the file.
    low, high : bounds of the finite values.
    nan, inf : whether NaN and infinity are allowed.
    required : whether the file must have the array.
    per_pixel : largest number of values per pixel of the h x w pixels; 0: any number.
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
    """The arrays of an .npz file by name, checked against their specs.

    Types and shapes are checked before memory is allocated.

    Parameters
    ----------
    specs : the requirements by name of array; the file may hold no other arrays.
    sizes : the numbers that letters in shapes stand for, at least h and w. New letters are added to `sizes`.

    Raises
    ------
    FileFormatError
        The file is missing or broken, lacks an array, has an array too many, or has one that does not meet its spec.
    """
    if not path.is_file():
        raise FileFormatError(f"{path} is missing.")
    arrays = read_arrays(path, check=_header_check(str(path), specs, sizes))
    return _with_checked_values(arrays, str(path), specs)


def checked_arrays(
    content: bytes, place: str, specs: Mapping[str, ArraySpec], sizes: dict[str, int]
) -> dict[str, np.ndarray]:
    """The arrays in the bytes of a .npz file, checked as `read_checked_arrays` checks those of a file.

    place : where the bytes come from, for messages.
    """
    arrays = arrays_from_bytes(content, place, check=_header_check(place, specs, sizes))
    return _with_checked_values(arrays, place, specs)


def _header_check(path: str, specs: Mapping[str, ArraySpec], sizes: dict[str, int]) -> Check:
    """A check of the names, types and shapes of arrays, which adds to `sizes`."""

    def check(name: str, place: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if name not in specs:
            raise FileFormatError(f"{path}: expected the arrays {', '.join(specs)}, got {shown(name)} as well.")
        _check_header(shape, dtype, specs[name], sizes, place)

    return check


def _with_checked_values(
    arrays: dict[str, np.ndarray], path: str, specs: Mapping[str, ArraySpec]
) -> dict[str, np.ndarray]:
    for name, spec in specs.items():
        if name in arrays:
            _check_values(arrays[name], spec, f"{path}: array {name!r}")
        elif spec.required:
            raise FileFormatError(f"{path}: expected an array {name!r}, found none of that name.")
    return arrays


SETTINGS = ArraySpec("uint8", ("settings",))
"""Requirement on the array of settings in a file of arrays; see `settings_array`."""


def settings_array(data: Mapping[str, Any]) -> np.ndarray:
    """Plain data as an array of bytes (JSON), so that a file of arrays can hold settings as well."""
    return np.frombuffer(json.dumps(data).encode(), np.uint8)


def settings_of(array: np.ndarray, path: Path) -> dict[str, Any]:
    """The plain data in an array that `settings_array` made; FileFormatError if it holds no table.

    Examples
    --------
    >>> settings_of(settings_array({"steps": 4}), Path("capture.npz"))
    {'steps': 4}
    """
    try:
        settings = json.loads(array.tobytes().decode())
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: expected settings as JSON: {shown(str(error))}.") from error
    if not isinstance(settings, dict):
        raise FileFormatError(f"{path}: expected settings as a table, got {shown(settings)}.")
    return settings


MAX_TEXT = 1000
"""Largest number of characters of a name in an array of text, as for `Name`, so that one long name makes no huge array:
NumPy stores each name of an array with as many characters as the longest."""


def _check_header(
    shape: tuple[int, ...], dtype: np.dtype[Any], spec: ArraySpec, sizes: dict[str, int], place: str
) -> None:
    """Check type and shape of an array, which are known before memory is allocated, and add new letters to `sizes`."""
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
