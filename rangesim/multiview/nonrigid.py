# SPDX-License-Identifier: Apache-2.0
"""Structure from motion of a shape that deforms: K basis shapes, mixed anew in each image.

    x_ij = P R_i (B_0j + sum_k c_ik B_kj) + t_i,    k = 1 ... K - 1,    P = [1 0 0; 0 1 0]

The pixels of all images, less t, have rank 3 K (Bregler, Hertzmann, Biermann: "Recovering non-rigid 3D shape from image
streams", CVPR 2000): `factorise_nonrigid` decomposes them at that rank and looks for the rotations and coefficients
among the factors. `adjust_nonrigid` is bundle adjustment of the same model, with priors on what changes from an image
to the next (Del Bue, Smeraldi, Agapito: "Non-rigid structure from motion using ranklet-based tracking and non-linear
optimization", IVC 2007; Torresani, Hertzmann, Bregler: "Nonrigid structure-from-motion: estimating shape and motion
with hierarchical priors", PAMI 2008).

Which upgrade is well posed. The decomposition leaves a matrix G of 3 K x 3 K open, M_i G = [R_i, c_i1 R_i, ...].
Linear constraints of orthonormality alone leave a space of dimension 2 K^2 - K (Xiao, Chai, Kanade 2004; Akhter,
Sheikh, Khan, Kanade 2009). Methods that look for one triple of columns of G at a time (Dai, Li, He 2012) have 2 n
equations for a triple of 9 K entries that is determined up to K + 3: of 10 images and K = 4, 20 equations for 29, too
few. All of G at once has 6 K n equations for n (K + 2) rotations and coefficients and 9 K^2 entries, less 3 + K (K - 1)
of gauge: 240 for 189. So G, R_i and c_i are found at once, as a non-rigid shape of 3 K virtual points, the columns of
the decomposition, in some milliseconds from each of several starts, the first of them the best rigid shape. Where
observations are missing, the decomposition at rank 3 K has wrong minima (of 10 images, more often than not), and the
same is done with the points themselves, from a rigid factorisation. The answer is the one that two starts agree on, and
that no other start beats.

Degenerate: fewer images than the rank takes; fewer basis shapes in the tracks than asked for; no turning. A rigid
motion of the whole shape and a deformation that looks the same cannot be told apart: a shape whose deformation turns
it as a whole has no answer but the one of the model.
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

STARTS, START_STEPS = 20, 120
"""Starts of the upgrade before it is given up, and steps of each."""
TURN = 0.3
"""Radians by which starts turn the images of the first."""
SAME_COST = 1e-4
"""Relative difference of the sums of squares of starts that agree."""
MAX_SHAPE_DEVIATION = 0.5
"""Of the shape's extent; a shape whose median coordinate is known worse is none."""
LEAST_NOISE = 1e-4
"""Of the extent of the tracks, beside a prior: less is numerically none."""


