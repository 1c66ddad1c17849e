# SPDX-License-Identifier: Apache-2.0
"""Directories that appear whole or not at all; writing them never destroys a file of the user.

Every command and every `save` of rangesim that writes a directory does so here, by four rules; those that write single
files do so in `pcgraph.plumbing.plain_files`.

1. Work goes on in a hidden staging directory, `STAGING`, inside the directory that is asked for. A lock says that the
   work is alive. If a process was killed, the next process clears what it left, or completes its replacement.
2. A finished directory holds a manifest with size and SHA-256 of each of its files. What the manifest does not list, or
   lists with another content, belongs to the user: it is never moved, overwritten or removed.
3. The new files take the place of the old ones by renames that a journal describes. Once the journal is on the disk,
   the new result is valid: the next process that looks carries out the rest. Before that, the old result is valid.
4. Files and directories are flushed to the disk before they take a place.

Only the standard library and `pcgraph.plumbing` are imported: commands check their output before they load the rest.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import stat
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from pcgraph.plumbing import interrupts
from pcgraph.plumbing.plain_files import DISK, clear_parts, flush, is_plain_file, remove_empty, replace_file, why

try:
    import fcntl
except ImportError:  # Windows has no flock: there, two runs with the same output are not told apart
    fcntl = None  # type: ignore[assignment]

STAGING = ".rangesim-staging"
"""Name of the hidden directory, inside the output, in which work in progress lies."""
MANIFEST = "manifest.json"
"""Name of the file that lists all other files of a finished directory."""
MANIFEST_FORMAT = "rangesim-manifest"
MANIFEST_VERSION = 1
"""Version of the manifest's format; a manifest of another version is refused."""
MAX_MANIFEST_BYTES = 64 << 20
"""Bytes of the largest manifest that is read, so that a damaged or hostile one cannot fill the memory. Each listed file
takes some 150 bytes, so this is enough for over 400 000 files."""
_JOURNAL, _LOCK, _WORK, _NEW, _OLD, _DOOMED = "journal.json", "lock", "work", "new", "old", "doomed"
_ATTEMPTS = 1000
"""Number of attempts, about a millisecond apart, to claim a directory that another process removes at the same moment.
If all fail, which takes about a second, the directory counts as one that cannot be made."""


@dataclass(frozen=True)
class DirectoryKind:
    """A kind of directory that this project writes.

    format : name of the kind in the manifest and in the sidecar. sidecar : name of the JSON file with the settings.
    error : type of the exception whose message says, in one sentence, why a directory of this kind cannot be written.

    Examples
    --------
    >>> DirectoryKind("rangesim-result", "experiment.json", ValueError).format
    'rangesim-result'
    """

    format: str
    sidecar: str
    error: type[Exception]


class Digest(NamedTuple):
    """Size in bytes and SHA-256 (hexadecimal) of a file."""

    size: int
    sha256: str


@dataclass(frozen=True)
class Verification:
    """The differences between a directory and its manifest; paths are relative to the directory and sorted.

    missing : listed files that do not exist. changed : listed files with another content. foreign : files and empty
    directories that are not listed. files : number of listed files.
    """

    missing: tuple[str, ...]
    changed: tuple[str, ...]
    foreign: tuple[str, ...]
    files: int


# ---- Directories ---------------------------------------------------------------------------------------------------


