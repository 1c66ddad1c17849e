# SPDX-License-Identifier: Apache-2.0
"""The projective plane: points and lines, the four kinds of plane transforms, rectification of planes.

Any multiple of (x, y, 1) stands for the point (x, y). Any multiple of (a, b, c) stands for the line a x + b y + c = 0.
Points whose last coordinate is 0 lie at infinity, all of them on the line (0, 0, 1). The symbols are those of Hartley,
Zisserman: "Multiple View Geometry in Computer Vision", 2nd edition 2004 (HZ), chapter 2.

All functions except `classify` and the rectifications work on batches: leading dimensions broadcast.

Used by: rangesim.geometry.two_view, two_view_triangulation and uncalibrated_rectification;
rangesim.calibration.rig_calibration. `classify` and the rectifications are for users alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.correspondences import ROUNDING, Array, checked_array, unit_norm

LINE_AT_INFINITY: tuple[float, float, float] = (0.0, 0.0, 1.0)
"""The line at infinity: it meets every other line in that line's point at infinity. A map of the plane keeps it if and
only if the map is an affinity."""

LAST_DIGITS = 1e-15
"""Ratio up to which a number is the rounding of a few operations, because double precision has 16 digits. A homogeneous
coordinate below this fraction of the largest counts as 0, and lines that differ by less than this angle in radians
count as parallel. With a larger value, lines that meet far away count as parallel; with a smaller one, rounding decides
where parallel lines meet."""

MIN_SINGULAR_RATIO = 1e-14
"""Largest ratio of the smallest to the largest singular value at which a 3 x 3 matrix counts as singular, after its
rows and columns are scaled to one size. It is 45 times the rounding unit of double precision. So a matrix is refused
that differs from a singular one only by rounding. A larger value refuses strong but valid perspective."""


def homogeneous(points: ArrayLike) -> Array:
    """(..., 3) float64 homogeneous coordinates (x, y, 1) of points (..., 2).

    Examples
    --------
    >>> homogeneous([[2, 3]])
    array([[2., 3., 1.]])
    """
    xy = checked_array("points", points, 2)
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)


def euclidean(points: ArrayLike) -> Array:
    """(..., 2) float64 coordinates (x / w, y / w) of homogeneous points (..., 3).

    Points at infinity (see `is_at_infinity`) give NaN.

    Examples
    --------
    >>> euclidean([[4, 6, 2], [1, 0, 0]])
    array([[ 2.,  3.],
           [nan, nan]])
    """
    p = checked_array("points", points, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(is_at_infinity(p)[..., None], np.nan, p[..., :2] / p[..., 2:])


def is_at_infinity(points: ArrayLike) -> np.ndarray:
    """(...,) bool, whether the last homogeneous coordinate of points (..., 3) is 0, to 1e-15 of the largest one.

    Examples
    --------
    >>> is_at_infinity([[4, 6, 2], [1, 0, 0]])
    array([False,  True])
    """
    p = checked_array("points", points, 3)
    return np.asarray(np.abs(p[..., 2]) <= LAST_DIGITS * np.abs(p).max(axis=-1))


def join(first: ArrayLike, second: ArrayLike) -> Array:
    """(..., 3) float64 line through two homogeneous points (..., 3): their cross product; 0 where they are the same.

    Examples
    --------
    >>> join([0, 0, 1], [1, 1, 1])  # the line y = x
    array([-1.,  1.,  0.])
    """
    return np.asarray(np.cross(checked_array("first", first, 3), checked_array("second", second, 3)))


def meet(first: ArrayLike, second: ArrayLike) -> Array:
    """(..., 3) float64 homogeneous point on two lines (..., 3): their cross product; 0 where they are the same.

    Parallel lines (l1, l2, l3) and (l1, l2, m3) meet at (m3 - l3) (l2, -l1, 0), at infinity. Lines whose directions
    differ by less than 1e-15 rad count as parallel, because rounding of their coefficients leaves such an angle. The
    last coordinate of the point is then exactly 0.

    Examples
    --------
    >>> meet([1, 0, -2], [0, 1, -3])  # x = 2 and y = 3
    array([2., 3., 1.])
    >>> meet([1, 0, -2], [1, 0, -5])  # x = 2 and x = 5
    array([0., 3., 0.])
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
    """(..., 3) float64 point (b, -a, 0) where a line (..., 3) meets the line at infinity: the direction of the line.

    Examples
    --------
    >>> point_at_infinity([1, -1, 7])  # the line y = x + 7
    array([-1., -1.,  0.])
    """
    return meet(line, LINE_AT_INFINITY)


