# SPDX-License-Identifier: Apache-2.0
"""Cameras and points at once from the rank of the matrix of tracks: affine, orthographic and projective factorisation.

Affine cameras see x_ij = M_i X_j + t_i, so that the pixels of all images, less t, are a matrix of rank 3 (Tomasi,
Kanade: "Shape and motion from image streams under orthography: a factorization method", IJCV 1992). Pinholes see
d_ij (x_ij, 1) = P_i X_j, so that with the right projective depths d the matrix has rank 4 (Sturm, Triggs: "A
factorization based algorithm for multi-image projective structure and motion", ECCV 1996; Mahamud, Hebert: "Iterative
projective reconstruction from multiple views", CVPR 2000; Hartley, Zisserman 2004, chapter 18).

The singular value decomposition solves the affine case alone, and that only where every point is in every image. Each
function therefore ends with the minimum of the squared pixel errors over the observations there are, over exactly the
parameters that its camera has, and reaches the Cramer-Rao bound; missing observations are nothing but rows that are
not there. Only where they start from needs them filled in: by rounds of decomposition and prediction.

Degenerate: points on a plane, images that do not turn (affine) or do not move (projective), the same view again, fewer
images or points than the rank takes. These are errors, told by the singular values against those of noise.
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

AFFINE_RANK, PROJECTIVE_RANK = 3, 4
ROUNDS = 60
"""Of filling in and decomposing, before the descent."""
DEPTH_ROUNDS = 100
RANDOM_STARTS = 4
SAME_COST = 1e-6
"""Relative difference of the sums of squares of two starts that found the same minimum."""
LEAST_DAMPING = 1e-12
MAX_ROTATION_DEVIATION = 0.3
"""Radians; rotations known worse than this are none."""
MAX_DEPTH_DEVIATION = 0.15
"""Relative standard deviation of the depths of a rigid shape together, beyond which they are open. Noise is Gaussian in
1 / depth^2: at 0.15, two standard deviations are depths 1.6 times as large; at 0.2, noise alone finds 1000 times."""


class AffineCameras(NamedTuple):
    """M : (n, 2, r), t : (n, 2), X : (p, r) with x_ij = M_i X_j + t_i."""

    M: Array
    t: Array
    X: Array

    def project(self) -> Array:
        """(n, p, 2) pixels."""
        return np.asarray(np.einsum("nar,pr->npa", self.M, self.X) + self.t[:, None])


@dataclass(frozen=True, eq=False)
class AffineFactorisation:
    """x_ij = M_i X_j + t_i, up to X -> A X + b, an affinity of space.

    M : (n_images, 2, r) pixels. t : (n_images, 2) pixels. points : (n_points, r), of zero mean and unit covariance;
    NaN of points seen in too few images. residuals_px : (m, 2) predicted less seen; NaN of observations that were left
    out. noise_px : standard deviation of a coordinate. singular_values : (r,) of the predicted pixels less t: how much
    each component moves them, pixels.
    """

    M: Array
    t: Array
    points: Array
    residuals_px: Array
    noise_px: float
    singular_values: Array


@dataclass(frozen=True, eq=False)
class OrthographicFactorisation:
    """x_ij = s_i (R_i X_j)_xy + t_i, in the frame of the first camera, up to a reversal.

    R_camera_world : (n_images, 3, 3), the first of which is the identity. t : (n_images, 2) pixels. scale :
    (n_images,), 1 under orthography, and 1 in the first image under weak perspective. points : (n_points, 3) in units
    of the pixels, of the first image, their mean at 0; NaN of points seen in too few images. shape_deviation_px :
    (n_points,) standard deviation of a coordinate of `points`, root mean square over the three; NaN as `points`, and
    where nothing tells the noise. residuals_px : (m, 2) predicted less seen; NaN of what was left out. noise_px :
    standard deviation of a pixel's coordinate.

    Without perspective a shape and its mirror image, deep for shallow, look alike (Necker reversal): `reversed` is as
    good an answer as this one. Here the first image that turns is taken to be turned by a positive angle about the
    vertical axis, or horizontal if it is not turned about that.
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
        """The other answer: X -> diag(1, 1, -1) X, and rotations to match."""
        flip = np.array([1.0, 1.0, -1.0])
        return replace(self, R_camera_world=flip[:, None] * self.R_camera_world * flip, points=self.points * flip)


