# SPDX-License-Identifier: Apache-2.0
"""Triangles of light as kernels see them: the search for those that cover a point of a surface.

The triangles are a scene of their own. A short ray along the normal of the surface meets all of them that cover the
point, one after the other. Triangles that lie in one plane would hide each other, so each of them is lifted off the
surface by a distance of its own.

Faint triangles are many and bring little. They are dealt out to groups, in copies of the scene that lie side by side. A
sample of a pixel looks into one group, whose light counts for all. The samples of a pixel look into all groups in turn.
Light of narrow lobes is dealt out in the same way, by the points of the lobes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.caustic_kernels import crowd_of, irradiance_of, lifted
from rangesim.light_transport.caustic_sheets import FAINT, MAX_SAG, Sheets
from rangesim.light_transport.sampling import aligned
from rangesim.light_transport.specular_tree import LOBE_GROUPS

LIFT = 4e-4
"""Largest distance between two triangles in one place, as a fraction of their distance from the projector: a thousand
times the rounding of single precision, which has to tell all triangles apart that cover a point. They are lifted off
their surface to both sides of it, so that they are as large as on the surface on average. A larger distance would make
triangles on curved surfaces too large or too small."""
FLAT = 0.02
"""Largest distance of a point from the plane of a triangle on a flat receiver, as a fraction of the distance to which
rays look: a hundred times the rounding of single precision."""
STEP = 6e-8
"""Step behind a triangle, as a fraction of the coordinates: the rounding of single precision. With a smaller step, a
ray could meet the same triangle for ever; a larger one would pass triangles by. Coordinates count from the middle of
the lit part of the scene, where they are small."""
MARGIN = 1.4
"""Ratio of the height from which a ray looks, and the depth to which it does, to those of the edges of triangles: the
middle of a triangle is 4 / 3 times as far from a curved surface as its edges."""
PERIOD = 16
"""Largest number of samples after which a half of a pixel's samples has looked into all groups of faint triangles. With
a longer period, faint light would be noisy in passes of few samples."""
EVERY = 4
"""Largest number of samples of which one looks for faint triangles. If every sample looked, a pass would take a fifth
longer."""
FAINT_LOBES = 0.5
"""Fraction of the light of narrow lobes that may be bright while samples look for it in turn, so that this light is not
noisy where there is much of it."""
CROWD = 2.0
"""Number of faint triangles over a point from which they are dealt out to groups, because every sample looks for
fewer of them at little cost."""
CUBES = 64
"""Number of cubes along the lit part of the scene, in which faint triangles are counted. With fewer cubes, the count of
a small spot would be that of its surroundings."""
FAINTEST = 1e-3
"""Ratio of the irradiance to direct light below which faint triangles are drawn by lot, anew for each seed. There are
many of them, and together they bring a few thousandths of the light."""
SPACING = 1.5
"""Distance between groups of faint triangles, as a multiple of the size of the lit part of the scene, so that groups do
not touch."""
MIN_SIZE_M = 1e-6
"""Metres that are added to the size of the lit part of the scene, which may be a point."""
MAX_COSINE_DIFFERENCE = 0.35
"""Largest difference between the cosines of a direction to the normal of a triangle and to that of a point that it may
light, so that a triangle on one side of a thin part does not light the other side."""


@dataclass
class Place:
    """A place on a triangle. Loops of Dr.Jit carry it, so it is not frozen.

    triangle : UInt32, index. b1, b2 : Float, barycentric coordinates.
    """

    triangle: mi.UInt32
    b1: mi.Float
    b2: mi.Float

    @classmethod
    def none(cls, lanes: int) -> Place:
        """The first corner of the first triangle."""
        return cls(dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes))

    def replaced(self, where: mi.Bool, found: mi.PreliminaryIntersection3f) -> Place:
        """The place that a ray found, on the lanes of the mask `where`."""
        return Place(
            dr.select(where, found.prim_index, self.triangle),
            dr.select(where, found.prim_uv.x, self.b1),
            dr.select(where, found.prim_uv.y, self.b2),
        )


class Light(NamedTuple):
    """Light of a triangle at a place.

    direction : Vector3f, unit, world, direction of flight.
    u, v : Float, projector pixel coordinates.
    length : Float, metres, optical length from the projector.
    cosine : Float, cosine between direction and geometric normal where it landed.
    """

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
    seed : int, decides which of the faintest triangles are kept.
    """

    def __init__(
        self, sheets: Sheets, projector_at: np.ndarray, irradiance: float, samples: int, seed: int = 0
    ) -> None:
        period = 1 << int(np.log2(max(1, min(samples // 2, PERIOD))))  # in each half of the samples
        every = min(period, EVERY)
        groups = period // every
        at_vertex, scale, area = irradiance_of(sheets.triangles, sheets.flux, sheets.position, len(sheets.u))
        first = sheets.position[sheets.triangles[:, 0]]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.linalg.norm(first - projector_at, axis=1)
            level = sheets.flux / area * distance**2 / irradiance

        low, high = sheets.position.min(axis=0), sheets.position.max(axis=0)
        size, middle = float((high - low).max()) + MIN_SIZE_M, (0.5 * (low + high)).astype(np.float64)
        # Faint light of lobes is looked for in some samples alone, unless some of it is bright
        self.has_lobes = bool(sheets.lobe.any())
        is_bright = level * sheets.lobe.max() >= FAINT
        bright, of_lobes = (float(sheets.flux[(sheets.lobe > 0) & which].sum()) for which in (is_bright, np.True_))
        self.lobes_in_turn = bright <= FAINT_LOBES * of_lobes
        self.first = 2 if sheets.lobe.all() else 0  # through what samples look first, as `which` of `ray`
        places_needed = 1 + groups + self.has_lobes * LOBE_GROUPS
        across = math.isqrt(places_needed - 1) + 1  # all of them lie in a square
        places = [[g % across, g // across] for g in range(across**2)]
        places = sorted(places, key=lambda place: np.hypot(*(np.array(place) - across // 2)))
        offsets = (np.array(places[:places_needed]) - across // 2) * (SPACING * size)  # bright ones in the middle
        image = np.column_stack([sheets.u, sheets.v]).view(np.uint64)[:, 0]
        columns = (sheets.position, sheets.normal, sheets.triangles, sheets.shape, sheets.key, image)
        flat_lift = (LIFT + 2 * MAX_SAG) * distance  # a flat receiver leaves room that a curved one takes
        is_faint = (level < FAINT) & (sheets.lobe == 0)
        weak = np.flatnonzero(is_faint)
        crowd = crowd_of(sheets.position, sheets.triangles[weak], sheets.shape[weak], area[weak], size / CUBES)
        is_faint[weak[crowd < CROWD]] = False
        fixed = np.where(sheets.lobe > 0, 1 + groups + (sheets.lobe.astype(np.int64) - 1) % LOBE_GROUPS, 0)
        chance = np.minimum(level / FAINTEST, 1)
        salt = np.random.default_rng(seed).integers(1 << 63, dtype=np.uint64)
        numbers = groups, every, LOBE_GROUPS * (every if self.lobes_in_turn else 1)
        corners, names, terms = lifted(
            columns, scale, is_faint, fixed, chance, salt, numbers, LIFT * distance, flat_lift, offsets, middle
        )
        mesh = mi.Mesh("light", len(corners), len(names))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(aligned(corners, np.float32))
        parameters["faces"] = mi.UInt32(aligned(np.arange(len(corners)), np.uint32))
        parameters.update()
        self.scene = mi.load_dict({"type": "scene", "light": mesh})
        # Between vertices the length is interpolated with its gradient, which is exact for a quadratic function: the
        # mean of the values at the vertices and of the tangent planes there
        along = np.einsum("ij,ij->i", sheets.slowness, sheets.position - projector_at)
        looks = np.column_stack(
            [sheets.slowness, sheets.length - 0.5 * along, sheets.u, sheets.v, at_vertex, sheets.cosine]
        )
        self.looks, self.names = mi.Float(aligned(looks, np.float32)), mi.UInt32(aligned(names, np.uint32))
        self.terms, self.offsets = mi.Float(aligned(terms, np.float32)), mi.Float(aligned(offsets, np.float32))
        self.groups, self.every = dr.opaque(mi.UInt32, groups), dr.opaque(mi.UInt32, every)
        half_size = 0.5 * (high - low) + MARGIN * (0.5 * LIFT + MAX_SAG) * distance.max()
        self.projector_at, self.middle, self.half_size = (
            mi.Vector3f(*(dr.opaque(mi.Float, float(c)) for c in place)) for place in (projector_at, middle, half_size)
        )
        is_lit = np.zeros(int(sheets.shape.max()) + 1, np.bool_)
        is_lit[names[:, 3]] = True
        self.is_lit, self.shapes = mi.Bool(is_lit), dr.opaque(mi.UInt32, len(is_lit))

    def may_light(self, point: mi.Point3f, shape: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether any triangle lies on a shape, and the point is in the lit part of the scene, beyond which its copies
        begin."""
        inside = dr.abs(mi.Vector3f(point) - self.middle) < self.half_size
        known = active & dr.all(inside) & (shape < self.shapes)
        return known & dr.gather(mi.Bool, self.is_lit, shape, known)

    def is_turn(self, turn: mi.UInt32, which: mi.UInt32) -> mi.Bool:
        """True where it is this turn; each turn comes once in `every` samples."""
        return turn % self.every == which % self.every

    def ray(
        self,
        point: mi.Point3f,
        normal: mi.Normal3f,
        turn: mi.UInt32,
        lobe_turn: mi.UInt32,
        which: mi.UInt32,
        way: mi.Float,
    ) -> tuple[mi.Ray3f, mi.Float, mi.Float]:
        """The rest of the ray through the triangles that may cover a point, after a way in metres; and the step in
        metres from a triangle that it meets to where the next one is looked for; and the distance from the point to
        which rays look, in metres.

        which : UInt32; 0: through bright triangles, 1: through those of the group of faint ones whose turn it is, 2:
            through those of the group of points of narrow lobes whose turn it is.
        """
        distance = dr.norm(mi.Vector3f(point) - self.projector_at)
        above = MARGIN * (0.5 * LIFT + MAX_SAG) * distance
        group = dr.select(which == 0, 0, turn // self.every % self.groups + 1)
        if self.has_lobes:
            group = dr.select(which == 2, 1 + self.groups + lobe_turn % LOBE_GROUPS, group)
        offset = dr.gather(mi.Vector2f, self.offsets, group)
        place = mi.Point3f(point) - self.middle + mi.Vector3f(offset.x, offset.y, 0)
        ray = mi.Ray3f(place + mi.Vector3f(normal) * (above - way), -mi.Vector3f(normal))
        ray.maxt = 2 * above - way
        # The way along the ray is rounded as well, so in the middle of the scene it counts more than the coordinates
        return ray, STEP * (dr.norm(mi.Vector3f(place)) + 10 * above), above

    def next(self, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """The next triangle on a ray."""
        return self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)

    def irradiance(
        self,
        found: mi.PreliminaryIntersection3f,
        height: mi.Float,
        above: mi.Float,
        shape: mi.UInt32,
        normal: mi.Normal3f,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Bool]:
        """Irradiance (W/m2) of a triangle that was found, and whether it lies on this side of this shape.

        height, above : metres, height of the triangle over the point, and distance to which rays look.
        """
        names = dr.gather(mi.Vector4u, self.names, found.prim_index, active)
        terms = dr.gather(mi.Vector3f, self.terms, found.prim_index, active)
        # On a flat receiver a triangle is as high as it was lifted; otherwise it lies on another part of the shape
        is_here = active & (names.w == shape) & (dr.abs(height - terms.y) < dr.select(terms.z > 0, FLAT * above, above))
        b1, b2 = found.prim_uv.x, found.prim_uv.y
        total = mi.Float(0)
        for index, weight in zip((names.x, names.y, names.z), (1 - b1 - b2, b1, b2), strict=True):
            total += weight * dr.gather(mi.Float, self.looks, 8 * index + 6, is_here)
        direction = dr.gather(mi.Vector4f, self.looks, 2 * names.x, is_here).xyz
        cosine = dr.gather(mi.Float, self.looks, 8 * names.x + 7, is_here)
        is_here &= dr.abs(dr.dot(dr.normalize(direction), normal) - cosine) < MAX_COSINE_DIFFERENCE
        total *= terms.x
        return dr.select(is_here, total, 0), is_here & (total > 0)

    def light(self, place: Place, point: mi.Point3f, active: mi.Bool) -> Light:
        """The light of a triangle at a place, which is `point` in the world."""
        names = dr.gather(mi.Vector4u, self.names, place.triangle, active)
        weights = (1 - place.b1 - place.b2, place.b1, place.b2)
        first, second = mi.Vector4f(0), mi.Vector4f(0)
        for index, weight in zip((names.x, names.y, names.z), weights, strict=True):
            first += weight * dr.gather(mi.Vector4f, self.looks, 2 * index, active)
            second += weight * dr.gather(mi.Vector4f, self.looks, 2 * index + 1, active)
        length = first.w + 0.5 * dr.dot(first.xyz, mi.Vector3f(point) - self.projector_at)
        return Light(dr.normalize(first.xyz), second.x, second.y, length, second.w)