def map_points(H: ArrayLike, points: ArrayLike) -> Array:
    """(..., n, 2) float64 images x' = H x of points (..., n, 2) under maps H (..., 3, 3).

    Images at infinity are NaN.

    Examples
    --------
    >>> map_points([[2, 0, 1], [0, 2, 0], [0, 0, 1]], [[3, 4]])
    array([[7., 8.]])
    """
    h = checked_array("H", H, 3, 3)
    mapped = homogeneous(checked_array("points", points, None, 2)) @ np.swapaxes(h, -1, -2)
    return euclidean(mapped)


def map_lines(H: ArrayLike, lines: ArrayLike) -> Array:
    """(..., n, 3) float64 images l' = H^-T l of lines (..., n, 3) under maps H (..., 3, 3).

    Raises
    ------
    ValueError
        H is singular: it does not map lines to lines.

    Examples
    --------
    >>> map_lines([[2, 0, 1], [0, 2, 0], [0, 0, 1]], [[1, 0, -3]])  # x = 3 becomes x = 7
    array([[ 0.5,  0. , -3.5]])
    """
    h = checked_array("H", H, 3, 3)
    if np.any(_is_singular(h)):
        raise ValueError(
            "expected H to be invertible, got a singular matrix, which maps the plane to a line or a point."
        )
    return np.asarray(checked_array("lines", lines, None, 3) @ np.linalg.inv(h))


Kind = Literal["isometry", "similarity", "affinity", "projectivity"]
"""The four kinds of plane transforms, from the most special to the most general."""

DEGREES_OF_FREEDOM: dict[Kind, int] = {"isometry": 3, "similarity": 4, "affinity": 6, "projectivity": 8}
"""Number of independent parameters of each kind (HZ table 2.4)."""

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
"""The properties that each kind of transform keeps (HZ table 2.4). A kind also keeps what the kinds below it keep."""


@dataclass(frozen=True, eq=False)
class Decomposition:
    """The factors of a plane transform H = H_S H_A H_P, up to scale (HZ 2.17).

    H applies the projective part H_P first, then the affine part H_A, then the similarity H_S:

        H_S = [s R, t; 0, 1]    H_A = [K, 0; 0, 1]    H_P = [I, 0; v^T, 1]

    Attributes
    ----------
    scale : s, positive.
    rotation_rad : angle of R, anticlockwise from x to y.
    is_reversing : whether H mirrors the plane; K then has the determinant -1.
    translation : (2,) float64 t, in units of the points.
    affine : (2, 2) float64 K, upper triangular, determinant 1 or -1, first entry positive.
    projective : (2,) float64 v, in units of 1 / length.

    Examples
    --------
    >>> parts = classify([[0, -4, 5], [4, 0, -3], [0, 0, 1]]).decomposition
    >>> float(round(parts.scale, 9)), float(round(parts.rotation_rad, 9)), parts.translation
    (4.0, 1.570796327, array([ 5., -3.]))
    """

    scale: float
    rotation_rad: float
    is_reversing: bool
    translation: Array
    affine: Array
    projective: Array

    @property
    def shear(self) -> float:
        """The ratio K12 / K11, which says how far y moves x."""
        return float(self.affine[0, 1] / self.affine[0, 0])

    @property
    def aspect(self) -> float:
        """The ratio |K11 / K22| of the scales of x and y."""
        return float(abs(self.affine[0, 0] / self.affine[1, 1]))

    @property
    def H_S(self) -> Array:
        """(3, 3) float64 similarity."""
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        result = np.eye(3)
        result[:2, :2] = self.scale * np.array([[c, -s], [s, c]])
        result[:2, 2] = self.translation
        return result

    @property
    def H_A(self) -> Array:
        """(3, 3) float64 affinity."""
        result = np.eye(3)
        result[:2, :2] = self.affine
        return result

    @property
    def H_P(self) -> Array:
        """(3, 3) float64 projectivity that moves the line at infinity."""
        result = np.eye(3)
        result[2, :2] = self.projective
        return result


