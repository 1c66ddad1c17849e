# SPDX-License-Identifier: Apache-2.0
"""The points and arguments that callers hand in, checked and brought to one form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.cloud import Cloud, as_numbers
from pcgraph.cloud_sources import as_cloud
from pcgraph.columns import RobustScaling
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.rounding import TINY
from pcgraph.voxels.cells import bounding_box
from pcgraph.voxels.sampling import sample

_MAX_ZEROS = 1000
"""Points of a list at (0, 0, 0), at most, if these are points: if more are there, they are holes; chosen by eye."""
_MAX_ZEROS_ONE_IN = 1000
"""Points of a list per point at (0, 0, 0), at least, in the same way; chosen by eye."""
_MIN_LENGTH_M = 1e-250
"""Metres: lengths that are given are no less; chosen by eye, so that voxels of 1e-200 still work."""
_MAX_LENGTH_M = 1e100
"""Metres: coordinates and lengths are no larger, because far beyond it squares of distances overflow."""
_SAME_PLACE = 0.02
"""Median ranges between viewpoints that are one, at most, as of a sweep whose scanner moved a little; chosen by eye."""
_RANGE_SAMPLE = 1 << 12
"""Points off which the median range is read, about; chosen by eye, for the time's sake."""


Points = Any
"""What `pcgraph.segment` takes: whatever `pcgraph.as_cloud` takes."""


Features = ArrayLike | str | Sequence[str] | None
"""What `pcgraph.segment` takes as features: numbers, or names of a cloud's columns."""


class Arrays(NamedTuple):
    """Points, and their colours, normals, features and viewpoints; None for those that are not given."""

    points: ArrayLike
    colors: ArrayLike | None
    normals: ArrayLike | None
    viewpoint: ArrayLike | None
    features: ArrayLike | None


def as_arrays(
    points: Points,
    colors: ArrayLike | None,
    normals: ArrayLike | None,
    viewpoint: ArrayLike | None,
    features: Features = None,
) -> Arrays:
    """The arguments as arrays; those that are None are taken from the cloud that `points` is, or that has them.

    Features that are names are replaced by the columns of the cloud that have these names.

    Raises
    ------
    CloudReadError
        `points` names a file that cannot be read as a cloud.
    ValueError
        `points` is nothing that `as_cloud` takes, or `features` names a column that is not there, or that has another
        shape.
    """
    cloud, names = as_cloud(points), _names(features)
    return Arrays(
        cloud.points,
        cloud.colors if colors is None else colors,
        cloud.normals if normals is None else normals,
        cloud.viewpoint if viewpoint is None else viewpoint,
        _columns(cloud, names) if names else features,  # type: ignore[arg-type]
    )


def _names(features: Features) -> list[str]:
    """The names of columns, if features are such; else none."""
    if isinstance(features, str):
        return [features]
    return list(features) if isinstance(features, (list, tuple)) and all(isinstance(f, str) for f in features) else []


def _columns(cloud: Cloud, names: list[str]) -> NDArray[np.float64]:
    """The columns of these names as one array, points' leading shape + (d,); a vector adds each of its numbers."""
    shape = np.shape(cloud.points)[:-1]
    columns = []
    for name in names:
        if name not in cloud.columns:
            known = ", ".join(cloud.columns)[:200] or "none"
            raise ValueError(f"expected features to name columns of the cloud, got {name!r}; there are: {known}")
        column = as_numbers(f"the column {name!r}", cloud.columns[name])
        if column.shape[: len(shape)] != shape or column.ndim > len(shape) + 1:
            raise ValueError(f"expected the column {name!r} in the points' shape {shape}, got {column.shape}")
        with np.errstate(over="ignore"):
            columns.append(column.reshape(*shape, -1).astype(np.float64))
    return np.concatenate(columns, axis=-1)


