# SPDX-License-Identifier: Apache-2.0
"""Nonlinear least squares on manifolds (rotations, directions, matrices up to scale) by Levenberg-Marquardt.

SciPy's solvers work on vectors. Here a state can be any object, and a step is a vector in the tangent space of the
state. So a rotation stays a rotation, no parameter is redundant, and the inverse of J^T J gives the covariance. The
damping follows Madsen, Nielsen, Tingleff: "Methods for non-linear least squares problems", 2004.

Used by: rangesim.geometry.camera_pose, hand_eye, homography and two_view; rangesim.calibration.bundle, suspects and
zhang; rangesim.multiview.bundle_adjustment, factorisation, nonrigid and orthographic.
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
"""Largest number of steps of a descent. A descent from a good start converges in far fewer; the limit ends descents
from a bad start, which are then judged by their cost."""

CONVERGED = 1e-12
"""Relative decrease of the cost, as a ratio, at which a descent has converged. It lies a little above what double
precision resolves, so that an estimate reaches its minimum; with a larger value the descent ends sooner, beside the
minimum."""

START_DAMPING = 1e-6
"""Damping of the first step, as a ratio to the diagonal of J^T J. It is small because starts are good (Madsen, Nielsen,
Tingleff 2004, section 3.2): the first step is nearly a Gauss-Newton step. From a bad start the damping grows until a
step succeeds."""

MAX_DAMPING = 1e12
"""Damping at which a descent gives up, as a ratio to the diagonal of J^T J: steps are then below rounding, so that no
step can lower the cost."""

LEAST_DAMPING = 1e-15
"""Least damping of dense equations, as a ratio to the diagonal of J^T J. It may be as small as rounding, because
`Minimum.damped_step` solves singular equations in the least-squares sense; sparse solvers state a larger one."""

MIN_DETERMINED = 1e-10
"""Ratio of the smallest to the largest singular value of a jacobian below which the residuals do not determine all
parameters. It lies above the rounding of the singular values, 1e-16 times some thousand residuals, so that exact
degeneracy is found; a larger value also refuses weakly determined parameters."""


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State]):
    """A state, for example that of the least sum of squares, with the residuals and their derivatives there.

    Attributes
    ----------
    state : any object, such as a pose or a matrix.
    residuals : (m,) float64.
    jacobian : (m, k) float64 derivatives of the residuals by a step in the tangent space of the state.
    """

    state: State
    residuals: Array
    jacobian: Array

    @property
    def cost(self) -> float:
        """Sum of squares of the residuals."""
        return float(self.residuals @ self.residuals)

    def damped_step(self, damping: float) -> tuple[Array, float]:
        """The step and its predicted decrease of the cost; see `Descent.damped_step`.

        Singular equations are solved in the least-squares sense.
        """
        normal, slope = self.jacobian.T @ self.jacobian, self.jacobian.T @ self.residuals
        scale = np.maximum(np.diag(normal), 1e-30)
        delta = np.linalg.lstsq(normal + np.diag(damping * scale), -slope, rcond=None)[0]
        return delta, float(-delta @ (2 * slope + normal @ delta))

    def noise(self, parameters: int) -> float:
        """Standard deviation of a residual: the root of the sum of squares per degree of freedom.

        It is NaN if there are no more residuals than parameters.
        """
        freedom = len(self.residuals) - parameters
        return float(np.sqrt(self.cost / freedom)) if freedom > 0 else float("nan")

    def covariance(self, noise: float) -> Array:
        """(k, k) float64 covariance of the step, noise^2 (J^T J)^-1: the Cramer-Rao bound for Gaussian noise.

        All entries are infinite if the residuals leave a direction open (`MIN_DETERMINED`).

        Parameters
        ----------
        noise : standard deviation of a residual.
        """
        _, values, axes = np.linalg.svd(self.jacobian, full_matrices=False)
        if len(values) < self.jacobian.shape[1] or not values[-1] > MIN_DETERMINED * values[0]:
            return np.full((self.jacobian.shape[1],) * 2, np.inf)
        scaled = axes.T / values
        return np.asarray(noise**2 * scaled @ scaled.T)


class Descent(Protocol):
    """The quadratic model of a sum of squares about a state, from which a descent takes its steps.

    `Minimum` is the dense model; `rangesim.multiview.schur_complement` has a sparse one.
    """

    @property
    def cost(self) -> float:
        """Sum of squares of the residuals at the state."""
        ...

    def damped_step(self, damping: float) -> tuple[Any, float] | None:
        """The damped step, and the decrease of the cost that the quadratic model predicts for it.

        The step delta solves (N + damping diag N) delta = -g with N = J^T J and g = J^T r. The result is None if these
        equations are singular.
        """
        ...


@dataclass(frozen=True, eq=False)
class Descended(Generic[State, Look]):
    """The end of a descent.

    Attributes
    ----------
    state : the last state.
    here : the quadratic model there, as `look` returned it.
    steps : number of steps that were taken.
    has_converged : whether no step lowers the cost any more.
    """

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
    """The descent of Levenberg and Marquardt from `start`, with dense or sparse equations.

    Parameters
    ----------
    look : returns the quadratic model of the sum of squares about a state.
    step : returns the state moved by a step.
    max_steps : largest number of steps.
    converged : relative decrease of the cost at which the descent ends.
    least_damping : lower limit of the damping, as a ratio to the diagonal of J^T J.
    """
    state, here = start, look(start)
    damping, growth = max(START_DAMPING, least_damping), 2.0
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
    """The local minimum of a sum of squares that a descent from `start` reaches, with dense equations.

    Parameters
    ----------
    residuals : returns the (m,) residuals at a state and their (m, k) derivatives by a step, at step 0.
    step : returns the state moved by a step (k,) of its tangent space.

    Examples
    --------
    The angle whose cosine is 0.5:

    >>> found = minimise(
    ...     lambda angle: (np.array([np.cos(angle) - 0.5]), np.array([[-np.sin(angle)]])),
    ...     lambda angle, step: angle + step[0],
    ...     start=1.0,
    ... )
    >>> float(round(found.state, 6))
    1.047198
    """
    return descend(lambda state: Minimum(state, *residuals(state)), step, start).here
