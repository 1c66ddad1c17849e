# SPDX-License-Identifier: Apache-2.0
"""Files and directories that appear when they are complete, and never half-written."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rangesim.errors import FileFormatError


@contextmanager
def new_directory(directory: str | Path, sidecar: str, kind: str) -> Iterator[Path]:
    """A directory to fill, beside `directory`; takes its place when the block ends well, vanishes if it fails.

    Parameters
    ----------
    directory : an older one of the same kind is replaced.
    sidecar, kind : name of a JSON file and the `format` it states, by which a directory of ours is known.

    Raises
    ------
    FileFormatError
        `directory` exists and is neither empty nor of this kind, or no directory can be made there.
    """
    target = Path(directory)
    missing: list[Path] = []
    try:
        _check(target, sidecar, kind)
        missing = [parent for parent in target.absolute().parents if not parent.exists()]
        target.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        _remove_empty(missing)
        in_the_way = isinstance(error, (FileExistsError, NotADirectoryError))
        reason = "a file is in the way" if in_the_way else error.strerror or str(error)
        raise FileFormatError(f"cannot create the directory {target}: {reason}; name another place.") from error
    done = False
    try:
        inside = staging / "new"
        inside.mkdir()
        yield inside
        if target.exists():
            target.rename(staging / "old")
        inside.rename(target)
        done = True
    finally:
        if not done and (staging / "old").exists():
            (staging / "old").rename(target)
        shutil.rmtree(staging, ignore_errors=True)
        if not done:
            _remove_empty(missing)


def write_file(path: Path, data: bytes) -> None:
    """Write `path`, making its directories; a reader finds the old content or the new, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, staging = tempfile.mkstemp(prefix=f".{path.name}-", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(staging, 0o644)
        os.replace(staging, path)
    finally:
        Path(staging).unlink(missing_ok=True)


def read_sidecar(path: Path, kind: str) -> dict[str, Any]:
    """Contents of a JSON file that states `format` as `kind`; FileFormatError if it is missing or another."""
    if not path.is_file():
        raise FileFormatError(f"{path.parent} is no {kind} directory: it has no {path.name}.")
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise FileFormatError(f"{path} is no valid JSON: {error}.") from error
    if not isinstance(info, dict) or info.get("format") != kind:
        raise FileFormatError(f"{path} is no {kind} file.")
    return info


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write plain data, indented."""
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _remove_empty(directories: list[Path]) -> None:
    """Remove directories, the innermost first, up to the first that cannot go."""
    with suppress(OSError):  # never made, or somebody else put something there meanwhile
        for directory in directories:
            directory.rmdir()


def _check(target: Path, sidecar: str, kind: str) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise FileFormatError(f"{target} exists and is no directory; name another place.")
    if any(target.iterdir()):
        try:
            read_sidecar(target / sidecar, kind)
        except FileFormatError as error:
            raise FileFormatError(
                f"{target} exists and holds something else than a {kind}; nothing was written, name another place."
            ) from error