def check_directory(directory: str | Path, kind: DirectoryKind, inputs: Sequence[str | Path] = ()) -> Path:
    """Return the directory that output to `directory` goes to, with links followed; nothing is written.

    A directory may be new, or empty, or hold an unchanged older result of the same kind, beside which the user may keep
    files. `inputs` are the files and directories that the work reads.

    Raises
    ------
    kind.error
        The place holds something else, or a file of the older result was changed; `directory` is a link to nothing; it
        is an input, holds one or lies in one; or another process is writing to it.
    """
    named = Path(directory)
    if named.parts[:1] == ("~",) or named.name.startswith("--"):
        kind_of_name = "an option" if named.name.startswith("--") else "a home directory, which only a shell expands"
        raise kind.error(f"{named} looks like {kind_of_name}; name another place, or ./{named}.")
    try:
        if named.is_symlink() and not named.exists():
            raise kind.error(f"{named} is a link to {os.readlink(named)}, which does not exist; name another place.")
        target = Path(os.path.realpath(named))
        if os.path.lexists(target) and not target.is_dir():
            raise kind.error(f"{named} exists and is no directory; name another place.")
        for source in inputs:
            _check_apart(named, target, Path(source), kind)
        if target.is_dir():
            if _is_claimed(target):
                raise kind.error(f"another process is writing to {named}; wait for it, or name another place.")
            if not (target / STAGING).exists():  # else they are checked after the clearing
                _check_contents(named, target, kind, inputs)
    except OSError as problem:
        place = f" ({os.fsdecode(problem.filename)})" if problem.filename else ""
        raise kind.error(f"cannot write to {named}: {why(problem)}{place}; name another place.") from problem
    return target


@contextmanager
def new_directory(directory: str | Path, kind: DirectoryKind, inputs: Sequence[str | Path] = ()) -> Iterator[Path]:
    """Yield a directory to fill; its files move to `directory` when the block ends well, and are removed if it fails.

    An older result of the same kind stays until the block ends well, and is then replaced. Files that are not in its
    manifest stay. If a file of the user stands in the way when the block ends, the new result is kept in a directory
    inside `directory`, and the error names that directory.

    Raises
    ------
    kind.error
        As for `check_directory`; or the directory cannot be made, or the disk is full.
    """
    named = Path(directory)
    target = check_directory(named, kind, inputs)
    with _one_sentence(named, target, kind):
        staging = _Staging.claim(named, target, kind)
        try:
            _check_contents(named, target, kind, inputs)
            yield staging.make_new()
            staging.commit(named, kind)
        except OSError:
            if staging.was_moved():
                raise kind.error(_moved(named)) from None  # no directory is to be created: see `_one_sentence`
            raise
        finally:
            staging.release()


def write_manifest(folder: Path, kind: DirectoryKind) -> None:
    """Write the manifest of a complete directory, with all its files; `new_directory` does this itself."""
    files = {name: [_digest(folder / name)] for name in _walk(folder) if name != MANIFEST}
    (folder / MANIFEST).write_bytes(_manifest(kind, files))


def replace_listed_file(directory: str | Path, name: str, make: Callable[[], bytes], kind: DirectoryKind) -> None:
    """Write the file `name` of a complete directory again, and its manifest.

    `make` returns the new content. No other process replaces the directory from the call of `make` until the end.

    Raises
    ------
    kind.error
        The file was changed by somebody else, or another process is writing to the directory.
    """
    named, folder = Path(directory), Path(os.path.realpath(directory))
    with _one_sentence(named, folder, kind):
        recover(folder, kind.error)
        read_manifest(folder, kind)
        staging = _Staging.claim(named, folder, kind)
        try:
            content = make()
            files = read_manifest(folder, kind)
            path = folder / name
            if os.path.lexists(path) and not (is_plain_file(path) and _digest(path) in files.get(name, [])):
                raise kind.error(f"{path} was changed since rangesim wrote it; move it away first.")
            new = Digest(len(content), hashlib.sha256(content).hexdigest())
            # The manifest lists the old and the new content while the new one replaces the old one
            replace_file(folder / MANIFEST, _manifest(kind, files | {name: [*files.get(name, []), new]}))
            replace_file(path, content)
            replace_file(folder / MANIFEST, _manifest(kind, files | {name: [new]}))
            interrupts.count()
        finally:
            staging.release()


