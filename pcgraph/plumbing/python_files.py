# SPDX-License-Identifier: Apache-2.0
"""A Python file of somebody's, run as a module; it finds the files beside it, as with `python FILE.py`."""

from __future__ import annotations

import importlib
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from zlib import crc32

_NEIGHBOURS: dict[Path, dict[str, ModuleType]] = {}
"""Modules that files of a folder imported from there, by their names."""
_CHANGED: dict[Path, int] = {}
"""When files of neighbours were last changed, as they were imported."""


def run_python_file(path: Path, package: str) -> ModuleType:
    """The module of a Python file, which runs, under a name of its own that tells the package that asked for it.

    Imports find the folder of the file first; later ones, inside its functions, last. A name that files of two folders
    use for a neighbour is for each that of its own folder, as long as it runs.

    Raises
    ------
    BaseException
        What the file raises; it is no module then, nor is what it imported from its folder.
    """
    name = f"_{package}_file_{path.stem}_{crc32(bytes(path)):x}"
    spec = spec_from_file_location(name, path)
    assert spec is not None, path  # a .py file has one
    assert spec.loader is not None, path
    module = module_from_spec(spec)
    folder = path.parent.absolute()
    _take_out_neighbours(folder)
    before = set(sys.modules)
    sys.modules[name] = module  # dataclasses look their own module up
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()  # for files written since
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
    return module


def _take_out_neighbours(folder: Path) -> None:
    """Leave those modules that files imported from `folder`, unless one changed, and none from other folders."""
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
    """Modules and packages beside each other in `folder`, and theirs, unless they or their package were there before.

    What is installed below the folder, such as in an environment there, is not beside the file.
    """
    found = {}
    for name, module in list(sys.modules.items()):
        top = name.partition(".")[0]
        if top not in before and name not in before and _is_beside(folder, top, module):
            found[name] = module
    return found


def _is_beside(folder: Path, top: str, module: ModuleType) -> bool:
    """Whether a module is of the file or package `top` in the folder itself."""
    places = [file] if (file := getattr(module, "__file__", None)) else list(getattr(module, "__path__", ()))
    for place in places:
        path = Path(place).absolute()
        if folder in path.parents:
            first = path.relative_to(folder).parts[0]
            return first == top or first.partition(".")[0] == top
    return False
