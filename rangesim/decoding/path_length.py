# SPDX-License-Identifier: Apache-2.0
"""Path lengths to ranges, for an emitter at any pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rangesim.decoding.coordinates import Coordinates
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.returns import Returns
from rangesim.decoding.row_bands import bands
from rangesim.decoding.status import Status
from rangesim.rig import Intrinsics, Rig


def range_from_path_length(length_m: np.ndarray, directions: np.ndarray, rig: Rig) -> np.ndarray:
    """(...) float64, ranges in metres along camera rays at which the path emitter -> point -> camera has this length.

    With the unit ray d and the emitter's centre b (camera coordinates) the length is l = r + |r d - b|. Squaring (l -
    r)^2 = r^2 - 2 r d.b + b^2 leaves a linear equation: r = (l^2 - b^2) / (2 (l - d.b)). There the ray meets the
    ellipsoid with foci at camera and emitter. The range is NaN where the length is not larger than the baseline |b|:
    then no such point exists.

    Parameters
    ----------
    length_m : (...) float, metres, there and back.
    directions : (..., 3) float, camera rays of any length, camera coordinates.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig import Intrinsics, Rig, translation
    >>> device = Intrinsics(640, 480, 800, 800, 320, 240)
    >>> rig = Rig(device, device, np.eye(4), translation(0.6, 0, 0))  # the emitter stands 0.6 m to the right
    >>> range_from_path_length(np.array([1.8, 0.5]), np.array([[0.0, 0.0, 1.0]]), rig)  # 0.8 m there, 1 m back
    array([0.8, nan])
    """
    b = rig.T_camera_projector[:3, 3]
    d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    length = np.asarray(length_m, dtype=np.float64)
    return _on_ellipsoid(length, b @ b, d @ b)


def range_along_ray(length_m: np.ndarray, directions: np.ndarray, emitters: np.ndarray) -> np.ndarray:
    """(...) float64, as `range_from_path_length`, for rays whose emitters stand at other places beside them.

    Parameters
    ----------
    length_m : (...) float, metres, there and back.
    directions : (..., 3) float, unit vectors, camera coordinates.
    emitters : (..., 3) float, metres, from the origin of each ray to its emitter, camera coordinates.
    """
    return _on_ellipsoid(length_m, np.sum(emitters**2, axis=-1), np.sum(directions * emitters, axis=-1))


def _on_ellipsoid(length_m: np.ndarray, b2: np.ndarray, along: np.ndarray) -> np.ndarray:
    """(...) float64, the ranges of `range_from_path_length`; `b2` is |b|^2 in square metres, `along` d.b in metres."""
    with np.errstate(invalid="ignore", divide="ignore"):
        result = (length_m**2 - b2) / (2 * (length_m - along))
        return np.asarray(np.where(length_m > np.sqrt(b2), result, np.nan))


def range_slope(length_m: np.ndarray, directions: np.ndarray, emitters: np.ndarray) -> np.ndarray:
    """(...) float64, derivative of `range_along_ray` by the length; 1/2 without a baseline.

    Examples
    --------
    >>> range_slope(np.array([1.8]), np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)))
    array([0.5])
    """
    length, along = np.asarray(length_m, dtype=np.float64), np.sum(directions * emitters, axis=-1)
    b2 = np.sum(emitters**2, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((length**2 - 2 * length * along + b2) / (2 * (length - along) ** 2))


class LengthReturns(NamedTuple):
    """All returns of each pixel, before any geometry; (k, h, w) each, nearest first.

    length_m : float64, metres, path length there and back; NaN where there is none.
    sigma_m : float64, metres, its standard deviation by the noise of the frames; NaN where not known.
    strength : float64, counts of the pulse. status : uint8, values of `Status`.
    """

    length_m: np.ndarray
    sigma_m: np.ndarray
    strength: np.ndarray
    status: np.ndarray

    def ranges(self, rig: Rig | None) -> Returns:
        """The returns as ranges from the camera; without a rig, half of the lengths."""
        range_m, sigma_m = np.empty((2, *self.length_m.shape), dtype=np.float32)
        status = self.status.astype(np.uint8)
        for rows in bands(self.length_m.shape[1]):
            length = self.length_m[:, rows]
            along_ray, slope = length / 2, np.full(length.shape, 0.5)
            if rig is not None:
                directions, emitters = rig.camera.rays.directions[rows], rig.emitter_offsets[rows]
                along_ray = range_along_ray(length, directions, emitters)
                slope = range_slope(length, directions, emitters)
            is_behind = ~(np.nan_to_num(along_ray, nan=-1.0) > 0)
            status[:, rows][is_behind & (status[:, rows] == Status.OK)] = Status.OUT_OF_RANGE
            range_m[:, rows] = np.where(is_behind, np.nan, along_ray)
            sigma_m[:, rows] = np.where(is_behind, np.nan, slope * self.sigma_m[:, rows])
        return Returns(range_m, self.strength.astype(np.float32), sigma_m, status)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class PathLengths(Coordinates):
    """Path lengths of a time-of-flight capture, from the emitter to the surface and back to the camera.

    Parameters
    ----------
    length_m : (h, w) float64, metres; NaN where `status` is not OK.
    sigma_m : (h, w) float32, metres, standard deviation of `length_m` that the noise of the frames causes; NaN where
        `status` is not OK. None: not known, as for noise-free captures and unknown detectors.
    returns : LengthReturns, all returns of each pixel, of which `length_m` is one; None: they were not looked for.
    doubts : sentences with which the decoder has warned that the capture contradicts itself.

    Examples
    --------
    >>> import numpy as np
    >>> one = np.ones((1, 2))
    >>> lengths = PathLengths(length_m=np.array([[3.0, 9.0]]), status=np.array([[0, 1]]), confidence=one, intensity=one)
    >>> lengths.length_m
    array([[ 3., nan]])
    >>> lengths.range_image(None).range_m  # without a rig, half of the length
    array([[1.5, nan]], dtype=float32)
    """

    length_m: np.ndarray
    sigma_m: np.ndarray | None = None
    returns: LengthReturns | None = None
    doubts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        self._keep_valid("length_m", np.float64)
        self._keep_valid("sigma_m", np.float32)

    def spread(self, where: np.ndarray) -> PathLengths:
        """Path lengths of an image, see `Coordinates.spread`, without `returns`."""
        return super(PathLengths, replace(self, returns=None)).spread(where)

    def range_image(self, rig: Rig | None) -> RangeImage:
        """Range image of these path lengths.

        Lengths that lead to no point in front of the camera are `OUT_OF_RANGE`.

        Parameters
        ----------
        rig : Rig that took the capture; None: the range is half of the path length, and z is NaN everywhere.
        """
        status = self.status.copy()
        z_m, range_m = np.empty((2, *status.shape), dtype=np.float32)
        for rows in bands(len(status)):
            if rig is None:
                along_ray = self.length_m[rows] / 2
                z = np.full(along_ray.shape, np.nan)
            else:
                along_ray, z = _ranges(self.length_m[rows], rows, rig)
            in_front = np.nan_to_num(along_ray, nan=-1.0) > 0
            status[rows][(status[rows] == Status.OK) & ~in_front] = Status.OUT_OF_RANGE
            ok = status[rows] == Status.OK
            z_m[rows], range_m[rows] = np.where(ok, z, np.nan), np.where(ok, along_ray, np.nan)
        image = replace(self._image(rig, z_m, range_m, status), doubts=self.doubts)
        return image if self.returns is None else replace(image, returns=self.returns.ranges(rig))


def _ranges(length_m: np.ndarray, rows: slice, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (rows, w) float64, metres, along the rays of some rows, from their path lengths; and their depths z."""
    if isinstance(rig.camera, Intrinsics):
        directions, b = rig.camera.directions(rig.camera.pixel_centres(rows)), rig.T_camera_projector[:3, 3]
        per_z = np.linalg.norm(directions, axis=-1)
        along_ray = _on_ellipsoid(length_m, b @ b, directions / per_z[..., None] @ b)
        return along_ray, along_ray / per_z
    along_ray = range_along_ray(length_m, rig.camera.rays.directions[rows], rig.emitter_offsets[rows])
    return along_ray, rig.camera.z_of(along_ray, rows)
