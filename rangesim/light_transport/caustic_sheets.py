# SPDX-License-Identifier: Apache-2.0
"""Light beyond glass and mirrors, as triangles on the surfaces where it lands.

The projector is a point, so the place where a chain of delta interactions ends is a smooth function of the place in the
image where it began. The same holds for all sources without extent (`delta_sources`). A grid of points over the image
is traced through the scene (`specular_tree`). Where the points around a cell of the grid took the same chain, they span
triangles on the surface where they landed. The irradiance of a triangle is its flux over its area, and everything else
is interpolated between its corners. Cells are divided where triangles would be too coarse.

The rest, mostly along the silhouettes of glass, is left to photons: random points of the cells, each of which carries
the light of its cell over the parallelogram to which the derivatives of the place by the point spread the cell (photon
differentials: Schjøth et al., GRAPHITE 2007). A chain through a cell belongs either to triangles or to photons, so no
light is counted twice and none is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import maximum_filter

from rangesim.light_transport.camera_rays import CellGrid, Device
from rangesim.light_transport.caustic_kernels import (
    EMPTY,
    cells_of,
    larger,
    last_ways,
    linked,
    new_points,
    sides_of_photons,
    smooth_chains,
    with_names,
)
from rangesim.light_transport.delta_sources import DeltaSource, ProjectorSource
from rangesim.light_transport.delta_surfaces import deflects, has_throwers, is_thrower, meets_delta
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.sampling import aligned
from rangesim.light_transport.specular_tree import HASH_STEP, Landings, SpecularTree, lobe_points
from rangesim.light_transport.surfaces import number_of, table_of
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.scene.materials import is_specular

BLOCK_PX = 8.0
"""Edge of the largest blocks, in pixels of the projector; a block has two cells along each edge. Rays that find glass
are closer together, so smaller glass is not passed by."""
MAX_LEVELS = 2
"""Largest number of times that blocks are divided. With two, the smallest cells have the size of a pixel; with three, a
third of the light that is left to photons would move to triangles, for three times the time."""
CAMERA_CELL = 0.5
"""Edge of the smallest cells in pixels of the camera, if these are larger than two of the projector: nobody sees what
is finer."""
TOLERANCE_PX = 0.04
"""Largest error of the place of a triangle, in pixels of the projector. With 0.15 the middle of the light of a ball was
1.1 % too dim; with 0.04 it is 0.4 % too dim, and glassware has a tenth more triangles and takes as long to trace."""
FAINT = 0.05
"""Ratio of the irradiance to direct light below which a triangle is faint. Blocks are not divided for faint light, and
one sample of a few looks for it."""
SIGNIFICANT = 0.05
"""Fraction of the light of a block whose chains are not smooth, above which it is divided."""
FEWEST = 0.01
"""Fraction of the light of a point below which the grid drops a part and leaves it to photons. Light that was reflected
twice inside glass has 0.0016."""
FEWEST_OF_PHOTONS = 0.1
"""Fraction of the light of a photon below which Russian roulette decides about a part. If it were smaller, most of the
time would go into parts that carry little."""
LEFT = 0.1
"""Fraction of the light of a cell that is left to photons, above which it gets one for certain; the others are drawn by
lot. If it were smaller, many photons would carry little light."""
PHOTONS = 1 << 13
"""Number of photons of a pass, as far as cells that are left can be divided into parts of their own. If there are more
cells than this, each has a photon. With twice as many photons, their noise would be smaller by a third."""
PHOTONS_WITH_LOBES = 1 << 11
"""The same in scenes with narrow lobes, which send each photon into many directions."""
MAX_PARTS = 8
"""Largest number of parts along the edge of a cell that is left; an eighth of a pixel is finer than anything seen."""
MAX_SAG = 1e-3
"""Largest height of a curved receiver over a triangle, as a fraction of its distance from the projector; rays that look
for triangles (`sheet_scene`) reach as far."""
MAX_SIDE = 0.025
"""Longest side of the parallelogram of a photon, as a fraction of its way from the projector. Light that spreads
farther does not do so evenly."""
MAX_TURN = 0.3
"""Largest angle in radians by which a receiver turns over the parallelogram of a photon. Light on a tangent plane is
looked for along the normals of the receiver, so a cable that turns by 1.6 would get only 0.7 of its light."""
HALVINGS = 4
"""Largest number of times that the parallelogram of a photon is halved until all of it lies on the receiver. Light that
hangs over an edge is lost; with four, it is a sixteenth of what it would be with none."""
NEAREST = 0.02
"""Fraction of the way from glass to the receiver after which rays look for things in between, so that they start beyond
the glass even where it is curved. Things nearer to the glass are found by points of the grid alone."""
FLAT = 0.02
"""Largest distance of a flat receiver from where light between points of the grid lands, as a fraction of `MAX_SAG`:
ten times the rounding of single precision."""
SHIFT_PX = np.array([0.0137, 0.0071])
"""Largest shift of the lattice against the edges of pixels, in pixels: more than rounding, less than anything seen."""
BEND = 0.01
"""Difference in radians between the normals at the sides of a photon's parallelogram: enough to tell that its receiver
may be curved (`sheet_scene`), and too little to change anything else."""
MIN_SLOPE = 1e-3
"""Smallest cosine of light to a receiver by which is divided: light that grazes it more lands on the plane anyway."""
MIN_SIDE_M = 1e-12
"""Smallest length in metres by which another is divided, because light may land in a point."""
STEP_PX = 0.02
"""Distance of the points beside a photon that tell how its light spreads, in pixels of the projector. Closer points
would land within the rounding of single precision; farther ones would miss narrow chains."""
MAX_AT_ONCE = 1 << 18
"""Largest number of points of a launch, so that the weaker parts that it stores take 100 MB at most."""


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
    """The numbers that decide whether a block is divided, see `TOLERANCE_PX`, `FAINT` and `SIGNIFICANT`.

    `pixel_m` and `pixel_rad` tell the size of a pixel's light, see `DeltaSource`; `projector_at` is the place of the
    projector (3,) and `sag` is `MAX_SAG`."""

    pixel_m: float
    pixel_rad: float
    projector_at: np.ndarray
    sag: float
    tolerance: float
    faint: float
    significant: float


class Chains(NamedTuple):
    """The columns of `Landings` that decide about triangles."""

    key: np.ndarray
    shape: np.ndarray
    part: np.ndarray
    length: np.ndarray
    last: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    direction: np.ndarray


class Pairs(NamedTuple):
    """Pairs of a block or a cell and a chain that may make triangles, see `smooth_chains`."""

    triangles: np.ndarray
    flux: np.ndarray
    names: np.ndarray
    parts: np.ndarray

    def triangles_of(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Triangles and flux of the pairs in a mask (p,)."""
        each = len(self.triangles) // max(len(self.names), 1)
        rows = np.repeat(chosen, each)
        return self.triangles[rows], self.flux[rows]

    def parts_of(self, chosen: np.ndarray, n: int) -> np.ndarray:
        """(n,) float64, fraction of the light of each block or cell in its pairs in a mask (p,)."""
        return np.bincount(self.names[chosen, 0], self.parts[chosen, 0], n)


