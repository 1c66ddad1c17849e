# SPDX-License-Identifier: Apache-2.0
"""Material classes: how a surface treats the light of a range sensor, read off its BSDF."""

from __future__ import annotations

import re
from typing import Any

import mitsuba as mi
import numpy as np

MATERIAL_CLASSES = ("matte", "glossy", "mirror", "transparent", "translucent", "other")
"""matte: diffuse. glossy: a diffuse or wide lobe under a specular one. mirror: (nearly) specular reflection only.
transparent: (nearly) specular refraction. translucent: scattered transmission. other: none of these."""

SMOOTH = 0.05
"""Microfacet roughness alpha up to which a surface looks polished to a range sensor."""

MAX_NARROW_ALPHA = 0.03
"""Microfacet roughness alpha up to which light paths that start elsewhere hardly meet the lobe: its solid angle,
about pi (2 alpha)^2, is a five-hundredth of a hemisphere there."""

ALL_COMPONENTS = 0xFFFFFFFF

_TEXTURE_PARTS = re.compile(r"(\.color[01])*(\.value|\.data)?$")
"""The end of a parameter's name that tells which part of a texture it is."""
_ALPHAS = ("alpha", "alpha_u", "alpha_v")


def material_class(bsdf: Any) -> str:
    """One of `MATERIAL_CLASSES`, from the lobes of a mitsuba.BSDF and its roughness.

    Wrappers (`twosided`, `mask`, `bumpmap`) count as what they wrap; a blend has the lobes of all its parts.
    """
    parameters = _numbers(bsdf)
    alphas = _alphas(parameters)
    polished = all(alpha <= SMOOTH for alpha in alphas)
    delta = _has(bsdf, "DeltaReflection") or (polished and _has(bsdf, "GlossyReflection"))
    if _has(bsdf, "DeltaTransmission", "GlossyTransmission") or _has_thin_glass(bsdf):
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
    """Whether the surface has holes (`mask`, `null`); thin glass, which light passes unchanged as well, is none."""
    return holes(bsdf) != 0


def has_narrow_lobe(bsdf: Any) -> bool:
    """Whether a mitsuba.BSDF has a lobe that is as narrow as a mirror's nearly, but no delta interaction."""
    alphas = _alphas(_numbers(bsdf))
    return _has(bsdf, "GlossyReflection", "GlossyTransmission") and bool(alphas) and max(alphas) <= MAX_NARROW_ALPHA


def is_closed_mask(bsdf: Any) -> bool:
    """Whether the surface is a `mask` whose opacity is 1 everywhere, over what lets nothing through unchanged."""
    return bool(bsdf.class_name() == "MaskBSDF" and not _has_thin_glass(bsdf) and _numbers(bsdf).get("opacity") == 1)


def holes(bsdf: Any) -> int:
    """Bits of the components of a mitsuba.BSDF that are holes: light passes there as if nothing were there."""
    if not _has(bsdf, "Null"):
        return 0
    if not _has_thin_glass(bsdf):
        return ALL_COMPONENTS
    return 1 << (bsdf.component_count() - 1) if bsdf.class_name() == "MaskBSDF" else 0  # of a mask, the last one


def transmits(bsdf: Any) -> bool:
    """Whether light gets through the material itself, not through its holes alone."""
    return _has(bsdf, "DiffuseTransmission", "GlossyTransmission", "DeltaTransmission") or _has_thin_glass(bsdf)


def is_matte(shape: Any) -> bool:
    """Whether a surface is nothing but a diffuse reflector, without holes and with nothing inside that scatters."""
    flags = shape.bsdf().flags() & mi.BSDFFlags.All.value
    return bool(flags == flags & mi.BSDFFlags.DiffuseReflection.value != 0) and shape.interior_medium() is None


def has_texture(bsdf: Any) -> bool:
    """Whether the reflectance of a matte mitsuba.BSDF is not the same everywhere."""
    return any(not name.endswith("reflectance.value") for name in mi.traverse(bsdf).keys())  # noqa: SIM118


def _has_thin_glass(bsdf: Any) -> bool:
    """Whether a `thindielectric` is in it: what passes that has the flag of what passes a hole."""
    parts = mi.traverse(bsdf).hierarchy if _has(bsdf, "Null") else {}
    return any(isinstance(part, mi.BSDF) and part.class_name() == "ThinDielectric" for part in parts)


def _has(bsdf: Any, *lobes: str) -> bool:
    return any(bool(mi.has_flag(bsdf.flags(), getattr(mi.BSDFFlags, lobe))) for lobe in lobes)


def _alphas(parameters: dict[str, float]) -> list[float]:
    """The microfacet roughnesses among the parameters of a BSDF."""
    alphas = [parameters[key] for key in _ALPHAS if key in parameters]
    return alphas + ([parameters["roughness"] ** 2] if "roughness" in parameters else [])  # principled (Burley 2012)


def _numbers(bsdf: Any) -> dict[str, float]:
    """Parameters that hold one number, by their last name: `nested_bsdf.alpha.value` is `alpha`.

    A texture counts as its mean; one whose values are not its own (`mesh_attribute`) as NaN.
    """
    values: dict[str, list[float]] = {}
    try:
        parameters = list(mi.traverse(bsdf))
    except TypeError:  # Mitsuba 3.9 cannot list those of `hair` in a variant of one wavelength
        return {}
    for key, value in parameters:
        if isinstance(value, (float, mi.Float, mi.TensorXf)):
            array = np.array(value, dtype=np.float64)
            if array.size == 1 or isinstance(value, mi.TensorXf):
                owner, _, last = key.rpartition(".")
                is_attribute = last == "scale"
                values.setdefault(owner if is_attribute else _TEXTURE_PARTS.sub("", key), []).append(
                    np.nan if is_attribute else float(array.mean())
                )
    return {key.rsplit(".", 1)[-1]: float(np.mean(means)) for key, means in values.items()}