class UnknownCount(NamedTuple):
    """Equations and unknowns of a non-rigid shape of n images, p points and K basis shapes.

    equations : 2 n p, two for each point in each image. rotations : 3 n. translations : 2 n. scales : n under weak
    perspective, else 0. coefficients : (K - 1) n, for the mean shape's is 1. shapes : 3 K p. gauge : how many of the
    unknowns change nothing that is seen: 3 (a rotation of the world), 3 K (a translation of each basis shape, made up
    for by those of the images), K (K - 1) (an affinity of the coefficients: other deformations that span the same, and
    another mean), and K under weak perspective, where scales and coefficients together are known up to any linear map.
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
        """As parameterised: rotations, translations, scales, coefficients and shapes."""
        return self.rotations + self.translations + self.scales + self.coefficients + self.shapes

    @property
    def determinable(self) -> int:
        """Unknowns less the gauge: the rank that the equations have where the motion is general."""
        return self.unknowns - self.gauge

    @property
    def redundancy(self) -> int:
        """Equations less what they determine."""
        return self.equations - self.determinable


def count_unknowns(n_images: int, n_points: int, n_basis: int, *, has_scale: bool = False) -> UnknownCount:
    """Equations and unknowns of `n_basis` = K basis shapes: 50 points in 10 images at K = 4 are 1000 equations and 30 +
    20 + 30 + 600 = 680 unknowns, of which the gauge removes 3 + 12 + 12 = 27."""
    for name, value in (("n_images", n_images), ("n_points", n_points), ("n_basis", n_basis)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"expected {name} as a number from 1 on, got {shown(value)}.")
    n, p, K = int(n_images), int(n_points), int(n_basis)
    gauge = 3 + 3 * K + K * (K - 1) + K * int(has_scale)
    return UnknownCount(2 * n * p, 3 * n, 2 * n, n * int(has_scale), (K - 1) * n, 3 * K * p, gauge)


@dataclass(frozen=True, eq=False)
class NonRigidShape:
    """A deforming shape and its cameras, in the frame of the first, up to a reversal.

    R_camera_world : (n_images, 3, 3), the first the identity. t : (n_images, 2) pixels. coefficients : (n_images, K),
    the first 1, the others uncorrelated, of zero mean and unit variance over the images. basis : (n_points, K, 3), the
    mean shape, its mean at 0, and the principal deformations, largest first, pixels; NaN of points seen in too few
    images. shapes : (n_images, n_points, 3) what they make in each image. shape_deviation_px : (n_images, n_points)
    standard deviation of a coordinate of the shape as its camera sees it, root mean square over the three; look at it
    before you trust a point that few images see. residuals_px : (m, 2) predicted less seen; NaN of what was left out.
    noise_px : standard deviation of a pixel's coordinate. prior : that was used.

    As a rigid shape without perspective, it has a mirror image that looks the same: `reversed`.
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
        """(n_images, n_points, 3) pixels, in the frame of the first camera."""
        return np.asarray(np.einsum("nk,pkd->npd", self.coefficients, self.basis))

    @property
    def reversed(self) -> NonRigidShape:
        """The other answer: depths of the opposite sign, and rotations to match."""
        flip = np.array([1.0, 1.0, -1.0])
        return replace(self, R_camera_world=flip[:, None] * self.R_camera_world * flip, basis=self.basis * flip)

    def project(self) -> Array:
        """(n_images, n_points, 2) pixels."""
        turned = np.einsum("nad,npd->npa", self.R_camera_world[:, :2], self.shapes)
        return np.asarray(turned + self.t[:, None])


def factorise_nonrigid(tracks: Tracks, n_basis: int, *, noise_px: float | None = None, seed: int = 0) -> NonRigidShape:
    """The shape of K basis shapes, from the factors of rank 3 K, then of least squared pixel error, without priors.

    Parameters
    ----------
    tracks : of more than 3 K / 2 images; each with more than 3 K points; points in fewer images than 3 K / 2 are NaN.
    n_basis : K, the mean shape included; 1 is a rigid one.
    noise_px : standard deviation of a coordinate; None: from the residuals.
    seed : of the starts.

    Raises
    ------
    ValueError
        Too few images or points; images that share no points; fewer deformations than K - 1 in the tracks; no start
        ends at the noise; residuals over three times the stated noise; or rotations that stay open.
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
    """The most probable shape of K basis shapes: squared pixel errors over the noise, plus those of a temporal prior.

    Bundle adjustment from the answer of `factorise_nonrigid`. The prior holds what few images see: depths that the
    tracks leave nearly open move as smoothly from image to image as it says, and points in too few images for the
    factorisation, but two or more, come in with it.

    Parameters
    ----------
    tracks, n_basis, noise_px, seed : as `factorise_nonrigid`.
    prior : "estimated" takes the bend of the shape from the tracks: the mean square, in the factorisation, of the half
        of the points that the tracks determine best, times (n_images - 2) / (K - 1), for so many bends of a point are
        made of each basis shape.

    Raises
    ------
    ValueError
        As `factorise_nonrigid`; of a stated prior, tracks of a lower rank are none.
    """
    is_estimated = not isinstance(prior, TemporalPrior)
    some, points, found, noise = _factorised(tracks, n_basis, noise_px, seed, is_strict=is_estimated)
    noise = max(noise, LEAST_NOISE * float(np.std(some.pixels)))
    if is_estimated:
        found, noise = _left_wrong_minimum(some, found, noise, noise_px is None)
        # of a shape that is open, there is nothing to estimate
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
    """The tracks of the points that the rank determines, their numbers, the shapes, and the noise."""
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
            refuse_rank(values, some, noise, 2 * n - 1, p - 1, "it deforms less, is flat, or the images do not turn")
        start = _lifted(_upgraded(_virtual(cameras.M), K, seed, has_translation=False), cameras)
    else:
        start = _upgraded(some, K, seed, has_translation=True)
    found = orthographic.adjust(some, start)
    refuse_misfit(found.here.cost, freedom, noise_px, f"{K} basis shapes")
    residuals = found.state.project()[some.image, some.point] - some.pixels
    return some, points, found, noise_of(residuals, freedom, noise_px)


def _virtual(M: Array) -> Tracks:
    """The factors M (n, 2, 3 K) as tracks of 3 K points; of unit covariance, those of noisy tracks have equal noise."""
    n, _, rank = M.shape
    return Tracks.from_dense(np.swapaxes(M, 1, 2).reshape(n, rank, 2))


def _upgraded(tracks: Tracks, K: int, seed: int, has_translation: bool) -> Shapes:
    """The shapes of least squared error, from one start after another until two agree.

    The first start is the best rigid shape, with the largest deformations that explain what it leaves; the others turn
    its images at random.
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
        R = Rotation.from_rotvec(random.normal(0, TURN * min(attempt, 1), (n, 3))).as_matrix() @ rigid.R
        left = np.nan_to_num(tracks.dense() - replace(rigid, R=R).project())
        modes = np.linalg.svd(np.einsum("nad,npa->npd", R[:, :2], left).reshape(n, -1), full_matrices=False)[0]
        coefficients = np.concatenate([np.ones((n, 1)), modes[:, : K - 1] * np.sqrt(n)], axis=1)
        basis = np.concatenate([rigid.basis, np.zeros((p, K - 1, 3))], axis=1)
        start = Shapes(R, rigid.t, rigid.scale, coefficients, basis)
        found = orthographic.adjust(
            tracks, start, has_translation=has_translation, max_steps=START_STEPS, converged=1e-9
        )
        cost = found.here.cost
        agrees = abs(cost - least) <= SAME_COST * least
        if cost < least:
            best, least = found.state, cost
        if (agrees and attempt > 1) or least <= floor:
            return best
    raise ValueError(
        f"expected tracks of {K} basis shapes, got some for which no two of {STARTS} starts agree: the shape deforms "
        "in fewer ways, or the images turn too little; try fewer basis shapes."
    )


