# SPDX-License-Identifier: Apache-2.0
"""Scenes that are functions of a few parameters: a wall, a step, and parts of one material on a table.

They are what sweeps over distance, tilt and material measure. Each function returns a dictionary for `load_scene`. The
camera stands at the origin and looks along +y; z is up; lengths are metres. Even light from all directions gives 1
W/m2 on an open surface (before `rangesim.Ambient` scales it), so that an ambient light can be stated in lux.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from rangesim.scene.catalogue_materials import material_names, surface
from rangesim.scene.mesh import MESH_MATERIALS
from rangesim.settings.bounds import Bounds, check_number
from rangesim.settings.config import nearest, shown

FOV_DEG = 50.0
"""Horizontal field of view of the scenes' camera, degrees, as of the scene `plane`. Devices bring their own."""
SIZE_PX = (640, 480)
"""Width and height of the image of the scenes' camera, pixels."""
WALL_DISTANCES = 8.0
"""Half of the edge of a wall, in distances from the camera: it fills fields of view of up to 160 degrees."""
TABLE_M = 1.5
"""Half of the edge of the table, metres: it fills the field of view at working distances of up to a metre or two."""

_METRES = Bounds("a positive distance in metres", 1e-3, 1e4)
_DEGREES = Bounds("degrees between -85 and 85", -85, 85)
_REFLECTANCE = Bounds("a reflectance between 0 and 1", 0, 1)


def wall(
    distance_m: float = 1.0, tilt_deg: float = 0.0, reflectance: float = 0.8, material: str = "matte"
) -> dict[str, Any]:
    """A wall in front of the camera.

    Parameters
    ----------
    distance_m : depth of the wall on the camera's axis, metres.
    tilt_deg : angle between the wall's normal and the camera's axis, degrees; the wall turns about its vertical.
    reflectance : of a matte wall.
    material : "matte", or another class or material, see `surface_of`.
    """
    from mitsuba import ScalarTransform4f as T

    check_number("distance_m", distance_m, _METRES)
    check_number("tilt_deg", tilt_deg, _DEGREES)
    place = T().translate([0, distance_m, 0]).rotate([0, 0, 1], tilt_deg).rotate([1, 0, 0], 90)
    surface = {
        "type": "rectangle",
        "to_world": place @ T().scale(WALL_DISTANCES * distance_m),
        "bsdf": surface_of(material, reflectance)["bsdf"],
    }
    return {**_empty(), "wall": surface}


def step(
    height_m: float = 0.05, distance_m: float = 1.0, reflectance: float = 0.8, material: str = "matte"
) -> dict[str, Any]:
    """Two walls that face the camera, the right one nearer by a step.

    Parameters
    ----------
    height_m : depth of the step, metres. distance_m : depth of the farther wall, metres.
    reflectance, material : as of `wall`.
    """
    from mitsuba import ScalarTransform4f as T

    check_number("height_m", height_m, _METRES)
    if not height_m < distance_m:
        raise ValueError(f"expected height_m below the distance_m of {distance_m:g}, got {height_m:g}.")
    edge = WALL_DISTANCES * distance_m / 2
    place = T().translate([edge, distance_m - height_m / 2, 0]) @ T().scale([edge, height_m / 2, 2 * edge])
    block = {"type": "cube", "to_world": place, **surface_of(material, reflectance)}
    return {**wall(distance_m, 0.0, reflectance, material), "step": block}


def part_on_table(
    material: str = "brushed_aluminium", distance_m: float = 0.5, elevation_deg: float = 60.0, reflectance: float = 0.5
) -> dict[str, Any]:
    """A ball, a block and a leaning plate of one material on a matte table.

    Parameters
    ----------
    material : of the parts, see `surface_of`.
    distance_m : from the camera to the middle of the table, metres.
    elevation_deg : angle of the camera's axis above the table, degrees.
    reflectance : of the table, and of matte parts.
    """
    from mitsuba import ScalarTransform4f as T

    check_number("distance_m", distance_m, _METRES)
    check_number("elevation_deg", elevation_deg, Bounds("degrees between 5 and 90", 5, 90))
    # The table has coordinates of its own, z up; the camera stays where it is.
    table = T().translate([0, distance_m, 0]) @ T().rotate([1, 0, 0], elevation_deg)

    def part(kind: str, place: Any) -> dict[str, Any]:
        return {"type": kind, "to_world": table @ place, **surface_of(material, reflectance)}

    leaning = T().translate([0.015, 0.075, 0.033]).rotate([1, 0, 0], 55) @ T().scale([0.06, 0.04, 0.003])
    return {
        **_empty(),
        "table": {"type": "rectangle", "to_world": table @ T().scale(TABLE_M), **surface_of("matte", reflectance)},
        "ball": part("sphere", T().translate([-0.09, 0.0, 0.035]) @ T().scale(0.035)),
        "block": part(
            "cube", T().translate([0.07, -0.03, 0.02]).rotate([0, 0, 1], 30) @ T().scale([0.04, 0.025, 0.02])
        ),
        "plate": part("cube", leaning),
    }


PARAMETRIC: dict[str, Callable[..., dict[str, Any]]] = {"wall": wall, "step": step, "part_on_table": part_on_table}
"""The functions by the names that settings give them."""


def surface_of(material: str, reflectance: float) -> dict[str, Any]:
    """Entries of a shape that give it a material, as of `rangesim.scene.catalogue_materials.surface`.

    Parameters
    ----------
    material : "matte", of the reflectance given; another class of a bare mesh (glossy, mirror, transparent); or a
        material of the catalogue (docs/materials.md).

    Raises
    ------
    ValueError
        There is no such material, or the reflectance is not from 0 to 1.
    """
    check_number("reflectance", reflectance, _REFLECTANCE)
    if material == "matte":
        return {"bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": float(reflectance)}}}
    if isinstance(material, str) and material in MESH_MATERIALS:
        return {"bsdf": MESH_MATERIALS[material]}
    if isinstance(material, str) and material in material_names():
        return surface(material)
    known = (*MESH_MATERIALS, *material_names())
    raise ValueError(
        f"expected material to be one of {', '.join(MESH_MATERIALS)} or a material of the catalogue "
        f"(docs/materials.md), got {shown(material)}{nearest(material, known)}."
    )


def _empty() -> dict[str, Any]:
    """A scene of a camera and even light that brings 1 W/m2 to an open surface."""
    from mitsuba import ScalarTransform4f as T

    film = {"type": "hdrfilm", "width": SIZE_PX[0], "height": SIZE_PX[1]}
    camera = {
        "type": "perspective",
        "fov": FOV_DEG,
        "to_world": T().look_at(origin=[0, 0, 0], target=[0, 1, 0], up=[0, 0, 1]),
        "film": film,
    }
    return {"type": "scene", "camera": camera, "sky": {"type": "constant", "radiance": 1 / math.pi}}
