# SPDX-License-Identifier: Apache-2.0
"""Sums of squares over images and points whose normal equations are sparse: solved by the Schur complement on the
points.

A residual of an observation depends on its image (a block of parameters), on its point (another), and perhaps on
parameters that all share, as a lens. The normal equations are then

    [ U    W ] [ images ]     [ g_images ]
    [ W^T  V ] [ points ] = - [ g_points ]      V block diagonal, a small block for each point,

and eliminating the points leaves S = U - W V^-1 W^T, as large as the images alone (Brown 1958; Triggs, McLauchlan,
Hartley, Fitzgibbon: "Bundle adjustment - a modern synthesis", 2000, section 6.1). W is never kept: with V = L L^T,
S = U - Y^T Y where Y = L^-1 W^T is made for some hundred points at a time, over the images that see them.

S is dense: (images x parameters)^2 numbers, 0.3 GB for 1000 cameras.
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

LEAST_DAMPING = 1e-10
"""Relative to the diagonal; it also holds what the residuals leave open, such as the gauge, where it is."""
CHUNK_BYTES = 16e6
"""Of Y at a time."""


class Step(NamedTuple):
    """shared : (s,). images : (n_images, c). points : (n_points, p)."""

    shared: Array
    images: Array
    points: Array


class Term(NamedTuple):
    """Residuals of one kind and their derivatives by a step.

    values : (m, d). point : (m,) int64, ascending. images : (m, e) int64, the e images that each depends on.
    by_images : (m, d, e, c). by_point : (m, d, p). by_shared : (m, d, s).
    """

    values: Array
    point: np.ndarray
    images: np.ndarray
    by_images: Array
    by_point: Array
    by_shared: Array


class Prior(NamedTuple):
    """Residuals of shared and image parameters alone. values : (q,). by_step : (q, s + n_images c), shared first."""

    values: Array
    by_step: Array


@dataclass(frozen=True)
class Sizes:
    """Numbers of shared parameters, of images and parameters of each, of points and parameters of each."""

    shared: int
    images: int
    of_image: int
    points: int
    of_point: int

    @property
    def eliminated(self) -> int:
        """Parameters that are left once the points are eliminated: shared ones first, then those of each image."""
        return self.shared + self.images * self.of_image


class NormalEquations:
    """A sum of squares near a state, as `least_squares.descend` takes it; made of terms when a step is first asked for.

    Parameters
    ----------
    cost : the sum of squares, or the sum of a robust loss that the weighted `terms` stand for.
    terms : with rows already weighted. prior : on shared and image parameters.

    Parameters that nothing depends on, such as those of images that are held, stay as they are.
    """

    def __init__(self, cost: float, sizes: Sizes, terms: Sequence[Term], prior: Prior | None = None) -> None:
        self.cost, self.sizes, self.terms, self.prior = cost, sizes, terms, prior

    @cached_property
    def _starts(self) -> list[np.ndarray]:
        """(n_points + 1,) of each term: where the residuals of each point start."""
        numbers = np.arange(self.sizes.points + 1)
        return [np.searchsorted(term.point, numbers) for term in self.terms]

    @cached_property
    def _of_points(self) -> tuple[Array, Array]:
        """V and g of the points."""
        sizes = self.sizes
        V, h = np.zeros((sizes.points, sizes.of_point, sizes.of_point)), np.zeros((sizes.points, sizes.of_point))
        for term, starts in zip(self.terms, self._starts, strict=True):
            in_blocks(_add_points, sizes.points, starts, term.values, term.by_point, V, h, smallest=256)
        return V, h

    @cached_property
    def _of_images(self) -> tuple[Array, Array]:
        """U and g of shared and image parameters."""
        sizes = self.sizes
        U, g = np.zeros((sizes.eliminated, sizes.eliminated)), np.zeros(sizes.eliminated)
        for term in self.terms:
            _add_images(term.values, term.images, term.by_images, term.by_shared, U, g)
        if self.prior is not None:
            U += self.prior.by_step.T @ self.prior.by_step
            g += self.prior.by_step.T @ self.prior.values
        return U, g

    def reduced(self, damping: float) -> tuple[Array, Array, Array, Array, list[Array]] | None:
        """S, its right side, and for the points: L^-1, L^-1 g, and the terms' by_point L^-T; None where V is singular.

        damping : relative, of all parameters.
        """
        (U, g), (V, h) = self._of_images, self._of_points
        sizes = self.sizes
        block = np.arange(sizes.of_point)
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
        """S -= Y^T Y and right += Y^T L^-1 g, some points at a time."""
        sizes = self.sizes
        at_once = int(max(1, CHUNK_BYTES / (8 * sizes.of_point * max(sizes.eliminated, 1))))
        for first in range(0, sizes.points, at_once):
            last = min(first + at_once, sizes.points)
            involved = np.zeros(sizes.images, dtype=bool)
            for term, starts in zip(self.terms, self._starts, strict=True):
                involved[term.images[starts[first] : starts[last]]] = True
            if not involved.any():
                continue  # points that nothing observes
            images = np.flatnonzero(involved)
            place = np.full(sizes.images, -1)
            place[images] = np.arange(len(images))
            Y = np.zeros((last - first, sizes.of_point, sizes.shared + len(images) * sizes.of_image))
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
                    (sizes.shared + images[:, None] * sizes.of_image + np.arange(sizes.of_image)).ravel(),
                ]
            )
            if len(columns) == sizes.eliminated:
                S -= flat.T @ flat
            else:
                S[np.ix_(columns, columns)] -= flat.T @ flat
            right[columns] += flat.T @ scaled_h[first:last].ravel()

    def damped_step(self, damping: float) -> tuple[Step, float] | None:
        """See `least_squares.Descent`."""
        found = self.reduced(damping)
        if found is None:
            return None
        S, right, inverse, scaled_h, by_points = found
        try:
            of_images = cho_solve(cho_factor(S, lower=True, check_finite=False), right, check_finite=False)
        except np.linalg.LinAlgError:
            return None
        sizes = self.sizes
        shared, images = of_images[: sizes.shared], of_images[sizes.shared :].reshape(sizes.images, sizes.of_image)
        for term, starts, by_point in zip(self.terms, self._starts, by_points, strict=True):
            arrays = term.images, term.by_images, term.by_shared, by_point, shared, images, scaled_h
            in_blocks(_substitute, sizes.points, starts, *arrays, smallest=256)
        points = -(np.swapaxes(inverse, 1, 2) @ scaled_h[:, :, None])[:, :, 0]
        (U, g), (V, h) = self._of_images, self._of_points
        block = np.arange(sizes.of_point)
        slope = float(of_images @ g + (points * h).sum())
        damped = float((of_images**2 * np.diag(U)).sum() + (points**2 * V[:, block, block]).sum())
        return Step(shared, images, points), -slope + damping * damped

    def step_of_points(self) -> Array:
        """(n_points, p) the step of the points alone, images held; exact where residuals are linear in the points.

        Points that the residuals leave open take the smallest such step.
        """
        V, h = self._of_points
        return -(np.linalg.pinv(V, rcond=1e-12, hermitian=True) @ h[:, :, None])[:, :, 0]

    def response_of_points(self) -> Array:
        """(n_points, p, k) d points / d (shared, images) at the minimum over the points: -V^-1 W^T."""
        sizes = self.sizes
        found = self.reduced(1e-13)
        if found is None:
            return np.full((sizes.points, sizes.of_point, sizes.eliminated), np.inf)
        _, _, inverse, _, by_points = found
        Y = np.zeros((sizes.points, sizes.of_point, sizes.eliminated))
        for term, starts, by_point in zip(self.terms, self._starts, by_points, strict=True):
            place = np.arange(sizes.images)
            _fill(0, sizes.points, 0, starts, place, term.images, term.by_images, term.by_shared, by_point, Y)
        return np.asarray(-np.swapaxes(inverse, 1, 2) @ Y)

    def covariance_of_points(self) -> Array:
        """(n_points, p, p) V^-1: of each point given the images, for residuals of unit variance; infinite where the
        residuals leave it open."""
        V, _ = self._of_points
        values, axes = np.linalg.eigh(V)
        sound = values[:, 0] > 1e-13 * values[:, -1]
        half = axes / np.sqrt(np.where(sound[:, None], values, 1.0))[:, None, :]
        result = half @ np.swapaxes(half, 1, 2)
        result[~sound] = np.inf
        return np.asarray(result)

    def free_covariance(self, gauge: int) -> Array:
        """(k, k) as `covariance`, with `gauge` freedoms spread over all parameters: S^+ less its `gauge` least
        eigenvalues, that of smallest trace (inner constraints). Infinite if more are open."""
        size = self.sizes.eliminated
        found = self.reduced(1e-13)
        if found is None:
            return np.full((size, size), np.inf)
        scale = 1 / np.sqrt(np.maximum(np.diag(self._of_images[0]), 1e-300))
        values, axes = np.linalg.eigh(found[0] * np.outer(scale, scale))
        if not values[gauge] > 1e-11 * values[-1]:
            return np.full((size, size), np.inf)
        half = scale[:, None] * (axes[:, gauge:] / np.sqrt(values[gauge:]))
        return np.asarray(half @ half.T)

    def covariance(self, gauge: Array) -> Array:
        """(k, k) inverse of S where gauge @ step = 0, k = `Sizes.eliminated`: of shared and image parameters, for
        residuals of unit variance.

        Parameters
        ----------
        gauge : (q, k) rows of the conditions that the step obeys. Zero columns of S and what they leave open are
            infinite.
        """
        found = self.reduced(1e-12)
        size = self.sizes.eliminated
        if found is None:
            return np.full((size, size), np.inf)
        S = found[0]
        scale = 1 / np.sqrt(np.maximum(np.diag(self._of_images[0]), 1e-300))
        scale[np.diag(self._of_images[0]) == 0] = 1
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
    """U += J^T J and g += J^T r of shared and image parameters."""
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
    """V += J^T J and h += J^T r of each point."""
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
    """result[i] = by_point[i] L^-T, with L^-1 of its point lower triangular."""
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
    """Y[j] += by_point^T by_images of all residuals of point first + j, in the columns of their images."""
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
def _substitute(start, stop, starts, images, by_images, by_shared, by_point, shared, steps, result):  # type: ignore[no-untyped-def]
    """result[j] += Y (shared, steps), the steps of the images."""
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