def read_manifest(directory: Path, kind: DirectoryKind) -> dict[str, list[Digest]]:
    """Return the contents that each file of a directory may have, by its path relative to the directory, with `/`.

    Raises
    ------
    kind.error
        There is no manifest of this kind, or it is damaged.
    """
    path = directory / MANIFEST
    if not is_plain_file(path):
        raise kind.error(f"{directory} has no {MANIFEST}, so it is not known which of its files rangesim wrote.")
    with path.open("rb") as stream:
        text = stream.read(MAX_MANIFEST_BYTES + 1)
    try:
        if len(text) > MAX_MANIFEST_BYTES:
            raise ValueError(f"it is larger than {MAX_MANIFEST_BYTES} bytes")
        return _parse_manifest(json.loads(text), kind.format)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200] or "it is nested too deeply"
        raise kind.error(f"{path} is no manifest of a {kind.format}: {reason}.") from error


def verify_directory(directory: str | Path, kind: DirectoryKind) -> Verification:
    """Return how the files of a directory differ from what was written; this reads every byte.

    Raises
    ------
    kind.error
        There is no manifest of this kind, or it is damaged.
    """
    folder = Path(os.path.realpath(directory))
    recover(folder, kind.error)
    files = read_manifest(folder, kind)
    found = _walk(folder, empty_directories=True)
    listed = set(files)
    ours = listed | {MANIFEST} | {str(parent) for name in listed for parent in PurePosixPath(name).parents}
    return Verification(
        missing=tuple(sorted(name for name in listed if not os.path.lexists(folder / name))),
        changed=tuple(sorted(n for n in listed if os.path.lexists(folder / n) and not _is_as_listed(folder, n, files))),
        foreign=tuple(sorted(name for name in found if name not in ours)),
        files=len(listed),
    )


def sidecar_of(directory: str | Path, kind: DirectoryKind) -> Path:
    """Path of the sidecar of a directory, after a replacement that a killed process began is completed.

    Raises
    ------
    kind.error
        The directory has no sidecar of this kind, or as `recover`.
    """
    recover(directory, kind.error)
    sidecar = Path(directory) / kind.sidecar
    if not sidecar.is_file():
        raise kind.error(f"{directory} is no {kind.format} directory: it has no {kind.sidecar}.")
    return sidecar


def recover(directory: str | Path, error: type[Exception]) -> None:
    """Complete a replacement that a killed process began. Call this before reading a directory that rangesim wrote.

    Raises
    ------
    error
        The replacement cannot be completed: a file is in the way, or the place cannot be written.
    """
    target = Path(os.path.realpath(directory))
    staging = target / STAGING
    if not is_plain_file(staging / _JOURNAL) or not _is_staging(staging):
        return
    try:
        handle = _lock(staging, seconds=5.0)  # a living process needs less time for its renames
    except FileNotFoundError:  # that process has finished
        return
    except OSError as problem:
        raise error(f"cannot read {staging}: {why(problem)}.") from problem
    if handle is None:
        raise error(f"another process is replacing the files of {directory}; wait for it.")
    try:
        try:
            _carry_out(target)
            _dissolve(staging)
        finally:
            os.close(handle)
    except OSError as problem:
        raise error(
            f"an interrupted replacement of {directory} cannot be completed: {why(problem)} "
            f"({problem.filename or staging})."
        ) from problem


_claims: dict[Path, _Staging] = {}
"""Staging directories that this process works in, by their paths."""
_claims_lock = threading.RLock()
"""The lock that is held while claims change and while files move to their places; `abandon` waits for it."""


def abandon() -> bool:
    """Remove all work in progress of this process, which is about to end; return whether there was any.

    A replacement under way is completed first. The thread that handles signals calls this.
    """
    with interrupts.holding(_claims_lock):
        begun = bool(_claims)
        for claim in list(_claims.values()):
            claim.release()
        return begun


