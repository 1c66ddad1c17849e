# SPDX-License-Identifier: Apache-2.0
"""Zones: cameras whose pixels are sums of the pixels of a finer camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from rangesim.rig.cameras import Camera, PixelRays, finite_array
from rangesim.rig.poses import Array
from rangesim.settings import limits
from rangesim.settings.bounds import Bounds, check_fields, whole
from rangesim.settings.config import shown

if TYPE_CHECKING:
    from scipy.sparse import csr_array

BLUR_REACH = 4.0
"""Distance, in standard deviations of the blur, at which it is cut off; 6e-5 of the light along an axis lies beyond."""
MIN_WEIGHT = 1e-9
"""Least weight of a pixel in a zone that is kept; smaller ones are rounding errors of the blur."""


@dataclass(frozen=True, eq=False)
class Zones(Camera):
    """A camera whose pixels are weighted sums of the pixels of a finer camera: traced fine, read coarse.

    A multi-zone time-of-flight sensor has a few zones, each of which sees as much as hundreds of pixels of a camera. A
    binned mode adds the electrons of 2 x 2 pixels. In both cases light is added up before it is counted, so a zone that
    sees an edge gets light from both sides.

    The zones are rectangles that tile the image of the finer camera. They may overlap and blur into each other, or be
    given as any matrix. Light paths are traced for the finer camera; the signals of a pass are then summed over each
    zone (`rangesim.light_transport.zone_sums`). Range images of zones are read along the rays through their middles.

    Parameters
    ----------
    camera : Camera, the finer one, whose rays are traced.
    columns, rows : int, numbers of zones.
    overlap : float, width by which a zone is larger than the distance to the next one, as a fraction of that distance.
        Beyond the image there is nothing to be seen.
    blur_px : float, standard deviation of a Gaussian blur of the zones, as by their lens, in pixels of the finer
        camera.
    weights : (rows * columns, height * width of the finer camera) float, sensitivity of each zone (row by row) to each
        pixel (row by row); 1: all light of the pixel counts. None: the rectangles. A matrix needs no `overlap` and
        `blur_px`.

    Raises
    ------
    ValueError
        A value out of its bounds, more zones than pixels along an axis, weights of another shape, negative ones, or a
        zone without any.

    Examples
    --------
    A sensor with 8 x 8 zones over 45 degrees, of which each is traced as 16 x 16 pixels:

    >>> from rangesim.rig import Intrinsics
    >>> sensor = Zones(Intrinsics.from_fov(128, 128, fov_x_deg=45.0), columns=8, rows=8)
    >>> sensor.width, sensor.matrix.shape, float(sensor.matrix.sum(axis=1)[0])
    (8, (64, 16384), 256.0)
    """

    camera: Camera
    columns: Annotated[int, whole(1, "pixels")]
    rows: Annotated[int, whole(1, "pixels")]
    overlap: Annotated[float, Bounds("0 or positive", 0, 100)] = 0.0
    blur_px: Annotated[float, Bounds("0 or positive", 0, 1e4)] = 0.0
    weights: np.ndarray | None = None

    type_name: ClassVar[str] = "zones"

    def __post_init__(self) -> None:
        check_fields(self)
        if not isinstance(self.camera, Camera) or isinstance(self.camera, Zones):
            raise ValueError(
                f"expected camera as a Camera without zones, such as Intrinsics, got {shown(self.camera)}."
            )
        limits.check("pixels", self.columns * self.rows, f"zones, not {self.columns} x {self.rows}")
        if self.weights is not None:
            self._check_weights()
        elif self.columns > self.camera.width or self.rows > self.camera.height:
            raise ValueError(
                f"expected at most {self.camera.width} x {self.camera.height} zones, one for each pixel of the finer "
                f"camera, got {self.columns} x {self.rows}."
            )

    def _check_weights(self) -> None:
        shape = self.rows * self.columns, self.camera.height * self.camera.width
        weights = finite_array(self.weights, "weights", shape)
        if weights.min() < 0 or not (weights.sum(axis=1) > 0).all():
            raise ValueError("expected weights of 0 or more, with one above 0 for each zone.")
        if self.overlap or self.blur_px:
            raise ValueError("expected either weights, or overlap and blur_px, got both.")
        object.__setattr__(self, "weights", weights)

    @property
    def width(self) -> int:  # type: ignore[override]
        return self.columns

    @property
    def height(self) -> int:  # type: ignore[override]
        return self.rows

    @property
    def has_neighbours(self) -> bool:  # type: ignore[override]
        return self.weights is None and self.camera.has_neighbours

    @property
    def traced(self) -> Camera:
        return self.camera

    @property
    def times_s(self) -> Array | None:
        times = self.camera.times_s
        return None if times is None else self.mean(times)

    @cached_property
    def matrix(self) -> csr_array:
        """(rows * columns, pixels of the finer camera) sparse float64, the weights of the pixels in each zone."""
        from scipy.sparse import csr_array, kron

        if self.weights is not None:
            return csr_array(self.weights)
        across = _along_axis(self.camera.width, self.columns, self.overlap, self.blur_px)
        down = _along_axis(self.camera.height, self.rows, self.overlap, self.blur_px)
        return csr_array(kron(csr_array(down), csr_array(across)))

    def mean(self, image: np.ndarray) -> Array:
        """(rows, columns, ...) float64, mean of an image (h, w, ...) of the finer camera over zones, without NaN."""
        flat = np.asarray(image, dtype=np.float64).reshape(self.matrix.shape[1], -1)
        known = np.isfinite(flat)
        with np.errstate(invalid="ignore"):
            mean = (self.matrix @ np.where(known, flat, 0.0)) / (self.matrix @ known.astype(np.float64))
        return np.asarray(mean.reshape(self.rows, self.columns, *np.shape(image)[2:]))

    def pixel_rays(self) -> PixelRays:
        """Rays through the middles of the zones; a zone is as wide as an even one that spreads as much."""
        rays = self.camera.rays
        directions, origins = self.mean(rays.directions), self.mean(rays.origins)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        place = np.stack(np.meshgrid(np.arange(self.camera.width), np.arange(self.camera.height)), axis=-1)
        variance = np.maximum(self.mean(place**2) - self.mean(place) ** 2, 0.0)
        pixels = np.sqrt(12 * variance + 1)[..., None]  # n pixels in a row have the variance (n^2 - 1) / 12
        shift = None if rays.origin_steps is None else self.mean(rays.origin_steps) * pixels
        return PixelRays(origins, directions, self.mean(rays.steps) * pixels, shift)

    def project(self, points: ArrayLike) -> Array:
        if self.weights is not None:
            return super().project(points)
        return self.camera.project(points) * [self.columns / self.camera.width, self.rows / self.camera.height]

    def solid_angle_sr(self) -> Array:
        fine = np.broadcast_to(self.camera.solid_angle_sr(), (self.camera.height, self.camera.width))
        return np.asarray((self.matrix @ np.nan_to_num(fine).ravel()).reshape(self.rows, self.columns))

    def etendue_m2sr(self, aperture_radius_m: float) -> float:
        """Etendue of the largest zone: that of its pixels, each by its weight, m2 sr."""
        largest = self.solid_angle_sr().max() / np.nanmax(self.camera.solid_angle_sr())
        return float(self.camera.etendue_m2sr(aperture_radius_m) * largest)


def _along_axis(pixels: int, zones: int, overlap: float, blur_px: float) -> Array:
    """(zones, pixels) float64, weights along one axis: the part of each pixel within a zone, which is then blurred."""
    edges, step = np.arange(pixels + 1), pixels / zones
    low = (np.arange(zones) - overlap / 2)[:, None] * step
    high = low + (1 + overlap) * step
    inside = np.clip(edges[1:], low, high) - np.clip(edges[:-1], low, high)
    if blur_px > 0:
        reach = int(np.ceil(BLUR_REACH * blur_px))
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / blur_px) ** 2)
        inside = np.stack([np.convolve(row, kernel / kernel.sum())[reach : reach + pixels] for row in inside])
    return np.asarray(np.where(inside > MIN_WEIGHT, inside, 0.0))
