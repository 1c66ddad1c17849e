# SPDX-License-Identifier: Apache-2.0
"""Frames of other light than a sensor received: of straight paths to the true surface alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangesim.response import DenseResponse, LightPath, NumpyMath, SparseResponse
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.signals import GroundTruth

_CHUNK_VALUES = 32_000_000
FOOTPRINT_PATHS = 55
"""Number of light paths over the area of a pixel, on a Fibonacci lattice: even along both sides, hence fine enough for
stripes of a twentieth of the pixel, and over its area."""
FOOTPRINT_STEP = 34
"""Step of the lattice along the second side, the Fibonacci number before."""


def single_path_frames(sensor: Sensor, rig: Rig, truth: GroundTruth) -> np.ndarray:
    """(k, h, w) float32: frames of the straight path to the true point of each pixel, alone, with a radiance of 1.

    Where a reading of these is wrong, no light but that which belongs to the surface was needed to make it so: the
    distance is beyond what the sensor can measure, or finer than it can tell. No light where there is no surface.
    """
    where = np.isfinite(truth.z)
    channels = _no_light(sensor, where.shape)
    _add(channels, sensor, where, _straight_path(rig, truth, where))
    return sensor.frames(channels, where.astype(np.float32), np.zeros(where.shape, dtype=np.float32))


def footprint_frames(sensor: Sensor, rig: Rig, truth: GroundTruth, spread: np.ndarray) -> np.ndarray:
    """Frames as of `single_path_frames`, but in the pixels `spread` (h, w) bool, which have a surface, the mean of
    straight paths to all over the pixel's area, on the plane that touches the surface in the true point.

    Where a reading of these is wrong, the pixel is too coarse for the pattern, or mixes too many distances of its one
    surface. Where it is right, an inclined surface alone does no harm.
    """
    where = np.isfinite(truth.z)
    channels, alone = _no_light(sensor, where.shape), where & ~spread
    _add(channels, sensor, alone, _straight_path(rig, truth, alone))
    for n in range(FOOTPRINT_PATHS):
        offset = (n + 0.5) * np.array([1, FOOTPRINT_STEP]) / FOOTPRINT_PATHS % 1.0 - 0.5
        _add(channels, sensor, spread, _path_beside(rig, truth, spread, offset), 1 / FOOTPRINT_PATHS)
    return sensor.frames(channels, where.astype(np.float32), np.zeros(where.shape, dtype=np.float32))


def _no_light(sensor: Sensor, shape: tuple[int, ...]) -> list[np.ndarray]:
    return [np.zeros((response.channels, *shape), dtype=np.float32) for response in sensor.responses()]


def _add(
    channels: Sequence[np.ndarray], sensor: Sensor, where: np.ndarray, path: LightPath, radiance: float = 1.0
) -> None:
    """Add a light path to each of the n pixels `where` (h, w) bool to the channels of the sensor's responses."""
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
    """Add the bins of a light path (1, n) to values (channels, h w) at n pixels."""
    for index, weight in response.bin_weights(path, NumpyMath()):
        index, weight = (np.broadcast_to(x, path.u.shape)[0] for x in (index, weight))
        inside = index < response.channels
        values[index[inside].astype(np.intp), pixels[inside]] += radiance * weight[inside]


def points_in_projector(rig: Rig, z: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(n, 3) float64, metres: surface points at depths z (h, w) of the n pixels `where`, in projector coordinates."""
    points = rig.camera.directions(rig.camera.pixel_centres()[where]) * z[where].astype(np.float64)[:, None]
    return np.asarray((points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3])


def _straight_path(rig: Rig, truth: GroundTruth, where: np.ndarray) -> LightPath:
    """The direct path of each pixel; where the projector does not see, through the nearest place of its image."""
    return _path(rig, points_in_projector(rig, truth.z, where), truth.range_m[where])


def _path_beside(rig: Rig, truth: GroundTruth, where: np.ndarray, offset: np.ndarray) -> LightPath:
    """Light paths as of `_straight_path`, but `offset` (2,) pixels beside the centres, on the tangent planes."""
    ray = rig.camera.directions(rig.camera.pixel_centres()[where] + offset)
    depth = depth_on_plane(rig, truth, where, ray)
    points = ray * np.where(np.isfinite(depth), depth, truth.z[where])[:, None]
    in_projector = (points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3]
    return _path(rig, in_projector, np.linalg.norm(points, axis=-1))


def depth_on_plane(rig: Rig, truth: GroundTruth, where: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """(n,) float64, metres: depth at which rays (n, 3) with z = 1 meet the planes that touch the surfaces of the n
    pixels `where`; NaN where they do so behind the camera, or never."""
    normal = truth.normal[where].astype(np.float64) @ rig.T_world_camera[:3, :3]
    centre = rig.camera.directions(rig.camera.pixel_centres()[where])
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = truth.z[where] * np.sum(normal * centre, axis=-1) / np.sum(normal * ray, axis=-1)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def _path(rig: Rig, point: np.ndarray, range_m: np.ndarray) -> LightPath:
    """Light paths by points (n, 3) in projector coordinates, `range_m` (n,) from the camera; metres."""
    uv = np.nan_to_num(rig.projector.project(point))
    u, v = np.clip(uv[:, 0], 0, rig.projector.width), np.clip(uv[:, 1], 0, rig.projector.height)
    return LightPath(u, v, range_m + np.linalg.norm(point, axis=-1), True)
