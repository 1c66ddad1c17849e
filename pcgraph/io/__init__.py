# SPDX-License-Identifier: Apache-2.0
"""Point clouds in files: `read_cloud` reads all formats, and `write_cloud` writes most of them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from pcgraph.cloud import Cloud, plain_cloud
from pcgraph.errors import CloudReadError, CloudWriteError, PcgraphError
from pcgraph.io.driving_sweeps import KITTI, NUSCENES, SWEEP
from pcgraph.io.e57 import E57
from pcgraph.io.format import CloudFile, Format
from pcgraph.io.las import COPC, LAS
from pcgraph.io.mesh import GLTF, OBJ, OFF, STL, sample_surface
from pcgraph.io.npz import NPY, NPZ
from pcgraph.io.ouster import OUSTER
from pcgraph.io.pcd import PCD
from pcgraph.io.ply import PLY
from pcgraph.io.ptx import PTX
from pcgraph.io.text import PTS, TEXT, XYZN, XYZRGB
from pcgraph.plumbing.plain_files import read_file, write_file

__all__ = ["decode_cloud", "encode_cloud", "read_cloud", "sample_surface", "write_cloud"]

MAX_REASON = 300
"""Largest count of characters in a message about a damaged file, because it may quote text of any length from the file.
Chosen by eye; not varied."""
FORMATS: tuple[Format, ...] = (
    *(PCD, PLY, LAS, COPC, E57, NPZ, NPY),
    *(TEXT, PTS, PTX, XYZN, XYZRGB),
    *(KITTI, NUSCENES, SWEEP, OUSTER),
    *(OBJ, STL, OFF, GLTF),
)
_WRITABLE = tuple(one for one in FORMATS if one.encode is not None)


def read_cloud(
    path: str | PathLike[str], file_format: str | None = None, columns: Sequence[str] | None = None
) -> Cloud:
    """Cloud of a file, in the file's own frame and unit; all other functions assume metres.

    Parameters
    ----------
    path : str or path
        A file in any format of docs/files.md: LAS, LAZ, COPC, E57, PLY, PCD, text (``.xyz``, ``.csv``, ``.pts``,
        ``.ptx`` and others), ``.npz``, ``.npy``, sweeps of KITTI, nuScenes and Ouster, the vertices of meshes
        (``.obj``, ``.stl``, ``.off``, ``.glb``).
    file_format : str, optional
        Name of the format, such as "ply". Default: the suffix of the file's name tells the format.
    columns : sequence of str, optional
        Names of the columns of a text file without a header, such as ["x", "y", "z", "intensity"].

    Raises
    ------
    CloudReadError
        There is no such file, it is a directory, its suffix is unknown, or its content is cut off or contradicts its
        header.
    """
    path = Path(path)
    if os.path.isdir(path):  # unlike Path.is_dir it takes names that no file can have
        raise CloudReadError(f"{path} is a directory: expected a file ending in {_either(_suffixes(FORMATS))}")
    chosen, _ = _format(path.name, file_format, FORMATS, CloudReadError)
    return _read(chosen, CloudFile(read_file(path, CloudReadError), path, _named(columns, chosen)), str(path))


def decode_cloud(content: bytes, name: str, columns: Sequence[str] | None = None) -> Cloud:
    """Cloud from the bytes of a file, for uploads and pipes; the file's name tells the format.

    Parameters
    ----------
    content : bytes
    name : str
        Name of the file, such as "scan.ply". No file of that name has to exist.
    columns : as for `read_cloud`

    Raises
    ------
    CloudReadError
        As for `read_cloud`.

    Examples
    --------
    >>> import numpy as np
    >>> content = encode_cloud(Cloud(np.ones((2, 3))), "two.pcd")
    >>> decode_cloud(content, "two.pcd").points.tolist()
    [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    chosen, _ = _format(Path(name).name, None, FORMATS, CloudReadError)
    return _read(chosen, CloudFile(content, None, _named(columns, chosen)), name)


def write_cloud(path: str | PathLike[str], cloud: Cloud, file_format: str | None = None) -> None:
    """Write a cloud to a file, and replace an existing one; after an error the file is as it was before.

    `read_cloud` returns the same points, colours, normals, labels and columns, with their types and names.
    docs/files.md lists what a format cannot hold. PCD, NPZ and NPY keep every point; all other formats keep the finite
    points only.

    Parameters
    ----------
    path : str or path
    cloud : Cloud
        `pcgraph.as_cloud` makes one of arrays and of the clouds of other libraries.
    file_format : str, optional
        Name of the format, such as "ply". Default: the suffix of the file's name tells the format.

    Raises
    ------
    CloudWriteError
        The suffix is unknown, the file cannot be written, or the format cannot hold a column.
    ValueError
        `cloud` is not a `Cloud`.

    Examples
    --------
    >>> import numpy as np, tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "two.ply"
    >>> write_cloud(path, Cloud(np.ones((2, 3)), columns={"ring": np.array([0, 1], np.uint16)}))
    >>> read_cloud(path).columns
    {'ring': array([0, 1], dtype=uint16)}
    """
    path = Path(path)
    write_file(path, _encode(cloud, path.name, file_format), CloudWriteError)


def encode_cloud(cloud: Cloud, name: str) -> bytes:
    """Bytes that `write_cloud` writes to a file of this name; the name tells the format."""
    return _encode(cloud, Path(name).name, None)


def check_writable(name: str) -> None:
    """Raise CloudWriteError unless `write_cloud` can write a file of this name."""
    _format(name, None, _WRITABLE, CloudWriteError)


def holds_columns(suffix: str) -> bool:
    """Whether `write_cloud` can write files with this suffix, and these hold columns of any name."""
    return any(suffix.lower() in one.suffixes and one.holds_columns for one in _WRITABLE)


def without_suffix(name: str) -> str:
    """Name of a file without the suffix of its format, such as ``.copc.laz``; without its last suffix if none fits."""
    end = max((suffix for suffix in _suffixes(FORMATS) if name.lower().endswith(suffix)), key=len, default="")
    return name[: -len(end)] if end else Path(name).stem


def _read(chosen: Format, file: CloudFile, name: str) -> Cloud:
    try:
        return chosen.read(file)
    except CloudReadError as error:
        # Names of fields may have any characters.
        said = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(error))
        raise CloudReadError(f"{name}: {said[:MAX_REASON]}") from None
    except MemoryError:
        raise CloudReadError(f"{name}: the points do not fit into memory") from None


