# SPDX-License-Identifier: Apache-2.0
"""Affine, orthographic and projective factorisation: cameras and points from the rank of the matrix of all pixels.

Affine cameras project to x_ij = M_i X_j + t_i, so that the pixels of all images minus t are a matrix of rank 3 (Tomasi,
Kanade: "Shape and motion from image streams under orthography: a factorization method", IJCV 1992). Pinhole cameras
have d_ij (x_ij, 1) = P_i X_j, so that with the right projective depths d the matrix has rank 4 (Sturm, Triggs: "A
factorization based algorithm for multi-image projective structure and motion", ECCV 1996; Mahamud, Hebert: "Iterative
projective reconstruction from multiple views", CVPR 2000; Hartley, Zisserman 2004, chapter 18).

The singular value decomposition alone solves only the affine camera, and only if every image sees every point. So each
function ends with a descent to the least sum of squared pixel errors over the observations, with exactly the parameters
of its camera, and reaches the Cramer-Rao bound. The sum leaves missing observations out. Only the start of
the descent needs them: rounds of decomposition and prediction fill them in.

Some inputs do not determine the result: points on a plane, images that do not turn (affine) or do not move
(projective), the same view repeated, fewer images or points than the rank needs. They raise an error: a singular
value is then no larger than that of noise.

Used by: `nonrigid` of `rangesim.multiview`; no other module of rangesim.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.geometry.consensus import SIGNIFICANCE, refuse_misfit, rounding_of, simpler_model_suffices
from rangesim.geometry.correspondences import (
    ROUNDING,
    Array,
    apply_similarity,
    check_noise,
    normalising_transform,
    right_singular_vectors,
)
from rangesim.geometry.least_squares import Descended, descend
from rangesim.multiview import orthographic
from rangesim.multiview.bundle_adjustment import check_connected
from rangesim.multiview.orthographic import Shapes
from rangesim.multiview.schur_complement import NormalEquations, Sizes, Step, Term
from rangesim.multiview.tracks import Tracks

AFFINE_RANK = 3
"""Rank of the pixels of affine cameras minus their translations, a count: one for each coordinate of a point (Tomasi,
Kanade 1992)."""
PROJECTIVE_RANK = 4
"""Rank of the homogeneous pixels times their depths, a count: one for each homogeneous coordinate of a point (Sturm,
Triggs 1996)."""
FILL_ROUNDS = 60
"""Number of rounds that fill in missing pixels and decompose the matrix, before the descent. Measured with 12 scenes of
8 images and 40 points, 30 % missing: 0 to 200 rounds end at the same minimum; 200 take three times as long as 60."""
DEPTH_ROUNDS = 100
"""Number of rounds that find the projective depths, before the descent. Measured with 12 scenes of 8 images and 40
points, 30 % missing: 1 to 300 rounds end at the same minimum, and 30 to 100 take the least time."""
RANDOM_STARTS = 4
"""Largest number of random starts after the first one. No more follow as soon as one agrees with the best minimum so
far. Measured with 25 scenes each, 30 % missing: with 8 images of 40 points no random start found a lower minimum; with
4 images of 20 points one did in 4 scenes."""
SAME_AFFINE_COST = 1e-6
"""Relative difference of the sums of squares of two starts, below which they count as ended in the same minimum. It
must exceed the relative distance from the minimum, 1e-12, at which a descent ends. Measured in the scenes of
`RANDOM_STARTS`: different minima have a ratio of 30 or more."""
MIN_DAMPING = 1e-12
"""Smallest damping of Levenberg-Marquardt over the diagonal of the normal equations, a ratio. It must not be 0, because
the gauge changes no residual and would leave the equations singular."""
MAX_ROTATION_DEVIATION = 0.3
"""Largest standard deviation of a rotation, radians. Beyond about 17 degrees the covariance, which is linear in the
rotation, means little, and the rotation counts as undetermined."""
MAX_DEPTH_DEVIATION = 0.15
"""Largest relative standard deviation of a common factor on all depths of a rigid shape. The error is Gaussian in
1 / depth^2: at 0.15, two standard deviations make the depths 1.6 times as large; at 0.2, noise alone finds depths 1000
times as large."""


class AffineCameras(NamedTuple):
    """Affine cameras and points, x_ij = M_i X_j + t_i.

    M : (n, 2, r) and t : (n, 2), float64, the cameras. X : (p, r) float64, the points.
    """

    M: Array
    t: Array
    X: Array

    def project(self) -> Array:
        """(n, p, 2) float64, pixels of each point in each image."""
        return np.asarray(np.einsum("nar,pr->npa", self.M, self.X) + self.t[:, None])


@dataclass(frozen=True, eq=False)
class AffineFactorisation:
    """Affine cameras and points with x_ij = M_i X_j + t_i, known up to an affinity X -> A X + b of space.

    M : (n_images, 2, r) float64, pixels.
    t : (n_images, 2) float64, pixels.
    points : (n_points, r) float64, without unit, with zero mean and unit covariance; NaN for a point seen in too few
        images.
    residuals_px : (m, 2) float64, predicted minus seen pixel; NaN for an observation that was left out.
    noise_px : standard deviation of a pixel's coordinate.
    singular_values : (r,) float64, pixels, singular values of the predicted pixels minus t, divided by the root of the
        number of observations: how far each component moves the pixels.

    Examples
    --------
    See `factorise_affine`.
    """

    M: Array
    t: Array
    points: Array
    residuals_px: Array
    noise_px: float
    singular_values: Array


@dataclass(frozen=True, eq=False)
class OrthographicFactorisation:
    """Rotations and points with x_ij = s_i (R_i X_j)_xy + t_i in the frame of the first camera, up to a reversal.

    R_camera_world : (n_images, 3, 3) float64, rotates world coordinates to those of each camera; the first is the
        identity.
    t : (n_images, 2) float64, pixels.
    scale : (n_images,) float64, a ratio: 1 under orthography, and 1 in the first image under weak perspective.
    points : (n_points, 3) float64, world, in pixels of the first image, with their mean at 0; NaN for a point seen in
        too few images.
    shape_deviation_px : (n_points,) float64, standard deviation of a coordinate of a point, as the root mean square
        over the three; NaN where the point is NaN or the noise is unknown.
    residuals_px : (m, 2) float64, predicted minus seen pixel; NaN for an observation that was left out.
    noise_px : standard deviation of a pixel's coordinate.

    Without perspective, a shape and the shape with all depths of the opposite sign look alike (Necker reversal), so
    `reversed` is an equally good solution. In the solution that is returned, the first image that is turned has R[0, 2]
    > 0, a positive angle about the vertical axis; if it is turned about the horizontal axis alone, it has R[1, 2] > 0.

    Examples
    --------
    See `factorise_orthographic`.
    """

    R_camera_world: Array
    t: Array
    scale: Array
    points: Array
    shape_deviation_px: Array
    residuals_px: Array
    noise_px: float

    @property
    def reversed(self) -> OrthographicFactorisation:
        """The other solution: depths of the opposite sign, X -> diag(1, 1, -1) X, with the rotations that fit them."""
        flip = np.array([1.0, 1.0, -1.0])
        return replace(self, R_camera_world=flip[:, None] * self.R_camera_world * flip, points=self.points * flip)


@dataclass(frozen=True, eq=False)
class ProjectiveFactorisation:
    """Camera matrices and points with x_ij = (P_i X_j)_xy / (P_i X_j)_z, known up to a projectivity X -> H X of space.

    P : (n_images, 3, 4) float64, camera matrices of unit norm.
    points : (n_points, 4) float64, homogeneous, of unit norm; NaN for a point seen in too few images. All depths
        (P_i X_j)_z of observations are positive.
    residuals_px : (m, 2) float64, predicted minus seen pixel; NaN for an observation that was left out.
    noise_px : standard deviation of a pixel's coordinate.

    Examples
    --------
    See `factorise_projective`.
    """

    P: Array
    points: Array
    residuals_px: Array
    noise_px: float

    def project(self) -> Array:
        """(n_images, n_points, 2) float64, pixels of each point in each image."""
        image = np.einsum("nab,pb->npa", self.P, self.points)
        return np.asarray(image[..., :2] / image[..., 2:])


# ------------------------------------------------------------------------------------------- affine


def factorise_affine(
    tracks: Tracks, rank: int = AFFINE_RANK, *, noise_px: float | None = None, seed: int = 0
) -> AffineFactorisation:
    """Affine cameras and points with the least squared pixel error (Tomasi, Kanade 1992, before the metric upgrade).

    If every image sees every point, t_i is the mean pixel of an image, and M and X are the first `rank` components of
    the singular value decomposition. Otherwise damped Gauss-Newton steps with variable projection (Okatani, Yoshida,
    Deguchi, ICCV 2011) minimise the sum over the observations, from the decomposition with missing pixels filled in.
    If this descent fails, others start from random cameras; only these use the seed.

    Parameters
    ----------
    tracks : which image sees which point; more than `rank` points in each image. A point in fewer than rank / 2 images
        is left out.
    rank : 3 for a rigid scene, 3 K for K basis shapes.
    noise_px : standard deviation of a pixel's coordinate; None estimates it from the residuals.
    seed : seed of the random cameras.

    Raises
    ------
    ValueError
        There are too few images or points, images share no points, or the tracks have a lower rank: the points lie on
        a plane, or the images do not turn against each other.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.multiview import Tracks
    >>> random = np.random.default_rng(0)
    >>> M, X = random.normal(0, 100, (4, 2, 3)), random.normal(0, 1, (20, 3))
    >>> tracks = Tracks.from_dense(np.einsum("nar,pr->npa", M, X) + [320, 240])
    >>> found = factorise_affine(tracks)
    >>> predicted = np.einsum("nar,pr->npa", found.M, found.points) + found.t[:, None]
    >>> np.allclose(predicted, tracks.dense())
    True
    """
    some, points = checked_tracks(tracks, -(-rank // 2), rank + 1, 0.5 * (rank + 1), f"a factorisation of rank {rank}")
    check_noise(noise_px)
    cameras = low_rank(some, rank, seed)
    residuals = cameras.project()[some.image, some.point] - some.pixels
    n, p = some.n_images, some.n_points
    freedom = residuals.size - (n * (2 * rank + 2) + p * rank - rank * (rank + 1))
    refuse_misfit(float((residuals**2).sum()), freedom, noise_px, f"a matrix of rank {rank}")
    noise = noise_of(residuals, freedom, noise_px)
    cameras, values = whitened(cameras)
    refuse_rank(values, some, noise, 2 * n - 1, p - 1, "points on a plane, or images that do not turn")
    all_residuals = residuals_of_all(tracks, points, residuals)
    return AffineFactorisation(
        cameras.M,
        cameras.t,
        points_of_all(tracks, points, cameras.X),
        all_residuals,
        noise,
        values / np.sqrt(len(some)),
    )


def checked_tracks(
    tracks: Tracks, least_images: int, least_points: int, images_needed: float, purpose: str
) -> tuple[Tracks, np.ndarray]:
    """The tracks of the points in at least `least_images` images, and the numbers of these points in `tracks`.

    In the result the points have new numbers from 0 on. The function raises ValueError if there are fewer than
    `images_needed` images, fewer than `least_points` such points in all or in an image, or images without shared
    points. The message names `purpose`.
    """
    if tracks.n_images < images_needed:
        raise ValueError(
            f"expected at least {int(np.ceil(images_needed))} images for {purpose}, got {tracks.n_images}."
        )
    some, points = renumbered(tracks, max(least_images, 2))
    if len(points) < least_points:
        raise ValueError(
            f"expected at least {least_points} points in {max(least_images, 2)} images or more for {purpose}, got "
            f"{len(points)} of {tracks.n_points}; track them through more images."
        )
    check_connected(some)
    few = np.flatnonzero(some.points_per_image < least_points)
    if len(few):
        raise ValueError(
            f"expected at least {least_points} points in each image for {purpose}, got {some.points_per_image[few[0]]} "
            f"in image {few[0]}; leave it out (Tracks.of_images) or add points."
        )
    return some, points


def renumbered(tracks: Tracks, least_images: int) -> tuple[Tracks, np.ndarray]:
    """The tracks of the points in at least `least_images` images, and the numbers of these points in `tracks`.

    In the result the points have new numbers from 0 on.
    """
    points = np.flatnonzero(tracks.images_per_point >= least_images)
    place = np.full(tracks.n_points, -1)
    place[points] = np.arange(len(points))
    kept = place[tracks.point] >= 0
    some = Tracks(tracks.image[kept], place[tracks.point[kept]], tracks.pixels[kept], tracks.n_images, len(points))
    return some, points


def low_rank(tracks: Tracks, rank: int, seed: int) -> AffineCameras:
    """Affine cameras and points of a rank with the least squared pixel error over the observations."""
    dense = tracks.dense()
    missing = np.isnan(dense)
    filled = np.where(missing, np.nanmean(dense, axis=1, keepdims=True), dense)
    cameras = _decomposed(filled, rank)
    if not missing.any():
        return cameras
    for _ in range(FILL_ROUNDS):
        filled[missing] = cameras.project()[missing]
        cameras = _decomposed(filled, rank)
    random = np.random.default_rng(seed)
    spread = float(np.nanstd(dense)) + 1e-300
    best, least = cameras, np.inf
    for attempt in range(1 + RANDOM_STARTS):
        if attempt:
            M = random.normal(0, spread, cameras.M.shape)
            cameras = AffineCameras(M, np.nanmean(dense, axis=1), np.zeros_like(cameras.X))
        found, cost = _affine_descent(tracks, cameras)
        floor = (ROUNDING * spread) ** 2 * len(tracks)
        is_same = attempt > 0 and abs(cost - least) <= SAME_AFFINE_COST * least + floor
        if cost < least:
            best, least = found, cost
        if is_same or least <= floor:
            break
    return best


def _decomposed(dense: Array, rank: int) -> AffineCameras:
    """Affine cameras and points from the singular value decomposition of pixels (n, p, 2) without NaN."""
    n, p, _ = dense.shape
    t = dense.mean(axis=1)
    u, values, vt = np.linalg.svd((dense - t[:, None]).transpose(0, 2, 1).reshape(2 * n, p), full_matrices=False)
    return AffineCameras((u[:, :rank] * values[:rank]).reshape(n, 2, rank), t, vt[:rank].T)


def _affine_descent(tracks: Tracks, start: AffineCameras) -> tuple[AffineCameras, float]:
    """The affine cameras and points at the minimum below a start, and their sum of squared errors, px^2."""
    n, p, rank = len(start.M), len(start.X), start.X.shape[1]
    sizes = Sizes(0, n, 2 * rank + 2, p, rank)

    def look(cameras: AffineCameras) -> NormalEquations:
        X, M = cameras.X[tracks.point], cameras.M[tracks.image]
        values = (M @ X[:, :, None])[:, :, 0] + cameras.t[tracks.image] - tracks.pixels
        by_images = np.zeros((len(tracks), 2, 1, sizes.per_image))
        for k in range(2):
            by_images[:, k, 0, k * rank : (k + 1) * rank] = X
            by_images[:, k, 0, 2 * rank + k] = 1
        term = Term(values, tracks.point, tracks.image[:, None], by_images, M, np.empty((len(tracks), 2, 0)))
        return NormalEquations(float((values**2).sum()), sizes, [term])

    def settled(cameras: AffineCameras) -> AffineCameras:
        return cameras._replace(X=cameras.X + look(cameras).step_of_points())

    def move(cameras: AffineCameras, step: Step) -> AffineCameras:
        M = cameras.M + step.images[:, : 2 * rank].reshape(n, 2, rank)
        return settled(AffineCameras(M, cameras.t + step.images[:, 2 * rank :], cameras.X))

    found = descend(look, move, settled(start), max_steps=300, least_damping=MIN_DAMPING)
    return found.state, found.here.cost


def whitened(cameras: AffineCameras) -> tuple[AffineCameras, Array]:
    """The same cameras with whitened points, and the singular values of the pixels.

    Whitened points have zero mean and unit covariance, along their principal axes.
    """
    middle = cameras.X.mean(axis=0)
    t = cameras.t + cameras.M @ middle
    n, _, rank = cameras.M.shape
    q, upper = np.linalg.qr(cameras.X - middle)
    u, values, vt = np.linalg.svd(cameras.M.reshape(2 * n, rank) @ upper.T, full_matrices=False)
    root = np.sqrt(len(q))
    M = (u * values / root).reshape(n, 2, -1)
    return AffineCameras(M, t, q @ vt.T * root), values


def refuse_rank(values: Array, tracks: Tracks, noise: float, rows: int, columns: int, why: str) -> None:
    """Raise ValueError if the smallest of r singular values is no larger than a singular value of noise alone.

    The largest singular value of a matrix of noise exceeds noise * (sqrt(rows) + sqrt(columns) + u) with a probability
    below exp(-u^2 / 2) (Davidson, Szarek 2001). The r - 1 larger components use up r - 1 rows and columns.

    values : (r,) singular values, descending, pixels. rows, columns : size of the matrix. why : explains the error.
    """
    full = len(tracks) / (tracks.n_images * tracks.n_points)
    before = len(values) - 1
    spread = np.sqrt(max(rows - before, 0)) + np.sqrt(max(columns - before, 0)) + np.sqrt(-2 * np.log(SIGNIFICANCE))
    of_noise = 0.0 if np.isnan(noise) else noise * spread / np.sqrt(full)
    if not values[-1] > max(of_noise, ROUNDING * values[0]):
        raise ValueError(
            f"expected tracks of rank {len(values)}, got singular values {', '.join(f'{v:.3g}' for v in values)} px, "
            f"of which the last may be noise (up to {of_noise:.3g} px): {why}; add points or views of other kinds."
        )


def noise_of(residuals: Array, freedom: int, noise_px: float | None) -> float:
    """Standard deviation of a residual: `noise_px`; if None, estimated. NaN without degrees of freedom."""
    if noise_px is not None:
        return float(noise_px)
    return float(np.sqrt((residuals**2).sum() / freedom)) if freedom > 0 else float("nan")


def residuals_of_all(tracks: Tracks, points: np.ndarray, residuals: Array) -> Array:
    """(m, 2) residuals of all observations of the tracks, from those of some points; NaN for the others."""
    result = np.full((len(tracks), 2), np.nan)
    result[np.isin(tracks.point, points)] = residuals
    return result


def points_of_all(tracks: Tracks, points: np.ndarray, X: Array) -> Array:
    """(n_points, r) rows for all points of the tracks, from the rows X of some points; NaN for the others."""
    result = np.full((tracks.n_points, X.shape[1]), np.nan)
    result[points] = X
    return result


# ------------------------------------------------------------------------------------------- orthographic


def factorise_orthographic(
    tracks: Tracks, *, has_scale: bool = False, noise_px: float | None = None, seed: int = 0
) -> OrthographicFactorisation:
    """Rotations and points under orthography or weak perspective, with the least squared pixel error.

    It starts with `factorise_affine` and its metric upgrade A: Q = A A^T solves m1^T Q m1 = m2^T Q m2 = 1 and
    m1^T Q m2 = 0 for the rows m1 and m2 of each image, which is linear in Q (Tomasi, Kanade 1992). Under weak
    perspective the two squares are equal instead of 1, and Q is known up to scale (Poelman, Kanade: "A paraperspective
    factorization method", PAMI 1997). A descent then adjusts rotations, translations, scales and points to the pixels.
    Its result reaches the Cramer-Rao bound.

    Parameters
    ----------
    tracks : which image sees which point; at least three images with at least four points each.
    has_scale : whether each image has a scale (weak perspective); the scale of the first image is 1.
    noise_px : standard deviation of a pixel's coordinate; None estimates it from the residuals.
    seed : see `factorise_affine`.

    Raises
    ------
    ValueError
        The tracks are refused by `factorise_affine`, or there are fewer than three images, because two leave a family
        of shapes (Ullman 1979). Or the images turn too little, or about the viewing direction alone, so that the depths
        stay open: half the depth under twice the turn looks the same, except for terms of the square of the turn.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from rangesim.multiview import Tracks
    >>> X = np.random.default_rng(0).normal(0, 100, (20, 3))
    >>> R = Rotation.from_rotvec(np.radians([0, 10, 20, 30])[:, None] * [0, 1, 0]).as_matrix()
    >>> tracks = Tracks.from_dense(np.einsum("nad,pd->npa", R[:, :2], X) + [320, 240])
    >>> found = factorise_orthographic(tracks)
    >>> np.allclose(found.R_camera_world, R), np.allclose(found.points, X - X.mean(axis=0))
    (True, True)
    """
    if tracks.n_images < 3:
        raise ValueError(
            f"expected at least 3 images, got {tracks.n_images}: two images without perspective leave the depth scale "
            "open (Ullman 1979)."
        )
    affine = factorise_affine(tracks, noise_px=noise_px, seed=seed)
    some, points = checked_tracks(tracks, 2, 4, 3, "an orthographic factorisation")
    start = metric_upgrade(affine.M, affine.t, affine.points[points], has_scale)
    found = orthographic.adjust(some, start, has_scale=has_scale)
    shapes = found.state
    residuals = shapes.project()[some.image, some.point] - some.pixels
    n, p = some.n_images, some.n_points
    gauge = 6 + int(has_scale)
    freedom = residuals.size - (n * (5 + int(has_scale)) + 3 * p - gauge)
    refuse_misfit(float((residuals**2).sum()), freedom, noise_px, "one rigid shape without perspective")
    noise = noise_of(residuals, freedom, noise_px)
    refuse_open_rotations(found.here, gauge, noise)
    _refuse_open_depth(found, noise)
    deviations = shape_deviations(found, gauge)[0] * noise
    shapes = first_upright(shapes)
    return OrthographicFactorisation(
        shapes.R,
        shapes.t,
        shapes.scale,
        points_of_all(tracks, points, shapes.basis[:, 0]),
        points_of_all(tracks, points, deviations[:, None])[:, 0],
        residuals_of_all(tracks, points, residuals),
        noise,
    )


def metric_upgrade(M: Array, t: Array, X: Array, has_scale: bool) -> Shapes:
    """The rigid shape that is nearest to affine cameras M (n, 2, 3), t (n, 2) and points X (p, 3).

    Raises ValueError if the images do not turn in different ways.
    """
    n = len(M)
    first, second = M[:, 0], M[:, 1]

    def row(a: Array, b: Array) -> Array:
        """(n, 6) coefficients of a^T Q b in the entries 11, 12, 13, 22, 23, 33 of Q."""
        products = a[:, :, None] * b[:, None, :]
        both = products + np.swapaxes(products, 1, 2)
        pairs = [(i, j) for i in range(3) for j in range(i, 3)]
        return np.stack([both[:, i, j] if i != j else products[:, i, i] for i, j in pairs], axis=-1)

    if has_scale:
        rows = np.concatenate([row(first, first) - row(second, second), row(first, second)])
        values, axes = right_singular_vectors(rows)
        entries, rank, wanted = axes[5], values[4], values[0]
    else:
        rows = np.concatenate([row(first, first), row(second, second), row(first, second)])
        values = np.linalg.svd(rows, compute_uv=False)
        entries = np.linalg.lstsq(rows, np.repeat([1.0, 1.0, 0.0], n), rcond=None)[0]
        rank, wanted = values[5], values[0]
    if not rank > ROUNDING * wanted:
        raise ValueError(
            "expected images that turn in different ways, got images whose equations for the shape are dependent: the "
            "same view again, or turns about the viewing direction alone; add views from other sides."
        )
    Q = np.zeros((3, 3))
    Q[np.triu_indices(3)] = entries
    Q = Q + Q.T - np.diag(np.diag(Q))
    if np.trace(Q) < 0:
        Q = -Q
    values, axes = np.linalg.eigh(Q)
    A = axes * np.sqrt(np.maximum(values, 1e-3 * values[-1]))  # noise may make Q indefinite; for a start this is enough
    rows = (M @ A).reshape(n, 2, 3)
    scale = np.sqrt(0.5 * (rows**2).sum(axis=(1, 2)))
    R = np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None] / scale[:, None, None]], axis=1)
    u, _, vt = np.linalg.svd(R)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    unit = scale if has_scale else np.ones(n)
    return Shapes(u @ vt, t, unit, np.ones((n, 1)), (X @ np.linalg.inv(A).T)[:, None])


def refuse_open_rotations(equations: NormalEquations, gauge: int, noise: float, unit: float = 1.0) -> None:
    """Raise ValueError if the rotation of an image has a deviation above `MAX_ROTATION_DEVIATION`.

    The rotation vector is the first three parameters of an image, and the gauge is that of `free_covariance`.

    gauge : number of freedoms of the gauge. noise : standard deviation of a pixel's coordinate. unit : pixels by which
    the residuals were divided.
    """
    covariance = equations.free_covariance(gauge) * (0.0 if np.isnan(noise) else max(noise / unit, 1e-300)) ** 2
    size = equations.sizes.per_image
    with np.errstate(invalid="ignore"):
        turn = np.sqrt(np.diag(covariance).reshape(-1, size)[:, :3].sum(axis=1))
    if not (turn <= MAX_ROTATION_DEVIATION).all():
        raise ValueError(
            f"expected images that determine the shape, got images that leave their rotations open at a noise of "
            f"{noise:.3g} px: they turn too little, show the same view again, or have too few points; add views from "
            "other sides."
        )


def shape_deviations(found: Descended[Shapes, NormalEquations], gauge: int) -> Array:
    """(n, p) float64, standard deviation of a coordinate of each point in each camera, for residuals of unit variance.

    It is the root mean square over the three coordinates. It has two parts: the errors that the points would have if
    the cameras were exact, and the errors that the cameras pass on to the points.

    gauge : number of freedoms of the gauge.
    """
    shapes, sizes = found.state, found.here.sizes
    n, K = shapes.coefficients.shape
    p, c = len(shapes.basis), sizes.per_image
    of_points = found.here.covariance_of_points().reshape(p, K, 3, K, 3)
    weights = shapes.coefficients
    variance = np.einsum("nk,pkdld,nl->np", weights, of_points, weights)
    values, axes = np.linalg.eigh(found.here.free_covariance(gauge))
    half = axes * np.sqrt(np.maximum(values, 0))
    response = found.here.response_of_points().reshape(p, K, 3, n * c) @ half
    for i in range(n):
        seen = shapes.basis @ shapes.R[i].T  # (p, K, 3)
        moved = np.einsum("ad,pkdg,k->pag", shapes.R[i], response, weights[i])
        y = np.einsum("k,pkd->pd", weights[i], seen)
        mine = half[i * c : (i + 1) * c]
        moved += np.cross(mine[:3].T[None], y[:, None]).transpose(0, 2, 1)
        moved += np.einsum("pkd,kg->pdg", seen[:, 1:], mine[5 : 4 + K])
        if c > 4 + K:  # the logarithm of a scale
            moved += y[:, :, None] * mine[-1]
        moved -= moved.mean(axis=0)  # the position of the whole shape does not count
        variance[i] += (moved**2).sum(axis=(1, 2))
    return np.asarray(shapes.scale[:, None] * np.sqrt(variance / 3))


def _refuse_open_depth(found: Descended[Shapes, NormalEquations], noise: float) -> None:
    """Raise ValueError if a common factor on all depths of a rigid shape has a deviation above `MAX_DEPTH_DEVIATION`.

    The tilts w_i of the cameras against the mean direction grow as the depths shrink:
    d log depth = -sum w_i dw_i / sum w_i^2.
    """
    shapes, size = found.state, found.here.sizes.per_image
    n = len(shapes.R)
    # the gauge: the first image stays, and so does the mean of the shape along its viewing direction
    conditions = np.zeros((7 if size > 5 else 6, n, size))
    conditions[:5, 0, :5] = np.eye(5)
    along = shapes.R[:, :2] @ shapes.R[0, 2]
    conditions[5, :, 3:5] = along / max(float(np.linalg.norm(along)), 1e-300)
    conditions[6:, 0, 5:] = 1.0
    covariance = found.here.covariance(conditions.reshape(len(conditions), -1))
    mean = Rotation.from_matrix(shapes.R).mean().as_matrix()
    tilts = Rotation.from_matrix(shapes.R @ mean.T).as_rotvec() * [1, 1, 0]
    tilts -= tilts.mean(axis=0)
    weights = np.zeros((n, size))
    weights[:, :3] = tilts / max(float((tilts**2).sum()), 1e-300)
    with np.errstate(invalid="ignore"):
        open_by = float(np.sqrt(weights.ravel() @ covariance @ weights.ravel())) * (0.0 if np.isnan(noise) else noise)
    if not open_by <= MAX_DEPTH_DEVIATION:
        amount = f"by {100 * open_by:.0f} %" if open_by < 10 else "altogether"
        raise ValueError(
            f"expected images whose turns determine the depths, got images that leave the depths open {amount} at a "
            f"noise of {noise:.3g} px: flatter points that turn more look nearly the same; add views from other sides."
        )


def first_upright(shapes: Shapes) -> Shapes:
    """Shapes with the same images, in the frame and the scale of the first camera, with the mean of the points at 0.

    Of the two reversals it is the one whose first turn is positive; see `OrthographicFactorisation`.
    """
    turn, unit = shapes.R[0], shapes.scale[0]
    basis = unit * shapes.basis @ turn.T
    R, scale = shapes.R @ turn.T, shapes.scale / unit
    middle = basis.mean(axis=0)
    moved = np.einsum("nk,kd->nd", shapes.coefficients, middle)
    t = shapes.t + scale[:, None] * np.einsum("nad,nd->na", R[:, :2], moved)
    basis = basis - middle
    # R13 is the sine of a turn about the vertical axis, and -R23 that of a turn about the horizontal axis
    sines = R[1:, :2, 2]
    k = int(np.argmax(np.abs(sines).max(axis=1) > 1e-3))
    if sines[k, int(np.argmax(np.abs(sines[k]) > 1e-3))] < 0:
        flip = np.array([1.0, 1.0, -1.0])
        R, basis = flip[:, None] * R * flip, basis * flip
    return Shapes(R, t, scale, shapes.coefficients, basis)


# ------------------------------------------------------------------------------------------- projective


def factorise_projective(tracks: Tracks, *, noise_px: float | None = None, seed: int = 0) -> ProjectiveFactorisation:
    """Camera matrices and points with the least squared pixel error, up to a projectivity.

    The depths start at 1, which is right for points far away. The matrix of d_ij (x_ij, 1) is decomposed at rank 4,
    which gives new depths, and this is repeated (Sturm, Triggs 1996, iterated). Before each decomposition, images and
    points are scaled to one size, so that the depths do not drift to zero (Hartley, Zisserman 2004, 18.4). Missing
    observations are filled in from an affine factorisation, and then from the prediction of each round. From this start
    a projective bundle adjustment over P_i and X_j goes to the least pixel error and reaches the Cramer-Rao bound.

    Parameters
    ----------
    tracks : which image sees which point; at least two images, and at least seven points that two or more images see.
        The pixels are those of a pinhole without distortion (`rangesim.geometry.ideal_pixels`).
    noise_px : standard deviation of a pixel's coordinate; None estimates it from the residuals.
    seed : see `factorise_affine`.

    Raises
    ------
    ValueError
        There are too few images or points, or images share no points. The matrix has a rank below 4: the points lie on
        a plane, or the cameras are in one place. Or some depths stay negative: tracks are wrong, or the start was too
        far from the minimum.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.multiview import Tracks
    >>> from rangesim.rig import Intrinsics
    >>> camera = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    >>> world = np.random.default_rng(0).uniform([-2, -1, 4], [3, 1, 7], (20, 3))
    >>> moves = [(0, 0, 0), (-0.5, 0.1, 0), (-1, 0, 0.2)]  # of the world before the camera, metres
    >>> tracks = Tracks.from_dense(np.stack([camera.project(world + move) for move in moves]))
    >>> found = factorise_projective(tracks)
    >>> np.allclose(found.project(), tracks.dense(), atol=1e-3)
    True
    """
    some, points = checked_tracks(tracks, 2, 7, 2, "a projective factorisation")
    check_noise(noise_px)
    n, p = some.n_images, some.n_points
    to_unit = np.stack([normalising_transform(some.pixels[some.image == i]) for i in range(n)])
    unit_pixels = some.pixels.copy()
    for i in range(n):
        mine = some.image == i
        unit_pixels[mine] = apply_similarity(to_unit[i], some.pixels[mine])
    unit = replace(some, pixels=unit_pixels)
    weights = to_unit[some.image, 0, 0]  # size of a pixel in the units of `unit`
    P, X, cost = _projective_descent(unit, *_projective_start(unit, seed, PROJECTIVE_RANK), weights)
    if not np.isfinite(cost):
        raise ValueError(
            "expected tracks of one rigid scene in front of all cameras, got tracks whose depths keep different "
            "signs: some tracks are wrong, too many observations are missing, or the points lie on a plane."
        )
    image = (P[some.image] @ X[some.point][:, :, None])[:, :, 0]
    residuals = (image[:, :2] / image[:, 2:] - unit_pixels) / weights[:, None]
    freedom = residuals.size - (11 * n + 3 * p - 15)
    refuse_misfit(cost, freedom, noise_px, "one rigid scene")
    noise = noise_of(residuals, freedom, noise_px)
    # the simpler model: homographies between the images, where P_i and X_j have rank 3
    flat = _projective_descent(unit, *_projective_start(unit, seed, PROJECTIVE_RANK - 1), weights)[2]
    simple = flat, residuals.size - (8 * n + 2 * p - 8)
    if simpler_model_suffices(simple, (cost, freedom), noise_px, rounding_of(some.pixels)):
        raise ValueError(
            f"expected tracks of rank 4, got tracks that homographies between the images explain to "
            f"{np.sqrt(flat / simple[1]):.3g} px: the points lie on a plane, or the cameras are in one place; add "
            "points at other depths or move the camera."
        )
    cameras = np.linalg.inv(to_unit) @ P
    cameras /= np.linalg.norm(cameras, axis=(1, 2), keepdims=True)
    return ProjectiveFactorisation(
        cameras, points_of_all(tracks, points, X), residuals_of_all(tracks, points, residuals), noise
    )


def _projective_start(tracks: Tracks, seed: int, rank: int) -> tuple[Array, Array]:
    """Camera matrices (n, 3, rank) and points (p, rank) from rounds of projective depths and decomposition."""
    dense = tracks.dense()
    missing = np.isnan(dense[..., 0])
    if missing.any():
        dense[missing] = low_rank(tracks, AFFINE_RANK, seed).project()[missing]
    depths = np.ones(missing.shape)
    homogeneous = np.concatenate([dense, np.ones((*missing.shape, 1))], axis=2)
    n, p = dense.shape[:2]
    for _ in range(DEPTH_ROUNDS):
        for _ in range(2):  # scale all points, then all images, to one size
            size = depths**2 * (homogeneous**2).sum(axis=2)
            depths /= np.sqrt(size.mean(axis=0))
            size = depths**2 * (homogeneous**2).sum(axis=2)
            depths /= np.sqrt(size.mean(axis=1, keepdims=True))
        matrix = (depths[..., None] * homogeneous).transpose(0, 2, 1).reshape(3 * n, p)
        u, values, vt = np.linalg.svd(matrix, full_matrices=False)
        P, X = (u[:, :rank] * values[:rank]).reshape(n, 3, rank), vt[:rank].T
        image = np.einsum("nab,pb->npa", P, X)
        better = (image * homogeneous).sum(axis=2) / (homogeneous**2).sum(axis=2)
        depths = np.where(better > 0, better, depths)
        fill = missing & (image[..., 2] > 0)
        homogeneous[fill, :2] = image[fill, :2] / image[fill, 2:]
    return P, X / np.linalg.norm(X, axis=1, keepdims=True)


def _projective_descent(tracks: Tracks, P: Array, X: Array, weights: Array) -> tuple[Array, Array, float]:
    """P, X and their sum of squared errors, px^2, at its minimum; infinite if a depth of the start is not positive.

    weights : (m,) size of a pixel in the units of the tracks.
    """
    rank = X.shape[1]
    sizes = Sizes(0, len(P), 3 * rank, len(X), rank - 1)

    def tangents(X: Array) -> Array:
        """(p, r, r - 1) float64, orthonormal directions in which the unit vectors X can move."""
        return np.linalg.svd(X[:, None, :])[2][:, 1:].transpose(0, 2, 1)

    def look(state: tuple[Array, Array]) -> NormalEquations:
        P, X = state
        Xo, Po = X[tracks.point], P[tracks.image]
        image = (Po @ Xo[:, :, None])[:, :, 0]
        w = image[:, 2]
        if not (w > 0).all():
            return NormalEquations(np.inf, sizes, [])
        xy = image[:, :2] / w[:, None]
        values = (xy - tracks.pixels) / weights[:, None]
        by_plane = np.zeros((len(tracks), 2, 3))
        by_plane[:, 0, 0] = by_plane[:, 1, 1] = 1 / (w * weights)
        by_plane[:, :, 2] = -xy / (w * weights)[:, None]
        by_images = (by_plane[:, :, :, None] * Xo[:, None, None, :]).reshape(len(tracks), 2, 1, 3 * rank)
        by_point = by_plane @ Po @ tangents(X)[tracks.point]
        term = Term(values, tracks.point, tracks.image[:, None], by_images, by_point, np.empty((len(tracks), 2, 0)))
        return NormalEquations(float((values**2).sum()), sizes, [term])

    def move(state: tuple[Array, Array], step: Step) -> tuple[Array, Array]:
        P, X = state
        P = P + step.images.reshape(P.shape)
        X = X + (tangents(X) @ step.points[:, :, None])[:, :, 0]
        size = np.linalg.norm(P, axis=(1, 2), keepdims=True)
        return P / size, X / np.linalg.norm(X, axis=1, keepdims=True)

    P = P / np.linalg.norm(P, axis=(1, 2), keepdims=True)
    if not np.isfinite(look((P, X)).cost):
        return P, X, np.inf
    found = descend(look, move, (P, X), max_steps=300, least_damping=MIN_DAMPING)
    return *found.state, found.here.cost
