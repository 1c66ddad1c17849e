# SPDX-License-Identifier: Apache-2.0
"""Participating media of shapes: their coefficients, and which of them can be traced."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

_OBLIQUE = np.array(
    [
        *([0.83, 0.47, 0.31], [-0.71, 0.59, 0.39], [0.37, -0.89, 0.27], [-0.43, -0.61, 0.67]),
        *([0.23, 0.41, -0.88], [-0.57, 0.33, -0.75], [0.19, -0.53, -0.83]),
    ]
)
DIRECTIONS = _OBLIQUE / np.linalg.norm(_OBLIQUE, axis=1, keepdims=True)
"""(7, 3) float64, unit vectors in all directions. None is along an axis, because edges of shapes often lie along axes,
and a ray that meets an edge may be counted wrongly. Seven is odd, so a majority exists."""
MAX_SURFACES = 64
"""Number of surfaces along a ray after which the search for enclosing bodies stops, so that its time is bounded;
surfaces beyond are ignored. A larger number costs time only where a ray crosses more surfaces."""


def is_boundary(shape: Any) -> bool:
    """Whether the shape is filled with a medium and does not refract at its boundary (matched index, BSDF `null`)."""
    has_interior = bool(shape.is_medium_transition()) and shape.interior_medium() is not None
    return has_interior and _lobes(shape.bsdf()) == int(mi.BSDFFlags.Null)


def medium_numbers(medium: Any) -> tuple[float, float, float]:
    """Coefficients of a homogeneous mitsuba.Medium: sigma_t in 1/m, the albedo, and the mean cosine g of scattering."""
    at = dr.zeros(mi.MediumInteraction3f, 1)
    sigma_s, _, sigma_t = (float(mi.unpolarized_spectrum(c)[0][0]) for c in medium.get_scattering_coefficients(at))
    g = np.ravel(dict(mi.traverse(medium)).get("phase_function.g", 0.0))[0]  # isotropic media have no such entry
    return sigma_t, sigma_s / sigma_t if sigma_t else 0.0, float(g)


def why_not_traced(shape: Any) -> str | None:
    """The reason why the media of a shape cannot be traced, as the end of a sentence; None if they can.

    A medium that scatters must fill a shape whose boundary has a matched index of refraction. A medium that only
    absorbs may also fill a body that refracts, or surround such a shape or body
    (`rangesim.light_transport.absorption`).
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
        return "has an exterior medium that scatters, or no medium inside; only media inside closed shapes are traced"
    if not medium_numbers(interior)[0] > 0:
        return "is filled with a medium of no density; expected a positive sigma_t"
    if interior.phase_function().class_name() not in ("IsotropicPhaseFunction", "HGPhaseFunction"):
        return f"scatters by a {interior.phase_function().class_name()}; only isotropic and hg are traced"
    return None


class MediumAround(NamedTuple):
    """The medium in which a place lies: its shape's id, `medium_numbers`, and whether it scatters."""

    body: str
    numbers: tuple[float, float, float]
    scatters: bool


def body_around(scene: Any, place: np.ndarray) -> str | None:
    """The id of a shape that is filled with a medium and contains a place (3,), metres; None if there is none."""
    around = medium_around(scene, place)
    return None if around is None else around.body


def medium_around(scene: Any, place: np.ndarray) -> MediumAround | None:
    """The medium in which a place (3,), metres, lies; None if there is none. Of nested bodies, any may be chosen.

    Rays in several directions count how often they leave and enter each filled shape, judged by its normals. The place
    is inside a shape if most rays leave it more often than they enter it.
    """
    filled = [shape for shape in scene.shapes() if shape.interior_medium() is not None]
    filled = [shape for shape in filled if medium_numbers(shape.interior_medium())[0] > 0]
    if not filled:
        return None
    left = np.zeros((len(filled), len(DIRECTIONS)), np.int64)
    for outward, met in _crossings(scene, place, DIRECTIONS):
        for count, shape in zip(left, filled, strict=True):
            count += outward * (met == mi.ShapePtr(shape)).numpy()
    inside = (left > 0).sum(axis=1) > len(DIRECTIONS) / 2
    shape = next((shape for shape, is_in in zip(filled, inside, strict=True) if is_in), None)
    if shape is None:
        return None
    return MediumAround(str(shape.id()), medium_numbers(shape.interior_medium()), is_boundary(shape))


def _crossings(scene: Any, place: np.ndarray, directions: np.ndarray) -> Iterator[tuple[np.ndarray, Any]]:
    """The surfaces that rays from a place (3,), metres, in directions (n, 3) cross, one after another.

    Yields
    ------
    outward : (n,) int64, 1 where a ray crosses along the normal, -1 against it, 0 where it meets no further surface.
    shapes : n pointers of Mitsuba to the shapes crossed.
    """
    ray = mi.Ray3f(o=mi.Point3f(*map(float, place)), d=mi.Vector3f(np.asarray(directions, np.float32).T))
    active = mi.Bool(True)
    for _ in range(MAX_SURFACES):
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        active = si.is_valid()
        if not dr.any(active):
            return
        yield (np.sign(dr.dot(ray.d, si.n).numpy()) * active.numpy()).astype(np.int64), si.shape
        ray = si.spawn_ray(ray.d)


def inside_out(scene: Any, place: np.ndarray, directions: np.ndarray) -> tuple[str, str] | None:
    """A shape that rays leave without having entered it, which means that its normals point the wrong way.

    Parameters
    ----------
    place : (3,) metres, in air. directions : (n, 3), directions of rays from there.

    Returns
    -------
    None if there is no such shape; else its id and a side. Only rays count that are inside no body when they first meet
    the shape. The side is "interior" if most of them seem to leave the interior medium of the shape: its normals then
    point inwards. The side is "exterior" if most of them seem to come from its exterior medium, although they started
    in air.
    """
    filled, around = (
        [s for s in scene.shapes() if m(s) is not None and medium_numbers(m(s))[0] > 0]
        for m in (lambda s: s.interior_medium(), lambda s: s.exterior_medium())
    )
    if not filled and not around:
        return None
    bodies = np.zeros(len(directions), np.int64)  # number of bodies that each ray is inside of
    sides = [(s, "interior", 1) for s in filled] + [(s, "exterior", -1) for s in around]
    votes, unmet = [0] * len(sides), [np.ones(len(directions), bool) for _ in sides]
    for outward, shapes in _crossings(scene, place, directions):
        in_air = bodies == 0
        for number, (shape, side, amiss) in enumerate(sides):
            met = outward * (shapes == mi.ShapePtr(shape)).numpy()
            votes[number] += amiss * int(met[in_air & unmet[number]].sum())
            unmet[number] &= met == 0
            if side == "interior":
                bodies = np.maximum(bodies - met, 0)
    return next(((str(s.id()), side) for (s, side, _), n in zip(sides, votes, strict=True) if n > 0), None)


def _why_not_homogeneous(medium: Any) -> str | None:
    if medium.class_name() != "HomogeneousMedium":
        return str(medium.class_name())
    is_constant = {"albedo.value.value", "sigma_t.value.value"} <= set(dict(mi.traverse(medium)))
    return None if is_constant else "medium that varies from place to place"


def _why_not_absorbing(bsdf: Any, media: list[Any]) -> str | None:
    """The reason why media beside a surface that is no boundary of matched index cannot be traced; None if they can."""
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
