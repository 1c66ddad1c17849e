# SPDX-License-Identifier: Apache-2.0
"""TOML files of settings that name a scene: those of experiments and of scans."""

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
    """The settings in a TOML file, with the path of their scene relative to the current directory.

    In the file, the path of the scene is relative to the file's directory. If no such file exists, it may be the name
    of a scene that comes with the package.

    Parameters
    ----------
    expected : name for this kind of file, for the message.
    read : function that makes the settings, a frozen dataclass with a field `scene`, from the data of the file and its
        directory. A ValueError that it raises becomes a FileFormatError.

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
