# SPDX-License-Identifier: Apache-2.0
"""Tracks: which point is seen where in which image. What every chapter of `rangesim.multiview` takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.correspondences import Array, checked_array
from rangesim.settings.config import shown


class CommonPoints(NamedTuple):
    """point : (k,) int64, numbers of points that two images share. first, second : (k, 2) their pixels in either."""

    point: np.ndarray
    first: Array
    second: Array


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points in images, as parallel arrays sorted by point, then by image.

    image : (m,) int64, 0 to n_images - 1. point : (m,) int64, 0 to n_points - 1. pixels : (m, 2) float64, (x, y), pixel
    centres at integer + 0.5. n_images, n_points : how many there are; -1: as many as the largest numbers say.

    The dense form is (n_images, n_points, 2) with NaN where a point is not seen: `from_dense` and `dense`.

    Raises
    ------
    ValueError
        Arrays of other shapes; numbers that are no integers or out of range; pixels that are not finite; a point that
        is seen twice in one image.
    """

    image: np.ndarray
    point: np.ndarray
    pixels: Array
    n_images: int = -1
    n_points: int = -1

    def __post_init__(self) -> None:
        pixels = checked_array("pixels", self.pixels, None, 2)
        if pixels.ndim != 2:
            raise ValueError(f"expected pixels of shape (m, 2), got {pixels.shape}.")
        numbers = []
        for name, given, count in (("image", self.image, self.n_images), ("point", self.point, self.n_points)):
            array = np.asarray(given)
            if array.shape != (len(pixels),) or (array.size and not np.issubdtype(array.dtype, np.integer)):
                raise ValueError(
                    f"expected {name} as ({len(pixels)},) integers, one for each of the pixels, got shape "
                    f"{array.shape} of {array.dtype}."
                )
            array = array.astype(np.int64)
            if not isinstance(count, (int, np.integer)) or count < -1:
                raise ValueError(f"expected n_{name}s as a number of {name}s, got {shown(count)}.")
            most = int(array.max(initial=-1)) + 1
            size = most if count == -1 else int(count)
            if array.min(initial=0) < 0 or most > size:
                raise ValueError(f"expected numbers of {name}s from 0 to {size - 1}, got {array.min()} to {most - 1}.")
            object.__setattr__(self, f"n_{name}s", size)
            numbers.append(array)
        image, point = numbers
        order = np.lexsort((image, point))
        image, point, pixels = image[order], point[order], pixels[order]
        twice = np.flatnonzero((np.diff(image) == 0) & (np.diff(point) == 0))
        if len(twice):
            k = twice[0]
            raise ValueError(
                f"expected each point at most once in an image, got point {point[k]} twice in image {image[k]}, and "
                f"{len(twice) - 1} more; keep one of them."
            )
        for name, array in (("image", image), ("point", point), ("pixels", pixels)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @classmethod
    def from_dense(cls, pixels: ArrayLike) -> Tracks:
        """Tracks of pixels (n_images, n_points, 2), NaN, or masked, in both coordinates where a point is not seen.

        Raises
        ------
        ValueError
            Another shape; infinite pixels; pixels of which one coordinate alone is NaN.
        """
        try:
            if isinstance(pixels, np.ma.MaskedArray):  # what is masked is not seen
                pixels = np.where(np.ma.getmaskarray(pixels), np.nan, pixels.data.astype(np.float64))
            dense = np.asarray(pixels, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"expected pixels (n_images, n_points, 2) of numbers, got {shown(pixels)}.") from None
        if dense.ndim != 3 or dense.shape[2] != 2:
            raise ValueError(f"expected pixels of shape (n_images, n_points, 2), got {dense.shape}.")
        if np.isinf(dense).any():
            raise ValueError("expected finite pixels, or NaN where a point is not seen, got infinite ones.")
        missing = np.isnan(dense)
        half = missing[..., 0] != missing[..., 1]
        if half.any():
            i, j = np.argwhere(half)[0]
            raise ValueError(
                f"expected NaN in both coordinates where a point is not seen, got {dense[i, j].tolist()} of point {j} "
                f"in image {i}."
            )
        image, point = np.nonzero(~missing[..., 0])
        return cls(image, point, dense[image, point], *dense.shape[:2])

    def dense(self) -> Array:
        """(n_images, n_points, 2) pixels; NaN where a point is not seen."""
        result = np.full((self.n_images, self.n_points, 2), np.nan)
        result[self.image, self.point] = self.pixels
        return result

    def seen(self) -> np.ndarray:
        """(n_images, n_points) bool: which image sees which point."""
        result = np.zeros((self.n_images, self.n_points), dtype=bool)
        result[self.image, self.point] = True
        return result

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.image)

    def __repr__(self) -> str:
        full = max(self.n_images * self.n_points, 1)
        return (
            f"Tracks({len(self)} observations of {self.n_points} points in {self.n_images} images, "
            f"{len(self) / full:.0%} of all)"
        )

    @property
    def images_per_point(self) -> np.ndarray:
        """(n_points,) in how many images each point is seen."""
        return np.bincount(self.point, minlength=self.n_points)

    @property
    def points_per_image(self) -> np.ndarray:
        """(n_images,) how many points each image sees."""
        return np.bincount(self.image, minlength=self.n_images)

    def keep(self, observations: np.ndarray) -> Tracks:
        """The tracks with these observations alone, (m,) bool or indices; images and points keep their numbers."""
        return Tracks(
            self.image[observations], self.point[observations], self.pixels[observations], self.n_images, self.n_points
        )

    def of_images(self, images: ArrayLike) -> Tracks:
        """The tracks in some images, (k,) different numbers, which become 0 to k - 1; points keep their numbers.

        Raises
        ------
        ValueError
            Numbers that are no integers, out of range, or not different: copy the pixels to see an image twice.
        """
        given = np.asarray(images)
        if given.ndim != 1 or (given.size and not np.issubdtype(given.dtype, np.integer)):
            raise ValueError(f"expected images as (k,) integers, got shape {given.shape} of {given.dtype}.")
        chosen = given.astype(np.int64)
        self._check_images(chosen)
        if len(np.unique(chosen)) < len(chosen):
            raise ValueError(f"expected different images, got {shown(chosen.tolist())}.")
        place = np.full(self.n_images, -1)
        place[chosen] = np.arange(len(chosen))
        some = place[self.image] >= 0
        return Tracks(place[self.image[some]], self.point[some], self.pixels[some], len(chosen), self.n_points)

    def common(self, first: int, second: int) -> CommonPoints:
        """The points that two images share, with their pixels in either; ValueError for images that are none."""
        self._check_images(np.array([first, second]))
        one, two = (np.flatnonzero(self.image == k) for k in (first, second))
        point, a, b = np.intersect1d(self.point[one], self.point[two], assume_unique=True, return_indices=True)
        return CommonPoints(point, self.pixels[one[a]], self.pixels[two[b]])

    def _check_images(self, images: np.ndarray) -> None:
        outside = images[(images < 0) | (images >= self.n_images)]
        if len(outside):
            raise ValueError(f"expected images from 0 to {self.n_images - 1}, got {outside[0]}.")
