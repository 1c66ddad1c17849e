# SPDX-License-Identifier: Apache-2.0
"""Poses of devices: rigid transforms as (4, 4) matrices, in metres.

Coordinates of a device follow OpenCV: x right, y down, z forward, metres. `T_a_b` maps coordinates of b to coordinates
of a.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.settings.bounds import MAX_COORDINATE_M
from rangesim.settings.config import shown

Array = NDArray[np.float64]
"""An array of float64."""

SAME_PLACE = 1e-5
"""Largest difference of two poses, in metres and radians, that count as the same place. Poses that were computed along
different ways differ by rounding, about 1e-16. A pose that differs by less than 10 um is no other place either, because
nobody can adjust a device so finely."""
ROTATION_TOLERANCE = 1e-4
"""Largest entry of |R R^T - I|, dimensionless, of a matrix that counts as a rotation. A matrix written with five
decimals is off by at most 2e-5 and passes; a scale of 1.0001 does not."""


def pose(matrix: ArrayLike, name: str) -> Array:
    """A rigid transform as a read-only (4, 4) float64 copy.

    name : what the transform is, for the message.

    Raises
    ------
    ValueError
        The matrix is not a rotation and a translation of at most `MAX_COORDINATE_M`.
    """
    try:
        result: Array = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"expected {name} to be a (4, 4) matrix, got {shown(matrix)}.") from None
    if result.shape != (4, 4):
        raise ValueError(f"expected {name} to be a (4, 4) matrix, got shape {result.shape}.")
    if not np.isfinite(result).all():
        raise ValueError(f"expected {name} to hold finite numbers, got {result.tolist()}.")
    if np.abs(result).max() > MAX_COORDINATE_M:
        raise ValueError(f"expected {name} to move by at most {MAX_COORDINATE_M:g} m, got {np.abs(result).max():g}.")
    check_rigid(result, name)
    result.setflags(write=False)
    return result


def check_rigid(T: NDArray[np.floating[Any]], name: str) -> None:
    """Raise ValueError unless a pose (4, 4), or each of several (n, 4, 4), is a rotation and a translation.

    name : what the poses are, for the message; the first one that is not rigid is named by its index.
    """
    R = T[..., :3, :3]
    is_rotation = np.isclose(R @ np.swapaxes(R, -1, -2), np.eye(3), atol=ROTATION_TOLERANCE).all(axis=(-2, -1))
    is_rigid = is_rotation & (np.linalg.det(R) > 0) & np.isclose(T[..., 3, :], [0, 0, 0, 1]).all(axis=-1)
    if not is_rigid.all():
        if T.ndim > 2:
            first = int(np.argmin(is_rigid))
            name, T = f"{name}[{first}]", T[first]
        raise ValueError(f"expected {name} to be rigid (a rotation and a translation in metres), got {T.tolist()}.")


def is_same_pose(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two poses (4, 4) are equal within `SAME_PLACE`."""
    return bool(np.abs(np.linalg.inv(first) @ second - np.eye(4)).max() <= SAME_PLACE)


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """(4, 4) float64, T_world_device of a device at `origin` that looks at `target`.

    Parameters
    ----------
    origin, target : (3,) metres, world.
    up : (3,) direction in the world that is upwards in the image.

    Raises
    ------
    ValueError
        A coordinate that is not finite, `target` at `origin`, or `up` along the direction of view.

    Examples
    --------
    A camera 2 m above the ground that looks straight down; the last two columns are its direction of view and place:

    >>> T = look_at((0, 0, 2), (0, 0, 0), up=(0, 1, 0))
    >>> T[:3, 2], T[:3, 3]
    (array([ 0.,  0., -1.]), array([0., 0., 2.]))
    """
    o, t, u = (np.asarray(a, dtype=np.float64) for a in (origin, target, up))
    for name, value in (("origin", o), ("target", t), ("up", u)):
        if value.shape != (3,) or not (np.abs(value) <= MAX_COORDINATE_M).all():
            raise ValueError(f"expected {name} to be three finite coordinates, got {shown(value.tolist())}.")
    z = t - o
    x = np.cross(z, u)
    if np.linalg.norm(z) == 0 or np.linalg.norm(x) == 0:
        raise ValueError(
            f"expected target {t.tolist()} to differ from origin {o.tolist()}, and not to lie along up {u.tolist()}."
        )
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    result = np.eye(4)
    result[:3] = np.stack([x, np.cross(z, x), z, o], axis=1)
    return result


def translation(x: float, y: float, z: float) -> Array:
    """(4, 4) float64, the translation by (x, y, z), metres."""
    result = np.eye(4)
    result[:3, 3] = x, y, z
    return result
