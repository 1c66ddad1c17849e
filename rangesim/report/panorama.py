# SPDX-License-Identifier: Apache-2.0
"""Pictures of what scanners see: a panorama of azimuth and elevation, each of its pixels from the nearest ray.

The rows of a scanner's table are rings in the order in which they fire, or stretches of time, so the table itself
shows no scene. A panorama has azimuth from left to right and elevation upwards. If it is long, it is cut into strips,
one below the other.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rangesim.rig import Camera

WIDTH_PX = 1024
"""Number of columns of a panorama of a whole turn, as many as common LiDARs measure. With more columns, pictures are
larger and show nothing more."""
MAX_STRIP = 3.0
"""Largest ratio of width to height of a panorama; a longer one is cut into strips. With 3, a turn of 64 rings over 45
degrees becomes two strips of 512 pixels, as wide as other maps."""
MAX_GAP = 2.0
"""Largest distance of a picture's pixel from its ray, in mean distances of neighbouring rays. It fills the gaps between
rings that are up to 16 times farther apart than the columns; a larger one draws a broader margin around the field."""
GAP_PX = 2
"""Height of the empty stripe between two strips, pixels."""
FULL_TURN_RAD = np.radians(300.0)
"""Least range of azimuths, radians, that is shown as a whole turn, so that the pictures of scanners that leave out a
sector are comparable."""


class Panorama(NamedTuple):
    """The pixels of a picture of a camera's images.

    pixel : (h, w) int32, flat index of the camera's pixel that each pixel of the picture shows; -1 for none.
    """

    pixel: NDArray[np.int32]

    def picture(self, image: np.ndarray, nothing: float) -> np.ndarray:
        """An image (h, w) of the camera as a picture; its pixels without a ray have the value `nothing`."""
        return np.where(self.pixel >= 0, image.ravel()[self.pixel], np.asarray(nothing, dtype=image.dtype))


def panorama(camera: Camera) -> Panorama:
    """The panorama of a camera; for a pinhole and for lenses that make an image, the image itself.

    Examples
    --------
    >>> from rangesim.rig import Spinning
    >>> head = Spinning(elevations_deg=(-10.0, 10.0, 0.0), columns=90)
    >>> shown = panorama(head)
    >>> int(shown.pixel[1, 0]) // 90  # the ring at the top is the second of the table
    1
    """
    if camera.times_s is None:
        return Panorama(np.arange(camera.height * camera.width, dtype=np.int32).reshape(camera.height, camera.width))
    return of_directions(np.ascontiguousarray(camera.rays.directions))


def of_directions(directions: np.ndarray) -> Panorama:
    """The panorama of rays (h, w, 3), unit vectors, camera coordinates (x right, y down, z forward)."""
    return Panorama(_nearest(directions.tobytes(), directions.shape))


@lru_cache(maxsize=16)  # a page shows many images of each camera
def _nearest(directions: bytes, shape: tuple[int, ...]) -> NDArray[np.int32]:
    from scipy.spatial import cKDTree

    rays = np.frombuffer(directions).reshape(-1, 3)
    exists = np.flatnonzero(np.isfinite(rays).all(axis=1))
    x, y, z = rays[exists].T
    azimuth, elevation = np.arctan2(x, z), -np.arcsin(np.clip(y, -1, 1))
    left, right = float(azimuth.min()), float(azimuth.max())
    if right - left > FULL_TURN_RAD:
        left, right = -np.pi, np.pi
    low, high = float(elevation.min()), float(elevation.max())
    # Mean distance of neighbouring rays, if they were spread evenly over the field
    spacing = np.sqrt(max(right - left, 1e-6) * max(high - low, 1e-6) / len(exists))
    shown = 2 * np.pi if right - left > np.pi else right - left
    step = max(shown / WIDTH_PX, 1e-6)
    columns = max(1, round((right - left) / step))
    rows = int(np.clip(round((high - low + spacing) / step), 1, 4 * WIDTH_PX))
    middle = (low + high) / 2
    at = left + (np.arange(columns) + 0.5) * (right - left) / columns
    up = middle + (0.5 * (rows - 1) - np.arange(rows)) * step
    a, e = np.meshgrid(at, up)
    seen = np.stack([np.cos(e) * np.sin(a), -np.sin(e), np.cos(e) * np.cos(a)], axis=-1)
    distance, index = cKDTree(rays[exists]).query(seen.reshape(-1, 3), distance_upper_bound=MAX_GAP * spacing + step)
    found = np.isfinite(distance)
    pixel = np.full(len(found), -1, dtype=np.int32)
    pixel[found] = exists[index[found]]
    return _in_strips(pixel.reshape(rows, columns))


def _in_strips(pixel: NDArray[np.int32]) -> NDArray[np.int32]:
    """The picture, cut into strips below each other if it is longer than `MAX_STRIP` times its height."""
    strips = 1
    while pixel.shape[1] / strips > MAX_STRIP * pixel.shape[0] * strips:
        strips += 1
    padded = np.pad(pixel, ((0, 0), (0, -pixel.shape[1] % strips)), constant_values=-1)
    gap = np.full((GAP_PX, padded.shape[1] // strips), -1, dtype=np.int32)
    parts = [part for strip in np.split(padded, strips, axis=1) for part in (strip, gap)][:-1]
    return np.concatenate(parts)
