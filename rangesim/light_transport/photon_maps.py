# SPDX-License-Identifier: Apache-2.0
"""Photon maps on hash grids, and the light they bring to a surface point.

Density estimation after Jensen ("Realistic Image Synthesis Using Photon Mapping", 2001), with many small maps instead
of one large one: sample s of a pixel looks into map s mod n, and the maps' radii shrink as in probabilistic progressive
photon mapping (Knaus, Zwicker 2011, eq. 15; their alpha is our `ALPHA`). A sample so pays for a few photons only, and
the pixel as a whole sees all of them.

Photons are sorted into `LEVELS` by the light they bring, compared with the projector's direct light. Fainter light is
gathered over larger radii, because few photons carry it, and by fewer vertices, because little depends on it.

At a vertex, one photon within the radius is chosen with a chance proportional to its weight (reservoir sampling); it
stands for them all. So BSDF and sensor responses are evaluated once per vertex, however many photons are near.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.photons import Photons

ALPHA = 2 / 3
MOST_MAPS = 64
"""Photon maps; with more samples per pixel than this, several samples share a map."""
FLATNESS = 0.3
"""Photons farther than this share of the radius above or below the tangent plane lie on another surface."""
MOST_LOOKED_AT = 16
"""Photons that a gather looks at, where there are more."""
OCCUPANCY_CELLS = 1 << 18
PRIMES = (73856093, 19349663, 83492791)
"""Spatial hash (Teschner et al. 2003), but added: combined by exclusive or, opposite cells would share a place."""
FOLD = 1024
"""Cells along x after which a row turns back on itself, so that the table stays small in a large scene."""
ROW_FACTORS = (0x9E3779B3, 0x85EBCA75)


class Level(NamedTuple):
    """How photons of one brightness are gathered.

    brightest : of the photons of this level, irradiance as a share of the direct light.
    radius : times the radius of the brightest level.
    chance : that a vertex gathers them.
    """

    brightest: float
    radius: float
    chance: float


LEVELS = (Level(np.inf, 1.0, 1.0), Level(0.1, 2.5, 0.25), Level(0.01, 6.0, 0.1))


class Gathered(NamedTuple):
    """The photons near a point: index of the one that stands for all, and their irradiance in W/m2; 0: none."""

    photon: Any
    irradiance: Any


class Flight(NamedTuple):
    """How a photon came: unit direction of flight (world), projector pixel coordinates, optical length in metres."""

    direction: Any
    u: Any
    v: Any
    length: Any


class PhotonMaps:
    """Photons sorted into grid cells of twice the radius of their map and level, on the renderer's side.

    A point looks at 2 x 2 x 2 cells. The two along x are neighbours in memory, so that makes four ranges of photons.

    Parameters
    ----------
    photons : Photons, one or more.
    maps : int in 1..MOST_MAPS, independent maps they were dealt out to.
    radius_m : metres, largest radius of the brightest level.
    irradiance : W/m2, direct light of the projector where the scene is.
    wide_m : metres, radius from which on gathered light counts as smooth.
    """

    def __init__(self, photons: Photons, maps: int, radius_m: float, irradiance: float, wide_m: float = np.inf) -> None:
        self.is_wide = [radius_m * one.radius >= wide_m for one in LEVELS]
        self.maps = dr.opaque(mi.UInt32, maps)
        self.cut = photons.balance.cut
        level = levels_of(photons, maps, 4 * radius_m, irradiance)
        radii = np.concatenate([radii_of_maps(radius_m * one.radius, maps) for one in LEVELS])
        of_map = level * maps + photons.map
        origin = photons.position.min(axis=0) - radii.max()
        rows = 1 << int(np.ceil(np.log2(max(16, len(photons.flux) / maps))))
        cell = np.floor((photons.position - origin) * (0.5 / radii[of_map])[:, None].astype(np.float32)).astype(
            np.int64
        )
        stride = rows + FOLD + 1
        key = of_map * stride + _row(cell[:, 1], cell[:, 2], rows - 1) + _column(cell[:, 0])
        order = np.argsort(key, kind="stable")
        starts = np.cumsum(np.bincount(key + 1, minlength=len(radii) * stride + 1))
        points = np.column_stack([photons.position, photons.flux])
        padding = np.zeros((len(order), 2), np.float32)
        flights = np.column_stack([photons.direction, photons.u, photons.v, photons.length_m, padding])

        opaque = lambda x: dr.opaque(mi.Float, float(x))  # noqa: E731
        self.starts = mi.UInt32(starts.astype(np.uint32))
        self.points = mi.Float(points[order].astype(np.float32).ravel())
        self.flights = mi.Float(flights[order].astype(np.float32).ravel())
        self.radii = mi.Float(radii.astype(np.float32))
        self.origin = mi.Vector3f(*(opaque(x) for x in origin))
        self.row_mask, self.stride = dr.opaque(mi.UInt32, rows - 1), dr.opaque(mi.UInt32, stride)
        self.coarse = [opaque(0.5 / (radius_m * one.radius)) for one in LEVELS]
        self.occupied = [
            mi.UInt32(_occupancy(photons.position[level == i] - origin, photons.map[level == i], radius_m * one.radius))
            for i, one in enumerate(LEVELS)
        ]
        dr.eval([self.starts, self.points, self.flights, self.radii, *self.occupied])

    def near(self, level: int, point: Any, sample: Any, active: Any) -> Any:
        """Whether there may be photons of a level within its radius, in the map of `sample`."""
        cell = dr.floor((mi.Vector3f(point) - self.origin) * self.coarse[level])
        index = _hash(*(mi.UInt32(mi.Int32(x)) for x in cell)) & (OCCUPANCY_CELLS - 1)
        of_map = sample % self.maps
        bits = dr.gather(mi.UInt32, self.occupied[level], index * (MOST_MAPS // 32) + (of_map >> 5), active)
        return active & ((bits >> (of_map & 31)) & 1 != 0)

    @dr.syntax
    def gather(self, level: int, point: Any, normal: Any, sample: Any, pick: Any, offset: Any, active: Any) -> Gathered:
        """Photons of a level around a surface point, in the map of `sample`; `pick`, `offset` are uniform in 0..1."""
        of_map = sample % self.maps + level * self.maps
        radius = dr.gather(mi.Float, self.radii, of_map, active)
        starts, counts = self._ranges(point, of_map, radius, active)
        one, two = counts[0] + counts[1], counts[0] + counts[1] + counts[2]
        count = two + counts[3]
        # Where photons crowd, every n-th will do; they are in the order in which they left the projector
        every = (count + (MOST_LOOKED_AT - 1)) // MOST_LOOKED_AT
        k = mi.UInt32(offset * mi.Float(every))
        total, chosen, pick = mi.Float(0), mi.UInt32(0), mi.Float(pick)
        inverse_square, flat = dr.rcp(dr.square(radius)), FLATNESS * radius
        while active & (k < count):
            upper = dr.select(k < two, starts[2] + (k - one), starts[3] + (k - two))
            lower = dr.select(k < counts[0], starts[0] + k, starts[1] + (k - counts[0]))
            index = dr.select(k < one, lower, upper)
            photon = dr.gather(mi.Vector4f, self.points, index)
            d = mi.Vector3f(photon.x, photon.y, photon.z) - mi.Vector3f(point)
            kernel = 1 - dr.squared_norm(d) * inverse_square  # Epanechnikov: soft edge, less blur than a disc
            beside = (kernel > 0) & (dr.abs(dr.dot(d, normal)) < flat)
            weight = dr.select(beside, kernel * photon.w, 0)
            total += weight
            share = dr.select(beside, weight / total, 0)
            taken = pick < share
            chosen = dr.select(taken, index, chosen)
            pick = dr.select(taken, pick / share, (pick - share) / (1 - share))  # as good as new
            k += every
        return Gathered(chosen, total * mi.Float(every) * (2 / dr.pi) * inverse_square)

    def flight(self, photon: Any, active: Any) -> Flight:
        """How a photon came."""
        a, b = (dr.gather(mi.Vector4f, self.flights, photon * 2 + half, active) for half in (0, 1))
        return Flight(mi.Vector3f(a.x, a.y, a.z), a.w, b.x, b.y)

    def _ranges(self, point: Any, of_map: Any, radius: Any, active: Any) -> tuple[list[Any], list[Any]]:
        """Start and length of the four ranges of photons that lie in the 2 x 2 x 2 cells around a point."""
        base = dr.floor((mi.Vector3f(point) - self.origin) * (0.5 * dr.rcp(radius)) - 0.5)
        x, y, z = mi.Int32(base.x), mi.UInt32(mi.Int32(base.y)), mi.UInt32(mi.Int32(base.z))
        first = mi.UInt32(dr.minimum(_column(x), _column(x + 1)))  # the other one follows
        starts, counts = [], []
        for dy, dz in ((0, 0), (1, 0), (0, 1), (1, 1)):
            row = of_map * self.stride + _row(y + dy, z + dz, self.row_mask)
            begin = dr.gather(mi.UInt32, self.starts, row + first, active)
            end = dr.gather(mi.UInt32, self.starts, row + first + 2, active)
            starts.append(begin)
            counts.append(end - begin)
        return starts, counts


def radii_of_maps(radius_m: float, maps: int) -> np.ndarray:
    """(maps,) float64, metres: r_1 = radius_m, r_(i+1)^2 = r_i^2 (i + alpha) / (i + 1)."""
    i = np.arange(1, maps)
    return np.asarray(radius_m * np.sqrt(np.cumprod(np.concatenate([[1.0], (i + ALPHA) / (i + 1)]))))


def levels_of(photons: Photons, maps: int, cell_m: float, irradiance: float) -> np.ndarray:
    """(n,) int, index into `LEVELS`, from the irradiance that the photons of all maps bring to a cell of that edge."""
    key = _hash(*np.floor(photons.position / cell_m).astype(np.int64).T) & (OCCUPANCY_CELLS - 1)
    power = np.bincount(key, photons.flux, OCCUPANCY_CELLS)[key] / maps
    share = power / (irradiance * cell_m**2)
    return np.count_nonzero([share < one.brightest for one in LEVELS], axis=0) - 1


def _hash(x: Any, y: Any, z: Any) -> Any:
    """Hash of integer cell coordinates; NumPy integers and Dr.Jit UInt32 alike give the same low 32 bits."""
    return x * PRIMES[0] + y * PRIMES[1] + z * PRIMES[2]


def _column(x: Any) -> Any:
    """Place of a cell within its row, in 0..FOLD; neighbours stay neighbours. NumPy integers and Dr.Jit Int32."""
    return FOLD - abs(FOLD - (x & (2 * FOLD - 1)))


def _row(y: Any, z: Any, mask: Any) -> Any:
    """Where the cells of a row along x begin, in 0..mask; mask + 1 is a power of two of at least 16.

    A point looks at two cells in each of four neighbouring rows and must count no photon twice, so these begin two
    cells or more apart: their differences are 3, 5, 8 or 2 modulo 16.
    """
    return (y * ROW_FACTORS[0] + z * ROW_FACTORS[1]) & mask


def _occupancy(position: np.ndarray, of_map: np.ndarray, radius_m: float) -> np.ndarray:
    """(cells * MOST_MAPS / 32,) uint32: one bit per map and hash of a cell within the radius of some photon."""
    occupied = np.zeros(OCCUPANCY_CELLS * MOST_MAPS, dtype=bool)
    size = 2 * radius_m
    low = np.floor((position - radius_m) / size).astype(np.int64)
    high = np.floor((position + radius_m) / size).astype(np.int64)
    for corner in range(8):
        cell = [np.where(corner >> axis & 1, high[:, axis], low[:, axis]) for axis in range(3)]
        occupied[(_hash(*cell) & (OCCUPANCY_CELLS - 1)) * MOST_MAPS + of_map] = True
    return np.packbits(occupied, bitorder="little").view(np.uint32)
