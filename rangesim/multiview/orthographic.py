# SPDX-License-Identifier: Apache-2.0
"""Images without perspective of a shape, rigid or not: the sum of squares of factorisation and of non-rigid shape.

    x_ij = s_i P R_i (B_0j + sum_k c_ik B_kj) + t_i,    P = [1 0 0; 0 1 0]

with a rotation R_i, a translation t_i in pixels, perhaps a scale s_i (weak perspective; s_i = 1 is orthographic), and
K - 1 coefficients c_i for each image, and K basis shapes B_k for each point: K = 1 is a rigid body. The model is linear
in the points, so each step of the images is followed by the points that are best for them (variable projection: Golub,
Pereyra 1973; Okatani, Yoshida, Deguchi: "Efficient algorithm for low-rank matrix factorization with missing
components", ICCV 2011, for how much wider it converges).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.geometry.correspondences import Array
from rangesim.geometry.least_squares import Descended, descend
from rangesim.multiview.schur_complement import NormalEquations, Prior, Sizes, Step, Term
from rangesim.multiview.tracks import Tracks

MIN_DAMPING = 1e-12


@dataclass(frozen=True, eq=False)
class Shapes:
    """R : (n, 3, 3). t : (n, 2). scale : (n,). coefficients : (n, K), the first of which is 1. basis : (p, K, 3)."""

    R: Array
    t: Array
    scale: Array
    coefficients: Array
    basis: Array

    @property
    def shapes(self) -> Array:
        """(n, p, 3) the shape in each image, in coordinates of the world."""
        return np.einsum("nk,pkd->npd", self.coefficients, self.basis)

    def project(self) -> Array:
        """(n, p, 2) pixels."""
        turned = np.einsum("nad,npd->npa", self.R[:, :2], self.shapes)
        return np.asarray(self.scale[:, None, None] * turned + self.t[:, None])


@dataclass(frozen=True)
class TemporalPrior:
    """How smoothly a shape deforms and a camera turns, as standard deviations of a Gaussian prior; None: as it likes.

    shape_bend_px : of a coordinate of S_i-1 - 2 S_i + S_i+1, S_i a point of the shape in image i, in the world, pixels:
    how far, twice, it may lie off the middle between before and after. turn_step_rad : of the rotation vector between
    consecutive images. The prior is on the shape, the sum over points of |sum_k (c_i-1,k - 2 c_ik + c_i+1,k) B_kj|^2,
    and not on the coefficients, whose units the gauge leaves open: a prior on these alone would be met by making them
    small and the basis large. It is on bends and not on steps, since a deformation that goes on for some images has
    large steps, and a prior that takes them for chance makes it smaller.
    """

    shape_bend_px: float | None = None
    turn_step_rad: float | None = None

    def __post_init__(self) -> None:
        for name in ("shape_bend_px", "turn_step_rad"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ValueError(f"expected {name} to be positive, or None for no prior, got {value!r}.")


NO_PRIOR = TemporalPrior()


def adjust(
    tracks: Tracks,
    start: Shapes,
    *,
    has_scale: bool = False,
    has_translation: bool = True,
    prior: TemporalPrior = NO_PRIOR,
    noise_px: float = 1.0,
    max_steps: int = 300,
    converged: float = 1e-12,
) -> Descended[Shapes, NormalEquations]:
    """The shapes of least squared error, over the noise, plus those of the prior, from a start downwards.

    has_scale, has_translation : whether scales and translations are free; else they stay.
    """
    n, p, K = *start.coefficients.shape[:1], len(start.basis), start.coefficients.shape[1]
    sizes = Sizes(0, n, 5 + int(has_scale) + K - 1, p, 3 * K)

    def look(shapes: Shapes) -> NormalEquations:
        return _look(shapes, tracks, sizes, has_scale, has_translation, prior, noise_px)

    def move(shapes: Shapes, step: Step) -> Shapes:
        return settled(_moved(shapes, step, has_scale))

    def settled(shapes: Shapes) -> Shapes:
        return replace(shapes, basis=shapes.basis + look(shapes).step_of_points().reshape(shapes.basis.shape))

    return descend(look, move, settled(start), max_steps=max_steps, converged=converged, least_damping=MIN_DAMPING)


def _moved(shapes: Shapes, step: Step, has_scale: bool) -> Shapes:
    images, K = step.images, shapes.coefficients.shape[1]
    coefficients = shapes.coefficients.copy()
    coefficients[:, 1:] += images[:, 5 : 5 + K - 1]
    return Shapes(
        Rotation.from_rotvec(images[:, :3]).as_matrix() @ shapes.R,
        shapes.t + images[:, 3:5],
        shapes.scale * np.exp(np.clip(images[:, -1], -2, 2)) if has_scale else shapes.scale,
        coefficients,
        shapes.basis,
    )


def _look(
    shapes: Shapes,
    tracks: Tracks,
    sizes: Sizes,
    has_scale: bool,
    has_translation: bool,
    prior: TemporalPrior,
    noise_px: float,
) -> NormalEquations:
    image, point = tracks.image, tracks.point
    m, K = len(tracks), shapes.coefficients.shape[1]
    scale, R, c = shapes.scale[image], shapes.R[image], shapes.coefficients[image]
    basis = shapes.basis[point]
    # the basis shapes as the camera sees them, (m, K, 3), and their sum
    seen = scale[:, None, None] * (basis @ np.swapaxes(R, 1, 2))
    y = (c[:, None, :] @ seen)[:, 0]
    values = y[:, :2] + shapes.t[image] - tracks.pixels
    by_images = np.zeros((m, 2, 1, sizes.per_image))
    by_images[:, 0, 0, 1], by_images[:, 0, 0, 2] = y[:, 2], -y[:, 1]
    by_images[:, 1, 0, 0], by_images[:, 1, 0, 2] = -y[:, 2], y[:, 0]
    by_images[:, 0, 0, 3] = by_images[:, 1, 0, 4] = float(has_translation)
    by_images[:, :, 0, 5 : 4 + K] = np.swapaxes(seen[:, 1:, :2], 1, 2)
    if has_scale:
        by_images[:, :, 0, -1] = y[:, :2]
    by_point = c[:, None, :, None] * (scale[:, None, None] * R[:, :2])[:, :, None, :]
    none = np.empty((m, 2, 0))
    terms = [Term(values / noise_px, point, image[:, None], by_images / noise_px, _flat(by_point) / noise_px, none)]
    if prior.shape_bend_px is not None:
        terms.append(_shape_bends(shapes, sizes, prior.shape_bend_px))
    of_images = None if prior.turn_step_rad is None else _turn_steps(shapes, sizes, prior.turn_step_rad)
    cost = sum(float((term.values**2).sum()) for term in terms)
    if of_images is not None:
        cost += float((of_images.values**2).sum())
    return NormalEquations(cost, sizes, terms, of_images)


def _flat(by_point: Array) -> Array:
    return np.ascontiguousarray(by_point.reshape(*by_point.shape[:2], -1))


def _shape_bends(shapes: Shapes, sizes: Sizes, deviation: float) -> Term:
    """Residuals (p (n - 2), 3) of each point of the shape, second differences over the images."""
    n, K = shapes.coefficients.shape
    p = len(shapes.basis)
    point, middle = (a.ravel() for a in np.meshgrid(np.arange(p), np.arange(1, n - 1), indexing="ij"))
    images = middle[:, None] + np.arange(-1, 2)
    weights = np.array([1.0, -2.0, 1.0])
    change = np.einsum("mek,e->mk", shapes.coefficients[images], weights)
    basis = shapes.basis[point]
    by_images = np.zeros((len(point), 3, 3, sizes.per_image))
    by_images[..., 5 : 4 + K] = np.swapaxes(basis[:, 1:], 1, 2)[:, :, None] * weights[:, None]
    by_point = change[:, None, :, None] * np.eye(3)[:, None, :]
    values = np.einsum("mk,mkd->md", change, basis)
    none = np.empty((len(point), 3, 0))
    return Term(values / deviation, point, images, by_images / deviation, _flat(by_point) / deviation, none)


def _turn_steps(shapes: Shapes, sizes: Sizes, deviation: float) -> Prior:
    """Residuals (3 (n - 1),) of the rotation between consecutive images, as rotation vectors."""
    n, c = sizes.images, sizes.per_image
    between = shapes.R[1:] @ np.swapaxes(shapes.R[:-1], 1, 2)
    vectors = Rotation.from_matrix(between).as_rotvec()
    by_step = np.zeros((n - 1, 3, n * c))
    for k, (v, Q) in enumerate(zip(vectors, between, strict=True)):
        inverse = _inverse_left_jacobian(v)
        by_step[k, :, (k + 1) * c : (k + 1) * c + 3] = inverse
        by_step[k, :, k * c : k * c + 3] = -inverse @ Q
    return Prior(vectors.ravel() / deviation, by_step.reshape(-1, n * c) / deviation)


def _inverse_left_jacobian(v: Array) -> Array:
    """(3, 3) J with log(exp(w) exp(v)) = v + J w to first order."""
    angle = float(np.linalg.norm(v))
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    square = 1 / 12 if angle < 1e-4 else 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    return np.asarray(np.eye(3) - cross / 2 + square * cross @ cross)
