# SPDX-License-Identifier: Apache-2.0
"""Arrays in .npz files, as NumPy's: written whole or not at all, and read within the limits.

Sizes are known, and checked, before anything is decompressed.
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
KINDS = "biufcSU"
"""Kinds of NumPy types that are read: numbers and text of fixed size, no objects."""
MAX_ARRAYS = 1000
COMPRESSION_LEVEL = 1
"""Measured arrays are noise in their lower digits: more effort takes twice as long and saves 2 %."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def write_arrays(path: str | Path, arrays: Mapping[str, np.ndarray], seal: str | None = None) -> None:
    """Write arrays to a compressed .npz file; the same arrays give the same bytes.

    `seal` : its mark, see `pcgraph.plumbing.plain_files.sealed`; None: no seal.

    Raises
    ------
    FileFormatError
        The place cannot be written.
    """
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=COMPRESSION_LEVEL) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asarray(values), allow_pickle=False)
        archive.comment = unsealed(seal).encode() if seal else b""
    content = stream.getvalue()
    write_file(Path(path), sealed(content, seal, at_end=True) if seal else content, FileFormatError)


def read_arrays(
    path: str | Path, names: Iterable[str] | None = None, check: Check | None = None
) -> dict[str, np.ndarray]:
    """Arrays of a .npz file by name, as `numpy.savez` and `numpy.savez_compressed` write it.

    Nothing is unpickled. Their sizes, as the file states them, are checked against the limit `bytes` first, and hold:
    a member that is longer or shorter than it states is refused.

    Parameters
    ----------
    names : those to read; None: all.
    check : called with the place (for messages), name, shape and dtype of each, before memory is allocated for it.

    Raises
    ------
    FileFormatError
        The file is missing, broken, too large, lacks one of `names`, or holds objects.
    """
    path = Path(path)
    check_file(path, FileFormatError)
    try:
        with zipfile.ZipFile(path) as archive:
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
    except (NotImplementedError, RuntimeError, ValueError, OverflowError) as error:  # of odd entries in the directory
        raise FileFormatError(f"{path} cannot be read as .npz: {brief(error)}.") from error


def _members(archive: zipfile.ZipFile, path: Path) -> dict[str, zipfile.ZipInfo]:
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
            raise FileFormatError(f"{place} takes {size / 1e9:.1f} GB, which this machine has not free.") from error
        view, filled = array.view(np.uint8).data, 0
        while filled < size:
            count = file.readinto(view[filled:])  # type: ignore[attr-defined]
            if not count:
                raise FileFormatError(f"{place} ends early.")
            filled += count
        file.read(1)  # the end, where the checksum is compared
    return array.reshape(shape, order="F" if fortran_order else "C")


def _header(file: IO[bytes], place: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    try:
        version = np.lib.format.read_magic(file)
        if version not in _HEADERS:
            raise ValueError(f"version {version} is unknown")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers as Python 2 wrote them
            shape, fortran_order, dtype = _HEADERS[version](file)
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError, MemoryError, EOFError) as error:
        raise FileFormatError(f"{place}: its header is broken: {brief(error)}.") from error
    if dtype.kind not in KINDS or dtype.itemsize == 0 or len(shape) > 8 or any(n < 0 for n in shape):
        raise FileFormatError(f"{place}: expected numbers or text, got {shown(dtype)} of shape {shown(shape)}.")
    return shape, fortran_order, dtype
