# SPDX-License-Identifier: Apache-2.0
"""Points in space from two views by linear, midpoint and optimal triangulation, with a covariance for each point.

The rays of two measured pixels x, x' do not meet. The optimal point is the one whose images x^, x'^ are nearest to
them: it minimises d^2(x, x^) + d^2(x', x'^) subject to x'^^T F x^ = 0, which is the maximum likelihood for equal
Gaussian noise in both views. The linear and the midpoint method are simpler and never better; the module has them for
comparison.

Hartley and Sturm ("Triangulation", CVIU 1997) find the minimum over all epipolar lines by the roots of a polynomial.
Lindstrom ("Triangulation made easy", CVPR 2010) finds it by a few steps of a quadratic equation, hundreds of times as
fast. Both find the same minimum except for points near an epipole, where there are several. There a search over all
epipolar lines decides.

Pixels are those of a pinhole: remove lens distortion first (`camera_matrix.ideal_pixels`). Points whose rays are
parallel, or meet behind a camera, are NaN.

Used by: no other module of rangesim; it is for users alone. `rangesim.multiview.triangulate_many` is for more views.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pcgraph.parallel import in_blocks, kernel
from rangesim.geometry.camera_matrix import centre, depth, project, rays
from rangesim.geometry.correspondences import Array, checked_array
from rangesim.geometry.projective_plane import homogeneous
from rangesim.geometry.two_view import centred_cameras, fundamental_from_cameras

NEAR_EPIPOLE = 0.25
"""Ratio of a correction to the distance of the pixel from its epipole above which the search over all epipolar lines
decides. Several minima exist only where the noise is about as large as that distance; a larger ratio misses some of
them, a smaller one searches more often, which takes longer."""

CONVERGED_CORRECTION = 1e-5
"""Relative change of a correction, a ratio, below which the steps end. Because convergence is quadratic, the next step
would change it by about the square of this, which is rounding."""

MAX_CORRECTION_STEPS = 20
"""Largest number of steps. Two suffice for most pixels (Lindstrom 2010). For a pair that needs more than 20, the search
over all epipolar lines decides."""

PARALLEL_RAD = 1e-12
"""Angle between two rays, in radians, up to which they are parallel. It is far above rounding, 1e-16, and corresponds
to a billionth of a pixel for a focal length of 1000 px, so that no measured pixels distinguish it from 0."""

UNIFORM_ANGLES = 64
"""Number of angles that the search samples evenly over all epipolar lines. It need not be large, because narrow minima
lie near the two zeros (of the distance in either view), which are sampled separately."""

ANGLES_BESIDE_ZERO = 40
"""Number of angles that the search samples on either side of each zero, from 1e-8 to 1.5 rad in geometric steps of a
factor 1.6, so that minima of any width are met."""

GOLDEN_RATIO = 0.5 * (np.sqrt(5) - 1)
"""Ratio of two successive intervals of a golden-section search, (sqrt(5) - 1) / 2."""

GOLDEN_STEPS = 45
"""Number of times that a golden section shortens an interval, by a factor of 4e-10 in all. More steps would gain
nothing, because in shorter intervals a minimum is flat in double precision."""

PAIRS_AT_ONCE = 4096
"""Number of pairs whose angles are sampled at once, so that the memory stays at some ten megabytes per array; the
result does not depend on it."""


class CorrectedPixels(NamedTuple):
    """Pairs of pixels whose rays meet.

    Attributes
    ----------
    first, second : (n, 2) float64 pixels of both views.

    Examples
    --------
    >>> F = [[0, 0, 0], [0, 0, -1], [0, 1, 0]]  # parallel cameras: rows must match
    >>> corrected = correct_pixels(F, [[100, 200]], [[60, 202]])
    >>> corrected.first, corrected.second
    (array([[100., 201.]]), array([[ 60., 201.]]))
    """

    first: Array
    second: Array


@dataclass(frozen=True, eq=False)
class TriangulatedPoints:
    """Triangulated points, with their reprojection errors.

    Attributes
    ----------
    points : (n, 3) float64, metres, world coordinates of the camera matrices; NaN where rays are parallel or meet
        behind a camera.
    error_px : (n,) float64, the root of d^2(x, x^) + d^2(x', x'^), pixels. `triangulate_optimal` also gives it for
        points that are NaN.

    Examples
    --------
    >>> from rangesim.geometry import projection_matrix
    >>> from rangesim.rig import translation
    >>> K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> P, Q = projection_matrix(K), projection_matrix(K, translation(-0.1, 0, 0))
    >>> found = triangulate_optimal(P, Q, [[320, 240], [320, 240]], [[280, 240], [360, 240]])
    >>> found.points.round(6) + 0.0  # the second pair meets behind the cameras
    array([[ 0.,  0.,  2.],
           [nan, nan, nan]])
    """

    points: Array
    error_px: Array


def triangulate_linear(
    P_first: ArrayLike, P_second: ArrayLike, first: ArrayLike, second: ArrayLike
) -> TriangulatedPoints:
    """Points by the homogeneous linear method (HZ 12.2).

    A point is the least singular vector of the four equations x cross P X = 0. It minimises an algebraic error, which
    depends on the coordinates. The error is worst where a point is far from one camera and near the other.

    Parameters
    ----------
    P_first, P_second : (3, 4) camera matrices. The world may be far from its origin, as map coordinates are.
    first, second : (n, 2) corresponding pixels.

    Raises
    ------
    ValueError
        The cameras have the same centre, or arrays have other shapes or are not finite.

    Examples
    --------
    >>> from rangesim.geometry import projection_matrix
    >>> from rangesim.rig import translation
    >>> K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> P, Q = projection_matrix(K), projection_matrix(K, translation(-0.1, 0, 0))
    >>> triangulate_linear(P, Q, [[360, 240]], [[320, 240]]).points.round(6) + 0.0
    array([[0.1, 0. , 2. ]])
    """
    p, q, origin, x, y = _checked(P_first, P_second, first, second)
    fundamental_from_cameras(P_first, P_second)  # refuses cameras with the same centre
    rows = [points[:, k, None] * P[2] - P[k] for P, points in ((p, x), (q, y)) for k in (0, 1)]
    design = np.stack(rows, axis=1)
    design /= np.linalg.norm(design, axis=-1, keepdims=True)
    X = np.linalg.svd(design)[2][:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return _judged(p, q, x, y, X[:, :3] / X[:, 3:], origin)


def triangulate_midpoint(
    P_first: ArrayLike, P_second: ArrayLike, first: ArrayLike, second: ArrayLike
) -> TriangulatedPoints:
    """Points half way between the two rays, where these come nearest to each other.

    Parameters and errors are those of `triangulate_linear`.

    Examples
    --------
    >>> from rangesim.geometry import projection_matrix
    >>> from rangesim.rig import translation
    >>> K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> P, Q = projection_matrix(K), projection_matrix(K, translation(-0.1, 0, 0))
    >>> triangulate_midpoint(P, Q, [[360, 240]], [[320, 240]]).points.round(6) + 0.0
    array([[0.1, 0. , 2. ]])
    """
    p, q, origin, x, y = _checked(P_first, P_second, first, second)
    fundamental_from_cameras(P_first, P_second)
    C, D = _centres(p, q)
    d, e = rays(p, x), rays(q, y)
    normal = np.cross(d, e)
    size = (normal * normal).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (np.cross(D - C, e) * normal).sum(-1) / size
        w = (np.cross(D - C, d) * normal).sum(-1) / size
    return _judged(p, q, x, y, 0.5 * (C + z[:, None] * d + D + w[:, None] * e), origin)


def correct_pixels(F: ArrayLike, first: ArrayLike, second: ArrayLike) -> CorrectedPixels:
    """The nearest pairs that satisfy x'^T F x = 0: the global minimum of |dx|^2 + |dx'|^2.

    Both corrections point along the normals n = S F^T x'^, n' = S F x^ of the epipolar lines of the result, where S
    takes the first two entries: dx = lambda n, dx' = lambda n'. A step evaluates the normals at the last result and
    solves the constraint, a lambda^2 - 2 b lambda + c = 0, exactly (Lindstrom 2010, with the constraint satisfied at
    every step). Two steps suffice for most pairs. If the steps do not converge, or a correction is a large part of the
    distance to an epipole, the search of Hartley and Sturm over all epipolar lines decides.

    Parameters
    ----------
    F : (3, 3), x'^T F x = 0, rank 2.
    first, second : (n, 2) corresponding pixels.

    Raises
    ------
    ValueError
        F has another rank.

    Examples
    --------
    >>> F = [[0, 0, 0], [0, 0, -1], [0, 1, 0]]  # parallel cameras: rows must match
    >>> correct_pixels(F, [[100, 200]], [[60, 202]]).second
    array([[ 60., 201.]])
    """
    from rangesim.geometry.two_view import epipoles

    x, y = checked_array("first", first, None, 2), checked_array("second", second, None, 2)
    if x.shape != y.shape or x.ndim != 2:
        raise ValueError(f"expected first and second as corresponding points (n, 2), got {x.shape} and {y.shape}.")
    poles = epipoles(F)
    result = np.empty((len(x), 4))
    doubtful = np.empty(len(x), dtype=np.bool_)
    matrix = np.ascontiguousarray(F, dtype=np.float64) / np.linalg.norm(F)
    in_blocks(
        _correct, len(x), matrix, poles.first, poles.second, np.ascontiguousarray(np.hstack([x, y])), result, doubtful
    )
    if doubtful.any():
        which = np.flatnonzero(doubtful)
        for some in np.array_split(which, -(-len(which) // PAIRS_AT_ONCE)):
            result[some] = _over_the_pencil(matrix, poles.first, x[some], y[some])
    return CorrectedPixels(result[:, :2], result[:, 2:])


def triangulate_optimal(
    P_first: ArrayLike, P_second: ArrayLike, first: ArrayLike, second: ArrayLike
) -> TriangulatedPoints:
    """Points whose images are nearest to the measured pixels.

    `correct_pixels` moves the pixels so that their rays meet exactly; the points are where these rays meet. Parameters
    and errors are those of `triangulate_linear`.

    Examples
    --------
    >>> from rangesim.geometry import projection_matrix
    >>> from rangesim.rig import translation
    >>> K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> P, Q = projection_matrix(K), projection_matrix(K, translation(-0.1, 0, 0))
    >>> found = triangulate_optimal(P, Q, [[360, 239]], [[320, 241]])
    >>> found.points.round(6) + 0.0, found.error_px.round(4)
    (array([[0.1, 0. , 2. ]]), array([1.4142]))
    """
    p, q, origin, x, y = _checked(P_first, P_second, first, second)
    corrected = correct_pixels(fundamental_from_cameras(P_first, P_second), x, y)
    rays_of = _Rays(_world_from_pixel(p), _world_from_pixel(q), *_centres(p, q))
    points, error = np.empty((len(x), 3)), np.empty(len(x))
    in_blocks(
        _intersect,
        len(x),
        rays_of,
        *(np.ascontiguousarray(a) for a in (corrected.first, corrected.second, x, y)),
        points,
        error,
    )
    return TriangulatedPoints(points + origin, error)


def point_covariance(
    P_first: ArrayLike,
    P_second: ArrayLike,
    points: ArrayLike,
    noise_first_px: ArrayLike = 1.0,
    noise_second_px: ArrayLike = 1.0,
) -> Array:
    """(n, 3, 3) float64 covariance in m^2 of optimally triangulated points: (J^T S^-1 J)^-1, the Cramer-Rao bound.

    J (4, 3) holds the derivatives of both images by the point, S the covariance of the pixels (HZ 5.2.3). Optimal
    triangulation gives both views the same weight, so that it reaches this bound for equal noise.

    Parameters
    ----------
    P_first, P_second : (3, 4) camera matrices.
    points : (n, 3) metres, world coordinates. The covariance of points that are NaN or behind a camera is NaN.
    noise_first_px, noise_second_px : standard deviation of one coordinate in pixels, a number or (n,); or covariances
        (2, 2) or (n, 2, 2) in px^2.

    Raises
    ------
    ValueError
        A standard deviation is not positive, or a covariance is not positive definite.

    Examples
    --------
    >>> from rangesim.geometry import projection_matrix
    >>> from rangesim.rig import translation
    >>> K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    >>> P, Q = projection_matrix(K), projection_matrix(K, translation(-0.1, 0, 0))
    >>> covariance = point_covariance(P, Q, [[0.05, 0, 2]], 0.5, 0.5)
    >>> float(np.sqrt(covariance[0, 2, 2]).round(4))  # sqrt(2) * 0.5 px * z^2 / (f b)
    0.0354
    """
    X = np.asarray(points, dtype=np.float64)
    if X.ndim != 2 or X.shape[1] != 3:
        raise ValueError(f"expected points of shape (n, 3), got {X.shape}.")
    known = np.isfinite(X).all(axis=-1)
    information = np.zeros((int(known.sum()), 3, 3))
    for name, P, noise in (("noise_first_px", P_first, noise_first_px), ("noise_second_px", P_second, noise_second_px)):
        p = checked_array("P", P, 3, 4)
        image = X[known] @ p[:, :3].T + p[:, 3]
        jacobian = (p[None, :2, :3] - (image[:, :2] / image[:, 2:])[:, :, None] * p[2, :3]) / image[:, 2, None, None]
        jacobian[depth(p, X[known]) <= 0] = np.nan
        weight = np.linalg.inv(_covariances(name, noise, len(X))[known])
        information += np.swapaxes(jacobian, -1, -2) @ weight @ jacobian
    result = np.full((len(X), 3, 3), np.nan)
    sound = np.isfinite(information).all(axis=(-2, -1))
    inverse = np.full_like(information, np.nan)
    inverse[sound] = np.linalg.inv(information[sound])
    result[known] = inverse
    return result


# ------------------------------------------------------------------------------------------- the pieces


class _Rays(NamedTuple):
    """Matrices that turn pixels of both cameras into ray directions, and the cameras' centres.

    Attributes
    ----------
    first, second : (3, 3) float64, M^-1 of each camera matrix [M | m], scaled so that det M > 0.
    first_centre, second_centre : (3,) float64, metres.
    """

    first: Array
    second: Array
    first_centre: Array
    second_centre: Array


def _world_from_pixel(P: Array) -> Array:
    """(3, 3) M^-1 of a camera matrix [M | m], with the sign for which rays point forward."""
    block = P[:, :3] * np.sign(np.linalg.det(P[:, :3]))
    return np.ascontiguousarray(np.linalg.inv(block))


def _centres(p: Array, q: Array) -> tuple[Array, Array]:
    """Centres (3,) of both cameras, metres; not finite for an affine camera."""
    first, second = (centre(P) for P in (p, q))
    return first[:3] / first[3], second[:3] / second[3]


def _checked(
    P_first: ArrayLike, P_second: ArrayLike, first: ArrayLike, second: ArrayLike
) -> tuple[Array, Array, Array, Array, Array]:
    """The camera matrices with the origin at the first camera, that origin (3,), and the pixels (n, 2) as float64."""
    p, q = checked_array("P_first", P_first, 3, 4), checked_array("P_second", P_second, 3, 4)
    x, y = checked_array("first", first, None, 2), checked_array("second", second, None, 2)
    if p.ndim != 2 or q.ndim != 2:
        raise ValueError(f"expected camera matrices of shape (3, 4), got {p.shape} and {q.shape}.")
    if x.shape != y.shape or x.ndim != 2:
        raise ValueError(f"expected first and second as corresponding points (n, 2), got {x.shape} and {y.shape}.")
    return *centred_cameras(p, q), x, y


def _judged(p: Array, q: Array, x: Array, y: Array, X: Array, origin: Array) -> TriangulatedPoints:
    """Points X (n, 3) moved by the origin (3,), with the reprojection errors against the pixels x, y (n, 2).

    Points that are not finite, that are as far away as the meeting point of parallel rays, or that are not in front of
    both cameras become NaN.
    """
    points, error = np.full(X.shape, np.nan), np.full(len(X), np.nan)
    finite = np.asarray(np.isfinite(X).all(axis=-1))
    sound = finite.copy()
    C, D = _centres(p, q)
    farthest = np.linalg.norm(D - C) / PARALLEL_RAD
    for P in (p, q):
        sound[finite] = sound[finite] & (depth(P, X[finite]) > 0)
    sound[finite] &= np.linalg.norm(X[finite] - C, axis=-1) < farthest
    points[sound] = X[sound]
    parts = [project(P, X[sound]) - measured[sound] for P, measured in ((p, x), (q, y))]
    error[sound] = np.linalg.norm(np.hstack(parts), axis=-1)
    return TriangulatedPoints(points + origin, error)


def _covariances(name: str, noise: ArrayLike, n: int) -> Array:
    """(n, 2, 2) covariances in px^2 from noise in any of its forms; ValueError if it is not positive."""
    given = checked_array(name, noise)
    covariances = given[..., None, None] ** 2 * np.eye(2) if given.ndim < 2 else given
    if (given.ndim < 2 and (given <= 0).any()) or covariances.shape[-2:] != (2, 2):
        raise ValueError(f"expected {name} as positive pixels, a number or (n,), or covariances (2, 2) or (n, 2, 2).")
    if (np.linalg.eigvalsh(covariances) <= 0).any():
        raise ValueError(f"expected {name} to hold positive definite covariances, got one that is not.")
    return np.broadcast_to(covariances, (n, 2, 2))


@kernel
def _correct(start, stop, F, pole_first, pole_second, pairs, result, doubtful):  # type: ignore[no-untyped-def]
    """Kernel over pairs: result[i] is the corrected pair (x, y, x', y'), doubtful[i] whether to search all lines."""
    for i in range(start, stop):
        x, y, u, v = pairs[i, 0], pairs[i, 1], pairs[i, 2], pairs[i, 3]
        c = u * (F[0, 0] * x + F[0, 1] * y + F[0, 2]) + v * (F[1, 0] * x + F[1, 1] * y + F[1, 2])
        c += F[2, 0] * x + F[2, 1] * y + F[2, 2]
        # normals of the epipolar lines of the measured pixels: in the first view n0, in the second m0
        n0x, n0y = F[0, 0] * u + F[1, 0] * v + F[2, 0], F[0, 1] * u + F[1, 1] * v + F[2, 1]
        m0x, m0y = F[0, 0] * x + F[0, 1] * y + F[0, 2], F[1, 0] * x + F[1, 1] * y + F[1, 2]
        nx, ny, mx, my = n0x, n0y, m0x, m0y
        dx = dy = du = dv = 0.0
        change = size = 0.0
        solved = True
        for step in range(MAX_CORRECTION_STEPS):
            a = mx * (F[0, 0] * nx + F[0, 1] * ny) + my * (F[1, 0] * nx + F[1, 1] * ny)
            b = 0.5 * (nx * n0x + ny * n0y + mx * m0x + my * m0y)
            root = b * b - a * c
            solved = root >= 0 and b > 0
            if not solved:
                break
            scale = c / (b + np.sqrt(root))
            ex, ey, eu, ev = scale * nx, scale * ny, scale * mx, scale * my
            change = (ex - dx) ** 2 + (ey - dy) ** 2 + (eu - du) ** 2 + (ev - dv) ** 2
            dx, dy, du, dv = ex, ey, eu, ev
            size = dx * dx + dy * dy + du * du + dv * dv
            nx, ny = n0x - F[0, 0] * du - F[1, 0] * dv, n0y - F[0, 1] * du - F[1, 1] * dv
            mx, my = m0x - F[0, 0] * dx - F[0, 1] * dy, m0y - F[1, 0] * dx - F[1, 1] * dy
            if step > 0 and change <= CONVERGED_CORRECTION * CONVERGED_CORRECTION * size:
                break
        result[i, 0], result[i, 1], result[i, 2], result[i, 3] = x - dx, y - dy, u - du, v - dv
        # the distance to the epipole is |e x (x, 1)| / |e_3|; both sides are multiplied by |e_3|, which may be 0
        wx, wy, wu, wv = pole_first[2], pole_first[2], pole_second[2], pole_second[2]
        to_first = (wx * x - pole_first[0]) ** 2 + (wy * y - pole_first[1]) ** 2
        to_second = (wu * u - pole_second[0]) ** 2 + (wv * v - pole_second[1]) ** 2
        limit = NEAR_EPIPOLE * NEAR_EPIPOLE
        near = size * wx * wx > limit * to_first or size * wu * wu > limit * to_second
        doubtful[i] = not solved or near or change > CONVERGED_CORRECTION * CONVERGED_CORRECTION * size


@kernel
def _intersect(start, stop, cameras, first, second, measured_first, measured_second, points, error):  # type: ignore[no-untyped-def]
    """Kernel over pairs: points[i] is where the rays of the corrected pixels meet, error[i] the size of the correction.

    The point is NaN if it is not in front of both cameras, or if the rays are parallel.
    """
    M, N = cameras.first, cameras.second
    bx = cameras.second_centre[0] - cameras.first_centre[0]
    by = cameras.second_centre[1] - cameras.first_centre[1]
    bz = cameras.second_centre[2] - cameras.first_centre[2]
    for i in range(start, stop):
        x, y, u, v = first[i, 0], first[i, 1], second[i, 0], second[i, 1]
        px, py, pz = (
            M[0, 0] * x + M[0, 1] * y + M[0, 2],
            M[1, 0] * x + M[1, 1] * y + M[1, 2],
            M[2, 0] * x + M[2, 1] * y + M[2, 2],
        )
        qx, qy, qz = (
            N[0, 0] * u + N[0, 1] * v + N[0, 2],
            N[1, 0] * u + N[1, 1] * v + N[1, 2],
            N[2, 0] * u + N[2, 1] * v + N[2, 2],
        )
        nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        size = nx * nx + ny * ny + nz * nz
        along = (by * qz - bz * qy) * nx + (bz * qx - bx * qz) * ny + (bx * qy - by * qx) * nz
        other = (by * pz - bz * py) * nx + (bz * px - bx * pz) * ny + (bx * py - by * px) * nz
        least = PARALLEL_RAD * PARALLEL_RAD * (px * px + py * py + pz * pz) * (qx * qx + qy * qy + qz * qz)
        if along > 0 and other > 0 and size > least:
            z = along / size
            points[i, 0] = cameras.first_centre[0] + z * px
            points[i, 1] = cameras.first_centre[1] + z * py
            points[i, 2] = cameras.first_centre[2] + z * pz
        else:
            points[i, 0] = points[i, 1] = points[i, 2] = np.nan
        dx, dy = x - measured_first[i, 0], y - measured_first[i, 1]
        du, dv = u - measured_second[i, 0], v - measured_second[i, 1]
        error[i] = np.sqrt(dx * dx + dy * dy + du * du + dv * dv)


def _over_the_pencil(F: Array, pole: Array, x: Array, y: Array) -> Array:
    """(n, 4) corrected pairs by a search over all epipolar lines: the feet of both pixels on the best pair of lines.

    Lines through the epipole e are l = L u, and their partners are l' = F [e]_x l = L' u, where u lies on the unit
    circle. Both squared distances, (g u)^2 / u^T B u with g = x^T L and B = (S L)^T (S L), then depend on one angle.
    Hartley and Sturm 1997 find the up to three minima by the roots of a polynomial of degree 6. Here the angles are
    sampled, more densely near the two angles where one of the distances vanishes, and the three lowest minima are
    narrowed down by golden sections.

    Parameters
    ----------
    F : (3, 3) of unit norm.
    pole : (3,) homogeneous epipole of the first view.
    x, y : (n, 2) pixels of both views.
    """
    first = np.linalg.svd(pole[None])[2][1:].T  # (3, 2) two lines that span those through the epipole
    second = F @ np.cross(pole, first, axis=0)
    B, B_ = first[:2].T @ first[:2], second[:2].T @ second[:2]
    # angles are measured in a metric between those of the two views
    metric = np.linalg.cholesky(B / np.trace(B) + B_ / np.trace(B_) + 1e-12 * np.eye(2))
    to_lines = np.linalg.inv(metric).T
    lines = first @ to_lines, second @ to_lines
    g, g_ = homogeneous(x) @ lines[0], homogeneous(y) @ lines[1]

    def cost(angles: Array) -> Array:
        """(n, k) sums of both squared distances, px^2, at angles (n, k)."""
        u = np.stack([np.cos(angles), np.sin(angles)])
        total = np.zeros(angles.shape)
        for form, at in ((lines[0], g), (lines[1], g_)):
            normal = np.einsum("ij,jnk->ink", form[:2], u)
            total += np.einsum("nj,jnk->nk", at, u) ** 2 / np.maximum((normal**2).sum(axis=0), 1e-300)
        return total

    steps = np.geomspace(1e-8, 1.5, ANGLES_BESIDE_ZERO)  # less than a right angle, where both sides meet
    around = np.concatenate([-steps, [0.0], steps])
    zeros = np.stack([np.arctan2(-at[:, 0], at[:, 1]) for at in (g, g_)], axis=1) % np.pi
    even = np.broadcast_to(np.pi / UNIFORM_ANGLES * (np.arange(UNIFORM_ANGLES) + 0.123), (len(x), UNIFORM_ANGLES))
    angles = np.sort(np.concatenate([even, (zeros[:, :, None] + around).reshape(len(x), -1) % np.pi], axis=1), axis=1)
    angles = np.concatenate([angles[:, -1:] - np.pi, angles, angles[:, :1] + np.pi], axis=1)
    sampled = cost(angles)
    lowest = np.where(
        (sampled[:, 1:-1] <= sampled[:, :-2]) & (sampled[:, 1:-1] <= sampled[:, 2:]), sampled[:, 1:-1], np.inf
    )
    chosen = np.argsort(lowest, axis=1)[:, :3] + 1
    low, high = (np.take_along_axis(angles, chosen + side, axis=1) for side in (-1, 1))
    for _ in range(GOLDEN_STEPS):
        width = GOLDEN_RATIO * (high - low)
        falls = cost(high - width) > cost(low + width)
        low, high = np.where(falls, high - width, low), np.where(falls, high, low + width)
    middle = 0.5 * (low + high)
    best = np.take_along_axis(middle, np.argmin(cost(middle), axis=1)[:, None], axis=1)[:, 0]
    u = np.stack([np.cos(best), np.sin(best)], axis=-1)
    feet = []
    for form, pixels in ((lines[0], x), (lines[1], y)):
        line = u @ form.T
        off = (line[:, :2] * pixels).sum(axis=-1) + line[:, 2]
        feet.append(pixels - (off / (line[:, :2] ** 2).sum(axis=-1))[:, None] * line[:, :2])
    return np.hstack(feet)