@dataclass(frozen=True, eq=False)
class PlaneTransform:
    """The kind of a map of the plane, with its invariants and its decomposition.

    Attributes
    ----------
    kind : the most special of isometry, similarity, affinity and projectivity that the map is.
    degrees_of_freedom : number of independent parameters of that kind.
    invariants : the properties that this kind keeps (`INVARIANTS`).
    decomposition : factors of the map; None if the map sends the origin to infinity (H33 = 0). Such a map has no
        decomposition: move the origin first.

    Examples
    --------
    >>> found = classify([[2, 0, 1], [0, 2, 0], [0, 0, 1]])
    >>> found.kind, found.degrees_of_freedom
    ('similarity', 4)
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
    tolerance : fraction by which H may differ from a more special kind and still count as that kind. H counts as an
        affinity if the scale h31 x + h32 y + h33 changes by less than this over the region of radius `extent`. It
        counts as a similarity if, in addition, both singular values of its upper left 2 x 2 block differ by less
        than this, and as an isometry if they also differ from 1 by less than this. The default asks for exact maps;
        state a larger tolerance for an estimated map, which has errors.
    extent : radius about the origin of the region where the map is used, in units of the points. With it the test of
        the projective part does not depend on these units.

    Raises
    ------
    ValueError
        H is not a finite 3 x 3 matrix; or H is singular, so that it maps the plane to a line or a point.

    Examples
    --------
    >>> classify([[0, -1, 5], [1, 0, -3], [0, 0, 1]]).kind
    'isometry'
    >>> classify([[1, 0.2, 0], [0, 1, 0], [0, 0, 1]]).kind
    'affinity'
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
    """(...,) bool, whether matrices (..., 3, 3) are singular.

    Rows and columns are scaled to one size first, so that the units of the points do not count.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in (-1, -2, -1, -2):
            h = np.nan_to_num(h / np.linalg.norm(h, axis=axis, keepdims=True))
    values = np.linalg.svd(h, compute_uv=False)
    return np.asarray(values[..., 2] <= MIN_SINGULAR_RATIO * values[..., 0])