class _Staging:
    """The staging directory inside an output, which this process claims as long as it keeps the lock file open."""

    def __init__(self, target: Path) -> None:
        self.target, self.path = target, target / STAGING
        self.made = [path for path in (target, *target.parents) if not path.exists()]
        self.handle: int | None = None
        self.process = os.getpid()
        self.work = self.path / f"{_WORK}-{os.urandom(8).hex()}"  # its own name: see `is_ours`
        self.manifest: Digest | None = None

    @classmethod
    def claim(cls, named: Path, target: Path, kind: DirectoryKind) -> _Staging:
        """Make the staging directory, or take over the one that a killed process left."""
        with _claims_lock:
            claim = cls(target)
            try:
                for _ in range(_ATTEMPTS):
                    if claim.take(kind):
                        break
                    time.sleep(0.001)
                else:
                    raise kind.error(f"{named} cannot be made, or somebody removes it at once; name another place.")
                if claim.handle is None:
                    raise kind.error(f"another process is writing to {named}; wait for it, or name another place.")
                _carry_out(target)
                _clear(claim.path)
                if is_plain_file(target / MANIFEST):
                    claim.manifest = _digest(target / MANIFEST)
                clear_parts(target, _listed_names(target, kind) | {MANIFEST})
            except BaseException:
                claim.release()
                raise
            _claims[claim.path] = claim
        return claim

    def take(self, kind: DirectoryKind) -> bool:
        """Try to lock the staging directory, which is made if need be; return whether it still existed."""
        try:
            self.target.mkdir(parents=True, exist_ok=True)
            self.path.mkdir(exist_ok=True)
            found = _is_staging(self.path)
            if found is None:  # its owner has just removed it
                return False
            if not found:
                raise kind.error(f"{self.path} is no staging directory of rangesim; move it away.")
            self.handle = _lock(self.path)
        except FileNotFoundError:  # its owner has just removed it
            return False
        except FileExistsError:  # in the way is a file, or was a directory that its owner has just removed
            if any(
                os.path.lexists(path) and not path.is_dir() for path in (self.path, self.target, *self.target.parents)
            ):
                raise
            return False
        return True

    def make_new(self) -> Path:
        """Make the directory to fill, and return it."""
        with _claims_lock:
            self.work.mkdir()
        return self.work

    def is_ours(self) -> bool:
        """Whether this process made the claim, and the directory is still where it was.

        A user may move or remove it meanwhile, another process may work in a new one of that name, and a child of this
        process shares the claim.
        """
        with _claims_lock:  # a thread that ends the process may give up the claim meanwhile
            if self.handle is None or self.process != os.getpid():
                return False
            try:
                return os.path.samestat(os.stat(self.path / _LOCK), os.fstat(self.handle))
            except FileNotFoundError:
                return False

    def was_moved(self) -> bool:
        """Whether the directory is no longer where this process made it, because somebody moved or removed it."""
        with _claims_lock:
            return self.handle is not None and self.process == os.getpid() and not self.is_ours()

    def commit(self, named: Path, kind: DirectoryKind) -> None:
        """List the new files in a manifest, flush them, and move them to their places."""
        if self.process != os.getpid():
            return
        write_manifest(self.work, kind)
        _flush_tree(self.work)
        with _claims_lock:
            if self.was_moved():
                raise kind.error(_moved(named))
            new = self.path / _NEW
            self.work.rename(new)
            old = self.listed(kind)
            names = _walk(new)
            obstacle = next((name for name in names if _is_in_the_way(self.target, name, old)), None)
            if obstacle is not None:
                kept = self._set_aside(kind)
                raise kind.error(
                    f"{named / obstacle} appeared or was changed while the work went on; it was left as it is, and the "
                    f"new result is in {kept}."
                )
            for name in old:  # before the journal, because this may fail
                _make_plain_parents(self.path, f"{_OLD}/{name}")
            replace_file(self.path / _JOURNAL, _json({"retire": old, "place": names}))
            try:
                _carry_out(self.target)
            except KeyboardInterrupt:
                _carry_out(self.target)
                raise
        interrupts.count()

    def listed(self, kind: DirectoryKind) -> dict[str, list[Digest]]:
        """Return the files of the older result that are still as they were written, including its manifest.

        A manifest that somebody put there while the work went on belongs to the user, with the files that it lists.
        """
        try:
            if self.manifest is None or _digest(self.target / MANIFEST) != self.manifest:
                return {}
            files = read_manifest(self.target, kind)
        except (kind.error, FileNotFoundError):
            return {}
        kept = {name: digests for name, digests in files.items() if _is_as_listed(self.target, name, files)}
        return {**kept, MANIFEST: [_digest(self.target / MANIFEST)]}

    def _set_aside(self, kind: DirectoryKind) -> Path:
        """Move the new result to a directory inside the target that does not exist yet, and return that directory."""
        for number in range(2, 10_000):
            place = self.target / f"{kind.format}-{number}"
            if not os.path.lexists(place):
                (self.path / _NEW).rename(place)
                flush(self.target)
                return place
        raise kind.error(f"{self.target} holds too many results that were set aside; move them away.")

    def release(self) -> None:
        """Remove the staging directory, unless it holds a replacement to complete, and give up the lock."""
        with _claims_lock:
            _claims.pop(self.path, None)
            handle = self.handle
            try:
                if self.is_ours() and not (self.path / _JOURNAL).exists():
                    _dissolve(self.path)
            finally:  # also when a second Ctrl-C ends the clearing: the lock of a living process would stay
                self.handle = None
                if handle is not None:
                    os.close(handle)
            if self.process == os.getpid():
                remove_empty(self.made)


