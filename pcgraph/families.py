# SPDX-License-Identifier: Apache-2.0
"""Linkages and supervoxel methods by name: those of the package, those loaded since, and those in a user's files."""

from __future__ import annotations

import inspect
import re
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

from pcgraph.errors import PcgraphError
from pcgraph.plumbing.python_files import place_of_failure, run_python_file

_SEPARATOR = ".py:"
_HOMES = {"Linkage": "pcgraph.tree.linkage", "SupervoxelMethod": "pcgraph.supervoxels.method"}
"""The module of each family's base class. pcgraph's own members are in the same subpackage."""


def members(family: str) -> dict[str, type[Any]]:
    """Classes of a family by name, if they need no argument; `MumfordShahLinkage` is called mumford-shah.

    Parameters
    ----------
    family : "Linkage" or "SupervoxelMethod"
    """
    room = _HOMES[family].rpartition(".")[0]
    for module in iter_modules(import_module(room).__path__):
        import_module(f"{room}.{module.name}")  # a class is known once it is loaded
    waiting, found = [_base(family)], {}
    while waiting:
        kind = waiting.pop()
        waiting += kind.__subclasses__()
        needed = [p for p in inspect.signature(kind).parameters.values() if p.default is p.empty]
        if not inspect.isabstract(kind) and not needed:
            found[re.sub("(?<=.)([A-Z])", r"-\1", kind.__name__.removesuffix(family)).lower()] = kind
    return dict(sorted(found.items()))


def member(family: str, name: str) -> Any:
    """A member of a family: by its name, by an unambiguous beginning of the name, or as FILE.py:NAME.

    NAME is a class of the family, or an object of such a class, in a Python file. A relative FILE is relative to the
    current folder. Loading a file runs it, so only name files that you trust.

    Raises
    ------
    ValueError
        No member has that name.
    PcgraphError
        The file is missing or fails, or NAME is no member of the family.
    """
    if _SEPARATOR in name:
        path, _, attribute = name.rpartition(":")
        return _member_in(family, Path(path).resolve(), attribute)
    known = members(family)
    fitting = [name] if name in known else [one for one in known if name and one.startswith(name)]
    if len(fitting) != 1:
        raise ValueError(f"expected one of {', '.join(known)}, or FILE.py:NAME, got {ascii(name)[:100]}")
    return known[fitting[0]]()


def refusal(argument: str, family: str, given: object) -> str:
    """Message about an argument that is no member of its family: the classes there are, and one that may be meant."""
    known = members(family)
    own = {name: kind for name, kind in known.items() if kind.__module__.startswith("pcgraph.")}
    own = {name: kind for name, kind in own.items() if not kind.__module__.startswith("pcgraph.user_modules.")}
    classes = ", ".join(f"pcgraph.{kind.__name__}()" for kind in own.values())
    near = get_close_matches(given.lower(), own, 1) if isinstance(given, str) else []
    hint = f"; did you mean pcgraph.{own[near[0]].__name__}()?" if near else ""
    return f"expected a {argument} such as {classes}, got {ascii(given)[:100]}{hint}"


def _base(family: str) -> type[Any]:
    """The base class of a family."""
    base: type[Any] = getattr(import_module(_HOMES[family]), family)
    return base


def _member_in(family: str, path: Path, attribute: str) -> Any:
    base = _base(family)
    found = getattr(_module(path), attribute, None)
    if isinstance(found, type) and issubclass(found, base):
        try:
            found = found()
        except Exception as error:  # a user's class may raise anything
            raise PcgraphError(f"{path}: {attribute}: {type(error).__name__}: {_brief(error)}") from error
    if not isinstance(found, base):
        raise PcgraphError(f"{path}: expected {attribute} to be a {family} or a class of them, got {_brief(found)}")
    return found


def _module(path: Path) -> ModuleType:
    """The module of a Python file, which this runs."""
    if not path.is_file():
        raise PcgraphError(f"{path} does not exist; expected a Python file")
    try:
        return run_python_file(path, "pcgraph")
    except (Exception, SystemExit) as error:
        raise PcgraphError(
            f"{place_of_failure(error) or path} fails: {type(error).__name__}: {_brief(error)}"
        ) from error


def _brief(thing: object) -> str:
    """A short and printable form of an object, or a message, of a user's file."""
    return " ".join(ascii(str(thing))[1:-1].split())[:200]
