# SPDX-License-Identifier: Apache-2.0
"""Signals of analytic scenes, without a renderer: one direct light path per camera pixel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rangesim.response import DenseResponse, FirstReturn, LightPath, NumpyMath, Response, SparseResponse
from rangesim.rig import Intrinsics, Rig, translation
from rangesim.sensors import Sensor
from rangesim.signals import EnergySplit, GroundTruth, Signals, StillSignals


def stereo_rig(width: int = 160, height: int = 120, baseline_m: float = 0.2, **changes: object) -> Rig:
    """Camera and projector side by side, baseline along x, the projector turned in by the camera's side."""
    angle = -0.15 if baseline_m else 0.0
    pose = translation(baseline_m, 0.0, 0.0)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    settings: dict[str, object] = {
        "camera": Intrinsics.from_fov(width, height, 45),
        "projector": Intrinsics.from_fov(1280, 800, 60),
        "T_camera_projector": pose,
    }
    return Rig(**(settings | changes))  # type: ignore[arg-type]


def plane_depth(rig: Rig, distance_m: float = 1.0, normal: tuple[float, float, float] = (0.2, 0.1, -1.0)) -> np.ndarray:
    """(h, w) depth of a plane through (0, 0, distance_m) of the camera frame."""
    rays = rig.camera.directions(rig.camera.pixel_centres())
    return np.asarray(distance_m * normal[2] / (rays @ np.asarray(normal)))


def signals_of_depth(
    rig: Rig,
    z: np.ndarray,
    sensors: Sequence[Sensor],
    albedo: float = 0.5,
    ambient: float = 0.0,
    delay_m: np.ndarray | float = 0.0,
) -> StillSignals:
    """Signals of a matte surface at depth z (h, w), NaN for nothing, direct light only, no shadows.

    delay_m : (h, w) metres of path that the electronics of each pixel add.
    """
    points = rig.camera.directions(rig.camera.pixel_centres()) * z[..., None]
    in_projector = (points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3]
    uv = rig.projector.project(in_projector)
    range_m = np.linalg.norm(points, axis=-1)
    length = range_m + np.linalg.norm(in_projector, axis=-1)
    with np.errstate(invalid="ignore"):
        visible = ((uv >= 0) & (uv <= [rig.projector.width, rig.projector.height])).all(axis=-1)
    radiance = np.where(visible, albedo / np.pi * rig.projector_irradiance / in_projector[..., 2] ** 2, 0.0)
    seen_m = length + delay_m
    path = LightPath(*(np.nan_to_num(a) * visible for a in (uv[..., 0], uv[..., 1], seen_m)), visible)
    responses = {r for s in sensors for r in s.responses()}
    channels = {r: _channels(r, path, radiance) for r in responses}
    zero = np.zeros(z.shape, dtype=np.float32)
    constant = np.where(np.isfinite(z), np.float32(ambient), np.float32(0))
    energy = EnergySplit(radiance.astype(np.float32), zero, zero, zero, zero, constant)
    nothing = ~np.isfinite(z)
    truth = GroundTruth(
        z=z.astype(np.float32),
        range_m=range_m.astype(np.float32),
        normal=np.full((*z.shape, 3), np.nan, dtype=np.float32),
        instance=np.where(nothing, -1, 0).astype(np.int32),
        material=np.where(nothing, -1, 0).astype(np.int32),
        projector_uv=uv.astype(np.float32),
        projector_visible=visible,
        instance_names=("plane",),
        material_names=("matte",),
    )
    return StillSignals(rig, energy, truth, channels=channels)


def plane_signals(rig: Rig, *sensors: Sensor, distance_m: float = 1.0, **changes: float) -> StillSignals:
    """Signals of a tilted matte plane."""
    return signals_of_depth(rig, plane_depth(rig, distance_m), sensors, **changes)


def _channels(response: Response, path: LightPath, radiance: np.ndarray) -> np.ndarray:
    if isinstance(response, SparseResponse):
        weights = response.bin_weights(path, NumpyMath())
        bins = range(response.channels)
        return np.stack([sum(np.where(i == b, radiance * w, 0) for i, w in weights) for b in bins]).astype(np.float32)
    assert isinstance(response, DenseResponse)
    return np.stack([radiance * w for w in response.weights(path, NumpyMath())]).astype(np.float32)


def counted_return() -> tuple[FirstReturn, list[None]]:
    """A first return, and a list that grows by one whenever a kernel with it is traced."""
    traces: list[None] = []

    class Counted(FirstReturn):
        type_name = "counted"

        def weights(self, path: Any, m: Any) -> list[Any]:
            traces.append(None)
            return super().weights(path, m)

    return Counted(), traces


def all_bytes(signals: Signals) -> bytes:
    """Channels, energy split and truth of a pass, to compare passes to the last bit."""
    assert isinstance(signals, StillSignals)
    parts = [signals.channels, vars(signals.energy), vars(signals.truth)]
    return b"".join(np.ascontiguousarray(x).tobytes() for p in parts for x in p.values() if isinstance(x, np.ndarray))
