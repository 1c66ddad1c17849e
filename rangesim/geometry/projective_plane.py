# SPDX-License-Identifier: Apache-2.0
"""The projective plane: points and lines, the four kinds of plane transforms, rectification of planes.

A point (x, y) is any multiple of (x, y, 1), a line a x + b y + c = 0 any multiple of (a, b, c). Points with a last
coordinate of 0 lie at infinity, all of them on the line (0, 0, 1). Hartley, Zisserman: "Multiple View Geometry in
Computer Vision", 2nd edition 2004 (HZ), chapter 2, whose symbols are kept.

All functions but `classify` and the rectifications work on batches: leading dimensions broadcast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.correspondences import ROUNDING, Array, checked_array, unit_norm

LINE_AT_INFINITY: tuple[float, float, float] = (0.0, 0.0, 1.0)
"""Meets every line in its point at infinity; fixed by a map if and only if that is an affinity."""

LAST_DIGITS = 1e-15
"""Relative error of a few operations in double precision: below it a homogeneous coordinate is 0, and lines at that
angle, in radians, are parallel."""


def homogeneous(points: ArrayLike) -> Array:
    """(..., 3) float64 (x, y, 1) of points (..., 2)."""
    xy = checked_array("points", points, 2)
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)


def euclidean(points: ArrayLike) -> Array:
    """(..., 2) float64 (x/w, y/w) of homogeneous points (..., 3); NaN for points at infinity (see `is_at_infinity`)."""
    p = checked_array("points", points, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(is_at_infinity(p)[..., None], np.nan, p[..., :2] / p[..., 2:])


def is_at_infinity(points: ArrayLike) -> np.ndarray:
    """(...,) bool: the last of the homogeneous coordinates (..., 3) is 0, to 1e-15 of the largest."""
    p = checked_array("points", points, 3)
    return np.asarray(np.abs(p[..., 2]) <= LAST_DIGITS * np.abs(p).max(axis=-1))


def join(first: ArrayLike, second: ArrayLike) -> Array:
    """(..., 3) the line through two homogeneous points (..., 3): their cross product; 0 where they are the same."""
    return np.asarray(np.cross(checked_array("first", first, 3), checked_array("second", second, 3)))


def meet(first: ArrayLike, second: ArrayLike) -> Array:
    """(..., 3) the point on two lines (..., 3): their cross product; 0 where they are the same.

    Parallel lines (l1, l2, l3) and (l1, l2, m3) meet at (m3 - l3) (l2, -l1, 0), at infinity. Lines whose directions
    differ by less than 1e-15 rad are parallel: this is what rounding of their coefficients leaves, and the last
    coordinate of the point is then exactly 0.
    """
    point = join(first, second)
    a, b = np.broadcast_arrays(checked_array("first", first, 3), checked_array("second", second, 3))
    normal_a, normal_b = np.linalg.norm(a[..., :2], axis=-1), np.linalg.norm(b[..., :2], axis=-1)
    is_parallel = np.abs(point[..., 2]) <= LAST_DIGITS * normal_a * normal_b
    rounding = LAST_DIGITS * (normal_a * np.abs(b[..., 2]) + normal_b * np.abs(a[..., 2]))
    is_same = is_parallel & (np.abs(point[..., :2]).max(axis=-1) <= rounding)
    point[..., 2] = np.where(is_parallel, 0.0, point[..., 2])
    return np.where(is_same[..., None], 0.0, point)


def point_at_infinity(line: ArrayLike) -> Array:
    """(..., 3) where lines (..., 3) meet the line at infinity: (b, -a, 0), the direction of the line."""
    return meet(line, LINE_AT_INFINITY)


def map_points(H: ArrayLike, points: ArrayLike) -> Array:
    """(..., n, 2) images x' = H x of points (..., n, 2) under maps H (..., 3, 3); NaN where they lie at infinity."""
    h = checked_array("H", H, 3, 3)
    mapped = homogeneous(checked_array("points", points, None, 2)) @ np.swapaxes(h, -1, -2)
    return euclidean(mapped)


def map_lines(H: ArrayLike, lines: ArrayLike) -> Array:
    """(..., n, 3) images l' = H^-T l of lines (..., n, 3) under maps H (..., 3, 3).

    Raises
    ------
    ValueError
        H is singular: it has no map of lines.
    """
    h = checked_array("H", H, 3, 3)
    if np.any(_is_singular(h)):
        raise ValueError(
            "expected H to be invertible, got a singular matrix, which maps the plane to a line or a point."
        )
    return np.asarray(checked_array("lines", lines, None, 3) @ np.linalg.inv(h))


