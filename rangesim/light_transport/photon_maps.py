# SPDX-License-Identifier: Apache-2.0
"""Photon maps on hash grids, and the light they bring to a surface point.

Density estimation after Jensen ("Realistic Image Synthesis Using Photon Mapping", 2001), with many small maps instead
of one large one: sample s of a pixel looks into map s mod n, and the maps' radii shrink as in probabilistic progressive
photon mapping (Knaus, Zwicker 2011, eq. 15; their alpha is our `ALPHA`). A sample so pays for a few photons only, and
the pixel as a whole sees all of them.

How far a gather reaches follows from where it is (`GatheringRadius`). A grid has cells of one size, so photons are
sorted by the radius there into classes, `CLASSES_PER_OCTAVE` for each factor of two, and a point looks into the cells
of its own class. Photons near a border between two classes are in the cells of both.

Photons are sorted into `LEVELS` by the light they bring, compared with the projector's direct light. Fainter light is
gathered over larger radii, because few photons carry it, and by fewer vertices, because little depends on it.

At a vertex, one photon within the radius is chosen with a chance proportional to its weight (reservoir sampling); it
stands for them all. So BSDF and sensor responses are evaluated once per vertex, however many photons are near.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.photons import Photons
from rangesim.light_transport.sampling import aligned

ALPHA = 2 / 3
MAX_MAPS = 64
"""Photon maps; with more samples per pixel than this, several samples share a map."""
CLASSES_PER_OCTAVE = 4
STEEPEST = 1 / 12
"""Radius of the brightest level over the distance, at most; that of the faintest is half the distance then."""
FLATNESS = 0.3
"""Photons farther than this fraction of the radius above or below the tangent plane lie on another surface."""
MAX_LOOKED_AT = 16
"""Photons that a gather looks at, where there are more."""
OCCUPANCY_CELLS = 1 << 18
PRIMES = (73856093, 19349663, 83492791)
"""Spatial hash (Teschner et al. 2003), but added: combined by exclusive or, opposite cells would share a place."""
CLASS_PRIME = 50331653
"""The same for the number of a class."""
BESIDE = 1e-4
"""Relative error of a radius that does not put a photon into the wrong class."""
TYPICAL = 0.05
"""Quantile of the radii, over the distance from the camera, that stands for them all."""
FOLD = 1024
"""Cells along x after which a row turns back on itself, so that the table stays small in a large scene."""
ROW_FACTORS = (0x9E3779B3, 0x85EBCA75)
CLASS_FACTOR = 0xC2B2AE3D
UNBOUNDED = 1e30
"""Stands for infinity in single precision."""
MIN_M = 1e-9
"""Least radius: at a device itself."""


class Level(NamedTuple):
    """How photons of one brightness are gathered.

    brightest : of the photons of this level, irradiance as a fraction of the direct light.
    radius : times the radius of the brightest level.
    chance : that a vertex gathers them.
    """

    brightest: float
    radius: float
    chance: float


LEVELS = (Level(np.inf, 1.0, 1.0), Level(0.1, 2.5, 0.25), Level(0.01, 6.0, 0.1))


@dataclass(frozen=True)
class GatheringRadius:
    """How far photons of the brightest level are gathered around a point, in the first map: `projector` times the
    distance from the projector, within `camera` (least, most) times the distance from the camera; or `fixed_m`.

    Distances are straight ones: light that came a long way round, off a mirror, has spread and is fainter than direct
    light would be, so a wider level has it. Angles are radians, capped at `STEEPEST`; centres metres, world.
    """

    projector: float
    camera: tuple[float, float]
    projector_at: np.ndarray
    camera_at: np.ndarray
    fixed_m: float | None = None

    def bounds(self) -> tuple[float, float, float, float]:
        """a, b, c, d: the radius is a + b x distance from the projector, within c and d x distance from the camera."""
        if self.fixed_m is not None:
            return self.fixed_m, 0.0, 0.0, UNBOUNDED
        of_projector, least, most = (min(angle, STEEPEST) for angle in (self.projector, *self.camera))
        return 0.0, of_projector, least, most

    def at(self, position: np.ndarray) -> np.ndarray:
        """(n,) metres at positions (n, 3)."""
        a, b, c, d = self.bounds()
        from_camera = np.linalg.norm(position - self.camera_at, axis=1)
        return np.clip(a + b * np.linalg.norm(position - self.projector_at, axis=1), c * from_camera, d * from_camera)

    @property
    def steepness(self) -> float:
        """How fast the radius grows, at most, in metres per metre."""
        return 0.0 if self.fixed_m is not None else max(self.bounds()[1:])


class Gathered(NamedTuple):
    """The photons near a point: index of the one that stands for all, and their irradiance in W/m2; 0: none."""

    photon: Any
    irradiance: Any


class GatherRadius(NamedTuple):
    """How far a gather reaches at a point: radius of the brightest level in the first map, metres; number of the class
    of that radius; and edge of the cells of this class, metres."""

    radius: Any
    kind: Any
    edge: Any


class Flight(NamedTuple):
    """How a photon came: unit direction of flight (world), projector pixel coordinates, optical length in metres, and
    the cosine of its direction to the geometric normal of the surface."""

    direction: Any
    u: Any
    v: Any
    length: Any
    cosine: Any


class PhotonMaps:
    """Photons sorted into grid cells of twice the radius of their map, level and class, on the renderer's side.

    A point looks at 2 x 2 x 2 cells. The two along x are neighbours in memory, so that makes four ranges of photons.

    Parameters
    ----------
    photons : Photons, one or more.
    radius : GatheringRadius, of the first map and the brightest level.
    irradiance : W/m2, direct light of the projector at 1 m.
    wide : radians, radius over the distance from the camera from which on gathered light counts as smooth.
    """

    def __init__(self, photons: Photons, radius: GatheringRadius, irradiance: float, wide: float = np.inf) -> None:
        maps = photons.maps
        at_photons = np.maximum(radius.at(photons.position), MIN_M)
        # Of a whole level, lest light be smooth on one side of a line and not on the other
        from_camera = np.linalg.norm(photons.position - radius.camera_at, axis=1)
        typical = float(np.quantile(at_photons / np.maximum(from_camera, MIN_M), TYPICAL))
        self.is_wide = [typical * one.radius >= wide for one in LEVELS]
        self.maps = dr.opaque(mi.UInt32, maps)
        unit = float(at_photons.min()) * (1 + BESIDE)
        level = levels_of(photons, maps, at_photons, radius, irradiance)
        factors = np.array([one.radius for one in LEVELS])
        shrinkage = radii_of_maps(1.0, maps)
        copies, kind = _in_classes(at_photons / unit, radius.steepness * factors[level])
        position, level, of_map = photons.position[copies], level[copies], photons.map[copies]
        origin = position.min(axis=0)
        edge = 2 * unit * 2 ** (kind / CLASSES_PER_OCTAVE) * factors[level]
        rows = 1 << int(np.ceil(np.log2(max(16, len(photons.flux) / maps))))
        cell = _cells(position - origin, edge * shrinkage[of_map])
        stride = rows + FOLD + 1
        key = (level * maps + of_map) * stride + _row(cell[:, 1], cell[:, 2], kind, rows - 1) + _column(cell[:, 0])
        order = np.argsort(key, kind="stable")
        starts = np.cumsum(np.bincount(key + 1, minlength=len(LEVELS) * maps * stride + 1))
        order, occupancy_of = copies[order], (position - origin, of_map, kind, edge)
        points = np.column_stack([photons.position, photons.flux])
        padding = np.zeros(len(points), np.float32)
        columns = [photons.direction, photons.u, photons.v, photons.length_m, photons.cosine, padding]
        flights = np.column_stack(columns)

        opaque = lambda x: dr.opaque(mi.Float, float(x))  # noqa: E731
        self.starts = mi.UInt32(aligned(starts, np.uint32))
        self.points = mi.Float(aligned(points[order], np.float32))
        self.flights = mi.Float(aligned(flights[order], np.float32))
        self.shrinkage = mi.Float(aligned(shrinkage, np.float32))
        self.origin, self.projector_at, self.camera_at = (
            mi.Vector3f(*(opaque(x) for x in place)) for place in (origin, radius.projector_at, radius.camera_at)
        )
        self.bounds, self.unit = [opaque(x) for x in radius.bounds()], opaque(unit)
        self.row_mask, self.stride = dr.opaque(mi.UInt32, rows - 1), dr.opaque(mi.UInt32, stride)
        self.occupied = [mi.UInt32(_occupancy(*(x[level == i] for x in occupancy_of))) for i in range(len(LEVELS))]
        dr.eval([self.starts, self.points, self.flights, self.shrinkage, *self.occupied])

    def reach(self, point: Any) -> GatherRadius:
        """How far photons of the brightest level are gathered around a point."""
        point = mi.Vector3f(point)
        a, b, c, d = self.bounds
        from_camera = dr.norm(point - self.camera_at)
        radius = dr.fma(b, dr.norm(point - self.projector_at), a)
        radius = dr.maximum(dr.clip(radius, c * from_camera, d * from_camera), MIN_M)
        kind = dr.ceil(dr.log2(radius / self.unit) * CLASSES_PER_OCTAVE)
        return GatherRadius(radius, mi.UInt32(mi.Int32(kind)), 2 * self.unit * dr.exp2(kind / CLASSES_PER_OCTAVE))

    def near(self, level: int, point: Any, reach: GatherRadius, sample: Any, active: Any) -> Any:
        """Whether there may be photons of a level within its radius, in the map of `sample`."""
        cell = dr.floor((mi.Vector3f(point) - self.origin) / (reach.edge * LEVELS[level].radius))
        index = _hash(*(mi.UInt32(mi.Int32(x)) for x in cell)) + reach.kind * CLASS_PRIME
        index &= OCCUPANCY_CELLS - 1
        of_map = sample % self.maps
        bits = dr.gather(mi.UInt32, self.occupied[level], index * (MAX_MAPS // 32) + (of_map >> 5), active)
        return active & ((bits >> (of_map & 31)) & 1 != 0)

    @dr.syntax
    def gather(
        self, level: int, point: Any, normal: Any, reach: GatherRadius, sample: Any, pick: Any, offset: Any, active: Any
    ) -> Gathered:
        """Photons of a level around a surface point, in the map of `sample`; `pick`, `offset` are uniform in 0..1."""
        of_map = sample % self.maps
        shrunk = dr.gather(mi.Float, self.shrinkage, of_map, active) * LEVELS[level].radius
        radius = reach.radius * shrunk
        starts, counts = self._ranges(point, of_map + level * self.maps, reach.edge * shrunk, reach.kind, active)
        one, two = counts[0] + counts[1], counts[0] + counts[1] + counts[2]
        count = two + counts[3]
        # Where photons crowd, every n-th will do; they are in the order in which they left the projector
        every = (count + (MAX_LOOKED_AT - 1)) // MAX_LOOKED_AT
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
            fraction = dr.select(beside, weight / total, 0)
            taken = pick < fraction
            chosen = dr.select(taken, index, chosen)
            pick = dr.select(taken, pick / fraction, (pick - fraction) / (1 - fraction))  # as good as new
            k += every
        return Gathered(chosen, total * mi.Float(every) * (2 / dr.pi) * inverse_square)

    def flight(self, photon: Any, active: Any) -> Flight:
        """How a photon came."""
        a, b = (dr.gather(mi.Vector4f, self.flights, photon * 2 + half, active) for half in (0, 1))
        return Flight(mi.Vector3f(a.x, a.y, a.z), a.w, b.x, b.y, b.z)

    def _ranges(self, point: Any, of_map: Any, edge: Any, kind: Any, active: Any) -> tuple[list[Any], list[Any]]:
        """Start and length of the four ranges of photons that lie in the 2 x 2 x 2 cells around a point."""
        base = dr.floor((mi.Vector3f(point) - self.origin) / edge - 0.5)
        x, y, z = mi.Int32(base.x), mi.UInt32(mi.Int32(base.y)), mi.UInt32(mi.Int32(base.z))
        first = mi.UInt32(dr.minimum(_column(x), _column(x + 1)))  # the other one follows
        starts, counts = [], []
        for dy, dz in ((0, 0), (1, 0), (0, 1), (1, 1)):
            row = of_map * self.stride + _row(y + dy, z + dz, kind, self.row_mask)
            begin = dr.gather(mi.UInt32, self.starts, row + first, active)
            end = dr.gather(mi.UInt32, self.starts, row + first + 2, active)
            starts.append(begin)
            counts.append(end - begin)
        return starts, counts


def radii_of_maps(radius_m: float, maps: int) -> np.ndarray:
    """(maps,) float64, metres: r_1 = radius_m, r_(i+1)^2 = r_i^2 (i + alpha) / (i + 1)."""
    i = np.arange(1, maps)
    return np.asarray(radius_m * np.sqrt(np.cumprod(np.concatenate([[1.0], (i + ALPHA) / (i + 1)]))))


def levels_of(
    photons: Photons, maps: int, radius_m: np.ndarray, radius: GatheringRadius, irradiance: float
) -> np.ndarray:
    """(n,) int, index into `LEVELS`, from the irradiance that the photons of all maps bring to a cell of about four
    times the radius (n,) there, compared with the direct light of the projector at that distance."""
    octave = np.ceil(np.log2(radius_m / (radius_m.min() * (1 + BESIDE)))).astype(np.int64)
    cell_m = 4 * radius_m.min() * (1 + BESIDE) * 2.0**octave
    key = _hash(*_cells(photons.position, cell_m).T) + octave * CLASS_PRIME & (OCCUPANCY_CELLS - 1)
    power = np.bincount(key, photons.flux, OCCUPANCY_CELLS)[key] / maps
    direct = irradiance / np.maximum(np.sum((photons.position - radius.projector_at) ** 2, axis=1), MIN_M)
    fraction = power / (direct * cell_m**2)
    return np.count_nonzero([fraction < one.brightest for one in LEVELS], axis=0) - 1


def _in_classes(radius: np.ndarray, steepness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (m,) of photons, and a class of each: all classes from which a point may gather it.

    A point at distance d of a photon has a radius r' that differs from the photon's r by steepness x d, at most, and
    reaches that far: r' <= r / (1 - steepness), r' >= r / (1 + steepness). `radius` (n,) in units of that of class 0.
    """
    low, high = (
        np.ceil(CLASSES_PER_OCTAVE * np.log2(radius * bound)).astype(np.int64)
        for bound in ((1 - BESIDE) / (1 + steepness), (1 + BESIDE) / (1 - steepness))
    )
    count = high - low + 1
    photon = np.repeat(np.arange(len(radius)), count)
    return photon, np.arange(len(photon)) - np.repeat(np.cumsum(count) - count, count) + low[photon]