class ImageView(NamedTuple):
    """The place and the axis from which an image was seen.

    Attributes
    ----------
    place : (3,) float64, metres
    axis : (3,) float64, or None
        Optical axis of the camera that took it, of unit length, forwards; None if it may have been another sensor.
    """

    place: NDArray[np.float64]
    axis: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class Pixels:
    """The pixel of each of n points in an image; no two points share one.

    Attributes
    ----------
    shape : (h, w)
        Numbers of rows and columns of the image.
    at : (n,) int64
        Flat index of each point's pixel.
    view : ImageView, or None
        View of the camera that was found if the points came as a list; None if they came organised.
    """

    shape: tuple[int, int]
    at: NDArray[np.int64]
    view: ImageView | None = None

    @cached_property
    def point_at(self) -> NDArray[np.int32]:
        """The point of each pixel, (h * w,); -1 if there is none."""
        points = np.full(self.shape[0] * self.shape[1], -1, np.int32)
        points[self.at] = np.arange(len(self.at), dtype=np.int32)
        return points

    @cached_property
    def order(self) -> NDArray[np.int32]:
        """The points in the order of their pixels, (n,)."""
        return self.point_at[self.point_at >= 0]


@dataclass(frozen=True, eq=False)
class CleanCloud(ShortRepr):
    """The finite points of a cloud.

    Attributes
    ----------
    points : (n, 3) float64, metres, contiguous
    colors : (n, 3) float64, 0..1, or None
    normals : (n, 3) float64, unit length, or zero where none was given, or None
    shape : (s,) or (h, w)
        Leading shape of the points as given.
    kept : (n,) int64
        Flat indices of the finite points among these.
    outliers : (o,) int64
        Flat indices of finite points that were left out as outliers.
    features : (n, d) float32, -4..4, or None
        Features, scaled by `scaling`.
    scaling : RobustScaling of d columns, or None
    image : Pixels, or None
        Pixels of the points in their image; None if they are a mere list.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.float64] | None
    normals: NDArray[np.float64] | None
    shape: tuple[int, ...]
    kept: NDArray[np.int64]
    outliers: NDArray[np.int64]
    features: NDArray[np.float32] | None = None
    scaling: RobustScaling | None = None
    image: Pixels | None = None

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest coordinates, (3,) each."""
        return bounding_box(self.points)

    @cached_property
    def sample(self) -> NDArray[np.float64]:
        """About 16 000 of the points, without duplicates, in a pseudo-random order that does not depend on theirs."""
        return sample(self.points, self.bounds)

    def in_input_shape(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """Labels of the points in the input's shape, int32; -1 where nothing was measured, and of outliers."""
        if len(labels) == math.prod(self.shape):
            return labels.astype(np.int32).reshape(self.shape)
        full = np.full(self.shape, -1, np.int32)
        full.reshape(-1)[self.kept] = labels
        return full

    @property
    def is_outlier(self) -> NDArray[np.bool_]:
        """Whether each point was left out as an outlier, in the input's shape."""
        full = np.zeros(self.shape, np.bool_)
        full.reshape(-1)[self.outliers] = True
        return full

    def without(self, outliers: NDArray[np.bool_]) -> CleanCloud:
        """The cloud without some points, (n,) bool, which become outliers; a mere list without pixels."""
        left = np.flatnonzero(~outliers)
        return replace(
            self,
            points=self.points.take(left, axis=0),
            colors=None if self.colors is None else self.colors.take(left, axis=0),
            normals=None if self.normals is None else self.normals.take(left, axis=0),
            kept=self.kept[left],
            outliers=np.sort(np.concatenate((self.outliers, self.kept[outliers]))),
            features=None if self.features is None else self.features.take(left, axis=0),
            image=None,
        )


def clean_cloud(
    points: ArrayLike,
    colors: ArrayLike | None,
    normals: ArrayLike | None,
    features: ArrayLike | None = None,
    scaling: RobustScaling | None = None,
) -> CleanCloud:
    """The finite points with their colours, normals and features.

    Features are scaled by `scaling` if it is given, else by their own medians and spreads.

    Raises
    ------
    ValueError
        A shape, dtype or range is not the documented one, or no point is finite.
    """
    array = as_numbers("points", points)
    if array.ndim not in (2, 3) or array.shape[-1] != 3:
        raise ValueError(f"expected points of shape (n, 3) or (h, w, 3), got {array.shape}")
    shape = array.shape[:-1]
    flat = array.reshape(-1, 3)
    if not len(flat):
        raise ValueError("expected at least one point, got an empty cloud")
    kept = np.flatnonzero(_is_measured(flat, organised=len(shape) == 2))
    if not len(kept):
        no_points = "NaN or infinite" + (", or (0, 0, 0) as holes are" if len(shape) == 2 else "")
        raise ValueError(f"expected at least one finite point, but all {len(flat)} points are {no_points}")
    with np.errstate(over="ignore"):  # long doubles may be too large
        places = _rows(flat, kept).astype(np.float64, order="C")
    none = np.empty(0, np.int64)
    clean = CleanCloud(places, _colors(colors, shape, kept), _normals(normals, shape, kept), shape, kept, none)
    if len(shape) == 2:
        clean = replace(clean, image=Pixels(shape, kept))
    largest = float(np.abs(clean.bounds).max())
    if largest > _MAX_LENGTH_M:
        raise ValueError(f"expected coordinates below {_MAX_LENGTH_M:g} m, got {largest:g} m")
    if features is None:
        return clean
    numbers = _features(features, shape, kept)
    scaling = RobustScaling.of(numbers) if scaling is None else scaling
    if len(scaling) != numbers.shape[1]:
        expected = f"{len(scaling)} columns of features as in the earlier scan"
        raise ValueError(f"expected {expected}, got {numbers.shape[1]}")
    return replace(clean, features=scaling.scaled(numbers), scaling=scaling)


def _is_measured(points: NDArray[np.generic], organised: bool) -> NDArray[np.bool_]:
    """Whether each of n points, (n, 3), was measured: it is finite, and not one of many at (0, 0, 0).

    Drivers write (0, 0, 0) for holes.
    """
    is_point = np.isfinite(points[:, 0]) & np.isfinite(points[:, 1]) & np.isfinite(points[:, 2])
    zeros = np.flatnonzero(points[:, 0] == 0)
    zeros = zeros[(points[zeros, 1] == 0) & (points[zeros, 2] == 0)]
    several = 1 if organised else max(_MAX_ZEROS, len(points) // _MAX_ZEROS_ONE_IN)
    if len(zeros) > several and (organised or len(zeros) < np.count_nonzero(is_point)):
        is_point[zeros] = False
    return is_point


def clean_viewpoint(viewpoint: ArrayLike, cloud: CleanCloud) -> NDArray[np.float64]:
    """The viewpoint as given, (3,) or (n, 3) float64, metres.

    Viewpoints of the points that are nearly one place become one, as of a sweep whose scanner moved a little.
    """
    given = as_numbers("viewpoint", viewpoint).astype(np.float64)
    per_point = given.ndim > 1 and given.shape == (*cloud.shape, 3)
    position = given.reshape(-1, 3).take(cloud.kept, axis=0) if per_point else given
    if position.shape not in ((3,), cloud.points.shape) or not (np.abs(position) <= _MAX_LENGTH_M).all():
        raise ValueError(
            f"expected a viewpoint of three finite coordinates in metres, or one per point, {(*cloud.shape, 3)}, "
            f"finite at finite points; got an array of shape {given.shape}{_excerpt(given)}"
        )
    return position if position.ndim == 1 or not len(position) else _one_place(position, cloud.points)


def _one_place(places: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The middle of places, (n, 3), if they lie near each other against the ranges of the points; else the places."""
    low, high = bounding_box(places)
    if (low == high).all():
        return places[0]
    middle = low + (high - low) / 2.0
    ranges = np.linalg.norm(points[:: len(points) // _RANGE_SAMPLE + 1] - middle, axis=1)
    return middle if (high - low).max() <= _SAME_PLACE * np.median(ranges) else places


def _excerpt(values: NDArray[np.float64]) -> str:
    """End of the message about a viewpoint of a wrong shape or value."""
    if values.size <= 4:
        return f" of {values.tolist()}"
    if values.shape == (4, 4):
        return "; of a camera's pose, 4 x 4, its place is the last column: pose[:3, 3]"
    return "" if np.isfinite(values).all() else " with NaN or infinite values"


def positive(name: str, value: float) -> float:
    """The value as float, if it is a number of metres from 1e-250 to 1e100; ValueError otherwise."""
    number = _number(value)
    if not _MIN_LENGTH_M <= number <= _MAX_LENGTH_M:
        most = f"{_MIN_LENGTH_M:g} to {_MAX_LENGTH_M:g} works"
        raise ValueError(f"expected a finite {name} above 0 metres, got {value!r}; {most}")
    return number


def non_negative(name: str, value: float) -> float:
    """The value as float, if it is a finite number of at least zero; ValueError otherwise."""
    number = _number(value)
    if not 0.0 <= number < float("inf"):
        raise ValueError(f"expected {name} to be a finite number, not negative, got {value!r}")
    return number


def check_non_negative(settings: object, *names: str) -> None:
    """Raise ValueError unless `non_negative` takes these attributes of a dataclass; by default all its fields."""
    for name in names or [field.name for field in fields(settings)]:  # type: ignore[arg-type]
        non_negative(name, getattr(settings, name))


def fraction(name: str, value: float) -> float:
    """The value as float, if it is in 0..1 without 1; ValueError otherwise."""
    number = _number(value)
    if not 0.0 <= number < 1.0:
        raise ValueError(f"expected {name} of at least 0 and below 1, got {value!r}")
    return number


def whole_number(name: str, value: int, least: int = 1) -> int:
    """The value as int, if it is a whole number of at least the least; ValueError otherwise."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise ValueError(f"expected {name} as a whole number of at least {least}, got {value!r}")
    return int(value)


def _number(value: float) -> float:
    """The value as float; NaN if it is no number."""
    if isinstance(value, (str, bytes)):
        return float("nan")
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def _same_shape(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.generic]:
    """Rows of three values, (n, 3), for points of a shape; ValueError if they have another."""
    array = as_numbers(name, values)
    if array.shape != (*shape, 3):
        raise ValueError(f"expected {name} of the points' shape {(*shape, 3)}, got {array.shape}")
    return array.reshape(-1, 3)


def _rows(values: NDArray[np.generic], kept: NDArray[np.int64]) -> NDArray[np.generic]:
    """The rows whose indices are kept, which ascend; a view if these are all rows."""
    return values if len(kept) == len(values) else values.take(kept, axis=0)


def _colors(colors: ArrayLike | None, shape: tuple[int, ...], kept: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Colours of the points that are kept, (n, 3) float64, 0..1; ValueError if they are not as documented."""
    if colors is None:
        return None
    masked = np.ma.getmaskarray(colors) if isinstance(colors, np.ma.MaskedArray) else np.zeros(0, bool)
    array = _rows(_same_shape("colors", np.ma.getdata(colors) if masked.any() else colors, shape), kept)
    if masked.any() and masked.reshape(-1, 3)[kept].any():
        raise ValueError("expected colors of all finite points, but some are masked; fill them, or mask the points")
    if array.dtype == np.uint8:
        shades = array.astype(np.float64, order="C")
        shades *= 1.0 / 255.0
        return shades
    if array.dtype.kind != "f":
        raise ValueError(
            f"expected colors as uint8 (0..255) or float (0..1), got {array.dtype}; divide by the largest there can be"
        )
    shades = array.astype(np.float64, order="C")
    if not ((shades >= 0.0) & (shades <= 1.0)).all():
        raise ValueError(
            f"expected float colors within 0..1 at finite points, got {shades.min():g} to {shades.max():g}; "
            "divide by the largest there can be"
        )
    return shades


def _normals(normals: ArrayLike | None, shape: tuple[int, ...], kept: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """Normals of the points that are kept, (n, 3) float64, of unit length, or zero where none is given."""
    if normals is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # long doubles, signalling NaN
        array = _same_shape("normals", normals, shape).take(kept, axis=0).astype(np.float64)
    array[~np.isfinite(array).all(axis=1)] = 0.0
    return unit_rows(array)


def unit_rows(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows, (n, 3), scaled to length 1, however small or large they are; rows of zeros stay."""
    scaled = rows / np.maximum(np.abs(rows).max(axis=1, keepdims=True), TINY)
    return scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), TINY)


def _features(features: ArrayLike, shape: tuple[int, ...], kept: NDArray[np.int64]) -> NDArray[np.float64]:
    """The features of the points that are kept, (n, d)."""
    array = as_numbers("features", features)
    if array.shape[: len(shape)] != shape or array.ndim > len(shape) + 1 or array.shape[len(shape) :] == (0,):
        wanted = f"{shape} or {shape} + (d,)"
        raise ValueError(f"expected features of the points' leading shape, {wanted}, got {array.shape}")
    with np.errstate(over="ignore", invalid="ignore"):
        numbers = array.reshape(int(np.prod(shape)), -1).take(kept, axis=0).astype(np.float64)
    if np.isinf(numbers).any():
        raise ValueError("expected finite features at finite points, or NaN where unknown, got infinite ones")
    return numbers