@dataclass(frozen=True, eq=False)
class ProjectiveFactorisation:
    """x_ij = pixels of P_i X_j, up to X -> H X, a projectivity of space.

    P : (n_images, 3, 4) of unit norm. points : (n_points, 4) homogeneous, of unit norm; NaN of points seen in too few
    images. Depths, the third coordinate of P_i X_j, are positive. residuals_px : (m, 2) predicted less seen; NaN of
    what was left out. noise_px : standard deviation of a coordinate.
    """

    P: Array
    points: Array
    residuals_px: Array
    noise_px: float

    def project(self) -> Array:
        """(n_images, n_points, 2) pixels."""
        image = np.einsum("nab,pb->npa", self.P, self.points)
        return np.asarray(image[..., :2] / image[..., 2:])


# ------------------------------------------------------------------------------------------- affine


def factorise_affine(
    tracks: Tracks, rank: int = AFFINE_RANK, *, noise_px: float | None = None, seed: int = 0
) -> AffineFactorisation:
    """Affine cameras and points of least squared pixel error (Tomasi, Kanade 1992, before the metric upgrade).

    With every point in every image: t_i is the mean, M and X the first `rank` components of the singular value
    decomposition. Otherwise the sum over the observations alone is minimised by variable projection with a damped
    Gauss-Newton step (Okatani, Yoshida, Deguchi, ICCV 2011), from the matrix filled in and from random cameras,
    until two starts agree.

    Parameters
    ----------
    tracks : each image with more than `rank` points; points in fewer than rank / 2 images are left out.
    rank : 3 for a rigid scene, 3 K for K basis shapes.
    noise_px : standard deviation of a coordinate; None: from the residuals.
    seed : of the random cameras.

    Raises
    ------
    ValueError
        Too few images or points; images that share no points; or a rank that is not there: points on a plane, or
        images that do not turn against each other.
    """
    some, points = determined(tracks, -(-rank // 2), rank + 1, 0.5 * (rank + 1), f"a factorisation of rank {rank}")
    check_noise(noise_px)
    cameras = low_rank(some, rank, seed)
    residuals = cameras.project()[some.image, some.point] - some.pixels
    n, p = some.n_images, some.n_points
    freedom = residuals.size - (n * (2 * rank + 2) + p * rank - rank * (rank + 1))
    refuse_misfit(float((residuals**2).sum()), freedom, noise_px, f"a matrix of rank {rank}")
    noise = noise_of(residuals, freedom, noise_px)
    cameras, values = whitened(cameras)
    refuse_rank(values, some, noise, 2 * n - 1, p - 1, "points on a plane, or images that do not turn")
    all_residuals = everywhere(tracks, points, residuals)
    return AffineFactorisation(
        cameras.M, cameras.t, scattered(tracks, points, cameras.X), all_residuals, noise, values / np.sqrt(len(some))
    )


def determined(
    tracks: Tracks, least_images: int, least_points: int, images_needed: float, purpose: str
) -> tuple[Tracks, np.ndarray]:
    """The tracks of points in at least `least_images` images, numbered anew, and their numbers before."""
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
    """The tracks of points in at least `least_images` images, numbered anew, and their numbers before."""
    points = np.flatnonzero(tracks.images_per_point >= least_images)
    place = np.full(tracks.n_points, -1)
    place[points] = np.arange(len(points))
    kept = place[tracks.point] >= 0
    some = Tracks(tracks.image[kept], place[tracks.point[kept]], tracks.pixels[kept], tracks.n_images, len(points))
    return some, points


def low_rank(tracks: Tracks, rank: int, seed: int) -> AffineCameras:
    """Cameras and points of least squared error over the observations."""
    dense = tracks.dense()
    missing = np.isnan(dense)
    filled = np.where(missing, np.nanmean(dense, axis=1, keepdims=True), dense)
    cameras = _decomposed(filled, rank)
    if not missing.any():
        return cameras
    for _ in range(ROUNDS):
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
        is_same = abs(cost - least) <= SAME_COST * least + floor
        if cost < least:
            best, least = found, cost
        if is_same or least <= floor:
            break
    return best


def _decomposed(dense: Array, rank: int) -> AffineCameras:
    n, p, _ = dense.shape
    t = dense.mean(axis=1)
    u, values, vt = np.linalg.svd((dense - t[:, None]).transpose(0, 2, 1).reshape(2 * n, p), full_matrices=False)
    return AffineCameras((u[:, :rank] * values[:rank]).reshape(n, 2, rank), t, vt[:rank].T)


def _affine_descent(tracks: Tracks, start: AffineCameras) -> tuple[AffineCameras, float]:
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

    found = descend(look, move, settled(start), max_steps=300, least_damping=LEAST_DAMPING)
    return found.state, found.here.cost


def whitened(cameras: AffineCameras) -> tuple[AffineCameras, Array]:
    """The same with points of zero mean and unit covariance along the principal axes, and the singular values."""
    middle = cameras.X.mean(axis=0)
    t = cameras.t + cameras.M @ middle
    n, _, rank = cameras.M.shape
    q, upper = np.linalg.qr(cameras.X - middle)
    u, values, vt = np.linalg.svd(cameras.M.reshape(2 * n, rank) @ upper.T, full_matrices=False)
    root = np.sqrt(len(q))
    M = (u * values / root).reshape(n, 2, -1)
    return AffineCameras(M, t, q @ vt.T * root), values


def refuse_rank(values: Array, tracks: Tracks, noise: float, rows: int, columns: int, why: str) -> None:
    """Raise ValueError where the least of r singular values is no larger than noise alone would have.

    Of a matrix of noise, the largest exceeds noise (sqrt(rows) + sqrt(columns) + u) with a probability below
    exp(-u^2 / 2) (Davidson, Szarek 2001); r - 1 components have taken as many rows and columns before it.
    """
    full = len(tracks) / (tracks.n_images * tracks.n_points)
    before = len(values) - 1
    spread = np.sqrt(max(rows - before, 0)) + np.sqrt(max(columns - before, 0)) + np.sqrt(-2 * np.log(SIGNIFICANCE))
    of_noise = 0.0 if np.isnan(noise) else noise * spread / np.sqrt(full)
    if not values[-1] > max(of_noise, ROUNDING * values[0]):
        raise ValueError(
            f"expected tracks of rank {len(values)}, got singular values {', '.join(f'{v:.3g}' for v in values)} px of "
            f"which the last may be noise (up to {of_noise:.3g}): {why}; add points or views of other kinds."
        )


def noise_of(residuals: Array, freedom: int, noise_px: float | None) -> float:
    if noise_px is not None:
        return float(noise_px)
    return float(np.sqrt((residuals**2).sum() / freedom)) if freedom > 0 else float("nan")


def everywhere(tracks: Tracks, points: np.ndarray, residuals: Array) -> Array:
    """(m, 2) of all observations, from those of some points."""
    result = np.full((len(tracks), 2), np.nan)
    result[np.isin(tracks.point, points)] = residuals
    return result


def scattered(tracks: Tracks, points: np.ndarray, X: Array) -> Array:
    result = np.full((tracks.n_points, X.shape[1]), np.nan)
    result[points] = X
    return result


# ------------------------------------------------------------------------------------------- orthographic


def factorise_orthographic(
    tracks: Tracks, *, has_scale: bool = False, noise_px: float | None = None, seed: int = 0
) -> OrthographicFactorisation:
    """Rotations and points under orthography, or weak perspective, of least squared pixel error.

    `factorise_affine`, then the metric upgrade: Q = A A^T with m1^T Q m1 = m2^T Q m2 = 1 and m1^T Q m2 = 0 for the rows
    m of each image, linear in Q (Tomasi, Kanade 1992); under weak perspective without the 1, up to scale (Poelman,
    Kanade: "A paraperspective factorization method", PAMI 1997). The upgrade is a start: rotations, translations,
    scales and points are then adjusted to the pixels, and this reaches the Cramer-Rao bound of n images and p points.

    Parameters
    ----------
    tracks : at least three images, four points in each; see `factorise_affine`.
    has_scale : weak perspective, a scale for each image; the first one's is 1.

    Raises
    ------
    ValueError
        As `factorise_affine`; fewer than three images (two leave a family of shapes, Ullman 1979); or images that turn
        too little, or about the viewing direction alone, so that the shape stays open: half the depth and twice the
        turn look the same but for the square of the turn.
    """
    if tracks.n_images < 3:
        raise ValueError(
            f"expected at least 3 images, got {tracks.n_images}: two images without perspective leave the depth scale "
            "open (Ullman 1979)."
        )
    affine = factorise_affine(tracks, noise_px=noise_px, seed=seed)
    some, points = determined(tracks, 2, 4, 3, "an orthographic factorisation")
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
        scattered(tracks, points, shapes.basis[:, 0]),
        scattered(tracks, points, deviations[:, None])[:, 0],
        everywhere(tracks, points, residuals),
        noise,
    )


def metric_upgrade(M: Array, t: Array, X: Array, has_scale: bool) -> Shapes:
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
            "expected images that turn in different ways, got some whose equations for the shape depend on each other: "
            "the same view again, or turns about the viewing direction alone; add views from other sides."
        )
    Q = np.zeros((3, 3))
    Q[np.triu_indices(3)] = entries
    Q = Q + Q.T - np.diag(np.diag(Q))
    if np.trace(Q) < 0:
        Q = -Q
    values, axes = np.linalg.eigh(Q)
    A = axes * np.sqrt(np.maximum(values, 1e-3 * values[-1]))  # noise may make it indefinite; this is but a start
    rows = (M @ A).reshape(n, 2, 3)
    scale = np.sqrt(0.5 * (rows**2).sum(axis=(1, 2)))
    R = np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None] / scale[:, None, None]], axis=1)
    u, _, vt = np.linalg.svd(R)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    unit = scale if has_scale else np.ones(n)
    return Shapes(u @ vt, t, unit, np.ones((n, 1)), (X @ np.linalg.inv(A).T)[:, None])


