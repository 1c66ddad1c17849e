# SPDX-License-Identifier: Apache-2.0
"""Structure from motion of a shape that deforms: each image combines K basis shapes with its own coefficients.

    x_ij = P R_i (B_0j + sum_k c_ik B_kj) + t_i,    k = 1 ... K - 1,    P = [1 0 0; 0 1 0]

The pixels of all images minus t have rank 3 K (Bregler, Hertzmann, Biermann: "Recovering non-rigid 3D shape from image
streams", CVPR 2000). `factorise_nonrigid` decomposes them at this rank and finds the rotations and coefficients in the
factors. `adjust_nonrigid` is bundle adjustment of the same model, with priors on the change from one image to the next
(Del Bue, Smeraldi, Agapito: "Non-rigid structure from motion using ranklet-based tracking and non-linear optimization",
IVC 2007; Torresani, Hertzmann, Bregler: "Nonrigid structure-from-motion: estimating shape and motion with hierarchical
priors", PAMI 2008).

The metric upgrade. The decomposition is known up to a matrix G (3 K, 3 K), and M_i G = [R_i, c_i1 R_i, ...] determines
it. Three ways to find G have been proposed. The linear constraints of orthonormality alone leave a space of solutions
of dimension 2 K^2 - K (Xiao, Chai, Kanade 2004; Akhter, Sheikh, Khan, Kanade 2009). One triple of columns of G at a
time (Dai, Li, He 2012) has 2 n equations for 9 K entries, which are determined up to K + 3 freedoms: 20 equations for
29 unknowns with 10 images and K = 4, too few. All of G at once has 6 K n equations for n (K + 2) rotations and
coefficients and 9 K^2 entries, minus 3 + K (K - 1) of gauge: 240 equations for 189 unknowns. This module therefore
finds G, R_i and c_i at once, as a non-rigid shape of 3 K virtual points, which are the columns of the decomposition. It
takes some milliseconds for each of several starts, and the first start is the best rigid shape. If observations are
missing, the decomposition at rank 3 K has wrong minima, with 10 images more often than not. Then the points themselves
take the place of the virtual points, and a rigid factorisation is the start. The search ends as soon as a start agrees
with the best result so far, and returns this result.

Some inputs do not determine the result: fewer images than the rank needs, fewer basis shapes in the tracks than asked
for, images that do not turn. These raise an error. A rigid motion of the whole shape and a deformation that looks the
same cannot be distinguished: if a deformation turns the whole shape, the model may count it as a turn of the camera.

Used by: no module of rangesim; it is for users alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.geometry.consensus import refuse_misfit
from rangesim.geometry.correspondences import ROUNDING, Array, check_noise
from rangesim.geometry.least_squares import Descended
from rangesim.multiview import orthographic
from rangesim.multiview.factorisation import (
    AffineCameras,
    checked_tracks,
    first_upright,
    low_rank,
    metric_upgrade,
    noise_of,
    refuse_open_rotations,
    refuse_rank,
    renumbered,
    residuals_of_all,
    shape_deviations,
    whitened,
)
from rangesim.multiview.orthographic import Shapes, TemporalPrior
from rangesim.multiview.schur_complement import NormalEquations
from rangesim.multiview.tracks import Tracks
from rangesim.settings.config import shown

STARTS = 20
"""Largest number of starts of the metric upgrade, a count; if no two of them agree, an error is raised. Measured with
24 sets of 50 points in 10 images at K = 4, half of them with 10 % missing: 3 to 7 starts are needed."""
START_STEPS = 120
"""Largest number of steps from each start, a count. A start need not converge, because the best one goes on from there;
it must come near enough to its minimum to be compared within `SAME_SHAPE_COST`."""
START_TURN_RAD = 0.3
"""Standard deviation of a component of the rotation vector by which a start turns each image of the first start,
radians. Smaller turns end in the same minimum again; larger ones are no better than random rotations."""
SAME_SHAPE_COST = 1e-4
"""Relative difference of the sums of squares of two starts, a ratio, below which they agree. It is larger than 1e-9,
the relative decrease at which a descent from a start counts as ended."""
MAX_SHAPE_DEVIATION = 0.5
"""Largest ratio of the median coordinate's standard deviation to the extent of the mean shape. A shape that is known
less well is refused, because its errors would be as large as half of the shape."""
MIN_RELATIVE_NOISE = 1e-4
"""Smallest noise beside a prior, as a fraction of the standard deviation of all pixels. With less noise, rounding
of the normal equations would hide the prior."""


class UnknownCount(NamedTuple):
    """The numbers of equations and unknowns of a non-rigid shape of n images, p points and K basis shapes.

    equations : 2 n p, two for each point in each image.
    rotations : 3 n. translations : 2 n. scales : n under weak perspective, else 0.
    coefficients : (K - 1) n, because the coefficient of the mean shape is 1.
    shapes : 3 K p, the coordinates of the basis shapes.
    gauge : number of freedoms that change no pixel: 3 of a rotation of the world; 3 K of a translation of each basis
        shape, which translations of the images make up for; K (K - 1) of an affinity of the coefficients, which gives
        other deformations with the same span, and another mean; and under weak perspective K more, because there any
        linear map of scales and coefficients together changes no pixel.

    Examples
    --------
    See `count_unknowns`.
    """

    equations: int
    rotations: int
    translations: int
    scales: int
    coefficients: int
    shapes: int
    gauge: int

    @property
    def unknowns(self) -> int:
        """Number of all unknowns: rotations, translations, scales, coefficients and shapes."""
        return self.rotations + self.translations + self.scales + self.coefficients + self.shapes

    @property
    def determinable(self) -> int:
        """Number of unknowns minus the gauge, which is the rank of the equations for a general motion."""
        return self.unknowns - self.gauge

    @property
    def redundancy(self) -> int:
        """Number of equations minus the number of unknowns that they determine."""
        return self.equations - self.determinable


def count_unknowns(n_images: int, n_points: int, n_basis: int, *, has_scale: bool = False) -> UnknownCount:
    """The numbers of equations and unknowns of a non-rigid shape.

    Parameters
    ----------
    n_images, n_points : numbers of images and points.
    n_basis : number K of basis shapes, the mean shape included.
    has_scale : whether each image has a scale (weak perspective).

    Raises
    ------
    ValueError
        A number is not an integer of 1 or more.

    Examples
    --------
    >>> count = count_unknowns(10, 50, 4)
    >>> count.equations, count.unknowns  # 2 * 10 * 50; 30 + 20 + 30 + 600
    (1000, 680)
    >>> count.gauge, count.determinable, count.redundancy  # 3 + 12 + 12
    (27, 653, 347)
    """
    for name, value in (("n_images", n_images), ("n_points", n_points), ("n_basis", n_basis)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"expected {name} as a number from 1 on, got {shown(value)}.")
    n, p, K = int(n_images), int(n_points), int(n_basis)
    gauge = 3 + 3 * K + K * (K - 1) + K * int(has_scale)
    return UnknownCount(2 * n * p, 3 * n, 2 * n, n * int(has_scale), (K - 1) * n, 3 * K * p, gauge)


@dataclass(frozen=True, eq=False)
class NonRigidShape:
    """A deforming shape and its cameras, in the frame of the first camera, up to a reversal.

    R_camera_world : (n_images, 3, 3) float64, rotates world coordinates to those of each camera; the first is the
        identity.
    t : (n_images, 2) float64, pixels.
    coefficients : (n_images, K) float64. The first is 1; the others are uncorrelated, with zero mean and unit variance
        over the images.
    basis : (n_points, K, 3) float64, world, pixels: the mean shape with its mean at 0, then the principal deformations,
        the largest first. NaN for a point seen in too few images.
    shape_deviation_px : (n_images, n_points) float64, standard deviation of a coordinate of the shape in the camera of
        each image, as the root mean square over the three. Read it before you trust a point that few images see.
    residuals_px : (m, 2) float64, predicted minus seen pixel; NaN for an observation that was left out.
    noise_px : standard deviation of a pixel's coordinate.
    prior : the prior that was used.

    Without perspective, the shape with all depths of the opposite sign looks the same: `reversed`.

    Examples
    --------
    See `factorise_nonrigid`.
    """

    R_camera_world: Array
    t: Array
    coefficients: Array
    basis: Array
    shape_deviation_px: Array
    residuals_px: Array
    noise_px: float
    prior: TemporalPrior

    @property
    def shapes(self) -> Array:
        """(n_images, n_points, 3) float64, the shape in each image, pixels, in the frame of the first camera."""
        return np.asarray(np.einsum("nk,pkd->npd", self.coefficients, self.basis))

    @property
    def reversed(self) -> NonRigidShape:
        """The other solution: depths of the opposite sign, with the rotations that fit them."""
        flip = np.array([1.0, 1.0, -1.0])
        return replace(self, R_camera_world=flip[:, None] * self.R_camera_world * flip, basis=self.basis * flip)

    def project(self) -> Array:
        """(n_images, n_points, 2) float64, pixels of each point in each image."""
        turned = np.einsum("nad,npd->npa", self.R_camera_world[:, :2], self.shapes)
        return np.asarray(turned + self.t[:, None])


def factorise_nonrigid(tracks: Tracks, n_basis: int, *, noise_px: float | None = None, seed: int = 0) -> NonRigidShape:
    """The deforming shape of K basis shapes with the least squared pixel error, without a prior.

    It starts from the factors of the pixels at rank 3 K; the module describes how.

    Parameters
    ----------
    tracks : which image sees which point; more than 3 K / 2 images with more than 3 K points each. A point in fewer
        than 3 K / 2 images is left out and NaN in the result.
    n_basis : number K of basis shapes, the mean shape included; 1 is a rigid shape.
    noise_px : standard deviation of a pixel's coordinate; None estimates it from the residuals.
    seed : seed of the starts.

    Raises
    ------
    ValueError
        There are too few images or points, images share no points, the tracks have fewer than K - 1 deformations, no
        two starts agree, the residuals are over three times the stated noise, or rotations or the shape stay open.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from rangesim.multiview import Tracks
    >>> random = np.random.default_rng(0)
    >>> mean, bend = random.normal(0, [[[100]], [[30]]], (2, 10, 3))  # two basis shapes of 10 points, pixels
    >>> R = Rotation.from_rotvec(np.linspace(0, 1.5, 8)[:, None] * [0.3, 1, 0.1]).as_matrix()  # 8 images
    >>> shapes = mean + random.normal(0, 1, (8, 1, 1)) * bend
    >>> tracks = Tracks.from_dense(np.einsum("nad,npd->npa", R[:, :2], shapes))
    >>> found = factorise_nonrigid(tracks, 2)
    >>> np.allclose(found.project(), tracks.dense(), atol=1e-3), found.basis.shape
    (True, (10, 2, 3))
    """
    some, points, found, noise = _factorised(tracks, n_basis, noise_px, seed, is_strict=True)
    found, noise = _left_wrong_minimum(some, found, noise, noise_px is None)
    return _judged(tracks, some, points, found, TemporalPrior(), noise, 1.0)


def adjust_nonrigid(
    tracks: Tracks,
    n_basis: int,
    *,
    prior: TemporalPrior | Literal["estimated"] = "estimated",
    noise_px: float | None = None,
    seed: int = 0,
) -> NonRigidShape:
    """The most probable deforming shape of K basis shapes, under a prior on how it changes from image to image.

    It is a bundle adjustment that starts from the result of `factorise_nonrigid`. It minimises the sum of the squared
    pixel errors, divided by the noise, and the squared errors of the prior. The prior helps where few images see a
    point: depths that the tracks hardly determine then change smoothly from image to image. Points that two or more
    images see, but too few for the factorisation, are included, too.

    Parameters
    ----------
    tracks, n_basis, noise_px, seed : see `factorise_nonrigid`.
    prior : a `TemporalPrior`, or "estimated". The estimated prior takes `shape_bend_px` from the factorisation: the
        root mean square of the second differences, over the half of the points that the tracks determine best, times
        sqrt((n_images - 2) / (K - 1)). The factor is there because K - 1 basis shapes make all n_images - 2 second
        differences of a point, so that these are not independent.

    Raises
    ------
    ValueError
        See `factorise_nonrigid`. With a stated prior, tracks of a lower rank are no error.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from rangesim.multiview import Tracks
    >>> random = np.random.default_rng(0)
    >>> mean, bend = random.normal(0, [[[100]], [[30]]], (2, 10, 3))  # two basis shapes of 10 points, pixels
    >>> angles = np.linspace(0, 1.5, 8)
    >>> R = Rotation.from_rotvec(angles[:, None] * [0.3, 1, 0.1]).as_matrix()  # 8 images
    >>> pixels = np.einsum("nad,npd->npa", R[:, :2], mean + np.sin(4 * angles)[:, None, None] * bend)
    >>> pixels += random.normal(0, 0.5, pixels.shape)
    >>> pixels[2:, 0] = np.nan  # only the first two images see point 0
    >>> found = adjust_nonrigid(Tracks.from_dense(pixels), 2)
    >>> bool(np.isfinite(found.shapes).all())
    True
    """
    is_estimated = not isinstance(prior, TemporalPrior)
    some, points, found, noise = _factorised(tracks, n_basis, noise_px, seed, is_strict=is_estimated)
    noise = max(noise, MIN_RELATIVE_NOISE * float(np.std(some.pixels)))
    if is_estimated:
        found, noise = _left_wrong_minimum(some, found, noise, noise_px is None)
        # without a determined shape, there are no second differences that give the prior
        gauge = count_unknowns(1, 1, n_basis).gauge
        _refuse_open_shape(shape_deviations(found, gauge) * noise, _principal(found.state), noise)
    used = prior if isinstance(prior, TemporalPrior) else _estimated(found)
    start = found.state
    if used.shape_bend_px is not None:
        everyone, all_points = renumbered(tracks, 2)
        basis = np.zeros((len(all_points), n_basis, 3))
        basis[np.isin(all_points, points)] = start.basis
        some, points, start = everyone, all_points, replace(start, basis=basis)
    found = orthographic.adjust(some, start, prior=used, noise_px=noise)
    return _judged(tracks, some, points, found, used, noise, noise)


def _factorised(
    tracks: Tracks, K: int, noise_px: float | None, seed: int, is_strict: bool
) -> tuple[Tracks, np.ndarray, Descended[Shapes, NormalEquations], float]:
    """The tracks of the points that the rank determines, their numbers in `tracks`, the descent, and the noise.

    is_strict : whether a rank below 3 K is an error.
    """
    check_noise(noise_px)
    count_unknowns(1, 1, K)  # the check of K
    rank = 3 * K
    purpose = f"{K} basis shapes, a factorisation of rank {rank}"
    some, points = checked_tracks(tracks, -(-rank // 2), rank + 1, 0.5 * (rank + 2), purpose)
    n, p = some.n_images, some.n_points
    freedom = 2 * len(some) - count_unknowns(n, p, K).determinable
    if len(some) == n * p:
        cameras, values = whitened(low_rank(some, rank, seed))
        if is_strict:
            left = cameras.project()[some.image, some.point] - some.pixels
            noise = noise_of(left, left.size - (n * (2 * rank + 2) + p * rank - rank * (rank + 1)), noise_px)
            why = "the shape deforms in fewer ways or is flat, or the images do not turn"
            refuse_rank(values, some, noise, 2 * n - 1, p - 1, why)
        start = _lifted(_upgraded(_virtual(cameras.M), K, seed, has_translation=False), cameras)
    else:
        start = _upgraded(some, K, seed, has_translation=True)
    found = orthographic.adjust(some, start)
    refuse_misfit(found.here.cost, freedom, noise_px, f"{K} basis shapes")
    residuals = found.state.project()[some.image, some.point] - some.pixels
    return some, points, found, noise_of(residuals, freedom, noise_px)


def _virtual(M: Array) -> Tracks:
    """The factors M (n, 2, 3 K) as tracks of 3 K virtual points. With whitened points, they have equal noise."""
    n, _, rank = M.shape
    return Tracks.from_dense(np.swapaxes(M, 1, 2).reshape(n, rank, 2))


def _upgraded(tracks: Tracks, K: int, seed: int, has_translation: bool) -> Shapes:
    """The shapes with the least squared error, from one start after another until two agree.

    The first start is the best rigid shape, with the largest deformations that explain its residuals. The other starts
    turn the images of the first one at random.
    """
    n, p = tracks.n_images, tracks.n_points
    if has_translation:
        cameras, _ = whitened(low_rank(tracks, 3, seed))
        rigid = metric_upgrade(cameras.M, cameras.t, cameras.X, has_scale=False)
    else:
        rigid = metric_upgrade(np.swapaxes(tracks.dense(), 1, 2)[:, :, :3], np.zeros((n, 2)), np.eye(p)[:, :3], False)
    rigid = orthographic.adjust(tracks, rigid, has_translation=has_translation, max_steps=START_STEPS).state
    if K == 1:
        return rigid
    random = np.random.default_rng(seed)
    floor = (ROUNDING * float(np.std(tracks.pixels))) ** 2 * len(tracks)
    best, least = rigid, np.inf
    for attempt in range(STARTS):
        R = Rotation.from_rotvec(random.normal(0, START_TURN_RAD * min(attempt, 1), (n, 3))).as_matrix() @ rigid.R
        left = np.nan_to_num(tracks.dense() - replace(rigid, R=R).project())
        modes = np.linalg.svd(np.einsum("nad,npa->npd", R[:, :2], left).reshape(n, -1), full_matrices=False)[0]
        coefficients = np.concatenate([np.ones((n, 1)), modes[:, : K - 1] * np.sqrt(n)], axis=1)
        basis = np.concatenate([rigid.basis, np.zeros((p, K - 1, 3))], axis=1)
        start = Shapes(R, rigid.t, rigid.scale, coefficients, basis)
        found = orthographic.adjust(
            tracks, start, has_translation=has_translation, max_steps=START_STEPS, converged=1e-9
        )
        cost = found.here.cost
        agrees = abs(cost - least) <= SAME_SHAPE_COST * least
        if cost < least:
            best, least = found.state, cost
        if (agrees and attempt > 1) or least <= floor:
            return best
    raise ValueError(
        f"expected tracks of {K} basis shapes, got tracks for which no two of {STARTS} starts agree: the shape deforms "
        "in fewer ways, or the images turn too little; try fewer basis shapes."
    )


def _lifted(virtual: Shapes, cameras: AffineCameras) -> Shapes:
    """The shapes of the points themselves, from those of the virtual points, of which they are linear combinations."""
    return replace(virtual, t=cameras.t, basis=np.einsum("vkd,pv->pkd", virtual.basis, cameras.X))


def _left_wrong_minimum(
    some: Tracks, found: Descended[Shapes, NormalEquations], noise: float, is_free: bool
) -> tuple[Descended[Shapes, NormalEquations], float]:
    """The factorisation, or a better one found with the help of a strong prior, and its noise.

    With missing points the sum of squares has wrong minima. A descent with a strong prior leads out of some of them,
    and a second descent without it ends at the minimum of the pixel errors.

    is_free : whether the noise is estimated from the residuals.
    """
    bend = _estimated(found, has_repeats=False).shape_bend_px
    if bend is None or not noise > 0:
        return found, noise
    led = orthographic.adjust(some, found.state, prior=TemporalPrior(shape_bend_px=bend), noise_px=noise)
    other = orthographic.adjust(some, led.state)
    if other.here.cost >= (1 - SAME_SHAPE_COST) * found.here.cost:
        return found, noise
    return other, noise * float(np.sqrt(other.here.cost / found.here.cost)) if is_free else noise


def _estimated(found: Descended[Shapes, NormalEquations], *, has_repeats: bool = True) -> TemporalPrior:
    """The prior on second differences, estimated from the half of the points that the tracks determine best.

    K - 1 basis shapes make the n - 2 second differences of a point, so that only K - 1 numbers in each direction are
    free. The sum of squares of the prior should therefore be that of K - 1 numbers of unit variance. If it were that
    of n - 2 numbers, the prior would be too strong by a factor sqrt((n - 2) / (K - 1)), and would pull the shape away
    from the tracks.

    has_repeats : whether this factor is applied.
    """
    deviation = shape_deviations(found, count_unknowns(1, 1, found.state.basis.shape[1]).gauge).max(axis=0)
    best = np.argsort(deviation)[: -(-len(deviation) // 2)]
    bends = np.diff(found.state.shapes[:, best], n=2, axis=0)
    n, K = found.state.coefficients.shape
    repeated = max((n - 2) / max(K - 1, 1), 1.0) if has_repeats else 1.0
    size = float(np.sqrt(((bends - bends.mean(axis=1, keepdims=True)) ** 2).mean() * repeated))
    return TemporalPrior(shape_bend_px=size if size > 0 else None)


def _judged(
    tracks: Tracks,
    some: Tracks,
    points: np.ndarray,
    found: Descended[Shapes, NormalEquations],
    prior: TemporalPrior,
    noise: float,
    unit: float,
) -> NonRigidShape:
    """The result in its gauge; ValueError if rotations or the shape stay open.

    some, points : the tracks of the descent, and the numbers of their points in `tracks`. unit : pixels by which the
    residuals of the descent were divided.
    """
    K = found.state.basis.shape[1]
    # a prior on bends of the shape fixes where the deformations have their middle
    gauge = 3 + 3 * (K if prior.shape_bend_px is None else 1) + K * (K - 1)
    refuse_open_rotations(found.here, gauge, noise, unit)
    deviations = shape_deviations(found, gauge) * noise / unit
    shapes = _principal(found.state)
    _refuse_open_shape(deviations, shapes, noise)
    residuals = shapes.project()[some.image, some.point] - some.pixels
    basis = np.full((tracks.n_points, K, 3), np.nan)
    basis[points] = shapes.basis
    everyone = np.full((tracks.n_images, tracks.n_points), np.nan)
    everyone[:, points] = deviations
    left = residuals_of_all(tracks, points, residuals)
    return NonRigidShape(shapes.R, shapes.t, shapes.coefficients, basis, everyone, left, noise, prior)


def _refuse_open_shape(deviations: Array, shapes: Shapes, noise: float) -> None:
    """Raise ValueError if the median deviation (n, p), pixels, is above `MAX_SHAPE_DEVIATION` of the mean shape."""
    extent = float(np.sqrt((shapes.basis[:, 0] ** 2).mean()))
    open_px = float(np.median(deviations))
    if not open_px <= MAX_SHAPE_DEVIATION * extent:
        raise ValueError(
            f"expected tracks that determine the shape, got coordinates with a standard deviation of {open_px:.3g} px "
            f"in an extent of {extent:.3g} px at a noise of {noise:.3g} px: use fewer basis shapes, more images that "
            "turn, or state how the shape moves (TemporalPrior)."
        )


def _principal(shapes: Shapes) -> Shapes:
    """The same shapes, with their mean over the images as the first basis shape, then their principal components."""
    shapes = first_upright(shapes)
    n, K = shapes.coefficients.shape
    p = len(shapes.basis)
    everything = shapes.shapes.reshape(n, -1)
    mean = everything.mean(axis=0)
    u, values, vt = np.linalg.svd(everything - mean, full_matrices=False)
    coefficients = np.concatenate([np.ones((n, 1)), u[:, : K - 1] * np.sqrt(n)], axis=1)
    modes = (values[: K - 1, None] * vt[: K - 1] / np.sqrt(n)).reshape(K - 1, p, 3)
    basis = np.concatenate([mean.reshape(1, p, 3), modes]).transpose(1, 0, 2)
    return replace(shapes, coefficients=coefficients, basis=basis)
