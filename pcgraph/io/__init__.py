# SPDX-License-Identifier: Apache-2.0
"""Point clouds and segmentations in files: one function reads all formats, one writes them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError
from pcgraph.io.e57 import E57
from pcgraph.io.format import CloudFile, Format
from pcgraph.io.las import LAS
from pcgraph.io.mesh import GLTF, OBJ, OFF, STL, sample_surface
from pcgraph.io.pcd import PCD
from pcgraph.io.ply import PLY
from pcgraph.io.segmentation_files import write_segmentation
from pcgraph.plumbing.plain_files import read_file

__all__ = ["read_cloud", "sample_surface", "write_segmentation"]

MAX_REASON = 300
"""Characters of a message about a damaged file, count: such files can make messages of any length. Chosen by eye; not
varied."""
FORMATS: tuple[Format, ...] = (PCD, PLY, LAS, E57, OBJ, STL, OFF, GLTF)


def read_cloud(
    path: str | PathLike[str], file_format: str | None = None, columns: Sequence[str] | None = None
) -> Cloud:
    """Cloud of a file, in the file's own frame and unit; all other functions assume metres.

    Parameters
    ----------
    path : str or path
        ``.pcd`` (ascii, binary, binary_compressed) or ``.ply`` (ascii, binary of either byte order).
    file_format : str, optional
        Name of the format, such as "ply". Default: by the end of the file's name.
    columns : names, optional
        Names of the columns of a text file without a header, such as ["x", "y", "z", "intensity"].

    Raises
    ------
    CloudReadError
        There is no such file, it is a directory, it has another extension, or its content is cut off or contradicts its
        header.
    """
    path = Path(path)
    if os.path.isdir(path):  # unlike Path.is_dir it takes names that no file can have
        raise CloudReadError(f"{path} is a directory: expected a file ending in {_suffixes()}")
    chosen = _format(path.name, file_format)
    named = None if columns is None else tuple(columns)
    return _read(chosen, CloudFile(read_file(path, CloudReadError), path, named), str(path))


def _read(chosen: Format, file: CloudFile, name: str) -> Cloud:
    try:
        return chosen.read(file)
    except CloudReadError as error:
        # Names of fields may have any characters.
        said = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(error))
        raise CloudReadError(f"{name}: {said[:MAX_REASON]}") from None


def _format(name: str, file_format: str | None) -> Format:
    """The format of a name, or the one whose end the file's name has; of several ends the longest counts."""
    if file_format is not None:
        named = [one for one in FORMATS if one.name == file_format]
        if not named:
            known = ", ".join(one.name for one in FORMATS)
            raise CloudReadError(f"expected file_format as one of {known}, got {ascii(file_format)[:80]}")
        return named[0]
    ends = {suffix: one for one in FORMATS for suffix in one.suffixes if name.lower().endswith(suffix)}
    if not ends:
        raise CloudReadError(f"expected a file ending in {_suffixes()}, got {name!r}: convert it first")
    return ends[max(ends, key=len)]


def _suffixes() -> str:
    ends = [suffix for one in FORMATS for suffix in one.suffixes]
    return f"{', '.join(ends[:-1])} or {ends[-1]}"