Kind = Literal["isometry", "similarity", "affinity", "projectivity"]
DEGREES_OF_FREEDOM: dict[Kind, int] = {"isometry": 3, "similarity": 4, "affinity": 6, "projectivity": 8}
INVARIANTS: dict[Kind, tuple[str, ...]] = {
    "isometry": ("length", "area", "angle", "ratio of lengths", "ratio of areas", "circular points"),
    "similarity": ("ratio of lengths", "ratio of areas", "angle", "circular points"),
    "affinity": (
        "parallelism",
        "ratio of areas",
        "ratio of lengths on parallel lines",
        "centroid",
        "line at infinity",
    ),
    "projectivity": ("concurrency", "collinearity", "order of contact", "cross ratio"),
}
"""HZ table 2.4. What a kind keeps, all kinds above it in the list keep, too."""


@dataclass(frozen=True, eq=False)
class Decomposition:
    """H = H_S H_A H_P up to scale (HZ 2.17): first what is projective, then what is affine, then a similarity.

        H_S = [s R, t; 0, 1]    H_A = [K, 0; 0, 1]    H_P = [I, 0; v^T, 1]

    scale : s, positive. rotation_rad : angle of R, anticlockwise from x to y. is_reversing : whether H mirrors, which
    then stands in K. translation : (2,) t. affine : (2, 2) K, upper triangular, determinant 1 or -1, first entry
    positive. projective : (2,) v, 1 / length.
    """

    scale: float
    rotation_rad: float
    is_reversing: bool
    translation: Array
    affine: Array
    projective: Array

    @property
    def shear(self) -> float:
        """K12 / K11: by how much y moves x."""
        return float(self.affine[0, 1] / self.affine[0, 0])

    @property
    def aspect(self) -> float:
        """|K11 / K22|: the ratio of the scales of x and y."""
        return float(abs(self.affine[0, 0] / self.affine[1, 1]))

    @property
    def H_S(self) -> Array:
        """(3, 3) the similarity."""
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        result = np.eye(3)
        result[:2, :2] = self.scale * np.array([[c, -s], [s, c]])
        result[:2, 2] = self.translation
        return result

    @property
    def H_A(self) -> Array:
        """(3, 3) the affinity."""
        result = np.eye(3)
        result[:2, :2] = self.affine
        return result

    @property
    def H_P(self) -> Array:
        """(3, 3) the projectivity that moves the line at infinity."""
        result = np.eye(3)
        result[2, :2] = self.projective
        return result


@dataclass(frozen=True, eq=False)
class PlaneTransform:
    """What a map of the plane is.

    kind : the most special of isometry, similarity, affinity, projectivity that it is. degrees_of_freedom : of its
    kind. invariants : what its kind keeps (`INVARIANTS`). decomposition : None if it sends the origin to infinity
    (H33 = 0), where there is none: move the origin first.
    """

    kind: Kind
    degrees_of_freedom: int
    invariants: tuple[str, ...]
    decomposition: Decomposition | None


def classify(H: ArrayLike, tolerance: float = 1e-9, extent: float = 1.0) -> PlaneTransform:
    """The kind of a plane transform, with its decomposition H = H_S H_A H_P.

    Parameters
    ----------
    H : (3, 3), x' = H x; any multiple is the same map.
    tolerance : relative; how far from the more special kind H may be. Not a projectivity: over the region the scale
        h31 x + h32 y + h33 changes by less. Not an affinity: the singular values of the upper left 2 x 2 block are
        equal to it. Not a similarity: they are 1 to it. 1e-9 asks for exact maps; an estimated one has errors of its
        own.
    extent : the radius about the origin of the region where the map is used, in units of the points; it makes the first
        of the three free of units.

    Raises
    ------
    ValueError
        H is not a finite 3 x 3 matrix, or singular: it maps the plane to a line or a point.
    """
    h = checked_array("H", H, 3, 3)
    if h.ndim != 2:
        raise ValueError(f"expected H of shape (3, 3), got {h.shape}.")
    if _is_singular(h):
        raise ValueError(
            "expected H to be invertible, got a singular matrix, which maps the plane to a line or a point."
        )
    if not (tolerance >= 0 and extent > 0):
        raise ValueError(f"expected tolerance >= 0 and extent > 0, got {tolerance!r} and {extent!r}.")
    decomposition = None
    if abs(h[2, 2]) > ROUNDING * np.hypot(*h[2, :2]) * extent:
        decomposition = _decomposition(h / h[2, 2])
    if decomposition is None or np.hypot(*decomposition.projective) * extent > tolerance:
        kind: Kind = "projectivity"
    else:
        largest, smallest = np.linalg.svd(h[:2, :2] / h[2, 2], compute_uv=False)
        if largest - smallest > tolerance * largest:
            kind = "affinity"
        else:
            kind = "similarity" if abs(largest - 1) > tolerance else "isometry"
    return PlaneTransform(kind, DEGREES_OF_FREEDOM[kind], INVARIANTS[kind], decomposition)


