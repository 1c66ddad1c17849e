# SPDX-License-Identifier: Apache-2.0
"""Tells the objects of a scene from its background: what bears them, stands behind them or surrounds them.

A shape is background if one of four things holds. All follow from the geometry of the scene; names play no part.

lamp : it emits light.
support : it is flat, and two other shapes or more rest on it: a table, a shelf, a conveyor, a road.
wall : it is flat, more than half of the other shapes stand before it that are not known as background yet, and it rests
    on no background itself. In a scene of flat shapes alone, those that are about as large as the largest are walls.
container : it encloses more than half of the other shapes; each of them takes up little of its box, and so do its own
    walls, unless the camera is in it, too: a bin, a shelf, a room. A glass is no container, since what is in it is seen
    through it; nor is a bottle that its filling fills, nor a ring around a ball.

A scene of one wall thus has no object. A scene file overrides the rule with `is_object` at a shape, and an experiment
with its list of `objects`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from rangesim.scene.scene import Instance

MAX_FLATNESS = 0.25
"""Mean thickness of a flat shape, at most, as a fraction of its smaller width. From 0.16 to 0.3, 42 of 43 scenes do not
change; at 0.12 conveyor belts and pallets are objects."""
MAX_BURDEN = 0.5
"""Area of the largest face of a shape that rests on another one, at most, as a fraction of the area of that one's face.
Walls that meet in a corner, or the panes of a cabin, do not bear each other."""
MAX_FILLING = 0.25
"""Fraction of a container's box that one shape in it fills, at most, and that its own walls fill. The water in a bottle
fills half and more, an angle bracket a third; from 0.15 to 0.25, none of 43 scenes changes."""
SLACK = 0.05
"""Tolerance of contacts and edges, as a fraction of the extent of the shape that touches."""
MAX_CANDIDATES = 64
"""Number of the largest flat shapes, and of the largest shapes of any form, that are tested as background. What bears
or surrounds others is larger than they, and time grows with this number times the number of shapes."""
MAX_VERTICES = 4096
"""Number of vertices from which the outline of a mesh is found, evenly chosen."""
MAX_OPENING = 1e-3
"""Length of the sum of a closed mesh's face normals, at most, as a fraction of its area. Each normal is as long as its
face is large; of a closed surface they add up to zero, but for rounding."""
NORMAL_CELLS = 50
"""Number of cells per unit length into which the components of normals are rounded: directions within about a degree
count as one."""
SEE_THROUGH = ("transparent", "translucent")
"""Material classes of shapes that show what they enclose."""


def objects_of(
    scene: Any, instances: Sequence[Instance], stated: dict[str, bool], camera: np.ndarray
) -> tuple[Instance, ...]:
    """The instances with `is_object` set by the rule of this module, or as the scene states it.

    All shapes that are part of one thing agree: it is an object if one of them is.

    Parameters
    ----------
    scene : mitsuba.Scene.
    instances : one per shape, in the order of `scene.shapes()`.
    stated : whether a shape is an object, by its name, where the scene file says so.
    camera : (3,) float64, metres, renderer's coordinates, place of the camera.
    """
    background = _background(scene.shapes(), instances, camera)
    by_rule: dict[str, bool] = {}
    for instance, behind in zip(instances, background, strict=True):
        by_rule[instance.part_of] = by_rule.get(instance.part_of, False) or not behind
    decided = by_rule | {i.part_of: stated[i.name] for i in instances if i.name in stated}
    return tuple(replace(i, is_object=decided[i.part_of]) for i in instances)


def _background(shapes: Sequence[Any], instances: Sequence[Instance], camera: np.ndarray) -> np.ndarray:
    """(n,) bool, whether each shape is background."""
    boxes = [_box_of(shape) for shape in shapes]
    outlines = _Outlines.of(boxes)
    thing = np.unique([i.part_of for i in instances], return_inverse=True)[1]
    areas, volumes = np.array([b.area for b in boxes]), np.array([b.volume for b in boxes])
    largest = {*np.argsort(-areas)[:MAX_CANDIDATES].tolist(), *np.argsort(-volumes)[:MAX_CANDIDATES].tolist()}
    result = np.array([shape.is_emitter() for shape in shapes])
    only_flat = all(box.is_flat for box in boxes)
    borne: dict[int, np.ndarray] = {}  # what touches each flat background
    for index in sorted(largest, key=lambda i: (-areas[i], i)):
        box, apart = boxes[index], thing != thing[index]
        others = apart & ~result
        is_clear = instances[index].material in SEE_THROUGH
        if box.is_flat:
            near, touching = (mask & apart for mask in box.before(outlines, camera))
            far = box.before(outlines, 2 * box.centre - camera)[0] & (not is_clear)
            touching &= areas <= MAX_BURDEN * areas[index]
            rests = any(touched[index] and boxes[bearer].is_parallel(box) for bearer, touched in borne.items())
            is_alone = only_flat and areas[index] > MAX_BURDEN * areas.max()
            is_wall = is_alone or _most(near, others) or _most(far, others)
            if touching.sum() >= 2 or (is_wall and not rests):
                result[index], borne[index] = True, touching
        inside = box.encloses(outlines) & others
        if not is_clear and (box.filling <= MAX_FILLING or box.holds(camera)) and _most(inside, others):
            result[index] |= volumes[inside].max() <= MAX_FILLING * box.volume
    return result


def _most(part: np.ndarray, of: np.ndarray) -> bool:
    """Whether more than half of the members of a mask are in another mask; False if there are no members."""
    return bool(2 * (part & of).sum() > of.sum())


# ---- Boxes ---------------------------------------------------------------------------------------------------------


class _Outlines(NamedTuple):
    """The outlines of n shapes.

    points : (n, k, 3) float64, metres, points of each shape that lie farthest in k directions.
    centre : (n, 3) float64, metres, centre of the bounding box.
    size : (n,) float64, metres, largest extent along an axis.
    """

    points: np.ndarray
    centre: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, boxes: Sequence[_Box]) -> _Outlines:
        points = np.stack([box.outline for box in boxes])
        low, high = points.min(axis=1), points.max(axis=1)
        return cls(points, 0.5 * (low + high), (high - low).max(axis=1))


@dataclass(frozen=True, eq=False)
class _Box:
    """The box around a shape.

    axes : (3, 3) float64, unit vectors in rows; the shape is thinnest along the first.
    low, high : (3,) float64, metres, bounds along the axes.
    thickness_m : thickness along the first axis, metres. Of a closed surface that has such a face it is the mean, the
        volume over the area: a table with legs is as thin as its top.
    filling : fraction of the box that the shape fills, 0..1; 0 for an open surface.
    outline : (k, 3) float64, metres, points of the shape.
    """

    axes: np.ndarray
    low: np.ndarray
    high: np.ndarray
    thickness_m: float
    filling: float
    outline: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """(3,) float64, metres, centre of the box."""
        return np.asarray(0.5 * (self.low + self.high) @ self.axes)

    @property
    def area(self) -> float:
        """Area of the largest face, m2."""
        return float(np.prod((self.high - self.low)[1:]))

    @property
    def volume(self) -> float:
        """Volume of the box, m3."""
        return float(np.prod(self.high - self.low))

    @property
    def is_flat(self) -> bool:
        """Whether the shape is thin against both its widths."""
        return self.thickness_m <= MAX_FLATNESS * float((self.high - self.low)[1:].min())

    def is_parallel(self, other: _Box) -> bool:
        """Whether the largest faces of two boxes lie within 45 degrees of each other."""
        return bool(abs(self.axes[0] @ other.axes[0]) > np.sqrt(0.5))

    def before(self, outlines: _Outlines, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Two masks (n,) bool: the shapes over the face towards the camera, and those of them that touch it."""
        side = 1.0 if self.axes[0] @ camera > 0.5 * (self.low[0] + self.high[0]) else -1.0
        back, face = (self.low[0], self.high[0]) if side > 0 else (-self.high[0], -self.low[0])
        off = np.abs((outlines.centre - self.centre) @ self.axes[1:].T)
        over = np.flatnonzero((off <= (0.5 + SLACK) * (self.high - self.low)[1:]).all(axis=1))
        height, reach = outlines.points[over] @ (side * self.axes[0]), SLACK * outlines.size[over]
        before, touching = np.zeros((2, len(off)), dtype=bool)
        before[over] = (height.min(axis=1) >= back - reach) & (height.max(axis=1) > face)
        touching[over] = before[over] & (height.min(axis=1) <= face + reach)
        return before, touching

    def holds(self, point: np.ndarray) -> bool:
        """Whether a point (3,), metres, lies in the box."""
        return bool(((self.axes @ point >= self.low) & (self.axes @ point <= self.high)).all())

    def encloses(self, outlines: _Outlines) -> np.ndarray:
        """(n,) bool, whether more than half of the box of each shape lies in this one."""
        slack, within = SLACK * (self.high - self.low), np.zeros(len(outlines.centre), dtype=bool)
        centre = outlines.centre @ self.axes.T
        near = np.flatnonzero(((centre >= self.low - slack) & (centre <= self.high + slack)).all(axis=1))
        points = outlines.points[near] @ self.axes.T
        low, high = points.min(axis=1), points.max(axis=1)
        common = np.minimum(high, self.high + slack) - np.maximum(low, self.low - slack)
        extent = np.maximum(high - low, 1e-9 * outlines.size[near, None])
        within[near] = (common / extent).clip(0, 1).prod(axis=1) > 0.5
        return within


