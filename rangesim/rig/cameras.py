# SPDX-License-Identifier: Apache-2.0
"""The interface of a camera: for each pixel a ray, the angles around it from which light arrives, and perhaps a time.

`rangesim.rig.Intrinsics` is the pinhole camera. `rangesim.rig.ray_cameras` has cameras with other rays: fisheye lenses,
telecentric lenses, and tables of rays such as those of scanning LiDARs. A new camera is a frozen dataclass that derives
from `Camera` and says its rays.

Coordinates of a camera follow OpenCV: x right, y down, z forward, metres. A scanner that turns has them too, in its
position at azimuth 0.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.rig.poses import Array
from rangesim.settings.config import Named, shown

Acceptance = Literal["box", "gaussian"]
"""How the sensitivity of a pixel (or the power of a beam) depends on the angle: even within its field, or Gaussian."""


class Optics(Named, ABC):
    """Base of everything that decides on the rays of a device: cameras, projectors and beams.

    Subclasses are frozen dataclasses. Those with arrays among their fields are made with `eq=False`: two of them are
    equal if all their fields are, arrays byte for byte.

    width, height : int, size of the image, pixels.
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    width: int
    height: int

    def __eq__(self, other: Any) -> bool:
        return type(self) is type(other) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self._values())

    def _values(self) -> tuple[Any, ...]:
        """Values of the fields, with arrays as their shapes and bytes, and lists as tuples."""
        return tuple(_hashable(value) for value in self.__getstate__().values())

    def __getstate__(self) -> dict[str, Any]:
        """Fields by name: what is computed from them, such as `Camera.rays`, is not pickled."""
        return {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}  # type: ignore[arg-type]


class HasRanges(Protocol):
    """An image with depths z and ranges `range_m`, both (h, w) float32, metres."""

    @property
    def z(self) -> np.ndarray: ...

    @property
    def range_m(self) -> np.ndarray: ...


class PixelRays(NamedTuple):
    """The rays through the pixel centres of a camera, in its coordinates.

    origins : (h, w, 3) float64, metres, where each ray starts. Ranges count from there.
    directions : (h, w, 3) float64, unit vectors.
    steps : (h, w, 2, 3) float64, change of the direction from the left to the right side of the pixel, and from its
        upper to its lower side, radians.
    origin_steps : (h, w, 2, 3) float64, metres, change of the origin likewise. None: all rays of a pixel start at one
        point.
    """

    origins: Array
    directions: Array
    steps: Array
    origin_steps: Array | None = None