def _lifted(virtual: Shapes, cameras: AffineCameras) -> Shapes:
    """The shapes of the points themselves, which are combinations of the virtual ones, with their translations."""
    return replace(virtual, t=cameras.t, basis=np.einsum("vkd,pv->pkd", virtual.basis, cameras.X))


def _left_wrong_minimum(
    some: Tracks, found: Descended[Shapes, NormalEquations], noise: float, is_free: bool
) -> tuple[Descended[Shapes, NormalEquations], float]:
    """The factorisation, or the better one that lies behind a prior that is too sure, and the noise there.

    With missing points the sum of squares has wrong minima. A strong prior leads out of some; then it is let go.
    """
    bend = _estimated(found, has_repeats=False).shape_bend_px
    if bend is None or not noise > 0:
        return found, noise
    led = orthographic.adjust(some, found.state, prior=TemporalPrior(shape_bend_px=bend), noise_px=noise)
    other = orthographic.adjust(some, led.state)
    if other.here.cost >= (1 - SAME_COST) * found.here.cost:
        return found, noise
    return other, noise * float(np.sqrt(other.here.cost / found.here.cost)) if is_free else noise


def _estimated(found: Descended[Shapes, NormalEquations], *, has_repeats: bool = True) -> TemporalPrior:
    """The prior that the best determined half of the points suggests.

    A point's n - 2 bends are made of K - 1 basis shapes: as many numbers in each direction are unknown, and the others
    follow. The sum of squares of the prior is to be that of K - 1 numbers of unit variance, and not of n - 2, else it
    is too sure by the root of (n - 2) / (K - 1), and pulls the shape off what the tracks say.
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
    """The result, in its gauge; unit : pixels by which residuals were divided."""
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
    extent = float(np.sqrt((shapes.basis[:, 0] ** 2).mean()))
    open_px = float(np.median(deviations))
    if not open_px <= MAX_SHAPE_DEVIATION * extent:
        raise ValueError(
            f"expected tracks that determine the shape, got some that leave its coordinates open by {open_px:.3g} px "
            f"of an extent of {extent:.3g} at a noise of {noise:.3g} px: use fewer basis shapes, more images that "
            "turn, or state how the shape moves (TemporalPrior)."
        )


def _principal(shapes: Shapes) -> Shapes:
    """The same shapes with the mean over the images as the first, and their principal components as deformations."""
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
