# SPDX-License-Identifier: Apache-2.0
"""Depth images: what the order of organised points tells of the camera that took them, and of its failures."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import CleanCloud, ImageView, Pixels, unit_rows
from pcgraph.parallel import MIN_ROWS, in_blocks, kernel, routine
from pcgraph.resection import NO_PLANE, is_far_off, resection
from pcgraph.voxels.outliers import MIN_POINTS
from pcgraph.voxels.spacing import VOXELS_PER_SPACING
from pcgraph.voxels.warp import FORWARDS, Warp, along_axis

# Cameras
_SOME_PIXELS = 2048  # pixels sampled to test for a camera, or to find it
_MIN_RANK_CORRELATION = 0.95  # of columns and rows with x/z and y/z, in a camera's image
_SOME_PAIRS, _MIN_PAIRS = 2048, 64  # neighbouring pixels that are compared, and needed
_FAR_APART = 2.5  # median angles between neighbours as seen from the origin: more, and they are not neighbours there
_MAX_FAR_APART = 0.001  # fraction of such pairs
_MAX_RESIDUAL = 1.0  # reprojection error, pixels,
_MIN_INLIERS = 0.95  # of this fraction of the points
_SAME_VIEWPOINT = 0.02  # extents of the cloud between two viewpoints that are one
# Steps of depth
_SOME_TRIPLES, _MIN_DIFFERING = 1 << 15, 0.1  # second differences that are taken, and fraction that must not be 0
_ROUNDING = 1e-6  # of the largest inverse depth: smaller second differences are 0
_FAR_QUANTILE = 0.8  # of the depths
_MAX_STEP = 0.75  # voxel edges that one step of depth may be there,
_MAX_COARSENING = 4.0  # unless the spacing would grow by more than this factor
_FAR_BAND = 1.4  # steps are read at depths between far / this and far * this
_MIN_PER_PITCH = 0.4  # of what rows, or columns, are apart
# Flying pixels
_MIN_SLOPE = 20.0  # by how many pixels' pitches their depth differs from both neighbours', or one beside a hole,
_MIN_STEPS = 6.0  # and by how many steps of depth
_MAX_SLOPE_PIXELS = 4  # within so many pixels the slope on which they lie ends,
_END_OF_SLOPE = 0.3  # that of inverse depth being less than this fraction of what it is there
_MIN_FLYING, _MAX_FLYING = 1e-4, 0.2  # fraction of all points; else none is removed
_MIN_WITH_NEIGHBOUR = 0.9  # fraction of a list's points that have one to their right, if it was not thinned


def image_view(cloud: CleanCloud) -> ImageView | None:
    """Viewpoint and optical axis of the sensor that took a cloud with known pixels; None if they cannot be told.

    That of the camera whose list of points told its pixels. Of organised points the origin, if neighbours lie side by
    side as seen from there, as in the frame of their sensor; else the centre of the pinhole camera that sees each point
    at its pixel, whatever frame the points are in.
    """
    if cloud.image is None:
        return None
    if cloud.image.view is not None:
        return cloud.image.view
    origin = ImageView(np.zeros(3), None)
    far_apart = _neighbours_far_apart(cloud, cloud.image)
    told = max(far_apart, default=0.0) <= _MAX_FAR_APART
    if told and is_camera_image(cloud, origin.place):
        return origin
    camera = _camera(cloud, cloud.image)
    if told:
        if camera is None or not _is_same_place(camera.place, origin.place, cloud):
            return origin
        return ImageView(origin.place, camera.axis)
    return origin if camera is None and min(far_apart) <= _MAX_FAR_APART else camera


def axis_at(place: NDArray[np.float64], cloud: CleanCloud) -> NDArray[np.float64] | None:
    """Optical axis, (3,), of the camera that took an organised cloud, if it stood at a given place, (3,); else None."""
    view = image_view(cloud)
    return None if view is None or not _is_same_place(view.place, place, cloud) else view.axis


def _is_same_place(one: NDArray[np.float64], other: NDArray[np.float64], cloud: CleanCloud) -> bool:
    return bool(np.abs(one - other).max() <= _SAME_VIEWPOINT * float(np.ptp(cloud.bounds, axis=0).max()))


def _neighbours_far_apart(cloud: CleanCloud, image: Pixels) -> list[float]:
    """Fraction of the neighbours in a row, and of those in a column, that do not lie side by side as seen from the
    origin.

    Of what was seen from there the ways to them make much the same angle, also where one of them hides what lies behind
    it; but for columns of a scanner whose beams are not evenly spread. From elsewhere those at such edges lie far
    apart.
    """
    if is_far_off(*cloud.bounds):
        return [1.0, 1.0]
    some, far_apart = _some_of(image, _SOME_PAIRS), []
    for step in (1, image.shape[1]):
        one, other = (unit_rows(cloud.points[at]) for at in _pairs_beside(image, some, step))
        angles = np.linalg.norm(one - other, axis=1)
        if len(angles) >= _MIN_PAIRS:
            far_apart.append(float(np.mean(angles > _FAR_APART * np.median(angles))))
    return far_apart


def _pairs_beside(image: Pixels, some: NDArray[np.int32], step: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Those of some points that have a neighbour in their row (a step of 1) or column (of a row's width),
    and these."""
    sought, (h, w) = image.at[some] + step, image.shape
    beside = image.point_at[np.minimum(sought, h * w - 1)]
    pairs = (beside >= 0) & (sought < h * w) & ((step != 1) | (sought % w > 0))
    return some[pairs], beside[pairs]