class Sheets(NamedTuple):
    """Triangles of light.

    position, slowness : (n, 3) float32, vertices: place where light lands, and its direction of flight times the
        refractive index there, which is the gradient of the optical length; world.
    cosine, length, u, v : (n,) float32, vertices: cosine of the direction to the normal (negative from in front),
        optical length in metres, pixel coordinates of the projector.
    normal : (n, 3) float32, geometric normals.
    triangles : (t, 3) int64, vertices. flux : (t,) float64, watts.
    direct : (t,) float64, W/m2, irradiance that the source would make there on a surface that faces it.
    shape, key : (t,) uint32, number of the shape where it lands, and name of the chain.
    lobe : (t,) uint32, number of the point of the narrow lobes that the light met, from 1 on; 0 if it met none.
    cut : ratio of the light that was lost in chains that are too long to all light.
    in_triangles : fraction of the flux that the grid's triangles carry; photons carry the rest.
    """

    position: np.ndarray
    slowness: np.ndarray
    cosine: np.ndarray
    length: np.ndarray
    u: np.ndarray
    v: np.ndarray
    normal: np.ndarray
    triangles: np.ndarray
    flux: np.ndarray
    direct: np.ndarray
    shape: np.ndarray
    key: np.ndarray
    lobe: np.ndarray
    cut: float
    in_triangles: float


