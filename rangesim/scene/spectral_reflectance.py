# SPDX-License-Identifier: Apache-2.0
"""Reflectances at the wavelength of the sensor, and warnings where a scene states only colours.

Most scenes are made for the eye: their reflectances are RGB colours. The light transport has one band, that of the
sensor, and takes the luminance of a colour as its reflectance. This is a guess: at 850 nm many dyes are white and
leaves are bright. A BSDF may therefore state `<float name="sensor_reflectance" value="0.7"/>`, which replaces its
colour. Where a coloured BSDF does not, a warning says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi

from rangesim.errors import FileFormatError, warn
from rangesim.files.image_files import is_coloured
from rangesim.settings.config import shown

REFLECTANCE_KEY = "sensor_reflectance"
"""Property of a BSDF that states its reflectance for the sensor, a fraction from 0 to 1."""
COLOUR_OF = {
    "diffuse": "reflectance",
    "plastic": "diffuse_reflectance",
    "roughplastic": "diffuse_reflectance",
    "principled": "base_color",
    "principledthin": "base_color",
}
"""Property with the colour of a BSDF, by its type; `sensor_reflectance` replaces it."""
GREY = 0.02
"""Largest difference between the channels (0 to 1) of a colour that counts as grey: five of the 256 steps of 8 bits,
which the eye hardly sees. At 0, rounding of greys would cause warnings."""
MAX_NAMED = 3
"""Number of materials that a warning names, so that it stays one readable sentence."""


def take_sensor_reflectances(state: Any, label: str) -> None:
    """Replace colours by the `sensor_reflectance` of their BSDF, and remove that entry, which Mitsuba does not know.

    Raises
    ------
    FileFormatError
        The reflectance is stated for a BSDF without a colour, or is no number.
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
    """Names of the BSDFs whose reflectance is a colour other than grey, each once."""
    return list(dict.fromkeys(_coloured(state)))


def warn_of_colours(names: list[str], label: str) -> None:
    """Warn once about the BSDFs of these names, whose reflectances are colours. Without names there is no warning."""
    if names:
        listed = ", ".join(names[:MAX_NAMED]) + (" ..." if len(names) > MAX_NAMED else "")
        warn(
            f"{label}: colours of {len(names)} material{'s' if len(names) > 1 else ''} ({listed}) are read as their "
            f"luminance, but a sensor sees its own wavelength; state {REFLECTANCE_KEY} in the BSDF, or a grey texture."
        )


def _coloured(state: Any) -> Iterator[str]:
    """Names of the BSDFs whose colour is not grey, in the order of the nodes."""
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