def refuse_open_rotations(equations: NormalEquations, gauge: int, noise: float, unit: float = 1.0) -> None:
    """Raise ValueError where rotations, the first parameters of each image, are known worse than within
    `MAX_ROTATION_DEVIATION`, the gauge spread over all of them. unit : pixels by which residuals were divided."""
    covariance = equations.free_covariance(gauge) * (0.0 if np.isnan(noise) else max(noise / unit, 1e-300)) ** 2
    size = equations.sizes.per_image
    with np.errstate(invalid="ignore"):
        turn = np.sqrt(np.diag(covariance).reshape(-1, size)[:, :3].sum(axis=1))
    if not (turn <= MAX_ROTATION_DEVIATION).all():
        raise ValueError(
            f"expected images that determine the shape, got some that leave their rotations open at a noise of "
            f"{noise:.3g} px: they turn too little, the same view again, or too few points; add views from other sides."
        )


def shape_deviations(found: Descended[Shapes, NormalEquations], gauge: int) -> Array:
    """(n, p) root mean square standard deviation of the coordinates of the shape as its camera sees it, for residuals
    of unit variance: what the points leave open, and what the images do, whose errors the points follow."""
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
        moved -= moved.mean(axis=0)  # where the whole shape stands is no part of it
        variance[i] += (moved**2).sum(axis=(1, 2))
    return np.asarray(shapes.scale[:, None] * np.sqrt(variance / 3))


