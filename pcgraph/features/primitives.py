# SPDX-License-Identifier: Apache-2.0
"""Planes, spheres and cylinders that fit groups of points best, from the groups' moments alone."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.powers import tensor
from pcgraph.features.primitive_moments import PrimitiveMoments
from pcgraph.short_repr import ShortRepr

_STRAIGHT = 1e7  # radius over size above which a round shape is a plane
_EXACT = 1e-6  # residual over size below which a fit counts as perfect: powers resolve no less


class Primitive(IntEnum):
    """Which shape a group of points has."""

    PLANE = 0
    SPHERE = 1
    CYLINDER = 2


@dataclass(frozen=True)
class Primitives(ShortRepr):
    """The best plane, sphere and cylinder of every one of k groups of points.

    Where a group is flat, so that no sphere or cylinder is better than its plane, the radius is infinite and centre
    or point are NaN.

    Attributes
    ----------
    plane_normal : (k, 3) float64
        Unit, on the side of the points' normals.
    plane_offset : (k,) float64, metres
        normal . x of the plane's points.
    plane_residual : (k,) float64, metres
        Root mean square distance to the plane, exactly.
    sphere_center : (k, 3) float64, metres
    sphere_radius : (k,) float64, metres
    sphere_residual : (k,) float64, metres
        Root mean square of Taubin's algebraic distance (d^2 - R^2) / (2 rms d), d the distance from the centre. Equals
        the geometric one, rms of d - R, up to the square of residual over radius.
    cylinder_axis : (k, 3) float64
        Unit, its largest component positive.
    cylinder_point : (k, 3) float64, metres
        Point of the axis nearest to the centroid.
    cylinder_radius : (k,) float64, metres
    cylinder_residual : (k,) float64, metres
        As for spheres, with d the distance from the axis.
    best : (k,) int8
        A `Primitive`: the simplest one that no other beats by the factor `gain`.
    """

    plane_normal: NDArray[np.float64]
    plane_offset: NDArray[np.float64]
    plane_residual: NDArray[np.float64]
    sphere_center: NDArray[np.float64]
    sphere_radius: NDArray[np.float64]
    sphere_residual: NDArray[np.float64]
    cylinder_axis: NDArray[np.float64]
    cylinder_point: NDArray[np.float64]
    cylinder_radius: NDArray[np.float64]
    cylinder_residual: NDArray[np.float64]
    best: NDArray[np.int8]

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """All features by name, in the order of the attributes."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def fit_primitives(moments: PrimitiveMoments, *, gain: float = 2.0, noise: float = 0.0) -> Primitives:
    """Planes, spheres and cylinders through every group of points.

    Parameters
    ----------
    moments : PrimitiveMoments of k groups
    gain : float, >= 1
        Factor by which a sphere has to lower the residual of the plane, and a cylinder that of the sphere (and of the
        plane), before it counts as the better description.
    noise : float, metres, >= 0
        Residuals below the sensor's noise count as that noise, so that no shape is preferred for fitting it.

    Raises
    ------
    ValueError
        `gain` or `noise` are out of range.

    Notes
    -----
    Sphere: Taubin 1991, smallest eigenvector of the covariance of (q, x) with q = |x|^2 over its gradient; no
    iteration, and unlike Kasa's fit hardly biased to small radii on caps. Cylinder: the axis is the direction with the
    least scatter of normals; the circle across it is fitted as the sphere is.
    """
    if not 1.0 <= gain < np.inf:
        raise ValueError(f"expected a finite gain of at least 1, got {gain!r}")
    if not 0.0 <= noise < np.inf:
        raise ValueError(f"expected noise as a finite number of metres, not negative, got {noise!r}")
    mean, second, third, fourth = _central(moments)
    centroid = moments.centers + mean * moments.scales[:, None]
    size = np.sqrt(np.trace(second, axis1=1, axis2=2)) * moments.scales

    variances, axes = np.linalg.eigh(second)
    normal = (
        axes[:, :, 0] * np.where(np.einsum("ki,ki->k", axes[:, :, 0], moments.normal_sums) < 0.0, -1.0, 1.0)[:, None]
    )
    flatness = np.sqrt(np.maximum(variances[:, 0], 0.0)) * moments.scales

    everywhere = np.broadcast_to(np.eye(3), second.shape)
    axis = _axis(moments.normal_scatters)
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    ball, ball_radius, ball_residual = _round(second, third, fourth, everywhere, moments.scales)
    tube, tube_radius, tube_residual = _round(second, third, fourth, across, moments.scales)
    # A round shape may be as straight as it likes, so it is never worse than the plane but by rounding.
    sphere_residual = np.minimum(ball_residual, flatness)
    cylinder_residual = np.where(np.isfinite(tube_radius), tube_residual, np.maximum(tube_residual, flatness))
    floor = np.maximum(noise, _EXACT * size)
    return Primitives(
        plane_normal=normal,
        plane_offset=np.einsum("ki,ki->k", normal, centroid),
        plane_residual=flatness,
        sphere_center=centroid + ball,
        sphere_radius=ball_radius,
        sphere_residual=sphere_residual,
        cylinder_axis=axis,
        cylinder_point=centroid + tube,
        cylinder_radius=tube_radius,
        cylinder_residual=cylinder_residual,
        best=_simplest(
            np.maximum(flatness, floor), np.maximum(sphere_residual, floor), np.maximum(cylinder_residual, floor), gain
        ),
    )


