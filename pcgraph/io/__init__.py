# SPDX-License-Identifier: Apache-2.0
"""Point clouds and segmentations in files: one function reads all formats, one writes them."""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError
from pcgraph.io.pcd import read_pcd
from pcgraph.io.ply import read_ply
from pcgraph.io.segmentation_files import write_segmentation
from pcgraph.plumbing.plain_files import read_file

__all__ = ["read_cloud", "write_segmentation"]

MAX_REASON = 300
"""Characters of a message about a damaged file, count: such files can make messages of any length. Chosen by eye; not
varied."""
_READERS = {".pcd": read_pcd, ".ply": read_ply}


def read_cloud(path: str | PathLike[str]) -> Cloud:
    """Cloud of a PCD or PLY file, in the file's own frame and unit; all other functions assume metres.

    Parameters
    ----------
    path : str or path
        ``.pcd`` (ascii, binary, binary_compressed) or ``.ply`` (ascii, binary of either byte order).

    Raises
    ------
    CloudReadError
        There is no such file, it is a directory, it has another extension, or its content is cut off or contradicts its
        header.
    """
    path = Path(path)
    if os.path.isdir(path):  # unlike Path.is_dir it takes names that no file can have
        raise CloudReadError(f"{path} is a directory: expected a file ending in {' or '.join(_READERS)}")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise CloudReadError(f"expected a file ending in {' or '.join(_READERS)}, got {path.name!r}: convert it first")
    content = read_file(path, CloudReadError)
    try:
        return reader(content)
    except CloudReadError as error:
        # Names of fields may have any characters.
        said = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(error))
        raise CloudReadError(f"{path}: {said[:MAX_REASON]}") from None
