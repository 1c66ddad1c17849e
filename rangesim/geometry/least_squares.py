# SPDX-License-Identifier: Apache-2.0
"""Nonlinear least squares over rotations, directions and matrices up to scale: Levenberg and Marquardt on a manifold.

SciPy's solvers work on vectors. Here a state is anything, and a step is a vector in its tangent space, so that a
rotation stays a rotation, no parameter is redundant and the inverse of J^T J is the covariance (Madsen, Nielsen,
Tingleff: "Methods for non-linear least squares problems", 2004, for the damping).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from rangesim.geometry.correspondences import Array

State = TypeVar("State")

MAX_STEPS = 100
CONVERGED = 1e-12
"""Relative decrease of the cost at which it ends."""


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State]):
    """state : where the sum of squares is least. residuals : (m,) there. jacobian : (m, k) d residuals / d step."""

    state: State
    residuals: Array
    jacobian: Array

    @property
    def cost(self) -> float:
        """Sum of squares of the residuals."""
        return float(self.residuals @ self.residuals)

    def noise(self, parameters: int) -> float:
        """Standard deviation of a residual: root of the sum of squares per degree of freedom; NaN if there is none."""
        freedom = len(self.residuals) - parameters
        return float(np.sqrt(self.cost / freedom)) if freedom > 0 else float("nan")

    def covariance(self, noise: float) -> Array:
        """(k, k) covariance of the step, noise^2 (J^T J)^-1: the Cramer-Rao bound for Gaussian noise.

        Infinite along what the residuals do not determine (singular values below 1e-10 of the largest).
        """
        _, values, axes = np.linalg.svd(self.jacobian, full_matrices=False)
        if len(values) < self.jacobian.shape[1] or not values[-1] > 1e-10 * values[0]:
            return np.full((self.jacobian.shape[1],) * 2, np.inf)
        scaled = axes.T / values
        return np.asarray(noise**2 * scaled @ scaled.T)


def minimise(
    residuals: Callable[[State], tuple[Array, Array]], step: Callable[[State, Array], State], start: State
) -> Minimum[State]:
    """Local minimum of a sum of squares, from `start` downwards.

    Parameters
    ----------
    residuals : state -> (m,) residuals and (m, k) their derivatives by the step at 0.
    step : state, (k,) -> the state moved by a step of the tangent space.
    """
    here = Minimum(start, *residuals(start))
    damping, growth = 1e-6, 2.0
    for _ in range(MAX_STEPS):
        normal, slope = here.jacobian.T @ here.jacobian, here.jacobian.T @ here.residuals
        scale = np.maximum(np.diag(normal), 1e-30)
        delta = np.linalg.lstsq(normal + np.diag(damping * scale), -slope, rcond=None)[0]  # it may be singular
        there = Minimum(step(here.state, delta), *residuals(step(here.state, delta)))
        predicted = -delta @ (2 * slope + normal @ delta)
        if not (np.isfinite(there.cost) and there.cost <= here.cost):
            damping, growth = damping * growth, growth * 2
            if damping > 1e12 or predicted <= CONVERGED * here.cost:
                break
            continue
        decrease = here.cost - there.cost
        here, damping, growth = there, max(damping / 5, 1e-15), 2.0
        if decrease <= CONVERGED * here.cost:
            break
    return here