def trace_sheets(
    traced: TracedScene,
    power_w: float,
    seed: int,
    pixel_rad: float = 0.0,
    report: Callable[[], None] = lambda: None,
) -> Sheets | None:
    """The projector's light through glass and off mirrors, on the surfaces where it lands; None if there is none.

    Parameters
    ----------
    power_w : watts, power of the projector while it shows white.
    seed : int, 0 to 2^64 - 1, decides about photons.
    pixel_rad : radians, smallest angle of a camera's pixel; what is finer than half of it is not resolved.
    report : called after each kernel launch.
    """
    assert isinstance(traced.projector, Device)  # beams need no sheets
    source = ProjectorSource(traced.projector, power_w, CAMERA_CELL * pixel_rad, pixel_rad)
    points = None
    if has_throwers(traced.scene):
        cells = CellGrid.of(source.width, source.height, source.fineness)
        rays_of = lambda a, b: source.rays(cells.probes(a, b))[0]  # noqa: E731
        meets, _ = meets_delta(traced.scene, cells.columns * cells.rows, rays_of, is_thrower, through_holes=True)
        points = lobe_points(meets.mean() * source.width * source.height * source.fineness.prod(), seed)
    tree = SpecularTree(traced, Launches(), points)
    return sheets_of(tree, source, source.at, np.random.default_rng(seed), report)


def sheets_of(
    tree: SpecularTree,
    source: DeltaSource,
    projector_at: np.ndarray,
    rng: np.random.Generator,
    report: Callable[[], None] = lambda: None,
) -> Sheets | None:
    """The light of a source through glass and off mirrors, on the surfaces where it lands; None if there is none.

    Parameters
    ----------
    tree : SpecularTree of the scene.
    projector_at : (3,) float64, metres, world, the place from which distances count, see `MAX_SAG`.
    rng : decides about photons.
    """
    tracing = _Tracing(tree, source, projector_at, report)
    lenses = [None] if source.lens is None else list(source.lens)
    made = [tracing.sheets(part, rng, lens) for part, lens in zip(source.lens_weights, lenses, strict=True)]
    return joined(apart(made))


def apart(sheets: Sequence[Sheets]) -> list[Sheets]:
    """Sheets whose keys tell them apart: chains from different places are different chains."""
    return [one._replace(key=one.key + np.uint32(i * HASH_STEP & 0xFFFFFFFF)) for i, one in enumerate(sheets)]


def joined(sheets: Sequence[Sheets]) -> Sheets | None:
    """Several sheets as one; None if they are all empty."""
    sheets = [one for one in sheets if len(one.flux)]
    if len(sheets) < 2:
        return sheets[0] if sheets else None
    first = np.cumsum([0, *(len(one.u) for one in sheets)])
    moved = [one._replace(triangles=one.triangles + begin) for one, begin in zip(sheets, first, strict=False)]
    columns: list[Any] = [np.concatenate(c) for c in list(zip(*moved, strict=True))[:-2]]
    flux = np.array([one.flux.sum() for one in sheets])
    means = (
        float(np.average([getattr(one, name) for one in sheets], weights=flux)) for name in ("cut", "in_triangles")
    )
    return Sheets(*columns, *means)


class _Points:
    """Points of a lattice over the image that were traced, and where their light landed.

    Parameters
    ----------
    columns : int, number of lattice points in a row.
    coarsest : int, distance of the points of the largest blocks.
    """

    def __init__(self, columns: int, coarsest: int) -> None:
        self.columns, self.coarsest = columns, coarsest
        self.table, self.value = np.full(1 << 12, EMPTY, np.int64), np.empty(1 << 12, np.int64)
        self.numbers, self.dropped = np.empty(0, np.int64), np.empty(0)
        self.landings: list[Landings] = []

    def new(self, blocks: Blocks) -> np.ndarray:
        """Lattice numbers of the points of these blocks that were not traced yet."""
        needed = 2 * (len(self.numbers) + 9 * len(blocks.x))
        if needed > len(self.table):
            self.table, self.value = larger(self.table, self.value, 1 << int(np.ceil(np.log2(needed))))
        return new_points(self.table, self.value, *blocks[:3], self.columns, len(self.numbers))

    def add(self, numbers: np.ndarray, landings: Landings, dropped: np.ndarray) -> tuple[Lattice, Landings]:
        """Keep the landings of new points; returns all of them."""
        point = landings.point.astype(np.int64) + len(self.numbers)
        self.landings = [
            Landings(*map(np.concatenate, zip(*self.landings, landings._replace(point=point), strict=True)))
        ]
        self.numbers, self.dropped = np.concatenate([self.numbers, numbers]), np.concatenate([self.dropped, dropped])
        head, after = linked(self.landings[0].point, len(self.numbers))
        return Lattice(self.table, self.value, head, after, self.columns, self.coarsest), self.landings[0]


