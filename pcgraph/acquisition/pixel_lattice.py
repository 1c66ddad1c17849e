# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera that took a list of points, in whatever frame, found by the lattice of its pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.acquisition.resection import NO_PLANE, PinholeCamera, resection
from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.rounding import TINY
from pcgraph.voxels.directions import plane_basis, sphere_directions
from pcgraph.voxels.sampling import farthest_points

# Numbers without a reason were chosen by eye and not varied.

# Kernels read these.
MAX_OFF_PIXEL = 0.1
"""Pixels by which a ray may be off its own, at most: single precision leaves a thousandth; chosen by eye."""
MAX_PIXELS = 1 << 20
"""Rows, or columns, of an image, at most: the longest side that is taken for an image in pixels; chosen by eye."""
MIN_LINES = 8
"""Rows, or columns, of pixels in an image, at least, as few lines are even by accident; chosen by eye."""
_NEAR_QUANTILE = 0.1
"""Quantile of the distances of a patch's points to their nearest, as seen, that is the least one; chosen by eye."""
_FAR_QUANTILE = 0.9
"""Quantile of these distances that is the largest one, a fraction: on a lattice both are alike; chosen by eye."""
_FIRST_TURN = 0.08
"""Radians by which a direction is turned first, half of those between neighbouring directions, about; chosen by eye."""
_LAST_TURN = 0.004
"""Radians: a turn by less does not make a patch look sharper; chosen by eye."""

_DIRECTIONS = sphere_directions(600)[:300]  # half of those all around, 8 degrees apart


@dataclass(frozen=True)
class PatchThresholds:
    """Numbers of patches of neighbours that are looked at, and of their points."""

    sample: int = 1 << 11  # points among which patches are sought
    asked: int = 64  # points of these whose surroundings are asked how dense they are
    tried: int = 6  # patches, at most
    points: int = 48  # points of a patch
    around: int = 1 << 10  # points around it from which a camera grows, about
    max_dull: int = 2  # patches that look like no lattice: then no more are tried
    max_views: int = 12  # views of patches as lattices: then no more are tried
    max_grown: int = 4  # cameras that grew to all points: then no more are tried


@dataclass(frozen=True)
class LatticeThresholds:
    """Conditions for a patch, seen from a direction, to be a lattice. `_sharpness` tells how it looks."""

    sharp: float = 0.7  # sharpness, 0..1, of a direction that is looked at again
    very_sharp: float = 0.8  # the same once it was turned to the sharpest nearby
    same_peak: float = 0.95  # cosine between two directions of which one is looked at again, 18 degrees
    same_direction: float = 0.995  # cosine between two turned directions that are one, 6 degrees
    max_directions: int = 8  # directions that are looked at again
    beside: float = 1.25  # distance to a point over the least: with less it is a neighbour along the shortest step
    beyond: float = 1.9  # distance to a point over the least: with more it is no neighbour
    min_sine: float = 0.5  # sine of the angle between the two steps, 30 degrees
    max_off: float = 0.15  # steps: median distance of the points from the lattice
    like: float = 0.3  # of a step: steps that differ by less are averaged


@dataclass(frozen=True)
class CameraThresholds:
    """Growth of a camera from a patch to all points, and conditions for it to fit."""

    sample: int = 1 << 13  # points to which it grows
    counted: int = 300  # points it is fitted to, each time, at most
    min_pinhole: int = 100  # points for a pinhole camera; fewer fit an affine one
    growth: float = 1.4  # factor of the reach, each time
    max_fits: int = 4  # fits to the points within reach
    settled: float = 0.02  # fraction of the points that changed whether they count: with less, the fit ends
    sure: float = 0.3  # quantile of the distances from pixels by which a fit is judged
    max_sure: float = 0.1  # pixels: if that quantile is more, the fit fails
    times: float = 8.0  # multiple of that quantile: points farther off do not count
    precise: float = 0.02  # pixels: points nearer than that always count
    off: float = 0.25  # pixels: points farther off than that never count
    min_inliers: float = 0.4  # fraction of the points that count
    along: float = 1e-3  # weight of an affine camera's direction, which decides only if points are on one plane
    better: float = 0.7  # ratio of mean squares by which a pinhole camera has to beat an affine one
    max_skew: float = 0.02  # cosine between rows and columns
    max_reductions: int = 32  # steps of Lagrange's reduction: a guard


