# SPDX-License-Identifier: Apache-2.0
"""TOML files of settings that name a scene: an experiment, a scan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from rangesim.errors import FileFormatError
from rangesim.files.bundled_scenes import scene_names
from rangesim.files.text_files import read_toml

T = TypeVar("T")


def load_settings(file: str | Path, expected: str, read: Callable[[Mapping[str, Any], Path], T]) -> T:
    """The settings of a TOML file; a relative `scene` counts from the file's directory.

    A scene that comes with the package is meant where its name is given and no file of that name is there.

    expected : what the file should be, for the message. read : frozen dataclass with a field `scene`, of the file's
    data and directory; its ValueError becomes FileFormatError.

    Raises
    ------
    FileFormatError
        The file is missing or no valid TOML, or `read` refuses its data; the message names the place.
    """
    file = Path(file)
    if not file.is_file():
        raise FileFormatError(f"{file} does not exist; expected {expected} (.toml).")
    try:
        settings: Any = read(read_toml(file), file.parent)
    except ValueError as error:
        raise FileFormatError(f"{file}: {error}") from error
    beside = file.parent / settings.scene
    comes_along = settings.scene in scene_names() and not beside.is_file()
    return settings if comes_along else replace(settings, scene=str(beside))  # type: ignore[no-any-return]
