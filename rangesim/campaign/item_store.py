# SPDX-License-Identifier: Apache-2.0
"""The directory of a campaign: the results of its items, each written whole or not at all, and its quarantine.

DIR/campaign.json            what the campaign is: settings, versions, function
DIR/items/5d0/KEY.item       result of an item: a mark, SHA-256 of key and content, and the content
DIR/quarantine/KEY.json      an item that failed: its argument, the error and the traceback
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pcgraph.plumbing.plain_files import read_file, replace_file, why
from rangesim.errors import EnvironmentProblem, FileFormatError
from rangesim.settings.config import to_dict

try:
    import fcntl
except ImportError:  # Windows has no flock: there, two campaigns in one directory are not kept apart
    fcntl = None  # type: ignore[assignment]

MARK = b"rangesim item 1\n"
"""The first bytes of an item's file; the number is the version of the format."""
KEY = re.compile(r"[a-z0-9][a-z0-9._=+-]{0,199}")
"""What a key may be. It is the name of a file, on every file system: so no upper case, which some take for lower case,
and at most 200 characters, because a name has at most 255 bytes, some of which temporary files need."""
FOLDER_DIGITS = 3
"""Hexadecimal digits of the names of the folders below `items`: 4096 folders, so that 10^6 items are 250 files in each.
Every write lists one folder."""


@dataclass(frozen=True)
class QuarantinedItem:
    """An item that failed, as it stands in the store.

    key : its key. error : one line. argument : plain data of its argument, or its `repr`. traceback : of the exception
    in the worker; empty if the worker died. attempts : how often it ran.
    """

    key: str
    error: str
    argument: Any
    traceback: str = ""
    attempts: int = 1


class ItemStore:
    """The results of a campaign's items in a directory of their own.

    Parameters
    ----------
    directory : folder of the campaign, which is made when the first item is written.
    settings : plain data that says what the campaign computes. It is written to `campaign.json` by the first run; a
        later run with other settings in the same directory is refused.

    Examples
    --------
    >>> import tempfile
    >>> store = ItemStore(tempfile.mkdtemp())
    >>> store.write("distance=0.5", b"result")
    >>> "distance=0.5" in store, store.read("distance=0.5")
    (True, b'result')
    """

    def __init__(self, directory: str | Path, settings: Mapping[str, Any] | None = None) -> None:
        self.directory = Path(directory)
        self.settings = {} if settings is None else to_dict(settings)

    def __repr__(self) -> str:
        return f"ItemStore({str(self.directory)!r})"

    def __contains__(self, key: str) -> bool:
        """Whether the store holds the result of an item. Its content is checked when it is read."""
        return os.path.lexists(self._file(key))

    def read(self, key: str) -> bytes:
        """Return the result of an item.

        Raises
        ------
        KeyError
            The store does not hold the item.
        FileFormatError
            The file was changed after it had been written.
        """
        path = self._file(key)
        if not os.path.lexists(path):
            raise KeyError(key)
        content = read_file(path, FileFormatError)
        start = len(MARK) + 32
        if content[:start] != MARK + _digest(key, content[start:]):
            raise FileFormatError(f"{path} is broken: its checksum does not fit; delete it and run the campaign again.")
        return content[start:]

    def write(self, key: str, content: bytes) -> None:
        """Write the result of an item, whole or not at all; EnvironmentProblem if the disk does not take it."""
        self._write(self._file(key), MARK + _digest(key, content) + content)

    def discard(self, key: str) -> None:
        """Forget an item, its result and its failure, so that the next run computes it."""
        for path in (self._file(key), self._quarantine_file(key)):
            with suppress(FileNotFoundError):
                path.unlink()

    def keys(self) -> Iterator[str]:
        """The keys of all items that the store holds, in no order."""
        for path in (self.directory / "items").glob("*/*.item"):
            yield path.name.removesuffix(".item")

    # ---- Items that failed -----------------------------------------------------------------------------------------

    @property
    def quarantined(self) -> tuple[QuarantinedItem, ...]:
        """The items that failed, by key."""
        folder = self.directory / "quarantine"
        paths = sorted(folder.glob("*.json")) if folder.is_dir() else []
        return tuple(_read_quarantined(path) for path in paths)

    def is_quarantined(self, key: str) -> bool:
        """Whether an item failed in an earlier run."""
        return os.path.lexists(self._quarantine_file(key))

    def quarantine(self, item: QuarantinedItem) -> None:
        """Write down an item that failed."""
        content = json.dumps(asdict(item), indent=1, default=repr)
        self._write(self._quarantine_file(item.key), content.encode())

    # ---- Files -----------------------------------------------------------------------------------------------------

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Keep other processes from running a campaign in the directory while the block runs."""
        with self._saying_why():
            self.directory.mkdir(parents=True, exist_ok=True)
            handle = os.open(self.directory / ".campaign.lock", os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if fcntl is not None:
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise EnvironmentProblem(
                        f"another process is running a campaign in {self.directory}; wait until it has ended, or "
                        "choose another directory."
                    ) from None
            yield
        finally:
            os.close(handle)

    def _file(self, key: str) -> Path:
        check_key(key)
        folder = hashlib.sha256(key.encode()).hexdigest()[:FOLDER_DIGITS]
        return self.directory / "items" / folder / f"{key}.item"

    def _quarantine_file(self, key: str) -> Path:
        check_key(key)
        return self.directory / "quarantine" / f"{key}.json"

    def _write(self, path: Path, content: bytes) -> None:
        with self._saying_why():
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, content)

    @contextmanager
    def _saying_why(self) -> Iterator[None]:
        try:
            yield
        except OSError as problem:
            raise EnvironmentProblem(
                f"cannot write to {self.directory}: {why(problem)}; what is done is kept, so mend that and run the "
                "same again to go on."
            ) from problem


def check_key(key: str) -> None:
    """Raise ValueError unless `key` can be the name of an item."""
    if not isinstance(key, str) or not KEY.fullmatch(key):
        raise ValueError(
            f"expected a key of 1 to 200 characters out of a-z, 0-9, '.', '_', '=', '+' and '-', which begins with a "
            f"letter or digit, got {key!r:.80}."
        )


def _digest(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + b"\0" + content).digest()


def _read_quarantined(path: Path) -> QuarantinedItem:
    try:
        return QuarantinedItem(**json.loads(read_file(path, FileFormatError)))
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{path} is no record of a failed item; delete it.") from error
