# SPDX-License-Identifier: Apache-2.0
"""Names in UTF-8 for files whose own are none, for libraries in C++, which take no others.

Linux lets a name be any bytes, such as those that older systems wrote in Latin-1. Python keeps such bytes in half
surrogate pairs; Mitsuba and OpenEXR refuse them. A link in a temporary directory gives the file another name.
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
    """Whether a name can be written in UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


PLACES = ("/tmp", "/var/tmp")
"""Folders for temporary files besides that of the user, whose name may be no UTF-8 either."""


class Utf8Names:
    """Links to directories and files whose names are no UTF-8, in a `folder` whose own is."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._names: dict[str, str] = {}

    def of(self, path: Path) -> Path:
        """The path itself if it is UTF-8, as is what it leads to; else another of the same file, or directory.

        What is beside a file is beside the new path too, unless the file's own name is no UTF-8.
        """
        real = Path(os.path.realpath(path))
        if is_utf8(real):
            return path if is_utf8(os.path.abspath(path)) else real
        if real.is_dir():
            return self._link(real)
        return self._link(real.parent) / real.name if is_utf8(real.name) else self._link(real)

    def restored(self, text: str) -> str:
        """A message that may name links, with the names that they stand for."""
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
    """Names in UTF-8 while the block runs; a FileFormatError that leaves it says the files' own.

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
    """A name of a file, which need not exist yet, that is UTF-8 while the block runs: its own if that is."""
    if is_utf8(path):
        yield str(path)
        return
    with utf8_names() as names:
        yield str(names.of(path))


def _place() -> str:
    """A folder for temporary files: the user's, if its name is UTF-8."""
    users = tempfile.gettempdir()
    for place in (users, *PLACES):
        if is_utf8(os.path.abspath(place)) and os.access(place, os.W_OK):
            return place
    raise FileFormatError(
        f"expected a folder for temporary files whose name is UTF-8, got {users}; set TMPDIR to another."
    )
