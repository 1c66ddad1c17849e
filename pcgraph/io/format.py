# SPDX-License-Identifier: Apache-2.0
"""What a file format of point clouds is: its names, its reader and its writer.

A new format is one file in this folder with a `Format`, and its name in the list `FORMATS` of the folder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudWriteError

MAX_HEADER_BYTES = 1 << 16
"""Bytes in which the header of a file must end: far more than headers have, so that a file without one is refused
before all of it is searched. Chosen by eye; not varied."""


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
        where the format cannot hold one. The cloud is as `pcgraph.cloud.plain_cloud` returns it, and a list of finite
        points unless `organised`; `pcgraph.cloud.columns_of_cloud` names its columns. None: the format is only read.
    organised : bool
        Whether a file keeps images of points, (h, w, 3), and NaN where nothing was measured. Other formats are lists of
        the finite points.
    holds_columns : bool
        Whether a file takes columns of any name and number.
    takes_names : bool
        Whether `CloudFile.columns` may name the columns.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[CloudFile], Cloud]
    encode: Callable[[Cloud, str], bytes] | None = None
    organised: bool = False
    holds_columns: bool = True
    takes_names: bool = False


# ---- Names of fields in headers of words ---------------------------------------------------------------------------


def field_name(word: bytes) -> str:
    """Name of a field from the word of a header: UTF-8, or Latin-1 if it is none."""
    try:
        return word.decode()
    except UnicodeDecodeError:
        return word.decode("latin-1")


def field_word(name: str) -> bytes:
    """Word of a header for the name of a field; its blanks become underscores, as CloudCompare writes them."""
    return "_".join(name.split()).encode(errors="backslashreplace")


def check_words(names: Sequence[str]) -> None:
    """Raise CloudWriteError unless the words of these fields are distinct."""
    words = [field_word(name) for name in names]
    if len(set(words)) < len(words):
        twice = next(word for word in words if words.count(word) > 1)
        raise CloudWriteError(
            f"expected columns of distinct names, but several are called {twice.decode()!r} once their blanks are "
            "underscores; rename one"
        )