def _central(moments: PrimitiveMoments) -> tuple[NDArray[np.float64], ...]:
    """Mean, and the means of products of two, three and four coordinates about it, in the groups' units."""
    first, second, third, fourth = (
        tensor(moments.powers, r) / moments.counts.reshape(-1, *[1] * r) for r in range(1, 5)
    )
    # The origin is the centroid up to its rounding, so the mean is tiny and its second powers vanish.
    second = second - np.einsum("ki,kj->kij", first, first)
    turns = np.einsum("ki,kjl->kijl", first, second)
    third = third - turns - turns.transpose(0, 2, 1, 3) - turns.transpose(0, 3, 2, 1)
    four = np.einsum("ki,kjlm->kijlm", first, third)
    fourth = (
        fourth - four - four.transpose(0, 2, 1, 3, 4) - four.transpose(0, 3, 2, 1, 4) - four.transpose(0, 4, 2, 3, 1)
    )
    return first, second, third, fourth


def _axis(normal_scatters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Direction across which normals turn, (k, 3), its largest component positive."""
    axis = np.linalg.eigh(normal_scatters)[1][:, :, 0]
    largest = np.take_along_axis(axis, np.abs(axis).argmax(axis=1)[:, None], axis=1)
    return axis * np.where(largest < 0.0, -1.0, 1.0)


def _round(
    second: NDArray[np.float64],
    third: NDArray[np.float64],
    fourth: NDArray[np.float64],
    across: NDArray[np.float64],
    scales: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Centre relative to the centroid (k, 3), radius and residual (k,), metres, within the subspace `across`.

    With u the part of x in the subspace and q = |u|^2, Taubin's fit is the least eigenvector (alpha, b) of the
    covariance of ((q - mean q) / (2 sqrt(mean q)), u).
    """
    k = len(second)
    row, column = across.reshape(k, 1, 9), across.reshape(k, 9, 1)  # of these, one product sums over two indices
    mean_q = (row @ second.reshape(k, 9, 1))[:, 0, 0]
    unit = 2.0 * np.sqrt(np.where(mean_q > 0.0, mean_q, 1.0))
    inside = across @ second @ across
    outside = np.trace(second, axis1=1, axis2=2)[:, None, None] + 1.0
    covariance = np.empty((k, 4, 4))
    covariance[:, 0, 0] = ((row @ fourth.reshape(k, 9, 9) @ column)[:, 0, 0] - mean_q**2) / unit**2
    covariance[:, 0, 1:] = (row @ third.reshape(k, 9, 3) @ across)[:, 0] / unit[:, None]
    covariance[:, 1:, 0] = covariance[:, 0, 1:]
    covariance[:, 1:, 1:] = inside + outside * (np.eye(3) - across)  # keeps the fit within the subspace
    values, vectors = np.linalg.eigh(covariance)
    alpha, slope = vectors[:, 0, 0], vectors[:, 1:, 0]
    straight = (np.abs(alpha) * _STRAIGHT <= np.linalg.norm(slope, axis=1)) | (mean_q <= 0.0)
    bend = np.where(straight, np.nan, 2.0 * alpha / unit)
    center = -slope / bend[:, None]
    radius = np.where(straight, np.inf, np.sqrt(np.einsum("ki,ki->k", center, center) + mean_q))
    return center * scales[:, None], radius * scales, np.sqrt(np.maximum(values[:, 0], 0.0)) * scales


def _simplest(
    plane: NDArray[np.float64], sphere: NDArray[np.float64], cylinder: NDArray[np.float64], gain: float
) -> NDArray[np.int8]:
    """The first shape, in this order, that no later one beats by the factor `gain`."""
    flat = plane <= gain * np.minimum(sphere, cylinder)
    ball = sphere <= gain * cylinder
    return np.where(flat, Primitive.PLANE, np.where(ball, Primitive.SPHERE, Primitive.CYLINDER)).astype(np.int8)