def _is_singular(h: Array) -> np.ndarray:
    """(...,) bool. Rows and columns are brought to one size first, so that the units of the points do not count."""
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in (-1, -2, -1, -2):
            h = np.nan_to_num(h / np.linalg.norm(h, axis=axis, keepdims=True))
    values = np.linalg.svd(h, compute_uv=False)
    return np.asarray(values[..., 2] <= 1e-14 * values[..., 0])


def _decomposition(h: Array) -> Decomposition | None:
    """Of H with H33 = 1: the block A = s R K + t v^T, and QR of A - t v^T is R times the rest; None if that is
    singular."""
    t, v = h[:2, 2], h[2, :2]
    block = h[:2, :2] - np.outer(t, v)
    size = np.sqrt(abs(np.linalg.det(block)))
    if not size > 0:
        return None
    angle = np.arctan2(block[1, 0], block[0, 0])
    c, s = np.cos(angle), np.sin(angle)
    affine = np.array([[c, s], [-s, c]]) @ block / size
    affine[1, 0] = 0.0
    return Decomposition(float(size), float(angle), bool(affine[1, 1] < 0), t.copy(), affine, v.copy())


def affine_rectification(parallel: Sequence[tuple[ArrayLike, ArrayLike]]) -> Array:
    """(3, 3) map of an image of a plane to one in which parallel lines are parallel again (HZ 2.7.2).

    Each pair of images of parallel lines meets in a vanishing point; the line l through two of them is the image of the
    line at infinity, and H = [1, 0, 0; 0, 1, 0; l] sends it back. Two of the 8 degrees of freedom are gone; 6, an
    affinity, remain. With more than two pairs, l is their least-squares fit.

    Parameters
    ----------
    parallel : pairs of lines (3,), images of lines that are parallel in the plane; two directions at least.

    Raises
    ------
    ValueError
        Fewer than two pairs; the lines of a pair are the same; all pairs have one direction.
    """
    if len(parallel) < 2:
        raise ValueError(
            f"expected two pairs of parallel lines of different directions, got {len(parallel)}: one pair gives one "
            "vanishing point and removes at most 2 of the 8 degrees of freedom of the projectivity; the affine "
            "rectification needs the whole vanishing line, the metric one also orthogonal pairs."
        )
    first, second = (np.stack([checked_array("line", pair[k], 3) for pair in parallel]) for k in (0, 1))
    transform = _centring(np.concatenate([first, second]))
    first, second = (_unit_lines(map_lines(transform, lines)) for lines in (first, second))
    points = meet(first, second)
    lengths = np.linalg.norm(points, axis=-1)
    if (lengths <= ROUNDING).any():
        pair = int(np.argmin(lengths))
        raise ValueError(f"expected two different lines in each pair, got the same line twice in pair {pair}.")
    _, values, axes = np.linalg.svd(points / lengths[:, None])
    if values[1] <= ROUNDING:
        raise ValueError(
            "expected pairs of two directions, got pairs whose images meet in one point: they are all parallel to "
            "each other and determine a single point of the vanishing line; add a pair of another direction."
        )
    return _sending_to_infinity(transform.T @ axes[2])


