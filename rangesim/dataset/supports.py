# SPDX-License-Identifier: Apache-2.0
"""Supports that objects lie on: a table, a floor, or a bin. The surface that bears them, or the bin, is centred at the
origin, and z points up.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from rangesim.dataset.random_primitives import box_mesh
from rangesim.settings.bounds import Bounds
from rangesim.settings.config import Named
from rangesim.settings.draws import Draw, Of, check_draws, drawn
from rangesim.triangle_mesh import TriangleMesh

LENGTH = Bounds("a length in metres", 1e-3, 100)
"""Bounds of the lengths of tables and bins, metres."""
Length = Annotated[Draw, Of(float, LENGTH)]
MaterialName = Annotated[Draw, Of(str)]
THICKNESS_M = 0.03
"""Thickness of a table top or a floor, metres. Only its upper side is seen, as a rule."""


SEAM_M = 1e-4
"""Gap between a bin and the table below, metres: light that leaves a clear bin must meet the table after it, and single
precision resolves 1e-7 m here."""


class Placed(NamedTuple):
    """A support of drawn size.

    Parameters
    ----------
    meshes : mesh of each shape, metres, world, by the shape's name.
    materials : material of each shape.
    boxes : (n, 2, 3) float64, metres, world: lower and upper corners of boxes that collide, and that are the meshes.
    area_m : (2, 2) float64, metres: lower and upper corner (x, y) of the area that objects may lie on.
    height_m : z of the plane that bears the objects, metres.
    rim_m : z of the rim of a bin, metres; None: no bin.
    values : all that was drawn.
    """

    meshes: dict[str, TriangleMesh]
    materials: dict[str, str]
    boxes: np.ndarray
    area_m: np.ndarray
    height_m: float
    rim_m: float | None
    values: dict[str, Any]


class Support(Named, ABC):
    """Base of what objects lie on. Subclasses are frozen dataclasses whose fields are draws."""

    known: ClassVar[dict[str, type[Any]]] = {}

    @abstractmethod
    def placed(self, values: Mapping[str, Any]) -> Placed:
        """The support of drawn values."""

    def draw(self, random: np.random.Generator) -> Placed:
        """A support of random size and material."""
        return self.placed(drawn(self, random))


@dataclass(frozen=True)
class Table(Support):
    """A table top; whatever is beside it is the room.

    width_m, depth_m : along x and y, metres. material : of the catalogue.
    """

    width_m: Length = Draw.of(0.6)
    depth_m: Length = Draw.of(0.6)
    material: MaterialName = Draw.of("raw_wood")

    type_name: ClassVar[str] = "table"

    def __post_init__(self) -> None:
        check_draws(self)

    def placed(self, values: Mapping[str, Any]) -> Placed:
        half = np.array([values["width_m"], values["depth_m"]]) / 2
        return _plate("table", half, half, dict(values))


@dataclass(frozen=True)
class Floor(Support):
    """A floor that ends nowhere near the camera's view; the objects lie in its middle.

    width_m, depth_m : of the area that the objects lie on, along x and y, metres. material : of the catalogue.
    """

    width_m: Length = Draw.of(0.6)
    depth_m: Length = Draw.of(0.6)
    material: MaterialName = Draw.of("grey_cardboard")

    type_name: ClassVar[str] = "floor"

    def __post_init__(self) -> None:
        check_draws(self)

    def placed(self, values: Mapping[str, Any]) -> Placed:
        half = np.array([values["width_m"], values["depth_m"]]) / 2
        return _plate("floor", 10 * half, half, dict(values))


@dataclass(frozen=True)
class Bin(Support):
    """An open box that the objects lie in, on a table.

    width_m, depth_m, height_m : of the space inside, along x, y and z, metres. wall_m : thickness of walls and bottom,
    metres. material, table_material : of the catalogue.
    """

    width_m: Length = Draw.of(0.4)
    depth_m: Length = Draw.of(0.3)
    height_m: Length = Draw.of(0.15)
    wall_m: Length = Draw.of(0.005)
    material: MaterialName = Draw.of("grey_cardboard")
    table_material: MaterialName = Draw.of("raw_wood")

    type_name: ClassVar[str] = "bin"

    def __post_init__(self) -> None:
        check_draws(self)

    def placed(self, values: Mapping[str, Any]) -> Placed:
        wall, height = values["wall_m"], values["height_m"]
        half = np.array([values["width_m"], values["depth_m"]]) / 2
        x, y = half
        outer = half + wall
        table = _plate("table", 2 * outer + 0.2, half, {}, -SEAM_M)
        top = wall + height
        lower = [(-x - wall, -y - wall, 0), (-x - wall, -y - wall, wall), (x, -y - wall, wall)]
        upper = [(x + wall, y + wall, wall), (-x, y + wall, top), (x + wall, y + wall, top)]
        lower += [(-x, -y - wall, wall), (-x, y, wall)]
        upper += [(x, -y, top), (x, y + wall, top)]
        boxes = np.concatenate([table.boxes, np.stack([lower, upper], axis=1)])
        return Placed(
            {**table.meshes, "bin": _open_box(half, outer, wall, top)},
            {"table": values["table_material"], "bin": values["material"]},
            boxes,
            np.stack([-half, half]),
            wall,
            top,
            dict(values),
        )


def _plate(name: str, half: np.ndarray, usable: np.ndarray, values: dict[str, Any], top: float = 0.0) -> Placed:
    """A plate; half, usable : (2,) half sizes of all of it and of the part for objects. top : z of its upper side."""
    low, high = np.array([*-half, top - THICKNESS_M]), np.array([*half, top])
    material = {name: values["material"]} if values else {}
    area = np.stack([-usable, usable])
    return Placed({name: box_mesh(low, high)}, material, np.stack([low, high])[None], area, 0.0, None, values)


def _open_box(inner: np.ndarray, outer: np.ndarray, bottom: float, top: float) -> TriangleMesh:
    """A closed mesh of an open box that stands on z = 0; inner, outer : (2,) half sizes, metres."""
    around = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    rings = [(outer, 0.0), (outer, top), (inner, top), (inner, bottom)]
    vertices = np.concatenate([np.column_stack([around * half, np.full(4, z)]) for half, z in rings])
    faces = []
    for ring in range(3):
        for i in range(4):
            a, b = 4 * ring + i, 4 * ring + (i + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
    faces += [(0, 2, 1), (0, 3, 2), (12, 13, 14), (12, 14, 15)]
    return TriangleMesh(vertices, np.array(faces))