def _decomposition(h: Array) -> Decomposition | None:
    """The factors of H (3, 3) with H33 = 1; None if A - t v^T is singular.

    The upper left block of H is A = s R K + t v^T. The QR decomposition of A - t v^T gives R and s K.
    """
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
    """(3, 3) float64 map of an image of a plane that makes parallel lines parallel again (HZ 2.7.2).

    The images of two parallel lines meet in a vanishing point. The line l through two vanishing points is the image of
    the line at infinity, and H = [1, 0, 0; 0, 1, 0; l] sends it back. This removes two of the 8 degrees of freedom; an
    affinity with 6 remains. With more than two pairs, l is the least-squares fit to their vanishing points.

    Parameters
    ----------
    parallel : pairs of lines (3,), images of lines that are parallel in the plane; at least two directions.

    Raises
    ------
    ValueError
        There are fewer than two pairs, the lines of a pair are the same, or all pairs have one direction.

    Examples
    --------
    >>> import numpy as np
    >>> H = np.array([[1, 0.2, 3], [0.1, 1, 2], [0.001, 0.002, 1]])  # how the plane came into the image
    >>> seen = map_lines(H, [[1, 0, 0], [1, 0, -9], [0, 1, 0], [0, 1, -9]])  # a square
    >>> back = affine_rectification([(seen[0], seen[1]), (seen[2], seen[3])])
    >>> classify(back @ H).kind
    'affinity'
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
    """(3, 3) float64 map of an image of a plane that restores the plane up to a similarity (HZ 2.7.3 to 2.7.5).

    Images l, m of orthogonal lines satisfy l^T C m = 0, where C is the image of the dual conic of the circular points.
    C has 5 unknowns and each pair gives one equation. If the vanishing line v is known, C v = 0 leaves 2 unknowns.

    Parameters
    ----------
    orthogonal : pairs of lines (3,), images of lines that are orthogonal in the plane. With a vanishing line, two pairs
        of different directions are needed; without one, five pairs in general position.
    vanishing_line : (3,) image of the line at infinity; (0, 0, 1) if the image is affinely rectified.

    Raises
    ------
    ValueError
        There are too few pairs, some pairs have the same directions as others, or no plane can have such pairs (C is
        not the image of the dual conic of circular points).

    Examples
    --------
    >>> import numpy as np
    >>> H = np.array([[1, 0.2, 3], [0, 0.8, 2], [0, 0, 1]])  # an affine image of the plane
    >>> seen = map_lines(H, [[1, 0, 0], [0, 1, 0], [1, 1, 0], [1, -1, 0]])
    >>> back = metric_rectification([(seen[0], seen[1]), (seen[2], seen[3])], vanishing_line=[0, 0, 1])
    >>> classify(back @ H).kind
    'similarity'
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
    # a similarity is still free: choose the one that keeps the image upright and its size about its middle
    found = classify(rectified @ np.linalg.inv(transform @ to_affine)).decomposition
    upright = np.eye(3) if found is None else np.linalg.inv(found.H_S)
    if found is not None and found.is_reversing:
        upright = np.diag([1.0, -1.0, 1.0]) @ upright
    return np.asarray(np.linalg.inv(transform) @ upright @ rectified)


def _conic_of_circular_points(first: Array, second: Array, affine: bool) -> Array:
    """(3, 3) float64 symmetric C of rank 2 with l^T C m = 0 for the pairs of lines `first`, `second` (n, 3).

    In an affine image only the upper left 2 x 2 block of C is not 0.
    """
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
    """(3, 3) float64 map that sends `line` (3,) to (0, 0, 1).

    If the line is far from the origin, the map is close to the identity near the origin.
    """
    if np.linalg.norm(line) == 0:
        raise ValueError("expected a line, got (0, 0, 0).")
    if abs(line[2]) > ROUNDING * np.abs(line).max():
        return np.array([[1.0, 0, 0], [0, 1.0, 0], line / line[2]])
    third = line / np.linalg.norm(line)  # the line goes through the origin: any two other rows are right
    _, _, axes = np.linalg.svd(third[None])
    return np.stack([axes[1], axes[2] * np.sign(np.linalg.det(np.stack([axes[1], axes[2], third]))), third])


def _centring(lines: Array) -> Array:
    """(3, 3) float64 scaling after which the median distance of lines (n, 3) from the origin is 1.

    With it, thresholds do not depend on the units of the points.
    """
    norms = np.linalg.norm(lines[:, :2], axis=-1)
    if (norms == 0).any():
        raise ValueError("expected lines of the image, got the line at infinity or (0, 0, 0).")
    distance = np.median(np.abs(lines[:, 2]) / norms)
    return np.diag([1 / distance, 1 / distance, 1.0]) if distance > 0 else np.eye(3)


def _unit_lines(lines: Array) -> Array:
    """Lines (n, 3) scaled to unit norm."""
    return np.asarray(unit_norm(lines[:, None, :])[:, 0])