class _Tracing:
    """Traces sheets of a source.

    Parameters
    ----------
    tree, source, projector_at, report : as for `sheets_of`.
    """

    def __init__(
        self, tree: SpecularTree, source: DeltaSource, projector_at: np.ndarray, report: Callable[[], None]
    ) -> None:
        self.tree, self.source, self.at, self.report = tree, source, projector_at, report
        self.is_glass = mi.Bool(table_of(tree.traced.scene, list(map(is_specular, tree.traced.scene.shapes()))))
        # All lengths here are in parts of pixels, see `DeltaSource.fineness`
        largest, self.fineness = 0.5 * BLOCK_PX, source.fineness
        parts = float(np.sqrt(self.fineness.prod()))  # of a pixel, along the edge of a square of its area
        self.finest_px = float(np.clip(source.finest_px * parts, 1, largest))
        self.levels = min(int(np.log2(largest / self.finest_px)), MAX_LEVELS)
        self.between_px = 1.0 if source.lens is not None else self.finest_px  # between rays that look for thin things
        self.size_px = np.array([source.width, source.height]) * self.fineness
        self.rule = Rule(
            source.pixel_m / parts, source.pixel_rad / parts, self.at, MAX_SAG, TOLERANCE_PX, FAINT, SIGNIFICANT
        )
        self.blocks = tuple(int(np.ceil(n / BLOCK_PX)) for n in self.size_px)
        self.coarsest = 1 << self.levels
        self.step_px = self.size_px / (2 * self.coarsest * np.array(self.blocks))
        self.columns = 2 * self.coarsest * self.blocks[0] + 1
        cells = CellGrid.of(source.width, source.height, self.fineness)
        meets, exists = meets_delta(
            tree.traced.scene,
            cells.columns * cells.rows,
            lambda a, b: source.rays(cells.probes(a, b))[0],
            lambda shape: deflects(shape) or (tree.has_lobes and is_thrower(shape)),
            through_holes=True,
        )
        meets = (meets & exists).reshape(cells.rows, cells.columns)
        self.delta = _Delta(meets, 2 * self.coarsest * np.array(self.blocks))

    def sheets(self, weight: float, rng: np.random.Generator, lens: np.ndarray | None) -> Sheets:
        """Sheets of a fraction of the light through a point of the lens, uniform coordinates in the unit square (2,);
        None: its centre."""
        points = _Points(self.columns, self.coarsest)
        x, y = (
            c.ravel().astype(np.int64) for c in np.meshgrid(*(2 * self.coarsest * np.arange(n) for n in self.blocks))
        )
        taken, used, step = np.full(1 << 14, EMPTY, np.int64), 0, self.coarsest
        near = self.delta.within(x, y, 2 * step)
        x, y = x[near], y[near]
        made, left = [], []
        watts = weight * self.source.watts / self.fineness.prod()
        pixels = np.sqrt(self.step_px.prod())
        landings = _no_landings()
        while step and len(x):
            blocks = Blocks(x, y, step, 2 * step * pixels)
            new = points.new(blocks)
            lattice, landings = points.add(new, *self._follow(self._pixels(new), lens, FEWEST))
            chains = Chains(*(getattr(landings, name) for name in Chains._fields))
            *found, rest, is_dark = smooth_chains(blocks, lattice, chains, self.rule, taken)
            pairs = Pairs(*found)
            is_clear = self._are_clear(pairs, chains, step * pixels, self.delta.fills(x, y, 2 * step))
            rest += pairs.parts_of(~is_clear, len(rest))
            taken, used = with_names(pairs.names[is_clear], x, y, step, self.columns, taken, used)
            made.append(pairs.triangles_of(is_clear))
            # A surface that lies between the points is as good as a chain that is not whole
            divides = ((rest > SIGNIFICANT) | (is_dark & self.delta.within(x, y, 2 * step))) & (step > 1)
            whole = Blocks(x[~divides], y[~divides], *blocks[2:])
            cells = np.column_stack([np.add.outer(c, step * offset).ravel() for c, offset in (
                (whole.x, np.array([0, 1, 0, 1])), (whole.y, np.array([0, 0, 1, 1])))])  # fmt: skip
            *found, rest, is_dark = cells_of(whole, lattice, chains, self.rule, points.dropped, taken)
            pairs, (cx, cy) = Pairs(*found), cells.T.copy()
            is_clear = self._are_clear(pairs, chains, step * pixels, self.delta.fills(cx, cy, step))
            rest += pairs.parts_of(~is_clear, len(rest))
            rest[is_dark & self.delta.within(cx, cy, step)] = 1.0
            taken, used = with_names(pairs.names[is_clear], cx, cy, -step, self.columns, taken, used)
            made.append(pairs.triangles_of(is_clear))
            left.append(np.column_stack([cells, np.full(len(cells), step), rest])[rest > 0])
            x, y, step = x[divides], y[divides], step // 2
            x, y = (
                np.concatenate([x, x + 2 * step, x, x + 2 * step]),
                np.concatenate([y, y, y + 2 * step, y + 2 * step]),
            )
        if not made:
            return _sheets(landings, np.empty((0, 2)), np.empty((0, 3), np.int64), np.empty(0), 0.0)
        triangles, flux = (np.concatenate(c) for c in zip(*made, strict=True))
        of_grid = _sheets(landings, self._pixels(points.numbers)[landings.point], triangles, watts * flux[:, 0], 0.0)
        both = joined([of_grid, self._photons(np.concatenate(left), taken, watts, rng, lens)])
        every = of_grid if both is None else both._replace(in_triangles=float(of_grid.flux.sum() / both.flux.sum()))
        direct = self.source.direct(every.position[every.triangles[:, 0]])
        return every._replace(
            u=every.u / np.float32(self.fineness[0]), v=every.v / np.float32(self.fineness[1]), direct=direct
        )

    def _are_clear(self, pairs: Pairs, chains: Chains, cell_px: float, fills: np.ndarray) -> np.ndarray:
        """(p,) bool, whether all light between the points of pairs takes their way, as far as rays between them tell.

        What hides the glass from the projector, what stands before the receiver, and holes in the receiver may lie
        between the points. Faint light is taken as it is.

        Parameters
        ----------
        cell_px : edge of a cell, pixels. fills : (n,) bool, whether all rays through a block or cell meet a delta
            surface first.
        """
        is_clear = pairs.names[:, 2] > 0
        looks = ~is_clear & fills[pairs.names[:, 0]]
        if not looks.any():
            return is_clear
        side = int(np.ceil(cell_px / self.between_px))
        triangles, _ = pairs.triangles_of(looks)
        rays = last_ways(triangles, chains, self.rule, side, NEAREST, FLAT)
        lands, shapes = np.empty(len(rays), bool), np.repeat(chains.shape[triangles[::2, 0]], side * side)
        for begin in range(0, len(rays), MAX_AT_ONCE):
            some = slice(begin, begin + MAX_AT_ONCE)
            x, y, z, *direction, way, most = (mi.Float(aligned(c, np.float32)) for c in rays[some].T)
            ray, here = (
                mi.Ray3f(mi.Point3f(x, y, z), mi.Vector3f(*direction)),
                mi.UInt32(aligned(shapes[some], np.uint32)),
            )
            met = self.tree.traced.scene.ray_intersect_preliminary(ray, coherent=False)
            is_here = (number_of(met.shape) == here) & (dr.abs(met.t - way) < most)
            # Glass on the way is that which the light leaves: the ray starts inside it where it is curved
            is_glass = dr.gather(mi.Bool, self.is_glass, number_of(met.shape), met.is_valid())
            lands[some] = (met.is_valid() & (is_here | is_glass)).numpy()
        is_clear[looks] = lands.reshape(looks.sum(), -1).all(axis=1)
        return is_clear

    def _pixels(self, number: np.ndarray) -> np.ndarray:
        """(n, 2) float64, pixel coordinates of lattice points.

        They are moved a little, by less towards the borders of the image, so that none lies exactly on an edge of a
        scene that is aligned with the projector.
        """
        regular = np.column_stack([number % self.columns, number // self.columns]) * self.step_px
        return regular + SHIFT_PX * np.sin(np.pi * regular / self.size_px)

    def _photons(
        self, cells: np.ndarray, taken: np.ndarray, watts: float, rng: np.random.Generator, lens: np.ndarray | None
    ) -> Sheets:
        """Sheets of photons: the light of cells that is in no triangle.

        cells : (n, 4) float64, lattice coordinates and edge of cells, and fraction of their light that is left.
        taken : set of the cells and chains that have triangles. watts : W, power of a pixel.
        """
        chance = np.minimum(cells[:, 3] / LEFT, 1)
        # Each cell is divided into parts x parts, each of which may have a photon
        photons = PHOTONS_WITH_LOBES if self.tree.has_lobes else PHOTONS
        parts = int(np.clip(np.sqrt(photons / max(chance.sum(), 1)), 1, MAX_PARTS))
        offset = np.indices((parts, parts)).reshape(2, -1).T / parts
        part = np.tile(offset, (len(cells), 1))
        cells, chance = np.repeat(cells, parts**2, axis=0), np.repeat(chance, parts**2)
        chosen = rng.random(len(cells)) < chance
        cells, chance, part = cells[chosen], chance[chosen], part[chosen]
        size = cells[:, 2:3] * self.step_px / parts
        place = (cells[:, :2] + cells[:, 2:3] * part) * self.step_px + rng.random((len(cells), 2)) * size
        beside = np.repeat(place, 3, axis=0)
        beside[1::3, 0] += STEP_PX
        beside[2::3, 1] += STEP_PX
        # The three points of a photon share their random numbers, and so their chains
        states = np.repeat(rng.integers(0, 1 << 63, len(cells), dtype=np.uint64), 3)
        found, lost = self._follow(beside, lens, FEWEST_OF_PHOTONS, states)
        lists = Lists(*linked(found.point.astype(np.int64), len(beside)))
        chains = Chains(*(getattr(found, name) for name in Chains._fields))
        corners, edges = cells[:, :2].astype(np.int64), cells[:, 2].astype(np.int64)
        which = sides_of_photons(corners, edges, lists, self.columns, self.coarsest, chains, taken)
        power = watts * size.prod(axis=1) / chance
        made = _parallelograms(found, which, size, place, power, self.rule, self._lie_on)
        # Nothing outside the image may reach a pattern
        u, v = (np.clip(c, 0, np.float32(n)) for c, n in zip((made.u, made.v), self.size_px, strict=True))
        cut = float((lost[::3] * power).sum() / made.flux.sum()) if len(made.flux) else 0.0
        return made._replace(u=u, v=v, cut=cut)

    def _lie_on(self, points: np.ndarray, normal: np.ndarray, shape: np.ndarray, across: np.ndarray) -> np.ndarray:
        """(n,) bool, whether points (n, 3), metres, lie on shapes of these numbers (n,), as far as one looks along
        their normals (n, 3). `across` is their distance (n,) from the middles of tangent planes, metres."""
        distance = np.linalg.norm(points - self.at, axis=1)
        height = np.clip(0.25 * MAX_TURN * across, FLAT * MAX_SAG * distance, MAX_SAG * distance)
        reach = mi.Float(aligned(height, np.float32))
        p, n = (mi.Vector3f(*(mi.Float(aligned(c, np.float32)) for c in rows.T)) for rows in (points, normal))
        found, here = dr.zeros(mi.Bool, len(points)), mi.UInt32(aligned(shape, np.uint32))
        for side in (n, -n):  # something may stand on the shape
            ray = mi.Ray3f(mi.Point3f(p + reach * side), -side)
            ray.maxt = 2 * reach
            met = self.tree.traced.scene.ray_intersect_preliminary(ray, coherent=False)
            found |= met.is_valid() & (number_of(met.shape) == here)
        return found.numpy()

    def _follow(
        self, pixels: np.ndarray, lens: np.ndarray | None, fewest: float, states: np.ndarray | None = None
    ) -> tuple[Landings, np.ndarray]:
        """Follow the light of points of the image (n, 2), as `SpecularTree.follow`."""
        found, lost = [_no_landings()], [np.empty(0)]
        at_once = MAX_AT_ONCE // self.tree.points
        for begin in range(0, len(pixels), at_once):
            some = slice(begin, begin + at_once)
            place = mi.Point2f(*(mi.Float(aligned(c, np.float32)) for c in (pixels[some] / self.fineness).T))
            on_lens = None if lens is None else mi.Point2f(*map(float, lens))
            random = None if states is None else mi.UInt64(aligned(states[some], np.uint64))
            landings, dropped = self.tree.follow(self.source, place, on_lens, fewest, random)
            self.report()
            found.append(landings._replace(point=landings.point + np.uint32(begin)))
            lost.append(dropped)
        return Landings(*map(np.concatenate, zip(*found, strict=True))), np.concatenate(lost)


def _no_landings() -> Landings:
    """No landing at all."""
    whole, real, vector = np.empty(0, np.uint32), np.empty(0, np.float32), np.empty((0, 3), np.float32)
    return Landings(whole, whole, whole, real, real, real, real, vector, vector, vector, whole)


def _sheets(landings: Landings, uv: np.ndarray, triangles: np.ndarray, flux: np.ndarray, cut: float) -> Sheets:
    """Sheets whose vertices are these landings; `uv` (n, 2) are pixel coordinates."""
    cosine = np.einsum("ij,ij->i", landings.direction, landings.normal)
    u, v = np.asarray(uv, np.float32).T
    of = triangles[:, 0]
    slowness = landings.ior[:, None] * landings.direction
    vertices = landings.position, slowness, cosine, landings.length, u, v, landings.normal
    untold = np.full(len(triangles), np.nan)
    return Sheets(*vertices, triangles, flux, untold, landings.shape[of], landings.key[of], landings.lobe[of], cut, 0.0)


def _parallelograms(
    found: Landings,
    which: np.ndarray,
    size: np.ndarray,
    place: np.ndarray,
    power: np.ndarray,
    rule: Rule,
    lie_on: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray],
) -> Sheets:
    """Sheets of photons, two triangles each.

    Parameters
    ----------
    found : Landings of the three points of each photon. which : (m, 3) int64, see `sides_of_photons`.
    size, place : (n, 2) float64, pixels, sizes of the photons' cells and places of the photons.
    power : (n,) float64, watts, power that a photon stands for. rule : Rule.
    lie_on : function that says whether points with normals lie on shapes.
    """
    this = which[:, 0]
    photon = found.point[this] // 3
    edges, centre = size[photon], found.position[this].astype(np.float64)
    normal = found.normal[this].astype(np.float64)
    # Where no chain of the same name lies beside a photon, its light spreads as without glass
    across = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    spread = rule.pixel_m + rule.pixel_rad * found.length[this]
    across *= (spread / np.linalg.norm(across, axis=1))[:, None]
    plain = np.stack([across, np.cross(normal, across)], axis=1)
    known = np.all(which[:, 1:] >= 0, axis=1, keepdims=True)
    sides = (
        np.where(known[..., None], (found.position[which[:, 1:]] - centre[:, None]) / STEP_PX, plain)
        * edges[:, :, None]
    )
    # Along the light, a hit on a thin round shape is known to a hundredth of its radius: sides are those of the plane
    direction = found.direction[this].astype(np.float64)
    slope = np.einsum("ij,ij->i", direction, normal)
    slope = np.where(np.abs(slope) > MIN_SLOPE, slope, np.inf)[:, None]
    sides -= np.einsum("mij,mj->mi", sides, normal)[..., None] * (direction / slope)[:, None]
    longest = MAX_SIDE * found.length[this, None]
    turn = np.linalg.norm(found.normal[which[:, 1:]] - normal[:, None], axis=2) / STEP_PX * edges  # radians over a side
    length = np.maximum(np.linalg.norm(sides, axis=2), MIN_SIDE_M)
    sag = rule.sag * np.linalg.norm(centre - rule.projector_at, axis=1)[:, None]
    flat = np.sqrt(4 * sag / np.maximum(np.where(known, turn, 0) * length, MIN_SIDE_M))  # half for each side
    even = MAX_TURN / np.maximum(np.where(known, turn, 0), MIN_SIDE_M)
    shrinks = np.minimum(np.minimum(np.minimum(longest / length, flat), even), 1)
    sides *= shrinks[..., None]
    ends = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])
    hangs = np.arange(len(this))
    for _ in range(HALVINGS):
        if not len(hangs):
            break
        corners = (centre[hangs, None] + ends @ sides[hangs]).reshape(-1, 3)
        normals, shapes = (np.repeat(column[this[hangs]], 4, axis=0) for column in (found.normal, found.shape))
        across = np.linalg.norm(ends @ sides[hangs], axis=2).ravel()
        hangs = hangs[~lie_on(corners, normals, shapes, across).reshape(-1, 4).all(axis=1)]
        sides[hangs] *= 0.5
        shrinks[hangs] *= 0.5
    corners = centre[:, None] + ends @ sides
    uv = place[photon][:, None] + ends * (edges * shrinks)[:, None]
    four = Landings(*(np.repeat(column[this], 4, axis=0) for column in found))
    triangles = (4 * np.arange(len(this))[:, None, None] + np.array([[0, 1, 3], [0, 3, 2]])).reshape(-1, 3)
    flux = np.repeat(0.5 * found.part[this] * power[photon], 2)
    # The direction of flight is the gradient of the optical length
    further = np.einsum("mij,mj->mi", ends @ sides, found.ior[this, None] * found.direction[this]).ravel()
    moved = np.asarray(corners.reshape(-1, 3), np.float32)
    # A receiver may bend within a parallelogram, so the normals at the corners differ
    bends = BEND * plain / np.linalg.norm(plain, axis=2, keepdims=True)
    normals = np.asarray((normal[:, None] + ends @ bends).reshape(-1, 3), np.float32)
    four = four._replace(position=moved, normal=normals, length=np.asarray(four.length + further, np.float32))
    return _sheets(four, uv.reshape(-1, 2), triangles, flux, 0.0)