def _some_of(image: Pixels, number: int) -> NDArray[np.int32]:
    """Numbers of so many points, some perhaps twice; always the same, whatever their order."""
    return image.order[np.random.default_rng(0).integers(len(image.order), size=number)]


def _camera(cloud: CleanCloud, image: Pixels) -> ImageView | None:
    """The camera that sees each point at its pixel; None if there is none, or all is one plane."""
    some, (low, high) = _some_of(image, _SOME_PIXELS), cloud.bounds
    pixels = np.stack(np.divmod(image.at[some], image.shape[1]), axis=1).astype(np.float64)
    camera = resection(cloud.points[some], pixels, NO_PLANE)
    if camera is None:
        return None
    seen_at, depth = camera.pixels(cloud.points[some])
    if not (depth > 0.0).all() and not (depth < 0.0).all():
        return None
    if np.mean(np.linalg.norm(seen_at - pixels, axis=1) <= _MAX_RESIDUAL) < _MIN_INLIERS:
        return None
    place, forwards = camera.place(low, high), camera.matrix[2, :3] * np.sign(depth[0])
    if place is None or not (along_axis(cloud.points - place, forwards) > 0.0).all():
        return None
    return ImageView(place, forwards)


def is_camera_image(cloud: CleanCloud, viewpoint: NDArray[np.float64]) -> bool:
    """Whether columns and rows of the image are in the order of x/z and y/z as seen from the viewpoint.

    Other organised clouds, as height maps and the rows of a turning scanner, may also lie in front of a place.
    """
    if cloud.image is None or viewpoint.ndim != 1:
        return False
    if not cloud.bounds[0][2] > viewpoint[2]:
        return False
    some = _some_of(cloud.image, _SOME_PIXELS)
    rays = cloud.points[some] - viewpoint
    with np.errstate(over="ignore"):  # of points in the camera
        x, y = (rays[:, :2] / rays[:, 2:]).T
    row, column = np.divmod(cloud.image.at[some], cloud.image.shape[1])
    orders = ((x, column), (y, row)), ((x, row), (y, column))  # the second of an image on its side
    return any(all(_rank_correlation(a, b) >= _MIN_RANK_CORRELATION for a, b in order) for order in orders)


