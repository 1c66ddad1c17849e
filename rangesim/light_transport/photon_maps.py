# SPDX-License-Identifier: Apache-2.0
"""Photon maps on hash grids, and the light that their photons bring to a surface point.

Density estimation follows Jensen ("Realistic Image Synthesis Using Photon Mapping", 2001), with many small maps instead
of one large one. Sample s of a pixel looks into map s mod n, and the radii of the maps shrink as in probabilistic
progressive photon mapping (Knaus and Zwicker 2011, eq. 15; their alpha is our `ALPHA`). So each sample looks at few
photons only, and all samples of a pixel together look at all photons.

The radius of a gather depends on the place (`GatheringRadius`). A grid has cells of one size, so photons are sorted by
the radius at their place into classes, `CLASSES_PER_OCTAVE` for each factor of two, and a point looks into the cells of
its own class. Photons near a border between two classes are in the cells of both.

Photons are sorted into `LEVELS` by the light that they bring, compared with the projector's direct light. Faint light
has few photons, so it is gathered over larger radii. Results depend little on it, so fewer vertices gather it.

At a vertex, one photon within the radius is chosen with a chance in proportion to its weight (reservoir sampling). It
stands for all of them. So BSDF and sensor responses are evaluated once per vertex, however many photons are near.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.photon_kernels import mark, sorted_by
from rangesim.light_transport.photons import Photons
from rangesim.light_transport.sampling import aligned

ALPHA = 2 / 3
"""Dimensionless number (alpha of Knaus and Zwicker 2011) that decides how fast the radii of successive maps shrink. The
noise of n maps falls as n^(-alpha / 2) and their bias as n^(alpha - 1). With this value both fall equally fast; with 1
the radii would not shrink, and the blur would stay."""
MAX_MAPS = 64
"""Largest number of photon maps. With more samples per pixel than this, several samples share a map."""
CLASSES_PER_OCTAVE = 4
"""Number of classes of radii per factor of two. It is small, because photons near a border between two classes are
stored twice. With fewer classes, cells would be larger than their radii need."""
STEEPEST = 1 / 12
"""Largest ratio of the radius of the brightest level to the distance from a device. The radius of the faintest level is
six times as large, so it is half the distance at most."""
FLATNESS = 0.3
"""Largest distance of a photon from the tangent plane, as a fraction of the radius. Photons farther off lie on another
surface. With a smaller value, photons on curved surfaces are lost; with a larger one, light from beyond edges is
counted."""
MAX_LOOKED_AT = 16
"""Number of photons that a gather looks at, so that the time per vertex is bounded. If n times as many are near, it
looks at every n-th photon and counts it n times. A larger number makes less noise in bright caustics."""
OCCUPANCY_CELLS = 1 << 18
"""Number of places per level in the table that says where photons may be, a power of two. At 1 MiB for 32 maps it
fits into caches; a smaller table has more false hits, because more cells share a place."""
PRIMES = (73856093, 19349663, 83492791)
"""Factors of the spatial hash of a cell's coordinates (Teschner et al. 2003). The products are added up here. The paper
combines them by exclusive or; opposite cells would then share a place."""
CLASS_PRIME = 50331653
"""Factor of the class in the same hash, see `_hash`; dimensionless."""
ROW_FACTORS = (0x9E3779B3, 0x85EBCA75)
"""Factors of a row's y and z in the hash of rows. Modulo 16 they keep neighbouring rows apart, see `_row`."""
CLASS_FACTOR = 0xC2B2AE3D
"""Factor of the class in the hash of rows, see `_row`; dimensionless."""
ROUNDING = 1e-4
"""Relative error, a fraction of a radius, for which classes allow, so that rounding in single precision (6e-8 per
operation) puts no photon into a wrong class."""
TYPICAL_QUANTILE = 0.05
"""Quantile of the ratios of radius to distance from the camera. A level of photons counts as wide if this quantile is
above the limit. The quantile is low, so nearly all photons of such a level are gathered over wide circles."""
FOLD = 1024
"""Number of cells along x after which a row turns back on itself, so that the table stays small in a large scene.
Places 1024 or more cells apart may then share an entry, which costs time."""
UNBOUNDED_M = 1e30
"""Stands for an infinite radius, in metres, because single precision ends at 3e38."""
MIN_M = 1e-9
"""Smallest radius and distance in metres, because both are 0 at a device itself, and are divided by."""


class Level(NamedTuple):
    """Radius and chance with which photons of one range of brightness are gathered.

    brightest : upper end of the range: irradiance as a fraction of the projector's direct light.
    radius : ratio of the radius to that of the brightest level.
    chance : probability that a vertex gathers the level.
    """

    brightest: float
    radius: float
    chance: float