@dataclass(frozen=True)
class StepThresholds:
    """Reading of the step between even values, and choice among cameras that differ by steps of inverse depth."""

    min_step: float = 2e-5  # of the span: differences below it are rounding
    adjacent: float = 0.1  # quantile of the differences that is one step
    max_slant: int = 32  # rows, or columns, that a camera may count more per step of inverse depth
    tried: int = 100  # images that are looked at, the smallest first
    max_cameras: int = 8  # cameras that are given back, at most
    min_area: float = 0.97  # of the points: an image of a sample's rows and columns has at least so many pixels


_PATCH = PatchThresholds()
_LATTICE = LatticeThresholds()
_CAMERA = CameraThresholds()
_STEP = StepThresholds()


def likely_cameras(points: NDArray[np.float64], sample: NDArray[np.float64]) -> Iterator[PinholeCamera]:
    """The cameras that may have seen each of n points, (n, 3), at its own pixel, the likeliest first.

    Patches are sought in a sample of the points, (m, 3). Rows and columns of a camera start anywhere; they may be
    exchanged, or run backwards.

    Notes
    -----
    Noise of a depth image is along its rays. So a patch of it, seen from the camera, is a lattice; seen from any other
    direction it is blurred. A patch of neighbours in space is looked at from all directions. Seen as a lattice, its
    points have pixels in whole numbers, and an affine camera is fitted to them. That tells the pixels of the points
    around to a fraction, so that these can be numbered, too. With more and more points it becomes the pinhole camera of
    all.
    """
    more, some = sample[: _CAMERA.sample], sample[: _PATCH.sample]
    if len(some) < _PATCH.points:
        return
    nearest = min(math.ceil(_PATCH.around * len(some) / len(points)) + 1, len(some) - 1)
    grew = dull = views = 0
    for seed, reach in zip(*_seeds(some, nearest), strict=True):
        near = np.concatenate(in_blocks(_find_near, len(points), points, seed, reach))
        around = _by_distance(points[near], seed)
        together = None
        for view in _sharp_views(around[: _PATCH.points]) if len(around) >= _PATCH.points else ():
            if together is None:
                farther = _by_distance(more, seed)
                beyond = np.linalg.norm(farther - seed, axis=1) > np.linalg.norm(around[-1] - seed)
                together = np.concatenate((around, farther[beyond]))
            grown = _grown(view, together)
            camera = None if grown is None else _of_all(grown, some)
            if camera is not None:
                yield from _alike(camera, more, len(points))
            views, grew = views + 1, grew + (grown is not None)
            if views == _PATCH.max_views or grew == _PATCH.max_grown:
                return
        dull += together is None
        if dull == _PATCH.max_dull:
            return