class DepthImage(NamedTuple):
    """What a camera measured, pixel by pixel.

    Attributes
    ----------
    place : (3,) float64, metres
        Of the camera.
    axis : (3,) float64
        Of unit length, forwards.
    pixels : Pixels
        In which its n points are.
    depths : (h, w) float64, metres
        From there along the axis; NaN where nothing was seen.
    step : float, 1/metres
        By which inverse depth of what is far is noisy, or goes in steps; 0 where it is so fine that it does not show.
    pitch : (2,) float64
        Median distance of neighbours in a row, and in a column, at a depth of 1; 0 if there are none.
    middle, far : float, metres
        Median of the depths, and what a fifth of them exceed; 0 if there are none.
    """

    place: NDArray[np.float64]
    axis: NDArray[np.float64]
    pixels: Pixels
    depths: NDArray[np.float64]
    step: float
    pitch: NDArray[np.float64]
    middle: float
    far: float

    @classmethod
    def of(
        cls, points: NDArray[np.float64], image: Pixels, place: NDArray[np.float64], axis: NDArray[np.float64] | None
    ) -> DepthImage:
        """The image whose pixels n points are, (n, 3), given the camera's place and its axis, None for z."""
        axis = np.array(FORWARDS) if axis is None else axis
        depths = np.full(image.shape, np.nan)
        along = along_axis(points, axis) - place @ axis
        if along.min() <= 0.0:  # of a camera that was told and is none
            along[along <= 0.0] = np.nan
        depths.reshape(-1)[image.at] = along
        some = depths[:: max(1, depths.size // _SOME_TRIPLES)]
        seen = np.isfinite(some).any()
        middle, far = (float(np.nanmedian(some)), float(np.nanquantile(some, _FAR_QUANTILE))) if seen else (0.0, 0.0)
        with np.errstate(over="ignore"):  # of the tiniest depths
            steps = [_step_along(rows[:: max(1, rows.size // _SOME_TRIPLES)], far) for rows in (depths, depths.T)]
        pitch = np.array([_pitch(points, place, along, image, one) for one in (1, image.shape[1])])
        return cls(place, axis, image, depths, min(filter(None, steps), default=0.0), pitch, middle, far)

    def spacing(self, of_points: float, warp: Warp) -> float:
        """How far apart points are that the camera tells from each other, metres, in the space of a warp.

        It is the distance to the nearest, of most points; more, up to four times that, where depth is coarser than the
        voxels that this makes, at the depth of what is far; and 0.4 of what rows, or columns, are apart, at least, so
        that voxels hold more than one row of pixels that are far from square.

        Notes
        -----
        Depth by triangulation comes in steps of inverse depth, so of z^2 in depth (Khoshelham and Elberink 2012),
        while pixels are z apart: from some depth on a surface is a stack of sheets that touch no other.
        """
        if self.far == 0.0:
            return of_points
        depths = np.array([self.middle, self.far])
        of_middle, of_far = (depths / warp.scale(self.place + depths[:, None] * self.axis)).tolist()
        coarse, across = self.step * self.far * of_far, float(self.pitch.max()) * of_middle
        return max(
            of_points,
            min(coarse / (_MAX_STEP * VOXELS_PER_SPACING), _MAX_COARSENING * of_points),
            _MIN_PER_PITCH * across,
        )

    def flying(self) -> NDArray[np.bool_]:
        """Which of its n points fly, (n,) bool: they lie between a surface and what it hides, on neither.

        Their depth is a mix of both. It rises, or falls, from one neighbour to the other in a row or column, by twenty
        times as much as pixels are apart on each side, or on one side, if nothing is seen on the other; and some pixels
        on it does so no more, as it would on a plane seen edge-on. Where more than a fifth of all would fly, or fewer
        than one in ten thousand, none does; nor in clouds of fewer than 1000 points, nor in lists that were thinned, in
        which what is missing is no hole.
        """
        if (
            self.pixels.view is not None
            and np.mean(np.diff(self.pixels.at[self.pixels.order]) == 1) < _MIN_WITH_NEIGHBOUR
        ):
            return np.zeros(len(self.pixels.at), np.bool_)
        flying = np.empty(self.depths.shape, np.bool_)
        least = _MIN_SLOPE * float(self.pitch[0])
        depths = np.ascontiguousarray(self.depths)
        of_steps = least, _MIN_STEPS * self.step
        in_blocks(_find_flying, len(flying), depths, depths.reshape(-1), *of_steps, flying, smallest=MIN_ROWS)
        found = flying.reshape(-1)[self.pixels.at]
        some_fly = len(found) >= MIN_POINTS and _MIN_FLYING <= np.mean(found) <= _MAX_FLYING
        return found if some_fly else np.zeros_like(found)


def _pitch(
    points: NDArray[np.float64], place: NDArray[np.float64], depths: NDArray[np.float64], image: Pixels, step: int
) -> float:
    """Median distance, as seen at a depth of 1 from a place, of pixels so many apart; 0 if there are none."""
    one, other = (
        (points[at] - place) / depths[at, None] for at in _pairs_beside(image, _some_of(image, _SOME_PAIRS), step)
    )
    return float(np.median(np.linalg.norm(other - one, axis=1))) if len(one) else 0.0


def _step_along(rows: NDArray[np.float64], far: float) -> float:
    """Twice what the inverse depth of a pixel differs by from the mean of its two neighbours' in a row, 1/metres.

    It is the median over those about as deep as what is far, where it differs at all; 0 where it hardly differs
    anywhere. On a plane inverse depth is linear in the pixels, whatever its slant, so what is left is noise, or steps.
    """
    inverse, middle = 1.0 / rows, rows[:, 1:-1]
    differences = np.abs(inverse[:, :-2] - 2.0 * inverse[:, 1:-1] + inverse[:, 2:])
    differences = differences[np.isfinite(differences) & (middle > far / _FAR_BAND) & (middle < far * _FAR_BAND)]
    if not len(differences):
        return 0.0
    differing = differences[differences > _ROUNDING * np.nanmax(inverse)]
    return float(np.median(differing)) if len(differing) > _MIN_DIFFERING * len(differences) else 0.0


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
    """Set which pixels of some rows fly, of depths (h, w) and the same in a row, (h w,)."""
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
    """Whether a pixel of a line, a row or a column, lies behind one neighbour and before the other by more than a
    limit, or the other is NaN; and whether such a slope ends on both sides.

    The line is ``pixels[first : first + step * length : step]``.
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
    """Whether a slope ends some pixels along a line, in a hole or on a surface: on a plane inverse depth goes on as it
    went, be it seen edge-on."""
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
    """How far one column rises or falls with another, 0..1 (Spearman); 1 where one is constant."""
    ranks = []
    for values in (a, b):
        _, place, number = np.unique(values, return_inverse=True, return_counts=True)
        if len(number) == 1:
            return 1.0
        ranks.append((np.cumsum(number) - 0.5 * number)[place])
    return abs(float(np.corrcoef(*ranks)[0, 1]))
