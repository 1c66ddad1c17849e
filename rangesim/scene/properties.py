# SPDX-License-Identifier: Apache-2.0
"""Checks of the properties in a scene, on its parsed nodes, before Mitsuba makes objects of them.

Mitsuba accepts most numbers unchecked. With a reflectance of 2 or a radius of NaN the light is then wrong, and the user
may not notice.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.errors import FileFormatError
from rangesim.files.image_files import check_pixels
from rangesim.files.text_files import is_nested_deeper
from rangesim.files.utf8_names import is_utf8
from rangesim.scene.mesh_files import check_ply, check_serialized
from rangesim.scene.nodes import check_type, named_file
from rangesim.settings import limits
from rangesim.settings.bounds import MAX_COORDINATE_M, Bounds, whole
from rangesim.settings.config import shown

ANY = Bounds("finite", -1e30, 1e30)
"""Bounds of a property that is not in `PROPERTIES`: any number that single precision holds."""
PLACE = Bounds("a coordinate in metres", -MAX_COORDINATE_M, MAX_COORDINATE_M)
"""Bounds of a coordinate of the world, metres."""
POSITIVE = Bounds("positive and finite", 1e-12, 1e12)
"""Bounds of a number that has to be above 0, in whatever unit."""
LENGTH = Bounds("positive and finite", 1e-12, MAX_COORDINATE_M)
"""Bounds of a length, metres."""
NOT_NEGATIVE = Bounds("0 or positive, and finite", 0, 1e12)
"""Bounds of a number of at least 0, in whatever unit."""
FRACTION = Bounds("a fraction", 0, 1)
"""Bounds of a reflectance or another fraction."""
WAVELENGTHS_NM = Bounds("nanometres", 1, 1e7)
"""Bounds of the wavelengths of a spectrum, nanometres: from X-rays to 1 cm."""

PROPERTIES: dict[str, dict[str, Bounds]] = {
    "Shape": {"radius": LENGTH, "center": PLACE, "p0": PLACE, "p1": PLACE},
    "BSDF": dict.fromkeys(
        (
            *("reflectance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance", "transmittance"),
            *("diffuse_transmittance", "base_color", "roughness", "metallic", "anisotropic", "spec_trans", "spec_tint"),
            *("sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "flatness", "opacity", "weight"),
        ),
        FRACTION,
    )
    | dict.fromkeys(("int_ior", "ext_ior"), Bounds("a positive index of refraction", 1e-3, 1e3))
    | dict.fromkeys(("eta", "k"), Bounds("an index of refraction of at least 0", 0, 1e4))
    | dict.fromkeys(("alpha", "alpha_u", "alpha_v"), Bounds("a roughness of at least 0", 0, 10))
    | {"exponent": NOT_NEGATIVE},
    "Emitter": dict.fromkeys(("radiance", "irradiance", "intensity", "scale"), NOT_NEGATIVE)
    | {"position": PLACE, "filename": NOT_NEGATIVE, "bitmap": NOT_NEGATIVE},
    "Medium": {"albedo": FRACTION} | dict.fromkeys(("sigma_t", "scale"), NOT_NEGATIVE),
    "Unknown": {"falloff": Bounds("an exponent of at least 0", 0, 1000)},  # a BSDF in Python, such as retroreflector
    "PhaseFunction": {"g": Bounds("above -1 and below 1", -0.9999, 0.9999)},
    "Sensor": {"fov": Bounds("degrees between 0 and 180", 1e-3, 179.999)}
    | dict.fromkeys(("near_clip", "far_clip"), POSITIVE),
    "Film": dict.fromkeys(("width", "height"), whole(1)),
}
"""Bounds of properties, by kind of node and name of property as in Mitsuba; all other properties must be finite."""
COLOURS = ("value", "color", "color0", "color1", "filename", "bitmap", "data")
"""Properties of a texture that hold its values. They have the bounds of the property that the texture is for."""
ENTRIES_PER_SHAPE = 20
"""Mean count of entries per allowed shape (limit `shapes`) above which a scene dictionary is refused. Usual shapes have
fewer, their BSDF included. The bound exists because a dictionary that contains another one many times, in many levels,
has more entries and would fill the memory."""
NOT_OF_MEDIA = ("sigma_a", "sigma_s", "material")
"""Properties of media in other renderers, which Mitsuba 3.9 silently ignores."""
BITMAP_SOURCES = ("filename", "bitmap", "data")
"""Properties that a bitmap texture can be made from; Mitsuba 3.9 crashes if all are missing."""
FAIL_IN_ONE_BAND = {
    "blackbody": "give the emission at the sensor's wavelength as a number",
    "regular": "give the value at the sensor's wavelength as a number",
    "irregular": "give the value at the sensor's wavelength as a number",
    "hair": "give a roughplastic, principled or diffuse BSDF instead",
    "sunsky": "give a constant emitter for the sky and a directional one for the sun",
    "timed_sunsky": "give a constant emitter for the sky and a directional one for the sun",
}
"""Plugins that load but cannot be evaluated without a spectrum, each with the advice for the message.