def _directions() -> np.ndarray:
    """(k, 3) float64, unit vectors, spread evenly on the sphere, and the axes."""
    count = 58
    z = (2 * np.arange(count) + 1) / count - 1
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z**2)
    return np.concatenate([np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1), np.eye(3), -np.eye(3)])


_DIRECTIONS = _directions()
"""(64, 3) float64, unit vectors in which the outline of a shape is sought: spread on the sphere, and along the axes."""
_CIRCLE = np.stack([np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8), np.zeros(16)], axis=1)
_UNIT_SHAPES = {
    "Cylinder": np.concatenate([_CIRCLE, _CIRCLE + np.array([0, 0, 1])]),
    "Disk": _CIRCLE,
    "Rectangle": np.array([[-1, -1, 0], [-1, 1, 0], [1, -1, 0], [1, 1, 0.0]]),
}
"""Points of a shape before its `to_world`, by the name of its class in Mitsuba."""


def _box_of(shape: Any) -> _Box:
    """The box of a mitsuba.Shape; that of a shape which is neither a mesh nor round lies along the axes."""
    low, high = (np.array([corner[i] for i in range(3)]) for corner in (shape.bbox().min, shape.bbox().max))
    if shape.class_name() == "Sphere":
        return _box_along(0.5 * (low + high) + 0.5 * (high[0] - low[0]) * _DIRECTIONS, np.eye(3))
    parameters = mi.traverse(shape)
    if "vertex_positions" in parameters:
        vertices = np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
        return _box_of_mesh(vertices, np.array(parameters["faces"]).reshape(-1, 3))
    if (unit := _UNIT_SHAPES.get(shape.class_name())) is not None:
        matrix = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)
        x, normal = matrix[:3, 0], np.cross(matrix[:3, 0], matrix[:3, 1])
        axes = np.stack([normal, x, np.cross(normal, x)])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        return replace(_box_along(unit @ matrix[:3, :3].T + matrix[:3, 3], axes), filling=0.0)
    return _box_along(np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3), np.eye(3))


