# SPDX-License-Identifier: Apache-2.0
"""Sparse normal equations of sums of squares over images and points, solved by the Schur complement on the points.

The residual of an observation depends on the parameters of its image, on those of its point, and perhaps on shared
parameters, such as a lens. The normal equations are then

    [ U    W ] [ images ]     [ g_images ]
    [ W^T  V ] [ points ] = - [ g_points ]      V block diagonal, a small block for each point.

The elimination of the points leaves S = U - W V^-1 W^T, which has rows for the shared and the image parameters only
(Brown 1958; Triggs, McLauchlan, Hartley, Fitzgibbon: "Bundle adjustment - a modern synthesis", 2000, section 6.1). W is
never stored. With V = L L^T, S = U - Y^T Y, where Y = L^-1 W^T is computed for some hundred points at a time, over the
images that see them.

S is dense and has (images x parameters per image)^2 numbers, 0.3 GB for 1000 cameras.

Used by: `bundle_adjustment`, `multi_view_triangulation`, `factorisation`, `orthographic` and `nonrigid` of
`rangesim.multiview`; no other module of rangesim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pcgraph.parallel import in_blocks, kernel
from rangesim.geometry.correspondences import Array

CHUNK_BYTES = 16e6
"""Largest size of Y at a time, bytes. Measured with 60 views of 3000 points: 1e6 to 1e8 take the same time, 1e5 takes
2.5 times as long. More bytes need more memory."""


class Step(NamedTuple):
    """A step of all parameters, float64.

    shared : (s,), of the shared parameters. images : (n_images, c), of each image. points : (n_points, p), of each
    point.
    """

    shared: Array
    images: Array
    points: Array


class Term(NamedTuple):
    """Residuals of one kind, and their derivatives with respect to a step.

    values : (m, d) float64, m residual vectors of d components.
    point : (m,) int64, the point of each residual vector, ascending.
    images : (m, e) int64, the e images that each residual vector depends on.
    by_images : (m, d, e, c) float64, derivatives by the parameters of these images.
    by_point : (m, d, p) float64, derivatives by the parameters of the point.
    by_shared : (m, d, s) float64, derivatives by the shared parameters.
    """

    values: Array
    point: np.ndarray
    images: np.ndarray
    by_images: Array
    by_point: Array
    by_shared: Array


class Prior(NamedTuple):
    """Residuals that depend on the shared and the image parameters, but on no point.

    values : (q,) float64. by_step : (q, s + n_images c) float64, derivatives by the shared parameters, then by those of
    each image.
    """

    values: Array
    by_step: Array


@dataclass(frozen=True)
class Sizes:
    """The numbers of parameters.

    shared : number s of shared parameters. images : number of images. per_image : number c of parameters of an image.
    points : number of points. per_point : number p of parameters of a point.
    """

    shared: int
    images: int
    per_image: int
    points: int
    per_point: int

    @property
    def reduced(self) -> int:
        """Number of rows of S, one for each parameter left: the shared ones first, then those of each image."""
        return self.shared + self.images * self.per_image


class NormalEquations:
    """The sum of squares near a state, in the form that `least_squares.descend` takes.

    The matrices are computed when they are first needed. A parameter on which no residual depends, such as the pose of
    a held image, gets a step of 0.

    Parameters
    ----------
    cost : the sum of squares, or the sum of the robust loss that the weighted `terms` represent.
    sizes : the numbers of parameters.
    terms : residuals and derivatives, already weighted.
    prior : residuals on the shared and the image parameters alone; None for none.
    """

    def __init__(self, cost: float, sizes: Sizes, terms: Sequence[Term], prior: Prior | None = None) -> None:
        self.cost, self.sizes, self.terms, self.prior = cost, sizes, terms, prior

    @cached_property
    def _starts(self) -> list[np.ndarray]:
        """Index of the first residual of each point, and the number of all: (n_points + 1,) int64 for each term."""
        numbers = np.arange(self.sizes.points + 1)
        return [np.searchsorted(term.point, numbers) for term in self.terms]

    @cached_property
    def _point_equations(self) -> tuple[Array, Array]:
        """V (n_points, p, p) and g (n_points, p) of the points."""
        sizes = self.sizes
        V, h = np.zeros((sizes.points, sizes.per_point, sizes.per_point)), np.zeros((sizes.points, sizes.per_point))
        for term, starts in zip(self.terms, self._starts, strict=True):
            in_blocks(_add_points, sizes.points, starts, term.values, term.by_point, V, h, smallest=256)
        return V, h

    @cached_property
    def _image_equations(self) -> tuple[Array, Array]:
        """U (k, k) and g (k,) of the shared and the image parameters, k = `Sizes.reduced`."""
        sizes = self.sizes
        U, g = np.zeros((sizes.reduced, sizes.reduced)), np.zeros(sizes.reduced)
        for term in self.terms:
            _add_images(term.values, term.images, term.by_images, term.by_shared, U, g)
        if self.prior is not None:
            U += self.prior.by_step.T @ self.prior.by_step
            g += self.prior.by_step.T @ self.prior.values
        return U, g

    def reduced(self, damping: float) -> tuple[Array, Array, Array, Array, list[Array]] | None:
        """S, its right side, L^-1 and L^-1 g of the points, and by_point L^-T of each term; None if V is singular.

        damping : relative increase of the diagonals of U and V.
        """
        (U, g), (V, h) = self._image_equations, self._point_equations
        sizes = self.sizes
        block = np.arange(sizes.per_point)
        V = V.copy()
        diagonal = V[:, block, block]
        V[:, block, block] = np.where(diagonal > 0, diagonal * (1 + damping), 1.0)
        try:
            inverse = np.linalg.inv(np.linalg.cholesky(V))
        except np.linalg.LinAlgError:
            return None
        S = U.copy()
        scale = np.diag(U)
        S[np.diag_indices_from(S)] = np.where(scale > 0, scale * (1 + damping), 1.0)
        right, scaled_h = -g, (inverse @ h[:, :, None])[:, :, 0]
        by_points = []
        for term in self.terms:
            by_point = np.empty_like(term.by_point)
            in_blocks(_scaled, len(term.point), term.point, term.by_point, inverse, by_point)
            by_points.append(by_point)
        self._eliminate(by_points, scaled_h, S, right)
        return S, right, inverse, scaled_h, by_points

    def _eliminate(self, by_points: list[Array], scaled_h: Array, S: Array, right: Array) -> None:
        """Compute S -= Y^T Y and right += Y^T L^-1 g in place, for some points at a time."""
        sizes = self.sizes
        at_once = int(max(1, CHUNK_BYTES / (8 * sizes.per_point * max(sizes.reduced, 1))))
        for first in range(0, sizes.points, at_once):
            last = min(first + at_once, sizes.points)
            involved = np.zeros(sizes.images, dtype=bool)
            for term, starts in zip(self.terms, self._starts, strict=True):
                involved[term.images[starts[first] : starts[last]]] = True
            if not involved.any():
                continue  # no residual depends on these points
            images = np.flatnonzero(involved)
            place = np.full(sizes.images, -1)
            place[images] = np.arange(len(images))
            Y = np.zeros((last - first, sizes.per_point, sizes.shared + len(images) * sizes.per_image))
            for term, starts, by_point in zip(self.terms, self._starts, by_points, strict=True):
                in_blocks(
                    _fill,
                    last - first,
                    first,
                    starts,
                    place,
                    term.images,
                    term.by_images,
                    term.by_shared,
                    by_point,
                    Y,
                    smallest=16,
                )
            flat = Y.reshape(-1, Y.shape[2])
            columns = np.concatenate(
                [
                    np.arange(sizes.shared),
                    (sizes.shared + images[:, None] * sizes.per_image + np.arange(sizes.per_image)).ravel(),
                ]
            )
            if len(columns) == sizes.reduced:
                S -= flat.T @ flat
            else:
                S[np.ix_(columns, columns)] -= flat.T @ flat
            right[columns] += flat.T @ scaled_h[first:last].ravel()

    def damped_step(self, damping: float) -> tuple[Step, float] | None:
        """The damped step and the decrease of the cost that it predicts; see `least_squares.Descent`."""
        found = self.reduced(damping)
        if found is None:
            return None
        S, right, inverse, scaled_h, by_points = found
        try:
            of_images = cho_solve(cho_factor(S, lower=True, check_finite=False), right, check_finite=False)
        except np.linalg.LinAlgError:
            return None
        sizes = self.sizes
        shared, images = of_images[: sizes.shared], of_images[sizes.shared :].reshape(sizes.images, sizes.per_image)
        for term, starts, by_point in zip(self.terms, self._starts, by_points, strict=True):
            arrays = term.images, term.by_images, term.by_shared, by_point, shared, images, scaled_h
            in_blocks(_back_substitute, sizes.points, starts, *arrays, smallest=256)
        points = -(np.swapaxes(inverse, 1, 2) @ scaled_h[:, :, None])[:, :, 0]
        (U, g), (V, h) = self._image_equations, self._point_equations
        block = np.arange(sizes.per_point)
        slope = float(of_images @ g + (points * h).sum())
        damped = float((of_images**2 * np.diag(U)).sum() + (points**2 * V[:, block, block]).sum())
        return Step(shared, images, points), -slope + damping * damped

    def step_of_points(self) -> Array:
        """(n_points, p) float64, the step of the points with all other parameters held.

        It ends at the minimum if the residuals are linear in the points. A point that its residuals do not determine
        takes the shortest such step.
        """
        V, h = self._point_equations
        return -(np.linalg.pinv(V, rcond=1e-12, hermitian=True) @ h[:, :, None])[:, :, 0]

    def response_of_points(self) -> Array:
        """(n_points, p, k) float64, -V^-1 W^T: how the best-fitting points move with the k shared and image
        parameters."""
        sizes = self.sizes
        found = self.reduced(1e-13)
        if found is None:
            return np.full((sizes.points, sizes.per_point, sizes.reduced), np.inf)
        _, _, inverse, _, by_points = found
        Y = np.zeros((sizes.points, sizes.per_point, sizes.reduced))
        for term, starts, by_point in zip(self.terms, self._starts, by_points, strict=True):
            place = np.arange(sizes.images)
            _fill(0, sizes.points, 0, starts, place, term.images, term.by_images, term.by_shared, by_point, Y)
        return np.asarray(-np.swapaxes(inverse, 1, 2) @ Y)

    def covariance_of_points(self) -> Array:
        """(n_points, p, p) float64, V^-1: covariance of each point if all other parameters are exact.

        It is for residuals of unit variance, and infinite for a point that its residuals do not determine.
        """
        V, _ = self._point_equations
        values, axes = np.linalg.eigh(V)
        sound = values[:, 0] > 1e-13 * values[:, -1]
        half = axes / np.sqrt(np.where(sound[:, None], values, 1.0))[:, None, :]
        result = half @ np.swapaxes(half, 1, 2)
        result[~sound] = np.inf
        return np.asarray(result)

    def free_covariance(self, gauge: int) -> Array:
        """(k, k) float64, the covariance of the shared and image parameters in the gauge with the smallest trace.

        S is scaled to a unit diagonal, and its inverse leaves out the `gauge` smallest eigenvalues (inner constraints).
        The residuals have unit variance. All entries are infinite if more freedoms are open.

        gauge : number of freedoms of the gauge.
        """
        size = self.sizes.reduced
        found = self.reduced(1e-13)
        if found is None:
            return np.full((size, size), np.inf)
        scale = 1 / np.sqrt(np.maximum(np.diag(self._image_equations[0]), 1e-300))
        values, axes = np.linalg.eigh(found[0] * np.outer(scale, scale))
        if not values[gauge] > 1e-11 * values[-1]:
            return np.full((size, size), np.inf)
        half = scale[:, None] * (axes[:, gauge:] / np.sqrt(values[gauge:]))
        return np.asarray(half @ half.T)

    def covariance(self, gauge: Array) -> Array:
        """(k, k) float64, the covariance of the k = `Sizes.reduced` shared and image parameters, in a gauge.

        It is the inverse of S on the steps that obey the conditions of the gauge, for residuals of unit variance. All
        entries are infinite if a parameter is still open under these conditions.

        Parameters
        ----------
        gauge : (q, k) conditions; a step obeys them if gauge @ step = 0.
        """
        found = self.reduced(1e-12)
        size = self.sizes.reduced
        if found is None:
            return np.full((size, size), np.inf)
        S = found[0]
        scale = 1 / np.sqrt(np.maximum(np.diag(self._image_equations[0]), 1e-300))
        scale[np.diag(self._image_equations[0]) == 0] = 1
        basis = np.eye(size)
        if len(gauge):
            basis = np.linalg.qr((gauge * scale).T, mode="complete")[0][:, len(gauge) :]
        values, axes = np.linalg.eigh(basis.T @ (S * np.outer(scale, scale)) @ basis)
        if not values[0] > 1e-13 * values[-1]:
            return np.full((size, size), np.inf)
        half = scale[:, None] * (basis @ (axes / np.sqrt(values)))
        return np.asarray(half @ half.T)


# ------------------------------------------------------------------------------------------- kernels


@kernel
def _add_images(values, images, by_images, by_shared, U, g):  # type: ignore[no-untyped-def]
    """Add J^T J to U and J^T r to g, for the shared and the image parameters."""
    m, d, e, c = by_images.shape
    s = by_shared.shape[2]
    for i in range(m):
        for one in range(e):
            row = s + images[i, one] * c
            for a in range(c):
                for k in range(d):
                    left = by_images[i, k, one, a]
                    g[row + a] += left * values[i, k]
                    for two in range(e):
                        column = s + images[i, two] * c
                        for b in range(c):
                            U[row + a, column + b] += left * by_images[i, k, two, b]
                    for b in range(s):
                        U[row + a, b] += left * by_shared[i, k, b]
                        U[b, row + a] += left * by_shared[i, k, b]
        for a in range(s):
            for k in range(d):
                g[a] += by_shared[i, k, a] * values[i, k]
                for b in range(s):
                    U[a, b] += by_shared[i, k, a] * by_shared[i, k, b]


@kernel
def _add_points(start, stop, starts, values, by_point, V, h):  # type: ignore[no-untyped-def]
    """Add J^T J to V and J^T r to h, for each point from start to stop."""
    d, p = by_point.shape[1], by_point.shape[2]
    for j in range(start, stop):
        for i in range(starts[j], starts[j + 1]):
            for k in range(d):
                for a in range(p):
                    h[j, a] += by_point[i, k, a] * values[i, k]
                    for b in range(p):
                        V[j, a, b] += by_point[i, k, a] * by_point[i, k, b]


@kernel
def _scaled(start, stop, point, by_point, inverse, result):  # type: ignore[no-untyped-def]
    """Set result[i] = by_point[i] L^-T, where `inverse` holds the lower triangular L^-1 of each point."""
    d, p = by_point.shape[1], by_point.shape[2]
    for i in range(start, stop):
        j = point[i]
        for k in range(d):
            for a in range(p):
                total = 0.0
                for b in range(a + 1):
                    total += by_point[i, k, b] * inverse[j, a, b]
                result[i, k, a] = total


@kernel
def _fill(start, stop, first, starts, place, images, by_images, by_shared, by_point, Y):  # type: ignore[no-untyped-def]
    """Add by_point^T by_images of all residuals of point first + j to Y[j], in the columns of their images."""
    d, e, c = by_images.shape[1], by_images.shape[2], by_images.shape[3]
    s, p = by_shared.shape[2], by_point.shape[2]
    for j in range(start, stop):
        for i in range(starts[first + j], starts[first + j + 1]):
            for a in range(p):
                for k in range(d):
                    left = by_point[i, k, a]
                    for one in range(e):
                        column = s + place[images[i, one]] * c
                        for b in range(c):
                            Y[j, a, column + b] += left * by_images[i, k, one, b]
                    for b in range(s):
                        Y[j, a, b] += left * by_shared[i, k, b]


@kernel
def _back_substitute(start, stop, starts, images, by_images, by_shared, by_point, shared, steps, result):  # type: ignore[no-untyped-def]
    """Add Y (shared, steps) to result[j], where `steps` are the steps of the images."""
    d, e, c = by_images.shape[1], by_images.shape[2], by_images.shape[3]
    s, p = by_shared.shape[2], by_point.shape[2]
    for j in range(start, stop):
        for i in range(starts[j], starts[j + 1]):
            for k in range(d):
                total = 0.0
                for one in range(e):
                    for b in range(c):
                        total += by_images[i, k, one, b] * steps[images[i, one], b]
                for b in range(s):
                    total += by_shared[i, k, b] * shared[b]
                for a in range(p):
                    result[j, a] += by_point[i, k, a] * total
