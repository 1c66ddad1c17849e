# SPDX-License-Identifier: Apache-2.0
"""Reading files only if they are plain, and writing them whole or not at all.

This module imports only the standard library, because the entry points of both packages need it before anything else.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import stat
import threading
from collections.abc import Iterable, Mapping, Set
from contextlib import suppress
from pathlib import Path

from pcgraph.plumbing import interrupts

try:
    import fcntl
except ImportError:  # Windows has no flock: there, what killed processes left is not cleared
    fcntl = None  # type: ignore[assignment]

DISK = {errno.ENOSPC: "no space left on the device", errno.EDQUOT: "the disk quota is used up",
        errno.EFBIG: "the file would be larger than allowed", errno.EROFS: "the file system is read-only",
        errno.EIO: "the device fails"}  # fmt: skip
"""Reasons why a disk takes no more data, by error number."""
FULL = (errno.ENOSPC, errno.EDQUOT)
"""Numbers of the errors after which the same path works again once there is room."""
_MAX_NAME = 255
"""Most bytes of a file's name, from the limit of common file systems. If the name of a temporary file would be longer,
it has a digest in place of the name."""
_SEALED_WITHIN = 400
"""Bytes at the beginning, or at the end, of a file that are searched for its seal, because writers put it there."""
_BLOCK = 1 << 20
"""Bytes that are read and hashed at a time, so that a large file does not have to fit into memory. Chosen by eye; not
varied."""
_PART = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{16}\.part")


# ---- Reading -------------------------------------------------------------------------------------------------------


def check_file(path: str | Path, error: type[Exception]) -> None:
    """Raise `error` unless `path` is a plain file, or a link to one: pipes may never answer, devices may never end."""
    path = Path(path)
    try:
        if path.is_file():
            return
        reason = "it is no plain file" if path.exists() else "No such file or directory"
    except (OSError, ValueError) as problem:  # a loop of links, or an impossible name
        reason = getattr(problem, "strerror", None) or str(problem)
    raise error(f"cannot read {path}: {reason}.")


def read_file(path: str | Path, error: type[Exception]) -> bytes:
    """Return the content of a plain file; raise `error` if it is none, cannot be read, or does not fit into memory."""
    check_file(path, error)
    try:
        return Path(path).read_bytes()
    except OSError as problem:
        raise error(f"cannot read {path}: {problem.strerror or problem}.") from problem
    except MemoryError:
        raise error(f"cannot read {path}: it does not fit into memory.") from None


def is_plain_file(path: Path) -> bool:
    """Whether `path` is a plain file, and not a link to one."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False


# ---- Seals ---------------------------------------------------------------------------------------------------------


def unsealed(mark: str) -> str:
    """Text in the place where `sealed` will put the seal of a file; it has only characters that any format takes."""
    return f"{mark} sha256 {'0' * 64}"


def sealed(content: bytes, mark: str, at_end: bool = False) -> bytes:
    """The bytes of a file with their SHA-256 in place of the zeros of its `unsealed` text.

    The sum is taken while the zeros are in place. With `at_end`, the last such text in the file is the seal; otherwise
    the first one is.

    Examples
    --------
    >>> content = sealed(f"<!-- {unsealed('mine')} -->".encode(), "mine")
    >>> content[:28]
    b'<!-- mine sha256 5da3f0adb61'
    """
    empty = unsealed(mark).encode()
    start = (content.rindex(empty) if at_end else content.index(empty)) + len(empty) - 64
    return content[:start] + hashlib.sha256(content).hexdigest().encode() + content[start + 64 :]


def is_sealed(path: Path, mark: str, at_end: bool = False) -> bool:
    """Whether a file has a seal in its first 400 bytes (with `at_end` in its last), and still the sealed content."""
    with path.open("rb") as stream:
        start = max(0, stream.seek(0, os.SEEK_END) - _SEALED_WITHIN) if at_end else 0
        stream.seek(start)
        seals = list(re.finditer(rb"%s sha256 ([0-9a-f]{64})" % re.escape(mark.encode()), stream.read(_SEALED_WITHIN)))
        if not seals:
            return False
        seal = seals[-1 if at_end else 0]
        stream.seek(0)
        sha256, left = hashlib.sha256(), start + seal.start(1)
        while left and (block := stream.read(min(left, _BLOCK))):
            sha256.update(block)
            left -= len(block)
        sha256.update(b"0" * len(stream.read(64)))
        while block := stream.read(_BLOCK):
            sha256.update(block)
    return sha256.hexdigest().encode() == seal[1]


# ---- Writing -------------------------------------------------------------------------------------------------------


def write_file(
    path: Path, content: bytes, error: type[Exception], make_parents: bool = False, overwrite: bool = True
) -> None:
    """Write one file, as `write_files` does."""
    write_files({path: content}, error, make_parents, overwrite)


