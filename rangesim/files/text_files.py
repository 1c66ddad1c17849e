# SPDX-License-Identifier: Apache-2.0
"""JSON, TOML and XML files, read within the limits: their size, and how deep they nest.

Parsers of all three recurse, and Mitsuba's crashes the process where the stack ends. So depth is counted first.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol
from xml.parsers import expat

from pcgraph.plumbing.plain_files import check_file
from rangesim.errors import FileFormatError
from rangesim.settings import limits
from rangesim.settings.config import brief

_LONG_KEY = r"""(?<![\w-])(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){%d}"""
_PARAMETER = re.compile(r"\$(\w+)")


def read_text(path: str | Path) -> str:
    """Contents of a UTF-8 file; FileFormatError if it is missing, too large or no text."""
    path = Path(path)
    check_file(path, FileFormatError)
    try:
        limits.check("text", path.stat().st_size, f"bytes in {path}", FileFormatError)
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is no text file.") from error
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}.") from error


def read_json(path: str | Path) -> Any:
    """Contents of a JSON file; FileFormatError if it is missing, too large, nested too deep or no JSON."""
    text = read_text(path)
    try:
        data = json.loads(text)
    except RecursionError:
        raise _too_deep(path) from None
    except ValueError as error:  # also of a number of more digits than Python converts
        raise FileFormatError(f"{path} is no valid JSON: {brief(error)}.") from error
    if is_nested_deeper(data, limits.current().nesting):
        raise _too_deep(path)
    return data


def read_toml(path: str | Path) -> dict[str, Any]:
    """Contents of a TOML file; FileFormatError if it is missing, too large, nested too deep or no TOML."""
    text = read_text(path)
    deepest = limits.current().nesting
    if re.search(_LONG_KEY % deepest, text):  # a.b.c ... takes quadratic time
        raise _too_deep(path)
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise _too_deep(path) from None
    except ValueError as error:
        raise FileFormatError(f"{path} is no valid TOML: {brief(error)}.") from error
    if is_nested_deeper(data, deepest):
        raise _too_deep(path)
    return data


def is_nested_deeper(data: Any, levels: int) -> bool:
    """Whether plain data holds mappings or lists more than `levels` deep; also if it holds itself."""
    layer = [data] if _is_container(data) else []
    for _ in range(levels):
        inner = (v for values in layer for v in (values.values() if isinstance(values, Mapping) else values))
        layer = list({id(v): v for v in inner if _is_container(v)}.values())  # a thing that is used often counts once
        if not layer:
            return False
    return bool(layer)


def _is_container(value: Any) -> bool:
    return isinstance(value, (Mapping, list, tuple))


class SearchPaths(Protocol):
    """Folders in which the files lie that an XML file names."""

    def resolve(self, name: str) -> Path:
        """Path of the file of a name, which may be missing."""

    def within(self, folder: str, beside: Path) -> SearchPaths:
        """Paths with a folder before those so far, as `<path value="folder"/>` in the file `beside` asks for."""


def check_xml(path: str | Path, search: SearchPaths | None = None, ignored: tuple[str, ...] = ()) -> dict[str, str]:
    """Values for the parameters (`$name`) without a default that stand inside elements which are ignored alone.

    search : finds the files that `filename="..."` of an element names. Those that are there have to be plain files
        within the limits; one that an `<include>` names is checked in its place. None: names of files mean nothing.
    ignored : names of elements whose contents do not matter.

    Raises
    ------
    FileFormatError
        The file is missing, too large, nested too deep, no XML, or declares entities.
    """
    xml = _Xml(ignored)
    xml.read(Path(path), 0, (), search)
    return {name: value for name, value in xml.fillers.items() if name not in xml.needed | set(xml.defaults)}


class _Xml:
    """Depth and size of an XML file with what it includes."""

    def __init__(self, ignored: tuple[str, ...]) -> None:
        self.ignored = ignored
        self.size = 0
        self.defaults: dict[str, str] = {}
        self.open: list[str] = []  # elements around the present place
        self.fillers: dict[str, str] = {}  # for parameters without a default inside ignored elements
        self.needed: set[str] = set()  # parameters without a default elsewhere

    def read(self, path: Path, depth: int, within: tuple[Path, ...], search: SearchPaths | None) -> None:
        """Check a file that stands `depth` levels deep inside the files `within`; paths that it adds are its own."""
        check_file(path, FileFormatError)
        real = path.resolve()  # what it includes lies beside it by its name, though
        if real in within:
            raise FileFormatError(f"{path} includes itself.")
        try:
            self.size += path.stat().st_size
            limits.check("text", self.size, f"bytes in {path} and what it includes", FileFormatError)
            data = path.read_bytes()
        except OSError as error:
            raise FileFormatError(f"cannot read {path}: {error.strerror or error}.") from error
        deepest = limits.current().nesting
        level = depth

        def start(name: str, attributes: dict[str, str]) -> None:
            nonlocal level, search
            level += 1
            if level > deepest:
                raise _too_deep(path)
            self.open.append(name)
            self.note_parameters(name, attributes)
            if name == "default" and "name" in attributes:
                self.defaults.setdefault(attributes["name"], attributes.get("value", ""))
            if search is None:
                return
            if name == "path" and "value" in attributes:
                search = search.within(self.filled(attributes["value"]), path)
            if "filename" in attributes:
                named = self.filled(attributes["filename"])
                beside = path.parent / named
                found = beside if name == "include" and os.path.exists(beside) else search.resolve(named)
                if not os.path.exists(found):  # also of names that cannot be; whoever reads it says so
                    return
                check_file(found, FileFormatError)
                limits.check("text", found.stat().st_size, f"bytes in {found}", FileFormatError)
                if name == "include":
                    self.read(found, level, (*within, real), search)

        def end(_: str) -> None:
            nonlocal level
            level -= 1
            self.open.pop()

        def entity(name: str, *_: Any) -> None:
            raise FileFormatError(f"expected no entities in {path}, got {name[:40]!r}.")

        parser = expat.ParserCreate()
        parser.StartElementHandler, parser.EndElementHandler, parser.EntityDeclHandler = start, end, entity
        try:
            parser.Parse(data, True)
        except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two: of an unknown encoding
            raise FileFormatError(f"{path} is no valid XML: {brief(error)}.") from error

    def note_parameters(self, name: str, attributes: Mapping[str, str]) -> None:
        """Keep the parameters of an element that have no default yet: a value where it is ignored, else the name."""
        missing = {match for text in attributes.values() for match in _PARAMETER.findall(text)} - set(self.defaults)
        if any(element in self.ignored for element in self.open):
            self.fillers |= dict.fromkeys(missing, "false" if name == "boolean" else "1")
        else:
            self.needed |= missing

    def filled(self, text: str) -> str:
        """An attribute with the parameters put in that `<default>` has named before."""
        return _PARAMETER.sub(lambda m: self.defaults.get(m[1], m[0]), text)


def _too_deep(path: str | Path) -> FileFormatError:
    most = limits.current().nesting
    return FileFormatError(
        f"expected at most {most} levels in {path}, got more; if this is meant, raise the limit with "
        f"{limits.VARIABLE}=nesting=N or rangesim.settings.limits.raised(nesting=N)."
    )