def _refuse_open_depth(found: Descended[Shapes, NormalEquations], noise: float) -> None:
    """Raise ValueError where the depths of a rigid shape, all by one factor, are known worse than within
    `MAX_DEPTH_DEVIATION`.

    Tilts w_i against the mean direction grow as the depths shrink: d log depth = -sum w_i dw_i / sum w_i^2.
    """
    shapes, size = found.state, found.here.sizes.per_image
    n = len(shapes.R)
    # the first image stays, and so does the mean of the shape along its viewing direction
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
            f"expected images whose turns determine the depths, got some that leave these open {amount} at a noise of "
            f"{noise:.3g} px: shallow points that turn more look nearly the same; add views from other sides."
        )


def first_upright(shapes: Shapes) -> Shapes:
    """The same images of shapes in the frame of the first camera, about their mean, of its scale, the first turn
    positive."""
    turn, unit = shapes.R[0], shapes.scale[0]
    basis = unit * shapes.basis @ turn.T
    R, scale = shapes.R @ turn.T, shapes.scale / unit
    middle = basis.mean(axis=0)
    moved = np.einsum("nk,kd->nd", shapes.coefficients, middle)
    t = shapes.t + scale[:, None] * np.einsum("nad,nd->na", R[:, :2], moved)
    basis = basis - middle
    # R13 is the sine of a turn about the vertical axis, R23 of one about the horizontal one
    sines = R[1:, :2, 2]
    k = int(np.argmax(np.abs(sines).max(axis=1) > 1e-3))
    if sines[k, int(np.argmax(np.abs(sines[k]) > 1e-3))] < 0:
        flip = np.array([1.0, 1.0, -1.0])
        R, basis = flip[:, None] * R * flip, basis * flip
    return Shapes(R, t, scale, shapes.coefficients, basis)


