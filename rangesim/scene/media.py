# SPDX-License-Identifier: Apache-2.0
"""The media of shapes: which ones are traced, and their numbers."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


def is_boundary(shape: Any) -> bool:
    """Whether a medium fills the shape behind a boundary of matched index, so that light walks through it."""
    has_interior = bool(shape.is_medium_transition()) and shape.interior_medium() is not None
    return has_interior and _lobes(shape.bsdf()) == int(mi.BSDFFlags.Null)


def medium_numbers(medium: Any) -> tuple[float, float, float]:
    """sigma_t (1/m), albedo and g of a homogeneous mitsuba.Medium."""
    at = dr.zeros(mi.MediumInteraction3f, 1)
    sigma_s, _, sigma_t = (float(mi.unpolarized_spectrum(c)[0][0]) for c in medium.get_scattering_coefficients(at))
    g = np.ravel(dict(mi.traverse(medium)).get("phase_function.g", 0.0))[0]  # isotropic: no such entry
    return sigma_t, sigma_s / sigma_t if sigma_t else 0.0, float(g)


def why_not_traced(shape: Any) -> str | None:
    """What keeps the media of a shape from being traced; None: nothing.

    A medium that scatters fills a shape behind a boundary of matched index; one that absorbs alone may also fill a body
    that refracts, or lie around either (`rangesim.light_transport.absorption`).
    """
    if not shape.is_medium_transition():
        return None
    interior, exterior = shape.interior_medium(), shape.exterior_medium()
    for medium, holds in ((interior, "is filled with"), (exterior, "is surrounded by")):
        varies = None if medium is None else _why_not_homogeneous(medium)
        if varies is not None:
            return f"{holds} a {varies}; only homogeneous media are traced"
    if _lobes(shape.bsdf()) != int(mi.BSDFFlags.Null):
        return _why_not_absorbing(shape.bsdf(), [m for m in (interior, exterior) if m is not None])
    if interior is None or (exterior is not None and medium_numbers(exterior)[1] > 0):
        return "has an exterior medium that scatters, or none inside; only media inside closed shapes are traced"
    if not medium_numbers(interior)[0] > 0:
        return "is filled with a medium of no density; expected a positive sigma_t"
    if interior.phase_function().class_name() not in ("IsotropicPhaseFunction", "HGPhaseFunction"):
        return f"scatters by a {interior.phase_function().class_name()}; only isotropic and hg are traced"
    return None


def _why_not_homogeneous(medium: Any) -> str | None:
    if medium.class_name() != "HomogeneousMedium":
        return str(medium.class_name())
    is_constant = {"albedo.value.value", "sigma_t.value.value"} <= set(dict(mi.traverse(medium)))
    return None if is_constant else "medium that varies from place to place"


def _why_not_absorbing(bsdf: Any, media: list[Any]) -> str | None:
    """What keeps media from being traced on the sides of a surface that is no boundary of matched index."""
    if any(medium_numbers(medium)[1] > 0 for medium in media):
        bounds = f"bounds a medium that scatters by a {bsdf.class_name()}"
        return f"{bounds}; only boundaries of matched index are traced (null)"
    refracts = int(mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.GlossyTransmission)
    has_no_inside = int(mi.BSDFFlags.Null | mi.BSDFFlags.DiffuseTransmission)
    if not _lobes(bsdf) & refracts or _lobes(bsdf) & has_no_inside:
        bounds = f"bounds a medium that absorbs by a {bsdf.class_name()}"
        return f"{bounds}; only bodies that refract light are traced (dielectric, roughdielectric)"
    return None


def _lobes(bsdf: Any) -> int:
    """Bits of the components of a mitsuba.BSDF."""
    return int(bsdf.flags()) & int(mi.BSDFFlags.All)
