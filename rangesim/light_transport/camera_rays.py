# SPDX-License-Identifier: Apache-2.0
"""Camera and projector as kernels see them, and the straight connection of a surface point to the projector.

`rangesim.light_transport.ray_tables` has cameras that are no pinhole, `rangesim.light_transport.beams` the emitter of a
scanner. They have the same methods, as far as cameras and emitters need them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.cutouts import Cutouts
from rangesim.light_transport.sampling import GOLDEN_STEP
from rangesim.light_transport.scattering import Media, Medium
from rangesim.light_transport.surfaces import ray_to_emitter
from rangesim.rig import Intrinsics, Lens, Rig
from rangesim.rig.camera_model import CameraModel, appears, distort, project, unproject

MAX_REPROJECTION_PX = 1e-2
"""Largest error, in pixels, with which the ray found for a pixel may project back onto it. Where it is larger, the
distortion has no inverse in single precision, and the pixel has no ray. With a larger bound, wrong rays beside the fold
of a lens model would pass; a smaller one comes near the rounding of single precision."""
MAX_RADIUS2 = 1e30
"""Stands for an infinite squared radius on the plane z = 1, dimensionless, because single precision ends at 3e38."""


MAX_CELLS = 1 << 18
"""Largest number of cells of a projector's image. More cells find the light that meets glass more exactly, and take
longer. At 1280 x 800 pixels a cell has 2 x 2 of them."""


class PrimaryRay(NamedTuple):
    """Rays that leave a device.

    origin, direction : Point3f and Vector3f, world, metres and unit.
    path_offset : Float, metres, to be added to path lengths that are measured from `origin`. All paths through a lens
        to a point in focus are optically as long as the one through its centre.
    exists : Bool, false where the distortion has no inverse, so that the lens sends no ray; the direction is then that
        of the axis. None: true everywhere.
    """

    origin: mi.Point3f
    direction: mi.Vector3f
    path_offset: mi.Float
    exists: mi.Bool = None


class Connection(NamedTuple):
    """The straight segment from a surface point to the projector.

    uv : Point2f, projector pixel coordinates.
    direction : Vector3f, unit, world, towards the projector.
    distance : Float, metres.
    geometry : Float, ratio of the irradiance on a surface at the point that faces the projector to the irradiance at
        z = 1 m.
    lit : Bool, whether the point is inside the projector's image and nothing stands in between.
    blur_px : Float, see `rangesim.response.LightPath`; None: sharp.
    """

    uv: mi.Point2f
    direction: mi.Vector3f
    distance: mi.Float
    geometry: mi.Float
    lit: mi.Bool
    blur_px: mi.Float | None = None


def lit_from(
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    emitter: mi.Point3f,
    geometry: mi.Float,
    active: mi.Bool,
    media: Media | None,
    inside: Medium | None,
    cutouts: Cutouts | None = None,
) -> tuple[mi.Bool, mi.Float]:
    """Whether light comes straight from the emitter to the point `si`, and `geometry` less what media and the surfaces
    around holes on the way take.

    Parameters
    ----------
    geometry : Float, see `Connection`, without media and holes.
    media, inside : the media of the scene, and the one in which the point lies; None in scenes without any.
    cutouts : the holes of the scene; None: light goes through none.
    """
    if cutouts is not None and not cutouts.exist:
        cutouts = None
    if media is not None and inside is not None:
        fraction, _ = media.transmittance(scene, si, emitter, inside, active, cutouts=cutouts, ray_to=ray_to_emitter)
    elif cutouts is not None:
        fraction = cutouts.transmittance(si, emitter, active)
    else:
        return active & ~scene.ray_test(ray_to_emitter(si, emitter), coherent=False, active=active), geometry
    return active & (fraction > 0), geometry * fraction


class Device:
    """A camera or a projector of the rig as kernels see it: intrinsics, centre and axes.

    The kernel cache does not see the numbers (they are opaque): other numbers need no new kernel. Distortion, a finite
    lens and vignetting add code to the kernel; without them it is the kernel of a pinhole.

    Parameters
    ----------
    intrinsics : Intrinsics
    T_world_device : (4, 4) float, maps device coordinates to world coordinates, metres.
    lens : Lens. Its aperture is used if it has a focus; else the lens is a point.

    Attributes
    ----------
    model : CameraModel of a lens with distortion, as `rangesim.rig.camera_model` takes it; None for a pinhole.
    has_lens : bool, whether rays start on a lens of finite size, so that `sample_ray` needs a sample of it.
    """

    def __init__(self, intrinsics: Intrinsics, T_world_device: np.ndarray, lens: Lens) -> None:
        opaque = lambda x: dr.opaque(mi.Float, float(x))  # noqa: E731
        self.f = mi.Vector2f(opaque(intrinsics.fx), opaque(intrinsics.fy))
        self.c = mi.Vector2f(opaque(intrinsics.cx), opaque(intrinsics.cy))
        self.size = mi.Vector2f(opaque(intrinsics.width), opaque(intrinsics.height))
        self.x, self.y, self.z, self.centre = (
            mi.Vector3f(*map(opaque, T_world_device[:3, column])) for column in range(4)
        )
        self.model: CameraModel | None = None
        if any(intrinsics.distortion):
            coefficients = [opaque(k) for k in intrinsics.coefficients]
            fold_radius2 = opaque(min(intrinsics.fold_radius2, MAX_RADIUS2))
            self.model = CameraModel(self.f.x, self.f.y, self.c.x, self.c.y, coefficients, fold_radius2)
        self.has_lens = lens.focus_m is not None
        if lens.focus_m is not None:
            self.aperture, self.focus = opaque(lens.aperture_radius_m), opaque(lens.focus_m)
        self.vignetting = opaque(lens.vignetting) if lens.vignetting else None

    @classmethod
    def camera(cls, rig: Rig) -> Device:
        """The rig's pinhole camera without its vignetting: signals are radiance, and the exposure applies it."""
        assert isinstance(rig.camera, Intrinsics)
        return cls(rig.camera, rig.T_world_camera, replace(rig.camera_lens, vignetting=0.0))

    @classmethod
    def projector(cls, rig: Rig) -> Device:
        """The rig's projector."""
        assert isinstance(rig.projector, Intrinsics)
        return cls(rig.projector, rig.T_world_projector, rig.projector_lens)

    # ---- From pixels to rays -----------------------------------------------------------------------------

    def centre_ray(self, pixel: mi.Point2f) -> PrimaryRay:
        """The ray through the centre of the lens at pixel coordinates."""
        p, exists = self._undistorted(pixel)
        return PrimaryRay(mi.Point3f(self.centre), self._direction(p), mi.Float(0), exists)

    @property
    def pixels(self) -> int:
        """Number of pixels of the image."""
        return int(self.size.x[0]) * int(self.size.y[0])

    def centre_rays(self, begin: int, end: int) -> PrimaryRay:
        """Rays from the centre of the lens through the centres of the pixels `begin` to `end` - 1, row by row."""
        index, row = dr.arange(mi.UInt32, end - begin) + dr.opaque(mi.UInt32, begin), mi.UInt32(self.size.x)
        return self.centre_ray(mi.Point2f(mi.Float(index % row) + 0.5, mi.Float(index // row) + 0.5))

    def ray_in(self, corner: mi.Point2f, place: mi.Point2f, lens: mi.Point2f | None = None) -> PrimaryRay:
        """The ray through a place within a pixel.

        Parameters
        ----------
        corner : Point2f, pixel coordinates of the pixel's upper left corner, whole numbers.
        place : Point2f, place within the pixel, in the unit square.
        lens : as for `sample_ray`; None: the ray through the centre of the lens.
        """
        return self.centre_ray(corner + place) if lens is None else self.sample_ray(corner + place, lens)

    def sample_ray(self, pixel: mi.Point2f, lens: mi.Point2f | None) -> PrimaryRay:
        """The ray through pixel coordinates from a point of the lens.

        The lens is thin: rays of one pixel start anywhere on the aperture and meet in the plane z = `focus_m`.

        Parameters
        ----------
        pixel : Point2f, pixel coordinates.
        lens : Point2f, uniform in the unit square; None where `has_lens` is not set.
        """
        if not self.has_lens:
            return self.centre_ray(pixel)
        p, exists = self._undistorted(pixel)
        start = mi.warp.square_to_uniform_disk_concentric(lens) * self.aperture
        to_focus = mi.Vector3f(p.x, p.y, 1) * self.focus
        ray = to_focus - mi.Vector3f(start.x, start.y, 0)
        length = dr.norm(ray)
        direction = self._world(ray) / length
        origin = mi.Point3f(self.centre + self.x * start.x + self.y * start.y)
        return PrimaryRay(origin, direction, dr.norm(to_focus) - length, exists)

    def _direction(self, p: mi.Point2f) -> mi.Vector3f:
        return dr.normalize(self.x * p.x + self.y * p.y + self.z)

    def _world(self, v: mi.Vector3f) -> mi.Vector3f:
        return self.x * v.x + self.y * v.y + self.z * v.z

    def _undistorted(self, pixel: mi.Point2f) -> tuple[mi.Point2f, mi.Bool | None]:
        """Image-plane coordinates x/z and y/z of pixel coordinates, and whether they exist (None: everywhere)."""
        if self.model is None:
            return (pixel - self.c) / self.f, None
        x, y, exists = unproject(self.model, pixel.x, pixel.y, MAX_REPROJECTION_PX)
        return dr.select(exists, mi.Point2f(x, y), 0), exists

    # ---- From points to pixels ---------------------------------------------------------------------------

    def project(self, point: mi.Point3f) -> tuple[mi.Point2f, mi.Float]:
        """Pixel coordinates of a world point, NaN where the distortion folds the image, and its depth z in metres."""
        d = mi.Vector3f(point) - self.centre
        z = dr.dot(d, self.z)
        p = mi.Point2f(dr.dot(d, self.x), dr.dot(d, self.y)) / z
        if self.model is None:
            return p * self.f + self.c, z
        u, v, is_shown = project(self.model, p.x, p.y)
        return dr.select(is_shown, mi.Point2f(u, v), dr.nan), z

    # ---- How bright, how sharp ---------------------------------------------------------------------------

    def relative_illumination(self, direction: mi.Vector3f) -> mi.Float | float:
        """Fraction of a pixel's light that vignetting leaves along a unit world direction away from the device.

        It is the Python number 1 if the lens has no vignetting.
        """
        if self.vignetting is None:
            return 1.0
        return dr.power(dr.maximum(dr.dot(direction, self.z), 0), self.vignetting)

    def pixel_density(self, direction: mi.Vector3f) -> mi.Float | float:
        """Pixels per area of the plane z = 1 along a unit world direction, relative to an undistorted lens.

        Every pixel of a projector sends out the same power, so its irradiance there is multiplied by this factor. It is
        the Python number 1 without distortion, and 0 where the lens sends no light.
        """
        if self.model is None:
            return 1.0
        x, y = (dr.dot(direction, axis) / dr.dot(direction, self.z) for axis in (self.x, self.y))
        image = distort(self.model.coefficients, x, y)
        return dr.select(appears(self.model, x, y, image), image.jacobian, 0)

    def blur_px(self, z: mi.Float) -> mi.Float | None:
        """Standard deviation, in pixels, of the disc over which the image spreads a point at depth z; None: sharp.

        The diameter of the disc is 2 a f |1/z - 1/z_focus|, with the aperture's radius a. A uniform disc has the
        standard deviation diameter / 4 along each axis.
        """
        if not self.has_lens:
            return None
        return 0.5 * self.aperture * dr.sqrt(self.f.x * self.f.y) * dr.abs(dr.rcp(z) - dr.rcp(self.focus))

    # ---- The straight connection to a point --------------------------------------------------------------

    def connect(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
        pixel: mi.UInt32,
        media: Media | None = None,
        inside: Medium | None = None,
        cutouts: Cutouts | None = None,
    ) -> Connection:
        """Straight connection of the point `si` to the projector, through `media` and the holes of `cutouts` if there
        are any.

        All projector pixels have the same power. With E the irradiance at z = 1 m on the axis, the radiant intensity is
        E / cos^3. The irradiance on a surface that faces the projector is this times cos^2 / z^2, which is
        E / (z^2 cos). The lens multiplies E by the density of its pixels and by its relative illumination.

        Parameters
        ----------
        pixel : UInt32, index of the pixel that sees the point; it plays no part for a projector.
        inside : Medium, in which the point lies; None without media.
        """
        uv, z = self.project(si.p)
        to_projector = self.centre - mi.Vector3f(si.p)
        distance = dr.norm(to_projector)
        to_projector /= distance
        in_image = (uv.x >= 0) & (uv.x < self.size.x) & (uv.y >= 0) & (uv.y < self.size.y) & (z > 0)
        geometry = dr.rcp(dr.square(z) * -dr.dot(self.z, to_projector))
        if self.model is not None:
            geometry *= self.pixel_density(-to_projector)
        if self.vignetting is not None:
            geometry *= self.relative_illumination(-to_projector)
        in_image &= active
        lit, geometry = lit_from(scene, si, mi.Point3f(self.centre), geometry, in_image, media, inside, cutouts)
        blur = self.blur_px(z)
        return Connection(uv, to_projector, distance, geometry, lit, None if blur is None else dr.select(lit, blur, 0))


class CellGrid(NamedTuple):
    """Cells of equal size that make up the image of a projector.

    columns, rows : int, number of cells along x and y.
    size : Point2f, pixels, size of a cell.
    pixels_per_cell : float, area of a cell.
    """

    columns: int
    rows: int
    size: mi.Point2f
    pixels_per_cell: float

    @classmethod
    def of(cls, w: int, h: int, fineness: float = 1.0) -> CellGrid:
        """The cells of an image of w x h pixels: its pixels, or squares of them if there are more than `MAX_CELLS`.

        Each pixel is divided into `fineness` cells along each axis.
        """
        edge = max(1, math.ceil(math.sqrt(w * h * fineness**2 / MAX_CELLS))) / fineness
        columns, rows = math.ceil(w / edge), math.ceil(h / edge)
        size = mi.Point2f(dr.opaque(mi.Float, w / columns), dr.opaque(mi.Float, h / rows))
        return cls(columns, rows, size, w * h / (columns * rows))

    def place(self, cell: mi.UInt32, within: mi.Point2f) -> mi.Point2f:
        """Pixel coordinates of a place within a cell (unit square) of this flat index."""
        columns = dr.opaque(mi.UInt32, self.columns)
        return (mi.Point2f(mi.Float(cell % columns), mi.Float(cell // columns)) + within) * self.size

    def probes(self, begin: int, end: int) -> mi.Point2f:
        """Pixel coordinates of one place in each of the cells `begin` to `end` - 1, row by row.

        The places shift from row to row and from column to column by the golden ratio of a cell. Three neighbours are
        so spread that a line along rows or columns cannot pass all of them by if it is wider than 0.39 of a cell, and
        no line passes by all cells that it crosses, as it could pass by their centres.
        """
        cell = dr.arange(mi.UInt32, end - begin) + dr.opaque(mi.UInt32, begin)
        columns = dr.opaque(mi.UInt32, self.columns)
        shift_x, shift_y = (mi.Float(k * mi.UInt32(GOLDEN_STEP)) * 2.0**-32 for k in (cell // columns, cell % columns))
        return self.place(cell, mi.Point2f(shift_x, shift_y))
