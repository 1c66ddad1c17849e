# SPDX-License-Identifier: Apache-2.0
"""Caustic photons: the projector's light that goes through glass and off mirrors, up to the first surface that
scatters.

A photon leaves the projector through a pixel, follows delta interactions alone (dielectric, conductor, thin
dielectric, hole), and lands on the first surface that scatters. Light that lands without any delta interaction belongs
to next-event estimation, so such a photon ends at once (`rangesim.light_transport.strategies`). The medium of a
translucent object scatters light out of the way of photons and so weakens them; the photons do not follow that
scattered light. Glass that absorbs weakens them on their way inside (`rangesim.light_transport.absorption`).

Most photons are sent through cells of the projector's image whose light meets a delta surface first. A cell is a pixel,
or a few of them where the image has very many. A pre-pass with one ray per cell finds these cells; their neighbours
count as well. A small fraction of the photons goes through all other cells, so that the estimate has no bias where a
surface is finer than a cell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation

from rangesim.light_transport.camera_rays import CellGrid, Device, PrimaryRay
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.photon_flight import trace_photon_paths
from rangesim.light_transport.sampling import Seed, Stream, random_stream
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.scene.media import is_boundary

DEFENSIVE_FRACTION = 0.05
"""Fraction of the photons that go through pixels where the pre-pass found no delta surface, so that surfaces finer than
a pixel get some. Any fraction above 0 gives the same mean light; a larger one takes photons from the pixels that need
them."""
SURFACES_PER_PHOTON = 2
"""Number of surfaces per photon that is assumed when the size of a launch is chosen. Launches adapt to the time they
take, so that a wrong number costs little."""
SUMMED_TOGETHER = 1 << 16
"""Number of photons per block. The powers within a block are added first. A launch holds whole blocks, so the sum does
not depend on how photons are cut into launches. With larger blocks, the shortest launch would take longer."""
MAX_AT_ONCE = 1 << 20
"""Largest number of photons of a launch, so that NumPy's work on them between launches is short as well."""
BYTES_PER_PHOTON = 128
"""Memory per photon during its flight, in bytes, an upper bound from which the largest launch follows."""


@dataclass(frozen=True, eq=False)
class EnergyBudget:
    """Power of the projector by where it went, watts; emitted = direct + stored + absorbed + escaped + truncated.

    emitted : power that photons were sent out with.
    direct : power that landed without a delta interaction, and is left to next-event estimation.
    stored : power that landed beyond delta interactions, and is kept as photons.
    absorbed : power lost in delta surfaces, in media and inside glass. If a delta surface also scatters, the power that
        it scatters counts here too. Russian roulette absorbs nothing on average.
    escaped : power that met no surface.
    truncated : power still under way after `MAX_CHAIN` surfaces.
    """

    emitted: float
    direct: float
    stored: float
    absorbed: float
    escaped: float
    truncated: float

    @property
    def cut(self) -> float:
        """Ratio of the power that was truncated to the power that was stored."""
        return self.truncated / self.stored if self.stored else 0.0


