# SPDX-License-Identifier: Apache-2.0
"""JSON, TOML and XML files, read within the limits of their size and of their nesting.

The parsers of all three formats are recursive, and the parser of Mitsuba ends the process when the stack is full.
Therefore the depth is checked first.
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
"""Pattern of a TOML key of more than %d parts, such as a.b.c; parsing it takes quadratic time."""
_PARAMETER = re.compile(r"\$(\w+)")
"""Pattern of a parameter `$name` in a scene file."""


def read_text(path: str | Path) -> str:
    """Contents of a text file in UTF-8, without its byte-order mark.

    FileFormatError if the file is missing, too large or no text.
    """
    path = Path(path)
    check_file(path, FileFormatError)
    try:
        limits.check("text", path.stat().st_size, f"bytes in {path}", FileFormatError)
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is no text file.") from error
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}.") from error


def read_json(path: str | Path) -> Any:
    """Plain data of a JSON file; FileFormatError if it is missing, too large, nested too deep or no JSON."""
    text = read_text(path)
    try:
        data = json.loads(text)
    except RecursionError:
        raise _too_deep(path) from None
    except ValueError as error:  # also for a number with more digits than Python converts
        raise FileFormatError(f"{path} is no valid JSON: {brief(error)}.") from error
    if is_nested_deeper(data, limits.current().nesting):
        raise _too_deep(path)
    return data


def read_toml(path: str | Path) -> dict[str, Any]:
    """Plain data of a TOML file; FileFormatError if it is missing, too large, nested too deep or no TOML."""
    return parse_toml(read_text(path), path)


def parse_toml(text: str, path: str | Path) -> dict[str, Any]:
    """Plain data of the text of a TOML file; FileFormatError, which names the file, if it is nested too deep or no
    TOML."""
    deepest = limits.current().nesting
    if re.search(_LONG_KEY % deepest, text):
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
    """Whether plain data contains mappings or lists nested more than `levels` deep, or contains itself.

    Examples
    --------
    >>> is_nested_deeper({"a": [1, 2]}, levels=2), is_nested_deeper({"a": [1, 2]}, levels=1)
    (False, True)
    """
    layer = [data] if _is_container(data) else []
    for _ in range(levels):
        inner = (v for values in layer for v in (values.values() if isinstance(values, Mapping) else values))
        layer = list({id(v): v for v in inner if _is_container(v)}.values())  # each object once
        if not layer:
            return False
    return bool(layer)


def _is_container(value: Any) -> bool:
    return isinstance(value, (Mapping, list, tuple))


class SearchPaths(Protocol):
    """Folders in which the files named by an XML file are searched."""

    def resolve(self, name: str) -> Path:
        """Path of the file with a name; it need not exist."""

    def within(self, folder: str, beside: Path) -> SearchPaths:
        """Search paths with a folder before these ones, as `<path value="folder"/>` in the file `beside` states."""


def check_xml(path: str | Path, search: SearchPaths | None = None, ignored: tuple[str, ...] = ()) -> dict[str, str]:
    """Check an XML file and the files that it includes. Return arbitrary values for the parameters that nobody uses.

    These are the parameters (`$name`) without a default that occur only inside ignored elements. Mitsuba refuses a file
    in which a parameter has no value, even there.

    Parameters
    ----------
    search : search paths for the files that elements name with `filename="..."`. Existing ones must be plain files
        within the limits, and included files are checked like the file itself. None: file names are not followed.
    ignored : names of the elements whose contents are ignored.

    Raises
    ------
    FileFormatError
        The file is missing, too large, nested too deep or no XML, includes itself, or declares entities.
    """
    xml = _Xml(ignored)
    xml.read(Path(path), 0, (), search)
    return {name: value for name, value in xml.fillers.items() if name not in xml.needed | set(xml.defaults)}


class _Xml:
    """The check of an XML file together with the files that it includes."""

    def __init__(self, ignored: tuple[str, ...]) -> None:
        self.ignored = ignored
        self.size = 0
        self.defaults: dict[str, str] = {}
        self.open: list[str] = []  # elements that contain the current one
        self.fillers: dict[str, str] = {}  # values for parameters without a default inside ignored elements
        self.needed: set[str] = set()  # parameters without a default in other elements

    def read(self, path: Path, depth: int, within: tuple[Path, ...], search: SearchPaths | None) -> None:
        """Check a file that the files `within` include, `depth` levels deep.

        Search paths that it adds are valid only in this file and in those that it includes.
        """
        check_file(path, FileFormatError)
        real = path.resolve()  # used only to find rings: relative includes start from `path`
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
                if not os.path.exists(found):  # False for impossible names too; Mitsuba reports a missing file
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
        except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two for an unknown encoding
            raise FileFormatError(f"{path} is no valid XML: {brief(error)}.") from error

    def note_parameters(self, name: str, attributes: Mapping[str, str]) -> None:
        """Note the parameters of an element that have no default: as needed, or with a value if they are ignored."""
        missing = {match for text in attributes.values() for match in _PARAMETER.findall(text)} - set(self.defaults)
        if any(element in self.ignored for element in self.open):
            self.fillers |= dict.fromkeys(missing, "false" if name == "boolean" else "1")
        else:
            self.needed |= missing

    def filled(self, text: str) -> str:
        """The text of an attribute with the values of parameters that a `<default>` has set before."""
        return _PARAMETER.sub(lambda m: self.defaults.get(m[1], m[0]), text)


def _too_deep(path: str | Path) -> FileFormatError:
    most = limits.current().nesting
    return FileFormatError(
        f"expected at most {most} levels in {path}, got more; if this is meant, raise the limit with "
        f"{limits.VARIABLE}=nesting=N or rangesim.settings.limits.raised(nesting=N)."
    )
