# SPDX-License-Identifier: Apache-2.0
"""What a sensor reads of nothing but the straight light path to the true surface point."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rangesim.capture import Capture
from rangesim.decoding import decode
from rangesim.response import DenseResponse, LightPath, NumpyMath, Response, SparseResponse
from rangesim.rig import Rig
from rangesim.sensors import Sensor
from rangesim.signals import GroundTruth

_CHUNK_VALUES = 16_000_000


def single_path_depth(sensor: Sensor, rig: Rig, truth: GroundTruth) -> np.ndarray:
    """(h, w) float32, metres: z by one path of light per pixel, without noise; NaN where the sensor gives no reading.

    Where this is wrong, no light but that which belongs to the surface was needed to make it so: the distance is
    beyond what the sensor can measure, or finer than it can tell.
    """
    h, w = truth.z.shape
    result = np.full((h, w), np.nan, dtype=np.float32)
    channels = sum(r.channels for r in sensor.responses())
    for rows in _chunks(h, max(1, _CHUNK_VALUES // (w * max(channels, sensor.n_frames)))):
        camera = replace(rig.camera, height=rows.stop - rows.start, cy=rig.camera.cy - rows.start)
        part = replace(rig, camera=camera)
        path = _path(part, truth.z[rows], truth.range_m[rows])
        white = np.ones(path.u.shape, dtype=np.float32)
        responses = [_weights(r, path) for r in sensor.responses()]
        frames = sensor.frames(responses, white, np.zeros_like(white))
        result[rows] = decode(Capture(frames.astype(np.float32), sensor, part)).z
    return result


def in_projector(rig: Rig, z: np.ndarray) -> np.ndarray:
    """(h, w, 3) float64, metres: surface points at the depths z (h, w) of the camera, in the frame of the projector."""
    points = rig.camera.directions(rig.camera.pixel_centres()) * z[..., None]
    return np.asarray((points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3])


def _path(rig: Rig, z: np.ndarray, range_m: np.ndarray) -> LightPath:
    """The direct path of every pixel; where the projector does not see, the nearest place of its image."""
    point = in_projector(rig, z.astype(np.float64))
    uv = np.nan_to_num(rig.projector.project(point))
    u, v = np.clip(uv[..., 0], 0, rig.projector.width), np.clip(uv[..., 1], 0, rig.projector.height)
    return LightPath(u, v, np.nan_to_num(range_m + np.linalg.norm(point, axis=-1)), np.ones(z.shape, dtype=bool))


def _weights(response: Response, path: LightPath) -> np.ndarray:
    if isinstance(response, SparseResponse):
        index = np.asarray(response.bin(path, NumpyMath()))
        result = np.zeros((response.channels + 1, *index.shape), dtype=np.float32)
        np.put_along_axis(result, np.minimum(index, response.channels)[None].astype(np.intp), 1.0, axis=0)
        return result[:-1]
    assert isinstance(response, DenseResponse)
    shape = path.u.shape
    return np.stack([np.broadcast_to(w, shape) for w in response.weights(path, NumpyMath())]).astype(np.float32)


def _chunks(height: int, rows: int) -> Iterator[slice]:
    for start in range(0, height, rows):
        yield slice(start, min(start + rows, height))
