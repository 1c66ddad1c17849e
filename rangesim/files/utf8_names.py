# SPDX-License-Identifier: Apache-2.0
"""Names in UTF-8 for files whose own names are not UTF-8, for libraries that accept nothing else.

On Linux a file name can be any bytes, for example Latin-1 from an older system. Python represents such bytes by lone
surrogates; Mitsuba and OpenEXR refuse them. A symbolic link in a temporary directory gives such a file another name.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rangesim.errors import FileFormatError


def is_utf8(path: str | Path) -> bool:
    """Whether a name can be encoded in UTF-8.

    Examples
    --------
    >>> is_utf8("scène.xml"), is_utf8("sc\\udce8ne.xml")  # the second is Latin-1 on the disk
    (True, False)
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


PLACES = ("/tmp", "/var/tmp")
"""Folders for temporary files that are tried if the name of the user's own (TMPDIR) is not UTF-8."""


class Utf8Names:
    """Links to directories and files whose names are not UTF-8, in a `folder` whose name is."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._names: dict[str, str] = {}

    def of(self, path: Path) -> Path:
        """A path in UTF-8 of the same file or directory: the path itself if it and its real path are UTF-8.

        The neighbours of a file are neighbours of the returned path too, unless the file's own name is not UTF-8.
        """
        real = Path(os.path.realpath(path))
        if is_utf8(real):
            return path if is_utf8(os.path.abspath(path)) else real
        if real.is_dir():
            return self._link(real)
        return self._link(real.parent) / real.name if is_utf8(real.name) else self._link(real)

    def restored(self, text: str) -> str:
        """A message in which the names of links are replaced by the names that they stand for."""
        for link, name in self._names.items():
            text = text.replace(link, name)
        return text

    def _link(self, target: Path) -> Path:
        link = self.folder / f"{hashlib.sha256(os.fsencode(target)).hexdigest()[:16]}{target.suffix}"
        if not is_utf8(link):
            link = link.with_suffix("")
        if not link.is_symlink():
            link.symlink_to(target)
        self._names[str(link)] = str(target)
        return link


@contextmanager
def utf8_names() -> Iterator[Utf8Names]:
    """Names in UTF-8 for files, valid while the block runs.

    A FileFormatError that leaves the block names the files by their own names.

    Raises
    ------
    FileFormatError
        No folder for temporary files has a name in UTF-8.
    """
    with tempfile.TemporaryDirectory(dir=_place()) as folder:
        names = Utf8Names(folder)
        try:
            yield names
        except FileFormatError as error:
            message = names.restored(str(error))
            if message == str(error):
                raise
            raise FileFormatError(message) from error


@contextmanager
def utf8_name(path: Path) -> Iterator[str]:
    """A name in UTF-8 of a file, valid while the block runs: its own name if possible. The file need not exist yet."""
    if is_utf8(path):
        yield str(path)
        return
    with utf8_names() as names:
        yield str(names.of(path))


def _place() -> str:
    """A folder for temporary files whose name is UTF-8: the user's own if possible."""
    users = tempfile.gettempdir()
    for place in (users, *PLACES):
        if is_utf8(os.path.abspath(place)) and os.access(place, os.W_OK):
            return place
    raise FileFormatError(
        f"expected a folder for temporary files whose name is UTF-8, got {users}; set TMPDIR to another."
    )
