# SPDX-License-Identifier: Apache-2.0
"""Depth images: the camera that took organised points, told by their order, and its failures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.resection import NO_PLANE, is_far_off, resection
from pcgraph.inputs import CleanCloud, ImageView, Pixels, unit_rows
from pcgraph.parallel import MIN_ROWS, in_blocks, kernel, routine
from pcgraph.rounding import TINY
from pcgraph.voxels.outliers import MIN_POINTS
from pcgraph.voxels.spacing import VOXELS_PER_SPACING, median_spacing
from pcgraph.voxels.warp import FORWARDS, Warp, along_axis


@dataclass(frozen=True)
class CameraThresholds:
    """Conditions for organised points to be a camera's image. Chosen by eye; none was varied."""

    sample: int = 2048  # pixels, or pairs of neighbours, that are looked at
    min_pairs: int = 64  # pairs of neighbours that are needed
    min_rank_correlation: float = 0.95  # of columns and rows with x/z and y/z
    far_apart: float = 2.5  # median angles between neighbours: with more they do not lie side by side
    max_far_apart: float = 0.001  # fraction of the neighbours that do not lie side by side
    max_residual: float = 1.0  # pixels, reprojection error of an inlier, at most
    min_inliers: float = 0.95  # fraction of the points that are inliers
    same_place: float = 0.02  # extents of the cloud between two places that are one
    min_miss: float = 0.01  # pixels by which rays from one place miss a parallel view, at least; images of mOSD: 3e-5
    parallel_miss: float = 0.1  # of that, by which parallel rays miss it, at most; images of mOSD: above 1e6


@dataclass(frozen=True)
class StepThresholds:
    """Growth of voxels if depth comes in steps, or pixels are far from square. Gain: 0.0012, by one kind of images."""

    sample: int = 1 << 15  # second differences of inverse depth that are looked at, about
    min_differing: float = 0.1  # fraction of them that are not 0: else there are no steps; chosen by eye
    rounding: float = 1e-6  # of the largest inverse depth: smaller differences are 0, as in single precision
    far_quantile: float = 0.8  # of the depths: it is the far depth, at which the step is read; chosen by eye
    far_band: float = 1.4  # ratio: it is read from far / 1.4 to far * 1.4; chosen by eye
    max_step: float = 0.75  # voxel edges per step there; covering of 1.4, 1.0, 0.75, 0.7: 0.829, 0.846, 0.861, 0.865
    max_coarsening: float = 4.0  # ratio of the spacing to that of the points, at most; chosen by eye
    min_per_pitch: float = 0.4  # spacing over distance of rows or columns, at least; up to twice that is as good


@dataclass(frozen=True)
class FlyingThresholds:
    """Conditions for pixels to fly between a surface and what it hides. Gain: 0.0001, by images of time of flight."""

    min_slope: float = 20.0  # pixels' pitches of depth from one pixel to the next: 3 degrees to the ray
    min_steps: float = 6.0  # steps of depth, in the same way; chosen by eye
    min_flying: float = 1e-4  # fraction of the points: if fewer fly, none is removed; chosen by eye
    max_flying: float = 0.2  # fraction of the points: if more fly, it is no failure of the camera; chosen by eye
    min_with_neighbour: float = 0.9  # fraction of a list's points with one to their right: with fewer it was thinned


_CAMERA = CameraThresholds()
_STEPS = StepThresholds()
_FLYING = FlyingThresholds()

# Kernels read these.
_MAX_SLOPE_PIXELS = 4
"""Pixels within which the slope of flying pixels ends, so that a floor seen edge-on does not fly; chosen by eye."""
_END_OF_SLOPE = 0.3
"""Change of inverse depth over that one pixel before, below which a slope ends: on a plane it is 1; chosen by eye."""


def image_view(cloud: CleanCloud) -> ImageView | None:
    """Viewpoint and optical axis of the sensor that took a cloud with known pixels; None if they cannot be told.

    If the cloud came as a list whose pixels were found, its camera was found with them. Of organised points, the
    viewpoint is the origin if neighbours lie side by side as seen from there, as in the frame of their sensor. Else it
    is the centre of the pinhole camera that sees each point at its pixel, in whatever frame the points are. A height
    map tells none, nor do pixels of which hardly any has a neighbour.
    """
    if cloud.image is None:
        return None
    if cloud.image.view is not None:
        return cloud.image.view
    origin = ImageView(np.zeros(3), None)
    far_apart = _neighbours_far_apart(cloud, cloud.image)
    if not far_apart or _is_parallel_view(cloud, cloud.image, origin.place):
        return None
    told = max(far_apart) <= _CAMERA.max_far_apart
    if told and _is_in_order(cloud, cloud.image, origin.place):
        return ImageView(origin.place, np.array(FORWARDS))
    camera = _camera(cloud, cloud.image)
    if told:
        if camera is None or not _is_same_place(camera.place, origin.place, cloud):
            return origin
        return ImageView(origin.place, camera.axis)
    return origin if camera is None and min(far_apart) <= _CAMERA.max_far_apart else camera


