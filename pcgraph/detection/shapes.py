# SPDX-License-Identifier: Apache-2.0
"""Shapes of objects: which of plane, box, sphere and closed cylinder fits what was seen.

Kinds are the primitives of `pcgraph.features.primitives` and the box. Plane, sphere and the axis of the cylinder are
fitted there, from moments. Three things differ. A box has no fit from moments. An object's cylinder has an end, whose
points would pull a circle through all points inwards, so its circle goes through the points of the wall alone. And
kinds are compared by geometric distances, ends and edges included, where moments know algebraic ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.detection.boxes import OrientedBox, some_points, standing_box, tight_box
from pcgraph.features.nodes import unit_vector
from pcgraph.features.primitives import finite_vectors, fit_primitives, primitive_moments
from pcgraph.plumbing.plain_dict import PlainDict
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.directions import plane_basis

Kind = Literal["plane", "box", "sphere", "cylinder"]

ROUNDS = 6
"""Number of Gauss-Newton steps on a circle, and of moves of the sides of a box. Measured on mOSD: three rounds give the
same kinds, and residuals within 5 %."""


@dataclass(frozen=True)
class ShapeLimits:
    """Least and largest numbers for points to be a shape, and for a shape to beat a plane. None was varied."""

    min_side_fraction: float = 0.05
    """Fraction of the points that a side of a box, or the end of a cylinder, needs to be moved to them: fewer are
    noise."""
    max_wall_cosine: float = 0.5
    """|normal . axis| below which a point counts to the wall of a cylinder, above to its ends: 30 degrees off the
    wall's normals, 60 off those of the ends, as normals at the edge between them lean to the wall."""
    min_thickness: float = 2.0
    """Least thickness of a box over the residual of its plane: a flat patch has room for a flat box in its noise."""
    min_gain: float = 0.7
    """Ratio of residuals below which a shape is better than a plane: boxes, spheres and cylinders contain planes as
    limits, and so always fit a little better."""
    min_wall_points: int = 5
    """Points for a circle, which has three parameters, to say more than that it can be drawn."""
    max_radius: float = 100.0
    """Radius of a circle over the size of its points above which they are straight: the arc rises by half a percent of
    its length."""


LIMITS = ShapeLimits()


@dataclass(frozen=True, eq=False)
class Shape(ShortRepr, PlainDict):
    """Shape that fits points best.

    Attributes
    ----------
    kind : "plane", "box", "sphere" or "cylinder"
    residual : float, metres
        Root mean square distance of the points to its surface.
    residuals : dict from kind to float, metres
        The same for all kinds tried.
    center : (3,) float64, metres, the points' frame
        Of box, sphere and cylinder (halfway between its ends as seen); of a plane, the points' mean.
    axis : (3,) float64
        Unit: the cylinder's axis, the plane's normal, the box's longest side; zero for a sphere.
    radius : float, metres
        Of sphere and cylinder; NaN otherwise.
    box : OrientedBox or None
        The fitted box, if that is the kind.
    """

    kind: Kind
    residual: float
    residuals: dict[Kind, float]
    center: NDArray[np.float64]
    axis: NDArray[np.float64]
    radius: float
    box: OrientedBox | None


def fit_shape(points: ArrayLike, normals: ArrayLike, up: ArrayLike | None = None) -> Shape:
    """Shape whose surface lies nearest to points, by root mean square distance.

    Parameters
    ----------
    points : (n, 3) float, metres
        n >= 1, finite; parts of the surface may be missing.
    normals : (n, 3) float
        Unit normals at the points.
    up : (3,) float, any length but zero, optional
        Along which boxes and cylinders are likely to stand: tried besides other poses.

    Raises
    ------
    ValueError
        An argument is not as above.
    """
    places, directions = some_points(points), finite_vectors("normals", normals)
    if len(places) != len(directions):
        raise ValueError(f"expected one normal per point, got {len(places)} points and {len(directions)} normals")
    upwards = None if up is None else unit_vector("up", up)
    fits = fit_primitives(primitive_moments(places, directions, np.zeros(len(places), np.int32), 1))
    flat = Shape(
        "plane",
        float(fits.plane_residual[0]),
        {},
        places.mean(axis=0),
        fits.plane_normal[0],
        float("nan"),
        None,
    )
    boxes = _boxes(places, upwards)
    found = [flat, *(b for b in boxes if b.box is not None and b.box.size.min() > LIMITS.min_thickness * flat.residual)]
    center, radius = fits.sphere_center[0], float(fits.sphere_radius[0])
    if np.isfinite(radius):
        distance = np.linalg.norm(places - center, axis=1) - radius
        found.append(Shape("sphere", _rms(distance), {}, center, np.zeros(3), radius, None))
    axes = [fits.cylinder_axis[0]] + ([] if upwards is None else [upwards])
    for axis in axes:
        found += _cylinder(places, directions, axis)
    residuals: dict[Kind, float] = {}
    for shape in found:
        residuals[shape.kind] = min(shape.residual, residuals.get(shape.kind, np.inf))
    best = min(found, key=lambda shape: shape.residual * (LIMITS.min_gain if shape.kind == "plane" else 1.0))
    return Shape(best.kind, best.residual, residuals, best.center, best.axis, best.radius, best.box)


