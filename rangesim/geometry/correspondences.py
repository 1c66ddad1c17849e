# SPDX-License-Identifier: Apache-2.0
"""Checks of input arrays, and normalised coordinates in which linear equations of points are well conditioned.

Points are pixel coordinates with pixel centres at integer + 0.5, as everywhere in rangesim. This convention does not
matter in this package as long as points and calibration matrices use the same one; only images depend on it (`stereo`).

Used by: every other module of rangesim.geometry except camera_projector; every module of rangesim.multiview;
rangesim.calibration.bundle, rendered, rig_calibration, suspects, time_of_flight and zhang.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.settings.config import shown

Array = NDArray[np.floating[Any]]
"""An array of floating-point numbers, float64 unless a docstring says otherwise."""

ROUNDING = 1e-9
"""Ratio below which a number counts as rounding: a singular value relative to the largest one, or a residual relative
to the spread of the points. Solving can lose about half of the 16 digits of double precision, and the noise of measured
pixels is far larger than 1e-9 of an image. A larger value refuses sound data; a smaller one lets degenerate exact data
pass."""


def checked_array(name: str, value: ArrayLike, *shape: int | None) -> Array:
    """`value` as a float64 array of finite numbers, whose last dimensions are `shape`; None stands for any length.

    Raises
    ------
    ValueError
        `value` is not an array of numbers, has another shape, or holds NaN or infinity.

    Examples
    --------
    >>> checked_array("points", [[1, 2], [3, 4]], None, 2)
    array([[1., 2.],
           [3., 4.]])
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
    """Both arrays of corresponding points as (n, 2) float64, after a check of their shapes and their number.

    Raises
    ------
    ValueError
        The arrays are not finite or do not correspond, or an image has fewer than `least` different points. The message
        names the `purpose` that needs them.
    """
    a, b = checked_array("first", first, None, 2), checked_array("second", second, None, 2)
    if a.ndim != 2 or a.shape != b.shape:
        raise ValueError(f"expected first and second as corresponding points (n, 2), got {a.shape} and {b.shape}.")
    for name, points in (("first", a), ("second", b)):
        check_distinct(name, points, least, purpose)
    return a, b


def check_distinct(name: str, points: Array, least: int, purpose: str) -> None:
    """Raise ValueError unless at least `least` of the points (n, d) differ from each other."""
    if len(points) < least:
        raise ValueError(f"expected at least {least} points for {purpose}, got {len(points)} in {name}.")
    different = len(np.unique(points, axis=0))
    if different < least:
        raise ValueError(
            f"expected at least {least} different points for {purpose}, got {different} different ones among "
            f"{len(points)} in {name}; repeated points add nothing."
        )


def check_noise(noise_px: float | None) -> None:
    """Raise ValueError unless the standard deviation of a coordinate is positive, or None, which means unknown."""
    if noise_px is not None and not (np.isfinite(noise_px) and noise_px > 0):
        raise ValueError(
            f"expected noise_px, the standard deviation of a coordinate, to be positive, got {noise_px!r}."
        )


def normalising_transform(points: Array) -> Array:
    """(..., 3, 3) float64 similarity after which points (..., n, 2) have centroid 0 and mean distance sqrt(2) from it.

    In these coordinates the entries of the design matrices of homographies and fundamental matrices have similar sizes,
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
    """(..., n, 2) images of points under a transform (..., 3, 3) that `normalising_transform` returned."""
    return np.asarray(points * transform[..., 0, 0][..., None, None] + transform[..., None, :2, 2])


def unit_norm(matrix: Array) -> Array:
    """Matrices (..., r, c) divided by their Frobenius norm; for matrices whose scale has no meaning."""
    return np.asarray(matrix / np.linalg.norm(matrix, axis=(-2, -1), keepdims=True))


def right_singular_vectors(matrix: Array) -> tuple[Array, Array]:
    """Singular values (..., min(m, k)), largest first, and all right singular vectors (..., k, k) of (..., m, k).

    The full decomposition of NumPy would also compute the m left singular vectors with m entries each, which takes
    gigabytes for some thousand points.
    """
    rows, columns = matrix.shape[-2:]
    _, values, axes = np.linalg.svd(matrix, full_matrices=rows < columns)
    return values, axes


def covariance_of_unit_norm(matrix: Array, linear_map: Array, covariance: Array) -> Array:
    """(9, 9) float64 covariance of L m / |L m|, the linear image of a matrix scaled to unit norm.

    m is the row-major vector of the matrix (3, 3), L the linear map (9, 9) and C the covariance (9, 9) of m. The result
    is J L C L^T J^T, where J = (I - u u^T) / |L m| with u = L m / |L m| removes the scale. So u is a null vector of
    this covariance.
    """
    vector = linear_map @ matrix.ravel()
    norm = np.linalg.norm(vector)
    unit = vector / norm
    to_unit = (np.eye(vector.size) - np.outer(unit, unit)) @ linear_map / norm
    return np.asarray(to_unit @ covariance @ to_unit.T)
