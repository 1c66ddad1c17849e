# SPDX-License-Identifier: Apache-2.0
"""Least squares for images, without perspective, of a rigid or a deforming shape.

    x_ij = s_i P R_i (B_0j + sum_k c_ik B_kj) + t_i,    P = [1 0 0; 0 1 0]

Each image i has a rotation R_i, a translation t_i in pixels, K - 1 coefficients c_i and, under weak perspective, a
scale s_i; s_i = 1 is orthographic. Each point j has K basis shapes B_kj, and K = 1 is a rigid body. The model is linear
in the points. So after each step of the images, the points are set to those that fit best (variable projection: Golub,
Pereyra 1973). The descent then converges from farther away (Okatani, Yoshida, Deguchi: "Efficient algorithm for
low-rank matrix factorization with missing components", ICCV 2011).

Used by: `factorisation` and `nonrigid` of `rangesim.multiview`; no other module of rangesim.
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
"""Smallest damping of Levenberg-Marquardt over the diagonal of the normal equations, a ratio. It must not be 0, because
the gauge changes no residual and would leave the equations singular."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """The cameras of n images and the K basis shapes of p points, float64.

    R : (n, 3, 3), rotates world coordinates to those of each camera. t : (n, 2), pixels. scale : (n,), a ratio.
    coefficients : (n, K), the first of which is 1. basis : (p, K, 3), world, pixels.
    """

    R: Array
    t: Array
    scale: Array
    coefficients: Array
    basis: Array

    @property
    def shapes(self) -> Array:
        """(n, p, 3) float64, the shape in each image, world, pixels."""
        return np.einsum("nk,pkd->npd", self.coefficients, self.basis)

    def project(self) -> Array:
        """(n, p, 2) float64, pixels of each point in each image."""
        turned = np.einsum("nad,npd->npa", self.R[:, :2], self.shapes)
        return np.asarray(self.scale[:, None, None] * turned + self.t[:, None])


@dataclass(frozen=True)
class TemporalPrior:
    """A Gaussian prior on how smoothly a shape deforms and a camera turns from image to image.

    shape_bend_px : standard deviation of a coordinate of the second difference S_i-1 - 2 S_i + S_i+1, pixels, where S_i
        is a point of the shape in image i. The second difference is twice the distance of S_i from the middle of S_i-1
        and S_i+1. None leaves the shape free.
    turn_step_rad : standard deviation of a component of the rotation vector between consecutive images, radians. None
        leaves the cameras free.

    The prior acts on the shape, by the sum over points of |sum_k (c_i-1,k - 2 c_ik + c_i+1,k) B_kj|^2. A prior on the
    coefficients alone would have no effect, because their unit is free: small coefficients with a large basis make the
    same shape. The prior acts on second differences and not on first ones. A deformation that continues for some images
    has large first differences, and a prior on these would make it smaller.

    Raises
    ------
    ValueError
        A standard deviation is not positive.

    Examples
    --------
    >>> TemporalPrior(shape_bend_px=2.0)
    TemporalPrior(shape_bend_px=2.0, turn_step_rad=None)
    """

    shape_bend_px: float | None = None
    turn_step_rad: float | None = None

    def __post_init__(self) -> None:
        for name in ("shape_bend_px", "turn_step_rad"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ValueError(f"expected {name} to be positive, or None for no prior, got {value!r}.")


NO_PRIOR = TemporalPrior()
"""The prior that leaves shape and cameras free."""


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
    """The descent from a start to the shapes with the least squared errors of the pixels and of the prior.

    Each error is divided by its standard deviation: an error of a pixel by `noise_px`, an error of the prior by the
    prior's own.

    has_scale, has_translation : whether the scales and the translations of the images are free.
    max_steps, converged : see `rangesim.geometry.least_squares.descend`.
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
    """The shapes with the cameras and coefficients moved by a step, and the basis as it was."""
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
    """The normal equations of the squared errors of the pixels and of the prior."""
    image, point = tracks.image, tracks.point
    m, K = len(tracks), shapes.coefficients.shape[1]
    scale, R, c = shapes.scale[image], shapes.R[image], shapes.coefficients[image]
    basis = shapes.basis[point]
    # the basis shapes in coordinates of the camera (m, K, 3), and the sum of them that makes the shape (m, 3)
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
    """(m, d, K 3), from derivatives (m, d, K, 3) by the basis shapes of a point."""
    return np.ascontiguousarray(by_point.reshape(*by_point.shape[:2], -1))


def _shape_bends(shapes: Shapes, sizes: Sizes, deviation: float) -> Term:
    """The term of the prior on the shape, with residuals (p (n - 2), 3).

    They are the second differences of each point over the images.
    """
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
    """The prior on the cameras: rotation vectors between consecutive images, residuals (3 (n - 1),)."""
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
    """(3, 3) float64, J with log(exp(w) exp(v)) = v + J w to first order in w, for a rotation vector v."""
    angle = float(np.linalg.norm(v))
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    square = 1 / 12 if angle < 1e-4 else 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    return np.asarray(np.eye(3) - cross / 2 + square * cross @ cross)
