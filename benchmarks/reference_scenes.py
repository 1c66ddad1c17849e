# SPDX-License-Identifier: Apache-2.0
"""Small scenes in which projector light goes through glass or off a mirror, and the regions in which it is measured.

A `Case` is a scene seen by one rig. Its regions are named parts of the image: pixels all of whose neighbours, too,
see a given part of the matte floor, either straight or by way of glass or mirror ("through").
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion

from rangesim import Intrinsics, Rig, Scene, load_scene, look_at
from rangesim.environment.backend import select_variant
from rangesim.scene.camera import MITSUBA_FROM_OPENCV

CAMERA_PIXELS = (96, 72)
PROJECTOR_PIXELS = (64, 40)
STRIPES = ("columns_bit1", "rows_bit1")
"""Frames of the Gray code of `PROJECTOR_PIXELS`: stripes four projector pixels wide."""
GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
SILVER = {"type": "conductor", "eta": {"type": "spectrum", "value": 0.04}, "k": {"type": "spectrum", "value": 5.8}}
ENLARGEMENT = 1000.0
"""How much larger references make a scene, about its glass. Mitsuba starts rays 0.09 mm * (1 + c) off a surface, where
c is the largest coordinate of the point in metres. In a ball of 100 mm this moves refracted light so much that its
focus is 1.2 % too bright. In the large scene the offset is 9e-5 of the distance from the middle of the glass."""
MATTE = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.5}}}


@dataclass(frozen=True)
class Region:
    """Pixels that see the disc around `centre` (world, metres) of the matte floor, straight or by a delta surface."""

    centre: tuple[float, float, float]
    radius_m: float
    through: bool = False


@dataclass(frozen=True)
class Guide:
    """Where camera paths should look for the projector: directions from a surface towards `point` (away from it where
    `away` is set), within a cone. It changes the noise of the brute-force reference, not its mean."""

    point: tuple[float, float, float]
    half_angle_rad: float
    away: bool = False


@dataclass(frozen=True, eq=False)
class Case:
    """A scene dictionary, a rig, what is measured, and the projector's aperture in the reference: its radius, and the
    distance from it where its stripes are focused, so that they are sharpest in the regions. `middle` is that of the
    glass or mirror (world, metres)."""

    shapes: dict[str, Any]
    rig: Rig
    regions: dict[str, Region]
    guide: Guide
    aperture_radius_m: float
    focus_m: float
    middle: tuple[float, float, float]
    scene: Scene = field(init=False)

    def __post_init__(self) -> None:
        import mitsuba as mi

        to_world = mi.ScalarTransform4f(self.rig.T_world_camera @ MITSUBA_FROM_OPENCV)
        film = {"type": "hdrfilm", "width": CAMERA_PIXELS[0], "height": CAMERA_PIXELS[1]}
        fov = float(np.degrees(2 * np.arctan(0.5 * CAMERA_PIXELS[0] / self.rig.camera.fx)))
        sensor = {"type": "perspective", "fov": fov, "to_world": to_world, "film": film}
        object.__setattr__(self, "scene", load_scene({"type": "scene", "sensor": sensor, **self.shapes}))

    def enlarged(self) -> Case:
        """The same case for references, `ENLARGEMENT` times as large; it looks the same."""
        shapes, rig = enlarged(self.shapes, self.rig, self.middle)
        point = tuple(float(x) for x in ENLARGEMENT * (np.array(self.guide.point) - self.middle))
        return replace(
            self,
            shapes=shapes,
            rig=rig,
            guide=replace(self.guide, point=point),
            aperture_radius_m=ENLARGEMENT * self.aperture_radius_m,
            focus_m=ENLARGEMENT * self.focus_m,
        )

    def masks(self) -> dict[str, np.ndarray]:
        """Region name -> (h, w) bool."""
        point, through = seen_through_delta(self.scene, self.rig)
        result = {}
        for name, region in self.regions.items():
            inside = np.linalg.norm(point - region.centre, axis=-1) < region.radius_m
            result[name] = binary_erosion(inside & (through == region.through), np.ones((3, 3)))
        return result


def enlarged(shapes: dict[str, Any], rig: Rig, middle: tuple[float, float, float]) -> tuple[dict[str, Any], Rig]:
    """Shapes and rig, `ENLARGEMENT` times as large about a point in metres; each pixel receives the same light."""
    import mitsuba as mi

    larger = mi.ScalarTransform4f().scale(ENLARGEMENT).translate([-x for x in middle])
    T_world_camera, T_camera_projector = rig.T_world_camera.copy(), rig.T_camera_projector.copy()
    T_world_camera[:3, 3] = ENLARGEMENT * (T_world_camera[:3, 3] - middle)
    T_camera_projector[:3, 3] *= ENLARGEMENT
    power_w = rig.projector_power_w * ENLARGEMENT**2
    rig = replace(rig, T_world_camera=T_world_camera, T_camera_projector=T_camera_projector, projector_power_w=power_w)
    same = mi.ScalarTransform4f()
    return {k: {**shape, "to_world": larger @ shape.get("to_world", same)} for k, shape in shapes.items()}, rig


def seen_through_delta(scene: Scene, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) first non-delta point along the ray through each pixel centre, NaN if none, and (h, w) bool, whether
    glass (always entered) or a mirror came before it."""
    import drjit as dr
    import mitsuba as mi

    directions = rig.camera.directions(rig.camera.pixel_centres()).reshape(-1, 3) @ rig.T_world_camera[:3, :3].T
    ray = mi.Ray3f(mi.Point3f(rig.T_world_camera[:3, 3]), dr.normalize(mi.Vector3f(directions.T)))
    active, through = dr.full(mi.Bool, True, len(directions)), dr.full(mi.Bool, False, len(directions))
    point = dr.full(mi.Point3f, np.nan, len(directions))
    for _ in range(6):
        si = scene.mitsuba.ray_intersect(ray, active)
        active &= si.is_valid()
        smooth = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth)
        point = dr.select(active & smooth, si.p, point)
        active &= ~smooth
        through |= active
        last = 1 - 1e-6  # a random number that chooses refraction where there is a choice
        bs, _ = si.bsdf().sample(mi.BSDFContext(), si, last, mi.Point2f(0.5), active)
        ray = si.spawn_ray(si.to_world(bs.wo))
    h, w = rig.camera.height, rig.camera.width
    return np.array(point).T.reshape(h, w, 3), np.array(through).reshape(h, w)