LEVELS = (Level(np.inf, 1.0, 1.0), Level(0.1, 2.5, 0.25), Level(0.01, 6.0, 0.1))
"""Levels of photons, brightest first. Light below a tenth of the direct light is gathered over 2.5 times the radius at
every fourth vertex, below a hundredth over 6 times the radius at every tenth, because few photons carry it and little
depends on it."""


Whole = TypeVar("Whole", np.ndarray, "mi.UInt32", "mi.Int32")
"""Whole numbers, of NumPy or of Dr.Jit."""


@dataclass(frozen=True)
class GatheringRadius:
    """Radius within which photons of the brightest level are gathered around a point, in the first map.

    It is the distance from the projector times an angle, within two bounds that are the distance from the camera times
    an angle. Distances are straight ones. Light that came a long way, by a mirror, has spread and is fainter than
    direct light would be. So its photons belong to a level with a larger radius.

    projector : radians. A value above `STEEPEST` counts as `STEEPEST`.
    camera : smallest and largest angle, radians, likewise capped.
    projector_at, camera_at : (3,) float, metres, world, centres of the two.
    fixed_m : metres; the radius is then this everywhere, and the other fields are not used. None: they are used.
    """

    projector: float
    camera: tuple[float, float]
    projector_at: np.ndarray
    camera_at: np.ndarray
    fixed_m: float | None = None

    def bounds(self) -> tuple[float, float, float, float]:
        """Numbers a, b, c, d: the radius is a + b times the distance from the projector, not below c and not above d
        times the distance from the camera."""
        if self.fixed_m is not None:
            return self.fixed_m, 0.0, 0.0, UNBOUNDED_M
        of_projector, least, most = (min(angle, STEEPEST) for angle in (self.projector, *self.camera))
        return 0.0, of_projector, least, most

    def at(self, position: np.ndarray) -> np.ndarray:
        """(n,) float, metres, the radius at positions (n, 3)."""
        a, b, c, d = self.bounds()
        from_camera = np.sqrt(_squared_distance(position, self.camera_at))
        from_projector = np.sqrt(_squared_distance(position, self.projector_at))
        return np.clip(a + b * from_projector, c * from_camera, d * from_camera)

    @property
    def steepness(self) -> float:
        """Largest growth of the radius along a way, in metres per metre."""
        return 0.0 if self.fixed_m is not None else max(self.bounds()[1:])


class Gathered(NamedTuple):
    """The photons near a point.

    photon : UInt32, index of the photon that stands for all.
    irradiance : Float, W/m2, of all of them; 0 if there are none.
    """

    photon: mi.UInt32
    irradiance: mi.Float


class Reach(NamedTuple):
    """The distance within which photons are gathered at a point, for the brightest level in the first map.

    radius : Float, metres.
    kind : UInt32, number of the class of that radius.
    edge : Float, metres, edge of the cells of this class.
    """

    radius: mi.Float
    kind: mi.UInt32
    edge: mi.Float


class Flight(NamedTuple):
    """The way of a photon to where it landed.

    direction : Vector3f, unit, world, direction of flight.
    u, v : Float, projector pixel coordinates.
    length : Float, metres, optical length from the projector.
    cosine : Float, absolute cosine between the direction and the geometric normal of the surface.
    """

    direction: mi.Vector3f
    u: mi.Float
    v: mi.Float
    length: mi.Float
    cosine: mi.Float