def _moved(named: Path) -> str:
    return f"{named} was moved or removed while the work went on; nothing was written there."


def _clear(staging: Path) -> None:
    """Remove everything but the lock from a staging directory."""
    for entry in staging.iterdir():
        if entry.name == _LOCK:
            continue
        if entry.is_dir() and not entry.is_symlink():
            doomed = staging / f"{_DOOMED}-{os.urandom(8).hex()}"
            entry.rename(doomed)  # whoever still works in there finds no place for new files
            shutil.rmtree(doomed, ignore_errors=True)
        else:
            entry.unlink()


def _dissolve(staging: Path) -> None:
    """Remove a staging directory whose lock is held. The lock goes last, so that the rest never looks foreign."""
    with suppress(OSError):  # the next one clears it
        _clear(staging)
        if os.listdir(staging) == [_LOCK]:
            (staging / _LOCK).unlink()
            staging.rmdir()


def _forget_claims() -> None:
    """Forget the claims in a forked child: they belong to its parent."""
    global _claims_lock
    _claims_lock = threading.RLock()
    for claim in _claims.values():
        if claim.handle is not None:
            os.close(claim.handle)
            claim.handle = None
    _claims.clear()


interrupts.removers.append(abandon)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_claims)


def _carry_out(target: Path) -> None:
    """Complete the replacement that a journal describes, if there is one: retire the old files, place the new ones.

    Steps that are done already are left out. A crafted directory may hold a crafted journal, so no link is followed,
    and nothing outside the directory is touched.
    """
    staging = target / STAGING
    if not is_plain_file(staging / _JOURNAL):
        return
    retire, place = _read_journal(staging / _JOURNAL)
    waiting = {name for name in place if os.path.lexists(staging / _NEW / name)}
    for name, digests in retire.items():
        gone = name in place and name not in waiting  # the new file is there already
        if gone or os.path.lexists(staging / _OLD / name) or not os.path.lexists(target / name):
            continue
        if _is_as_listed(target, name, {name: digests}):
            _make_plain_parents(staging, f"{_OLD}/{name}")
            try:
                (target / name).rename(staging / _OLD / name)
            except OSError as problem:
                if problem.errno != errno.EXDEV:
                    raise
                (target / name).unlink()  # something is mounted below the target
    for name in sorted(waiting, key=lambda n: (n == MANIFEST, n)):  # the manifest last: it completes the directory
        if not _is_reached_plainly(staging, f"{_NEW}/{name}"):
            raise OSError(errno.ELOOP, "a link in the staging directory", str(staging / _NEW / name))
        _make_plain_parents(target, name)
        _move_to_free_place(staging / _NEW / name, target / name)
    folders = {target / parent for name in (*retire, *place) for parent in PurePosixPath(name).parents} | {target}
    remove_empty(sorted(folders - {target}, reverse=True))
    for folder in folders:
        if folder.is_dir() and not folder.is_symlink():
            flush(folder)
    (staging / _JOURNAL).unlink()
    flush(staging)


