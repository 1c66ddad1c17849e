# SPDX-License-Identifier: Apache-2.0
"""Archive of nested dataclasses in one .npz file without pickle: arrays by path, and all other values as JSON.

A structure is a dataclass, a NamedTuple or a msgspec.Struct. The path of a value has the names of the fields that lead
to it, as in ``graph/edge_features/convexity``. `flatten` turns a structure into arrays and plain values by path, and
`rebuild` turns these into an equal structure. The declared types of the fields limit what a file may hold. A file names
no module, and no code in it is run.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from functools import cached_property
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pcgraph.plumbing.plain_files import sealed, unsealed

HEADER = "header"
"""Name of the array that holds the JSON as UTF-8."""
OWN = "own:"
"""Mark before the name of a user's class, so that it never passes for one of this package's."""
_MAX_JSON = 1 << 20
"""Largest JSON, bytes: a segmentation has some 3000. Chosen by eye; not varied."""
_NUMBERS = "fiub"
"""NumPy's kinds of the arrays that can be stored: floats, signed and unsigned integers, and bools."""

Values = dict[str, Any]
"""Plain values by path: numbers, strings, bools, None, lists of these, and the name of each structure's class."""


class DamagedError(ValueError):
    """The file is not an archive, or does not hold the expected structure; the message does not name the file."""


class UnknownClassError(DamagedError):
    """The file names a class that is not loaded, or whose object cannot be built from the stored values.

    Attributes
    ----------
    path, name : str
        Path of the structure, and name of its class.
    """

    def __init__(self, path: str, name: str) -> None:
        super().__init__(f"the class {name!r} of {path!r} is not loaded")
        self.path, self.name = path, name


@dataclass
class Archive:
    """One or more structures as arrays and plain values by path.

    Examples
    --------
    >>> @dataclass(frozen=True)
    ... class Plane:
    ...     normal: NDArray[np.float64]
    ...     offset: float | None
    >>> flat = Archive()
    >>> flat.flatten(Plane(np.array([0.0, 0.0, 1.0]), None), "floor")
    >>> flat.arrays, flat.values
    ({'floor/normal': array([0., 0., 1.])}, {'floor': 'Plane', 'floor/offset': None})
    """

    arrays: dict[str, NDArray[Any]] = field(default_factory=dict)
    values: Values = field(default_factory=dict)

    def flatten(self, value: Any, path: str) -> None:
        """Add a value, and all values within it, below a path.

        Raises
        ------
        TypeError
            A value is of a type that an archive cannot hold. Nothing is added then.
        """
        parts = Archive()
        parts._add(value, path)
        self.arrays |= parts.arrays
        self.values |= parts.values

    def _add(self, value: Any, path: str) -> None:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, np.ndarray):
            if value.dtype.kind not in _NUMBERS:
                raise TypeError(f"expected {path} as an array of numbers, got {value.dtype}")
            self.arrays[path] = value
        elif isinstance(value, Enum):
            self.values[path] = value.name
        elif value is None or isinstance(value, (bool, int, str)):
            self.values[path] = value
        elif isinstance(value, float):
            self.values[path] = value if math.isfinite(value) else str(value)  # JSON has no infinity
        elif isinstance(value, Mapping):
            for name, one in value.items():
                self._add(one, f"{path}/{name}")
        elif _has_fields_alone(value):
            self.values[path] = class_name(type(value))
            for name in field_names(type(value)):
                self._add(getattr(value, name), f"{path}/{name}")
        elif isinstance(value, (tuple, list)):
            if not all(isinstance(one, (bool, int, str)) or _is_finite(one) for one in value):
                raise TypeError(f"expected {path} as a list of plain values, got {value!r:.80}")
            self.values[path] = list(value)
        else:
            raise TypeError(f"expected {path} as an array, a plain value or a dataclass, got {type(value).__name__}")


