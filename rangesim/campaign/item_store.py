# SPDX-License-Identifier: Apache-2.0
"""The directory of a campaign: the results of its items, each written whole or not at all, and its quarantine.

DIR/campaign.json            what the campaign is: settings, function, versions
DIR/items/5d0/KEY.item       result of an item: a mark, two checksums, and the content
DIR/quarantine/KEY.json      an item that failed: its argument, the error and the traceback
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pcgraph.plumbing import interrupts
from pcgraph.plumbing.plain_files import read_file, replace_file, why
from rangesim.errors import EnvironmentProblem, FileFormatError
from rangesim.settings.config import shown, to_dict

try:
    import fcntl
except ImportError:  # Windows has no flock: there, two campaigns in one directory are not kept apart
    fcntl = None  # type: ignore[assignment]

FORMAT = "rangesim campaign 1"
"""What `campaign.json` says that it is; the number is the version of the format."""
MARK = b"rangesim item 1\n"
"""The first bytes of an item's file; the number is the version of the format."""
KEY = re.compile(r"[a-z0-9][a-z0-9._=+-]{0,199}")
"""What a key may be. It is the name of a file, on every file system: so no upper case, which some take for lower case,
and at most 200 characters, because a name has at most 255 bytes, some of which temporary files need."""
FOLDER_DIGITS = 3
"""Hexadecimal digits of the names of the folders below `items`: 4096 folders, so that 10^6 items are 250 files in each.
Every write lists one folder."""
_HEAD = len(MARK) + 2 * 32
"""Bytes of an item's file before its content: the mark, SHA-256 of the argument, SHA-256 of everything else."""
_UNKNOWN = bytes(32)
"""In place of the SHA-256 of an argument that is no plain data."""


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

    # ---- Results ---------------------------------------------------------------------------------------------------

    def __contains__(self, key: str) -> bool:
        """Whether the store holds the result of an item. Its content is checked when it is read."""
        return os.path.lexists(self._file(key))

    def keys(self) -> Iterator[str]:
        """The keys of all items that the store holds, in no order."""
        for path in (self.directory / "items").glob("*/*.item"):
            yield path.name.removesuffix(".item")

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
        file = read_file(path, FileFormatError)
        head, content = file[:_HEAD], file[_HEAD:]
        if head[-32:] != _digest(key, head[:-32], content):
            raise FileFormatError(f"{path} is broken: its checksum does not fit; delete it and run the campaign again.")
        return content

    def write(self, key: str, content: bytes, argument: Any = None) -> None:
        """Write the result of an item, whole or not at all; EnvironmentProblem if the disk does not take it.

        `argument` is what the result was computed from.
        """
        head = MARK + _digest_of_argument(argument)
        self._write(self._file(key), head + _digest(key, head, content) + content)

    def check_argument(self, key: str, argument: Any) -> bool:
        """Return True if the stored item was computed from this argument; ValueError if it was from another one.

        Only numbers, texts, arrays, dataclasses, and lists and dictionaries of them are compared. FileFormatError if
        the file is broken.
        """
        with self._file(key).open("rb") as stream:
            head = stream.read(_HEAD)
        if len(head) < _HEAD or not head.startswith(MARK):
            raise FileFormatError(f"{self._file(key)} is broken; delete it and run the campaign again.")
        then, now = head[len(MARK) : len(MARK) + 32], _digest_of_argument(argument)
        if then != now and _UNKNOWN not in (then, now):
            raise ValueError(
                f"{self.directory} holds item {key}, computed from other settings; choose another directory, or "
                "discard the item."
            )
        return True

    def discard(self, key: str) -> None:
        """Forget an item, its result and its failure, so that the next run computes it."""
        for path in (self._file(key), self._quarantine_file(key)):
            with suppress(FileNotFoundError):
                path.unlink()

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

    # ---- The campaign ----------------------------------------------------------------------------------------------

    def pin(self, campaign: Mapping[str, Any]) -> None:
        """Write to `campaign.json` what the campaign is, or compare with what is there.

        Raises
        ------
        ValueError
            The directory holds another campaign; the message says what differs.
        """
        now = json.loads(json.dumps({"format": FORMAT, "settings": self.settings, **campaign}, default=repr))
        path = self.directory / "campaign.json"
        if not os.path.lexists(path):
            self._write(path, (json.dumps(now, indent=1, sort_keys=True) + "\n").encode())
            return
        try:
            then = json.loads(read_file(path, FileFormatError))
        except ValueError:
            then = None
        if not isinstance(then, dict) or then.get("format") != FORMAT:
            raise FileFormatError(f"{path} describes no campaign that this version knows; choose another directory.")
        if differences := list(_differences(then, now)):
            raise ValueError(
                f"{self.directory} holds another campaign: {'; '.join(differences[:5])}. Choose another directory."
            )

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Keep other processes from running a campaign in the directory while the block runs."""
        with self._saying_why():
            self.directory.mkdir(parents=True, exist_ok=True)
            handle = os.open(self.directory, os.O_RDONLY) if fcntl is not None else None
        try:
            if handle is not None and not _locked(handle):
                raise EnvironmentProblem(
                    f"another process is running a campaign in {self.directory}; wait until it has ended, or choose "
                    "another directory."
                )
            yield
        finally:
            if handle is not None:
                os.close(handle)

    # ---- Files -----------------------------------------------------------------------------------------------------

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
        interrupts.count()

    @contextmanager
    def _saying_why(self) -> Iterator[None]:
        try:
            yield
        except OSError as problem:
            raise EnvironmentProblem(f"cannot write to {self.directory}: {why(problem)}.") from problem


def _locked(handle: int) -> bool:
    """Whether a directory is locked for this process now; True also on file systems that have no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as problem:
        if problem.errno not in (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP):  # Lustre without flock, and others
            raise
    return True


def check_key(key: str) -> None:
    """Raise ValueError unless `key` can be the name of an item."""
    if not isinstance(key, str) or not KEY.fullmatch(key):
        raise ValueError(
            f"expected a key of 1 to 200 characters out of a-z, 0-9, '.', '_', '=', '+' and '-', which begins with a "
            f"letter or digit, got {key!r:.80}."
        )


def _digest(key: str, head: bytes, content: bytes) -> bytes:
    digest = hashlib.sha256(key.encode() + b"\0" + head)
    digest.update(content)
    return digest.digest()


def _digest_of_argument(argument: Any) -> bytes:
    """SHA-256 of plain data, the same in every process; `_UNKNOWN` of what is none."""
    try:
        plain = msgspec.json.encode(argument, enc_hook=_plain, order="deterministic")
    except (TypeError, ValueError, RecursionError):
        return _UNKNOWN
    return hashlib.sha256(plain).digest()


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no plain data")


def _differences(then: Any, now: Any, place: str = "") -> Iterator[str]:
    """Differences between two pieces of plain data, one text for each place."""
    if isinstance(then, dict) and isinstance(now, dict):
        for name in sorted(then.keys() | now.keys()):
            yield from _differences(then.get(name), now.get(name), f"{place}.{name}" if place else name)
    elif then != now:
        yield f"{place} was {shown(then)} and is {shown(now)} now"


def _read_quarantined(path: Path) -> QuarantinedItem:
    try:
        return QuarantinedItem(**json.loads(read_file(path, FileFormatError)))
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{path} is no record of a failed item; delete it.") from error
