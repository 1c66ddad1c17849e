# SPDX-License-Identifier: Apache-2.0
"""Noise-free frames of the straight light paths to the true surface alone, without any other light."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rangesim.response import DenseResponse, LightPath, NumpyMath, SparseResponse
from rangesim.rig import Beam, Rig
from rangesim.sensor import Sensor
from rangesim.signals import GroundTruth

_CHUNK_VALUES = 32_000_000
"""Largest number of weights that are computed at once, so that they take at most 256 MB. It changes no result."""
FOOTPRINT_PATHS = 55
"""Number of light paths over the area of a pixel, on a Fibonacci lattice.

With 55 paths, stripes of a twentieth of a pixel are resolved, because the points of the lattice lie evenly along both
sides of the pixel and over its area. More paths take more time.
"""
FOOTPRINT_STEP = 34
"""Step of the lattice along the second side of the pixel, counted in lattice points.

It is the Fibonacci number before `FOOTPRINT_PATHS`, because two such numbers make the lattice even.
"""
TEXTURE_PATHS = 13
"""Number of light paths over the area of a pixel for sensors that compare texture.

Every pixel of every camera then needs its area. Dots are about as wide as a pixel, so fewer paths than
`FOOTPRINT_PATHS` suffice. With 55, `explain` takes three times as long, and no failed pixel of the tabletop gets
another cause.
"""
TEXTURE_STEP = 8
"""Step of the lattice with `TEXTURE_PATHS`, counted in lattice points: the Fibonacci number before it, see
`FOOTPRINT_STEP`."""


def single_path_frames(sensor: Sensor, rig: Rig, truth: GroundTruth) -> np.ndarray:
    """(k, h, w) float32, W/m2/sr, frames of the straight path to the true point of each pixel, with a radiance of 1.

    Where a reading of these frames is wrong, no other light is to blame: the distance is beyond the range of the
    sensor, or the sensor's resolution is too coarse. Pixels without a surface get no light.
    """
    where = np.isfinite(truth.z)
    channels = _no_light(sensor, where.shape)
    _add(channels, sensor, where, _straight_path(rig, truth, where))
    return sensor.frames(channels, where.astype(np.float32), np.zeros(where.shape, dtype=np.float32))


def footprint_frames(sensor: Sensor, rig: Rig, truth: GroundTruth, spread: np.ndarray) -> np.ndarray:
    """(k, h, w) float32, W/m2/sr, frames of straight paths that cover the whole area of some pixels.

    In the pixels `spread`, the frames are the mean over `FOOTPRINT_PATHS` (or `TEXTURE_PATHS`) straight paths to the
    tangent plane of the surface. In the other pixels they are as in `single_path_frames`. Where a reading of these
    frames is wrong, the pixel is too coarse for the pattern, or covers too many distances of its one surface. Where
    such a reading is correct, the inclination of the surface alone does no harm.

    Parameters
    ----------
    spread : (h, w) bool, pixels that have a surface.
    """
    where = np.isfinite(truth.z)
    channels, alone = _no_light(sensor, where.shape), where & ~spread
    _add(channels, sensor, alone, _straight_path(rig, truth, alone))
    paths, step = (TEXTURE_PATHS, TEXTURE_STEP) if sensor.compares_texture else (FOOTPRINT_PATHS, FOOTPRINT_STEP)
    path_beside = _paths_beside(rig, truth, spread)
    for n in range(paths):
        offset = (n + 0.5) * np.array([1, step]) / paths % 1.0 - 0.5
        _add(channels, sensor, spread, path_beside(offset), 1 / paths)
    return sensor.frames(channels, where.astype(np.float32), np.zeros(where.shape, dtype=np.float32))


def _no_light(sensor: Sensor, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Channels (c, h, w) of each response of a sensor, all 0; shape : h and w."""
    return [np.zeros((response.channels, *shape), dtype=np.float32) for response in sensor.responses()]


