# SPDX-License-Identifier: Apache-2.0
"""Running a user's Python file as a module, which can import the files beside it, as with `python FILE.py`.

A file that PACKAGE runs becomes the module PACKAGE.user_modules.NAME, where NAME spells out the path of the file. So
objects of the file's classes can be pickled: another process imports that module, which runs the file.
"""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec, spec_from_file_location, spec_from_loader
from pathlib import Path
from types import ModuleType

_NEIGHBOURS: dict[Path, dict[str, ModuleType]] = {}
"""Modules, by their names, that files of each folder imported from that folder."""
_CHANGED: dict[Path, int] = {}
"""Times of the last change of neighbours' files, nanoseconds, when they were imported."""


_RUN: dict[str, tuple[ModuleType, int]] = {}
"""Modules of files that ran, by name, and the time of the file's last change then, nanoseconds."""


def module_of_file(path: Path, package: str) -> ModuleType:
    """The module of a Python file, which runs once, and again after a change; errors as of `run_python_file`."""
    name, changed = _name_of(path, package), path.stat().st_mtime_ns
    module, ran = _RUN.get(name, (None, None))
    return module if module is not None and ran == changed else run_python_file(path, package)


def run_python_file(path: Path, package: str) -> ModuleType:
    """The module of a Python file, which this runs for a package.

    Imports of the file search the file's folder first; later imports, inside its functions, search it last. If files of
    two folders use one name for a neighbour, each finds the one in its own folder, as long as it runs.

    Raises
    ------
    BaseException
        Any exception of the file. Then neither the file nor its imports from its folder stay modules.
    """
    importlib.import_module(f"{package}.user_modules")  # the module's package
    name, changed = _name_of(path, package), path.stat().st_mtime_ns
    spec = spec_from_file_location(name, path)
    assert spec is not None, path  # a .py file has one
    assert spec.loader is not None, path
    module = module_from_spec(spec)
    folder = path.parent.absolute()
    _take_out_neighbours(folder)
    before = set(sys.modules)
    sys.modules[name] = module  # dataclasses look up their own module
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()  # files may be new
    try:
        spec.loader.exec_module(module)
    except BaseException:
        for new in {name, *_imported_from(folder, before)}:
            sys.modules.pop(new, None)
        raise
    finally:
        sys.path.remove(str(folder))
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
    for new, neighbour in _imported_from(folder, before - set(_NEIGHBOURS.get(folder, ()))).items():
        _NEIGHBOURS.setdefault(folder, {})[new] = neighbour
        if neighbour.__file__:
            _CHANGED[Path(neighbour.__file__)] = Path(neighbour.__file__).stat().st_mtime_ns
    _RUN[name] = module, changed
    return module


def place_of_failure(error: BaseException) -> str:
    """Words that say where in a user's Python file an exception arose: "FILE.py, line 3,"; empty if it was in none."""
    steps = traceback.walk_tb(error.__traceback__)
    own = [
        f"{f.f_code.co_filename}, line {n}," for f, n in steps if ".user_modules.x" in f.f_globals.get("__name__", "")
    ]
    if not own and isinstance(error, SyntaxError):  # the file has not begun to run
        return f"{error.filename}, line {error.lineno},"
    return own[-1] if own else ""


def _name_of(path: Path, package: str) -> str:
    return f"{package}.user_modules.x{bytes(path.absolute()).hex()}"


class FileImporter(MetaPathFinder, Loader):
    """Importer of PACKAGE.user_modules.NAME, which runs the file whose path NAME spells out."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return spec_from_loader(fullname, self) if fullname.startswith(f"{self.package}.user_modules.x") else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        path = Path(bytes.fromhex(spec.name.rpartition(".x")[2]).decode(errors="surrogateescape"))
        if not path.is_file():
            raise ImportError(f"expected the Python file {path}, which defines what was pickled; it is not there.")
        return module_of_file(path, self.package)

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: the file has run."""


def _take_out_neighbours(folder: Path) -> None:
    """Remove modules that files imported from their folders, but keep those from `folder` if none has changed."""
    own = _NEIGHBOURS.get(folder, {})
    if any(_is_stale(Path(m.__file__)) for m in own.values() if m.__file__):
        _NEIGHBOURS.pop(folder)
    kept = _NEIGHBOURS.get(folder, {})
    for modules in (own, *_NEIGHBOURS.values()):
        for name, module in modules.items():
            if sys.modules.get(name) is module:
                del sys.modules[name]
    sys.modules.update(kept)


def _is_stale(file: Path) -> bool:
    return not file.is_file() or file.stat().st_mtime_ns != _CHANGED.get(file)


def _imported_from(folder: Path, before: set[str]) -> dict[str, ModuleType]:
    """New modules and packages in `folder`, and new modules of these packages; `before` are names of older modules.

    Modules installed below the folder, such as in an environment there, do not count.
    """
    found = {}
    for name, module in list(sys.modules.items()):
        top = name.partition(".")[0]
        if top not in before and name not in before and _is_beside(folder, top, module):
            found[name] = module
    return found


def _is_beside(folder: Path, top: str, module: ModuleType) -> bool:
    """Whether a module is the file or package `top` in the folder itself, or a part of it."""
    places = [file] if (file := getattr(module, "__file__", None)) else list(getattr(module, "__path__", ()))
    for place in places:
        path = Path(place).absolute()
        if folder in path.parents:
            first = path.relative_to(folder).parts[0]
            return first == top or first.partition(".")[0] == top
    return False
