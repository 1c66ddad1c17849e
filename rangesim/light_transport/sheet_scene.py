# SPDX-License-Identifier: Apache-2.0
"""Triangles of light as kernels see them: the search for those that cover a point of a surface.

The triangles are a scene of their own. A short ray along the normal of the surface meets all of them that cover the
point, one after the other. Triangles that lie in one plane would hide each other, so each of them is lifted off the
surface by a distance of its own.

A table of directions from the projector tells where a search is worth its ray.

Faint triangles are many and bring little. They are dealt out to groups, in copies of the scene that lie side by side.
One sample of a pixel in a few looks into one group, whose light counts for all, and neighbouring pixels share this
light (`indirect_filter`). Bright light of narrow lobes is dealt out to groups as well, by the points of the lobes; each
sample looks into one of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.caustic_kernels import crowd_of, irradiance_of, lifted, lit_directions
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
GROUPS = 4
"""Number of groups of faint triangles, a power of 2. With twice as many groups, a pass of glassware takes as long,
because there are more copies of triangles."""
EVERY = 8
"""Largest number of samples of which one looks for faint triangles. At 4 a pass of glassware takes 8 % longer and has
5 % less noise; at 16 it is 2 % faster and has 12 % more noise."""
CROWD = 2.5
"""Number of faint triangles over a point from which neighbouring pixels share their light. Fewer may show a pattern,
such as stripes in the reflection of a mirror."""
CUBES = 64
"""Number of cubes along the lit part of the scene, in which faint triangles are counted. With fewer cubes, the count of
a small spot would be that of its surroundings."""
FAINTEST = 1e-3
"""Ratio of the irradiance to direct light below which faint triangles are drawn by lot, anew for each seed. There are
many of them, and together they bring a few thousandths of the light."""
DIRECTIONS = 128
"""Number of cubes along the cube of unit vectors, in which directions with light are marked: as fine as triangles, and
so few that the table fits into a cache."""
REACH = 2 * MARGIN * (0.5 * LIFT + MAX_SAG)
"""Radians by which the direction of a point may differ from that of a triangle that lights it: twice the distance over
which rays look, so that rounding does not matter."""
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
    is_shared : Bool, whether neighbouring pixels share it.
    """

    direction: mi.Vector3f
    u: mi.Float
    v: mi.Float
    length: mi.Float
    cosine: mi.Float
    is_shared: mi.Bool