def _read_journal(path: Path) -> tuple[dict[str, list[Digest]], list[str]]:
    """Return the files to retire, with their contents, and the files to place; OSError if the journal is damaged."""
    try:
        journal = json.loads(path.read_bytes()[:MAX_MANIFEST_BYTES])
        place = [_checked_name(name) for name in journal["place"]]
        return _parse_files(journal["retire"]), place
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise OSError(errno.EINVAL, "its journal is damaged; remove the staging directory", str(path)) from error


def _check_contents(named: Path, target: Path, kind: DirectoryKind, inputs: Sequence[str | Path]) -> None:
    """Refuse a directory that is neither empty nor an unchanged result of the same kind, or that holds an input."""
    entries = [entry.name for entry in target.iterdir() if entry.name != STAGING]
    if not entries:
        return
    try:
        files = read_manifest(target, kind)
    except kind.error as error:
        if _states_kind(target / kind.sidecar, kind.format):
            raise kind.error(
                f"{named} holds a {kind.format} without a valid {MANIFEST}, so its files cannot be told from yours; "
                "nothing was written, remove it or name another place."
            ) from error
        raise kind.error(
            f"{named} exists and holds something else than a {kind.format}; nothing was written, name another place."
        ) from error
    changed = next((n for n in files if os.path.lexists(target / n) and not _is_as_listed(target, n, files)), None)
    if changed is not None:
        raise kind.error(
            f"{named / changed} was changed since rangesim wrote it; nothing was written, move it away or name another "
            "place."
        )
    fixed = next((n for n in (*files, MANIFEST) if os.path.lexists(target / n) and not _may_move(target / n)), None)
    if fixed is not None:
        raise kind.error(f"{named / fixed} cannot be replaced: permission denied; name another place.")
    for source in inputs:
        real = Path(os.path.realpath(source))
        within = real.relative_to(target).as_posix() if target in real.parents else None
        if within is not None and any(name == within or name.startswith(f"{within}/") for name in files):
            raise kind.error(f"the input {source} is a part of {named}, which would be replaced; name another place.")


def _check_apart(named: Path, target: Path, source: Path, kind: DirectoryKind) -> None:
    """Refuse an output that is an input or lies inside one."""
    real = Path(os.path.realpath(source))
    if target == real:
        raise kind.error(f"{named} is the input itself; name another place.")
    if real in target.parents and real.is_dir():
        raise kind.error(f"{named} lies inside the input {source}; name another place.")


def _is_in_the_way(target: Path, name: str, listed: Mapping[str, Any]) -> bool:
    """Whether a file or directory that rangesim did not write stands where the new file `name` is to go."""
    for parent in _parents(target, name):
        is_directory = parent.is_dir() and not parent.is_symlink()
        if os.path.lexists(parent) and not is_directory and parent.relative_to(target).as_posix() not in listed:
            return True
    return os.path.lexists(target / name) and name not in listed


def _may_move(path: Path) -> bool:
    """Whether this process may rename a file, which the permissions of its directory decide."""
    if not os.access(path.parent, os.W_OK | os.X_OK):
        return False
    folder = path.parent.stat()
    if not folder.st_mode & stat.S_ISVTX or not hasattr(os, "geteuid"):
        return True
    return os.geteuid() in (0, folder.st_uid, path.lstat().st_uid)


def _listed_names(target: Path, kind: DirectoryKind) -> set[str]:
    """Names of the files in the manifest of a directory; none if there is no valid manifest."""
    try:
        return set(read_manifest(target, kind))
    except kind.error:
        return set()


def _states_kind(sidecar: Path, kind: str) -> bool:
    """Whether a sidecar is a JSON file whose format is `kind`."""
    try:
        info = json.loads(sidecar.read_text(encoding="utf-8")) if is_plain_file(sidecar) else None
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(info, dict) and info.get("format") == kind


# ---- Files and locks beneath ---------------------------------------------------------------------------------------


