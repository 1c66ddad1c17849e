# SPDX-License-Identifier: Apache-2.0
"""A plain path tracer that knows the projector as a disc of finite size: slow, simple, and independent of `rangesim`.

Camera paths scatter until a segment happens to cross the disc from its front. The disc blocks nothing and has the
flux of the pinhole it replaces: where the irradiance of white at z = 1 m is E, light that leaves it at the angle
theta to the axis has the radiance E / (pi a^2 cos^4 theta). It is focused at a distance where blur matters least.
Nothing connects to the projector and no photon is stored, so the disc is found through glass and off mirrors like
anywhere else, and the only bias is the blur of the aperture, of order a^2.

Directions at matte surfaces come from a mixture of the BSDF, the case's cone (`Guide`) and a narrow cone around the
projector; all densities are known, so the cones change the noise and not the mean.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from reference_scenes import Guide

from rangesim import Rig

GUIDED_SHARE, STRAIGHT_SHARE = 0.45, 0.1
STRAIGHT_HALF_ANGLE_RAD = 0.04
LANES = 1 << 18
MAX_SURFACES = 130
"""Of a path: a pane guides light along for dozens of reflections."""


class Lamp:
    """The disc, focused at z = `focus_m`, with what it shows: `patterns` (k, height, width). Not a dataclass, which
    Dr.Jit's loops would search for variables."""

    def __init__(self, rig: Rig, radius_m: float, focus_m: float, patterns: np.ndarray) -> None:
        self.rig, self.radius_m, self.focus_m, self.patterns = rig, radius_m, focus_m, patterns

    def radiance(self, point: Any, direction: Any, hit: Any) -> list[Any]:
        """Of white and of each pattern, W/m2/sr, that leaves a point of the disc along `direction`."""
        p, (x, y, z, centre) = self.rig.projector, axes(self.rig.T_world_projector)
        cos = dr.dot(direction, z)
        at = (point - centre) * dr.opaque(mi.Float, 1 / self.focus_m) + direction / cos  # in focus, at z = 1 m
        u = dr.dot(at, x) * dr.opaque(mi.Float, p.fx) + dr.opaque(mi.Float, p.cx)
        v = dr.dot(at, y) * dr.opaque(mi.Float, p.fy) + dr.opaque(mi.Float, p.cy)
        hit &= (u >= 0) & (u < p.width) & (v >= 0) & (v < p.height)
        scale = dr.opaque(mi.Float, self.rig.projector_irradiance / (np.pi * self.radius_m**2))
        white = dr.select(hit, scale / dr.square(dr.square(cos)), 0)
        pixel = mi.UInt32(dr.clip(v, 0, p.height - 1)) * p.width + mi.UInt32(dr.clip(u, 0, p.width - 1))
        tables = [mi.Float(np.ascontiguousarray(a, np.float32).ravel()) for a in self.patterns]
        return [white, *(white * dr.gather(mi.Float, t, pixel, hit) for t in tables)]


class Cone(NamedTuple):
    """A `Guide` on the renderer's side."""

    point: Any
    sign: Any
    cutoff: Any

    def sample(self, si: Any, xi: Any) -> Any:
        """Local direction, uniform in the cone as seen from a surface point."""
        return si.to_local(self._frame(si).to_world(mi.warp.square_to_uniform_cone(xi, self.cutoff)))

    def pdf(self, si: Any, wo: Any) -> Any:
        """Density of a local direction per solid angle."""
        inside = self._frame(si).to_local(si.to_world(wo)).z >= self.cutoff  # Mitsuba's density leaves this test out
        return dr.select(inside, 1 / (2 * dr.pi * (1 - self.cutoff)), 0)

    def _frame(self, si: Any) -> Any:
        return mi.Frame3f(dr.normalize((self.point - mi.Vector3f(si.p)) * self.sign))


def _cone(guide: Guide) -> Cone:
    return Cone(
        point=mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in guide.point)),
        sign=dr.opaque(mi.Float, -1.0 if guide.away else 1.0),
        cutoff=dr.opaque(mi.Float, float(np.cos(guide.half_angle_rad))),
    )


