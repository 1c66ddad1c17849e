# SPDX-License-Identifier: Apache-2.0
"""What a scene says in colours, and what a sensor sees at its own wavelength.

Scenes are mostly made for the eye: their reflectances are RGB. The light transport has one band, that of the sensor,
and reads colours as their luminance. That is a guess: at 850 nm many dyes are white and leaves are bright. So a BSDF
may state `<float name="sensor_reflectance" value="0.7"/>`, which replaces its colour; who leaves it out is told.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi

from rangesim.errors import FileFormatError, warn
from rangesim.files.image_files import is_coloured
from rangesim.scene.materials import is_closed_mask
from rangesim.scene.media import is_boundary
from rangesim.settings.config import shown

REFLECTANCE_KEY = "sensor_reflectance"
COLOUR_OF = {
    "diffuse": "reflectance",
    "plastic": "diffuse_reflectance",
    "roughplastic": "diffuse_reflectance",
    "principled": "base_color",
    "principledthin": "base_color",
}
"""The colour of a BSDF by its type: what `sensor_reflectance` replaces."""
GREY = 0.02
"""Difference, at most, between the channels of a colour that counts as grey."""
MAX_NAMED = 3


def take_sensor_reflectances(state: Any, label: str) -> None:
    """Put stated reflectances in place of colours; removes the entries, which Mitsuba does not know.

    Raises
    ------
    FileFormatError
        A BSDF without a colour states one.
    """
    for node in state.nodes:
        if REFLECTANCE_KEY not in node.props:
            continue
        kind, value = node.props.plugin_name(), node.props[REFLECTANCE_KEY]
        target = COLOUR_OF.get(kind) if node.type == mi.ObjectType.BSDF else None
        if target is None:
            raise FileFormatError(
                f"{label}: expected {REFLECTANCE_KEY} in a BSDF of type {', '.join(COLOUR_OF)}, got one in {kind!r}."
            )
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise FileFormatError(f"{label}: expected {REFLECTANCE_KEY} to be a number, 0 to 1, got {shown(value)}.")
        del node.props[REFLECTANCE_KEY]
        node.props[target] = float(value)


def coloured_materials(state: Any) -> list[str]:
    """Names of the BSDFs whose reflectance is given in colours."""
    return list(dict.fromkeys(_coloured(state)))


def warn_of_colours(names: list[str], label: str) -> None:
    """Warn once if these BSDFs, or any, are in colours."""
    if names:
        listed = ", ".join(names[:MAX_NAMED]) + (" ..." if len(names) > MAX_NAMED else "")
        warn(
            f"{label}: colours of {len(names)} material{'s' if len(names) > 1 else ''} ({listed}) are read as their "
            f"luminance, but a sensor sees its own wavelength; state {REFLECTANCE_KEY} in the BSDF, or a grey texture."
        )


def warn_of_lamps_behind_glass(scene: Any, label: str) -> None:
    """Warn once if there are lamps without extent, and clear surfaces or holes that keep paths from them."""
    without_extent = mi.EmitterFlags.DeltaPosition.value | mi.EmitterFlags.DeltaDirection.value
    if any(e.flags() & without_extent for e in scene.emitters()) and any(map(_hides_lamps, scene.shapes())):
        warn(
            f"{label}: light of directional, point and spot emitters does not pass glass or holes (mask, null) and is "
            "missing behind it; give the lamp an extent (an area emitter, an envmap)."
        )


def _hides_lamps(shape: Any) -> bool:
    """Whether light passes a shape that a straight line to a lamp does not: through glass, thin glass or holes.

    Boundaries of media are passed on the way to a lamp (`rangesim.light_transport.scattering`).
    """
    bsdf = shape.bsdf()
    if mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaTransmission):
        return True
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) and not is_boundary(shape) and not is_closed_mask(bsdf)


def _coloured(state: Any) -> Iterator[str]:
    """Names of the BSDFs whose colour is not grey."""
    for index, node in enumerate(state.nodes):
        if node.type != mi.ObjectType.BSDF:
            continue
        key = COLOUR_OF.get(node.props.plugin_name())
        if key is not None and key in node.props and _is_coloured(state, node.props[key]):
            yield node.props.id() or f"bsdf_{index}"


def _is_coloured(state: Any, value: Any) -> bool:
    if isinstance(value, mi.Properties.ResolvedReference):
        return _is_coloured_texture(state, state.nodes[value.index()])
    channels = list(value) if type(value).__name__.startswith("ScalarColor3") else [0.0]
    return max(channels) - min(channels) > GREY


def _is_coloured_texture(state: Any, node: Any) -> bool:
    if node.type != mi.ObjectType.Texture:
        return False
    if node.props.plugin_name() == "bitmap" and isinstance(node.props.get("filename"), str):
        return is_coloured(Path(str(mi.file_resolver().resolve(node.props["filename"]))))
    return any(_is_coloured(state, value) for _, value in node.props.items())