def _add(
    channels: Sequence[np.ndarray], sensor: Sensor, where: np.ndarray, path: LightPath, radiance: float = 1.0
) -> None:
    """Add one light path per pixel to the channels of the sensor's responses.

    channels : one (c, h, w) float32 per response; they are changed.
    where : (h, w) bool, the n pixels.
    path : LightPath of n paths.
    """
    pixels = np.flatnonzero(where)
    for response, image in zip(sensor.responses(), channels, strict=True):
        values = image.reshape(response.channels, -1)
        step = max(1, _CHUNK_VALUES // response.channels)
        for begin in range(0, len(pixels), step):
            part = slice(begin, begin + step)
            some = LightPath(path.u[None, part], path.v[None, part], path.path_length_m[None, part], True)
            if isinstance(response, SparseResponse):
                _add_bins(values, pixels[part], response, some, radiance)
            else:
                assert isinstance(response, DenseResponse)
                for row, weight in zip(values, response.weights(some, NumpyMath()), strict=True):
                    row[pixels[part]] += radiance * np.asarray(np.broadcast_to(weight, some.u.shape)[0], np.float32)


def _add_bins(
    values: np.ndarray, pixels: np.ndarray, response: SparseResponse, path: LightPath, radiance: float
) -> None:
    """Add light paths to the bins of a response.

    values : (c, h * w) float32; they are changed. pixels : (n,) int, index of each path's pixel. path : (1, n) paths.
    """
    for index, weight in response.bin_weights(path, NumpyMath()):
        index, weight = (np.broadcast_to(x, path.u.shape)[0] for x in (index, weight))
        inside = index < response.channels
        values[index[inside].astype(np.intp), pixels[inside]] += radiance * weight[inside]


def points_in_projector(rig: Rig, reading: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(n, 3) float64 points at these readings (h, w) of the n pixels `where`, in projector coordinates, metres.

    Coordinates of a beam are those of the camera, from the emitter of each ray.
    """
    origins, directions = rig.camera.rays_at(where)
    points = origins + directions * reading[where].astype(np.float64)[:, None]
    return _to_projector(rig, where, origins)(points)


def _to_projector(rig: Rig, where: np.ndarray, origins: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Function from points (n, 3) in camera coordinates to those in projector coordinates, metres.

    where : (h, w) bool, the n pixels of the points. origins : (n, 3), origins of the rays through their centres.
    """
    if isinstance(rig.projector, Beam):
        emitters = rig.emitter_offsets[where]
        return lambda points: np.asarray(points - origins - emitters)
    return lambda points: np.asarray((points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3])


def _straight_path(rig: Rig, truth: GroundTruth, where: np.ndarray) -> LightPath:
    """Direct path to the true point of each of the n pixels `where`; a point outside the projector's image is clamped
    to the nearest place in it."""
    return _path(rig, points_in_projector(rig, rig.camera.reading(truth), where), truth.range_m[where])


def _paths_beside(rig: Rig, truth: GroundTruth, where: np.ndarray) -> Callable[[np.ndarray], LightPath]:
    """Function from offsets (2,), pixels, to light paths as in `_straight_path`, but to the tangent planes, and so far
    beside the centres."""
    planes, rays_beside = TangentPlanes(rig, truth, where), rig.camera.rays_beside(where)
    to_projector = _to_projector(rig, where, planes.origins)

    def path(offset: np.ndarray) -> LightPath:
        origins, rays = rays_beside(offset)
        readings = planes.readings(origins, rays)
        along = rays * np.where(np.isfinite(readings), readings, planes.at_centres)[:, None]
        return _path(rig, to_projector(origins + along), np.linalg.norm(along, axis=-1))

    return path


class TangentPlanes:
    """Tangent planes of the surfaces at the centres of n pixels.

    Parameters
    ----------
    where : (h, w) bool, the n pixels.

    Attributes
    ----------
    origins : (n, 3) float64, metres, camera coordinates, origins of the rays through the centres.
    at_centres : (n,) float32, metres, readings along these rays.
    """

    def __init__(self, rig: Rig, truth: GroundTruth, where: np.ndarray) -> None:
        self.origins, rays = rig.camera.rays_at(where)
        self.at_centres = rig.camera.reading(truth)[where]
        self._normals = truth.normal[where].astype(np.float64) @ rig.T_world_camera[:3, :3]
        self._heights = self.at_centres * np.sum(self._normals * rays, axis=-1)

    def readings(self, origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """(n,) float64 readings, in metres, where rays meet the planes; NaN behind the camera, or where they never do.

        origins, rays : (n, 3) float, camera coordinates, as `Camera.rays_at` returns them.
        """
        approach = np.sum(self._normals * rays, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            result = self._heights / approach + np.sum(self._normals * (self.origins - origins), axis=-1) / approach
        return np.where(np.isfinite(result) & (result > 0), result, np.nan)


def _path(rig: Rig, point: np.ndarray, range_m: np.ndarray) -> LightPath:
    """Light paths to points (n, 3), metres, in projector coordinates, at distances `range_m` (n,) from the camera."""
    if isinstance(rig.projector, Beam):
        middle = np.full(len(point), 0.5)
        return LightPath(middle, middle, range_m + np.linalg.norm(point, axis=-1), True)
    uv = np.nan_to_num(rig.image_projector.project(point))
    u, v = np.clip(uv[:, 0], 0, rig.projector.width), np.clip(uv[:, 1], 0, rig.projector.height)
    return LightPath(u, v, range_m + np.linalg.norm(point, axis=-1), True)
