# SPDX-License-Identifier: Apache-2.0
"""Caustic photons: projector light on its way through glass and off mirrors, up to the first surface that scatters it.

A photon leaves the projector through a pixel, follows delta interactions alone (dielectric, conductor, thin
dielectric, hole), and lands on the first non-delta surface. Light that lands without any delta interaction is
next-event estimation's (`rangesim.light_transport.loop`) and ends at once. A translucent object's medium weakens
photons by what it scatters out of their way; that scattered light is not followed further. Glass that absorbs weakens
them on their way inside (`rangesim.light_transport.absorption`).

Only pixels whose light meets a delta surface first are worth photons. A pre-pass with one ray per pixel finds them and
their neighbours; a small fraction of the photons goes to all other pixels, so that the estimate stays unbiased where
something is finer than a pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation

from rangesim.light_transport.device import Device
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.photon_flight import trace_photon_paths
from rangesim.light_transport.sampling import Seed, Stream, random_stream
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.scene.media import is_boundary

DEFENSIVE_FRACTION = 0.05
"""Of the photons, for the pixels where the pre-pass found no delta surface."""
SURFACES_PER_PHOTON = 2
"""Surfaces that a photon meets on average, about, on which the size of launches rests."""
SUMMED_TOGETHER = 1 << 16
"""Photons whose parts are added up first, so that the sum does not depend on launches."""
MAX_AT_ONCE = 1 << 20
"""Photons of a launch, so that what NumPy does with them is short as well."""
BYTES_PER_PHOTON = 128
"""While it flies, an upper bound."""


@dataclass(frozen=True, eq=False)
class EnergyBudget:
    """Where the projector's power went, watts; emitted = direct + stored + absorbed + escaped + truncated.

    emitted : of the pixels that photons were sent through. direct : landed without a delta surface, left to next-event
    estimation. stored : landed beyond delta surfaces. absorbed : by delta surfaces and by the parts of mixed ones that
    scatter, by media, and inside glass; by Russian roulette on average nothing. escaped : met no surface.
    truncated : still under way after `MAX_CHAIN` surfaces.
    """

    emitted: float
    direct: float
    stored: float
    absorbed: float
    escaped: float
    truncated: float

    @property
    def cut(self) -> float:
        """Flux that was cut off, over that which landed."""
        return self.truncated / self.stored if self.stored else 0.0


@dataclass(frozen=True, eq=False)
class Photons:
    """Photons that landed, n of them, in the order of their numbers.

    position, direction : (n, 3) float32, metres and unit, world; the direction is that of flight.
    flux : (n,) float32, watts, of white.
    u, v : (n,) float32, projector pixel coordinates.
    length_m : (n,) float32, metres, optical length from the projector.
    cosine : (n,) float32, of the direction to the geometric normal where it landed.
    map : (n,) int in 0..maps - 1, which of the independent maps a photon belongs to; each alone carries all the power.
    maps : int >= 1, how many there are.
    energy : EnergyBudget, the mean over the maps.
    per_pixel : float, photons of all maps sent through each projector pixel that is worth it.
    """

    position: np.ndarray
    direction: np.ndarray
    flux: np.ndarray
    u: np.ndarray
    v: np.ndarray
    length_m: np.ndarray
    cosine: np.ndarray
    map: np.ndarray
    maps: int
    energy: EnergyBudget
    per_pixel: float


def has_delta(scene: Any) -> bool:
    """Whether some surface of a mitsuba.Scene has a delta interaction: without one there is nothing to trace."""
    return any(map(_is_delta, scene.shapes()))


def _is_delta(shape: Any) -> bool:
    """Whether the surface of a shape has a delta interaction, and is not the boundary of a medium."""
    return bool(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta)) and not is_boundary(shape)


def meets_delta(scene: Any, device: Device) -> tuple[np.ndarray, np.ndarray]:
    """(pixels,) bool: whether the first surface behind each pixel's centre has a delta interaction; and whether the
    lens sends a ray through it at all."""
    launches, meets, exists = Launches(), np.zeros(device.pixels, dtype=bool), np.ones(device.pixels, dtype=bool)
    table = mi.Bool(table_of(scene, list(map(_is_delta, scene.shapes()))))
    for begin, end in launches.ranges(device.pixels):
        rays = device.centre_rays(begin, end)
        found = scene.ray_intersect_preliminary(mi.Ray3f(rays.origin, rays.direction))
        delta = dr.gather(mi.Bool, table, number_of(found.shape), found.is_valid())
        launches.evaluate([delta, rays.exists], end - begin)
        meets[begin:end] = delta.numpy()
        if rays.exists is not None:  # a distorted lens
            exists[begin:end] = rays.exists.numpy()
    return meets, exists


def trace_photons(
    traced: TracedScene,
    power_w: float,
    photons: int,
    maps: int,
    seed: int,
    memory_bytes: int,
    report: Callable[[], None] = lambda: None,
) -> Photons:
    """`photons` photons of a projector of that power, dealt out evenly to `maps` independent maps.

    `report` is called after each kernel launch.
    """
    pixels, fraction = _worthwhile_pixels(traced.scene, traced.projector)
    per_map = -(-photons // maps)
    cumulative, shift = np.cumsum(fraction), shift_of(seed)
    total = per_map * maps
    most = max(1, min(memory_bytes // BYTES_PER_PHOTON, MAX_AT_ONCE))
    landed: list[list[np.ndarray]] = []
    energy = np.zeros(len(EnergyBudget.__dataclass_fields__))
    launches = Launches()
    for begin, end in launches.ranges(total, SURFACES_PER_PHOTON, min(most, SUMMED_TOGETHER), at_most=most):
        number = np.arange(begin, end)
        chosen = stratified_choice(cumulative, number, per_map, shift)
        flux = power_w / (len(pixels) * per_map * fraction[chosen] / cumulative[-1])
        landing, parts = trace_photon_paths(traced, pixels[chosen], flux, number, seed)
        launches.evaluate([list(landing), list(parts)], SURFACES_PER_PHOTON * (end - begin))
        kept = np.flatnonzero(landing.flux)
        landed.append([_columns(x)[kept] for x in landing] + [number[kept] // per_map])
        blocks = np.arange(0, end - begin, SUMMED_TOGETHER)
        for sums in np.column_stack([np.add.reduceat(x.numpy(), blocks, dtype=np.float64) for x in parts]):
            energy += sums
        report()
    position, direction, flux, u, v, length, cosine, of_map = (np.concatenate(c) for c in zip(*landed, strict=True))
    mean_budget = EnergyBudget(*(energy / maps))
    return Photons(position, direction, flux, u, v, length, cosine, of_map, maps, mean_budget, total / cumulative[-1])


def _worthwhile_pixels(scene: Any, projector: Device) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of all projector pixels along a Morton curve, and the relative chance of a photon for each."""
    meets, _ = meets_delta(scene, projector)
    w, h = (int(n[0]) for n in projector.size)
    mask = binary_dilation(meets.reshape(h, w), np.ones((3, 3))).ravel()
    rest = ~mask
    chance = np.where(
        mask, 1.0, DEFENSIVE_FRACTION / (1 - DEFENSIVE_FRACTION) * max(mask.sum(), 1) / max(rest.sum(), 1)
    )
    # Places grow along every row of the image: runs, which a stable sort merges
    order = np.argsort(_morton(w, h).ravel(), kind="stable")
    return order, chance[order]


