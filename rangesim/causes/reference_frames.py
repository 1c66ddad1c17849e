# SPDX-License-Identifier: Apache-2.0
"""Noise-free frames of the straight light paths to the true surface alone, without any other light."""

from __future__ import annotations

from collections.abc import Sequence

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
TEXTURE_PATHS, TEXTURE_STEP = 13, 8
"""The same two numbers for sensors that compare texture, where every pixel of every camera needs its area.

Dots are about as wide as a pixel, so fewer paths suffice. With 55, `explain` takes three times as long, and no failed
pixel of the tabletop gets another cause.
"""


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
    for n in range(paths):
        offset = (n + 0.5) * np.array([1, step]) / paths % 1.0 - 0.5
        _add(channels, sensor, spread, _path_beside(rig, truth, spread, offset), 1 / paths)
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
    return _in_projector(rig, where, origins + directions * reading[where].astype(np.float64)[:, None])


def _in_projector(rig: Rig, where: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the n pixels `where`, from camera coordinates to projector coordinates, metres."""
    if isinstance(rig.projector, Beam):
        return np.asarray(points - rig.camera.rays_at(where)[0] - rig.emitter_offsets[where])
    return np.asarray((points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3])


def _straight_path(rig: Rig, truth: GroundTruth, where: np.ndarray) -> LightPath:
    """Direct path to the true point of each of the n pixels `where`; a point outside the projector's image is clamped
    to the nearest place in it."""
    return _path(rig, points_in_projector(rig, rig.camera.reading(truth), where), truth.range_m[where])


def _path_beside(rig: Rig, truth: GroundTruth, where: np.ndarray, offset: np.ndarray) -> LightPath:
    """Light paths as in `_straight_path`, but to the tangent planes, `offset` (2,) pixels beside the centres."""
    origin, ray = rig.camera.rays_at(where, offset)
    depth = depth_on_plane(rig, truth, where, origin, ray)
    along = ray * np.where(np.isfinite(depth), depth, rig.camera.reading(truth)[where])[:, None]
    return _path(rig, _in_projector(rig, where, origin + along), np.linalg.norm(along, axis=-1))


def depth_on_plane(rig: Rig, truth: GroundTruth, where: np.ndarray, origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """(n,) float64 readings, in metres, where rays meet the tangent planes of the surfaces of n pixels.

    A reading is NaN where a ray meets its plane behind the camera, or not at all.

    Parameters
    ----------
    where : (h, w) bool, the n pixels.
    origin, ray : (n, 3) float, camera coordinates, as `Camera.rays_at` returns them.
    """
    normal = truth.normal[where].astype(np.float64) @ rig.T_world_camera[:3, :3]
    start, centre = rig.camera.rays_at(where)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = rig.camera.reading(truth)[where] * np.sum(normal * centre, axis=-1) / np.sum(normal * ray, axis=-1)
        if not rig.camera.is_pinhole:
            depth = depth + np.sum(normal * (start - origin), axis=-1) / np.sum(normal * ray, axis=-1)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def _path(rig: Rig, point: np.ndarray, range_m: np.ndarray) -> LightPath:
    """Light paths to points (n, 3), metres, in projector coordinates, at distances `range_m` (n,) from the camera."""
    if isinstance(rig.projector, Beam):
        middle = np.full(len(point), 0.5)
        return LightPath(middle, middle, range_m + np.linalg.norm(point, axis=-1), True)
    uv = np.nan_to_num(rig.image_projector.project(point))
    u, v = np.clip(uv[:, 0], 0, rig.projector.width), np.clip(uv[:, 1], 0, rig.projector.height)
    return LightPath(u, v, range_m + np.linalg.norm(point, axis=-1), True)