def metric_rectification(
    orthogonal: Sequence[tuple[ArrayLike, ArrayLike]], vanishing_line: ArrayLike | None = None
) -> Array:
    """(3, 3) map of an image of a plane to one that is true up to a similarity (HZ 2.7.3 to 2.7.5).

    Images l, m of orthogonal lines satisfy l^T C m = 0 with C, the image of the dual conic of the circular points: 5
    unknowns, one equation each. With the vanishing line v known (C v = 0), 2 are left.

    Parameters
    ----------
    orthogonal : pairs of lines (3,), images of lines that are orthogonal in the plane. Two pairs of different
        directions with a vanishing line, else five in general position.
    vanishing_line : (3,) image of the line at infinity; (0, 0, 1) if the image is affinely rectified.

    Raises
    ------
    ValueError
        Too few pairs, pairs that repeat each other's directions, or pairs no plane can have (the conic is not one of
        circular points).
    """
    needed = 5 if vanishing_line is None else 2
    if len(orthogonal) < needed:
        known = "" if vanishing_line is None else ", with the vanishing line given"
        raise ValueError(
            f"expected {needed} pairs of orthogonal lines for a metric rectification{known}, got {len(orthogonal)}: "
            "each pair is one equation for the image of the circular points."
        )
    lines = [np.stack([checked_array("line", pair[k], 3) for pair in orthogonal]) for k in (0, 1)]
    to_affine: Array = np.eye(3)
    if vanishing_line is not None:
        to_affine = _sending_to_infinity(checked_array("vanishing_line", vanishing_line, 3))
    lines = [map_lines(to_affine, some) for some in lines]
    transform = _centring(np.concatenate(lines))
    first, second = (_unit_lines(map_lines(transform, some)) for some in lines)
    conic = _conic_of_circular_points(first, second, affine=vanishing_line is not None)
    # C = A diag(1, 1, 0) A^T, and A^-1 takes the circular points back to where they belong
    values, axes = np.linalg.eigh(conic)
    order = np.argsort(-np.abs(values))
    values, axes = values[order], axes[:, order]
    if values[0] < 0:
        values = -values
    if not (values[1] > ROUNDING * values[0] and abs(values[2]) < 0.5 * values[1]):
        raise ValueError(
            "expected pairs of orthogonal lines of one plane, got lines that no plane has (the conic of the circular "
            "points is not positive semidefinite); check which lines belong together."
        )
    a = axes * np.sqrt([values[0], values[1], 1.0])
    rectified = np.linalg.inv(a) @ transform @ to_affine
    # the similarity that is free: keep the image upright and as large as it was, about its middle
    found = classify(rectified @ np.linalg.inv(transform @ to_affine)).decomposition
    upright = np.eye(3) if found is None else np.linalg.inv(found.H_S)
    if found is not None and found.is_reversing:
        upright = np.diag([1.0, -1.0, 1.0]) @ upright
    return np.asarray(np.linalg.inv(transform) @ upright @ rectified)


def _conic_of_circular_points(first: Array, second: Array, affine: bool) -> Array:
    """(3, 3) symmetric C of rank 2 with l^T C m = 0; in an affine image only its upper left block is not 0."""
    terms = [(0, 0), (0, 1), (1, 1)] if affine else [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]
    products = first[:, :, None] * second[:, None, :]
    design = np.stack([products[:, i, j] + (products[:, j, i] if i != j else 0) for i, j in terms], axis=-1)
    _, values, axes = np.linalg.svd(design)
    unknowns = len(terms) - 1
    if values[unknowns - 1] <= ROUNDING * values[0]:
        raise ValueError(
            f"expected {unknowns} independent pairs of orthogonal lines, got pairs that repeat each other: parallel "
            "pairs of lines give the same equation; add pairs of other directions."
        )
    conic = np.zeros((3, 3))
    for (i, j), value in zip(terms, axes[-1], strict=True):
        conic[i, j] = conic[j, i] = value
    return conic


def _sending_to_infinity(line: Array) -> Array:
    """(3, 3) a map that sends `line` to (0, 0, 1) and is the identity near the origin if the line is far from it."""
    if np.linalg.norm(line) == 0:
        raise ValueError("expected a line, got (0, 0, 0).")
    if abs(line[2]) > ROUNDING * np.abs(line).max():
        return np.array([[1.0, 0, 0], [0, 1.0, 0], line / line[2]])
    third = line / np.linalg.norm(line)  # through the origin: any completion will do
    _, _, axes = np.linalg.svd(third[None])
    return np.stack([axes[1], axes[2] * np.sign(np.linalg.det(np.stack([axes[1], axes[2], third]))), third])


def _centring(lines: Array) -> Array:
    """(3, 3) similarity that brings the feet of lines (n, 3) on the origin into the unit circle; free of units."""
    norms = np.linalg.norm(lines[:, :2], axis=-1)
    if (norms == 0).any():
        raise ValueError("expected lines of the image, got the line at infinity or (0, 0, 0).")
    distance = np.median(np.abs(lines[:, 2]) / norms)
    return np.diag([1 / distance, 1 / distance, 1.0]) if distance > 0 else np.eye(3)


def _unit_lines(lines: Array) -> Array:
    return np.asarray(unit_norm(lines[:, None, :])[:, 0])
