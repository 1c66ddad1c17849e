# SPDX-License-Identifier: Apache-2.0
"""Triangles of light as kernels see them: the search for those that cover a point of a surface.

The triangles are a scene of their own. A short ray along the normal of the surface meets all of them that cover the
point, one after the other. Triangles that lie in one plane would hide each other, so each of them is lifted off the
surface by a distance of its own.

Faint triangles are many and bring little. They are dealt out to groups, in copies of the scene that lie side by side. A
sample of a pixel looks into one group, whose light counts for all. The samples of a pixel look into all groups in turn.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.caustic_kernels import irradiance_of
from rangesim.light_transport.caustic_sheets import FAINT, GROUPS, Sheets
from rangesim.light_transport.sampling import aligned

LIFT = 1e-3
"""Largest distance by which a triangle is lifted off its surface, as a fraction of the size of the lit part of the
scene. If it were smaller, single precision could not tell all triangles apart that cover a point; a larger one would
find triangles beside thin parts."""
SAG = 0.5
"""Depth below a surface to which triangles are looked for, as a fraction of `LIFT`, because triangles cut the corner of
curved surfaces."""
GOLDEN = 0.6180339887498949
MAX_COSINE_DIFFERENCE = 0.35
"""Largest difference between the cosines of a direction to the normal of a triangle and to that of a point that it may
light, so that a triangle on one side of a thin part does not light the other side."""


class Covering(NamedTuple):
    """A triangle that covers a point.

    irradiance : Float, W/m2. direction : Vector3f, unit. u, v : Float. length : Float, metres. cosine : Float.
    """

    irradiance: mi.Float
    direction: mi.Vector3f
    u: mi.Float
    v: mi.Float
    length: mi.Float
    cosine: mi.Float


class SheetScene:
    """Triangles of light, ready for kernels.

    Parameters
    ----------
    sheets : Sheets, at least one triangle.
    projector_at : (3,) float, metres, world. irradiance : W/m2, of the projector's direct light at 1 m.
    samples : int, smallest number of samples of a pixel, which bounds the number of groups.
    shapes : int, number of entries of tables by shape.
    """

    def __init__(self, sheets: Sheets, projector_at: np.ndarray, irradiance: float, samples: int) -> None:
        groups = 1 << int(np.log2(max(1, min(samples, GROUPS))))
        corners = sheets.position[sheets.triangles].astype(np.float64)
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        direct = irradiance / np.maximum(((corners.mean(axis=1) - projector_at) ** 2).sum(axis=1), 1e-18)
        with np.errstate(divide="ignore"):
            level = sheets.flux / area / direct
        is_faint = level < FAINT
        # The faintest are drawn by lot, and count for those that are not
        chance = np.where(is_faint, np.minimum(level * groups / FAINT, 1), 1)
        number = np.arange(len(area)) * GOLDEN % 1
        kept = np.flatnonzero((np.random.default_rng(0).random(len(area)) < chance) & (area > 0))
        at_vertex, scale = irradiance_of(sheets.triangles, sheets.flux, sheets.position, len(sheets.u))
        scale = scale / chance * np.where(is_faint, groups, 1)
        group = np.where(is_faint, (sheets.key[:] >> 8) % groups + 1, 0)

        low, high = sheets.position.min(axis=0), sheets.position.max(axis=0)
        size = float((high - low).max()) + 1e-6
        self.lift = LIFT * size
        across = 1 << ((groups.bit_length() + 1) // 2)  # groups lie in a square grid
        offsets = np.array([[0.0, 0.0], *([(g % across + 1) * 1.5 * size, g // across * 1.5 * size] for g in range(groups))])
        points = corners[kept] + (self.lift * number[kept])[:, None, None] * sheets.normal[sheets.triangles[kept]]
        points[:, :, :2] += offsets[group[kept]][:, None]
        mesh = mi.Mesh("light", 3 * len(kept), len(kept))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(aligned(points, np.float32))
        parameters["faces"] = mi.UInt32(aligned(np.arange(3 * len(kept)), np.uint32))
        parameters.update()
        self.scene = mi.load_dict({"type": "scene", "light": mesh})
        looks = np.column_stack([sheets.direction, sheets.length, sheets.u, sheets.v, at_vertex, sheets.cosine])
        self.looks = mi.Float(aligned(looks, np.float32))
        corner = np.column_stack([sheets.triangles, sheets.shape])[kept]
        self.corner = mi.UInt32(aligned(corner, np.uint32))
        self.scale = mi.Float(aligned(scale[kept], np.float32))
        self.offsets = mi.Float(aligned(offsets, np.float32))
        self.groups = dr.opaque(mi.UInt32, groups)
        self.height = dr.opaque(mi.Float, self.lift)
        lit = np.zeros(int(sheets.shape.max()) + 1, np.bool_)
        lit[np.unique(sheets.shape[kept])] = True
        self.lit, self.shapes = mi.Bool(lit), dr.opaque(mi.UInt32, len(lit))
        dr.eval(self.looks, self.corner, self.scale, self.offsets)

    def may_light(self, shape: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether any triangle lies on a shape."""
        known = active & (shape < self.shapes)
        return known & dr.gather(mi.Bool, self.lit, shape, known)

    def start(self, point: mi.Point3f, normal: mi.Normal3f, sample: mi.UInt32, which: mi.UInt32) -> mi.Point3f:
        """Start of the ray through bright triangles (`which` 0), or through those of the sample's group (1)."""
        offset = dr.gather(mi.Vector2f, self.offsets, dr.select(which == 0, 0, sample % self.groups + 1))
        return point + mi.Vector3f(normal) * (1.01 * self.height) + mi.Vector3f(offset.x, offset.y, 0)

    def next(self, origin: mi.Point3f, normal: mi.Normal3f, way: mi.Float, active: mi.Bool):
        """The next triangle on the ray."""
        ray = mi.Ray3f(origin - mi.Vector3f(normal) * way, -mi.Vector3f(normal))
        ray.maxt = (1.01 + SAG) * self.height - way
        return self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)

    def covering(self, found: mi.PreliminaryIntersection3f, shape: mi.UInt32, normal: mi.Normal3f, active: mi.Bool):
        """The light of a triangle that was found, and whether it lies on this side of this shape."""
        corner = dr.gather(mi.Vector4u, self.corner, found.prim_index, active)
        b1, b2 = found.prim_uv.x, found.prim_uv.y
        first, second = mi.Vector4f(0), mi.Vector4f(0)
        for index, weight in zip((corner.x, corner.y, corner.z), (1 - b1 - b2, b1, b2), strict=True):
            first += weight * dr.gather(mi.Vector4f, self.looks, 2 * index, active)
            second += weight * dr.gather(mi.Vector4f, self.looks, 2 * index + 1, active)
        direction = dr.normalize(first.xyz)
        irradiance = second.z * dr.gather(mi.Float, self.scale, found.prim_index, active)
        is_here = active & (corner.w == shape) & (dr.abs(dr.dot(direction, normal) - second.w) < MAX_COSINE_DIFFERENCE)
        return Covering(irradiance, direction, second.x, second.y, first.w, second.w), is_here
