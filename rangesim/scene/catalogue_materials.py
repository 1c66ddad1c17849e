# SPDX-License-Identifier: Apache-2.0
"""Materials of the catalogue as Mitsuba dictionaries, for scenes that are made in Python."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import Any

from rangesim.files.bundled_scenes import CATALOGUE
from rangesim.settings.config import nearest, shown


def material_names() -> tuple[str, ...]:
    """Names of the materials that come with the package, in alphabetical order (docs/materials.md).

    Examples
    --------
    >>> "brushed_steel" in material_names()
    True
    """
    return tuple(sorted(path.stem for path in (CATALOGUE / "materials").glob("*.xml")))


def catalogue_material(name: str) -> dict[str, Any]:
    """The BSDF of a material of the catalogue, as a Mitsuba dictionary for `load_scene`.

    Raises
    ------
    ValueError
        There is no such material; the message names the nearest one.

    Examples
    --------
    >>> catalogue_material("silver")["bsdf_0"]["type"]
    'conductor'
    """
    if name not in material_names():
        raise ValueError(
            f"expected a material of the catalogue (docs/materials.md), got {shown(name)}"
            f"{nearest(name, material_names())}."
        )
    root = ElementTree.parse(CATALOGUE / "materials" / f"{name}.xml").getroot()  # a file of this package
    (bsdf,) = root.findall("bsdf")
    return _node(bsdf)


def _node(element: ElementTree.Element) -> dict[str, Any]:
    """A plugin of a scene file as a dictionary. Plugins without a name are numbered, as Mitsuba does."""
    made: dict[str, Any] = {"type": element.get("type")}
    for number, child in enumerate(element):
        name, value = child.get("name") or f"{child.tag}_{number}", child.get("value", "")
        if child.tag in ("bsdf", "texture"):
            made[name] = _node(child)
        elif child.tag in ("float", "spectrum"):
            made[name] = float(value)
        elif child.tag == "integer":
            made[name] = int(value)
        elif child.tag == "boolean":
            made[name] = value == "true"
        elif child.tag == "string":
            made[name] = value
        else:
            raise ValueError(f"expected numbers, texts and plugins in a material, got <{child.tag}>.")
    return made