@contextmanager
def _one_sentence(named: Path, target: Path, kind: DirectoryKind) -> Iterator[None]:
    """Turn an OSError about the output directory, or about one around it, into an error whose sentence names it."""
    try:
        yield
    except (OSError, kind.error) as error:
        problem = error if isinstance(error, OSError) else error.__cause__
        if not isinstance(problem, OSError):
            raise
        where = None if problem.filename is None else Path(os.path.abspath(os.fsdecode(problem.filename)))
        ours = where is not None and (where == target or where in target.parents or target in where.parents)
        if problem.errno in DISK and (ours or where is None):
            raise kind.error(
                f"cannot write {named}: {why(problem)}; nothing was written, make room or name another place."
            ) from problem
        if not ours:
            raise
        in_the_way = isinstance(problem, (FileExistsError, NotADirectoryError))
        reason = "a file is in the way" if in_the_way else why(problem)
        raise kind.error(f"cannot create the directory {named}: {reason}; name another place.") from problem


def _walk(folder: Path, empty_directories: bool = False) -> list[str]:
    """Relative paths of all files and links in a directory except the staging; on demand, empty directories too."""
    found: list[str] = []
    pending = [""]
    while pending:
        prefix = pending.pop()
        with os.scandir(folder / prefix) as entries:
            names = [(e.name, e.is_dir(follow_symlinks=False)) for e in entries if prefix or e.name != STAGING]
        if prefix and not names and empty_directories:
            found.append(prefix.rstrip("/"))
        pending += [f"{prefix}{name}/" for name, is_directory in names if is_directory]
        found += [f"{prefix}{name}" for name, is_directory in names if not is_directory]
    return sorted(found)


def _is_as_listed(folder: Path, name: str, files: Mapping[str, Sequence[Digest]]) -> bool:
    """Whether a file stands where it was written, with no link on the way, and holds what the manifest says."""
    path = folder / name
    if not _is_reached_plainly(folder, name) or not is_plain_file(path):
        return False
    size = path.lstat().st_size
    return any(size == digest.size for digest in files[name]) and _digest(path) in files[name]


def _parents(folder: Path, name: str) -> list[Path]:
    """Directories between `folder` and its file `name`, the outermost first."""
    return [folder / parent for parent in PurePosixPath(name).parents if parent != PurePosixPath()][::-1]


def _is_reached_plainly(folder: Path, name: str) -> bool:
    """Whether the directories between `folder` and its file `name` exist and none of them is a link."""
    return all(parent.is_dir() and not parent.is_symlink() for parent in _parents(folder, name))


def _make_plain_parents(folder: Path, name: str) -> None:
    """Make the directories between `folder` and its file `name`; FileExistsError if a link or a file is there."""
    for parent in _parents(folder, name):
        if not parent.is_dir() or parent.is_symlink():
            parent.mkdir()  # FileExistsError if something else is there


def _is_staging(path: Path) -> bool | None:
    """Whether a directory with the name of a staging directory is one: it holds a lock, or nothing; None if it is gone.

    Its owner may make or remove it meanwhile, and another process may make the next one. So it counts as foreign only
    if several checks in a row say so.
    """
    lock = path / _LOCK
    for _ in range(5):
        try:
            if path.is_symlink() or not stat.S_ISDIR(path.lstat().st_mode):
                return False
            names = os.listdir(path)
        except FileNotFoundError:
            return None
        if not names or (_LOCK in names and (is_plain_file(lock) or not os.path.lexists(lock))):
            return True
        time.sleep(0.002)
    return False


def _digest(path: Path) -> Digest:
    """Size and SHA-256 of a file; a file that was hashed before and has the same change time is not read again."""
    with path.open("rb") as stream:
        state = os.fstat(stream.fileno())
        key = (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
        known = _hashed.get(key)
        if known is not None:
            return known
        settled = time.time_ns() - state.st_ctime_ns > SETTLED_NS
        sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
        digest = Digest(stream.tell(), sha256)
    if settled and digest.size == state.st_size:
        if len(_hashed) >= MAX_HASHED:
            _hashed.clear()
        _hashed[key] = digest
    return digest


_hashed: dict[tuple[int, ...], Digest] = {}
"""Digests of files that this process has read, by device, inode, size, and times of modification and change."""
SETTLED_NS = 2_000_000_000
"""Nanoseconds since the last change of a file after which its digest is kept. A later change surely gets another time,
because the coarsest clocks of file systems tick every two seconds."""
MAX_HASHED = 10_000
"""Largest number of digests that are kept, so that memory is bounded; when there are more, all are forgotten, and the
files are read again when they are needed."""


def _manifest(kind: DirectoryKind, files: Mapping[str, Sequence[Digest]]) -> bytes:
    """The content of a manifest."""
    info = {"format": MANIFEST_FORMAT, "format_version": MANIFEST_VERSION, "of": kind.format, "files": files}
    return _json(info)


def _json(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=1, sort_keys=True) + "\n").encode()