def axis_at(place: NDArray[np.float64], cloud: CleanCloud) -> NDArray[np.float64] | None:
    """Optical axis, (3,), of the camera that took an organised cloud if it stood at a given place, (3,); else None."""
    view = image_view(cloud)
    return None if view is None or not _is_same_place(view.place, place, cloud) else view.axis


def _is_same_place(one: NDArray[np.float64], other: NDArray[np.float64], cloud: CleanCloud) -> bool:
    """Whether two places are one, measured against the extent of the cloud."""
    return bool(np.abs(one - other).max() <= _CAMERA.same_place * float(np.ptp(cloud.bounds, axis=0).max()))


def _neighbours_far_apart(cloud: CleanCloud, image: Pixels) -> list[float]:
    """Fractions of the neighbours in rows, and in columns, that do not lie side by side as seen from the origin.

    If the cloud was seen from the origin, neighbours are seen there at nearly equal angles, even if one hides what lies
    behind it. (Columns of a scanner whose beams are not evenly spread are an exception.) From elsewhere, such
    neighbours are seen far apart.
    """
    if is_far_off(*cloud.bounds):
        return [1.0, 1.0]
    some, far_apart = _some_of(image, _CAMERA.sample), []
    for step in (1, image.shape[1]):
        rows, beside = _pairs_beside(image, some, step)
        angles = np.linalg.norm(unit_rows(cloud.points[some[rows]]) - unit_rows(cloud.points[beside]), axis=1)
        if len(angles) >= _CAMERA.min_pairs and np.median(angles) > 0.0:
            far_apart.append(float(np.mean(angles > _CAMERA.far_apart * np.median(angles))))
    return far_apart