@dataclass(frozen=True, eq=False)
class Photons:
    """The n photons that landed beyond delta interactions, in the order of their numbers.

    position : (n, 3) float32, metres, world.
    direction : (n, 3) float32, unit, world, direction of flight.
    flux : (n,) float32, watts, while the projector shows white.
    u, v : (n,) float32, projector pixel coordinates.
    length_m : (n,) float32, metres, optical length from the projector.
    cosine : (n,) float32, absolute cosine between the direction and the geometric normal of the surface.
    map : (n,) int, 0 to maps - 1, the independent map to which a photon belongs; each map alone carries all the power.
    maps : int >= 1, number of maps.
    energy : EnergyBudget, mean over the maps.
    per_pixel : float, number of photons of all maps that are sent through a projector pixel whose light meets a delta
        surface first.
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


def has_delta(scene: mi.Scene) -> bool:
    """Whether some surface of a mitsuba.Scene has a delta interaction. Without one there are no photons to trace."""
    return any(map(_is_delta, scene.shapes()))


def _is_delta(shape: mi.Shape) -> bool:
    """Whether the surface of a shape has a delta interaction, and is not the boundary of a medium."""
    return bool(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta)) and not is_boundary(shape)


def meets_delta(
    scene: mi.Scene, count: int, rays_of: Callable[[int, int], PrimaryRay]
) -> tuple[np.ndarray, np.ndarray]:
    """Whether the first surface that each of `count` rays meets has a delta interaction.

    Parameters
    ----------
    rays_of : function that returns the rays from one number up to another, such as those through pixels' centres.

    Returns
    -------
    meets : (count,) bool, whether it has one.
    exists : (count,) bool, whether the lens sends such a ray at all.
    """
    launches, meets, exists = Launches(), np.zeros(count, dtype=bool), np.ones(count, dtype=bool)
    table = mi.Bool(table_of(scene, list(map(_is_delta, scene.shapes()))))
    for begin, end in launches.ranges(count):
        rays = rays_of(begin, end)
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
    """Trace caustic photons, and return those that landed beyond delta interactions.

    Parameters
    ----------
    power_w : watts, power of the projector.
    photons : int, number of photons to send out; they are dealt out evenly to `maps` independent maps.
    seed : int, 0 to 2^64 - 1.
    memory_bytes : largest size of the renderer's arrays during a launch.
    report : called after each kernel launch.
    """
    assert isinstance(traced.projector, Device)  # a beam needs no photons
    grid = CellGrid.of(traced.projector)
    cells, fraction = _chances(traced.scene, traced.projector, grid)
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
        flux = power_w / (len(cells) * per_map * fraction[chosen] / cumulative[-1])
        landing, parts = trace_photon_paths(traced, grid, cells[chosen], flux, number, seed)
        launches.evaluate([list(landing), list(parts)], SURFACES_PER_PHOTON * (end - begin))
        kept = np.flatnonzero(landing.flux)
        landed.append([_columns(x)[kept] for x in landing] + [number[kept] // per_map])
        blocks = np.arange(0, end - begin, SUMMED_TOGETHER)
        for sums in np.column_stack([np.add.reduceat(x.numpy(), blocks, dtype=np.float64) for x in parts]):
            energy += sums
        report()
    position, direction, flux, u, v, length, cosine, of_map = (np.concatenate(c) for c in zip(*landed, strict=True))
    mean_budget = EnergyBudget(*(energy / maps))
    per_pixel = total / (cumulative[-1] * grid.pixels_per_cell)
    return Photons(position, direction, flux, u, v, length, cosine, of_map, maps, mean_budget, per_pixel)


def _chances(scene: mi.Scene, projector: Device, grid: CellGrid) -> tuple[np.ndarray, np.ndarray]:
    """The cells of the projector's image, and the relative chance that a photon is sent through each of them.

    Returns
    -------
    cells : (n,) int, flat indices of all cells, in the order of a Morton curve.
    chance : (n,) float, 1 for cells whose light meets a delta surface first and for their neighbours.
    """
    w, h = grid.columns, grid.rows
    meets, _ = meets_delta(scene, w * h, lambda begin, end: projector.centre_ray(grid.probes(begin, end)))
    mask = binary_dilation(meets.reshape(h, w), np.ones((3, 3))).ravel()
    rest = ~mask
    chance = np.where(
        mask, 1.0, DEFENSIVE_FRACTION / (1 - DEFENSIVE_FRACTION) * max(mask.sum(), 1) / max(rest.sum(), 1)
    )
    # Places grow along every row of the image, so a stable sort has only to merge sorted runs
    order = np.argsort(_morton(w, h).ravel(), kind="stable")
    return order, chance[order]


def _morton(w: int, h: int) -> np.ndarray:
    """(h, w) uint32, places of the pixels along the Morton curve. Even steps along it spread evenly over the image."""

    def spread(a: np.ndarray) -> np.ndarray:
        for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
            a = (a | (a << np.uint32(shift))) & np.uint32(mask)
        return a

    x, y = (np.arange(n, dtype=np.uint32) for n in (w, h))
    return spread(x) | (spread(y)[:, None] << np.uint32(1))


def shift_of(seed: int) -> float:
    """A number that is uniform in 0..1 over the seeds."""
    rng = random_stream(Seed.of(seed), mi.UInt32(0xC2B2AE35), Stream.THIRD)
    return float(rng.next_float64()[0])


def stratified_choice(cumulative: np.ndarray, number: np.ndarray, per_map: int, shift: float) -> np.ndarray:
    """(n,) int, index of the pixel through which each photon is sent.

    The photons of a map are evenly spaced in 0..1 (systematic sampling). Each map is shifted against the others by the
    golden ratio, and all of them by `shift`, in spacings. If `shift` is uniform, so is the place of every photon in its
    stratum. Then the chance of a pixel is its fraction, and the mean over seeds has no bias.

    Parameters
    ----------
    cumulative : (pixels,) float, cumulative sum of the relative chances of the pixels.
    number : (n,) int, numbers of the photons.
    per_map : int, number of photons of each map.
    shift : float, 0..1.
    """
    shifts = (number // per_map * 0.6180339887498949 + shift) % 1.0
    place = (number % per_map + shifts) / per_map
    return np.minimum(np.searchsorted(cumulative, place * cumulative[-1], side="right"), len(cumulative) - 1)


def _columns(array: mi.Float | mi.Vector3f) -> np.ndarray:
    """A Dr.Jit array as an array (n,) or (n, 3) of NumPy."""
    return np.ascontiguousarray(np.array(array).T)