class Camera(Optics):
    """A camera: a ray for each pixel.

    Subclasses are frozen dataclasses. They state the rays (`pixel_rays`); everything else follows from these.

    Attributes
    ----------
    is_pinhole : whether all rays pass through the origin and z is positive along all of them, so that the camera's
        images are depth images. The range images of all other cameras are read along the rays.
    acceptance : how the sensitivity of a pixel depends on the angle to its ray.
    has_neighbours : whether pixels beside each other see places beside each other.
    """

    is_pinhole: ClassVar[bool] = False
    acceptance: Acceptance = "box"
    has_neighbours: ClassVar[bool] = True

    @abstractmethod
    def pixel_rays(self) -> PixelRays:
        """Rays through the pixel centres, computed anew. Whoever reads them takes `rays`."""

    @cached_property
    def rays(self) -> PixelRays:
        """Rays through the pixel centres. They are computed once, because decoders and causes ask many times."""
        return self.pixel_rays()

    @property
    def times_s(self) -> Array | None:
        """(h, w) float64, seconds from the start of an image, when each ray is measured; None: all at once."""
        return None

    @property
    def traced(self) -> Camera:
        """The camera whose rays are traced: this one, or the finer one that zones are made of."""
        return self

    @property
    def rings(self) -> NDArray[np.uint16] | None:
        """(h, w) uint16, the beam of a turning head that measures each ray, if the rows are its rings; None: they are
        not."""
        return None

    @property
    def lattice(self) -> NDArray[np.int64] | None:
        """(h, w) int64, flat indices of the pixels in an order in which those beside each other see places beside each
        other, if that is not the order of the image; None: it is, or no such order is known."""
        return None

    def pixel_centres(self, rows: slice = slice(None)) -> Array:
        """(height, width, 2) float64, pixel coordinates (x, y) of the pixel centres.

        rows : the rows to return; default all.
        """
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height)[rows] + 0.5)
        return np.stack([x, y], axis=-1)

    def project(self, points: ArrayLike) -> Array:
        """(..., 2) float64, pixel coordinates of points (..., 3) in coordinates of this camera, metres.

        Raises
        ------
        ValueError
            The pixels of this camera follow no law, so that the pixel that sees a point is not known.
        """
        raise ValueError(f"expected a camera that projects points to pixels, got {type(self).__name__}.")

    def cropped(self, top: int, bottom: int, left: int, right: int) -> Camera:
        """The camera of a part of the image: rows `top` to `bottom` - 1, columns `left` to `right` - 1.

        Raises
        ------
        ValueError
            A part of this camera's image is no camera of the package.
        """
        raise ValueError(f"expected a camera whose image can be cropped, got {type(self).__name__}.")

    # ---- What follows from the rays -----------------------------------------------------------------------------

    @property
    def is_forward(self) -> bool:
        """Whether no ray leads sideways or backwards, so that z grows with the range along every ray."""
        return self.is_pinhole or not bool((self.rays.directions[..., 2] <= 0.0).any())

    def angle_of(self, pixels: float) -> float:
        """Angle between two rays that are that many pixels apart, radians, typical of the camera."""
        return float(pixels * np.nanmedian(np.linalg.norm(self.rays.steps, axis=-1)))

    def solid_angle_sr(self) -> Array | float:
        """(h, w) float64, or one number for all pixels: solid angle from which a pixel receives light, steradians.

        For a pixel with Gaussian acceptance, it is the integral of the acceptance, which is 1 along the ray.
        """
        steps = self.rays.steps
        area = np.linalg.norm(np.cross(steps[..., 0, :], steps[..., 1, :]), axis=-1)
        return np.asarray(area * (np.pi / 8 if self.acceptance == "gaussian" else 1.0))

    def etendue_m2sr(self, aperture_radius_m: float) -> float:
        """Area of the entrance pupil times solid angle of the largest pixel, m2 sr.

        Smaller pixels receive less light in proportion, see `Rig.camera_illumination`.

        aperture_radius_m : radius of the entrance pupil, metres.
        """
        return float(np.pi * aperture_radius_m**2 * np.nanmax(self.solid_angle_sr()))

    def reading(self, image: HasRanges) -> np.ndarray:
        """(h, w) float32, metres, the distances by which this camera's images are read and compared.

        They are depths z for a pinhole camera, and ranges along the rays for every other one.

        image : a `RangeImage` or a `GroundTruth` of this camera.
        """
        return image.z if self.is_pinhole else image.range_m

    def rays_at(self, at: Any, offset: ArrayLike = (0.0, 0.0)) -> tuple[Array, Array]:
        """Origins (n, 3) and directions (n, 3) float64, camera coordinates, of rays through some pixels.

        A point is origin + direction * reading, see `reading`; so the directions of a pinhole have z = 1, and those of
        every other camera unit length.

        Parameters
        ----------
        at : index of the n pixels in an array (h, w).
        offset : (2,) pixels, from the pixel centres to the rays.
        """
        return self.rays_beside(at)(offset)

    def rays_beside(self, at: Any) -> Callable[[ArrayLike], tuple[Array, Array]]:
        """Function from offsets (2,), pixels, to the rays of `rays_at`, for callers that ask for many offsets.

        Of offsets (m, 1, 2) it makes (m, n, 3) rays; the origins may be (n, 3), if they are the same.
        """
        rays = self.rays
        origins, directions, steps = rays.origins[at], rays.directions[at], rays.steps[at]
        origin_steps = None if rays.origin_steps is None else rays.origin_steps[at]

        def through(offset: ArrayLike) -> tuple[Array, Array]:
            x, y = np.moveaxis(np.asarray(offset, dtype=np.float64), -1, 0)[..., None]
            moved = directions + steps[:, 0] * x + steps[:, 1] * y
            start = origins
            if origin_steps is not None:
                start = origins + origin_steps[:, 0] * x + origin_steps[:, 1] * y
            return start, moved / np.linalg.norm(moved, axis=-1, keepdims=True)

        return through

    def points(self, image: HasRanges) -> Array:
        """(h, w, 3) float64, metres, camera coordinates, the points that an image shows; NaN where it shows none.

        image : a `RangeImage` or a `GroundTruth` of this camera.
        """
        everywhere = np.ones((self.height, self.width), dtype=bool)
        origins, directions = self.rays_at(everywhere)
        points = origins + directions * np.asarray(self.reading(image), dtype=np.float64).reshape(-1, 1)
        return np.asarray(points.reshape(self.height, self.width, 3))

    def z_of(self, range_m: np.ndarray, rows: slice = slice(None)) -> Array:
        """(h, w) float64, metres, z coordinate of the points at these ranges (h, w) along the rays of some rows."""
        rays = self.rays
        return np.asarray(rays.origins[rows, :, 2] + rays.directions[rows, :, 2] * range_m)