def finite_aperture(scene: Any, lamp: Lamp, guide: Guide, pixels: np.ndarray, spp: int, seed: int) -> np.ndarray:
    """(2 + k, n) float64 radiance at n camera pixels: white, the part of white that meets glass or mirror between the
    projector and the next matte surface, and k patterns.

    `scene` is a mitsuba.Scene, `pixels` (n, 2) int holds column and row. `spp` is rounded up to fill all lanes. Light
    that meets no matte surface at all (the lens seen in a mirror) is left out.
    """
    copies = max(1, LANES // len(pixels))
    per_lane = -(-spp // copies)
    column, row = (mi.UInt32(np.tile(pixels[:, i], copies).astype(np.uint32)) for i in range(2))
    straight = Guide(tuple(lamp.rig.T_world_projector[:3, 3]), STRAIGHT_HALF_ANGLE_RAD)
    number = dr.opaque(mi.UInt32, per_lane)
    sums = _trace(scene, lamp, _cone(guide), _cone(straight), mi.Point2f(column, row), number, seed)
    dr.eval(sums)
    return np.stack([s.numpy().astype(np.float64).reshape(copies, -1).sum(0) for s in sums]) / (copies * per_lane)


def axes(T_world_device: np.ndarray) -> list[Any]:
    """x, y, z and centre of a device, world."""
    return [mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in column)) for column in T_world_device[:3].T]


def add_light(sums: list[Any], radiance: list[Any], throughput: Any, delta: Any) -> list[Any]:
    """Sums after light of white and of the patterns; `delta`: it met glass or mirror since the last matte surface."""
    white, *patterns = (throughput * x for x in radiance)
    return [a + b for a, b in zip(sums, [white, dr.select(delta, white, 0), *patterns], strict=True)]


@dr.syntax
def _trace(scene: Any, lamp: Lamp, guided: Cone, straight: Cone, corner: Any, spp: Any, seed: int) -> list[Any]:
    camera = lamp.rig.camera
    right, down, forward, eye = axes(lamp.rig.T_world_camera)
    focal, principal = dr.opaque(mi.Float, camera.fx), mi.Point2f(camera.cx, camera.cy)
    _, _, axis, centre = axes(lamp.rig.T_world_projector)
    radius2, most = dr.opaque(mi.Float, lamp.radius_m**2), dr.opaque(mi.UInt32, MAX_SURFACES)
    lanes = dr.width(corner)
    rng = mi.PCG32(lanes, dr.opaque(mi.UInt64, seed + 1))
    sums = [dr.zeros(mi.Float, lanes) for _ in range(2 + len(lamp.patterns))]
    sample, depth = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.UInt32, lanes)
    ray = mi.Ray3f(dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Vector3f, lanes))
    throughput = dr.ones(mi.Float, lanes)
    scattered, delta = dr.full(mi.Bool, False, lanes), dr.full(mi.Bool, False, lanes)
    active = sample < spp

    while active:
        starts = depth == 0
        at = (corner + mi.Point2f(rng.next_float32(), rng.next_float32()) - principal) / focal
        ray.o = dr.select(starts, mi.Point3f(eye), ray.o)
        ray.d = dr.select(starts, dr.normalize(right * at.x + down * at.y + forward), ray.d)

        # Does the segment up to the next surface cross the disc, against its light?
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        facing = dr.dot(ray.d, axis)
        t = dr.dot(centre - mi.Vector3f(ray.o), axis) / facing
        crosses = active & scattered & (facing < 0) & (t > 0) & (t < si.t)
        met = mi.Vector3f(ray(t))
        crosses &= dr.squared_norm(met - centre) < radius2
        if crosses:
            sums = add_light(sums, lamp.radiance(met, -ray.d, crosses), dr.select(crosses, throughput, 0), delta)

        # Next direction: delta surfaces as they are, matte ones towards the guide's cone or by their BSDF
        hit = si.is_valid() & active
        bsdf = si.bsdf(ray)
        smooth = hit & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        xi = mi.Point2f(rng.next_float32(), rng.next_float32())
        bs, weight = bsdf.sample(mi.BSDFContext(), si, rng.next_float32(), xi, hit)
        choice = rng.next_float32()
        wo = dr.select(smooth & (choice < GUIDED_SHARE + STRAIGHT_SHARE), straight.sample(si, xi), bs.wo)
        wo = dr.select(smooth & (choice < GUIDED_SHARE), guided.sample(si, xi), wo)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo, smooth)
        density = GUIDED_SHARE * guided.pdf(si, wo) + STRAIGHT_SHARE * straight.pdf(si, wo)
        density += (1 - GUIDED_SHARE - STRAIGHT_SHARE) * pdf
        mixed = dr.select(pdf > 0, value[0] / density, 0)
        throughput *= dr.select(smooth, mixed, weight[0])
        scattered |= smooth
        delta = hit & ~smooth & (delta | scattered)
        ray = si.spawn_ray(si.to_world(wo))
        depth += 1

        ends = ~(
            hit & (throughput > 0) & (depth < most)
        )  # no roulette: its weights would be seen as single bright dots
        sample = dr.select(ends, sample + 1, sample)
        depth = dr.select(ends, 0, depth)
        throughput = dr.select(ends, 1, throughput)
        scattered &= ~ends
        delta &= ~ends
        active = sample < spp
    return sums