# ------------------------------------------------------------------------------------------- projective


def factorise_projective(tracks: Tracks, *, noise_px: float | None = None, seed: int = 0) -> ProjectiveFactorisation:
    """Camera matrices and points of least squared pixel error, up to a projectivity.

    Depths start at 1, as far away; the matrix of d_ij (x_ij, 1), its images and points balanced to one size, is
    decomposed at rank 4, which gives new depths, and so on (Sturm, Triggs 1996, iterated; balanced so that it does not
    drift to where all depths vanish, HZ 18.4). Missing observations are filled in from an affine factorisation and
    then by each round's prediction. This is a start: projective bundle adjustment over P_i and X_j ends at the minimum
    of the pixel errors, as its Cramer-Rao bound wants it.

    Parameters
    ----------
    tracks : at least two images, seven points in two or more; pixels of a pinhole (take the lens out first).
    noise_px : standard deviation of a coordinate; None: from the residuals.

    Raises
    ------
    ValueError
        Too few images or points; images that share no points; a rank below 4: points on a plane, cameras in one place;
        or depths that stay of different signs: the pairs are wrong, or the start was too far off.
    """
    some, points = determined(tracks, 2, 7, 2, "a projective factorisation")
    check_noise(noise_px)
    n, p = some.n_images, some.n_points
    to_unit = np.stack([normalising_transform(some.pixels[some.image == i]) for i in range(n)])
    unit_pixels = some.pixels.copy()
    for i in range(n):
        mine = some.image == i
        unit_pixels[mine] = apply_similarity(to_unit[i], some.pixels[mine])
    unit = replace(some, pixels=unit_pixels)
    weights = to_unit[some.image, 0, 0]  # a pixel in these units
    P, X, cost = _projective_descent(unit, *_projective_start(unit, seed, PROJECTIVE_RANK), weights)
    if not np.isfinite(cost):
        raise ValueError(
            "expected tracks of one rigid scene in front of all cameras, got some whose depths stay of different "
            "signs: some tracks are wrong, too much is missing, or points lie on a plane."
        )
    image = (P[some.image] @ X[some.point][:, :, None])[:, :, 0]
    residuals = (image[:, :2] / image[:, 2:] - unit_pixels) / weights[:, None]
    freedom = residuals.size - (11 * n + 3 * p - 15)
    refuse_misfit(cost, freedom, noise_px, "one rigid scene")
    noise = noise_of(residuals, freedom, noise_px)
    # with homographies alone, P_i and X_j of three entries: a plane, or cameras in one place
    flat = _projective_descent(unit, *_projective_start(unit, seed, PROJECTIVE_RANK - 1), weights)[2]
    simple = flat, residuals.size - (8 * n + 2 * p - 8)
    if simpler_model_suffices(simple, (cost, freedom), noise_px, rounding_of(some.pixels)):
        raise ValueError(
            f"expected tracks of rank 4, got some that homographies between the images explain to "
            f"{np.sqrt(flat / simple[1]):.3g} px: points on a plane, or cameras in one place; add points at other "
            "depths or move the camera."
        )
    cameras = np.linalg.inv(to_unit) @ P
    cameras /= np.linalg.norm(cameras, axis=(1, 2), keepdims=True)
    return ProjectiveFactorisation(cameras, scattered(tracks, points, X), everywhere(tracks, points, residuals), noise)


def _projective_start(tracks: Tracks, seed: int, rank: int) -> tuple[Array, Array]:
    dense = tracks.dense()
    missing = np.isnan(dense[..., 0])
    if missing.any():
        dense[missing] = low_rank(tracks, AFFINE_RANK, seed).project()[missing]
    depths = np.ones(missing.shape)
    homogeneous = np.concatenate([dense, np.ones((*missing.shape, 1))], axis=2)
    n, p = dense.shape[:2]
    for _ in range(DEPTH_ROUNDS):
        for _ in range(2):  # images and points to one size
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
    """P, X and their sum of squared errors over the weights, at its minimum; infinite where depths are not positive."""
    rank = X.shape[1]
    sizes = Sizes(0, len(P), 3 * rank, len(X), rank - 1)

    def tangents(X: Array) -> Array:
        """(p, r, r - 1) orthonormal directions in which unit vectors X can move."""
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
    found = descend(look, move, (P, X), max_steps=300, least_damping=LEAST_DAMPING)
    return *found.state, found.here.cost