class _Delta:
    """The part of the image whose rays meet a delta surface first.

    Parameters
    ----------
    meets : (rows, columns) bool, by cell of the image. lattice : (2,) int, size of the lattice over the image.
    """

    def __init__(self, meets: np.ndarray, lattice: np.ndarray) -> None:
        rows, columns = meets.shape
        self.near, self.all = (np.zeros((rows + 1, columns + 1), np.int64) for _ in range(2))
        self.near[1:, 1:] = maximum_filter(meets, 3).cumsum(0, np.int64).cumsum(1)
        self.all[1:, 1:] = meets.cumsum(0, np.int64).cumsum(1)
        self.scale = np.array([columns, rows]) / lattice

    def within(self, x: np.ndarray, y: np.ndarray, edge: int) -> np.ndarray:
        """(n,) bool, whether some ray through squares of the lattice, or right beside them, meets one."""
        return self._number(self.near, x, y, edge)[0] > 0

    def fills(self, x: np.ndarray, y: np.ndarray, edge: int) -> np.ndarray:
        """(n,) bool, whether all rays through squares of the lattice meet one."""
        number, cells = self._number(self.all, x, y, edge)
        return number == cells

    def _number(self, sums: np.ndarray, x: np.ndarray, y: np.ndarray, edge: int) -> tuple[np.ndarray, np.ndarray]:
        """Sum over the cells of the image that squares of the lattice touch, and number of these cells; (n,) int64."""
        rows, columns = sums.shape
        x0, y0 = (np.floor(c * s).astype(np.int64) for c, s in ((x, self.scale[0]), (y, self.scale[1])))
        x1, y1 = (np.ceil((c + edge) * s).astype(np.int64) for c, s in ((x, self.scale[0]), (y, self.scale[1])))
        x1, y1 = np.minimum(np.maximum(x1, x0 + 1), columns - 1), np.minimum(np.maximum(y1, y0 + 1), rows - 1)
        return sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0], (x1 - x0) * (y1 - y0)
