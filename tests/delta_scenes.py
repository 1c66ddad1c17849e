# SPDX-License-Identifier: Apache-2.0
"""Scenes of a few shapes on the z axis, with glass and mirrors, and the optics of slabs and mirrors on paper."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rangesim import Intrinsics, Rig, Scene, load_scene, look_at
from rangesim.environment.backend import select_variant
from rangesim.light_transport.caustic_sheets import Sheets
from rangesim.light_transport.caustics import caustic_sheets
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.response import DenseResponse, LightPath

SILVER = (0.04, 5.8)
"""Refractive index n and extinction k."""
MIRROR = {
    "type": "conductor",
    "eta": {"type": "spectrum", "value": SILVER[0]},
    "k": {"type": "spectrum", "value": SILVER[1]},
}
GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
DOWN = (0.0, -1.0, 0.0)
"""`up` of `look_at` for devices along z whose x axis is that of the world."""


def matte(reflectance: float = 0.5) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": reflectance}}}


def transform() -> Any:
    """Mitsuba's transforms need a variant."""
    select_variant()
    import mitsuba as mi

    return mi.ScalarTransform4f()


def wall(z: float, bsdf: dict[str, Any], half_size: float = 5.0, x: float = 0.0, y: float = 0.0) -> dict[str, Any]:
    """A square at depth z that faces the origin."""
    place = transform().translate([x, y, z]).scale([half_size, half_size, -1])
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def slab(near: float, far: float, half_size: float = 5.0, bsdf: dict[str, Any] = GLASS) -> dict[str, Any]:
    """Glass between two depths."""
    half = [half_size, half_size, (far - near) / 2]
    return {"type": "cube", "to_world": transform().translate([0, 0, (near + far) / 2]).scale(half), "bsdf": bsdf}


def scene_of(**parts: dict[str, Any]) -> Scene:
    """A scene seen from the origin along z."""
    sensor = {"type": "perspective", "fov": 40.0, "to_world": transform().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])}
    return load_scene({"type": "scene", "sensor": sensor, **parts})


def rig_of(
    camera: Intrinsics,
    projector: Intrinsics,
    at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    looks_at: tuple[float, float, float] | None = None,
    camera_at: tuple[float, float, float] = (0.0, 0.0, 0.0),
    camera_looks_at: tuple[float, float, float] | None = None,
    **more: Any,
) -> Rig:
    """Camera and projector at points in the world; they look along z if not told otherwise."""
    ahead = lambda p: (p[0], p[1], p[2] + 1.0)  # noqa: E731
    T_world_camera = look_at(camera_at, camera_looks_at or ahead(camera_at), DOWN)
    T_world_projector = look_at(at, looks_at or ahead(at), DOWN)
    return Rig(camera, projector, T_world_camera, np.linalg.inv(T_world_camera) @ T_world_projector, **more)


def sheets_of(scene: Scene, rig: Rig, seed: int = 0) -> Sheets | None:
    """The triangles of light of a pass; None if no light lands beyond glass or mirrors."""
    here = scene.in_renderer(rig)
    return caustic_sheets(TracedScene.of(scene.mitsuba, here), [here], TransportSettings(seed=seed))


def thrown_w(scene: Scene, rig: Rig, seeds: int = 1) -> float:
    """Watts that land on surfaces beyond glass and mirrors, mean over seeds."""
    found = [sheets_of(scene, rig, seed) for seed in range(seeds)]
    return float(np.mean([0.0 if one is None else one.flux.sum() for one in found]))


@dataclass(frozen=True)
class ProjectorCoordinates(DenseResponse):
    """Radiance, and radiance times u and times v, in projector pixels."""

    channels: int = 3  # type: ignore[misc]

    def weights(self, path: LightPath, m: Any) -> list[Any]:
        return [1.0, path.u, path.v]


# ---- Optics on paper --------------------------------------------------------------------------------


def fresnel_dielectric(sine: Any, n: float = 1.5) -> Any:
    """Reflectance of one face for unpolarised light that comes from air at that sine of the angle."""
    a, b = np.sqrt(1 - sine**2), np.sqrt(1 - (sine / n) ** 2)
    return (((a - n * b) / (a + n * b)) ** 2 + ((n * a - b) / (n * a + b)) ** 2) / 2


def fresnel_conductor(cosine: Any, n: float = SILVER[0], k: float = SILVER[1]) -> Any:
    """Reflectance of a metal for unpolarised light."""
    eta = complex(n, k)
    a = np.asarray(cosine, dtype=complex)
    b = np.sqrt(1 - (1 - a**2) / eta**2)
    return (np.abs((a - eta * b) / (a + eta * b)) ** 2 + np.abs((eta * a - b) / (eta * a + b)) ** 2) / 2


@dataclass(frozen=True)
class SlabPath:
    """Light through a slab of index n and thickness d, on the way to a plane `reach` metres from its source; it is
    reflected back and forth in the slab `turns` times. All functions of the tangent of the angle to the normal."""

    reach: float
    d: float
    n: float = 1.5
    turns: int = 0

    def sine(self, t: Any) -> Any:
        return t / np.sqrt(1 + t**2)

    def across(self, t: Any) -> Any:
        """Metres from the axis where it lands."""
        inside = self.sine(t) / self.n
        return t * (self.reach - self.d) + (2 * self.turns + 1) * self.d * inside / np.sqrt(1 - inside**2)

    def length(self, t: Any) -> Any:
        """Optical length, metres."""
        inside = self.sine(t) / self.n
        passes = 2 * self.turns + 1
        return (self.reach - self.d) * np.sqrt(1 + t**2) + self.n * passes * self.d / np.sqrt(1 - inside**2)

    def transmittance(self, t: Any) -> Any:
        r = fresnel_dielectric(self.sine(t), self.n)
        return (1 - r) ** 2 * r ** (2 * self.turns)

    def tangent(self, across: Any) -> Any:
        """The inverse of `across`, by a dense table."""
        t = np.linspace(0, 3, 300_001)
        return np.interp(across, self.across(t), t)

    def irradiance(self, across: Any) -> Any:
        """On the plane, for a source of 1 W/m2 on a facing plane at 1 m (before the slab)."""
        t, step = self.tangent(across), 1e-4
        slope = (self.across(t + step) - self.across(t - step)) / (2 * step)
        return self.transmittance(t) * np.where(across > 1e-9, t / np.maximum(across, 1e-9), 1 / slope) / slope
