# SPDX-License-Identifier: Apache-2.0
"""Arrays in .npz files, the format of NumPy: written completely or not at all, and read within the limits.

The size of every array is checked before anything is decompressed.
"""

from __future__ import annotations

import io
import math
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np

from pcgraph.plumbing.plain_files import check_file, sealed, unsealed, write_file
from rangesim.errors import FileFormatError
from rangesim.settings import limits
from rangesim.settings.config import brief, shown

Check = Callable[[str, str, tuple[int, ...], "np.dtype[Any]"], None]
"""A check of an array before it is read; see `read_arrays`."""
KINDS = "biufcSU"
"""Kinds of NumPy types that are read: numbers and text of fixed size, but no objects."""
MAX_ARRAYS = 1000
"""Largest number of arrays in a file. Files of this package have some tens of arrays; without a limit, the list of
contents of a hostile file could fill the memory."""
COMPRESSION_LEVEL = 1
"""Level of deflate, 1 to 9: the fastest, because the lower digits of measured arrays are noise, which hardly shrinks.
In a test, the default level 6 took twice as long and made files 2 % smaller."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Methods of compression that are read, those of `numpy.savez` and `numpy.savez_compressed`."""
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
"""Functions that read the header of a .npy file, by its version."""


def write_arrays(path: str | Path, arrays: Mapping[str, np.ndarray], seal: str | None = None) -> None:
    """Write arrays to a compressed .npz file. The same arrays always give the same bytes.

    Parameters
    ----------
    arrays : the arrays by name.
    seal : mark of the seal at the end of the file, see `pcgraph.plumbing.plain_files.sealed`; None: no seal.

    Raises
    ------
    FileFormatError
        The file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_arrays(f"{folder}/depth.npz", {"z": np.ones((2, 3), np.float32)})
    ...     read_arrays(f"{folder}/depth.npz")["z"].shape
    (2, 3)
    """
    write_file(Path(path), arrays_to_bytes(arrays, seal), FileFormatError)


def arrays_to_bytes(arrays: Mapping[str, np.ndarray], seal: str | None = None) -> bytes:
    """The bytes of the .npz file that `write_arrays` writes.

    Examples
    --------
    >>> content = arrays_to_bytes({"z": np.ones((2, 3), np.float32)})
    >>> arrays_from_bytes(content, "an example")["z"].shape
    (2, 3)
    """
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=COMPRESSION_LEVEL) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asarray(values), allow_pickle=False)
        archive.comment = unsealed(seal).encode() if seal else b""
    content = stream.getvalue()
    return sealed(content, seal, at_end=True) if seal else content


def read_arrays(
    path: str | Path, names: Iterable[str] | None = None, check: Check | None = None
) -> dict[str, np.ndarray]:
    """The arrays of a .npz file, by their names. `numpy.savez` or `numpy.savez_compressed` may have written the file.

    Nothing is unpickled. The sizes stated in the file are checked against the limit `bytes` first; an array whose size
    differs from the stated one is refused.

    Parameters
    ----------
    names : names of the arrays to read; None: all.
    check : function of name, place (for messages), shape and dtype of an array. It is called before memory is
        allocated, and raises if it does not accept the array.

    Raises
    ------
    FileFormatError
        The file is missing, broken or too large, lacks one of `names`, or holds objects.
    """
    check_file(Path(path), FileFormatError)
    return _arrays_in(Path(path), str(path), names, check)


def arrays_from_bytes(
    content: bytes, place: str, names: Iterable[str] | None = None, check: Check | None = None
) -> dict[str, np.ndarray]:
    """The arrays of the bytes of a .npz file, as `read_arrays` reads them of a file.

    place : where the bytes come from, for messages.
    """
    return _arrays_in(io.BytesIO(content), place, names, check)


