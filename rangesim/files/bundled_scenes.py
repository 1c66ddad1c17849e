# SPDX-License-Identifier: Apache-2.0
"""The scenes and materials that come with the package, and the files that scene names stand for."""

from __future__ import annotations

from pathlib import Path

from rangesim.errors import FileFormatError

_INSTALLED = Path(__file__).resolve().parents[1] / "scene" / "catalogue"
"""Directory of the scenes in an installed package."""
CATALOGUE = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parents[2] / "scenes"
"""Directory of the scenes and of `materials/`: inside an installed package, or `scenes` in a checkout."""


def scene_names() -> tuple[str, ...]:
    """Names of the scenes that come with the package, in alphabetical order.

    Examples
    --------
    >>> "tabletop" in scene_names()
    True
    """
    return tuple(sorted(path.stem for path in CATALOGUE.glob("*.xml")))


def scene_file(source: str | Path) -> Path:
    """Path of a scene or mesh file: `source` itself if it is a file, else the bundled scene of that name.

    Raises
    ------
    FileFormatError
        `source` is neither; the message lists the names.
    """
    from rangesim.settings.config import nearest  # imports NumPy, which the help of the command line does not need

    path, names = Path(source), scene_names()
    if path.is_file():
        return path
    if str(source) in names:
        return CATALOGUE / f"{source}.xml"
    missing = f"expected a scene or mesh file, but {path} does not exist"
    if path.stem in names:
        missing += f"; the scene that comes with rangesim is named {path.stem}, without folder and suffix"
    elif path.suffix == "" and len(path.parts) == 1:
        missing += f", and no scene of that name comes with rangesim{nearest(path.name, names)}; those are "
        missing += ", ".join(names)
    raise FileFormatError(f"{missing}.")
