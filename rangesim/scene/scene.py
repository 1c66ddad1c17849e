# SPDX-License-Identifier: Apache-2.0
"""A Mitsuba scene together with its camera, the names of its shapes, and their material classes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rangesim.rig import Camera, Intrinsics, Rig, look_at, pose, translation
from rangesim.settings.bounds import Bounds, check_number, whole
from rangesim.settings.config import nearest, shown

BASELINE = Bounds("a positive baseline in metres", 1e-9, 1e6)
"""Bounds of the distance between camera and projector, metres."""
PROJECTOR_PIXELS = (1280, 800)
"""Default width and height of a projector in pixels: WXGA, a common format."""


@dataclass(frozen=True)
class Instance:
    """A shape of a scene.

    name : id of the shape in the scene file. material : its class, one of `rangesim.scene.materials.MATERIAL_CLASSES`.
    part_of : name of the thing that the shape is a part of, as the scene states it; by default the shape's own name.
    is_object : whether that thing is an object, or else background (`rangesim.scene.objects`).
    """

    name: str
    material: str
    part_of: str
    is_object: bool = True

    @property
    def object_name(self) -> str:
        """Name of the object that the shape is a part of; empty if it is background."""
        return self.part_of if self.is_object else ""


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Geometry and materials to measure, as `load_scene` returns them.

    Attributes
    ----------
    name : str
    mitsuba : mitsuba.Scene of the active variant, in the renderer's coordinates, which are the world's minus
        `origin_m`.
    instances : one per shape, in the order of `mitsuba.shapes()`.
    camera, T_world_camera : intrinsics and pose (4, 4), metres, of the sensor in the scene file.
    working_distance_m : float, median depth that the camera sees, metres; the default baseline and the angle between
        camera and projector are computed from it.
    has_cutouts : bool, whether light passes some surface unchanged (`mask`, `null`).
    has_matte_textures : bool, whether the reflectance of some matte surface varies over it.
    source : Path of the file that the scene was loaded from; None for a dictionary.
    reload : function that makes another mitsuba.Scene of the same source, in which shapes can be moved.
    origin_m : (3,) float64, metres, world: origin of the renderer's coordinates (`rangesim.scene.origin`). Everything
        else here, and all results, are in coordinates of the world.
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

    def with_objects(self, names: Sequence[str]) -> Scene:
        """The same scene with these objects; all other shapes are background.

        names : names of shapes, or of the things that they are parts of (`Instance.part_of`).

        Raises
        ------
        ValueError
            The scene has no shape of such a name.
        """
        valid = [name for i in self.instances for name in (i.name, i.part_of)]
        for name in names:
            if name not in valid:
                raise ValueError(
                    f"expected objects of the scene {self.name!r}, got {shown(name)}{nearest(name, valid)}."
                )
        stated = {i.part_of for i in self.instances if not {i.name, i.part_of}.isdisjoint(names)}
        return replace(self, instances=tuple(replace(i, is_object=i.part_of in stated) for i in self.instances))

    @property
    def has_ambient(self) -> bool:
        """Whether the scene has emitters of its own, which are ambient light for a sensor."""
        return len(self.mitsuba.emitters()) > 0

    @property
    def has_lamps(self) -> bool:
        """Whether some ambient light comes from lamps, the sun or a sky, rather than evenly from all directions."""
        return any(emitter.class_name() != "ConstantBackgroundEmitter" for emitter in self.mitsuba.emitters())

    def in_renderer(self, rig: Rig) -> Rig:
        """The same rig with its pose in the renderer's coordinates."""
        return replace(rig, T_world_camera=translation(*-self.origin_m) @ rig.T_world_camera)

    def motion_in_renderer(self, T: np.ndarray) -> np.ndarray:
        """(4, 4) transform that moves a shape in the renderer's coordinates as T (4, 4), metres, does in the world."""
        return np.asarray(translation(*-self.origin_m) @ T @ translation(*self.origin_m))

    def rig(
        self,
        baseline_m: float | None = None,
        projector_size: tuple[int, int] | None = None,
        power_w: float = 1.0,
        width: int | None = None,
        height: int | None = None,
        *,
        camera: Camera | None = None,
        T_world_camera: np.ndarray | None = None,
    ) -> Rig:
        """A rig of the scene's camera and a projector to its right that covers the camera's field of view.

        Parameters
        ----------
        baseline_m : distance from camera to projector, metres; default a fifth of the working distance. The projector
            looks at the point on the optical axis of the camera at the working distance.
        projector_size : (width, height), pixels; default 1280 x 800.
        power_w : radiant power in watts that leaves the projector when it shows white.
        width, height : size of the camera's image, pixels; default as in the scene file. One alone keeps the aspect
            ratio. The horizontal field of view stays the same.
        camera : Intrinsics, or Zones of such a camera, to use instead of the scene's camera; `width` and `height` are
            then ignored.
        T_world_camera : (4, 4) float64, rigid, metres; pose of the camera to use instead of the scene's.

        Raises
        ------
        ValueError
            A value out of its bounds.
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
        target, fine = (0.0, 0.0, self.working_distance_m), camera.traced
        if not isinstance(fine, Intrinsics):
            raise ValueError(f"expected a pinhole camera (Intrinsics) or zones of one, got a {type(camera).__name__}.")
        return Rig(
            camera=camera,
            projector=covering(fine, *(projector_size or PROJECTOR_PIXELS)),
            T_world_camera=pose(T_world_camera, "T_world_camera"),
            T_camera_projector=look_at((baseline_m, 0.0, 0.0), target, up=(0.0, -1.0, 0.0)),
            projector_power_w=power_w,
        )


def covering(camera: Intrinsics, width: int, height: int, margin: float = 1.1) -> Intrinsics:
    """Intrinsics of a projector of width x height square pixels whose field of view contains that of the camera.

    margin : ratio of the tangents of the half fields of view; 1.1 leaves a tenth around the camera's view.
    """
    half_x = margin * max(camera.cx, camera.width - camera.cx) / camera.fx
    half_y = margin * max(camera.cy, camera.height - camera.cy) / camera.fy
    f = min(0.5 * width / half_x, 0.5 * height / half_y)
    return Intrinsics(width, height, f, f, width / 2, height / 2)