def _morton(w: int, h: int) -> np.ndarray:
    """(h, w) uint32, place along the Morton curve: even steps along it are spread evenly over the image."""

    def spread(a: np.ndarray) -> np.ndarray:
        for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
            a = (a | (a << np.uint32(shift))) & np.uint32(mask)
        return a

    x, y = (np.arange(n, dtype=np.uint32) for n in (w, h))
    return spread(x) | (spread(y)[:, None] << np.uint32(1))


def shift_of(seed: int) -> float:
    """Uniform in 0..1, of the seed's own random numbers."""
    rng = random_stream(Seed.of(seed), mi.UInt32(0xC2B2AE35), Stream.THIRD)
    return float(rng.next_float64()[0])


def stratified_choice(cumulative: np.ndarray, number: np.ndarray, per_map: int, shift: float) -> np.ndarray:
    """Which of the pixels with these cumulative chances each photon is sent through.

    The photons of a map are evenly spaced in 0..1 (systematic sampling), each map shifted against the others (golden
    ratio) and all by `shift`, in spacings. If that is uniform, so is every photon's place in its stratum: the chance of
    a pixel is its fraction, and the mean over seeds has no bias.
    """
    shifts = (number // per_map * 0.6180339887498949 + shift) % 1.0
    place = (number % per_map + shifts) / per_map
    return np.minimum(np.searchsorted(cumulative, place * cumulative[-1], side="right"), len(cumulative) - 1)


def _columns(array: Any) -> np.ndarray:
    """(n,) or (n, 3) of a Dr.Jit array."""
    return np.ascontiguousarray(np.array(array).T)