def _cells(position: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """(n, 3) int coordinates of grid cells."""
    return np.floor(position / np.asarray(edge, np.float32)[:, None]).astype(np.int64)


def _hash(x: Any, y: Any, z: Any) -> Any:
    """Hash of integer cell coordinates; NumPy integers and Dr.Jit UInt32 alike give the same low 32 bits."""
    return x * PRIMES[0] + y * PRIMES[1] + z * PRIMES[2]


def _column(x: Any) -> Any:
    """Place of a cell within its row, in 0..FOLD; neighbours stay neighbours. NumPy integers and Dr.Jit Int32."""
    return FOLD - abs(FOLD - (x & (2 * FOLD - 1)))


def _row(y: Any, z: Any, kind: Any, mask: Any) -> Any:
    """Where the cells of a row along x begin, in 0..mask; mask + 1 is a power of two of at least 16.

    A point looks at two cells in each of four neighbouring rows and must count no photon twice, so these begin two
    cells or more apart: their differences are 3, 5, 8 or 2 modulo 16.
    """
    return (y * ROW_FACTORS[0] + z * ROW_FACTORS[1] + kind * CLASS_FACTOR) & mask


def _occupancy(position: np.ndarray, of_map: np.ndarray, kind: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """(cells * MAX_MAPS / 32,) uint32: one bit per map and hash of a cell within the radius, half an edge, of some
    photon of that class."""
    occupied = np.zeros(OCCUPANCY_CELLS * MAX_MAPS, dtype=bool)
    low, high = (_cells(position + offset * edge[:, None], edge) for offset in (-0.5, 0.5))
    for corner in range(8):
        cell = [np.where(corner >> axis & 1, high[:, axis], low[:, axis]) for axis in range(3)]
        index = _hash(*cell) + kind * CLASS_PRIME
        occupied[(index & (OCCUPANCY_CELLS - 1)) * MAX_MAPS + of_map] = True
    return np.packbits(occupied, bitorder="little").view(np.uint32)