def _seeds(places: NDArray[np.float64], nearest: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centres of patches, (k, 3), far from each other where places are dense, and the distance to the neighbour of a
    given rank of each, (k,)."""
    from scipy.spatial.distance import cdist

    reach = np.partition(cdist(places[: _PATCH.asked], places), nearest, axis=1)[:, nearest]
    dense = np.argsort(reach, kind="stable")[: len(reach) // 4]
    chosen = dense[farthest_points(places[dense], 0, _PATCH.tried)]
    return places[chosen], reach[chosen]


@kernel
def _find_near(
    start: int, stop: int, points: NDArray[np.float64], seed: NDArray[np.float64], reach: float
) -> NDArray[np.int64]:
    """Numbers of the points within reach of a place."""
    found, n = np.empty(stop - start + 1, np.int64), np.int64(0)
    x, y, z = seed
    for i in range(start, stop):
        found[n] = i
        n += (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + (points[i, 2] - z) ** 2 <= reach * reach
    return found[:n]


def _by_distance(points: NDArray[np.float64], seed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points sorted by their distance from one of them, then by their coordinates."""
    ways = points - seed
    return points[np.lexsort((*points.T, np.einsum("ij,ij->i", ways, ways)))]


class _View(NamedTuple):
    """A patch seen as a lattice.

    Attributes
    ----------
    direction : (3,) float64
        Direction from which it is seen, of unit length.
    steps : (k, 2) int64
        Row and column of its points on the lattice, counted from any of its places.
    """

    direction: NDArray[np.float64]
    steps: NDArray[np.int64]


def _sharp_views(patch: NDArray[np.float64]) -> Iterator[_View]:
    """The directions from which a patch looks like a lattice, the sharpest first."""
    patch = patch - patch.mean(axis=0)
    sharpness = _sharpness(patch, _DIRECTIONS)
    tried: list[int] = []
    known: list[NDArray[np.float64]] = []
    for number in np.argsort(-sharpness, kind="stable"):
        if not sharpness[number] >= _LATTICE.sharp or len(tried) == _LATTICE.max_directions:
            return
        if (np.abs(_DIRECTIONS[tried] @ _DIRECTIONS[number]) > _LATTICE.same_peak).any():
            continue
        tried.append(int(number))
        direction = _DIRECTIONS[number].copy()
        is_sharp = _sharpen(patch, direction) >= _LATTICE.very_sharp
        if is_sharp and not any(abs(other @ direction) > _LATTICE.same_direction for other in known):
            known.append(direction)
            steps = _steps_on_lattice(patch, direction)
            if steps is not None:
                yield _View(direction, steps)


@kernel
def _sharpness(patch: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sharpness of a patch as seen from m directions, (m,), 0..1: 1 for a perfect lattice.

    It is the ratio of a low to a high quantile of the distances of its points to their nearest neighbours.
    """
    k = len(patch)
    found, nearest, seen = np.empty(len(directions)), np.empty(k), np.empty((k, 2))
    for m in range(len(directions)):
        _look_from(patch, directions[m], seen)
        nearest[:] = np.inf
        for i in range(k):
            for j in range(i):
                off = (seen[i, 0] - seen[j, 0]) ** 2 + (seen[i, 1] - seen[j, 1]) ** 2
                nearest[i], nearest[j] = min(nearest[i], off), min(nearest[j], off)
        ascending = np.sort(nearest)
        sparse = ascending[int(_FAR_QUANTILE * k)]
        found[m] = math.sqrt(ascending[int(_NEAR_QUANTILE * k)] / sparse) if sparse > 0.0 else 0.0
    return found


@routine
def _look_from(patch: NDArray[np.float64], direction: NDArray[np.float64], seen: NDArray[np.float64]) -> None:
    """Set the projections of points on the plane across a direction, (k, 2)."""
    (ax, ay, az), (bx, by, bz) = _basis(direction)
    for i in range(len(patch)):
        x, y, z = patch[i]
        seen[i, 0], seen[i, 1] = x * ax + y * ay + z * az, x * bx + y * by + z * bz


@routine
def _basis(direction: NDArray[np.float64]) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Two unit vectors at right angles to a direction and to each other: `plane_basis`, for kernels."""
    least = int(np.argmin(np.abs(direction)))
    x, y, z = direction
    ax, ay, az = (0.0, -z, y) if least == 0 else (z, 0.0, -x) if least == 1 else (-y, x, 0.0)
    length = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    return (ax, ay, az), (y * az - z * ay, z * ax - x * az, x * ay - y * ax)


@kernel
def _sharpen(patch: NDArray[np.float64], direction: NDArray[np.float64]) -> float:
    """Turn a direction to the one nearby from which a patch looks sharpest; return the sharpness."""
    step, best = _FIRST_TURN, _sharpness(patch, direction.reshape(1, 3))[0]
    others = np.empty((8, 3))
    while step > _LAST_TURN:
        (x, y, z), ((ax, ay, az), (bx, by, bz)) = direction, _basis(direction)
        for k in range(8):
            c, s = step * math.cos(k * math.pi / 4.0), step * math.sin(k * math.pi / 4.0)
            others[k, 0], others[k, 1], others[k, 2] = x + c * ax + s * bx, y + c * ay + s * by, z + c * az + s * bz
            others[k] /= math.sqrt(1.0 + step * step)
        sharpness = _sharpness(patch, others)
        k = int(np.argmax(sharpness))
        if sharpness[k] > best:
            best = sharpness[k]
            direction[:] = others[k]
        else:
            step /= 2.0
    return best


def _steps_on_lattice(patch: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """Row and column of each point of a patch on a lattice, (k, 2), as seen from a direction; None if it is no lattice.

    They count its two shortest steps from one of the points. No two points share a place.
    """
    seen = patch @ plane_basis(direction).T
    seen = seen - seen[int(np.argmin(np.linalg.norm(seen, axis=1)))]
    ways = (seen[:, None] - seen)[~np.eye(len(seen), dtype=bool)]
    lengths = np.linalg.norm(ways, axis=1)
    pitch = float(np.median(lengths.reshape(len(seen), -1).min(axis=1)))
    ways, lengths = ways[lengths < _LATTICE.beyond * pitch], lengths[lengths < _LATTICE.beyond * pitch]
    if not pitch > 0.0:
        return None
    first = _common_way(ways, lengths, lengths < _LATTICE.beside * pitch)
    across = np.abs(ways @ [-first[1], first[0]]) > _LATTICE.min_sine * lengths * np.linalg.norm(first)
    if not across.any():
        return None
    basis = np.stack((first, _common_way(ways, lengths, across)))
    for fits_left in (2, 1, 0):
        if abs(np.linalg.det(basis)) < _LATTICE.min_sine / 2.0 * pitch * pitch:
            return None
        at = seen @ np.linalg.inv(basis)
        steps = np.rint(at)
        if fits_left:
            fitted = np.linalg.lstsq(np.column_stack((steps, np.ones(len(steps)))), seen, rcond=None)[0]
            basis, seen = fitted[:2], seen - fitted[2]
    alone = len(np.unique(steps, axis=0)) == len(steps)
    off = float(np.median(np.abs(at - steps).max(axis=1)))
    return steps.astype(np.int64) if alone and off <= _LATTICE.max_off else None


def _common_way(
    ways: NDArray[np.float64], lengths: NDArray[np.float64], among: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Mean of the ways, (m, 2), that are nearly the same: like the one at the eighth of the shortest of `among`.

    Opposite ways count as the same.
    """
    shortest = np.flatnonzero(among)[np.argsort(lengths[among], kind="stable")]
    one = ways[shortest[len(shortest) // 8]]
    alike = ways * np.sign(ways @ one)[:, None]
    return alike[np.linalg.norm(alike - one, axis=1) < _LATTICE.like * np.linalg.norm(one)].mean(axis=0)


def _grown(view: _View, points: NDArray[np.float64]) -> PinholeCamera | None:
    """The camera of a patch, grown to all points, (m, 3), which are sorted by their distance from it, the patch first.

    None if, on the way, the points around are not at whole pixels.
    """
    k = len(view.steps)
    far = np.linalg.norm(points - points[0], axis=1)
    camera = _affine(points[:k], view.steps.astype(np.float64), view.direction)
    known, reach = k, float(far[k - 1])
    while True:
        among = np.linspace(0, known - 1, min(known, _CAMERA.counted)).astype(np.int64)
        counted = np.zeros(len(among), bool)
        for _ in range(_CAMERA.max_fits):
            at, depths = camera.pixels(points[among])
            pixels = np.rint(at)
            off = np.abs(at - pixels).max(axis=1)
            most = float(np.partition(off, int(_CAMERA.sure * len(off)))[int(_CAMERA.sure * len(off))])
            on = (off < min(max(_CAMERA.times * most, _CAMERA.precise), _CAMERA.off)) & (depths * depths[0] > 0.0)
            if not most < _CAMERA.max_sure or np.mean(on) < _CAMERA.min_inliers:
                return None
            if np.mean(on != counted) < _CAMERA.settled:
                break
            camera, counted = _fitted(camera, points[among[on]], pixels[on], view.direction), on
        if known == len(points):
            return camera
        reach = max(reach * _CAMERA.growth, float(far[known]))
        known = int(np.searchsorted(far, reach, "right"))


def _of_all(camera: PinholeCamera, points: NDArray[np.float64]) -> PinholeCamera | None:
    """The pinhole camera that sees points at the pixels of a given one, with rows at right angles to columns.

    None if all points are on a plane, so that many cameras do; if an affine camera does nearly as well; or if no rows
    are at right angles to columns.
    """
    pixels = np.rint(camera.pixels(points)[0])
    pinhole = resection(points, pixels, NO_PLANE)
    if pinhole is None:
        return None
    affine = _affine(points, pixels, pinhole.matrix[2, :3])
    if not _misses(pinhole, points, pixels) <= _CAMERA.better * _misses(affine, points, pixels):
        return None
    across = pinhole.matrix[:2, :3] - np.outer(pinhole.matrix[:2, :3] @ pinhole.matrix[2, :3], pinhole.matrix[2, :3])
    across = across / max(float(np.abs(across).max()), TINY)
    change = _to_shortest(np.linalg.pinv(across @ across.T).astype(np.float64))
    if change is None:
        return None
    matrix = pinhole.matrix.copy()
    matrix[:2] = np.rint(np.linalg.inv(change)) @ matrix[:2]
    return PinholeCamera(matrix)


def _to_shortest(products: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The two shortest steps of a lattice, columns of (2, 2) in whole numbers of two other steps; None if they are not
    at right angles. The scalar products of the other steps are given, (2, 2).

    Notes
    -----
    Lagrange's reduction.
    """
    change = np.eye(2)
    for _ in range(_CAMERA.max_reductions):
        longer, shorter = (0, 1) if products[0, 0] > products[1, 1] else (1, 0)
        times = np.rint(products[0, 1] / products[shorter, shorter])
        if times == 0.0:
            across = abs(products[0, 1]) <= _CAMERA.max_skew * math.sqrt(products[0, 0] * products[1, 1])
            return change if across else None
        one = np.eye(2)
        one[shorter, longer] = -times
        products, change = one.T @ products @ one, change @ one
    return None


def _alike(camera: PinholeCamera, points: NDArray[np.float64], n: int) -> list[PinholeCamera]:
    """The cameras that see some of n points at whole pixels as a given one does, those of the smallest images first.

    If inverse depth comes in steps, a camera that counts some more rows or columns per step sees whole pixels, too.
    Images need a pixel for each of the n points.
    """
    at, depths = camera.pixels(points)
    inverse = np.sort(np.abs(1.0 / depths))
    step = step_between(inverse)
    if step <= 0.0 or not are_whole((inverse - inverse[0]) / step):
        return [camera]
    steps, pixels = np.rint(np.sign(depths[0]) / (step * depths)), np.rint(at)
    slants = np.arange(-_STEP.max_slant, _STEP.max_slant + 1)
    rows, columns = (1.0 + np.ptp(line[:, None] - steps[:, None] * slants, axis=0) for line in pixels.T)
    areas = np.outer(rows, columns)
    areas[areas < _STEP.min_area * n] = np.inf
    found: list[PinholeCamera] = []
    for best in np.argsort(areas, axis=None, kind="stable")[: _STEP.tried]:
        slant = slants[np.array(np.unravel_index(best, areas.shape))]
        row, column = (pixels - steps[:, None] * slant).T
        if len(found) < _STEP.max_cameras and len(np.unique(row * (2 * MAX_PIXELS) + column)) == len(points):
            matrix = camera.matrix.copy()
            matrix[:2, 3] -= slant * (np.sign(depths[0]) / step)
            found.append(PinholeCamera(matrix))
    return found


def step_between(ascending: NDArray[np.float64]) -> float:
    """Step between values, if these are whole multiples of one step; 0 if there are too few, or too many steps.

    It is the mean, once a low quantile of their differences has told how many steps each difference has.
    """
    span = float(ascending[-1] - ascending[0]) if len(ascending) else 0.0
    steps = np.diff(ascending)
    steps = steps[steps > _STEP.min_step * span]
    if len(steps) < MIN_LINES - 1:
        return 0.0
    step = span / float(np.rint(steps / np.quantile(steps, _STEP.adjacent)).sum())
    if not span <= MAX_PIXELS * step:
        return 0.0
    return step * int(np.gcd.reduce(np.rint((ascending - ascending[0]) / step).astype(np.int64)))  # or half a step


def are_whole(values: NDArray[np.float64]) -> bool:
    """Whether all values are whole numbers, to a tenth."""
    return bool((np.abs(values - np.rint(values)) <= MAX_OFF_PIXEL).all())


def _fitted(
    before: PinholeCamera, points: NDArray[np.float64], pixels: NDArray[np.float64], direction: NDArray[np.float64]
) -> PinholeCamera:
    """The camera that sees points at pixels: a pinhole camera if the one before was, or if there are many points and it
    is better than an affine one; else an affine camera."""
    pinhole = resection(points, pixels) if len(points) >= _CAMERA.min_pinhole else None
    if pinhole is not None and before.matrix[2, :3].any():
        return pinhole
    affine = _affine(points, pixels, direction)
    if pinhole is None:
        return affine
    is_better = _misses(pinhole, points, pixels) <= _CAMERA.better * _misses(affine, points, pixels)
    return pinhole if is_better else affine


def _misses(camera: PinholeCamera, points: NDArray[np.float64], pixels: NDArray[np.float64]) -> float:
    """Mean squared distance between the pixels at which points are seen and their own."""
    return float(np.square(camera.pixels(points)[0] - pixels).sum(axis=1).mean())


def _affine(points: NDArray[np.float64], pixels: NDArray[np.float64], direction: NDArray[np.float64]) -> PinholeCamera:
    """The affine camera that sees points at pixels, by least squares; if they are on one plane, it looks along
    `direction`."""
    middle = points.mean(axis=0)
    ways = points - middle
    weight = _CAMERA.along * float(np.sqrt(np.square(ways).sum()))
    sides = np.vstack((ways, weight * direction))
    linear = np.linalg.lstsq(sides, np.vstack((pixels - pixels.mean(axis=0), np.zeros(2))), rcond=None)[0].T
    offset = pixels.mean(axis=0) - linear @ middle
    return PinholeCamera(np.vstack((np.column_stack((linear, offset)), [0.0, 0.0, 0.0, 1.0])))
