# SPDX-License-Identifier: Apache-2.0
"""The projector's light beyond glass and mirrors, as triangles on the surfaces where it lands.

The projector is a point, so the place where a chain of delta interactions ends is a smooth function of the place in the
image where it began. A grid of points over the image is traced through the scene (`specular_tree`). Where the points
around a cell of the grid took the same chain, they span triangles on the surface where they landed. The irradiance of a
triangle is its flux over its area, and everything else is interpolated between its corners. Cells are divided where
triangles would be too coarse.

The rest, mostly along the silhouettes of glass, is left to photons: random points of the cells, each of which carries
the light of its cell over the parallelogram to which the derivatives of the place by the point spread the cell (photon
differentials: Schjøth et al., GRAPHITE 2007). A chain through a cell belongs either to triangles or to photons, so no
light is counted twice and none is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mitsuba as mi
import numpy as np
from scipy.ndimage import maximum_filter

from rangesim.light_transport.camera_rays import CellGrid, Device
from rangesim.light_transport.caustic_kernels import (
    cells_of,
    larger,
    linked,
    new_points,
    sides_of_photons,
    smooth_chains,
)
from rangesim.light_transport.delta_surfaces import meets_delta
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.sampling import Seed, aligned, random_stream
from rangesim.light_transport.specular_tree import Landings, SpecularTree
from rangesim.light_transport.traced_scene import TracedScene

BLOCK_PX = 8.0
"""Edge of the largest blocks, in pixels of the projector; a block has two cells along each edge."""
LEVELS = 2
"""Number of times that blocks may be divided. With two, the smallest cells have the size of a pixel."""
TOLERANCE_PX = 0.15
"""Largest error of the place of a triangle, in pixels of the projector."""
FAINT = 0.05
"""Ratio of the irradiance to direct light below which a triangle is faint. Blocks are not divided for faint light, and
each sample sees one group of faint triangles alone."""
SIGNIFICANT = 0.03
"""Fraction of the light of a block whose chains are not smooth, above which it is divided."""
FEWEST_GRID, FEWEST_PHOTON = 4e-3, 2e-2
"""Fractions of the light of a point below which a part is dropped by the grid, and by Russian roulette of photons."""
LEFT = 0.02
"""Fraction of the light of a cell that is left to photons, above which the cell gets a photon for certain."""
STEP_PX = 0.02
"""Distance of the points beside a photon that tell how its light spreads, in pixels of the projector."""
GROUPS = 16
"""Largest number of groups of faint triangles."""


class Blocks(NamedTuple):
    """Blocks of one size: lattice coordinates of their first points (n,) int64, distance of their points on the
    lattice, and square root of their area in pixels."""

    x: np.ndarray
    y: np.ndarray
    step: int
    pixels: float


class Lattice(NamedTuple):
    """Points of the image that were traced: hash table of their lattice numbers, their indices, and the linked lists
    of their landings. `columns` is the number of lattice points in a row, `coarsest` the distance of points in the
    largest blocks."""

    table: np.ndarray
    value: np.ndarray
    head: np.ndarray
    after: np.ndarray
    columns: int
    coarsest: int


class Lists(NamedTuple):
    """Linked lists of the landings of points."""

    head: np.ndarray
    after: np.ndarray


class Rule(NamedTuple):
    """What decides whether a block is divided, see `TOLERANCE_PX`, `FAINT` and `SIGNIFICANT`; `angle` is that of a
    pixel in radians."""

    angle: float
    tolerance: float
    faint: float
    significant: float


class Chains(NamedTuple):
    """The columns of `Landings` that decide about triangles."""

    key: np.ndarray
    part: np.ndarray
    length: np.ndarray
    position: np.ndarray
    normal: np.ndarray


class Sheets(NamedTuple):
    """Triangles of light.

    position, direction : (n, 3) float32, vertices: place where light lands, and its direction of flight; world.
    cosine, length, u, v : (n,) float32, vertices: cosine of the direction to the normal (negative from in front),
        optical length in metres, pixel coordinates of the projector.
    normal : (n, 3) float32, geometric normals.
    triangles : (t, 3) int64, vertices. flux : (t,) float64, watts.
    shape, key : (t,) uint32, number of the shape where it lands, and name of the chain.
    cut : ratio of the light that was lost in chains that are too long to all light.
    in_triangles : fraction of the flux that the grid's triangles carry; photons carry the rest.
    """

    position: np.ndarray
    direction: np.ndarray
    cosine: np.ndarray
    length: np.ndarray
    u: np.ndarray
    v: np.ndarray
    normal: np.ndarray
    triangles: np.ndarray
    flux: np.ndarray
    shape: np.ndarray
    key: np.ndarray
    cut: float
    in_triangles: float


class _Grid:
    """The grid over the projector's image, and its landings so far."""

    def __init__(self, traced: TracedScene, launches: Launches) -> None:
        assert isinstance(traced.projector, Device)
        self.device = traced.projector
        width, height = (int(n[0]) for n in self.device.size)
        self.columns, self.rows = (int(np.ceil(n / BLOCK_PX)) for n in (width, height))
        self.finest = 1 << LEVELS  # distance of the points of the largest blocks on the lattice
        self.step_px = np.array([width / self.columns, height / self.rows]) / (2 * self.finest)
        self.lattice_columns = self.columns * 2 * self.finest + 1
        self.tree = SpecularTree(traced, launches)
        self.launches = launches

    def pixels_of(self, point: np.ndarray) -> np.ndarray:
        """(n, 2) float, pixel coordinates of lattice points."""
        return np.column_stack([point % self.lattice_columns, point // self.lattice_columns]) * self.step_px

    def rays(self, pixels: np.ndarray):
        return self.device.centre_ray(mi.Point2f(*(mi.Float(aligned(x, np.float32)) for x in pixels.T)))


def trace_sheets(traced: TracedScene, power_w: float, seed: int, report: Callable[[], None] = lambda: None) -> Sheets:
    """Trace the projector's light through glass and off mirrors to where it lands."""
    scene, launches = traced.scene, Launches()
    grid = _Grid(traced, launches)
    device = grid.device
    angle = 1 / float(np.sqrt(device.f.x[0] * device.f.y[0]))
    rule = Rule(angle, TOLERANCE_PX, FAINT, SIGNIFICANT)
    cells = CellGrid.of(device)
    meets, _ = meets_delta(scene, cells.columns * cells.rows, lambda a, b: device.centre_ray(cells.probes(a, b)))
    delta = _Delta(maximum_filter(meets.reshape(cells.rows, cells.columns), 3), grid)

    table, value = np.full(1 << 12, -1, np.int64), np.empty(1 << 12, np.int64)
    lattice, dropped = np.empty(0, np.int64), np.empty(0, np.float32)
    taken, used = np.full(1 << 14, -1, np.int64), 0
    landings: Landings | None = None
    x, y = (a.ravel().astype(np.int64) * 2 * grid.finest for a in np.meshgrid(np.arange(grid.columns), np.arange(grid.rows)))
    near = delta.within(x, y, 2 * grid.finest)
    x, y = x[near], y[near]
    made, left, at, edge = [], [], [], []
    step = grid.finest
    while len(x):
        needed = 2 * (len(lattice) + 9 * len(x))
        if needed > len(table):
            table, value = larger(table, value, 1 << int(np.ceil(np.log2(needed))))
        new = new_points(table, value, x, y, step, grid.lattice_columns, len(lattice))
        found, lost = grid.tree.follow(grid.rays(grid.pixels_of(new)), FEWEST_GRID)
        report()
        found = found._replace(point=found.point.astype(np.int64) + len(lattice))
        lattice, dropped = np.concatenate([lattice, new]), np.concatenate([dropped, lost])
        landings = found if landings is None else Landings(*map(np.concatenate, zip(landings, found, strict=True)))
        head, after = linked(landings.point, len(lattice))
        points = Lattice(table, value, head, after, grid.lattice_columns, grid.finest)
        chains = Chains(landings.key, landings.part, landings.length, landings.position, landings.normal)
        pixels = float(np.sqrt(np.prod(grid.step_px))) * 2 * step
        blocks = Blocks(x, y, step, pixels)
        triangles, flux, divides, taken, used = smooth_chains(
            blocks, points, chains, rule, delta.within(x, y, 2 * step), taken, used
        )
        made.append((triangles, flux))
        if step == 1:
            divides[:] = False
        leaf = Blocks(x[~divides], y[~divides], step, pixels)
        cell = np.column_stack([(one[:, None] + offset * step).ravel() for one, offset in (
            (leaf.x, np.array([0, 1, 0, 1])), (leaf.y, np.array([0, 0, 1, 1])))])
        triangles, flux, rest, taken, used = cells_of(
            leaf, points, chains, dropped, delta.within(cell[:, 0], cell[:, 1], step), taken, used
        )
        made.append((triangles, flux))
        at.append(cell[rest > 0])
        left.append(rest[rest > 0])
        edge.append(np.full(len(at[-1]), step))
        x, y = x[divides], y[divides]
        step //= 2
        x, y = np.concatenate([x, x + 2 * step, x, x + 2 * step]), np.concatenate([y, y, y + 2 * step, y + 2 * step])
    if landings is None:
        return None
    triangles, flux = (np.concatenate(c) for c in zip(*made, strict=True))
    flux = flux[:, 0]
    watts = power_w / device.pixels
    uv = grid.pixels_of(lattice)[landings.point]
    cosine = np.einsum("ij,ij->i", landings.direction, landings.normal)
    first = [landings.position, landings.direction, cosine, landings.length, uv[:, 0], uv[:, 1], landings.normal]
    of = triangles[:, 0]
    sheet = [triangles, flux * watts, landings.shape[of], landings.key[of]]

    # ---- Photons -----------------------------------------------------------------------------------------
    cells_left, edges, rest = np.concatenate(at), np.concatenate(edge), np.concatenate(left)
    rng = np.random.default_rng(seed)
    chance = np.minimum(rest / LEFT, 1)
    chosen = rng.random(len(rest)) < chance
    cells_left, edges, chance = cells_left[chosen], edges[chosen], chance[chosen]
    size = edges[:, None] * grid.step_px
    place = cells_left * grid.step_px + rng.random((len(edges), 2)) * size
    beside = np.repeat(place, 3, axis=0)
    beside[1::3, 0] += STEP_PX
    beside[2::3, 1] += STEP_PX
    cut = 0.0
    if len(beside):
        number = mi.UInt32(aligned(np.repeat(np.arange(len(place)), 3), np.uint32))
        random = random_stream(Seed.of(seed), number ^ 0x9E3779B9)
        found, lost = grid.tree.follow(grid.rays(beside), FEWEST_PHOTON, random)
        report()
        lists = Lists(*linked(found.point.astype(np.int64), len(beside)))
        chains = Chains(found.key, found.part, found.length, found.position, found.normal)
        which = sides_of_photons(cells_left, edges, lists, grid.lattice_columns, grid.finest, chains, taken)
        more, patches = _parallelograms(found, which, size, beside, chance, angle, watts, len(landings.key))
        first = [np.concatenate(c) for c in zip(first, more, strict=True)]
        sheet = [np.concatenate(c) for c in zip(sheet, patches, strict=True)]
        cut = float(lost[::3].sum()) / max(len(place), 1)
    total = float(sheet[1].sum())
    f32 = [np.asarray(c, np.float32) for c in first]
    return Sheets(*f32, *sheet, cut, float(flux.sum()) * watts / total if total else 0.0)


def _parallelograms(found, which, size, beside, chance, angle, watts, start):
    """The parallelograms of photons, two triangles each."""
    this = which[:, 0]
    photon = found.point[this] // 3
    edge = size[photon]
    place = found.position[this].astype(np.float64)
    normal = found.normal[this].astype(np.float64)
    plain = angle * found.length[this]
    # Where no chain of the same name is beside it, light spreads as without glass
    helper = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across = np.cross(normal, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    sides = [across * (plain * edge[:, 0])[:, None], np.cross(normal, across) * (plain * edge[:, 1])[:, None]]
    known = (which[:, 1:] >= 0).all(axis=1)
    for k in (0, 1):
        beside_it = found.position[which[:, 1 + k]].astype(np.float64)
        side = (beside_it - place) / STEP_PX * edge[:, k : k + 1]
        sides[k] = np.where(known[:, None], side, sides[k])
    corners, uv = [], []
    centre = beside[3 * photon]
    for a, b in ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)):
        corners.append(place + a * sides[0] + b * sides[1])
        uv.append(centre + edge * [a, b])
    m = len(this)
    stack = lambda four: np.stack(four, axis=1).reshape(4 * m, -1)  # noqa: E731
    uv = stack(uv)
    cosine = np.einsum("ij,ij->i", found.direction[this], found.normal[this])
    four = lambda one: np.repeat(one, 4, axis=0)  # noqa: E731
    vertices = [stack(corners), four(found.direction[this]), four(cosine), four(found.length[this]), uv[:, 0], uv[:, 1], four(normal)]
    base = start + 4 * np.arange(m)[:, None, None]
    triangles = (base + np.array([[0, 1, 3], [0, 3, 2]])).reshape(-1, 3)
    flux = np.repeat(0.5 * watts * found.part[this] * edge.prod(axis=1) / chance[photon], 2)
    return vertices, [triangles, flux, np.repeat(found.shape[this], 2), np.repeat(found.key[this], 2)]


class _Delta:
    """Where rays through the image meet a delta surface first."""

    def __init__(self, meets: np.ndarray, grid: _Grid) -> None:
        rows, columns = meets.shape
        self.sums = np.zeros((rows + 1, columns + 1), np.int64)
        self.sums[1:, 1:] = meets.cumsum(0).cumsum(1)
        lattice = 2 * grid.finest * np.array([grid.columns, grid.rows])
        self.scale = np.array([columns, rows]) / lattice

    def within(self, x: np.ndarray, y: np.ndarray, edge: int) -> np.ndarray:
        """(n,) bool, whether some ray through squares of the lattice meets one."""
        rows, columns = self.sums.shape
        x0, y0 = (np.floor(c * s).astype(np.int64) for c, s in ((x, self.scale[0]), (y, self.scale[1])))
        x1, y1 = (np.ceil((c + edge) * s).astype(np.int64) for c, s in ((x, self.scale[0]), (y, self.scale[1])))
        x1, y1 = np.minimum(np.maximum(x1, x0 + 1), columns - 1), np.minimum(np.maximum(y1, y0 + 1), rows - 1)
        return self.sums[y1, x1] - self.sums[y0, x1] - self.sums[y1, x0] + self.sums[y0, x0] > 0