def _arrays_in(
    source: Path | io.BytesIO, path: str, names: Iterable[str] | None, check: Check | None
) -> dict[str, np.ndarray]:
    """The arrays of a .npz file; `path` is its name in messages."""
    try:
        with zipfile.ZipFile(source) as archive:
            members = _members(archive, path)
            wanted = list(members) if names is None else list(names)
            missing = [name for name in wanted if name not in members]
            if missing:
                raise FileFormatError(f"{path}: expected an array {missing[0]!r}, found none of that name.")
            total = sum(members[name].file_size for name in wanted)
            limits.check("bytes", total, f"bytes in {path}, decompressed", FileFormatError)
            return {
                name: _read(
                    archive, members[name], f"{path}: array {shown(name)}", partial(check, name) if check else None
                )
                for name in wanted
            }
    except (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError, OSError) as error:
        reason = getattr(error, "strerror", None) or brief(error) or "it ends early"
        raise FileFormatError(f"{path} cannot be read as .npz: {reason}.") from error
    except (
        NotImplementedError,
        RuntimeError,
        ValueError,
        OverflowError,
    ) as error:  # odd entries of the directory
        raise FileFormatError(f"{path} cannot be read as .npz: {brief(error)}.") from error


def read_array(path: str | Path, check: Check | None = None) -> np.ndarray:
    """The array of a .npy file; as `read_arrays`, which reads .npz files, it unpickles nothing.

    Raises
    ------
    FileFormatError
        The file is missing, broken or too large, or holds objects.
    """
    path = Path(path)
    check_file(path, FileFormatError)
    try:
        limits.check("bytes", path.stat().st_size, f"bytes in {path}", FileFormatError)
        with path.open("rb") as file:
            shape, fortran_order, dtype = _header(file, str(path))
            if check is not None:
                check("", str(path), shape, dtype)
            size = math.prod(shape) * dtype.itemsize
            if size != path.stat().st_size - file.tell():
                raise FileFormatError(f"{path}: expected {size} bytes as its header says, got another number.")
            values = np.frombuffer(file.read(size), dtype=dtype)
    except (OSError, MemoryError, ValueError, OverflowError) as error:
        raise FileFormatError(f"{path} cannot be read as .npy: {brief(error)}.") from error
    return values.reshape(shape, order="F" if fortran_order else "C")


def _members(archive: zipfile.ZipFile, path: str) -> dict[str, zipfile.ZipInfo]:
    entries = archive.infolist()
    if len(entries) > MAX_ARRAYS:
        raise FileFormatError(f"{path}: expected at most {MAX_ARRAYS} arrays, got {len(entries)}.")
    members: dict[str, zipfile.ZipInfo] = {}
    for entry in entries:
        name = entry.filename.removesuffix(".npy")
        if name == entry.filename or entry.flag_bits & 1 or entry.compress_type not in _METHODS or name in members:
            raise FileFormatError(
                f"{path}: expected arrays (.npy) as numpy.savez writes them, got {shown(entry.filename)}."
            )
        members[name] = entry
    return members


def _read(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo, place: str, check: Callable[..., None] | None
) -> np.ndarray:
    with archive.open(entry) as file:
        shape, fortran_order, dtype = _header(file, place)
        if check is not None:
            check(place, shape, dtype)
        size = math.prod(shape) * dtype.itemsize
        if size != entry.file_size - file.tell():
            raise FileFormatError(f"{place}: expected {size} bytes as its header says, got another number.")
        try:
            array: np.ndarray = np.empty(math.prod(shape), dtype=dtype)
        except MemoryError as error:
            raise FileFormatError(f"{place} takes {size / 1e9:.1f} GB, more than this machine has free.") from error
        view, filled = array.view(np.uint8).data, 0
        while filled < size:
            count = file.readinto(view[filled:])  # type: ignore[attr-defined]
            if not count:
                raise FileFormatError(f"{place} ends early.")
            filled += count
        file.read(1)  # at the end of the entry its checksum is verified
    return array.reshape(shape, order="F" if fortran_order else "C")


def _header(file: IO[bytes], place: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    try:
        version = np.lib.format.read_magic(file)
        if version not in _HEADERS:
            raise ValueError(f"version {version} is unknown")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy warns of headers that Python 2 wrote
            shape, fortran_order, dtype = _HEADERS[version](file)
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError, MemoryError, EOFError) as error:
        raise FileFormatError(f"{place}: its header is broken: {brief(error)}.") from error
    if dtype.kind not in KINDS or dtype.itemsize == 0 or len(shape) > 8 or any(n < 0 for n in shape):
        raise FileFormatError(f"{place}: expected numbers or text, got {shown(dtype)} of shape {shown(shape)}.")
    return shape, fortran_order, dtype