class PhotonMaps:
    """Photons sorted into grid cells, as kernels see them. A cell's edge is twice the radius of its map, level and
    class.

    A point looks into 2 x 2 x 2 cells. The two along x are neighbours in memory, so they make four ranges of photons.

    Parameters
    ----------
    photons : Photons, at least one.
    radius : GatheringRadius, of the first map and the brightest level.
    irradiance : W/m2, irradiance of the projector's direct light at 1 m.
    wide : radians, ratio of radius to distance from the camera above which gathered light counts as smooth.
    """

    def __init__(self, photons: Photons, radius: GatheringRadius, irradiance: float, wide: float = np.inf) -> None:
        maps = photons.maps
        at_photons = np.maximum(radius.at(photons.position), MIN_M)
        # One decision for each level; else light would count as smooth on one side of a line and not on the other
        from_camera = np.sqrt(_squared_distance(photons.position, radius.camera_at))
        typical = float(np.quantile(at_photons / np.maximum(from_camera, MIN_M), TYPICAL_QUANTILE))
        self.is_wide = [typical * one.radius >= wide for one in LEVELS]
        self.maps = dr.opaque(mi.UInt32, maps)
        unit = float(at_photons.min()) * (1 + ROUNDING)
        level = levels_of(photons, maps, at_photons, radius, irradiance)
        factors = np.array([one.radius for one in LEVELS])
        shrinkage = radii_of_maps(1.0, maps)
        copies, kind = _in_classes(at_photons / unit, radius.steepness * factors[level])
        position, level, of_map = photons.position[copies], level[copies], photons.map[copies]
        origin = np.array([column.min() for column in position.T])
        edge = 2 * unit * 2 ** (kind / CLASSES_PER_OCTAVE) * factors[level]
        rows = 1 << int(np.ceil(np.log2(max(16, len(photons.flux) / maps))))
        cell = _cells(position - origin, edge * shrinkage[of_map])
        stride = rows + FOLD + 1
        key = (level * maps + of_map) * stride + _row(cell[:, 1], cell[:, 2], kind, rows - 1) + _column(cell[:, 0])
        starts = np.cumsum(np.bincount(key + 1, minlength=len(LEVELS) * maps * stride + 1))
        order = copies[sorted_by(key, starts)]
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
        words = -(-maps // 32)  # a bit for each map
        self.words = dr.opaque(mi.UInt32, words)
        of_levels = [level == i for i in range(len(LEVELS))]
        self.occupied = [
            mi.UInt32(_occupancy(position[x] - origin, of_map[x], kind[x], edge[x], words)) for x in of_levels
        ]
        dr.eval([self.starts, self.points, self.flights, self.shrinkage, *self.occupied])

    def reach(self, point: mi.Point3f) -> Reach:
        """The distance within which photons of the brightest level are gathered around a point."""
        point = mi.Vector3f(point)
        a, b, c, d = self.bounds
        from_camera = dr.norm(point - self.camera_at)
        radius = dr.fma(b, dr.norm(point - self.projector_at), a)
        radius = dr.maximum(dr.clip(radius, c * from_camera, d * from_camera), MIN_M)
        kind = dr.ceil(dr.log2(radius / self.unit) * CLASSES_PER_OCTAVE)
        return Reach(radius, mi.UInt32(mi.Int32(kind)), 2 * self.unit * dr.exp2(kind / CLASSES_PER_OCTAVE))

    def near(self, level: int, point: mi.Point3f, reach: Reach, sample: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether photons of a level may lie within its radius of a point, in the map of `sample`."""
        cell = dr.floor((mi.Vector3f(point) - self.origin) / (reach.edge * LEVELS[level].radius))
        index = _hash(*(mi.UInt32(mi.Int32(x)) for x in cell)) + reach.kind * CLASS_PRIME
        index &= OCCUPANCY_CELLS - 1
        of_map = sample % self.maps
        bits = dr.gather(mi.UInt32, self.occupied[level], index * self.words + (of_map >> 5), active)
        return active & ((bits >> (of_map & 31)) & 1 != 0)

    @dr.syntax
    def gather(
        self,
        level: int,
        point: mi.Point3f,
        normal: mi.Normal3f,
        reach: Reach,
        sample: mi.UInt32,
        pick: mi.Float,
        offset: mi.Float,
        active: mi.Bool,
    ) -> Gathered:
        """The photons of a level around a surface point, in the map of `sample`.

        Parameters
        ----------
        normal : Normal3f, unit, geometric normal of the surface.
        pick : Float, uniform in 0..1, chooses the photon that stands for all.
        offset : Float, uniform in 0..1, chooses the first photon where not all are looked at.
        """
        of_map = sample % self.maps
        shrunk = dr.gather(mi.Float, self.shrinkage, of_map, active) * LEVELS[level].radius
        radius = reach.radius * shrunk
        starts, counts = self._ranges(point, of_map + level * self.maps, reach.edge * shrunk, reach.kind, active)
        one, two = counts[0] + counts[1], counts[0] + counts[1] + counts[2]
        count = two + counts[3]
        # Where photons crowd, only every n-th is looked at. They are in the order in which they left the projector
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
            pick = dr.select(taken, pick / fraction, (pick - fraction) / (1 - fraction))  # uniform again
            k += every
        return Gathered(chosen, total * mi.Float(every) * (2 / dr.pi) * inverse_square)

    def flight(self, photon: mi.UInt32, active: mi.Bool) -> Flight:
        """The way of the photon with this index."""
        a, b = (dr.gather(mi.Vector4f, self.flights, photon * 2 + half, active) for half in (0, 1))
        return Flight(mi.Vector3f(a.x, a.y, a.z), a.w, b.x, b.y, b.z)

    def _ranges(
        self, point: mi.Point3f, of_map: mi.UInt32, edge: mi.Float, kind: mi.UInt32, active: mi.Bool
    ) -> tuple[list[mi.UInt32], list[mi.UInt32]]:
        """Starts and lengths of the four ranges of photons in the 2 x 2 x 2 cells around a point."""
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
    """(maps,) float64, metres, radii of the maps: r_1 = radius_m, r_(i+1)^2 = r_i^2 (i + alpha) / (i + 1)."""
    i = np.arange(1, maps)
    return np.asarray(radius_m * np.sqrt(np.cumprod(np.concatenate([[1.0], (i + ALPHA) / (i + 1)]))))


def levels_of(
    photons: Photons, maps: int, radius_m: np.ndarray, radius: GatheringRadius, irradiance: float
) -> np.ndarray:
    """(n,) int, the level of each photon, an index into `LEVELS`.

    The photons of all maps bring an irradiance to a cell around the photon, whose edge is about four times the radius
    there. The level follows from its ratio to the projector's direct light at that distance.

    Parameters
    ----------
    radius_m : (n,) float, metres, `radius` at the photons.
    irradiance : W/m2, irradiance of the projector's direct light at 1 m.
    """
    octave = np.ceil(np.log2(radius_m / (radius_m.min() * (1 + ROUNDING)))).astype(np.int64)
    cell_m = 4 * radius_m.min() * (1 + ROUNDING) * 2.0**octave
    key = _hash(*_cells(photons.position, cell_m).T) + octave * CLASS_PRIME & (OCCUPANCY_CELLS - 1)
    power = np.bincount(key, photons.flux, OCCUPANCY_CELLS)[key] / maps
    direct = irradiance / np.maximum(_squared_distance(photons.position, radius.projector_at), MIN_M)
    fraction = power / (direct * cell_m**2)
    return np.count_nonzero([fraction < one.brightest for one in LEVELS], axis=0) - 1


def _in_classes(radius: np.ndarray, steepness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a photon and a class from which a point may gather it: index of the photon (m,), and class (m,).

    A point at the distance d from a photon has a radius r' that differs from the photon's r by steepness times d at
    most. The point reaches the photon if d <= r', so r / (1 + steepness) <= r' <= r / (1 - steepness).

    Parameters
    ----------
    radius : (n,) float, the radii at the photons, in units of that of class 0.
    steepness : (n,) float, largest growth of these radii, in metres per metre.
    """
    low, high = (
        np.ceil(CLASSES_PER_OCTAVE * np.log2(radius * bound)).astype(np.int64)
        for bound in ((1 - ROUNDING) / (1 + steepness), (1 + ROUNDING) / (1 - steepness))
    )
    count = high - low + 1
    photon = np.repeat(np.arange(len(radius)), count)
    return photon, np.arange(len(photon)) - np.repeat(np.cumsum(count) - count, count) + low[photon]


def _cells(position: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """(n, 3) int, coordinates of the grid cells at these positions (n, 3), for cells of an edge (n,) in metres."""
    return np.floor(position / np.asarray(edge, np.float32)[:, None]).astype(np.int64)


def _squared_distance(position: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(n,) float64, square metres, of positions (n, 3) from a place (3,)."""
    x, y, z = (column - at for column, at in zip(position.T, place, strict=True))
    return np.asarray(x * x + y * y + z * z)


def _hash(x: Whole, y: Whole, z: Whole) -> Whole:
    """Hash of integer cell coordinates. Integers of NumPy and UInt32 of Dr.Jit give the same low 32 bits."""
    return x * PRIMES[0] + y * PRIMES[1] + z * PRIMES[2]


def _column(x: Whole) -> Whole:
    """Place of a cell within its row, 0 to `FOLD`. Neighbours stay neighbours. Takes NumPy integers or Int32."""
    return FOLD - abs(FOLD - (x & (2 * FOLD - 1)))


def _row(y: Whole, z: Whole, kind: Whole, mask: int | mi.UInt32) -> Whole:
    """Start of the cells of a row along x, 0 to `mask`; mask + 1 is a power of two, at least 16.

    A point looks into two cells in each of four neighbouring rows, and must count no photon twice. So the starts of
    these rows are two cells or more apart: they differ by 3, 5, 8 or 2 modulo 16.
    """
    return (y * ROW_FACTORS[0] + z * ROW_FACTORS[1] + kind * CLASS_FACTOR) & mask


def _occupancy(position: np.ndarray, of_map: np.ndarray, kind: np.ndarray, edge: np.ndarray, words: int) -> np.ndarray:
    """(cells * words,) uint32, a bit for each hash of a cell and each map.

    The bit is set if some point in such a cell has a photon of that map within the radius, which is half an edge.
    """
    occupied = np.zeros((OCCUPANCY_CELLS, words), np.uint32)
    mark(position, edge, np.array(PRIMES), kind * CLASS_PRIME, of_map, occupied)
    return occupied.ravel()