def cases() -> dict[str, Case]:
    """All cases by name."""
    return {
        "ball": _ball(camera=(-0.1, -0.5, 0.4), target=(-0.05, 0.0, 0.03), fov_deg=27.0),
        "ball, seen through it": _ball(camera=(0.15, -0.1, 0.8), target=(0.0, 0.0, 0.15), fov_deg=11.0),
        "pane": _pane(),
        "mirror": _mirror(),
    }


def _rig(
    camera: tuple[float, float, float],
    target: tuple[float, float, float],
    fov_deg: float,
    projector: tuple[float, float, float],
    projector_target: tuple[float, float, float],
    projector_fov_deg: float,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Rig:
    T_world_camera, T_world_projector = look_at(camera, target, up), look_at(projector, projector_target, up)
    return Rig(
        camera=Intrinsics.from_fov(*CAMERA_PIXELS, fov_deg),
        projector=Intrinsics.from_fov(*PROJECTOR_PIXELS, projector_fov_deg),
        T_world_camera=T_world_camera,
        T_camera_projector=np.linalg.inv(T_world_camera) @ T_world_projector,
    )


def _floor(half_size_m: float) -> dict[str, Any]:
    import mitsuba as mi

    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(half_size_m), "bsdf": MATTE}


def _ball(camera: tuple[float, float, float], target: tuple[float, float, float], fov_deg: float) -> Case:
    """A glass ball above a floor; beyond its focus the stripes come out bent and reversed."""
    select_variant()  # before Mitsuba's transforms
    ball = {"type": "sphere", "center": [0.0, 0.0, 0.15], "radius": 0.05, "bsdf": GLASS}
    lit = Region((-0.054, 0.0, 0.0), 0.04)
    straight = {"caustic": lit, "floor": Region((-0.16, 0.0, 0.0), 0.03)}
    through = {"lit and seen through the ball": Region(lit.centre, 0.05, through=True),
               "floor": Region((-0.05, 0.1, 0.0), 0.02)}  # fmt: skip
    return Case(
        shapes={"floor": _floor(0.4), "ball": ball},
        rig=_rig(camera, target, fov_deg, (0.27, 0.0, 0.9), (0.0, 0.0, 0.1), 28.0),
        regions=straight if camera[0] < 0 else through,
        guide=Guide((0.0, 0.0, 0.15), 0.33),
        aperture_radius_m=0.016,
        focus_m=0.66,  # conjugate to the floor by way of the ball
        middle=(0.0, 0.0, 0.15),
    )


def _pane() -> Case:
    """A glass pane, 10 mm thick, halfway to a wall that is partly seen and partly lit through it."""
    select_variant()  # before Mitsuba's transforms
    import mitsuba as mi

    up = mi.ScalarTransform4f()
    pane = {"type": "cube", "to_world": up.translate([-0.05, 0.0, 0.5]).scale([0.1, 0.3, 0.005]), "bsdf": GLASS}
    return Case(
        shapes={"floor": _floor(1.5), "pane": pane},
        rig=_rig((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 50.0, (0.25, 0.0, 1.0), (0.0, 0.0, 0.0), 62.0, (0.0, 1.0, 0.0)),
        regions={
            "lit through the pane": Region((-0.375, 0.0, 0.0), 0.06),
            "seen through the pane": Region((-0.03, 0.0, 0.0), 0.1, through=True),
            "lit and seen through the pane": Region((-0.22, 0.0, 0.0), 0.06, through=True),
            "floor": Region((0.36, 0.0, 0.0), 0.08),
        },
        guide=Guide((0.25, 0.0, 1.0), 0.03),
        aperture_radius_m=0.01,
        focus_m=1.0,
        middle=(-0.05, 0.0, 0.5),
    )


def _mirror() -> Case:
    """An upright silver cylinder beside a floor; a screen keeps the straight light off the part that it lights."""
    select_variant()  # before Mitsuba's transforms
    import mitsuba as mi

    cylinder = {"type": "cylinder", "p0": [0.0, 0.0, 0.0], "p1": [0.0, 0.0, 0.4], "radius": 0.15, "bsdf": SILVER}
    place = mi.ScalarTransform4f().translate([0.42, -0.05, 0.14]).scale([0.07, 0.16, 1.0])
    lit = Region((0.29, -0.02, 0.0), 0.07)
    return Case(
        shapes={"floor": _floor(1.0), "cylinder": cylinder,
                "screen": {"type": "rectangle", "to_world": place, "bsdf": MATTE}},
        rig=_rig((0.35, -0.7, 0.45), (0.2, 0.0, 0.03), 30.0, (0.65, -0.1, 0.4), (0.15, 0.0, 0.12), 45.0),
        regions={"caustic": lit, "caustic in the mirror": Region(lit.centre, 0.12, through=True),
                 "floor": Region((0.3, 0.25, 0.0), 0.06)},
        guide=Guide((0.0, 0.0, 0.2), 0.45),
        aperture_radius_m=0.01,
        focus_m=0.65,
        middle=(0.0, 0.0, 0.2),
    )  # fmt: skip