def _box_of_mesh(vertices: np.ndarray, faces: np.ndarray) -> _Box:
    """The box of a mesh: its largest face is parallel to the plane in which most of the mesh's area lies, or to that
    through its vertices with the least variance, whichever makes the box thinner."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = 0.5 * np.cross(b - a, c - a)
    size = np.linalg.norm(areas, axis=1)
    largest = int(size.argmax())
    edges = np.stack([b - a, c - b, a - c])[:, largest]
    (main, parallel), least = _main_normal(areas, size), np.linalg.eigh(np.cov(vertices.T))[1][:, 0]
    normal = min((main, least), key=lambda n: np.ptp(vertices @ n))
    box = _box_around(vertices, normal, edges[np.linalg.norm(edges, axis=1).argmin()])
    is_closed = np.linalg.norm(areas.sum(axis=0)) < MAX_OPENING * size.sum()
    if not is_closed or not box.volume:
        return replace(box, filling=0.0)
    volume = abs(float(np.einsum("ij,ij->", a - vertices.mean(axis=0), areas))) / 3
    has_face = normal is main and parallel >= box.area
    thickness = min(box.thickness_m, volume / box.area) if has_face else box.thickness_m
    return replace(box, thickness_m=thickness, filling=min(1.0, volume / box.volume))


def _main_normal(areas: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit vector (3,) to which most of the area is perpendicular, both sides of a plane together; and that area, m2.

    areas : (m, 3) float64, m2, normals of triangles times their areas. size : (m,) float64, m2, their lengths.
    """
    normals = areas / np.where(size > 0, size, 1)[:, None]
    cells = np.rint(normals * NORMAL_CELLS).astype(np.int64)
    first = np.sign(cells[np.arange(len(cells)), (cells != 0).argmax(axis=1)])
    keys = (cells * first[:, None]) @ [1, 1000, 1_000_000]
    _, inverse = np.unique(keys, return_inverse=True)
    sums = np.bincount(inverse, size)
    return normals[inverse == sums.argmax()][0], float(sums.max())


def _box_around(points: np.ndarray, normal: np.ndarray, along: np.ndarray) -> _Box:
    """The box of points (n, 3) with a face perpendicular to `normal`, turned about it to have the smallest area.

    along : (3,), a first direction for the edges of that face.
    """
    normal = normal / (np.linalg.norm(normal) or 1.0)
    u = along - (along @ normal) * normal
    u = u / np.linalg.norm(u) if np.linalg.norm(u) > 1e-6 * np.linalg.norm(along) else np.linalg.svd(normal[None])[2][1]
    v = np.cross(normal, u)
    few = points[:: 1 + len(points) // MAX_VERTICES]
    turns = np.arange(32) * np.pi / 64
    x, y = (few @ u)[:, None], (few @ v)[:, None]
    areas = np.ptp(x * np.cos(turns) + y * np.sin(turns), axis=0) * np.ptp(
        y * np.cos(turns) - x * np.sin(turns), axis=0
    )
    turn = turns[np.argmin(areas + 1e-9 * areas.max() * np.arange(32))]  # the first, if several are the smallest
    axes = np.stack([normal, u * np.cos(turn) + v * np.sin(turn), v * np.cos(turn) - u * np.sin(turn)])
    return _box_along(points, axes, few[(few @ _DIRECTIONS.T).argmax(axis=0)])


def _box_along(points: np.ndarray, axes: np.ndarray, outline: np.ndarray | None = None) -> _Box:
    """The box of points (n, 3) along given axes (3, 3), in rows."""
    along = points @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    order = np.argsort(high - low, kind="stable")
    if outline is None:
        outline = points[np.arange(len(_DIRECTIONS)) % len(points)]
    return _Box(axes[order], low[order], high[order], float((high - low).min()), 1.0, outline)
