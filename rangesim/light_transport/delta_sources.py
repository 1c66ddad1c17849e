# SPDX-License-Identifier: Apache-2.0
"""Light sources without extent as images, each of whose points sends out one ray.

The light of such a source beyond glass and mirrors is a smooth function of the place in its image
(`rangesim.light_transport.caustic_sheets`). The projector is one; `rangesim.light_transport.lamps` has the others.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import drjit as dr
import mitsuba as mi
import numpy as np

from rangesim.light_transport.camera_rays import Device, PrimaryRay
from rangesim.light_transport.specular_chain import RayState
from rangesim.light_transport.traced_scene import TracedScene

MAX_PIXELS = 1 << 18
"""Largest number of pixels into which the image of a coarse projector is divided. A flood illuminator has few pixels of
its own, which are only coordinates; without the division its light would have edges as coarse as these. With more,
the grid would take longer than for a projector of images."""
LENS_RADIUS, LENS_WEIGHTS = np.sqrt(2 / 3), (1 / 4, *[1 / 8] * 6)
"""Points of a lens of finite size, each of which has a grid of its own, at the lowest level: its centre and a regular
hexagon. Radius of the hexagon as a fraction of the lens, and fractions of the light. Means over these points are exact
for polynomials of the place on the lens up to degree 5 (Stroud, Approximate calculation of multiple integrals, 1971,
rule S2: 5-1), so light lands where it should on average, and blurs as much."""


class DeltaSource(ABC):
    """A light source without extent, as an image.

    Attributes
    ----------
    width, height : int, size of the image, pixels.
    watts : W, power of a pixel that sends out all of its light.
    pixel_m, pixel_rad : metres and radians. After a way of l metres without glass, the light of a pixel is
        pixel_m + pixel_rad * l wide.
    finest_px : pixels, edge of the smallest part of the image that is worth to be told apart.
    fineness : number of parts into which pixels are divided along each axis, because they are coarse.
    lens : (k, 2) float, points of the source's lens, as places in the unit square. None: the source is a point.
    lens_weights : (k,) fractions of the light that comes from each of them.
    """

    width: int
    height: int
    watts: float
    pixel_m: float
    pixel_rad: float
    finest_px: float = 1.0
    fineness: float = 1.0
    lens: np.ndarray | None = None
    lens_weights: tuple[float, ...] = (1.0,)

    @abstractmethod
    def rays(self, pixel: mi.Point2f, lens: mi.Point2f | None = None) -> tuple[PrimaryRay, mi.Float | float]:
        """The rays of points of the image, and the fraction of a pixel's light that each sends out.

        Parameters
        ----------
        pixel : Point2f, pixel coordinates. lens : Point2f, a place on the lens in the unit square; None: its centre.
        """

    @abstractmethod
    def direct(self, places: np.ndarray) -> np.ndarray:
        """(n,) float64, W/m2, irradiance that the source would make at places (n, 3), metres, that face it."""

    def start(self, traced: TracedScene, lanes: int) -> RayState:
        """The state of light that leaves the source."""
        return RayState.start(traced, lanes)


class ProjectorSource(DeltaSource):
    """The projector of a rig.

    Parameters
    ----------
    device : Device
    power_w : W, power while it shows white.
    finest_rad : radians, angle of `finest_px`.
    camera_rad : radians, smallest angle of a camera's pixel; 0: not known.
    """

    def __init__(self, device: Device, power_w: float, finest_rad: float, camera_rad: float = 0.0) -> None:
        self.device = device
        self.width, self.height = (int(n[0]) for n in device.size)
        self.watts = power_w / device.pixels
        self.pixel_m, self.pixel_rad = 0.0, 1 / float(np.sqrt(device.f.x[0] * device.f.y[0]))
        self.finest_px = finest_rad / self.pixel_rad
        coarseness = self.pixel_rad / camera_rad if camera_rad else 1.0
        self.fineness = float(np.clip(coarseness, 1, max(1, np.sqrt(MAX_PIXELS / device.pixels))))
        self.at = np.array([float(c[0]) for c in device.centre])
        if device.has_lens:
            self.finest_px, self.lens, self.lens_weights = np.inf, _lens_points(), LENS_WEIGHTS

    def rays(self, pixel: mi.Point2f, lens: mi.Point2f | None = None) -> tuple[PrimaryRay, mi.Float | float]:
        primary = self.device.centre_ray(pixel) if lens is None else self.device.sample_ray(pixel, lens)
        part = self.device.relative_illumination(primary.direction)
        return primary, part if primary.exists is None else dr.select(primary.exists, part, 0)

    def direct(self, places: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(places - self.at, axis=1)
        with np.errstate(divide="ignore"):
            return np.asarray(self.watts / (self.pixel_rad * distance) ** 2)


def _lens_points() -> np.ndarray:
    """(7, 2) float64, see `LENS_WEIGHTS`, as the places in the unit square that are mapped to them."""
    angle = np.pi / 3 * np.arange(6)
    x, y = (mi.Float(np.append(0, LENS_RADIUS * f(angle)).astype(np.float32)) for f in (np.cos, np.sin))
    return mi.warp.uniform_disk_to_square_concentric(mi.Point2f(x, y)).numpy().T.astype(np.float64)
