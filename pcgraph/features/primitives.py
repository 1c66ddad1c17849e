# SPDX-License-Identifier: Apache-2.0
"""Planes, spheres and cylinders that fit groups of points best, from the groups' moments alone.

The moments are sums of powers up to the fourth order, and additive, so every node of a tree has its best shapes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.moments import accumulate_moments, moments_of_groups
from pcgraph.parallel import kernel, routine
from pcgraph.plumbing.plain_dict import PlainDict
from pcgraph.plumbing.short_repr import ShortRepr

_MAX_RADIUS = 1e7
"""Ratio of the radius of a round shape to the size of its group above which the shape counts as a plane. Chosen by eye;
not varied."""
_MIN_RESIDUAL = 1e-6
"""Ratio of the residual of a fit to the size of its group below which the fit counts as perfect, because powers resolve
no less. Chosen by eye; not varied."""


class Primitive(IntEnum):
    """Kind of shape of a group of points."""

    PLANE = 0
    SPHERE = 1
    CYLINDER = 2


@dataclass(frozen=True, eq=False)
class Primitives(ShortRepr, PlainDict):
    """The best plane, sphere and cylinder of each of k groups of points.

    If a group is flat, so that no sphere or cylinder fits better than the plane, radii are infinite, and centre and
    point NaN.

    Attributes
    ----------
    plane_normal : (k, 3) float64
        Unit normal, on the side of the points' normals.
    plane_offset : (k,) float64, metres
        normal . x of the plane's points x.
    plane_residual : (k,) float64, metres
        Root mean square distance from the plane, exactly.
    sphere_center : (k, 3) float64, metres
    sphere_radius : (k,) float64, metres
    sphere_residual : (k,) float64, metres
        Root mean square of Taubin's algebraic distance (d^2 - R^2) / (2 rms d), with d the distance from the centre. It
        equals the geometric one, rms of d - R, up to the square of residual over radius.
    cylinder_axis : (k, 3) float64
        Unit vector, its largest component positive.
    cylinder_point : (k, 3) float64, metres
        Point of the axis that is nearest to the centroid.
    cylinder_radius : (k,) float64, metres
    cylinder_residual : (k,) float64, metres
        As for spheres, with d the distance from the axis.
    best : (k,) int8
        A `Primitive`: the simplest shape that no other beats by the factor `gain`.
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

    def to_dict(self) -> dict[str, Any]:
        """The attributes by name as lists of k, metres; None if not finite; `best` as "plane", "sphere", "cylinder"."""
        return {**super().to_dict(), "best": [Primitive(kind).name.lower() for kind in self.best.tolist()]}


def fit_primitives(moments: PrimitiveMoments, *, gain: float = 2.0, noise: float = 0.0) -> Primitives:
    """Planes, spheres and cylinders through every group of points.

    Parameters
    ----------
    moments : PrimitiveMoments of k groups
    gain : float, >= 1
        Factor by which a sphere has to lower the residual of the plane, and a cylinder those of sphere and plane, to
        count as the better shape.
    noise : float, metres, >= 0
        Noise of the sensor. Smaller residuals count as this noise, so that no shape is preferred for fitting noise.

    Raises
    ------
    ValueError
        `gain` or `noise` are out of range.

    Notes
    -----
    Sphere: Taubin 1991, the eigenvector of the least eigenvalue of the covariance of (q, x), with q = |x|^2 over its
    gradient. It needs no iteration, and unlike Kasa's fit it is hardly biased to small radii on caps. Cylinder: the
    axis is the direction with the least scatter of normals; the circle across it is fitted as the sphere is.
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
    # A round shape can be nearly straight, so it is worse than the plane only by rounding.
    sphere_residual = np.minimum(ball_residual, flatness)
    cylinder_residual = np.where(np.isfinite(tube_radius), tube_residual, np.maximum(tube_residual, flatness))
    floor = np.maximum(noise, _MIN_RESIDUAL * size)
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
    """Mean, and means of products of two, three and four coordinates about the mean, in the groups' units."""
    first, second, third, fourth = (
        tensor(moments.powers, r) / moments.counts.reshape(-1, *[1] * r) for r in range(1, 5)
    )
    # The origin is the rounded centroid, so the mean is tiny, and its second powers are left out.
    second = second - np.einsum("ki,kj->kij", first, first)
    turns = np.einsum("ki,kjl->kijl", first, second)
    third = third - turns - turns.transpose(0, 2, 1, 3) - turns.transpose(0, 3, 2, 1)
    four = np.einsum("ki,kjlm->kijlm", first, third)
    fourth = (
        fourth - four - four.transpose(0, 2, 1, 3, 4) - four.transpose(0, 3, 2, 1, 4) - four.transpose(0, 4, 2, 3, 1)
    )
    return first, second, third, fourth