def _parse_manifest(info: Any, kind: str) -> dict[str, list[Digest]]:
    """Return the files of a manifest of this kind; ValueError, TypeError, KeyError or AttributeError if it is none."""
    if not isinstance(info, dict) or info.get("format") != MANIFEST_FORMAT or info.get("of") != kind:
        raise ValueError(f"it does not state the format {MANIFEST_FORMAT!r} of a {kind!r}")
    if info.get("format_version") != MANIFEST_VERSION:
        raise ValueError(f"expected format version {MANIFEST_VERSION}, got {str(info.get('format_version'))[:40]}")
    return _parse_files(info["files"])


def _parse_files(files: Any) -> dict[str, list[Digest]]:
    parsed = {}
    for name, digests in files.items():
        parsed[_checked_name(name)] = [Digest(size, sha256) for size, sha256 in digests]
        for digest in parsed[name]:
            if type(digest.size) is not int or not re.fullmatch("[0-9a-f]{64}", digest.sha256):
                raise ValueError(f"expected size and SHA-256 of {name[:100]!r}")
    return parsed


def _checked_name(name: str) -> str:
    """Return `name` if it is a relative path that stays inside its directory; ValueError otherwise."""
    parts = PurePosixPath(name).parts
    plain = parts and not name.startswith("/") and ".." not in parts and PurePosixPath(name).as_posix() == name
    if not plain or "\0" in name or parts[0] == STAGING or name == ".":
        raise ValueError(f"expected a path inside the directory, got {name[:100]!r}")
    return name


def _move_to_free_place(source: Path, place: Path) -> None:
    """Move a file to a place where nothing is; FileExistsError if something is there after all."""
    try:
        os.link(source, place, follow_symlinks=False)
    except FileExistsError:
        if not os.path.samefile(source, place):  # the same file: a process was killed before `unlink`
            raise
    except OSError:  # a file system without hard links
        if os.path.lexists(place):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(place)) from None
        try:
            source.rename(place)
        except OSError as problem:
            if problem.errno != errno.EXDEV or not is_plain_file(source):
                raise
            replace_file(place, source.read_bytes())  # something is mounted below the target
            source.unlink()
        return
    source.unlink()


def _flush_tree(folder: Path) -> None:
    """Flush all files and directories of a directory to the disk."""
    for directory, _, names in os.walk(folder, topdown=False):
        for name in names:
            flush(Path(directory) / name)
        flush(Path(directory))


def _lock(staging: Path, seconds: float = 0.0) -> int | None:
    """Return an open handle with the lock of a staging directory; None if a living process keeps it that long.

    Return None if a living process holds the lock for all of `seconds`. Raise FileNotFoundError if the directory is
    removed meanwhile.
    """
    until = time.monotonic() + seconds
    while True:
        handle = os.open(staging / _LOCK, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            if fcntl is not None:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.stat(staging / _LOCK).st_ino == os.fstat(handle).st_ino:
                return handle
        except BlockingIOError:
            if time.monotonic() >= until:
                os.close(handle)
                return None
            time.sleep(0.02)
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # its holder still works, or has just removed it


def _is_claimed(target: Path) -> bool:
    """Whether a living process writes to a directory; this check creates no file."""
    path = target / STAGING / _LOCK
    if fcntl is None or not is_plain_file(path):
        return False
    try:
        handle = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False
