# SPDX-License-Identifier: Apache-2.0
"""Nodes of a parsed scene: checked, completed and stripped of our own keys, before Mitsuba makes objects of them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import mitsuba as mi

from pcgraph.plumbing.plain_files import check_file
from rangesim.errors import FileFormatError
from rangesim.scene.materials import MATERIAL_CLASSES
from rangesim.settings import limits
from rangesim.settings.config import nearest, shown

CLASS_KEY = "material_class"
"""Property of a shape or BSDF that states its material class; Mitsuba does not know it."""
PART_KEY, OBJECT_KEY = "part_of", "is_object"
"""Properties of a shape that name the thing it is a part of, and state whether that is an object or background."""
COMPOSITES = ("instance", "shapegroup", "merge")
"""Shapes that stand for other shapes. They are refused, because the parts would have neither name nor material."""
OF_MITSUBA = Path(mi.__file__).resolve().parent
"""Directory in which Mitsuba is installed; its plugins are in the folder `plugins` there."""
IGNORED_PLUGINS = {"Integrator": "path", "Film": "hdrfilm", "Sampler": "independent", "ReconstructionFilter": "box"}
"""Kinds of nodes whose plugin is ignored, each with the plugin of Mitsuba that replaces an unknown one."""
FILM_SIZES = ("width", "height", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y")
"""Properties of a film that are used."""
_OBJECTS = ("Any", "Object", "Reference", "ResolvedReference")
"""Kinds of properties that hold other objects."""
_LIBRARIES = (".so", ".dylib", ".dll")
"""Suffixes of shared libraries on Linux, macOS and Windows."""
_PLAIN_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,99}")
"""Pattern of plugin names that are plain words and cannot contain a path."""


@lru_cache(maxsize=1)
def shipped_types() -> frozenset[str]:
    """Names of the plugins that come with Mitsuba."""
    return frozenset(path.stem for path in (OF_MITSUBA / "plugins").iterdir() if path.suffix in _LIBRARIES)


def check_type(name: str, label: str) -> None:
    """Raise FileFormatError on a plugin type for which Mitsuba would run a library that a scene brings along.

    Mitsuba loads `plugins/NAME.so` from the first search path that has it. Two kinds of types are accepted: plugins
    that come with Mitsuba, provided that `OF_MITSUBA` is the first search path; and plain names for which no search
    path has a library. A plugin of the second kind is registered in Python, or Mitsuba refuses it.
    """
    if name in shipped_types():
        return
    is_plain = _PLAIN_NAME.fullmatch(name) is not None
    if is_plain and not any(
        os.path.lexists(str(mi.file_resolver().resolve(f"plugins/{name}{suffix}"))) for suffix in _LIBRARIES
    ):
        return
    raise FileFormatError(
        f"{label}: expected types of plugins that come with Mitsuba or are registered in Python, got "
        f"{shown(name)}{nearest(name, shipped_types())}; a scene must not bring a library of its own."
    )


def named_file(name: str, label: str) -> Path:
    """Path of a file that the scene `label` names. The file may be missing; Mitsuba reports that.

    Raises
    ------
    FileFormatError
        The file is a pipe, a device or a directory, or larger than the limit `bytes`.
    """
    path = Path(str(mi.file_resolver().resolve(name)))
    if os.path.exists(path):  # False for impossible names too
        try:
            check_file(path, FileFormatError)
        except FileFormatError as error:
            raise FileFormatError(f"{label} names a file: {error}") from error
        limits.check("bytes", path.stat().st_size, f"bytes in {path}, which {label} names", FileFormatError)
    return path


def check_types(state: Any, label: str) -> None:
    """Raise FileFormatError on the first node whose type `check_type` refuses."""
    for name in dict.fromkeys(node.props.plugin_name() for node in state.nodes):
        if name:
            check_type(name, label)


def ids_of_shapes(state: Any, label: str) -> set[str]:
    """Ids of all shapes; a shape without an id gets a unique one first.

    Raises
    ------
    FileFormatError
        A shape is composite, or refers to a medium without saying whether it is inside or outside.
    """
    taken = {node.props.id() for node in state.nodes}
    ids = set()
    for index, node in _shapes(state):
        kind, name = node.props.plugin_name(), node.props.id()
        if kind in COMPOSITES:
            raise FileFormatError(
                f"{label}: shapes of type {kind!r} are not supported; replace them by copies of their shapes."
            )
        if not name or name.startswith("_arg_"):
            name = f"{kind}_{index}"
            while name in taken:
                name += "_"
            node.props.set_id(name)
            taken.add(name)
        _check_media(state, node, f"{label}: shape {name!r}")
        ids.add(name)
    return ids


def _check_media(state: Any, node: Any, place: str) -> None:
    """Raise FileFormatError if a shape has a medium under another name than interior or exterior.

    Mitsuba ignores such a medium.
    """
    for key, value in node.props.items():
        is_medium = (
            isinstance(value, mi.Properties.ResolvedReference)
            and state.nodes[value.index()].type == mi.ObjectType.Medium
        )
        if is_medium and key not in ("interior", "exterior"):
            raise FileFormatError(f'{place} refers to a medium without saying where: add name="interior".')


def check_camera(state: Any, node: Any, label: str) -> None:
    """Raise FileFormatError if a sensor stands in a medium, which the light transport does not support."""
    for _, value in node.props.items():
        is_medium = (
            isinstance(value, mi.Properties.ResolvedReference)
            and state.nodes[value.index()].type == mi.ObjectType.Medium
        )
        if is_medium or isinstance(value, mi.Medium):
            raise FileFormatError(
                f"{label}: expected the camera to stand in air, got a medium in its sensor; remove it, and let the "
                "medium fill a closed shape in front of the camera."
            )


def replace_ignored_plugins(state: Any) -> None:
    """Replace integrators, films, samplers and filters that Mitsuba does not have by some that it has.

    A scene of a renderer built on Mitsuba, such as mitransient, has such plugins. They are ignored anyway; only the
    size of the film is kept.
    """
    for node in state.nodes:
        own = IGNORED_PLUGINS.get(node.type.name)
        if own is None or node.props.plugin_name() in shipped_types():
            continue
        props = mi.Properties(own)
        props.set_id(node.props.id())
        for key in FILM_SIZES if node.type == mi.ObjectType.Film else ():
            if key in node.props:
                props[key] = node.props[key]
        node.props = props


def forget_reading(state: Any) -> None:
    """Mark all values as not yet read, so that Mitsuba refuses those that no plugin reads, such as misspelt ones.

    The checks have read them all, so Mitsuba would miss the mistakes. The nodes of `IGNORED_PLUGINS` are left out.
    """
    for node in state.nodes:
        if node.type.name in IGNORED_PLUGINS:
            continue
        for key in node.props.keys():  # noqa: SIM118
            if node.props.type(key).name not in _OBJECTS:
                node.props.mark_queried(key, False)


def take_material_classes(state: Any, label: str) -> dict[str, str]:
    """Stated material classes by the id of the shape, where the shape or its BSDF states one.

    The entries are removed from the nodes, because Mitsuba does not know them.
    """
    stated: dict[int, str] = {}
    for index, node in enumerate(state.nodes):
        if CLASS_KEY in node.props:
            value = str(node.props[CLASS_KEY])
            if value not in MATERIAL_CLASSES:
                hint = nearest(value, MATERIAL_CLASSES)
                raise FileFormatError(
                    f"{label}: expected {CLASS_KEY} to be one of {', '.join(MATERIAL_CLASSES)}, "
                    f"got {shown(value)}{hint}."
                )
            stated[index] = value
            del node.props[CLASS_KEY]
    found = {node.props.id(): _stated_class(state, index, stated) for index, node in _shapes(state)}
    return {name: value for name, value in found.items() if value is not None}


def take_objects(state: Any, label: str) -> tuple[dict[str, str], dict[str, bool]]:
    """Statements of the scene about its objects: the things that shapes are parts of, and whether shapes are objects.

    Both are by the id of the shape. The entries are removed from the nodes, because Mitsuba does not know them.

    Raises
    ------
    FileFormatError
        The name of a thing is no text or is empty, `is_object` is neither true nor false, or shapes that are part of
        one thing disagree.
    """
    things: dict[str, str] = {}
    stated: dict[str, bool] = {}
    for _, node in _shapes(state):
        place = f"{label}: shape {node.props.id()!r}"
        if PART_KEY in node.props:
            thing = node.props[PART_KEY]
            if not isinstance(thing, str) or not thing:
                raise FileFormatError(f"{place}: expected {PART_KEY} to be the name of a thing, got {shown(thing)}.")
            things[node.props.id()] = thing
            del node.props[PART_KEY]
        if OBJECT_KEY in node.props:
            is_object = node.props[OBJECT_KEY]
            if not isinstance(is_object, bool):
                raise FileFormatError(f"{place}: expected {OBJECT_KEY} to be true or false, got {shown(is_object)}.")
            stated[node.props.id()] = is_object
            del node.props[OBJECT_KEY]
    agreed: dict[str, bool] = {}
    for name, is_object in stated.items():
        thing = things.get(name, name)
        if agreed.setdefault(thing, is_object) != is_object:
            raise FileFormatError(f"{label}: expected one {OBJECT_KEY} for all parts of {thing!r}, got true and false.")
    return things, stated


def _shapes(state: Any) -> Iterator[tuple[int, Any]]:
    return ((i, node) for i, node in enumerate(state.nodes) if node.type == mi.ObjectType.Shape)


def _stated_class(state: Any, index: int, stated: dict[int, str]) -> str | None:
    """The material class stated at a node or at the nearest BSDF inside; None if there is none."""
    if index in stated:
        return stated[index]
    for _, value in state.nodes[index].props.items():
        if isinstance(value, mi.Properties.ResolvedReference) and state.nodes[value.index()].type == mi.ObjectType.BSDF:
            return _stated_class(state, value.index(), stated)
    return None
