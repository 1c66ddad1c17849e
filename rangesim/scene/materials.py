# SPDX-License-Identifier: Apache-2.0
"""Material classes: how a surface treats the light of a range sensor, read off its BSDF."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

MATERIAL_CLASSES = ("matte", "glossy", "mirror", "transparent", "translucent", "other")
"""matte: diffuse. glossy: a diffuse or wide lobe under a specular one. mirror: (nearly) specular reflection only.
transparent: (nearly) specular refraction. translucent: scattered transmission. other: none of these."""

SMOOTH = 0.05
"""Microfacet roughness alpha up to which a surface looks polished to a range sensor."""

_ALPHAS = ("alpha", "alpha_u", "alpha_v")


def material_class(bsdf: Any) -> str:
    """One of `MATERIAL_CLASSES`, from the lobes of a mitsuba.BSDF and its roughness.

    Wrappers (`twosided`, `mask`, `bumpmap`) count as what they wrap; a blend has the lobes of all its parts.
    """
    parameters = _numbers(bsdf)
    alphas = [parameters[key] for key in _ALPHAS if key in parameters]
    alphas += [parameters["roughness"] ** 2] if "roughness" in parameters else []  # principled (Burley 2012)
    polished = all(alpha <= SMOOTH for alpha in alphas)
    delta = _has(bsdf, "DeltaReflection") or (polished and _has(bsdf, "GlossyReflection"))
    if _has(bsdf, "DeltaTransmission", "GlossyTransmission") or (_is_thin_glass(bsdf) and "opacity" not in parameters):
        return "transparent" if polished else "translucent"
    if _has(bsdf, "DiffuseTransmission"):
        return "translucent"
    if parameters.get("metallic", 0.0) > 0.5:  # principled: the diffuse lobe has no weight
        return "mirror" if polished else "glossy"
    if _has(bsdf, "DiffuseReflection"):
        return "glossy" if _has(bsdf, "DeltaReflection", "GlossyReflection") else "matte"
    if delta:
        return "mirror"
    return "glossy" if _has(bsdf, "GlossyReflection") else "other"


def is_cutout(bsdf: Any) -> bool:
    """Whether light can pass this surface unchanged (`mask`, `null`); thin glass, which reflects as well, is none."""
    return _has(bsdf, "Null") and not _is_thin_glass(bsdf)


def _is_thin_glass(bsdf: Any) -> bool:
    return _has(bsdf, "Null") and _has(bsdf, "DeltaReflection")


def _has(bsdf: Any, *lobes: str) -> bool:
    return any(bool(mi.has_flag(bsdf.flags(), getattr(mi.BSDFFlags, lobe))) for lobe in lobes)


def _numbers(bsdf: Any) -> dict[str, float]:
    """Parameters that hold one number, by their last name: `nested_bsdf.alpha.value` is `alpha`."""
    result: dict[str, float] = {}
    try:
        parameters = list(mi.traverse(bsdf))
    except TypeError:  # Mitsuba 3.9 cannot list those of `hair` in a variant of one wavelength
        return result
    for key, value in parameters:
        array = np.array(value, dtype=np.float64).ravel() if isinstance(value, (float, mi.Float)) else np.empty(0)
        if array.size == 1:
            result[key.removesuffix(".value").rsplit(".", 1)[-1]] = float(array[0])
    return result
