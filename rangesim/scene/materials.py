# SPDX-License-Identifier: Apache-2.0
"""Material classes: the behaviour of a surface towards a range sensor, derived from its BSDF."""

from __future__ import annotations

import re
from typing import Any

import mitsuba as mi
import numpy as np

MATERIAL_CLASSES = ("matte", "glossy", "mirror", "transparent", "translucent", "other")
"""Names of the material classes.

- matte: diffuse reflection only.
- glossy: a diffuse lobe together with a specular one, or a wide lobe alone.
- mirror: specular reflection only, or nearly so.
- transparent: specular refraction, or nearly so.
- translucent: scattered transmission.
- other: none of these.
"""

MAX_POLISHED_ALPHA = 0.05
"""Largest microfacet roughness alpha, dimensionless, of a surface that counts as polished: its lobe is about 2 alpha =
6 degrees wide. A larger value would call brushed metal a mirror; it changes only the class, not the light."""

MAX_NARROW_ALPHA = 0.03
"""Largest microfacet roughness alpha, dimensionless, of a narrow lobe. Its solid angle, about pi (2 alpha)^2, is then
at most a five-hundredth of a hemisphere, so a light path in a random direction hardly ever lies in the lobe. A larger
value would also count lobes that such paths do find."""

MAX_NEAR_SPECULAR_ALPHA = 0.1
"""Largest microfacet roughness alpha, dimensionless, of a metal or glass whose lobes are followed as specular chains
are. Paths find the light that wider lobes throw on a matte wall beside them: at 16 samples its noise is 3.5 % of all
light at 0.1, and 8, 28 and 43 % at 0.05, 0.02 and 0.01."""
NEAR_SPECULAR_BSDFS = ("RoughConductor", "RoughDielectric", "TwoSidedBRDF")
"""Class names of BSDFs that scatter into a reflected and a transmitted lobe alone, each of which can be sampled on its
own; wrappers of them that change nothing else."""

ALL_COMPONENTS = 0xFFFFFFFF
"""Mask of all components of a BSDF, as in `mitsuba.BSDFContext`."""

_TEXTURE_PARTS = re.compile(r"(\.color[01])*(\.value|\.data)?$")
"""End of a parameter's name, which only says which part of a texture the parameter is."""
_OF_TEXTURES = re.compile(r"\.(color[01]|data|scale|to_uv)\b")
"""Parameters that textures have and single numbers have not."""
_ALPHAS = ("alpha", "alpha_u", "alpha_v")
"""Names of the parameters that hold a microfacet roughness."""


def material_class(bsdf: Any) -> str:
    """The class out of `MATERIAL_CLASSES` of a mitsuba.BSDF, from its lobes and their roughness.

    A wrapper (`twosided`, `mask`, `bumpmap`) has the class of the BSDF inside; a blend has the lobes of all its parts.
    """
    parameters = _numbers(bsdf)
    alphas = _alphas(parameters)
    polished = all(alpha <= MAX_POLISHED_ALPHA for alpha in alphas)
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
    """Whether the surface has holes (`mask`, `null`). Thin glass has none, although light passes it unchanged too."""
    return holes(bsdf) != 0


def has_narrow_lobe(bsdf: Any) -> bool:
    """Whether a mitsuba.BSDF has lobes almost as narrow as those of a mirror, but not delta distributions."""
    alphas = _alphas(_numbers(bsdf))
    return _has(bsdf, "GlossyReflection", "GlossyTransmission") and bool(alphas) and max(alphas) <= MAX_NARROW_ALPHA


def is_near_specular(bsdf: Any) -> bool:
    """Whether a mitsuba.BSDF scatters into lobes alone that are nearly as narrow as those of a mirror or of glass."""
    if not _has(bsdf, "GlossyReflection", "GlossyTransmission") or _has(bsdf, "Diffuse", "Delta", "Null"):
        return False
    parts = mi.traverse(bsdf).hierarchy
    names = {part.class_name() for part in parts if isinstance(part, mi.BSDF)}
    alphas = np.array(_alphas(_numbers(bsdf)), np.float32)
    return (
        names <= set(NEAR_SPECULAR_BSDFS)
        and len(alphas) > 0
        and bool((alphas <= np.float32(MAX_NEAR_SPECULAR_ALPHA)).all())
    )


