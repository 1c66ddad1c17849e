# SPDX-License-Identifier: Apache-2.0
"""What a file has to be before anybody reads it."""

from __future__ import annotations

from pathlib import Path


def check_file(path: str | Path, error: type[Exception]) -> None:
    """Raise `error` unless `path` is a plain file or a link to one: pipes would be waited for, devices never end."""
    path = Path(path)
    try:
        if path.is_file():
            return
        reason = "it is no plain file" if path.exists() else "No such file or directory"
    except (OSError, ValueError) as problem:  # a loop of links; a name that cannot be
        reason = getattr(problem, "strerror", None) or str(problem)
    raise error(f"cannot read {path}: {reason}.")


def read_file(path: str | Path, error: type[Exception]) -> bytes:
    """Contents of a plain file; `error` if it is none, cannot be read, or does not fit into memory."""
    check_file(path, error)
    try:
        return Path(path).read_bytes()
    except OSError as problem:
        raise error(f"cannot read {path}: {problem.strerror or problem}.") from problem
    except MemoryError:
        raise error(f"cannot read {path}: it does not fit into memory.") from None
