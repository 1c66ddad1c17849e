# SPDX-License-Identifier: Apache-2.0
"""Materials of the catalogue as entries of a scene dictionary, with some of their parameters replaced."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree

from rangesim.files.bundled_scenes import CATALOGUE
from rangesim.settings.config import nearest, shown

_NUMBERS = ("float", "spectrum", "integer")
"""Tags of the catalogue's files that hold one number."""


@lru_cache(maxsize=1)
def material_names() -> tuple[str, ...]:
    """Names of the materials in the catalogue, in alphabetical order.

    Examples
    --------
    >>> {"steel", "bk7", "white_paper"} <= set(material_names())
    True
    """
    return tuple(sorted(path.stem for path in (CATALOGUE / "materials").glob("*.xml")))


def check_material(name: str, place: str = "a material") -> None:
    """Raise ValueError if the catalogue has no material of that name; `place` says what states it."""
    if name not in material_names():
        raise ValueError(
            f"expected {place} to be in the catalogue (docs/materials.md), got {shown(name)}"
            f"{nearest(name, material_names())}."
        )


def surface(name: str, parameters: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Entries of a shape in a scene dictionary that give it a material: `bsdf`, and `interior` if it absorbs.

    parameters : values that replace those of the BSDF or the medium, wherever they stand in it.

    Raises
    ------
    ValueError
        No such material, or it has no such parameter.

    Examples
    --------
    >>> surface("white_paper", {"reflectance": 0.7})["bsdf"]["bsdf"]
    {'type': 'diffuse', 'reflectance': 0.7}
    """
    check_material(name)
    entries = copy.deepcopy(_entries(name))
    tables = list(_tables(entries))
    for key, value in (parameters or {}).items():
        holders = [table for table in tables if isinstance(table.get(key), float)]
        if not holders:
            valid = sorted({k for table in tables for k, v in table.items() if isinstance(v, float)})
            raise ValueError(
                f"expected a parameter of {name} out of {', '.join(valid)}, got {shown(key)}{nearest(key, valid)}."
            )
        for table in holders:
            table[key] = float(value)
    return entries


@lru_cache(maxsize=128)  # the files of the catalogue do not change
def _entries(name: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for node in ElementTree.parse(CATALOGUE / "materials" / f"{name}.xml").getroot():
        found["bsdf" if node.tag == "bsdf" else "interior"] = _table(node)
    return found


def _table(node: ElementTree.Element) -> dict[str, Any]:
    """The dictionary of an object in a scene file."""
    table: dict[str, Any] = {"type": node.attrib["type"]}
    for number, child in enumerate(node):
        key, value = child.attrib.get("name", f"{child.tag}_{number}"), child.attrib.get("value", "")
        if child.tag in _NUMBERS:
            table[key] = float(value)
        elif child.tag == "string":
            table[key] = value
        elif child.tag == "boolean":
            table[key] = value == "true"
        else:
            table["bsdf" if node.attrib["type"] == "twosided" else key] = _table(child)
    return table


def _tables(entries: dict[str, Any]) -> list[dict[str, Any]]:
    inner = [table for value in entries.values() if isinstance(value, dict) for table in _tables(value)]
    return [entries, *inner]
