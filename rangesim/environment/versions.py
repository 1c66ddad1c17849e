# SPDX-License-Identifier: Apache-2.0
"""Versions of everything that the bytes of a result may depend on."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("rangesim", "mitsuba", "drjit", "numpy", "scipy", "numba", "open3d")
"""Packages whose versions a result records, because the bytes of its files may depend on them."""
SOURCES = ("rangesim", "pcgraph")
"""Packages of this distribution."""


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of `PACKAGES`; "not installed" for those that are missing.

    Examples
    --------
    >>> sorted(versions())[:3]
    ['drjit', 'mitsuba', 'numba']
    """
    return {"python": platform.python_version(), **{package: _version(package) for package in PACKAGES}}


@cache
def source_digest() -> str:
    """SHA-256 of all Python files of this distribution, by their paths and contents."""
    root = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for path in sorted(path for package in SOURCES for path in (root / package).rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _version(package: str) -> str:
    """Version of a package, or of its build for the CPU only, such as open3d-cpu."""
    for name in (package, f"{package}-cpu"):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "not installed"
