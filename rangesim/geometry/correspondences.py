# SPDX-License-Identifier: Apache-2.0
"""Checks of the arrays that come in, and the coordinates in which linear equations of points are well conditioned.

Points are pixel coordinates with pixel centres at integer + 0.5, as everywhere in rangesim. Nothing in this package
depends on where zero lies, as long as points and calibration matrices agree; only images do (`stereo`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.settings.config import shown

Array = NDArray[np.floating[Any]]

ROUNDING = 1e-9
"""Relative size below which a number is rounding: of singular values, and of residuals in units of the points'
spread."""


def checked_array(name: str, value: ArrayLike, *shape: int | None) -> Array:
    """`value` as float64 with finite numbers, whose last dimensions are `shape`; None stands for any length.

    Raises
    ------
    ValueError
        It is no array of numbers, of another shape, or holds NaN or infinity.
    """
    wanted = "(..., " + ", ".join("n" if length is None else str(length) for length in shape) + ")"
    try:
        array: Array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"expected {name} as an array of numbers {wanted}, got {shown(value)}.") from None
    last = array.shape[array.ndim - len(shape) :] if array.ndim >= len(shape) else ()
    if len(last) != len(shape) or any(w not in (None, n) for w, n in zip(shape, last, strict=True)):
        raise ValueError(f"expected {name} of shape {wanted}, got {array.shape}.")
    if not np.isfinite(array).all():
        bad = int(np.count_nonzero(~np.isfinite(array)))
        raise ValueError(f"expected {name} to be finite, got {bad} NaN or infinite of {array.size}; leave those out.")
    return array


def checked_pairs(first: ArrayLike, second: ArrayLike, least: int, purpose: str) -> tuple[Array, Array]:
    """Corresponding points (n, 2) and (n, 2) float64, finite, at least `least` different ones in each image.

    Raises
    ------
    ValueError
        They are not that; the message says what `purpose` needs them.
    """
    a, b = checked_array("first", first, None, 2), checked_array("second", second, None, 2)
    if a.ndim != 2 or a.shape != b.shape:
        raise ValueError(f"expected first and second as corresponding points (n, 2), got {a.shape} and {b.shape}.")
    for name, points in (("first", a), ("second", b)):
        check_distinct(name, points, least, purpose)
    return a, b


def check_distinct(name: str, points: Array, least: int, purpose: str) -> None:
    """Raise ValueError unless `least` of the points (n, d) differ from each other."""
    if len(points) < least:
        raise ValueError(f"expected at least {least} points for {purpose}, got {len(points)} in {name}.")
    different = len(np.unique(points, axis=0))
    if different < least:
        raise ValueError(
            f"expected at least {least} different points for {purpose}, got {different} different ones among "
            f"{len(points)} in {name}; repeated points add nothing."
        )


def check_noise(noise_px: float | None) -> None:
    """Raise ValueError unless the standard deviation of a coordinate is positive, or None for unknown."""
    if noise_px is not None and not (np.isfinite(noise_px) and noise_px > 0):
        raise ValueError(
            f"expected noise_px, the standard deviation of a coordinate, to be positive, got {noise_px!r}."
        )


def normalising_transform(points: Array) -> Array:
    """(..., 3, 3) similarity that moves the centroid of points (..., n, 2) to 0 and their mean distance to sqrt(2).

    In these coordinates the entries of the design matrices of homographies and fundamental matrices are of one size,
    and the linear solution becomes usable (Hartley: "In defense of the eight-point algorithm", PAMI 1997).
    """
    centre = points.mean(axis=-2)
    distance = np.linalg.norm(points - centre[..., None, :], axis=-1).mean(axis=-1)
    scale = np.sqrt(2) / np.where(distance > 0, distance, 1)
    transform = np.zeros((*centre.shape[:-1], 3, 3))
    transform[..., 0, 0] = transform[..., 1, 1] = scale
    transform[..., :2, 2] = -scale[..., None] * centre
    transform[..., 2, 2] = 1
    return transform


def apply_similarity(transform: Array, points: Array) -> Array:
    """(..., n, 2) points under a transform (..., 3, 3) of `normalising_transform`."""
    return np.asarray(points * transform[..., 0, 0][..., None, None] + transform[..., None, :2, 2])


def unit_norm(matrix: Array) -> Array:
    """A matrix (..., r, c) that stands for its multiples, divided by its Frobenius norm."""
    return np.asarray(matrix / np.linalg.norm(matrix, axis=(-2, -1), keepdims=True))


def right_singular_vectors(matrix: Array) -> tuple[Array, Array]:
    """Singular values (..., min(m, k)), largest first, and all right singular vectors (..., k, k) of (..., m, k).

    NumPy's full decomposition would also make the m left ones of m entries each: gigabytes for some thousand points.
    """
    rows, columns = matrix.shape[-2:]
    _, values, axes = np.linalg.svd(matrix, full_matrices=rows < columns)
    return values, axes


def covariance_of_unit_norm(matrix: Array, linear_map: Array, covariance: Array) -> Array:
    """(9, 9) covariance of the unit-norm matrix L m, of the row-major vector m with covariance C: J L C L^T J^T.

    J = (I - u u^T) / |L m| with u = L m / |L m| takes out the scale, so the covariance has a null vector, u itself.
    """
    vector = linear_map @ matrix.ravel()
    norm = np.linalg.norm(vector)
    unit = vector / norm
    to_unit = (np.eye(vector.size) - np.outer(unit, unit)) @ linear_map / norm
    return np.asarray(to_unit @ covariance @ to_unit.T)
