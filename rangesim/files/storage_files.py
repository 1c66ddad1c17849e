# SPDX-License-Identifier: Apache-2.0
"""Plain data of the files in which calibrations are kept: XML and YAML as OpenCV's FileStorage writes them, and JSON.

Of YAML this reads what OpenCV, ROS and PyYAML write for tables of numbers: maps by indentation, lists in brackets or
with hyphens, numbers and text. Anchors, several documents and text of several lines are refused.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from rangesim.errors import FileFormatError
from rangesim.files.text_files import check_xml, is_nested_deeper, read_json, read_text
from rangesim.settings import limits
from rangesim.settings.config import shown

SUFFIXES = (".xml", ".yml", ".yaml", ".json")
"""Suffixes of the files that `read_storage` reads."""
MAX_CHARACTERS = 1_000_000
"""Largest size of a file, in characters. A calibration has about 2000; the limit keeps the time of reading short."""
_TAG = re.compile(r"!+[\w:./,-]+\s*")
"""A tag of YAML, such as !!opencv-matrix, which says nothing that the data do not say."""
_ENTRY = re.compile(r"""(?:"([^"]*)"|'([^']*)'|([^\s:'"\[\]{}#,&*!|>%@`-][^:\[\]{}#]*?))\s*:(?=\s|$)\s*(.*)""")
"""A line `key: value` of YAML."""
_FLOW = re.compile(r"""\s*(?:([\[\]{},:])|"([^"]*)"|'([^']*)'|([^\s\[\]{},:"']+))""")
"""A token of a YAML list or map in brackets."""
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?\.?")
"""A number; OpenCV writes `1.` for whole ones."""
_NO_NUMBER = {".inf": "inf", "-.inf": "-inf", "+.inf": "inf", ".nan": "nan"}
"""What YAML calls numbers that are not finite."""