def write_files(
    contents: Mapping[Path, bytes], error: type[Exception], make_parents: bool = False, overwrite: bool = True
) -> None:
    """Write files so that a reader finds the old or the new content of each, never a part, also after a crash.

    Older files are replaced, unless `overwrite` is False. So names must come from the user, or the caller must first
    check that a file is its own.
    No file is replaced before all are on the disk, and a signal leaves all or none. Links are followed. Temporary files
    that killed processes left beside the files are removed.

    Raises
    ------
    error
        A path is no plain file, its directory does not exist, or the disk is full; or a file exists, perhaps since a
        moment ago, and shall not be replaced.
    """
    for path in contents:
        target = Path(os.path.realpath(path))
        if os.path.lexists(target) and not target.is_file():
            raise error(f"cannot write {path}: it exists and is no plain file; choose another path.")
        if os.path.lexists(target) and not os.access(target, os.W_OK):
            raise error(f"cannot write {path}: it is read-only; choose another path.")
    parts: list[_Part] = []
    done = False
    try:
        for path, content in contents.items():
            parts.append(_Part(path))
            parts[-1].write(content, make_parents)
        with _lock:
            if not overwrite and (taken := [part.named for part in parts if part.target.exists()]):
                raise error(f"cannot write {taken[0]}: it exists by now; choose another path.")
            for part in parts:
                path = part.named
                part.place()
                interrupts.count()
        done = True
    except OSError as problem:
        reason = "a file is in the way" if isinstance(problem, (FileExistsError, NotADirectoryError)) else why(problem)
        advice = "make room there and run it again" if problem.errno in FULL else "choose another path"
        raise error(f"cannot write {path}: {reason}; {advice}.") from problem
    finally:
        for part in reversed(parts):
            part.remove(and_directories=not done)


def replace_file(target: Path, content: bytes) -> None:
    """Write `content` to a plain file, new or old, whole or not at all; OSError if that fails."""
    part = _Part(target)
    try:
        part.write(content)
        part.place()
    finally:
        part.remove()


class _Part:
    """A temporary file beside a file, with the file's new content; it is locked until it is moved or removed."""

    def __init__(self, named: Path) -> None:
        self.named, target = named, Path(os.path.realpath(named))
        digest = hashlib.sha256(os.fsencode(target.name)).hexdigest()
        self.names = {target.name, digest}  # names in temporary files that killed processes may have left
        self.target = target
        self.path = target.with_name(f".{target.name}.{os.urandom(8).hex()}.part")
        if len(os.fsencode(self.path.name)) > _MAX_NAME:
            self.path = target.with_name(f".{digest}.{os.urandom(8).hex()}.part")
        self.made: list[Path] = []
        self._held: int | None = None

    def write(self, content: bytes, make_parents: bool = False) -> None:
        """Write and flush the temporary file; its directory is made if need be."""
        with _lock:
            if make_parents:
                self.made = [parent for parent in self.target.parents if not parent.exists()]
            _parts.append(self)
            if make_parents:
                self.target.parent.mkdir(parents=True, exist_ok=True)
            clear_parts(self.target.parent, self.names)
            handle = self._opened()
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(handle)
        if self.target.exists():
            os.chmod(self.path, stat.S_IMODE(self.target.stat().st_mode))

    def _opened(self) -> int:
        """Handle of the new temporary file, locked: another process takes a file without a lock for one left behind."""
        while True:
            handle = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
            if fcntl is None:
                return handle
            fcntl.flock(handle, fcntl.LOCK_EX)
            if os.path.lexists(self.path):  # else another process has removed it before it was locked
                self._held = os.dup(handle)  # keeps the lock when `handle` is closed
                return handle
            os.close(handle)

    def place(self) -> None:
        """Move the temporary file to the place of the file."""
        os.replace(self.path, self.target)
        flush(self.target.parent)

    def remove(self, and_directories: bool = False) -> None:
        """Remove the temporary file, if it still exists, and on request the empty directories that were made for it."""
        with _lock:
            if self in _parts:
                _parts.remove(self)
            if self._held is not None:
                os.close(self._held)
                self._held = None
            with suppress(OSError):  # it was moved, was never made, or its directory is gone
                self.path.unlink()
            if and_directories:
                remove_empty(self.made)


_parts: list[_Part] = []
"""Temporary files of this process."""
_lock = threading.RLock()
"""Lock that is held while temporary files are made, moved and removed; `_abandon` waits for it."""


def _abandon() -> bool:
    """Remove the temporary files of this process, which is about to end; return whether there were any."""
    with interrupts.holding(_lock):
        begun = bool(_parts)
        for part in reversed(_parts.copy()):
            part.remove(and_directories=True)
        return begun


def _forget_parts() -> None:
    """Forget the temporary files in a forked child, because they are its parent's."""
    global _lock
    _lock = threading.RLock()
    _parts.clear()


interrupts.removers.append(_abandon)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_parts)


def clear_parts(folder: Path, names: Set[str]) -> None:
    """Remove temporary files of these names from a folder, if their writers have ended."""
    if fcntl is None:
        return
    for entry in folder.iterdir():
        match = _PART.fullmatch(entry.name)
        if match is None or match["name"] not in names or not is_plain_file(entry):
            continue
        if any(part.path == entry for part in _parts):
            continue
        with suppress(OSError):
            handle = os.open(entry, os.O_RDONLY)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                entry.unlink()
            finally:
                os.close(handle)


def why(problem: OSError) -> str:
    """Reason of an error of the operating system, in words."""
    return DISK.get(problem.errno or 0) or problem.strerror or str(problem)


def said(problem: OSError) -> str:
    """Sentence about an error of the operating system, with the file and the reason."""
    if problem.errno is None:
        return str(problem)
    if problem.filename is not None:
        return f"cannot use {os.fsdecode(problem.filename)}: {why(problem)}"
    try:
        os.getcwd()
    except OSError:
        return "expected a working directory, but this one is gone: change to another"
    return why(problem)


def flush(path: Path) -> None:
    """Flush a file, or the entries of a directory, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def remove_empty(directories: Iterable[Path]) -> None:
    """Remove the directories that are empty, in the given order: the innermost comes first."""
    for directory in directories:
        with suppress(OSError):  # it was never made, or is no longer empty
            directory.rmdir()
