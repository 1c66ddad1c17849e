# SPDX-License-Identifier: Apache-2.0
"""What a file format of point clouds is: its names, its reader and its writer.

A new format is one file in this folder with a `Format`, and its name in the list `FORMATS` of the folder.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pcgraph.cloud import Cloud


@dataclass(frozen=True)
class CloudFile:
    """The content of a file, and the place where it lies.

    Attributes
    ----------
    content : bytes
    path : Path, or None
        For formats that read a second file beside it, and for libraries that open files themselves; None if the content
        came from a pipe or over a network.
    columns : tuple of str, or None
        Names that the user gave to the columns of a text file without a header.
    """

    content: bytes
    path: Path | None = None
    columns: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Format:
    """A file format of point clouds.

    Attributes
    ----------
    name : str
        Name in messages and of the argument `file_format`, in lower case: "ply".
    suffixes : tuple of str
        Ends of file names in lower case, with the dot: (".las", ".laz").
    read : CloudFile -> Cloud
        Raises CloudReadError.
    encode : (Cloud, suffix) -> bytes, or None
        Bytes of a file that `read` reads back: every column, in its type and under its name. Raises CloudWriteError
        where the format cannot hold one. None: the format is only read.
    organised : bool
        Whether a file keeps images of points, (h, w, 3), and NaN where nothing was measured. Other formats are lists of
        the finite points.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[CloudFile], Cloud]
    encode: Callable[[Cloud, str], bytes] | None = None
    organised: bool = False