def rays_by(unit_rays: Callable[[Array], Array], camera: Camera) -> PixelRays:
    """Rays of a camera at whose origin all of them start.

    unit_rays : function that maps pixel coordinates (..., 2) to the unit vectors (..., 3) of their rays.
    """
    x, y = np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)
    sides = unit_rays(np.stack(np.meshgrid(x, y[:-1] + 0.5), axis=-1))  # left and right of each pixel
    ends = unit_rays(np.stack(np.meshgrid(x[:-1] + 0.5, y), axis=-1))  # above and below it
    steps = np.stack([np.diff(sides, axis=1), np.diff(ends, axis=0)], axis=-2)
    directions = unit_rays(camera.pixel_centres())
    return PixelRays(np.zeros(directions.shape), directions, steps)


def tangents(directions: Array) -> tuple[Array, Array]:
    """Two unit vectors (..., 3) across each direction (..., 3): to the right, and downwards.

    The first is level (it has no y), and for a direction along y it points along x.
    """
    x, _, z = np.moveaxis(directions, -1, 0)
    level = np.hypot(x, z)
    upright = level > 1e-9
    across = np.where(upright, level, 1.0)
    right = np.stack([np.where(upright, z / across, 1.0), np.zeros_like(x), np.where(upright, -x / across, 0.0)], -1)
    return right, np.cross(directions, right)


def _hashable(value: Any) -> Any:
    """A value that is equal and hashes equally if the given one is equal."""
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    return tuple(value) if isinstance(value, list) else value


def finite_array(value: Any, name: str, shape: tuple[int | None, ...]) -> Array:
    """The value as a read-only float64 array of that shape, in which None stands for any size.

    name : what the value is, for the message.

    Raises
    ------
    ValueError
        Another shape, no values, or values that are not finite.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"expected {name} as an array of numbers, got {shown(value)}.") from None
    fits = array.ndim == len(shape) and all(s in (None, n) for s, n in zip(shape, array.shape, strict=True))
    if not fits or array.size == 0:
        expected = ", ".join("n" if s is None else str(s) for s in shape)
        raise ValueError(f"expected {name} of shape ({expected}), got {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"expected finite {name}, got {int((~np.isfinite(array)).sum())} values that are not.")
    array.setflags(write=False)
    return array


def unit_directions(value: Any) -> Array:
    """The value as read-only directions (h, w, 3) float64 of unit length; ValueError if it is no such array."""
    directions = finite_array(value, "directions", (None, None, 3))
    lengths = np.linalg.norm(directions, axis=-1, keepdims=True)
    if not (lengths > 0).all():
        raise ValueError("expected directions that are not (0, 0, 0).")
    # What is unit length already is kept, so that reading what was written changes nothing
    is_unit = np.abs(lengths - 1) < 4 * np.finfo(np.float64).eps
    result = np.where(is_unit, directions, directions / lengths)
    result.setflags(write=False)
    return np.asarray(result)