def _is_finite(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def _has_fields_alone(value: object) -> bool:
    """Whether the fields of an object are all it holds, except for cached properties."""
    kind, held = type(value), getattr(value, "__dict__", None)
    if held is None:
        return is_structure(kind)
    known = {one.name for one in fields(kind)} if is_dataclass(kind) else set(field_names(kind))
    return all(name in known or isinstance(getattr(kind, name, None), cached_property) for name in held)


# --- from arrays and plain values to a structure ----------------------------------------------------------------------


def rebuild(archive: Archive, kind: Any, path: str, names: Mapping[str, Any]) -> Any:
    """The value at a path of an archive, of the type that a field declares.

    Parameters
    ----------
    archive : Archive
    kind : type
        A structure, an array with its dtype, an Enum, a plain type, a tuple of plain types, or one of these or None.
        The archive may name a loaded subclass of a structure.
    path : str
    names : mapping of str to type
        Types that modules import only for type checkers.

    Raises
    ------
    UnknownClassError
        The archive names a user's class that is not loaded, or that does not accept the stored values.
    DamagedError
        A stored value is missing, has another type, or is refused by the class.
    """
    if get_origin(kind) in (Union, UnionType):
        options = [one for one in get_args(kind) if one is not NoneType]
        if NoneType in get_args(kind) and archive.values.get(path, "") is None:
            return None
        if len(options) > 1:
            raise TypeError(f"expected one type or None for {path}, got {kind}")
        return rebuild(archive, options[0], path, names)
    if np.ndarray in (kind, get_origin(kind)):
        return _array(archive, kind, path)
    if isinstance(kind, type) and issubclass(kind, Enum):
        stored = _value(archive, path, str)
        if stored not in kind.__members__:
            raise DamagedError(f"{path} is not one of {', '.join(kind.__members__)}")
        return kind[stored]
    if isinstance(kind, type) and kind in (bool, int, float, str):
        return _value(archive, path, kind)
    if get_origin(kind) is tuple:
        return _tuple(archive, kind, path)
    return _structure(archive, kind, path, names)


def _structure(archive: Archive, kind: Any, path: str, names: Mapping[str, Any]) -> Any:
    if not isinstance(kind, type) or kind is object:
        raise TypeError(f"expected the type of {path} as a class, got {kind}")
    name = _value(archive, path, str)
    found = [one for one in _and_subclasses(kind) if class_name(one) == name]
    is_own = name.startswith(OWN)
    homes = {(one.__module__, one.__qualname__) for one in found}
    if len(homes) != 1:  # none, or several of one name
        raise UnknownClassError(path, name) if is_own else DamagedError(f"{path} is no {kind.__name__}")
    chosen = found[-1]  # a file that ran twice defined it twice
    try:
        hints = get_type_hints(chosen, localns=dict(names))
        of_fields = {one: rebuild(archive, hints[one], f"{path}/{one}", names) for one in field_names(chosen)}
        return chosen(**of_fields)
    except DamagedError as error:
        raise UnknownClassError(path, name) if is_own else error from None
    except Exception as error:  # a user's class may raise anything
        if is_own:
            raise UnknownClassError(path, name) from error
        if isinstance(error, (ValueError, TypeError)):
            raise DamagedError(f"{path}: {error}") from None
        raise


def _array(archive: Archive, kind: Any, path: str) -> NDArray[Any]:
    array = archive.arrays.get(path)
    if array is None:
        raise DamagedError(f"the array {path} is missing")
    wanted = get_args(get_args(kind)[1])[0] if get_args(kind) else Any
    if wanted is not Any and not np.issubdtype(array.dtype, wanted):
        raise DamagedError(f"expected the array {path} as {wanted.__name__}, got {array.dtype}")
    return array


def _value(archive: Archive, path: str, kind: type[Any]) -> Any:
    stored = archive.values.get(path)
    if kind is float and stored in ("inf", "-inf", "nan"):
        return float(stored)
    is_number = kind is float and type(stored) is int and abs(stored) < 1 << 63  # more is no float to a kernel
    if not (type(stored) is kind or is_number):
        raise DamagedError(f"expected {path} as {kind.__name__}, got {stored!r:.80}")
    return stored


def _tuple(archive: Archive, kind: Any, path: str) -> tuple[Any, ...]:
    stored, kinds = archive.values.get(path), get_args(kind)
    if not isinstance(stored, list):
        raise DamagedError(f"expected {path} as a list, got {stored!r:.80}")
    kinds = kinds[:1] * len(stored) if kinds[1:] == (...,) else kinds
    if len(kinds) != len(stored) or not all(type(a) is k for a, k in zip(stored, kinds, strict=True)):
        raise DamagedError(f"expected {path} as {kind}, got {stored!r:.80}")
    return tuple(stored)


def is_structure(kind: type[Any]) -> bool:
    """Whether a class is a dataclass, a NamedTuple or a msgspec.Struct."""
    return is_dataclass(kind) or hasattr(kind, "_fields") or issubclass(kind, msgspec.Struct)


def field_names(kind: type[Any]) -> tuple[str, ...]:
    """Names of the fields that the constructor of a structure takes; empty for other classes."""
    if is_dataclass(kind):
        return tuple(one.name for one in fields(kind) if one.init)
    return getattr(kind, "_fields", getattr(kind, "__struct_fields__", ()))


def class_name(kind: type[Any]) -> str:
    """Name of a class in an archive, with the prefix `OWN` if it is a user's class."""
    package = f"{__name__.partition('.')[0]}."
    is_ours = kind.__module__.startswith(package) and not kind.__module__.startswith(f"{package}user_modules.")
    return kind.__name__ if is_ours else OWN + kind.__name__


def _and_subclasses(kind: type[Any]) -> Iterator[type[Any]]:
    yield kind
    for one in kind.__subclasses__():
        yield from _and_subclasses(one)


# --- the file ---------------------------------------------------------------------------------------------------------


def encode_archive(archive: Archive, header: Mapping[str, Any], mark: str) -> bytes:
    """Bytes of an .npz file with the arrays by path; the array `HEADER` has the header and the values as JSON.

    The comment of the file is a seal (`pcgraph.plumbing.plain_files`). Equal archives have equal bytes.
    """
    text = json.dumps({**header, "values": archive.values}, allow_nan=False, indent=1)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as file:
        file.comment = unsealed(mark).encode()
        for path, array in {HEADER: np.frombuffer(text.encode(), np.uint8), **archive.arrays}.items():
            with file.open(f"{path}.npy", "w", force_zip64=True) as member:
                npy.write_array(member, array, allow_pickle=False)  # type: ignore[no-untyped-call]
    return sealed(stream.getvalue(), mark, at_end=True)


def decode_archive(content: bytes, skipped: str) -> tuple[dict[str, Any], Archive]:
    """The header and the archive that `encode_archive` wrote; arrays whose paths begin with `skipped` are not read.

    Raises
    ------
    DamagedError
        The content is not such a file, or is damaged.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            members = [one for one in file.infolist() if not one.filename.startswith(skipped)]
            # They are not compressed, so no small file becomes a large one in memory.
            is_plain = all(one.compress_type == zipfile.ZIP_STORED for one in members)
            if not is_plain or sum(one.file_size for one in members) > len(content):
                raise DamagedError("its arrays are compressed, or overlap")
            arrays = {one.filename.removesuffix(".npy"): _member(file, one) for one in members}
        if len(arrays) != len(members):
            raise DamagedError("an array is there twice")
        header = json.loads(bytes(_header(arrays)), parse_constant=_refuse)
        values = header.pop("values")
        if not isinstance(values, dict):
            raise DamagedError("its header is not as expected")
    except DamagedError:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, KeyError, AttributeError, TypeError, OverflowError, EOFError,
            NotImplementedError, RuntimeError, RecursionError, OSError) as error:  # fmt: skip
        raise DamagedError(f"it is no archive of arrays, or is cut off: {ascii(str(error))[1:-1][:120]}") from None
    return header, Archive(arrays, values)


def _header(arrays: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
    text = arrays.pop(HEADER)
    if text.dtype != np.uint8 or text.size > _MAX_JSON:
        raise DamagedError("its header is not as expected")
    return text


def _refuse(constant: str) -> None:
    raise DamagedError(f"its header is no JSON: {constant}")


def _member(file: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """One array of an .npz file; memory is allocated only for the bytes that the member really has."""
    with file.open(member) as stream:
        version = npy.read_magic(stream)  # type: ignore[no-untyped-call]
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, is_fortran, dtype = read_header(stream)  # type: ignore[no-untyped-call]
        data = bytearray(stream.read())
    if dtype.kind not in _NUMBERS or not dtype.isnative or math.prod(shape) * dtype.itemsize != len(data):
        raise DamagedError(f"the array {member.filename} is cut off, or holds no numbers")
    if dtype.kind == "b" and any(one > 1 for one in set(data)):
        raise DamagedError(f"the array {member.filename} holds no truth values")
    array: NDArray[Any] = np.frombuffer(data, dtype).reshape(shape, order="F" if is_fortran else "C")
    return array