A single one of them stops the light transport of every scene that is in memory at the same time.
"""
LOADED_CLASSES = {
    "BlackBodySpectrum": "blackbody",
    "RegularSpectrum": "regular",
    "IrregularSpectrum": "irregular",
    "Hair": "hair",
}
"""Name of the plugin of a loaded object, by the name of its class."""
TEXTURES_WITHOUT = {
    "bumpmap": ("slopes", ("checkerboard", "mesh_attribute", "rawconstant", "srgb", "volume")),
    "normalmap": ("three channels", ("checkerboard",)),
}
"""Requirement on the texture of these BSDFs, and the textures of Mitsuba 3.9 that do not meet it.

Such a texture stops the light transport.
"""
FLOAT_IMAGES = (".exr", ".pfm", ".hdr", ".rgbe")
"""Suffixes of texture files whose values may lie outside 0 to 1."""


def check_depth(state: Any, label: str) -> None:
    """Raise FileFormatError if a parsed scene has too many shapes or too long chains of references between nodes.

    The limits are `shapes` and `nesting`. On a long chain Mitsuba would run out of stack.
    """
    shapes = sum(node.type == mi.ObjectType.Shape for node in state.nodes)
    limits.check("shapes", shapes, f"shapes in {label}", FileFormatError)
    by_id = {node.props.id(): index for index, node in enumerate(state.nodes)}
    children = [_children(node, by_id) for node in state.nodes]
    waiting = [0] * len(children)  # number of nodes not yet visited that refer to this one
    for child in chain.from_iterable(children):
        waiting[child] += 1
    depth = [1] * len(children)
    ready = [index for index, count in enumerate(waiting) if count == 0]
    for parent in ready:  # the list grows meanwhile; each node follows all nodes that refer to it
        for child in children[parent]:
            depth[child] = max(depth[child], depth[parent] + 1)
            waiting[child] -= 1
            if waiting[child] == 0:
                ready.append(child)
    if len(ready) == len(children):  # otherwise there is a cycle, which Mitsuba reports
        limits.check("nesting", max(depth, default=0), f"objects of {label} that refer to each other", FileFormatError)


def check_dictionary(scene: Any, label: str) -> None:
    """Raise FileFormatError if a scene dictionary is nested too deep, too large, or holds values that crash Mitsuba."""
    deepest, entries = limits.current().nesting, 0
    todo = [(1, "", scene)]
    while todo:
        depth, place, table = todo.pop()
        limits.check("nesting", depth, f"levels in {label}", FileFormatError)
        entries += len(table)
        limits.check("shapes", entries // ENTRIES_PER_SHAPE, f"shapes of entries in {label}", FileFormatError)
        for key, value in table.items():
            if isinstance(value, Mapping):
                todo.append((depth + 1, f"{place}{key}.", value))
            elif isinstance(value, (list, tuple)) and is_nested_deeper(value, deepest):
                limits.check("nesting", deepest + 1, f"levels in {label}", FileFormatError)
            elif value is None or (isinstance(value, int) and abs(value) >= 1 << 63):
                name = f"{place}{key}"[-200:]
                raise FileFormatError(f"{label}: expected {name} to be a value of 64 bits, got {shown(value)}.")
            elif isinstance(value, str) and not is_utf8(value):
                name = f"{place}{key}"[-200:]
                raise FileFormatError(
                    f"{label}: expected {name} in UTF-8, got {shown(value)}; name a link to that file instead."
                )
            if not isinstance(key, str):
                raise FileFormatError(f"{label}: expected names as keys, got {shown(key)}.")
            if key == "type" and isinstance(value, str):
                check_type(value, label)
            elif key == "filename" and isinstance(value, str):  # Mitsuba reads files of spectra while it parses
                named_file(value, label)


def check_evaluable(state: Any, label: str) -> None:
    """Raise FileFormatError if a node would load, but cannot be evaluated in the single band of the light transport."""
    parents = {value.index(): parent for parent, node in enumerate(state.nodes) for _, value in _references(node)}
    for index, node in enumerate(state.nodes):
        names = [node.props.plugin_name()]
        names += [LOADED_CLASSES.get(value.class_name(), "") for value in _loaded(node)]
        for name in names:
            if name in FAIL_IN_ONE_BAND:
                raise FileFormatError(
                    f"{label}: {_place(state, parents, index)}: {name!r} needs a spectrum, and the light has one band, "
                    f"that of the sensor; {FAIL_IN_ONE_BAND[name]}."
                )
        need, lacking = TEXTURES_WITHOUT.get(node.props.plugin_name(), ("", ()))
        for _, value in _references(node):
            if (kind := state.nodes[value.index()].props.plugin_name()) in lacking:
                raise FileFormatError(
                    f"{label}: {_place(state, parents, index)}: expected a texture with {need}, got {kind!r}; "
                    "give a bitmap instead."
                )


def check_properties(state: Any, label: str) -> None:
    """Raise FileFormatError on the first property of a node that is not finite or is out of its bounds.

    The message names node and property: 'shape "ball": expected radius to be positive and finite, got nan'.
    """
    parents = {value.index(): parent for parent, node in enumerate(state.nodes) for _, value in _references(node)}
    for index, node in enumerate(state.nodes):
        bounds = PROPERTIES.get(node.type.name, {})
        for key, value in node.props.items():
            checked = _Property(state, key, bounds.get(key, ANY), label)
            problem = checked.problem(value)
            if problem:
                raise FileFormatError(f"{label}: {_place(state, parents, index)}: {problem}.")
        if node.type == mi.ObjectType.Medium and (problem := _problem_of_medium(state, node)):
            raise FileFormatError(f"{label}: {_place(state, parents, index)}: {problem}.")
        if node.props.plugin_name() == "bitmap" and not any(name in node.props for name in BITMAP_SOURCES):
            raise FileFormatError(f"{label}: {_place(state, parents, index)}: expected a filename, found none.")
        _check_mesh(node.props, label)
        if node.type == mi.ObjectType.Film:
            width, height = (int(node.props.get(name, default)) for name, default in (("width", 768), ("height", 576)))
            limits.check("pixels", width * height, f"pixels of the film of {label}", FileFormatError)


def _check_mesh(props: Any, label: str) -> None:
    """Raise FileFormatError if the file of a mesh would make Mitsuba crash; the message names the scene too."""
    name = props.get("filename")
    if not isinstance(name, str):
        return
    path = named_file(name, label)
    try:
        if props.plugin_name() == "ply":
            check_ply(path)
        if props.plugin_name() == "serialized":
            check_serialized(path, int(props.get("shape_index", 0)))
    except FileFormatError as error:
        raise FileFormatError(f"{label}: {error}") from error


def check_vertices(scene: Any, label: str) -> None:
    """Raise FileFormatError on the first mesh of a loaded scene that is empty, has no extent, or has a bad vertex.

    A vertex is bad if it is not finite, too far from the origin, or missing although a face refers to it.
    """
    for shape in scene.shapes():
        parameters = mi.traverse(shape) if shape.is_mesh() else {}
        if "vertex_positions" not in parameters:  # a rectangle has none, although `is_mesh` holds
            continue
        vertices = np.array(parameters["vertex_positions"])
        limits.check("points", len(vertices) // 3, f"vertices of shape {shape.id()!r}", FileFormatError)
        if not len(vertices):
            raise FileFormatError(f"{label}: shape {shape.id()!r}: expected at least one triangle, got none.")
        faces = np.array(parameters["faces"])
        if len(faces) and faces.max() >= len(vertices) // 3:
            raise FileFormatError(
                f'{label}: shape "{shape.id()}": expected faces of its {len(vertices) // 3} vertices, '
                f"got vertex {faces.max()}."
            )
        far = ~(np.abs(vertices) <= MAX_COORDINATE_M)
        if far.any():
            raise FileFormatError(
                f'{label}: shape "{shape.id()}": expected the vertices to be {PLACE}, got {vertices[far][0]:g}.'
            )
        corners = vertices.reshape(-1, 3)
        if not (corners.max(axis=0) > corners.min(axis=0)).any():
            raise FileFormatError(f'{label}: shape "{shape.id()}": expected an extent, but all its vertices coincide.')


class _Property:
    """A property of a node, with the bounds of all numbers in it."""

    def __init__(self, state: Any, key: str, bounds: Bounds, label: str) -> None:
        self.state, self.key, self.bounds, self.label = state, key, bounds, label

    def problem(self, value: Any, key: str = "") -> str:
        """The reason to refuse a value of the property, as a clause for a message; empty if there is none."""
        key = key or self.key
        if isinstance(value, mi.Properties.ResolvedReference):
            return self._problem_of_texture(self.state.nodes[value.index()], key)
        if _is_transform(value):
            return _problem_of_transform(value, key)
        if key.endswith("filename") and isinstance(value, str):
            return self._problem_of_image(named_file(value, self.label), key)
        if key in ("width", "height") and isinstance(value, float):
            return f"expected {key} to be {self.bounds}, got {shown(value)}"
        for number in getattr(value, "wavelengths", ()):
            if number not in WAVELENGTHS_NM:
                return f"expected the wavelengths of {key} to be {WAVELENGTHS_NM}, got {shown(number)}"
        for number in _numbers(value):
            if number not in self.bounds:
                return f"expected {key} to be {self.bounds}, got {shown(number)}"
        return ""

    def _problem_of_texture(self, node: Any, key: str) -> str:
        if node.type not in (mi.ObjectType.Texture, mi.ObjectType.Volume) or self.bounds is ANY:
            return ""
        for inner, value in node.props.items():
            if inner in COLOURS:
                problem = self.problem(value, f"{key}.{inner}")
                if problem:
                    return problem
        return ""

    def _problem_of_image(self, path: Path, key: str) -> str:
        if not path.is_file():
            return ""  # Mitsuba reports a missing file
        if path.stat().st_size == 0:
            return f"expected {key} to name a file with contents, but {path.name} is empty"
        check_pixels(path)
        if self.bounds is ANY or path.suffix.lower() not in FLOAT_IMAGES:
            return ""
        values = np.array(mi.Bitmap(str(path)), dtype=np.float64)
        return self._problem_of_array(values, f"the pixels of {key} {path.name}")

    def _problem_of_array(self, values: np.ndarray, name: str) -> str:
        wrong = ~((values >= self.bounds.low) & (values <= self.bounds.high))
        return f"expected {name} to be {self.bounds}, got {values[wrong][0]:g}" if wrong.any() else ""


def _problem_of_medium(state: Any, node: Any) -> str:
    """The reason to refuse the coefficients of a homogeneous medium, as a clause for a message; empty if there is none.

    The coefficients must be single numbers, for the band of the sensor. Mitsuba would cut off a spectrum in 1/m at 1,
    would convert colours as for the eye, and ignores the properties that other renderers use (`NOT_OF_MEDIA`).
    """
    if node.props.plugin_name() != "homogeneous":
        return ""
    for key in NOT_OF_MEDIA:
        if key in node.props:
            return f"expected albedo and sigma_t, in 1/m, which Mitsuba reads; it ignores {key}"
    for key in ("sigma_t", "albedo"):
        value = node.props.get(key)
        if isinstance(value, mi.Properties.ResolvedReference):
            inside = state.nodes[value.index()].props
            value = inside.get("value") if inside.plugin_name() == "constvolume" else None
        if len(set(_numbers(value))) > 1 or (hasattr(value, "is_uniform") and not value.is_uniform()):
            return f"expected {key} to be one number, the value at the sensor's wavelength, got several colours"
    return ""


def _numbers(value: Any) -> Iterable[float]:
    """All numbers in the value of a property, or the extremes of an array; empty for other kinds of values."""
    if isinstance(value, bool):
        return ()
    if isinstance(value, (int, float)):
        return (value,)
    if hasattr(value, "is_uniform"):
        return tuple(value.values)
    if isinstance(value, dr.ArrayBase):
        return _extremes(np.array(value, dtype=np.float64))
    if isinstance(value, mi.Bitmap):
        return _extremes(np.array(value, dtype=np.float64))
    return ()


def _extremes(values: np.ndarray) -> Iterable[float]:
    """Smallest and largest value; both are NaN if one value is."""
    return (float(values.min()), float(values.max())) if values.size else ()


def _is_transform(value: Any) -> bool:
    return hasattr(value, "matrix") and hasattr(value, "inverse_transpose")


def _problem_of_transform(value: Any, key: str) -> str:
    matrix = np.array(value.matrix, dtype=np.float64)
    if not (np.abs(matrix) <= MAX_COORDINATE_M).all():  # also of NaN
        largest = matrix.flat[int(np.argmax(np.where(np.isnan(matrix), math.inf, np.abs(matrix))))]
        return f"expected {key} to hold finite numbers up to {MAX_COORDINATE_M:g}, got {largest:g}"
    if key == "to_world" and (np.linalg.norm(matrix[:3, :3], axis=0) == 0).any():
        return f"expected {key} to leave the shape an extent, got a scale of 0"
    return ""


def _children(node: Any, by_id: dict[str, int]) -> list[int]:
    """Indices of the nodes that a node refers to; references by id, which Mitsuba has not resolved yet, included."""
    named = (value.id() for _, value in node.props.items() if isinstance(value, mi.Properties.Reference))
    return [value.index() for _, value in _references(node)] + [by_id[name] for name in named if name in by_id]


def _references(node: Any) -> Iterator[tuple[str, Any]]:
    return ((key, value) for key, value in node.props.items() if isinstance(value, mi.Properties.ResolvedReference))


def _loaded(node: Any) -> Iterator[Any]:
    """Mitsuba objects among the properties of a node, which a dictionary may hold instead of descriptions."""
    return (value for _, value in node.props.items() if isinstance(value, (mi.BSDF, mi.Texture)))


def _place(state: Any, parents: dict[int, int], index: int) -> str:
    """Name of a node for messages: its kind and id; without an id, its plugin and the node that holds it."""
    node = state.nodes[index]
    kind, name = node.type.name.lower(), node.props.id()
    if name and not name.startswith("_arg_"):
        return f'{kind} "{name}"'
    plugin = f'{kind} "{node.props.plugin_name()}"'
    holder = parents.get(index)
    if holder is None or state.nodes[holder].type == mi.ObjectType.Scene:
        return plugin
    return f"{plugin} of {_place(state, parents, holder)}"
