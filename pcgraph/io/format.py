# SPDX-License-Identifier: Apache-2.0
"""The interface of file formats of point clouds: `Format` has the names, the reader and the writer of one.

A new format is one file in this folder that defines a `Format`, which `FORMATS` in `__init__.py` lists.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudWriteError

MAX_HEADER_BYTES = 1 << 16
"""Largest header, bytes: far more than headers have, so that a file without one is refused before all of it is
searched. Chosen by eye; not varied."""


@dataclass(frozen=True)
class CloudFile:
    """The content of a file, and its path.

    Attributes
    ----------
    content : bytes
    path : Path, or None
        Some formats read a second file beside this one, and some libraries open files themselves. None: the content
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
        Name in messages and in the argument `file_format`, in lower case, such as "ply".
    suffixes : tuple of str
        Suffixes of file names in lower case, with the dot, such as (".las", ".laz").
    read : CloudFile -> Cloud
        Reader. It raises CloudReadError.
    encode : (Cloud, suffix) -> bytes, or None
        Writer. `read` returns every column of its bytes, with the type and the name. It raises CloudWriteError for a
        column that the format cannot hold. The cloud is as `pcgraph.cloud.plain_cloud` returns it, and a list of finite
        points unless `organised`. `pcgraph.cloud.columns_of_cloud` names its columns. None: the format is only read.
    organised : bool
        Whether a file keeps images of points, (h, w, 3), with NaN where nothing was measured. Files of other formats
        are lists of the finite points.
    holds_columns : bool
        Whether a file holds columns of any name and number.
    takes_names : bool
        Whether the user may name the columns (`CloudFile.columns`).
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[CloudFile], Cloud]
    encode: Callable[[Cloud, str], bytes] | None = None
    organised: bool = False
    holds_columns: bool = True
    takes_names: bool = False


# ---- Names of fields in text headers -------------------------------------------------------------------------------


def field_name(word: bytes) -> str:
    """Name of a field from a word of a header, which is UTF-8, or else Latin-1."""
    try:
        return word.decode()
    except UnicodeDecodeError:
        return word.decode("latin-1")


def field_word(name: str) -> bytes:
    """Word of a header for the name of a field; blanks become underscores, as in files of CloudCompare."""
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
