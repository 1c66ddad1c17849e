# SPDX-License-Identifier: Apache-2.0
"""Lamps without extent (sun, point and spot lamps), and their light beyond glass and mirrors.

A camera path that goes through glass never meets a lamp that has no extent. So their light is traced as that of the
projector (`rangesim.light_transport.caustic_sheets`), and counts as ambient light. Each lamp gets images that cover the
glass and the mirrors of the scene: parallel rays through a rectangle for a sun, and the faces of a cube around a lamp
that has a place.

Large surfaces have images of their own, so that a glass on a polished floor is not lost in the image of the floor. The
first surface that a ray meets decides in which of the images its light counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.camera_rays import PrimaryRay
from rangesim.light_transport.caustic_sheets import Sheets, apart, joined, sheets_of
from rangesim.light_transport.delta_sources import DeltaSource
from rangesim.light_transport.delta_surfaces import boundaries_of, deflects, first_shape
from rangesim.light_transport.kernel_launches import Launches
from rangesim.light_transport.sampling import aligned
from rangesim.light_transport.scattering import Medium
from rangesim.light_transport.spectrum import mono
from rangesim.light_transport.specular_chain import RayState
from rangesim.light_transport.specular_tree import SpecularTree
from rangesim.light_transport.surfaces import table_of
from rangesim.light_transport.traced_scene import TracedScene
from rangesim.scene.media import medium_around

MAX_PIXELS = 1 << 18
"""Largest number of pixels of all images together. All of them may show glass, so this is as much as a quarter of the
image of a projector of 1280 x 800. With four times as many, details would be half as large, for four times the time."""
MIN_ACROSS = 128
"""Smallest number of pixels along the longer side of an image, as far as there are few images, so that triangles
describe curved glass also for cameras of few pixels. With fewer, photons would carry more of the light."""
MARGIN_PX = 2
"""Width of the margin of an image around the glass, in pixels, so that cells beside a silhouette belong to it."""
SIZES = 8.0
"""Largest ratio of the sizes of surfaces that share an image: the smallest of them then has some 16 pixels at least."""
PROBES = 255
"""Columns and rows of rays that tell which part of its image a lamp lights, and how brightly at most. A beam that is
narrower than their distance may be missed."""
NEAR = 1e-3
"""Distance in front of a lamp, as a fraction of the size of a surface, from which on the surface is seen. A surface
that is closer covers the whole face of the cube anyway."""


def lamps_of(scene: mi.Scene) -> list[mi.Emitter]:
    """The emitters of a mitsuba.Scene that have no extent: suns, points and spots."""
    without_extent = mi.EmitterFlags.DeltaPosition.value | mi.EmitterFlags.DeltaDirection.value
    return [
        lamp
        for lamp in scene.emitters()
        if lamp.flags() & without_extent and not mi.has_flag(lamp.flags(), mi.EmitterFlags.Surface)
    ]


def lamp_sheets(
    traced: TracedScene,
    finest_m: float,
    camera_at: np.ndarray,
    projector_at: np.ndarray,
    seed: int,
    report: Callable[[], None] = lambda: None,
) -> Sheets | None:
    """The light of the lamps beyond glass and mirrors, on the surfaces where it lands; None if there is none.

    Parameters
    ----------
    finest_m : metres, size of the smallest part of what a camera sees that is worth to be told apart.
    camera_at : (3,) float64, metres, world, the place of a camera.
    projector_at : (3,) float64, metres, world, the place from which distances count, as for `sheets_of`.
    seed : int, 0 to 2^64 - 1, decides about photons.
    report : called after each kernel launch.
    """
    lamps = lamps_of(traced.scene)
    targets = _targets(traced.scene) if lamps else []
    if not targets:
        return None
    windows = [w for lamp in lamps for target in targets for w in _windows(traced, lamp, target, finest_m, camera_at)]
    coarser = np.sqrt(max(sum(window.pixels for window in windows) / MAX_PIXELS, 1.0))
    tree, made = SpecularTree(traced, Launches()), list[Sheets]()
    for number, window in enumerate(windows):
        source, rng = window.make(window.image(coarser)), np.random.default_rng([seed, number])
        if (sheets := sheets_of(tree, source, projector_at, rng, report)) is not None:
            made.append(sheets)
    return joined(apart(made))


class _Target(NamedTuple):
    """Surfaces with delta interactions that share an image.

    corners : (k, 8, 3) float64, metres, world, corners of the boxes around them.
    is_own : table (`table_of`) of the shapes that belong to it; None: all surfaces with delta interactions do.
    boundaries : as for `first_shape`.
    """

    corners: np.ndarray
    is_own: mi.Bool | None
    boundaries: mi.Bool | None

    @property
    def size_m(self) -> float:
        """Largest edge of the box around all of them."""
        return float((self.corners.max(axis=(0, 1)) - self.corners.min(axis=(0, 1))).max())

    @property
    def middle(self) -> np.ndarray:
        """(3,) the middle of that box."""
        return np.asarray(0.5 * (self.corners.max(axis=(0, 1)) + self.corners.min(axis=(0, 1))))

    def is_met(self, traced: TracedScene, ray: mi.Ray3f) -> mi.Bool | bool:
        """Whether light along the ray counts in this image: the first surface that it meets belongs to the target."""
        if self.is_own is None:
            return True
        met = first_shape(traced.scene, ray, self.boundaries)
        return dr.gather(mi.Bool, self.is_own, met.number, met.exists)


CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T
"""(8, 3) int, corners of a box; each tells for every axis whether it lies at the lower or at the upper end."""
EDGES = np.array([(a, b) for a in range(8) for b in range(a) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1])
"""(12, 2) int, edges of a box as pairs of corners."""


def _targets(scene: mi.Scene) -> list[_Target]:
    """The surfaces of a scene that mirror or refract; those of one target differ in size by `SIZES` at most."""
    shapes = scene.shapes()
    members = [i for i, shape in enumerate(shapes) if deflects(shape)]
    boxes = np.array([[shapes[i].bbox().min, shapes[i].bbox().max] for i in members], np.float64).reshape(-1, 2, 3)
    corners = boxes[:, CORNERS, np.arange(3)]
    size = (boxes[:, 1] - boxes[:, 0]).max(axis=1, initial=0)
    boundaries, groups = boundaries_of(scene, and_holes=True), list[list[int]]()
    for k in np.argsort(size, kind="stable"):
        if not groups or size[k] > SIZES * size[groups[-1][0]]:
            groups.append([])
        groups[-1].append(int(k))
    if len(groups) == 1:
        return [_Target(corners, None, boundaries)]
    targets = []
    for group in groups:
        is_own = np.zeros(len(shapes), np.bool_)
        is_own[[members[k] for k in group]] = True
        targets.append(_Target(corners[group], mi.Bool(table_of(scene, is_own)), boundaries))
    return targets


class _Image(NamedTuple):
    """The pixels of an image.

    size : (2,) int, width and height in pixels. corner : (2,) float64, where the image begins. step : (2,) float64,
    edges of a pixel, in the unit of `corner`.
    """

    size: tuple[int, int]
    corner: np.ndarray
    step: np.ndarray


class _Window(NamedTuple):
    """The rectangle through which a lamp lights a target.

    low, high : (2,) float64, its ends; metres for a sun, else p and q of a face, see `_on_face`.
    limit : largest coordinate that an image may have, which is the end of the face; infinite for a sun.
    edge : wished edge of a pixel.
    make : function that makes the source of an image.
    """

    low: np.ndarray
    high: np.ndarray
    limit: np.ndarray | float
    edge: float
    make: Callable[[_Image], DeltaSource]

    @property
    def fine_edge(self) -> float:
        """Edge of a pixel with which the image has `MIN_ACROSS` at least."""
        return min(self.edge, float((self.high - self.low).max()) / MIN_ACROSS)

    @property
    def pixels(self) -> float:
        """Number of pixels of this edge."""
        return float((self.high - self.low).prod()) / self.fine_edge**2

    def image(self, coarser: float) -> _Image:
        """The pixels of the image with its margin; their edges are so many times as long."""
        edge = coarser * self.fine_edge
        low = np.maximum(self.low - MARGIN_PX * edge, -self.limit)
        high = np.minimum(self.high + MARGIN_PX * edge, self.limit)
        width, height = (int(n) for n in np.ceil((high - low) / edge))
        return _Image((width, height), low, (high - low) / (width, height))


def _windows(
    traced: TracedScene, lamp: mi.Emitter, target: _Target, finest_m: float, camera_at: np.ndarray
) -> Iterator[_Window]:
    """The rectangles through which a lamp lights a target; none if it does not."""
    if mi.has_flag(lamp.flags(), mi.EmitterFlags.DeltaDirection):
        sample, irradiance = lamp.sample_direction(dr.zeros(mi.SurfaceInteraction3f, 1), mi.Point2f(0.5), True)
        strength = float(mono(irradiance)[0])
        if not strength > 0:
            return
        axes = _axes(-np.array(sample.d, np.float64).ravel())
        places = target.corners.reshape(-1, 3) @ axes.T
        low, high = places.min(axis=0), places.max(axis=0)
        box = traced.scene.bbox()
        everything = np.array([box.min, box.max], np.float64)[CORNERS, range(3)]
        # In front of all media and holes, which let some light pass, and else in front of the target
        is_clear = traced.media is None and (traced.cutouts is None or not traced.cutouts.exist)
        in_front = target.corners if is_clear else everything
        front = float((in_front @ axes[2]).min()) - NEAR * target.size_m
        make = partial(Sun, traced, target, strength, axes, front)
        yield _Window(low[:2], high[:2], np.inf, finest_m, make)
        return
    at = _place_of(lamp)
    away = target.middle - at
    distance = float(np.linalg.norm(away))
    finest_rad = finest_m / max(distance, float(np.linalg.norm(camera_at - at)))
    axes = _axes(away / distance if distance > 0 else np.array([0.0, 0.0, 1.0]))
    for x, y, z in ((0, 1, 2), (0, 1, -3), (1, 2, 0), (1, 2, -1), (2, 0, 1), (2, 0, -2)):
        face = np.stack([axes[x], axes[y], axes[z] if z >= 0 else -axes[~z]])
        rectangle = _seen_on(face, target.corners - at, NEAR * target.size_m)
        if rectangle is not None and (lit := _lit(lamp, at, face, rectangle)) is not None:
            (low, high), brightest = lit
            yield _Window(low, high, FACE, finest_rad, partial(Bulb, traced, target, lamp, at, face, brightest))


class Sun(DeltaSource):
    """A lamp that sends out parallel rays, through a rectangle in front of a target.

    Parameters
    ----------
    irradiance : W/m2, on surfaces that face it.
    axes : (3, 3) float64, rows: unit vectors along x and y of the image, and along the rays.
    front : metres, coordinate along the rays at which they begin.
    image : its coordinates are metres.
    """

    def __init__(
        self, traced: TracedScene, target: _Target, irradiance: float, axes: np.ndarray, front: float, image: _Image
    ) -> None:
        self.traced, self.target, self.irradiance = traced, target, irradiance
        self.width, self.height = image.size
        self.pixel_m, self.pixel_rad = float(np.sqrt(image.step.prod())), 0.0
        self.watts = irradiance * self.pixel_m**2
        self.x, self.y, self.direction = (_opaque(axis) for axis in axes)
        self.corner, self.step = _opaque(axes.T @ [*image.corner, front]), _opaque(image.step)

    def rays(self, pixel: mi.Point2f, lens: mi.Point2f | None = None) -> tuple[PrimaryRay, mi.Float]:
        place = pixel * self.step
        origin = mi.Point3f(self.corner + self.x * place.x + self.y * place.y)
        direction = mi.Vector3f(self.direction) + dr.zeros(mi.Vector3f, dr.width(pixel))
        is_lit = ~self.traced.scene.ray_test(mi.Ray3f(origin, -direction), coherent=False)
        is_lit &= self.target.is_met(self.traced, mi.Ray3f(origin, direction))
        return PrimaryRay(origin, direction, mi.Float(0), is_lit), dr.select(is_lit, mi.Float(1), 0)

    def direct(self, places: np.ndarray) -> np.ndarray:
        return np.full(len(places), self.irradiance)


class Bulb(DeltaSource):
    """A lamp in one place, as seen through a rectangle on the face of a cube around it.

    Parameters
    ----------
    lamp : Emitter with a delta position. at : (3,) float64, metres, world, its place.
    face : (3, 3) float64, rows: axes x, y and z of the face, which lies at z = 1.
    brightest : W/sr, largest intensity in the rectangle.
    image : its coordinates are p and q of the face, see `_on_face`.
    """

    def __init__(
        self,
        traced: TracedScene,
        target: _Target,
        lamp: mi.Emitter,
        at: np.ndarray,
        face: np.ndarray,
        brightest: float,
        image: _Image,
    ) -> None:
        self.traced, self.lamp, self.target, self.at, self.brightest = traced, lamp, target, at, brightest
        self.around = medium_around(traced.scene, at)
        self.width, self.height = image.size
        self.pixel_m, self.pixel_rad = 0.0, float(np.sqrt(image.step.prod()))
        self.watts = brightest * self.pixel_rad**2
        self.x, self.y, self.z, self.centre, self.corner, self.step = map(
            _opaque, (*face, at, image.corner, image.step)
        )
        self.scale = dr.opaque(mi.Float, 1 / brightest)

    def rays(self, pixel: mi.Point2f, lens: mi.Point2f | None = None) -> tuple[PrimaryRay, mi.Float]:
        place = self.corner + pixel * self.step
        x, y, z = _on_face(dr, place.x, place.y)
        direction = self.x * x + self.y * y + self.z * z
        origin = mi.Point3f(self.centre) + dr.zeros(mi.Point3f, dr.width(pixel))
        intensity = _intensity(self.lamp, mi.Point3f(self.centre), direction)
        is_lit = (intensity > 0) & self.target.is_met(self.traced, mi.Ray3f(origin, direction))
        part = dr.select(is_lit, intensity * self.scale, 0)
        return PrimaryRay(origin, direction, mi.Float(0), is_lit), part

    def start(self, traced: TracedScene, lanes: int) -> RayState:
        state = super().start(traced, lanes)
        if self.around is None:
            return state
        if self.around.scatters:
            numbers = (dr.full(mi.Float, number, lanes) for number in self.around.numbers)
            return replace(state, inside=Medium(*numbers))
        return replace(state, sigma_a=dr.full(mi.Float, self.around.numbers[0], lanes))

    def direct(self, places: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return np.asarray(self.brightest / ((places - self.at) ** 2).sum(axis=1))


# ---- Shapes in images ------------------------------------------------------------------------------------


def _axes(z: np.ndarray) -> np.ndarray:
    """(3, 3) float64, rows: unit vectors x, y and z of a system with this z axis (3,)."""
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _opaque(v: np.ndarray) -> Any:
    """A vector of two or three numbers that the kernel cache does not see."""
    return (mi.Vector2f if len(v) == 2 else mi.Vector3f)(*(dr.opaque(mi.Float, float(c)) for c in v))


def _place_of(lamp: mi.Emitter) -> np.ndarray:
    """(3,) float64, metres, world: the place of a lamp that has one."""
    sample, _ = lamp.sample_direction(dr.zeros(mi.SurfaceInteraction3f, 1), mi.Point2f(0.5), True)
    return np.array(sample.p, np.float64).ravel()


def _intensity(lamp: mi.Emitter, at: mi.Point3f, direction: mi.Vector3f) -> mi.Float:
    """Radiant intensity (W/sr) of a lamp at a place in unit directions."""
    there = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
    there.p = at + direction
    sample, irradiance = lamp.sample_direction(there, mi.Point2f(0.5), True)
    return mono(irradiance) * dr.square(sample.dist)


FACE = np.array([np.sqrt(2) * np.pi / 6, np.sqrt(0.5)])
"""Largest p and q on the face of a cube, see `_on_face`."""


def _on_face(m: Any, p: Any, q: Any) -> tuple[Any, Any, Any]:
    """The unit direction (x, y, z) to a place (p, q) on the face z = 1 of a cube; `m` is `numpy` or `drjit`.

    Equal areas dp dq are equal solid angles, so that a lamp that shines evenly has pixels of equal power. With the
    longitude a around the axis y and the sine s of the latitude, solid angles are da ds. The face ends at
    s = cos a / sqrt(2 - sin^2 a), so p is the integral of this over a, times sqrt(2), and q is s over it.
    """
    sine = math.sqrt(2) * m.sin(p * math.sqrt(0.5))
    square = sine * sine
    cosine = m.sqrt(1 - square)
    s = math.sqrt(2) * q * cosine / m.sqrt(2 - square)
    across = m.sqrt(1 - s * s)
    return across * sine, s, across * cosine


def _seen_on(face: np.ndarray, corners: np.ndarray, near: float) -> np.ndarray | None:
    """(2, 2) float64, ends of a rectangle of p and q on the face of a cube that holds the boxes as seen from its
    middle; None if they do not lie behind the face.

    face : as for `Bulb`. corners : (k, 8, 3) from the middle of the cube. near : metres, smallest depth.
    """
    a, b = np.moveaxis((corners @ face.T)[:, EDGES], 2, 0).reshape(2, -1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = a + (b - a) * ((near - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None]
    crosses = (a[:, 2] < near) != (b[:, 2] < near)
    seen = np.concatenate([a[a[:, 2] >= near], b[b[:, 2] >= near], cut[crosses]])
    if not len(seen):
        return None
    place = seen[:, :2] / seen[:, 2:]
    low, high = np.maximum(place.min(axis=0), -1), np.minimum(place.max(axis=0), 1)
    if not np.all(low < high):
        return None
    x = np.array([low[0], np.clip(0, low[0], high[0]), high[0]])  # q at a given y is largest where |x| is smallest
    p = np.sqrt(2) * np.arcsin(np.sqrt(0.5) * x / np.sqrt(1 + x**2))
    q = np.array([y * np.sqrt((1 + 0.5 * x**2) / (1 + x**2 + y**2)) for y in (low[1], high[1])])
    return np.array([[p[0], q[0].min()], [p[2], q[1].max()]])


def _lit(lamp: mi.Emitter, at: np.ndarray, face: np.ndarray, rectangle: np.ndarray) -> tuple[np.ndarray, float] | None:
    """The part of a rectangle that a lamp lights (2, 2), and its largest intensity there (W/sr); None if it lights
    nothing of it."""
    low, high = rectangle
    steps = np.linspace(low, high, PROBES)
    p, q = (c.ravel() for c in np.meshgrid(steps[:, 0], steps[:, 1]))
    directions = np.column_stack(_on_face(np, p, q)) @ face
    d = mi.Vector3f(*(mi.Float(aligned(c, np.float32)) for c in directions.T))
    intensity = _intensity(lamp, _opaque(at), d).numpy().reshape(PROBES, PROBES)
    brightest = float(intensity.max())
    if not brightest > 0:
        return None
    rows, columns = (np.flatnonzero(intensity.any(axis=axis)) for axis in (1, 0))
    ends = np.array([[columns[0] - 1, rows[0] - 1], [columns[-1] + 1, rows[-1] + 1]]).clip(0, PROBES - 1)
    return np.stack([steps[ends[0], [0, 1]], steps[ends[1], [0, 1]]]), brightest
