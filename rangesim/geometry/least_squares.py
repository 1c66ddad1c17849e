# SPDX-License-Identifier: Apache-2.0
"""Nonlinear least squares over rotations, directions and matrices up to scale: Levenberg and Marquardt on a manifold.

SciPy's solvers work on vectors. Here a state is anything, and a step is a vector in its tangent space, so that a
rotation stays a rotation, no parameter is redundant and the inverse of J^T J is the covariance (Madsen, Nielsen,
Tingleff: "Methods for non-linear least squares problems", 2004, for the damping).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from rangesim.geometry.correspondences import Array

State = TypeVar("State")
Look = TypeVar("Look", bound="Descent")

MAX_STEPS = 100
CONVERGED = 1e-12
"""Relative decrease of the cost at which it ends."""
MAX_DAMPING = 1e12
LEAST_DAMPING = 1e-15
"""Of dense equations, which are solved in the least squares sense where they are singular."""


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

    def damped_step(self, damping: float) -> tuple[Array, float]:
        """See `Descent`; in the least squares sense where the equations are singular."""
        normal, slope = self.jacobian.T @ self.jacobian, self.jacobian.T @ self.residuals
        scale = np.maximum(np.diag(normal), 1e-30)
        delta = np.linalg.lstsq(normal + np.diag(damping * scale), -slope, rcond=None)[0]
        return delta, float(-delta @ (2 * slope + normal @ delta))

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


class Descent(Protocol):
    """A sum of squares near a state: dense (`Minimum`) or sparse (`rangesim.multiview.schur_complement`)."""

    @property
    def cost(self) -> float:
        """Sum of squares at the state."""
        ...

    def damped_step(self, damping: float) -> tuple[Any, float] | None:
        """The step delta with (N + damping diag N) delta = -g, and the decrease of the cost that the linear model
        predicts of it; None if the equations are singular. N = J^T J, g = J^T r."""
        ...


@dataclass(frozen=True, eq=False)
class Descended(Generic[State, Look]):
    """state : the last one. here : what `look` says of it. steps : how many were taken. has_converged : whether no step
    lowers the cost any more."""

    state: State
    here: Look
    steps: int
    has_converged: bool


def descend(
    look: Callable[[State], Look],
    step: Callable[[State, Any], State],
    start: State,
    *,
    max_steps: int = MAX_STEPS,
    converged: float = CONVERGED,
    least_damping: float = LEAST_DAMPING,
) -> Descended[State, Look]:
    """Levenberg and Marquardt's descent from `start`, whatever the algebra.

    Parameters
    ----------
    look : state -> the sum of squares there. step : state, step -> the state moved by it.
    converged : relative decrease of the cost at which it ends.
    """
    state, here = start, look(start)
    damping, growth = max(1e-6, least_damping), 2.0
    taken = 0
    for _ in range(max_steps):
        found = here.damped_step(damping)
        if found is not None:
            delta, predicted = found
            moved = step(state, delta)
            there = look(moved)
        if found is None or not (np.isfinite(there.cost) and there.cost <= here.cost):
            damping, growth = damping * growth, growth * 2
            if found is not None and predicted <= converged * here.cost:
                return Descended(state, here, taken, True)
            if damping > MAX_DAMPING:
                return Descended(state, here, taken, found is not None)
            continue
        decrease = here.cost - there.cost
        taken += 1
        state, here, damping, growth = moved, there, max(damping / 5, least_damping), 2.0
        if decrease <= converged * here.cost:
            return Descended(state, here, taken, True)
    return Descended(state, here, taken, False)


def minimise(
    residuals: Callable[[State], tuple[Array, Array]], step: Callable[[State, Array], State], start: State
) -> Minimum[State]:
    """Local minimum of a sum of squares, from `start` downwards.

    Parameters
    ----------
    residuals : state -> (m,) residuals and (m, k) their derivatives by the step at 0.
    step : state, (k,) -> the state moved by a step of the tangent space.
    """
    return descend(lambda state: Minimum(state, *residuals(state)), step, start).here