def _axis(normal_scatters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Direction about which normals turn, (k, 3), its largest component positive."""
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
    row, column = across.reshape(k, 1, 9), across.reshape(k, 9, 1)  # products with these sum over two indices
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
    straight = (np.abs(alpha) * _MAX_RADIUS <= np.linalg.norm(slope, axis=1)) | (mean_q <= 0.0)
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


# --- moments of groups up to the fourth order ---


@dataclass(frozen=True, eq=False)
class PrimitiveMoments(ShortRepr):
    """Moments of k groups of points up to the fourth order, and second moments of their normals.

    Attributes
    ----------
    counts : (k,) int64
        Number of points of each group, >= 1.
    centers : (k, 3) float64, metres
        Centroid of each group, rounded to float64: the origin of its powers.
    scales : (k,) float64, metres
        Unit of each group's powers: a power of two near the group's root mean square radius, or 1 if that is 0.
    powers : (k, 35) float64, dimensionless
        Sums over the points of x^a y^b z^c, with (x, y, z) = (point - center) / scale and a + b + c <= 4, in the order
        of `EXPONENTS`.
    normal_sums : (k, 3) float64
        Sum of the points' normals.
    normal_scatters : (k, 3, 3) float64
        Sum of n n^T over the points' normals n.

    Notes
    -----
    Up a tree groups only get larger, so no digits cancel. Do not subtract a group from a far larger or distant one:
    fourth powers lose four times as many digits as distances do.
    """

    counts: NDArray[np.int64]
    centers: NDArray[np.float64]
    scales: NDArray[np.float64]
    powers: NDArray[np.float64]
    normal_sums: NDArray[np.float64]
    normal_scatters: NDArray[np.float64]

    def __len__(self) -> int:
        """Number of groups."""
        return len(self.counts)


def primitive_moments(
    points: ArrayLike, normals: ArrayLike, groups: NDArray[np.int32], n_groups: int
) -> PrimitiveMoments:
    """Moments of points by group.

    Parameters
    ----------
    points : (n, 3) float64, metres
    normals : (n, 3) float64
        Unit normals; those of the points' voxels suffice: ``surface.normals[surface.grid.voxel_of_point]``.
    groups : (n,) int32, 0..n_groups - 1
        Every group has at least one point.
    n_groups : int

    Raises
    ------
    ValueError
        A shape is not as above, a number is not finite, or a group is out of range or has no point.
    """
    places, directions = finite_vectors("points", points), finite_vectors("normals", normals)
    if not len(places) == len(directions) == len(groups):
        raise ValueError(
            f"expected one normal and one group per point, got {len(places)} points, {len(directions)} normals, "
            f"{len(groups)} groups"
        )
    if groups.min(initial=0) < 0 or groups.max(initial=-1) != n_groups - 1 or not np.bincount(groups).all():
        raise ValueError(f"expected all of the groups 0..{n_groups - 1}, with a point each, and no others")
    low = moments_of_groups(places, None, groups, n_groups)
    scales = _scales(low.counts, low.scatters)
    powers = sums_of_powers(places, groups, low.centroids, scales)
    sums, scatters = _normal_moments(directions, groups, n_groups)
    return PrimitiveMoments(low.counts, low.centroids, scales, powers, sums, scatters)


def finite_vectors(name: str, vectors: ArrayLike) -> NDArray[np.float64]:
    """The vectors as (n, 3) float64; ValueError if they have another shape or are not all finite numbers."""
    array = np.asarray(vectors)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise ValueError(f"expected {name} as numbers of shape (n, 3), got {array.shape} {array.dtype}")
    if not np.isfinite(array).all():
        raise ValueError(f"expected {name} as finite numbers; leave out points that have NaN or infinite ones")
    return array.astype(np.float64, copy=False)


def primitive_moments_up_tree(leaves: PrimitiveMoments, parents: NDArray[np.int32]) -> PrimitiveMoments:
    """Moments of every node of a tree, from those of its leaves.

    Parameters
    ----------
    leaves : PrimitiveMoments
        Moments of the first nodes, in order.
    parents : (k,) int32
        Parent of each node; larger than the node's own number, except for the root, which is its own parent.
    """
    k, n = len(parents), len(leaves)
    counts, centers, scatters = np.zeros(k, np.int64), np.zeros((k, 3)), np.zeros((k, 3, 3))
    counts[:n], centers[:n] = leaves.counts, leaves.centers
    scatters[:n] = tensor(leaves.powers, 2) * (leaves.scales**2)[:, None, None]
    # Centres and scales of inner nodes are needed before their powers are summed.
    accumulate_moments(parents, counts, centers, scatters)
    scales = np.concatenate((leaves.scales, _scales(counts[n:], scatters[n:])))
    powers = np.zeros((k, N_POWERS))
    normal_sums, normal_scatters = np.zeros((k, 3)), np.zeros((k, 3, 3))
    powers[:n], normal_sums[:n], normal_scatters[:n] = leaves.powers, leaves.normal_sums, leaves.normal_scatters
    _accumulate(parents, centers, scales, powers, normal_sums, normal_scatters)
    return PrimitiveMoments(counts, centers, scales, powers, normal_sums, normal_scatters)


def _scales(counts: NDArray[np.int64], scatters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Powers of two next above the root mean square radii; products with powers of two are exact."""
    radius = np.sqrt(np.trace(scatters, axis1=1, axis2=2) / counts)
    return np.where(radius > 0.0, np.ldexp(1.0, np.frexp(radius)[1]), 1.0)


@kernel
def _normal_moments(  # type: ignore[no-untyped-def]
    normals: NDArray[np.float64], groups: NDArray[np.int32], n_groups: int
):
    """Sums of n, and of n n^T, by group."""
    sums, scatters = np.zeros((n_groups, 3)), np.zeros((n_groups, 3, 3))
    for i in range(len(groups)):
        for a in range(3):
            sums[groups[i], a] += normals[i, a]
            for b in range(3):
                scatters[groups[i], a, b] += normals[i, a] * normals[i, b]
    return sums, scatters


@kernel
def _accumulate(parents, centers, scales, powers, normal_sums, normal_scatters):  # type: ignore[no-untyped-def]
    """Add each node's sums to those of its parent, children first."""
    for node in range(len(parents)):
        up = parents[node]
        if up == node:
            continue
        add_moved(powers[up], powers[node], (centers[node] - centers[up]) / scales[up], scales[node] / scales[up])
        for a in range(3):
            normal_sums[up, a] += normal_sums[node, a]
            for b in range(3):
                normal_scatters[up, a, b] += normal_scatters[node, a, b]


# --- sums of powers, and their change to another origin and unit ---

# Row t stands for x^a y^b z^c. Rows ascend in order a + b + c: 1, 3, 6, 10 and 15 rows have order 0, 1, 2, 3 and 4.
EXPONENTS = np.array(
    [(a, b, order - a - b) for order in range(5) for a in range(order, -1, -1) for b in range(order - a, -1, -1)],
    dtype=np.int64,
)
N_POWERS = len(EXPONENTS)
_ROW = np.full((5, 5, 5), -1, np.int64)
_ROW[EXPONENTS[:, 0], EXPONENTS[:, 1], EXPONENTS[:, 2]] = np.arange(N_POWERS)
_CHOOSE = np.array([[1, 0, 0, 0, 0], [1, 1, 0, 0, 0], [1, 2, 1, 0, 0], [1, 3, 3, 1, 0], [1, 4, 6, 4, 1]], np.float64)


def tensor(powers: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """Sums of all products of `order` coordinates, (k, 3, ..., 3), from their (k, 35) sums of powers."""
    axes = np.indices((3,) * order).reshape(order, -1)
    exponents = np.stack([(axes == axis).sum(axis=0) for axis in range(3)])
    return powers[:, _ROW[tuple(exponents)]].reshape(len(powers), *(3,) * order)


@kernel
def sums_of_powers(
    points: NDArray[np.float64], groups: NDArray[np.int32], centers: NDArray[np.float64], scales: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Sums of x^a y^b z^c over the points of each of k groups, (k, 35), dimensionless.

    Parameters
    ----------
    points : (n, 3) float64, metres
    groups : (n,) int32, 0..k - 1
    centers : (k, 3) float64, metres
        Origin of each group's coordinates.
    scales : (k,) float64, metres
        Unit of each group's coordinates.
    """
    sums = np.zeros((len(centers), N_POWERS))
    ladder = np.ones((3, 5))
    for i in range(len(points)):
        s = groups[i]
        for axis in range(3):
            x = (points[i, axis] - centers[s, axis]) / scales[s]
            for order in range(1, 5):
                ladder[axis, order] = ladder[axis, order - 1] * x
        for t in range(N_POWERS):
            sums[s, t] += ladder[0, EXPONENTS[t, 0]] * ladder[1, EXPONENTS[t, 1]] * ladder[2, EXPONENTS[t, 2]]
    return sums


@routine
def add_moved(
    target: NDArray[np.float64], source: NDArray[np.float64], offset: NDArray[np.float64], ratio: float
) -> None:
    """Add the points of the sums `source` to the sums `target`, in the target's coordinates.

    Parameters
    ----------
    target, source : (35,) float64
        Sums of powers; `target` is changed.
    offset : (3,) float64
        Origin of the source in the target's coordinates.
    ratio : float
        Unit of the source over that of the target.

    Notes
    -----
    It applies the binomial theorem, so the result is exact but for rounding.
    """
    ladder = np.ones((3, 5))
    units = np.ones(5)
    for order in range(1, 5):
        units[order] = units[order - 1] * ratio
        for axis in range(3):
            ladder[axis, order] = ladder[axis, order - 1] * offset[axis]
    for t in range(N_POWERS):
        a, b, c = EXPONENTS[t]
        for i in range(a + 1):
            for j in range(b + 1):
                for k in range(c + 1):
                    ways = _CHOOSE[a, i] * _CHOOSE[b, j] * _CHOOSE[c, k]
                    shift = ladder[0, a - i] * ladder[1, b - j] * ladder[2, c - k]
                    target[t] += ways * shift * units[i + j + k] * source[_ROW[i, j, k]]
