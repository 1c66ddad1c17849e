# SPDX-License-Identifier: Apache-2.0
"""Frames of other light than a sensor got: its signals without noise, and one light path alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rangesim.response import DenseResponse, LightPath, NumpyMath, Response, SparseResponse
from rangesim.rig import Rig
from rangesim.sensor import Sensor
from rangesim.signals import GroundTruth

if TYPE_CHECKING:
    from rangesim.signals import Signals

_CHUNK_VALUES = 32_000_000


def clean_frames(signals: Signals, sensor: Sensor) -> np.ndarray:
    """(k, h, w) float32, W/m2/sr: frames of all light of the projector, without noise and ambient light."""
    return signals.frames(sensor, ambient_transmission=0.0)


def single_path_frames(sensor: Sensor, rig: Rig, truth: GroundTruth) -> np.ndarray:
    """(k, h, w) float32: frames of the straight path to the true point of each pixel, alone, with a radiance of 1.

    Where a reading of these is wrong, no light but that which belongs to the surface was needed to make it so: the
    distance is beyond what the sensor can measure, or finer than it can tell. No light where there is no surface.
    """
    where = np.isfinite(truth.z)
    path = _straight_path(rig, truth, where)
    channels = []
    for response in sensor.responses():
        image = np.zeros((response.channels, *where.shape), dtype=np.float32)
        values, pixels = image.reshape(response.channels, -1), np.flatnonzero(where)
        step = max(1, _CHUNK_VALUES // response.channels)
        for begin in range(0, len(pixels), step):
            part = slice(begin, begin + step)
            some = LightPath(path.u[None, part], path.v[None, part], path.path_length_m[None, part], True)
            values[:, pixels[part]] = _weights(response, some)[:, 0]
        channels.append(image)
    return sensor.frames(channels, where.astype(np.float32), np.zeros(where.shape, dtype=np.float32))


def points_in_projector(rig: Rig, z: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(n, 3) float64, metres: surface points at depths z (h, w) of the n pixels `where`, in projector coordinates."""
    points = rig.camera.directions(rig.camera.pixel_centres()[where]) * z[where].astype(np.float64)[:, None]
    return np.asarray((points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3])


def _straight_path(rig: Rig, truth: GroundTruth, where: np.ndarray) -> LightPath:
    """The direct path of each pixel; where the projector does not see, through the nearest place of its image."""
    point = points_in_projector(rig, truth.z, where)
    uv = np.nan_to_num(rig.projector.project(point))
    u, v = np.clip(uv[:, 0], 0, rig.projector.width), np.clip(uv[:, 1], 0, rig.projector.height)
    return LightPath(u, v, truth.range_m[where] + np.linalg.norm(point, axis=-1), True)


def _weights(response: Response, path: LightPath) -> np.ndarray:
    if isinstance(response, SparseResponse):
        result = np.zeros((response.channels + 1, *path.u.shape), dtype=np.float32)
        for index, weight in response.bin_weights(path, NumpyMath()):
            bins = np.minimum(np.asarray(index), response.channels).astype(np.intp)[None]
            np.put_along_axis(result, bins, np.take_along_axis(result, bins, axis=0) + weight, axis=0)
        return result[:-1]
    assert isinstance(response, DenseResponse)
    shape = path.u.shape
    return np.stack([np.broadcast_to(w, shape) for w in response.weights(path, NumpyMath())]).astype(np.float32)
