# SPDX-License-Identifier: Apache-2.0
"""The scenes of a sweep: functions of parameters, of the package or of the user, and files."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcgraph.plumbing.python_files import module_of_file, place_of_failure
from rangesim.errors import FileFormatError
from rangesim.files.bundled_scenes import scene_file, scene_names
from rangesim.settings.config import brief, check_keys, nearest, shown

if TYPE_CHECKING:
    from collections.abc import Callable

    from rangesim.scene import Scene

OF_FILES = ("material", "unit_m")
"""Parameters of a scene that is a bare mesh, as of `rangesim.load_scene`."""


@dataclass(frozen=True)
class SceneSource:
    """A scene by its name and its parameters, as plain data.

    name : function of the package, FILE.py:NAME, path of a file, or name of a bundled scene.
    kind : "function" of the package, "own" function of the user, or "file".
    parameters : names of the parameters that it takes. values : those that are stated.
    """

    name: str
    kind: str
    parameters: tuple[str, ...]
    values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_of_package(self) -> bool:
        """Whether the scene comes from a function of the package, whose even light is 1 W/m2."""
        return self.kind == "function"

    def with_parameters(self, values: Mapping[str, Any]) -> SceneSource:
        """The scene with other values of some parameters; ValueError if it has no such parameter."""
        check_keys(values, self.parameters, f"scene {self.name!r}")
        return replace(self, values={**self.values, **values})

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which another process makes the scene. A checksum tells whether a file has changed."""
        data = {"name": self.name, "kind": self.kind, "values": dict(sorted(self.values.items()))}
        if self.kind != "function":
            path = Path(self.name.rpartition(":")[0]) if self.kind == "own" else scene_file(self.name)
            data["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        return data

    def load(self) -> Scene:
        """The scene, loaded.

        Raises
        ------
        ValueError, FileFormatError
            As `rangesim.load_scene`; or the function of the user fails. The message names file, line and error.
        """
        from rangesim.environment.backend import select_variant
        from rangesim.scene import load_scene

        if self.kind == "file":
            return load_scene(self.name, **self.values)
        select_variant(None)
        function = _function(self.name, self.kind)
        with _failures_of(Path(self.name.rpartition(":")[0])) if self.kind == "own" else nullcontext():
            return replace(load_scene(function(**self.values)), name=_short(self.name))


def scene_of_dict(data: Mapping[str, Any]) -> SceneSource:
    """The scene that `SceneSource.to_dict` describes."""
    return SceneSource(data["name"], data["kind"], tuple(data["values"]), data["values"])


def scene_source(given: Any, folder: Path | None) -> SceneSource:
    """The scene that settings name.

    Parameters
    ----------
    given : name, or a table with `name` and parameters. folder : folder that relative paths count from.

    Raises
    ------
    ValueError, FileFormatError
        There is no such scene, or no such parameter.
    """
    table = {"name": given} if isinstance(given, str) else given
    if not isinstance(table, Mapping) or not isinstance(table.get("name"), str):
        raise ValueError(f"expected scene as a name, or as a table with name and parameters, got {shown(given)}.")
    values = {key: value for key, value in table.items() if key != "name"}
    return _named(table["name"], folder or Path()).with_parameters(values)


def _named(name: str, folder: Path) -> SceneSource:
    file, is_own, function = name.rpartition(":")
    if is_own and file.endswith(".py"):
        path = str((folder / file).resolve())
        return SceneSource(f"{path}:{function}", "own", _parameters(_function(f"{path}:{function}", "own")))
    known = _functions()
    beside = folder / name
    if name in known and not beside.is_file():
        return SceneSource(name, "function", _parameters(known[name]))
    if not beside.is_file() and name not in scene_names():
        raise ValueError(
            f"expected a scene out of {', '.join((*known, *scene_names()))}, a file of a scene or a mesh, or "
            f"FILE.py:NAME, got {shown(name)}{nearest(name, (*known, *scene_names()))}."
        )
    return SceneSource(str(beside) if beside.is_file() else name, "file", OF_FILES)


def _functions() -> dict[str, Callable[..., Any]]:
    from rangesim.scene.parametric import PARAMETRIC

    return PARAMETRIC


def _function(name: str, kind: str) -> Callable[..., Any]:
    """A function of the package, or one of a file FILE.py:NAME."""
    if kind == "function":
        return _functions()[name]
    file, _, function = name.rpartition(":")
    if not Path(file).is_file():
        raise FileFormatError(f"{file} does not exist; expected a Python file with the function {function}.")
    with _failures_of(Path(file)):
        module = module_of_file(Path(file), "rangesim")
    made = getattr(module, function, None)
    if not callable(made):
        raise FileFormatError(f"expected a function {function} in {file}, got {shown(made)}.")
    return made  # type: ignore[no-any-return]


@contextmanager
def _failures_of(file: Path) -> Iterator[None]:
    """Raise FileFormatError, with file, line and error, if a file of the user fails or ends the process."""
    try:
        yield
    except (Exception, SystemExit) as error:
        raise FileFormatError(
            f"{place_of_failure(error) or file} fails: {type(error).__name__}: {brief(error)}"
        ) from error


def _parameters(function: Callable[..., Any]) -> tuple[str, ...]:
    return tuple(inspect.signature(function).parameters)


def _short(name: str) -> str:
    return name.rpartition(":")[2]