def read_storage(path: str | Path) -> dict[str, Any]:
    """Maps, lists, numbers and text of an XML, YAML or JSON file.

    A matrix of OpenCV is a map with `rows`, `cols`, `dt` and `data`; of XML, `data` is a text of numbers.

    Raises
    ------
    FileFormatError
        The file is missing or broken, has another suffix, or holds no map.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise FileFormatError(f"expected a file that ends in {', '.join(SUFFIXES)}, got {path.name!r}.")
    if suffix == ".xml":
        check_xml(path)
        if path.stat().st_size > MAX_CHARACTERS:
            raise _too_large(path)
        data = _of_element(ET.parse(path).getroot()) or {}
    else:
        text = read_text(path)
        if len(text) > MAX_CHARACTERS:
            raise _too_large(path)
        if suffix == ".json":
            data = read_json(path)
        else:
            try:
                data = _Yaml(text).read()
            except RecursionError:
                raise _too_deep(path) from None
            except ValueError as error:
                raise FileFormatError(f"{path}: expected YAML as OpenCV writes it, got {error}.") from error
        if is_nested_deeper(data, limits.current().nesting):
            raise _too_deep(path)
    if not isinstance(data, dict):
        raise FileFormatError(f"{path}: expected a table with names, as of a calibration, got {shown(data)}.")
    return data


def _too_large(path: Path) -> FileFormatError:
    return FileFormatError(f"{path}: expected at most {MAX_CHARACTERS} bytes, as a calibration has, got more.")


def _too_deep(path: Path) -> FileFormatError:
    most = limits.current().nesting
    return FileFormatError(
        f"{path}: expected at most {most} levels of lists and tables, as a calibration has, got more."
    )


def _of_element(element: ET.Element) -> Any:
    """The data of an XML element: the text of one without children; `_` children are a list, as OpenCV writes it."""
    children = list(element)
    if not children:
        return (element.text or "").strip()
    if all(child.tag == "_" for child in children):
        return [_of_element(child) for child in children]
    return {child.tag: _of_element(child) for child in children}


class _Yaml:
    """The reader of a YAML text. Its methods raise ValueError with a noun phrase: what came instead of such a text."""

    def __init__(self, text: str) -> None:
        self.lines: list[tuple[int, str]] = []  # indentation and text of each line that says something
        for number, line in enumerate(text.split("\n")):
            bare = line.strip()
            if bare == "..." or (bare == "---" and self.lines):
                break
            if not bare or bare[0] in "#%" or bare == "---":
                continue
            if "\t" in line[: len(line) - len(line.lstrip())]:
                raise ValueError(f"line {number + 1}, which is indented by tabs: indent it by blanks")
            self.lines.append((len(line) - len(line.lstrip(" ")), bare))
        self.at = 0

    def read(self) -> Any:
        data = self._block(0) if self.lines else None
        if self.at < len(self.lines):
            raise ValueError(
                f"{shown(self.lines[self.at][1])}, which belongs to no entry above it: check how it is indented"
            )
        return data

    def _block(self, least: int) -> Any:
        """The map, list or value that begins at the current line, which is indented by at least `least`."""
        indent, line = self.lines[self.at]
        if indent < least:
            return None
        if f"{line} ".startswith("- "):
            return self._list(indent)
        return self._map(indent) if _ENTRY.fullmatch(line) else self._value(line, indent)

    def _list(self, indent: int) -> list[Any]:
        result = []
        while self.at < len(self.lines) and self.lines[self.at][0] == indent:
            line = self.lines[self.at][1]
            if not f"{line} ".startswith("- "):
                break
            rest = line[1:].lstrip()
            if rest:  # what follows the hyphen is a block, as far in as it stands
                self.lines[self.at] = (indent + len(line) - len(rest), rest)
            else:
                self.at += 1
            result.append(self._block(indent + 1) if self.at < len(self.lines) else None)
        return result

    def _map(self, indent: int) -> dict[str, Any]:
        result: dict[str, Any] = {}
        while self.at < len(self.lines) and self.lines[self.at][0] == indent:
            entry = _ENTRY.fullmatch(self.lines[self.at][1])
            if entry is None:
                break
            name, rest = next(part for part in entry.groups()[:3] if part is not None), _TAG.sub("", entry[4], count=1)
            if name in result:
                raise ValueError(f"{shown(name)} twice in one table: leave one of them out")
            if rest and not rest.startswith("#"):
                result[name] = self._value(rest, indent)
                continue
            self.at += 1
            is_list = self.at < len(self.lines) and f"{self.lines[self.at][1]} ".startswith("- ")
            least = indent if is_list else indent + 1  # PyYAML does not indent the lists of a map
            result[name] = self._block(least) if self.at < len(self.lines) else None
        return result

    def _value(self, text: str, indent: int) -> Any:
        """The value that begins with `text` in the current line; a list in brackets may go on in later lines."""
        self.at += 1
        if text[0] not in "[{":
            return _scalar(text.split(" #")[0].strip())
        parts = [text]
        while sum(part.count(mark) for part in parts for mark in "[{") > sum(
            part.count(mark) for part in parts for mark in "]}"
        ):
            if self.at == len(self.lines):
                raise ValueError("a list in brackets without its end")
            parts.append(self.lines[self.at][1])
            self.at += 1
        return _flow(" ".join(parts))


def _flow(text: str) -> Any:
    """The list or map of a text in brackets."""
    tokens = [match.groups() for match in _FLOW.finditer(text)]
    place = 0

    def value() -> Any:
        nonlocal place
        mark, *words = tokens[place] if place < len(tokens) else ("", None, None, None)
        place += 1
        if mark == "[":
            items = []
            while not ends("]"):
                items.append(value())
                comma("]")
            return items
        if mark == "{":
            table: dict[str, Any] = {}
            while not ends("}"):
                name = value()
                if not ends(":"):
                    raise ValueError("an entry without value in a map in brackets")
                table[str(name)] = value()
                comma("}")
            return table
        if mark:
            raise ValueError(f"{mark!r} where a value should be")
        if mark == "":
            raise ValueError("a list in brackets without its end")
        quoted = next((word for word in words[:2] if word is not None), None)
        return _scalar(str(words[2])) if quoted is None else quoted

    def ends(mark: str) -> bool:
        nonlocal place
        is_there = place < len(tokens) and tokens[place][0] == mark
        place += is_there
        return is_there

    def comma(end: str) -> None:
        if not ends(",") and not (place < len(tokens) and tokens[place][0] == end):
            raise ValueError("a list in brackets without a comma or its end")

    return value()


def _scalar(text: str) -> Any:
    """The number that a text stands for; the text itself, without quotes, if it is none."""
    if _NUMBER.fullmatch(text) and len(text) < 400:
        return int(text) if text.lstrip("+-").isdigit() else float(text.removesuffix(".") or "0")
    if text.lower() in _NO_NUMBER:
        return float(_NO_NUMBER[text.lower()])
    if text[:1] in "&*|>`@":
        raise ValueError(f"{shown(text)}, a reference or a block of text: write plain numbers, lists and tables")
    return text[1:-1] if len(text) > 1 and text[0] == text[-1] and text[0] in "\"'" else text
