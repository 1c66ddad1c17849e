# SPDX-License-Identifier: Apache-2.0
"""Material classes: how a surface treats the light of a range sensor."""

from __future__ import annotations

from typing import Any

MATERIAL_CLASSES = ("matte", "glossy", "mirror", "transparent", "translucent", "other")
"""matte: diffuse. glossy: a diffuse or wide lobe under a specular one. mirror: (nearly) specular reflection only.
transparent: (nearly) specular refraction. translucent: scattered transmission. other: none of these."""

ROUGHNESS_OF_MIRROR = 0.05
"""Rough conductors and dielectrics below this alpha look, to a range sensor, like polished ones."""

_CLASSES = {
    "diffuse": "matte",
    "measured": "other",
    "plastic": "glossy",
    "roughplastic": "glossy",
    "pplastic": "glossy",
    "principled": "glossy",
    "principledthin": "translucent",
    "conductor": "mirror",
    "roughconductor": "glossy",
    "dielectric": "transparent",
    "thindielectric": "transparent",
    "roughdielectric": "translucent",
    "null": "transparent",
}
_WRAPPERS = ("twosided", "mask", "bumpmap", "normalmap", "blendbsdf")


def material_class(bsdf_type: str, properties: dict[str, Any], nested: str | None) -> str:
    """One of `MATERIAL_CLASSES` for a Mitsuba BSDF plugin.

    Parameters
    ----------
    bsdf_type : name of the plugin.
    properties : its scalar parameters (only `alpha` matters).
    nested : class of the first BSDF inside, for wrappers such as `twosided`.
    """
    if bsdf_type in _WRAPPERS and nested is not None:
        return nested
    alpha = properties.get("alpha", 0.1)
    if isinstance(alpha, (int, float)) and alpha <= ROUGHNESS_OF_MIRROR:
        if bsdf_type == "roughconductor":
            return "mirror"
        if bsdf_type == "roughdielectric":
            return "transparent"
    return _CLASSES.get(bsdf_type, "other")
