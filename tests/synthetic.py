# SPDX-License-Identifier: Apache-2.0
"""Signals and captures of analytic scenes, without a renderer: direct light paths alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rangesim import Capture
from rangesim.response import DenseResponse, Dots, FirstReturn, LightPath, NumpyMath, Response, SparseResponse
from rangesim.rig import Intrinsics, Rig, translation
from rangesim.sensors import ActiveStereo, ReferencePatternStereo, Sensor
from rangesim.signals import EnergySplit, GroundTruth, Signals, StillSignals

PARTS = 5
"""Light paths along each side of a pixel that stand for its area, in captures of dots."""


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


def dots_on_plane(
    rig: Rig, sensor: ActiveStereo | ReferencePatternStereo, normal: Sequence[float], distance_m: float
) -> tuple[Capture, np.ndarray]:
    """Noise-free capture of the dots on a plane n X = d of the world, over the areas of the pixels, and true depths.

    normal : n, of any length.
    """
    n = np.array(normal) / np.linalg.norm(normal)
    T, P = rig.T_world_camera, np.linalg.inv(rig.T_world_projector)
    camera, projector, pattern = rig.pinhole, rig.image_projector, sensor.pattern
    assert isinstance(pattern, Dots)

    def seen(offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World directions (h, w, 3) of the rays beside the pixel centres, and the plane's depths along them."""
        rays = camera.directions(camera.pixel_centres() + offset) @ T[:3, :3].T
        return rays, (distance_m - T[:3, 3] @ n) / (rays @ n)

    light = np.zeros((camera.height, camera.width))
    for i, j in np.ndindex(PARTS, PARTS):
        rays, depth = seen((np.array([i, j]) + 0.5) / PARTS - 0.5)
        points = (rays * depth[..., None] + T[:3, 3]) @ P[:3, :3].T + P[:3, 3]
        uv = projector.project(points)
        lit = (uv >= 0).all(axis=-1) & (uv <= [projector.width, projector.height]).all(axis=-1)
        path = LightPath(*np.where(lit[..., None], uv, 0).transpose(2, 0, 1), light, True)
        light = light + lit * pattern.weights(path, NumpyMath())[0] / points[..., 2] ** 2 / PARTS**2
    return Capture(light[None].astype(np.float32), sensor, rig), seen(np.zeros(2))[1]


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
