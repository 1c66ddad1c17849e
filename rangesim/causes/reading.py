# SPDX-License-Identifier: Apache-2.0
"""What a sensor would read of other light than it got: of its signals without noise, and of one light path alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding import decode
from rangesim.decoding.path_length import range_from_path_length
from rangesim.response import DenseResponse, LightPath, NumpyMath, Response, SparseResponse
from rangesim.rig import Rig
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, Sensor
from rangesim.signals import GroundTruth

if TYPE_CHECKING:
    from rangesim.signals import Signals

_CHUNK_VALUES = 32_000_000


def clean_depth(signals: Signals, sensor: Sensor, where: np.ndarray) -> np.ndarray:
    """(n,) float64, metres: z read of the n pixels `where` (h, w) without noise and ambient light; NaN for none."""
    if all(r in signals.channels for r in sensor.responses()):
        light = signals.energy.projector[where][None]
        channels = [signals.channels[r][:, where][:, None] for r in sensor.responses()]
        frames = sensor.frames(channels, light, np.zeros_like(light))[:, 0]
    else:  # put together from several passes
        frames = signals.frames(sensor, ambient_transmission=0.0)[:, where]
    return depth_of_frames(frames, where, sensor, signals.rig)


def single_path_depth(sensor: Sensor, rig: Rig, truth: GroundTruth, where: np.ndarray) -> np.ndarray:
    """(n,) float64, metres: z read of the straight path to the true point of the n pixels `where` (h, w), alone.

    Where this is wrong, no light but that which belongs to the surface was needed to make it so: the distance is
    beyond what the sensor can measure, or finer than it can tell. NaN where the sensor gives no reading.
    """
    path = _straight_path(rig, truth, where)
    result = np.empty(len(path.u))
    values = max(sum(r.channels for r in sensor.responses()), sensor.n_frames)
    pixels = np.flatnonzero(where)
    step = max(1, _CHUNK_VALUES // values)
    for begin in range(0, len(result), step):
        part = slice(begin, begin + step)
        some = LightPath(path.u[None, part], path.v[None, part], path.path_length_m[None, part], True)
        white = np.ones(some.u.shape, dtype=np.float32)
        frames = sensor.frames([_weights(r, some) for r in sensor.responses()], white, np.zeros_like(white))
        of_part = np.zeros(where.shape, dtype=bool)
        of_part.ravel()[pixels[part]] = True
        result[part] = depth_of_frames(frames[:, 0], of_part, sensor, rig)
    return result


def depth_of_frames(frames: np.ndarray, where: np.ndarray, sensor: Sensor, rig: Rig) -> np.ndarray:
    """(n,) float64, metres: z that the sensor's decoder gives for noise-free frames (k, n) of the n pixels `where`."""
    if isinstance(sensor, (AmcwToF, DirectToF, IdealToF)):  # pixels are decoded each for itself; without a rig,
        length = 2 * decode(Capture(frames[:, None].astype(np.float32), sensor)).range_m[0]  # range is half the path
        directions = rig.camera.directions(rig.camera.pixel_centres()[where])
        range_m = range_from_path_length(length, directions, rig)
        return np.where(range_m > 0, range_m, np.nan) / np.linalg.norm(directions, axis=-1)
    image = np.zeros((len(frames), *where.shape), dtype=np.float32)
    image[:, where] = frames
    return np.asarray(decode(Capture(image, sensor, rig)).z[where], dtype=np.float64)


def points_in_projector(rig: Rig, z: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(n, 3) float64, metres: surface points at depths z (h, w) of the n pixels `where`, frame of the projector."""
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
        for index, weight in response.shares(path, NumpyMath()):
            bins = np.minimum(np.asarray(index), response.channels).astype(np.intp)[None]
            np.put_along_axis(result, bins, np.take_along_axis(result, bins, axis=0) + weight, axis=0)
        return result[:-1]
    assert isinstance(response, DenseResponse)
    shape = path.u.shape
    return np.stack([np.broadcast_to(w, shape) for w in response.weights(path, NumpyMath())]).astype(np.float32)
