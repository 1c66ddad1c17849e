# SPDX-License-Identifier: Apache-2.0
"""A Mitsuba scene with what range sensing needs to know of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rangesim.rig import Intrinsics, Rig, look_at, pose, translation
from rangesim.settings.bounds import Bounds, check_number, whole

BASELINE = Bounds("a positive baseline in metres", 1e-9, 1e6)
PROJECTOR_PIXELS = (1280, 800)


@dataclass(frozen=True)
class Instance:
    """One shape of the scene: its name (id in the scene file) and material class."""

    name: str
    material: str


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Geometry and materials to measure.

    name : str
    mitsuba : mitsuba.Scene of the active variant, in the renderer's coordinates: the world less `origin_m`.
    instances : one per shape, in the order of `mitsuba.shapes()`.
    camera, T_world_camera : the scene's own sensor.
    working_distance_m : float, median depth the camera sees; sets default baseline and vergence.
    has_cutouts : bool, whether some surface lets light pass unchanged (`mask`, `null`).
    has_matte_textures : bool, whether the reflectance of some matte surface is not the same everywhere.
    source : Path of the file it was loaded from; None for a dictionary.
    reload : makes another mitsuba.Scene of the same source, for shapes to be moved in.
    origin_m : (3,) float64, metres, world: where the renderer has its origin (`rangesim.scene.origin`); nothing else
        here and nothing in a result is relative to it.
    """

    name: str
    mitsuba: Any
    instances: tuple[Instance, ...]
    camera: Intrinsics
    T_world_camera: np.ndarray
    working_distance_m: float
    has_cutouts: bool = False
    has_matte_textures: bool = False
    source: Path | None = None
    reload: Callable[[], Any] | None = None
    origin_m: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __repr__(self) -> str:
        c = self.camera
        return f"Scene({self.name!r}, {len(self.instances)} shapes, camera {c.width} x {c.height})"

    @property
    def has_ambient(self) -> bool:
        """Whether the scene has light sources of its own."""
        return len(self.mitsuba.emitters()) > 0

    @property
    def has_lamps(self) -> bool:
        """Whether some of that light comes from somewhere, rather than evenly from all around."""
        return any(emitter.class_name() != "ConstantBackgroundEmitter" for emitter in self.mitsuba.emitters())

    def in_renderer(self, rig: Rig) -> Rig:
        """The rig in the renderer's coordinates."""
        return replace(rig, T_world_camera=translation(*-self.origin_m) @ rig.T_world_camera)

    def motion_in_renderer(self, T: np.ndarray) -> np.ndarray:
        """(4, 4) in the renderer's coordinates of a world transform (4, 4) that moves a shape."""
        return np.asarray(translation(*-self.origin_m) @ T @ translation(*self.origin_m))

    def rig(
        self,
        baseline_m: float | None = None,
        projector_size: tuple[int, int] | None = None,
        power_w: float = 1.0,
        width: int | None = None,
        height: int | None = None,
        *,
        camera: Intrinsics | None = None,
        T_world_camera: np.ndarray | None = None,
    ) -> Rig:
        """Rig of the scene's camera and a projector to its right that covers the camera's view.

        Parameters
        ----------
        baseline_m : metres; default a fifth of the working distance. The projector turns towards the point that the
            optical axis meets at the working distance.
        projector_size : (width, height) in projector pixels; default 1280 x 800.
        power_w : radiant power of white.
        width, height : camera pixels; default as in the scene file; one alone keeps the aspect ratio. The
            horizontal field of view is kept.
        camera : Intrinsics in place of the scene's camera; `width` and `height` then do not count.
        T_world_camera : (4, 4) float64, pose of the camera in place of the scene's, metres.
        """
        for name, value in (("width", width), ("height", height)):
            if value is not None:
                check_number(name, value, whole(1, "pixels"))
        if width is None:
            width = self.camera.width if height is None else round(height * self.camera.width / self.camera.height)
        if height is None:
            height = max(1, round(width * self.camera.height / self.camera.width))
        if camera is None:
            camera = self.camera.resized(width, height)
        if T_world_camera is None:
            T_world_camera = self.T_world_camera
        if baseline_m is None:
            baseline_m = float(f"{0.2 * self.working_distance_m:.1g}")
        check_number("baseline_m", baseline_m, BASELINE)
        target = (0.0, 0.0, self.working_distance_m)
        return Rig(
            camera=camera,
            projector=covering(camera, *(projector_size or PROJECTOR_PIXELS)),
            T_world_camera=pose(T_world_camera, "T_world_camera"),
            T_camera_projector=look_at((baseline_m, 0.0, 0.0), target, up=(0.0, -1.0, 0.0)),
            projector_power_w=power_w,
        )


def covering(camera: Intrinsics, width: int, height: int, margin: float = 1.1) -> Intrinsics:
    """Projector of the given pixel count, square pixels, whose field covers the camera's with a margin."""
    half_x = margin * max(camera.cx, camera.width - camera.cx) / camera.fx
    half_y = margin * max(camera.cy, camera.height - camera.cy) / camera.fy
    f = min(0.5 * width / half_x, 0.5 * height / half_y)
    return Intrinsics(width, height, f, f, width / 2, height / 2)