def _boxes(points: NDArray[np.float64], up: NDArray[np.float64] | None) -> list[Shape]:
    shapes = []
    for around in [tight_box(points)] + ([] if up is None else [standing_box(points, up)]):
        box = _fitted_box(points, around)
        longest = box.axes[int(box.size.argmax())]
        shapes.append(Shape("box", _rms(box.distances(points)), {}, box.center, longest, float("nan"), box))
    return shapes


def _fitted_box(points: NDArray[np.float64], box: OrientedBox) -> OrientedBox:
    """The box with its sides moved from the outermost points to the middle of the points near them."""
    low, high = -box.size / 2.0, box.size / 2.0
    local = box.local(points)
    for _ in range(ROUNDS):
        gaps = np.concatenate((np.abs(local - low), np.abs(local - high)), axis=1)
        side = gaps.argmin(axis=1)
        for axis in range(3):
            for limits, number in ((low, axis), (high, axis + 3)):
                near = local[side == number, axis]
                if len(near) >= LIMITS.min_side_fraction * len(local):
                    limits[axis] = float(np.median(near))
        low, high = np.minimum(low, high), np.maximum(low, high)
    return OrientedBox(box.center + (low + high) / 2.0 @ box.axes, box.axes, high - low)


def _cylinder(points: NDArray[np.float64], normals: NDArray[np.float64], axis: NDArray[np.float64]) -> list[Shape]:
    """Closed cylinder about an axis of this direction; none if no wall is seen."""
    wall = np.abs(normals @ axis) < LIMITS.max_wall_cosine
    basis = plane_basis(axis)
    flat = points @ basis.T
    if wall.sum() < LIMITS.min_wall_points:
        return []
    circle = _circle(flat[wall])
    if circle is None:
        return []
    center, radius = circle
    height = points @ axis
    low, high = float(height.min()), float(height.max())
    capped = ~wall & (height > (low + high) / 2.0)
    if capped.sum() >= LIMITS.min_side_fraction * len(points):
        high = float(np.median(height[capped]))
    across = np.linalg.norm(flat - center, axis=1) - radius
    along = np.abs(height - (low + high) / 2.0) - (high - low) / 2.0
    beyond = np.hypot(np.maximum(across, 0.0), np.maximum(along, 0.0))
    # The lower end stands on something and is not seen: only the upper one counts as surface.
    inside = np.minimum(-across, np.abs(high - height))
    distance = np.where((across <= 0.0) & (along <= 0.0), inside, beyond)
    middle = center @ basis + (low + high) / 2.0 * axis
    return [Shape("cylinder", _rms(distance), {}, middle, axis, radius, None)]


def _circle(flat: NDArray[np.float64]) -> tuple[NDArray[np.float64], float] | None:
    """Centre and radius of the circle near points (n, 2): algebraic first, then least squares of distances."""
    mean = flat.mean(axis=0)
    local = flat - mean
    scale = float(np.sqrt((local**2).sum(axis=1).mean()))
    if scale == 0.0:
        return None
    local = local / scale
    design = np.column_stack((2.0 * local, np.ones(len(local))))
    solution, _, rank, _ = np.linalg.lstsq(design, (local**2).sum(axis=1), rcond=1e-6)
    if rank < 3:
        return None
    center = solution[:2]
    for _ in range(ROUNDS):  # Gauss-Newton on distance - radius; the mean distance is the best radius
        offset = local - center
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        toward = offset / distance[:, None]
        slope = toward - toward.mean(axis=0)
        center = center + np.linalg.lstsq(slope, distance - distance.mean(), rcond=1e-3)[0]
    radius = float(np.linalg.norm(local - center, axis=1).mean())
    if not radius < LIMITS.max_radius:
        return None
    return mean + scale * center, scale * radius


def _rms(distances: NDArray[np.float64]) -> float:
    return float(np.sqrt((distances**2).mean()))
