# SPDX-License-Identifier: Apache-2.0
"""Two cameras, points in front of them, and the Cramer-Rao bound by numerical derivatives.

The tests of `rangesim.geometry` and its benchmark share them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.geometry import projection_matrix

K = np.array([[800.0, 0, 320], [0, 810, 240], [0, 0, 1]])


def rigid(turn: Iterable[float], move: Iterable[float]) -> np.ndarray:
    """(4, 4) pose of a rotation vector, rad, and a translation, metres."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(np.asarray(turn)).as_matrix(), move
    return T


T_SECOND_FIRST = rigid((0.05, -0.2, 0.03), (0.3, 0.05, 0.1))
FIRST, SECOND = projection_matrix(K), projection_matrix(K, T_SECOND_FIRST)


def points(random: np.random.Generator, n: int, plane: bool = False) -> np.ndarray:
    """(n, 3) points in metres that both cameras see; on one plane if `plane`."""
    X = random.uniform([-1, -1, 3], [1, 1, 6], (n, 3))
    if plane:
        X[:, 2] = 4 + 0.3 * X[:, 0] - 0.2 * X[:, 1]
    return X


def cramer_rao(
    predict: Callable[[np.ndarray], np.ndarray],
    quantity: Callable[[np.ndarray], np.ndarray],
    parameters: np.ndarray,
    noise: float,
) -> np.ndarray:
    """Least covariance that an unbiased estimate of `quantity` can have, from `predict` plus noise, at `parameters`.

    Redundant parameters do not matter if the quantity does not depend on them.
    """
    jacobian, gradient = (derivative(f, parameters) for f in (predict, quantity))
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0] = 1
    through = gradient / scale @ np.linalg.pinv(jacobian / scale, rcond=1e-8)
    return np.asarray(noise**2 * through @ through.T)


def derivative(f: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """(m, k) derivatives of f at a point (k,), by central differences."""
    steps = 1e-6 * np.maximum(np.abs(at), 1e-3)
    columns = [(np.ravel(f(at + h)) - np.ravel(f(at - h))) / (2 * h.max()) for h in np.diag(steps)]
    return np.stack(columns, axis=-1)


def efficiency(errors: np.ndarray, bound: np.ndarray, rank: int) -> float:
    """Mean of e^T C^-1 e / rank over errors e (trials, m), where C is the bound of that rank; 1 reaches the bound."""
    values, axes = np.linalg.eigh(bound)
    whitened = errors @ axes[:, -rank:] / np.sqrt(values[-rank:])
    return float((whitened**2).sum(axis=-1).mean() / rank)


def alike(matrix: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """A matrix without scale, at unit norm and with the sign of `truth`."""
    unit = matrix / np.linalg.norm(matrix)
    return np.asarray(unit * np.sign((unit * truth).sum()))