def holes(bsdf: Any) -> int:
    """Bits of the components of a mitsuba.BSDF that are holes, where light passes as if there were no surface."""
    if not _has(bsdf, "Null"):
        return 0
    if not _has_thin_glass(bsdf):
        return ALL_COMPONENTS
    # A mask has its hole as the last component
    return 1 << (bsdf.component_count() - 1) if bsdf.class_name() == "MaskBSDF" else 0


def transmits(bsdf: Any) -> bool:
    """Whether light passes through the material itself, not only through its holes."""
    return _has(bsdf, "DiffuseTransmission", "GlossyTransmission", "DeltaTransmission") or _has_thin_glass(bsdf)


def is_matte(shape: Any) -> bool:
    """Whether a surface is a diffuse reflector only, without holes and without a medium inside."""
    flags = shape.bsdf().flags() & mi.BSDFFlags.All.value
    return bool(flags == flags & mi.BSDFFlags.DiffuseReflection.value != 0) and shape.interior_medium() is None


def is_specular(shape: Any) -> bool:
    """Whether a surface has delta interactions only, as mirrors and glass have, and is no boundary of a medium."""
    bsdf = shape.bsdf()
    return _has(bsdf, "DeltaReflection", "DeltaTransmission") and not _has(bsdf, "Smooth")


def sharing_cosine(shape: Any) -> float:
    """Smallest cosine of the angle between the normals of two points of a surface that get similar indirect light.

    It is 0 if the shape scatters light into all directions, whatever the normal: a matte surface, also under a clear
    coat. Light in a glossy lobe comes from directions that turn with the normal; half the width of the lobe is allowed.
    It is NaN if points get different light: mirrors, glass, lobes as narrow as a mirror's, textures on gloss.
    """
    bsdf = shape.bsdf()
    if is_matte(shape):
        return 0.0
    if material_class(bsdf) != "glossy" or is_cutout(bsdf) or shape.interior_medium() is not None:
        return np.nan
    parameters = _numbers(bsdf)
    is_blend = "weight" in parameters  # perhaps of a matte surface and a mirror
    if is_blend or any(_OF_TEXTURES.search(name) for name in mi.traverse(bsdf).keys()):  # noqa: SIM118
        return np.nan
    alphas = _alphas(parameters)
    return float(np.cos(np.arctan(min(alphas)) / 2)) if alphas else 0.0


def has_texture(bsdf: Any) -> bool:
    """Whether the reflectance of a matte mitsuba.BSDF varies over the surface."""
    return any(not name.endswith("reflectance.value") for name in mi.traverse(bsdf).keys())  # noqa: SIM118


def _has_thin_glass(bsdf: Any) -> bool:
    """Whether the BSDF contains a `thindielectric`, whose transmission has the same flag as a hole."""
    parts = mi.traverse(bsdf).hierarchy if _has(bsdf, "Null") else {}
    return any(isinstance(part, mi.BSDF) and part.class_name() == "ThinDielectric" for part in parts)


def _has(bsdf: Any, *lobes: str) -> bool:
    return any(bool(mi.has_flag(bsdf.flags(), getattr(mi.BSDFFlags, lobe))) for lobe in lobes)


def _alphas(parameters: dict[str, float]) -> list[float]:
    """Values of the microfacet roughness among the parameters of a BSDF."""
    alphas = [parameters[key] for key in _ALPHAS if key in parameters]
    return alphas + ([parameters["roughness"] ** 2] if "roughness" in parameters else [])  # principled (Burley 2012)


def _numbers(bsdf: Any) -> dict[str, float]:
    """Parameters of a BSDF that are one number, by the last part of their name: `nested_bsdf.alpha.value` is `alpha`.

    A texture counts with its mean; one whose values are in the mesh (`mesh_attribute`) counts as NaN.
    """
    values: dict[str, list[float]] = {}
    try:
        parameters = list(mi.traverse(bsdf))
    except TypeError:  # Mitsuba 3.9 cannot list the parameters of `hair` in a monochrome variant
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
