# SPDX-License-Identifier: Apache-2.0
"""The pixels around a pixel: those beside it in an image, or the rays nearest to a scanner's ray.

The rows of a scanner's table are rings in the order in which they fire, whose beams lead or follow the head, or
stretches of time. So pixels beside each other in the table may look elsewhere.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rangesim.rig import Camera

REACH = 1.5
"""Largest distance of the nearest rays that count as beside a ray, in distances to the very nearest one, unless the
field of the ray is larger. It takes in the rays on both sides where spacing is uneven, and leaves out the next ones."""


class Neighbourhood(ABC):
    """The pixels around each pixel of an image (h, w)."""

    @abstractmethod
    def shifted(self, values: np.ndarray, radius: int) -> list[np.ndarray]:
        """Arrays (h, w) of the values of a pixel's surroundings: one array for each of (2 radius + 1)^2 places, the
        pixel itself among them. A place that does not exist repeats another one."""

    @abstractmethod
    def around(self, where: NDArray[np.bool_], radius: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns (n, (2 radius + 1)^2) of the pixels around the n pixels of a mask (h, w)."""


class ImageNeighbourhood(Neighbourhood):
    """Windows of an image. Beyond the border, the border's pixels are repeated.

    Examples
    --------
    >>> ImageNeighbourhood().shifted(np.array([[1, 2, 3]]), 1)[3]  # each pixel's left neighbour
    array([[1, 1, 2]])
    """

    def shifted(self, values: np.ndarray, radius: int) -> list[np.ndarray]:
        padded = np.pad(values, radius, mode="edge")
        h, w = values.shape
        size = 2 * radius + 1
        return [padded[y : y + h, x : x + w] for y in range(size) for x in range(size)]

    def around(self, where: NDArray[np.bool_], radius: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        rows, columns = np.nonzero(where)
        steps = np.arange(-radius, radius + 1)
        y, x = (steps.ravel() for steps in np.meshgrid(steps, steps, indexing="ij"))
        h, w = where.shape
        return np.clip(rows[:, None] + y, 0, h - 1), np.clip(columns[:, None] + x, 0, w - 1)


class RayNeighbourhood(Neighbourhood):
    """The rays nearest in direction to each ray of a scanner, within `REACH` or within the ray's field.

    camera : Camera whose rays are meant.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.shape = camera.height, camera.width

    def _nearest(self, radius: int) -> NDArray[np.intp]:
        return _nearest_rays(self.camera, radius)

    def shifted(self, values: np.ndarray, radius: int) -> list[np.ndarray]:
        return [values.ravel()[one].reshape(self.shape) for one in self._nearest(radius).T]

    def around(self, where: NDArray[np.bool_], radius: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        rows, columns = np.unravel_index(self._nearest(radius)[where.ravel()], self.shape)
        return rows, columns


IMAGE = ImageNeighbourhood()
"""The neighbourhood of cameras that make an image."""


def neighbourhood(camera: Camera | None) -> Neighbourhood:
    """The neighbourhood of a camera's pixels; None: of an uncalibrated image.

    Examples
    --------
    >>> from rangesim.rig import Spinning
    >>> head = Spinning((0.0, 0.1), columns=3600, azimuth_offsets_deg=(1.0, 0.0))
    >>> rows, columns = neighbourhood(head).around(np.arange(7200).reshape(2, 3600) == 100, 1)
    >>> sorted(set(zip(rows[0].tolist(), columns[0].tolist())))  # the other ring sees the same 10 columns later
    [(0, 99), (0, 100), (0, 101), (1, 109), (1, 110), (1, 111)]
    """
    return IMAGE if camera is None or camera.times_s is None else RayNeighbourhood(camera)


@lru_cache(maxsize=8)  # a report asks for each camera many times
def _nearest_rays(camera: Camera, radius: int) -> NDArray[np.intp]:
    """(h w, (2 radius + 1)^2) flat indices of the rays nearest to each ray; of itself, where there is none."""
    from scipy.spatial import cKDTree

    rays = camera.rays
    directions = rays.directions.reshape(-1, 3)
    field = np.nanmax(np.linalg.norm(rays.steps, axis=-1), axis=-1).reshape(-1, 1)
    count = min((2 * radius + 1) ** 2, len(directions))
    distance, index = cKDTree(directions).query(directions, count)
    distance, index = distance.reshape(-1, count), index.reshape(-1, count)
    own = np.arange(len(directions))[:, None]
    apart = np.where(distance > 0, distance, np.inf).min(axis=1, keepdims=True)  # two rays may be the same
    reach = radius * np.maximum(np.where(np.isfinite(apart), REACH * apart, 0.0), field)
    index = np.where(distance <= reach, index, own)
    return index.astype(np.intp)