class SheetScene:
    """Triangles of light, ready for kernels.

    Parameters
    ----------
    sheets : Sheets, at least one triangle.
    projector_at : (3,) float, metres, world.
    samples : int, smallest number of samples of a pixel.
    seed : int, decides which of the faintest triangles are kept.
    blur_px : blur of the light of every triangle, see `rangesim.response.LightPath`.
    """

    def __init__(
        self, sheets: Sheets, projector_at: np.ndarray, samples: int, seed: int = 0, blur_px: float | None = None
    ) -> None:
        self.blur_px = None if blur_px is None else mi.Float(blur_px)
        at_vertex, scale, area = irradiance_of(sheets.triangles, sheets.flux, sheets.position, len(sheets.u))
        first = sheets.position[sheets.triangles[:, 0]]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.linalg.norm(first - projector_at, axis=1)
            level = sheets.flux / area / sheets.direct
            # A faint triangle lies in more groups the brighter it is, so that each one found brings about as much
            copies = np.clip(2 ** np.ceil(np.log2(GROUPS * level / FAINT)), 1, GROUPS)
        # Light of a narrow lobe is faint where that of all its points together is
        is_faint = level * np.where(sheets.lobe > 0, max(sheets.lobe.max(), 1), 1) < FAINT
        copies = np.where(is_faint, copies, 0).astype(np.int64)
        every = 1 << int(np.log2(max(1, min(samples // 2, EVERY))))  # each half of the samples looks once
        group_of_lobe = 1 + GROUPS + (sheets.lobe.astype(np.int64) - 1) % LOBE_GROUPS
        of_lobe = np.where((sheets.lobe > 0) & ~is_faint, group_of_lobe, 0)
        self.has_lobes = bool(of_lobe.any())
        # What samples look for first where there is bright light, as `which` of `ray`
        self.first = 2 if self.has_lobes and (copies[of_lobe == 0] > 0).all() else 0

        low, high = sheets.position.min(axis=0), sheets.position.max(axis=0)
        size, middle = float((high - low).max()) + MIN_SIZE_M, (0.5 * (low + high)).astype(np.float64)
        # A faint triangle by itself lies in all groups, so that what it shows is as sharp as in bright light
        weak = np.flatnonzero(is_faint)
        crowd = crowd_of(sheets.position, sheets.triangles[weak], sheets.shape[weak], area[weak], size / CUBES)
        is_shared = np.zeros(len(level), np.bool_)
        is_shared[weak] = crowd >= CROWD
        copies[is_faint & ~is_shared] = GROUPS
        copied = 1 + GROUPS + self.has_lobes * LOBE_GROUPS
        across = math.isqrt(copied - 1) + 1  # all of them lie in a square
        places = [[g % across, g // across] for g in range(across**2)]
        places = sorted(places, key=lambda place: np.hypot(*(np.array(place) - across // 2)))
        offsets = (np.array(places[:copied]) - across // 2) * (SPACING * size)  # bright ones in the middle
        image = np.column_stack([sheets.u, sheets.v]).view(np.uint64)[:, 0]
        columns = (sheets.position, sheets.normal, sheets.triangles, sheets.shape, sheets.key, image)
        flat_lift = (LIFT + 2 * MAX_SAG) * distance  # a flat receiver leaves room that a curved one takes
        chance = np.minimum(level / FAINTEST, 1)
        salt = np.random.default_rng(seed).integers(1 << 63, dtype=np.uint64)
        numbers = GROUPS, every, LOBE_GROUPS
        corners, names, terms, faint = lifted(
            columns,
            scale,
            copies,
            is_shared,
            of_lobe,
            chance,
            salt,
            numbers,
            LIFT * distance,
            flat_lift,
            offsets,
            middle,
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
        self.every = dr.opaque(mi.UInt32, every)
        self.projector_at, self.middle = (
            mi.Vector3f(*(dr.opaque(mi.Float, float(c)) for c in place)) for place in (projector_at, middle)
        )
        from_projector = sheets.position - np.asarray(projector_at, np.float32)
        lit = lit_directions(from_projector, names[:, :3], faint, DIRECTIONS, REACH)
        self.lit = mi.UInt32(aligned(lit, np.uint32))

    def may_light(self, point: mi.Point3f, active: mi.Bool) -> tuple[mi.Bool, mi.Bool]:
        """Whether bright triangles, and whether faint ones, lie in about the direction of a point."""
        direction = dr.normalize(mi.Vector3f(point) - self.projector_at)
        x, y, z = (dr.minimum(mi.UInt32((d + 1) * (0.5 * DIRECTIONS)), DIRECTIONS - 1) for d in direction)
        cube = (x * DIRECTIONS + y) * DIRECTIONS + z
        bits = dr.gather(mi.UInt32, self.lit, cube >> 4, active) >> ((cube & 15) << 1)
        return active & ((bits & 1) != 0), active & ((bits & 2) != 0)

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
        group = dr.select(which == 0, 0, turn // self.every % GROUPS + 1)
        if self.has_lobes:
            group = dr.select(which == 2, 1 + GROUPS + lobe_turn % LOBE_GROUPS, group)
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
        terms = dr.gather(mi.Vector4f, self.terms, found.prim_index, active)
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
        is_shared = dr.gather(mi.Float, self.terms, 4 * place.triangle + 3, active) > 0
        return Light(dr.normalize(first.xyz), second.x, second.y, length, second.w, is_shared)