def _encode(cloud: Cloud, name: str, file_format: str | None) -> bytes:
    if not isinstance(cloud, Cloud):
        raise ValueError(f"expected a Cloud, as pcgraph.as_cloud makes it, got {type(cloud).__name__}")
    chosen, suffix = _format(name, file_format, _WRITABLE, CloudWriteError)
    cloud = plain_cloud(cloud)
    return chosen.encode(cloud if chosen.organised else cloud.finite(), suffix)  # type: ignore[misc]


def _format(
    name: str, file_format: str | None, formats: tuple[Format, ...], error: type[PcgraphError]
) -> tuple[Format, str]:
    """Format called `file_format`, else the format of the longest suffix that the file's name has; and that suffix."""
    ends = {suffix: one for one in FORMATS for suffix in one.suffixes if name.lower().endswith(suffix)}
    if file_format is not None:
        named = [one for one in formats if one.name == file_format]
        if not named:
            known = ", ".join(one.name for one in formats)
            raise error(f"expected file_format as one of {known}, got {ascii(file_format)[:80]}")
        own = [suffix for suffix, one in ends.items() if one is named[0]]
        return named[0], max(own or named[0].suffixes[:1], key=len, default="")
    suffix = max(ends, key=len, default="")
    if not ends or ends[suffix] not in formats:
        hint = "convert it first" if error is CloudReadError else "choose another name"
        hint = f"files ending in {suffix} are only read" if ends else hint
        raise error(f"expected a file ending in {_either(_suffixes(formats))}, got {name!r}: {hint}")
    return ends[suffix], suffix


def _named(columns: Sequence[str] | None, chosen: Format) -> tuple[str, ...] | None:
    if columns is not None and not chosen.takes_names:
        raise CloudReadError(
            f"expected the argument columns for text files only: leave it out, as {chosen.name} files name their own"
        )
    return None if columns is None else tuple(columns)


def _suffixes(formats: tuple[Format, ...]) -> list[str]:
    return [suffix for one in formats for suffix in one.suffixes]


def _either(ends: list[str]) -> str:
    return f"{', '.join(ends[:-1])} or {ends[-1]}"
