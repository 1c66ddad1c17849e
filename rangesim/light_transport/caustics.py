# SPDX-License-Identifier: Apache-2.0
"""Light beyond glass and mirrors, as camera paths gather it.

This module has the triangles of light made for a pass, and computes the light that they bring to a vertex of a camera
path.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.accumulators import Accumulators
from rangesim.light_transport.beams import BeamDevice
from rangesim.light_transport.caustic_sheets import CAMERA_CELL, Sheets, trace_sheets
from rangesim.light_transport.delta_surfaces import throws_caustics
from rangesim.light_transport.lamps import lamp_sheets
from rangesim.light_transport.sheet_scene import Place, SheetScene
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.surfaces import number_of
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.response import CAUSTIC, LightPath
from rangesim.rig import Rig

NONE = 0xFFFFFFFF
"""Index of no triangle."""
MAX_COSINE_RATIO = 4.0
"""Largest ratio of two cosines of the light's direction: that to the facet at the vertex, and that to the facet where
it landed. Radiance is divided by the second cosine, so without this bound, a facet that light meets edge-on would bring
any amount of light. A smaller bound would darken caustics beside edges where facets meet at an angle."""


def caustic_sheets(
    traced: TracedScene, rigs: Sequence[Rig], settings: TransportSettings, report: Callable[[], None] = lambda: None
) -> Sheets | None:
    """Triangles of light for a pass of any camera; None if the caller wants none, no surface has a delta interaction
    other than holes, or no light landed. A beam needs none, see `rangesim.light_transport.beams`.

    Parameters
    ----------
    rigs : rigs of the pass, which share their emitter.
    report : called after each kernel launch.
    """
    if not settings.caustics or not throws_caustics(traced.scene) or isinstance(traced.projector, BeamDevice):
        return None
    pixel_rad = min(rig.camera.angle_of(1) for rig in rigs)
    return trace_sheets(traced, rigs[0].projector_power_w, settings.seed, pixel_rad, report)


def lamp_caustics(
    traced: TracedScene,
    rigs: Sequence[Rig],
    ranges_m: Sequence[float],
    settings: TransportSettings,
    report: Callable[[], None] = lambda: None,
) -> Sheets | None:
    """Triangles of the light of lamps without extent, for a pass of any camera; None as for `caustic_sheets`.

    Parameters
    ----------
    ranges_m : metres, typical distance of what each camera sees; NaN if it sees nothing.
    """
    pixels_m = [rig.camera.angle_of(1) * range_m for rig, range_m in zip(rigs, ranges_m, strict=True)]
    if not settings.caustics or np.isnan(pixels_m).all():
        return None
    camera_at, projector_at = rigs[0].T_world_camera[:3, 3], rigs[0].T_world_projector[:3, 3]
    return lamp_sheets(traced, CAMERA_CELL * float(np.nanmin(pixels_m)), camera_at, projector_at, settings.seed, report)


def sheet_scene(sheets: Sheets | None, rig: Rig, samples: int, seed: int) -> SheetScene | None:
    """The triangles as kernels see them; None if there are none. `samples` is the smallest number of a pixel, and
    `seed` that of the pass."""
    if sheets is None or not len(sheets.flux):
        return None
    # Points of a lens are sharp, so that light has the blur of the pixels alone
    blur_px = None if rig.projector_lens.focus_m is None else 0.0
    return SheetScene(sheets, rig.T_world_projector[:3, 3], samples, seed, blur_px)


class Vertex(NamedTuple):
    """A vertex of a camera path.

    si, bsdf : SurfaceInteraction3f and BSDFPtr, the surface.
    throughput : Float, radiance at the camera per radiance that leaves the vertex towards it.
    length : Float, metres, optical length from the camera.
    is_first : Bool, whether this light is the first return: the vertex is the first of the path, and the projector
        does not light it straight.
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    throughput: mi.Float
    length: mi.Float
    is_first: mi.Bool


class Draws(NamedTuple):
    """The numbers of a sample that decide which triangles it looks for.

    turn : UInt32, decides about faint triangles; it grows by 1 from sample to sample of a half of the pixel.
    lobe_turn : UInt32, decides about points of narrow lobes; it grows by 1 from sample to sample.
    pick : Float, uniform number in 0..1 that chooses one of the faint triangles.
    """

    turn: mi.UInt32
    lobe_turn: mi.UInt32
    pick: mi.Float