def _pairs_beside(image: Pixels, some: NDArray[np.int32], step: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Pairs of neighbours: which of some points have one, as rows of `some`, and these neighbours, (m,) each.

    A step of 1 or -1 leads to the next or last pixel of the row; one of a row's width, or minus that, along a column.
    """
    at, (h, w) = image.at[some], image.shape
    sought = at + step
    beside = image.point_at[np.clip(sought, 0, h * w - 1)]
    rows = np.flatnonzero(
        (beside >= 0) & (sought >= 0) & (sought < h * w) & ((abs(step) == w) | (sought // w == at // w))
    )
    return rows, beside[rows]


def _some_of(image: Pixels, number: int) -> NDArray[np.int32]:
    """Numbers of randomly drawn points, perhaps some twice; the same draw each time, whatever their order."""
    return image.order[np.random.default_rng(0).integers(len(image.order), size=number)]


def _camera(cloud: CleanCloud, image: Pixels) -> ImageView | None:
    """The camera that sees each point at its pixel; None if there is none, or if all points are on one plane."""
    some, (low, high) = _some_of(image, _CAMERA.sample), cloud.bounds
    pixels = np.stack(np.divmod(image.at[some], image.shape[1]), axis=1).astype(np.float64)
    camera = resection(cloud.points[some], pixels, NO_PLANE)
    if camera is None:
        return None
    seen_at, depth = camera.pixels(cloud.points[some])
    if not (depth > 0.0).all() and not (depth < 0.0).all():
        return None
    if np.mean(np.linalg.norm(seen_at - pixels, axis=1) <= _CAMERA.max_residual) < _CAMERA.min_inliers:
        return None
    place, forwards = camera.place(low, high), camera.matrix[2, :3] * np.sign(depth[0])
    if place is None or not (along_axis(cloud.points - place, forwards) > 0.0).all():
        return None
    return ImageView(place, forwards)


def is_camera_image(cloud: CleanCloud, viewpoint: NDArray[np.float64]) -> bool:
    """Whether columns and rows are in the order of x/z and y/z as seen from the viewpoint, as in a camera's image.

    Height maps and the rows of a turning scanner are not, though they may lie before the viewpoint, too.
    """
    if cloud.image is None or viewpoint.ndim != 1:
        return False
    return not _is_parallel_view(cloud, cloud.image, viewpoint) and _is_in_order(cloud, cloud.image, viewpoint)


def _is_in_order(cloud: CleanCloud, image: Pixels, place: NDArray[np.float64]) -> bool:
    """Whether all points lie before a place, and x/z and y/z from there are in the order of columns and rows."""
    if not cloud.bounds[0][2] > place[2]:
        return False
    some = _some_of(image, _CAMERA.sample)
    rays = cloud.points[some] - place
    with np.errstate(over="ignore"):  # points in the camera
        x, y = (rays[:, :2] / rays[:, 2:]).T
    row, column = np.divmod(image.at[some], image.shape[1])
    orders = ((x, column), (y, row)), ((x, row), (y, column))  # the second: an image on its side
    return any(all(_rank_correlation(a, b) >= _CAMERA.min_rank_correlation for a, b in order) for order in orders)


def _is_parallel_view(cloud: CleanCloud, image: Pixels, place: NDArray[np.float64]) -> bool:
    """Whether parallel rays fit the pixels well, as those of a height map, and rays from a place before it do not.

    On a plane across the axis both fit; there the rays may come from the place.
    """
    if not cloud.bounds[0][2] > place[2]:
        return False
    some = _some_of(image, _CAMERA.sample)
    rays = cloud.points[some] - place
    rays /= max(float(np.abs(rays).max()), TINY)
    with np.errstate(over="ignore"):  # points in the camera
        central = rays[:, :2] / rays[:, 2:]
    if not np.isfinite(central).all():
        return False
    pixels = np.stack(np.divmod(image.at[some], image.shape[1]), axis=1).astype(np.float64)
    of_parallel, of_central = _miss(pixels, rays - rays.mean(axis=0)), _miss(pixels, central)
    return of_central >= _CAMERA.min_miss and of_parallel <= _CAMERA.parallel_miss * of_central


def _miss(pixels: NDArray[np.float64], at: NDArray[np.float64]) -> float:
    """Rms distance, pixels, of m pixels, (m, 2), from the affine map of coordinates, (m, d), that fits best."""
    of_image = np.column_stack((at / np.abs(at).max(axis=0).clip(TINY), np.ones(len(at))))
    off = pixels - of_image @ np.linalg.lstsq(of_image, pixels, rcond=None)[0]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


class DepthImage(NamedTuple):
    """The depths that a camera measured, pixel by pixel.

    Attributes
    ----------
    place : (3,) float64, metres
        Place of the camera.
    axis : (3,) float64
        Its optical axis, of unit length, forwards.
    pixels : Pixels
        The pixels of its n points.
    depths : (h, w) float64, metres
        Depth of each pixel along the axis; NaN where nothing was measured.
    step : float, 1/metres
        Step, or noise, of the inverse depth of far pixels; 0 if it is too small to show.
    pitch : (2,) float64
        Median distance of neighbours in a row, and in a column, at a depth of 1; 0 if there are none.
    nearest : float
        Median distance of pixels from the nearest of their four neighbours, over depth; 0 if many have none.
    middle, far : float, metres
        Median of the depths, and the depth that a fifth of them exceed; 0 if there are none.
    """

    place: NDArray[np.float64]
    axis: NDArray[np.float64]
    pixels: Pixels
    depths: NDArray[np.float64]
    step: float
    pitch: NDArray[np.float64]
    nearest: float
    middle: float
    far: float

    @classmethod
    def of(
        cls, points: NDArray[np.float64], image: Pixels, place: NDArray[np.float64], axis: NDArray[np.float64] | None
    ) -> DepthImage:
        """The image of n points, (n, 3), given their pixels, the camera's place and its axis (z if None)."""
        axis = np.array(FORWARDS) if axis is None else axis
        depths = np.full(image.shape, np.nan)
        along = along_axis(points, axis) - place @ axis
        if along.min() <= 0.0:  # the camera was given, and is none
            along[along <= 0.0] = np.nan
        depths.reshape(-1)[image.at] = along
        some = depths[:: max(1, depths.size // _STEPS.sample)]
        seen = np.isfinite(some).any()
        middle = float(np.nanmedian(some)) if seen else 0.0
        far = float(np.nanquantile(some, _STEPS.far_quantile)) if seen else 0.0
        with np.errstate(over="ignore"):  # the tiniest depths
            steps = [_step_along(rows[:: max(1, rows.size // _STEPS.sample)], far) for rows in (depths, depths.T)]
        pitch = np.array([_pitch(points, place, along, image, one) for one in (1, image.shape[1])])
        nearest = _nearest(points, place, along, image)
        return cls(place, axis, image, depths, min(filter(None, steps), default=0.0), pitch, nearest, middle, far)

    def spacing(self, points: NDArray[np.float64], warp: Warp) -> float:
        """Spacing by which voxels are sized, metres in the space of a warp: that of the points, (n, 3), or more.

        The spacing of the points is that of neighbouring pixels, unless pixels are missing. It is more, up to four
        times that, if steps of depth at the far depth are coarser than the voxels would be. And it is at least 0.4 of
        the distance between rows, or columns, so that a voxel holds more than one row of pixels that are far from
        square.

        Notes
        -----
        Depth by triangulation comes in steps of inverse depth, so its steps grow with z^2 (Khoshelham and Elberink
        2012), while the distance of pixels grows with z. So far off a surface is a stack of sheets that do not touch.
        """
        if self.far == 0.0:
            return median_spacing(points, warp)
        depths = np.array([self.middle, self.far])
        of_middle, of_far = (depths / warp.scale(self.place + depths[:, None] * self.axis)).tolist()
        of_points = self.nearest * of_middle if self.nearest > 0.0 else median_spacing(points, warp)
        coarse, across = self.step * self.far * of_far, float(self.pitch.max()) * of_middle
        return max(
            of_points,
            min(coarse / (_STEPS.max_step * VOXELS_PER_SPACING), _STEPS.max_coarsening * of_points),
            _STEPS.min_per_pitch * across,
        )

    def flying(self) -> NDArray[np.bool_]:
        """Whether each of its n points flies, (n,) bool: it lies between a surface and what that hides, on neither.

        The depth of a flying pixel is a mix of the two. Along its row or column, depth rises, or falls, from one
        neighbour to the pixel and on to the other, by twenty times the distance between pixels on each side. One side
        is enough if the other neighbour is a hole. Some pixels farther this slope ends; on a plane that is seen edge-on
        it would go on.

        None flies if more than a fifth of all would, or fewer than one in ten thousand; nor in clouds of fewer than
        1000 points; nor in thinned lists, as a missing pixel is no hole there.
        """
        if (
            self.pixels.view is not None
            and np.mean(np.diff(self.pixels.at[self.pixels.order]) == 1) < _FLYING.min_with_neighbour
        ):
            return np.zeros(len(self.pixels.at), np.bool_)
        flying = np.empty(self.depths.shape, np.bool_)
        slope, step = _FLYING.min_slope * float(self.pitch[0]), _FLYING.min_steps * self.step
        depths = np.ascontiguousarray(self.depths)
        in_blocks(_find_flying, len(flying), depths, depths.reshape(-1), slope, step, flying, smallest=MIN_ROWS)
        found = flying.reshape(-1)[self.pixels.at]
        some_fly = len(found) >= MIN_POINTS and _FLYING.min_flying <= np.mean(found) <= _FLYING.max_flying
        return found if some_fly else np.zeros_like(found)


def _pitch(
    points: NDArray[np.float64], place: NDArray[np.float64], depths: NDArray[np.float64], image: Pixels, step: int
) -> float:
    """Median distance of neighbours in rows or columns, at a depth of 1; 0 if there are none.

    `step` is 1 for rows, and the width of a row for columns.
    """
    some = _some_of(image, _CAMERA.sample)
    rows, beside = _pairs_beside(image, some, step)
    one, other = ((points[at] - place) / depths[at, None] for at in (some[rows], beside))
    return float(np.median(np.linalg.norm(other - one, axis=1))) if len(one) else 0.0


def _nearest(
    points: NDArray[np.float64], place: NDArray[np.float64], depths: NDArray[np.float64], image: Pixels
) -> float:
    """Median distance of some pixels from the nearest of their four neighbours, in depths; 0 if many have none.

    Distances are those of a camera's warp: along the axis, differences of the logarithm of depth count.
    """
    some, w = _some_of(image, _CAMERA.sample), image.shape[1]
    nearest = np.full(len(some), np.inf)
    for step in (1, -1, w, -w):
        rows, other = _pairs_beside(image, some, step)
        one = some[rows]
        ways = (points[other] - place) / depths[other, None] - (points[one] - place) / depths[one, None]
        squares = np.einsum("ij,ij->i", ways, ways) + np.log(depths[other] / depths[one]) ** 2
        nearest[rows] = np.fmin(nearest[rows], np.sqrt(squares))
    found = np.isfinite(nearest)
    return float(np.median(nearest[found])) if np.mean(found) >= _FLYING.min_with_neighbour else 0.0


def _step_along(rows: NDArray[np.float64], far: float) -> float:
    """Step of inverse depth along rows, 1/metres: the median of its second differences near the far depth.

    Only differences that are not zero count; the step is 0 if hardly any are. On a plane inverse depth is linear in the
    pixels, whatever the slant, so that only noise and steps are left.
    """
    inverse, middle = 1.0 / rows, rows[:, 1:-1]
    differences = np.abs(inverse[:, :-2] - 2.0 * inverse[:, 1:-1] + inverse[:, 2:])
    is_far = (middle > far / _STEPS.far_band) & (middle < far * _STEPS.far_band)
    differences = differences[np.isfinite(differences) & is_far]
    if not len(differences):
        return 0.0
    differing = differences[differences > _STEPS.rounding * np.nanmax(inverse)]
    return float(np.median(differing)) if len(differing) > _STEPS.min_differing * len(differences) else 0.0


@kernel
def _find_flying(
    start: int,
    stop: int,
    depths: NDArray[np.float64],
    pixels: NDArray[np.float64],
    least_slope: float,
    least_step: float,
    flying: NDArray[np.bool_],
) -> None:
    """Set whether each pixel of some rows flies, given depths as (h, w), and the same as (h w,)."""
    h, w = depths.shape
    for i in range(start, stop):
        for j in range(w):
            own = depths[i, j]
            limit = max(least_slope * own, least_step * own * own)
            beside = abs(depths[i, max(j - 1, 0)] - own) > limit or abs(depths[i, min(j + 1, w - 1)] - own) > limit
            above = abs(depths[max(i - 1, 0), j] - own) > limit or abs(depths[min(i + 1, h - 1), j] - own) > limit
            flying[i, j] = (beside and _is_mixed(pixels, i * w, np.int64(1), w, j, limit)) or (
                above and _is_mixed(pixels, j, w, h, i, limit)
            )


@routine
def _is_mixed(pixels: NDArray[np.float64], first: int, step: int, length: int, at: int, limit: float) -> bool:
    """Whether a pixel of a line, ``pixels[first : first + step * length : step]``, is a mix of two depths.

    It lies between the depths of its neighbours, by more than a limit off each (off one, if the other is NaN), and this
    slope ends on both sides.
    """
    own = pixels[first + step * at]
    before = pixels[first + step * (at - 1)] - own if at > 0 else 0.0
    after = pixels[first + step * (at + 1)] - own if at + 1 < length else 0.0
    between = min(before, after) < -limit and max(before, after) > limit
    at_hole = (abs(before) > limit and math.isnan(after)) or (abs(after) > limit and math.isnan(before))
    if not (between or at_hole):
        return False
    ends = True
    for way in (-1, 1):
        ends = ends and _ends(pixels, first, step, length, at, way)
    return ends


@routine
def _ends(pixels: NDArray[np.float64], first: int, step: int, length: int, at: int, way: int) -> bool:
    """Whether a slope ends within some pixels along a line, in a hole or on a surface.

    On a plane it does not end, even if it is seen edge-on: there inverse depth changes evenly.
    """
    for _ in range(_MAX_SLOPE_PIXELS):
        following = at + 2 * way
        if following < 0 or following >= length:
            return False
        here, there = pixels[first + step * at], pixels[first + step * (at + way)]
        beyond = pixels[first + step * following]
        if math.isnan(there) or math.isnan(beyond):
            return True
        if abs(1.0 / beyond - 1.0 / there) < _END_OF_SLOPE * abs(1.0 / there - 1.0 / here):
            return True
        at += way
    return False


def _rank_correlation(a: NDArray[np.number], b: NDArray[np.number]) -> float:
    """Absolute rank correlation of two columns (Spearman), 0..1; 1 if one of them is constant."""
    ranks = []
    for values in (a, b):
        _, place, number = np.unique(values, return_inverse=True, return_counts=True)
        if len(number) == 1:
            return 1.0
        ranks.append((np.cumsum(number) - 0.5 * number)[place])
    return abs(float(np.corrcoef(*ranks)[0, 1]))
