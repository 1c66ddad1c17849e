# SPDX-License-Identifier: Apache-2.0
"""Tracks: which point is seen in which image, and at which pixel. Every method of `rangesim.multiview` takes them.

Used by: all modules of `rangesim.multiview` except `schur_complement`; no other module of rangesim.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rangesim.geometry.correspondences import Array, checked_array
from rangesim.settings.config import shown


class CommonPoints(NamedTuple):
    """The points that two images share, with their pixels in both images.

    point : (k,) int64, numbers of the points, ascending. first, second : (k, 2) float64, pixels (x, y) in the first and
    in the second image.

    Examples
    --------
    >>> tracks = Tracks(image=[0, 1, 1], point=[4, 4, 7], pixels=[[10.5, 20.5], [12.5, 20.5], [30.5, 8.5]])
    >>> common = tracks.common(0, 1)
    >>> common.point, common.second - common.first
    (array([4]), array([[2., 0.]]))
    """

    point: np.ndarray
    first: Array
    second: Array


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points in images, as parallel arrays sorted by point, then by image.

    image : (m,) int64, number of the image of each observation, 0 to n_images - 1.
    point : (m,) int64, number of the point of each observation, 0 to n_points - 1.
    pixels : (m, 2) float64, (x, y) of each observation, with pixel centres at integer + 0.5.
    n_images, n_points : numbers of images and points; -1 takes the largest number in `image` or `point`, plus one.

    The dense form is an array (n_images, n_points, 2) with NaN where a point is not seen. `from_dense` reads it, and
    `dense` returns it.

    Raises
    ------
    ValueError
        The arrays have other shapes, the numbers are not integers or are out of range, a pixel is not finite, or a
        point is seen twice in one image.

    Examples
    --------
    >>> tracks = Tracks(image=[0, 0, 1], point=[0, 1, 1], pixels=[[10.5, 20.5], [30.5, 8.5], [31.5, 8.5]])
    >>> tracks
    Tracks(3 observations of 2 points in 2 images, 75% of all)
    >>> tracks.images_per_point
    array([1, 2])
    >>> tracks.dense()[1]
    array([[ nan,  nan],
           [31.5,  8.5]])
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
        """The tracks of a dense array of pixels.

        Parameters
        ----------
        pixels : (n_images, n_points, 2), (x, y) with pixel centres at integer + 0.5. Where a point is not seen, both
            coordinates are NaN or masked.

        Raises
        ------
        ValueError
            The array has another shape, a pixel is infinite, or only one coordinate of a pixel is NaN.

        Examples
        --------
        >>> import numpy as np
        >>> pixels = np.full((3, 10, 2), 100.5)
        >>> pixels[1, 4] = np.nan
        >>> Tracks.from_dense(pixels)
        Tracks(29 observations of 10 points in 3 images, 97% of all)
        """
        try:
            if isinstance(pixels, np.ma.MaskedArray):  # a masked point is not seen
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
        """(n_images, n_points, 2) float64, pixels; NaN where a point is not seen."""
        result = np.full((self.n_images, self.n_points, 2), np.nan)
        result[self.image, self.point] = self.pixels
        return result

    def seen(self) -> np.ndarray:
        """(n_images, n_points) bool, whether an image sees a point."""
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
        """(n_points,) int64, number of images that see each point."""
        return np.bincount(self.point, minlength=self.n_points)

    @property
    def points_per_image(self) -> np.ndarray:
        """(n_images,) int64, number of points that each image sees."""
        return np.bincount(self.image, minlength=self.n_images)

    def keep(self, observations: np.ndarray) -> Tracks:
        """The tracks with some of the observations; images and points keep their numbers.

        observations : (m,) bool, or int64 indices of the observations to keep.
        """
        return Tracks(
            self.image[observations], self.point[observations], self.pixels[observations], self.n_images, self.n_points
        )

    def of_images(self, images: ArrayLike) -> Tracks:
        """The tracks in some of the images, which get the numbers 0 to k - 1; points keep their numbers.

        images : (k,) integers, each at most once, in the order of the new numbers.

        Raises
        ------
        ValueError
            A number is not an integer, is out of range, or occurs twice. To use an image twice, copy its pixels.
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
        """The points that two images share, with their pixels in both; ValueError for an image that does not exist."""
        self._check_images(np.array([first, second]))
        one, two = (np.flatnonzero(self.image == k) for k in (first, second))
        point, a, b = np.intersect1d(self.point[one], self.point[two], assume_unique=True, return_indices=True)
        return CommonPoints(point, self.pixels[one[a]], self.pixels[two[b]])

    def _check_images(self, images: np.ndarray) -> None:
        outside = images[(images < 0) | (images >= self.n_images)]
        if len(outside):
            raise ValueError(f"expected images from 0 to {self.n_images - 1}, got {outside[0]}.")