@dr.syntax
def caustic_light(
    sheets: SheetScene,
    accumulators: Accumulators,
    channels: list[list[mi.Float]],
    vertex: Vertex,
    draws: Draws,
    is_later: mi.Bool,
    place: mi.UInt32,
    active: mi.Bool,
) -> tuple[list[list[mi.Float]], mi.Float, mi.Float]:
    """Add the light of all triangles that cover a vertex.

    Returns the channels, and the radiance (W/m2/sr) at the camera of light that is the pixel's own, and of light that
    neighbouring pixels share.

    Parameters
    ----------
    is_later : Bool, whether the vertex is not the first of its path.
    place : UInt32, index of the lane's pixel among those of the accumulators.
    """
    n = dr.width(place)
    si, bsdf = vertex.si, vertex.bsdf
    turn, lobe_turn, pick = draws
    shape, normal = number_of(si.shape), mi.Normal3f(si.n)
    seen = dr.dot(si.to_world(si.wi), si.n)
    sharp, smooth = dr.zeros(mi.Float, n), dr.zeros(mi.Float, n)
    last, total, chosen = dr.full(mi.UInt32, NONE, n), dr.zeros(mi.Float, n), Place.none(n)
    # Later vertices bring little each, so they look in some samples alone, which count for all
    is_turn = sheets.is_turn(turn, dr.select(is_later, mi.UInt32(1), 0))
    bright, faint = sheets.may_light(si.p, active & (~is_later | is_turn))
    faint &= is_turn
    looks, way, which = bright | faint, dr.zeros(mi.Float, n), dr.select(bright, mi.UInt32(sheets.first), 1)
    weight_of_bright = dr.select(is_later, mi.Float(sheets.every), 1)
    # What the loop only reads is excluded: Dr.Jit traces a loop twice that carries something without changing it
    while dr.hint(
        looks,
        exclude=[si, bsdf, vertex, shape, normal, seen, turn, lobe_turn, is_later, place, faint, weight_of_bright],
    ):
        # ---- The next triangle: each bright one counts, and one of the faint ones stands for all of them -----
        ray, step, above = sheets.ray(si.p, normal, turn, lobe_turn, which, way)
        found = sheets.next(ray, looks)
        hit = looks & found.is_valid()
        is_new = hit & (found.prim_index != last)
        irradiance, is_here = sheets.irradiance(found, ray.maxt - found.t - above, above, shape, normal, is_new)
        irradiance *= dr.select(which == 1, 1, weight_of_bright)
        total += irradiance
        fraction = dr.select(is_here, irradiance / total, 0)
        taken = is_here & ((which == 0) | (pick < fraction))
        pick = dr.select(which == 0, pick, dr.select(taken, pick / fraction, (pick - fraction) / (1 - fraction)))
        chosen = chosen.replaced(taken, found)
        counts = (total > 0) & dr.select(which == 0, is_here, ~hit)
        if dr.hint(counts, exclude=[si, bsdf, vertex, seen, is_later, place, faint, weight_of_bright]):
            light = sheets.light(chosen, si.p, counts)
            wo = si.to_local(-light.direction)
            value = bsdf.eval(mi.BSDFContext(), si, wo, counts)
            # Triangles count flux per area, which contains the geometric cosine already; the value of the BSDF contains
            # the cosine to the shading normal (Veach 1997, 5.3)
            lit = -dr.dot(light.direction, si.n)
            cosine = dr.maximum(dr.abs(light.cosine), dr.abs(lit) / MAX_COSINE_RATIO)
            on_one_side = counts & (seen * lit * si.wi.z * wo.z > 0)  # for both normals, or for neither
            brought = dr.select(on_one_side, vertex.throughput * total * mono(value) / cosine, 0)
            is_smooth = is_later | light.is_shared
            sharp += dr.select(is_smooth, 0, brought)
            smooth += dr.select(is_smooth, brought, 0)
            length = vertex.length + light.length
            path = LightPath(light.u, light.v, length, vertex.is_first, mi.UInt32(CAUSTIC), sheets.blur_px)
            channels = accumulators.add(channels, path, brought, place, on_one_side, is_smooth)
        total = dr.select(counts, 0, total)
        last = dr.select(hit, found.prim_index, last)
        way = dr.select(hit, way + found.t + step, 0)
        if dr.hint(sheets.has_lobes, mode="scalar"):  # bright light, then lobes, then faint light
            following = dr.select(which == 0, mi.UInt32(2), dr.select((which == 2) & faint, mi.UInt32(1), 3))
            which = dr.select(hit, which, following)
            looks &= which != 3
        else:
            which = dr.select(hit, which, which + 1)
            looks &= (which == 0) | ((which == 1) & faint)
    return channels, sharp, smooth
