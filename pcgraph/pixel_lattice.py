# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera that took a mere list of points, in whatever frame: found by the lattice of its pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.resection import NO_PLANE, PinholeCamera, resection
from pcgraph.voxels.directions import plane_basis, sphere_directions
from pcgraph.voxels.sampling import farthest_points

_TINY = float(np.finfo(np.float64).tiny)
MAX_OFF_PIXEL = 0.1
"""Pixels by which a ray may be off its own."""
MIN_LINES, MAX_PIXELS = 8, 1 << 20
"""Rows, or columns, of an image, at least and at most."""

# Patches
_SOME, _LOOKED_AT = 1 << 11, 64  # of some points of a sample, the density around so many is asked for
_PATCHES, _PATCH, _AROUND = 6, 48, 1 << 10  # patches that are tried, their points, and those around, about
_DULL, _VIEWS, _GREW = 2, 12, 4  # patches that look like no lattice, views, cameras of all: then no more are tried
# Directions
_DIRECTIONS = sphere_directions(600)[:300]  # half of those all around
_APART, _SAME, _TRIED = 0.95, 0.995, 8  # cosines between those that are looked at again, and of one; and their number
_FIRST_STEP, _LAST_STEP = 0.08, 0.004  # by which they are turned, radians
_DENSE, _SPARSE = 0.1, 0.9  # quantiles of the distances to the nearest, which are alike on a lattice:
_SHARP, _VERY_SHARP = 0.7, 0.8  # the one over the other, at first, and when turned
_BESIDE, _NOT_ACROSS = 1.25, 1.9  # distances between neighbours on a lattice, over the least
_SINE, _ON_LATTICE = 0.5, 0.15  # between its two steps, at least; and steps by which most points are off it, at most
# Cameras
_MORE, _COUNTED, _ENOUGH = 1 << 13, 300, 100  # points of a sample, those that count, and for a pinhole camera
_GROWTH, _FITS = 1.4, 4  # of the reach, each time, and how often a camera is fitted to the points within,
_SETTLED = 0.02  # if so many of them count now and did not, or the other way round
_SURE, _ON_PIXEL = 0.3, 0.1  # so many have to be off their pixels by less than that;
_TIMES, _PRECISE, _OFF_PIXEL = 8.0, 0.02, 0.25  # so many times as far off is not counted,
_MIN_INLIERS = 0.4  # if so many are left
_ALONG = 1e-3  # what an affine camera sees from its direction weighs, where points lie on one plane
_BETTER = 0.7  # a pinhole camera leaves that much of the squares that an affine one leaves, at most
_SKEW, _REDUCED = 0.02, 32  # cosine between rows and columns, at most; and changes after which no shortest steps come
# Steps
_LEAST, _ADJACENT = 2e-5, 0.1  # of all they span, at least; and quantile of those that is one between neighbours
_SLANT, _SLANTED = 32, 100  # rows, or columns, per step of inverse depth, at most; and how many images are looked at
_ALL = 0.97  # of an image's rows and columns lie between the first and last of a sample, at least


def likely_cameras(points: NDArray[np.float64], sample: NDArray[np.float64]) -> Iterator[PinholeCamera]:
    """The cameras that may have seen each of n points, (n, 3), at its own pixel, the likeliest first.

    A sample of the points, (m, 3), tells where to look. Rows and columns are counted from anywhere, and either may be
    the other, or run backwards.

    Notes
    -----
    Seen from its camera, a patch of a depth image is a lattice, whatever noise its depths have, as that is along the
    rays; seen from any other direction noise blurs it. So a patch of neighbours in space is looked at from everywhere.
    Where it is a lattice, whole numbers tell each point's pixel, and an affine camera fits them. It says at which
    pixels the points around are, to a fraction, so that they can be counted, too, and by more and more points it
    becomes the pinhole camera of all.
    """
    more, some = sample[:_MORE], sample[:_SOME]
    if len(some) < _PATCH:
        return
    nearest = min(math.ceil(_AROUND * len(some) / len(points)) + 1, len(some) - 1)
    grew = dull = views = 0
    for seed, reach in zip(*_seeds(some, nearest), strict=True):
        near = np.concatenate(in_blocks(_find_near, len(points), points, seed, reach))
        around = _by_distance(points[near], seed)
        together = None
        for view in _sharp_views(around[:_PATCH]) if len(around) >= _PATCH else ():
            if together is None:
                farther = _by_distance(more, seed)
                beyond = np.linalg.norm(farther - seed, axis=1) > np.linalg.norm(around[-1] - seed)
                together = np.concatenate((around, farther[beyond]))
            grown = _grown(view, together)
            camera = None if grown is None else _of_all(grown, some)
            if camera is not None:
                yield from _alike(camera, more, len(points))
            views, grew = views + 1, grew + (grown is not None)
            if views == _VIEWS or grew == _GREW:
                return
        dull += together is None
        if dull == _DULL:
            return


def _seeds(places: NDArray[np.float64], nearest: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Some of the first of places, (k, 3), around which these are dense, far from each other; and how far off so many
    others are, (k,)."""
    from scipy.spatial.distance import cdist

    reach = np.partition(cdist(places[:_LOOKED_AT], places), nearest, axis=1)[:, nearest]
    dense = np.argsort(reach, kind="stable")[: len(reach) // 4]
    chosen = dense[farthest_points(places[dense], 0, _PATCHES)]
    return places[chosen], reach[chosen]


@kernel
def _find_near(
    start: int, stop: int, points: NDArray[np.float64], seed: NDArray[np.float64], reach: float
) -> NDArray[np.int64]:
    """Those of some points that lie no farther from a place than its reach."""
    found, n = np.empty(stop - start + 1, np.int64), np.int64(0)
    x, y, z = seed
    for i in range(start, stop):
        found[n] = i
        n += (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + (points[i, 2] - z) ** 2 <= reach * reach
    return found[:n]


def _by_distance(points: NDArray[np.float64], seed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points by their distance from one of them, those as far by their coordinates."""
    ways = points - seed
    return points[np.lexsort((*points.T, np.einsum("ij,ij->i", ways, ways)))]


class _View(NamedTuple):
    """A patch seen as a lattice.

    Attributes
    ----------
    direction : (3,) float64
        From which it is seen, of unit length.
    steps : (k, 2) int64
        Of its points on the lattice, from any of its places.
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
        if not sharpness[number] >= _SHARP or len(tried) == _TRIED:
            return
        if (np.abs(_DIRECTIONS[tried] @ _DIRECTIONS[number]) > _APART).any():
            continue
        tried.append(int(number))
        direction = _DIRECTIONS[number].copy()
        if _sharpen(patch, direction) >= _VERY_SHARP and not any(abs(other @ direction) > _SAME for other in known):
            known.append(direction)
            steps = _steps_on_lattice(patch, direction)
            if steps is not None:
                yield _View(direction, steps)


@kernel
def _sharpness(patch: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """How much alike the distances of k points to their nearest are as seen from directions, (m,), 0..1."""
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
        sparse = ascending[int(_SPARSE * k)]
        found[m] = math.sqrt(ascending[int(_DENSE * k)] / sparse) if sparse > 0.0 else 0.0
    return found


@routine
def _look_from(patch: NDArray[np.float64], direction: NDArray[np.float64], seen: NDArray[np.float64]) -> None:
    """Set where points lie on the plane across a direction, (k, 2)."""
    (ax, ay, az), (bx, by, bz) = _basis(direction)
    for i in range(len(patch)):
        x, y, z = patch[i]
        seen[i, 0], seen[i, 1] = x * ax + y * ay + z * az, x * bx + y * by + z * bz


@routine
def _basis(direction: NDArray[np.float64]) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Two unit vectors across a direction and each other: `plane_basis`, for kernels."""
    least = int(np.argmin(np.abs(direction)))
    x, y, z = direction
    ax, ay, az = (0.0, -z, y) if least == 0 else (z, 0.0, -x) if least == 1 else (-y, x, 0.0)
    length = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / length, ay / length, az / length
    return (ax, ay, az), (y * az - z * ay, z * ax - x * az, x * ay - y * ax)


@kernel
def _sharpen(patch: NDArray[np.float64], direction: NDArray[np.float64]) -> float:
    """Turn a direction to the one nearby from which a patch looks sharpest; how sharp."""
    step, best = _FIRST_STEP, _sharpness(patch, direction.reshape(1, 3))[0]
    others = np.empty((8, 3))
    while step > _LAST_STEP:
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
    """Whole numbers of the two shortest steps of a lattice from one of its places to each point, (k, 2), as seen from a
    direction; None if the points are none, or two are at one place."""
    seen = patch @ plane_basis(direction).T
    seen = seen - seen[int(np.argmin(np.linalg.norm(seen, axis=1)))]
    ways = (seen[:, None] - seen)[~np.eye(len(seen), dtype=bool)]
    lengths = np.linalg.norm(ways, axis=1)
    pitch = float(np.median(lengths.reshape(len(seen), -1).min(axis=1)))
    ways, lengths = ways[lengths < _NOT_ACROSS * pitch], lengths[lengths < _NOT_ACROSS * pitch]
    if not pitch > 0.0:
        return None
    first = _common_way(ways, lengths, lengths < _BESIDE * pitch)
    across = np.abs(ways @ [-first[1], first[0]]) > _SINE * lengths * np.linalg.norm(first)
    if not across.any():
        return None
    basis = np.stack((first, _common_way(ways, lengths, across)))
    for fits_left in (2, 1, 0):
        if abs(np.linalg.det(basis)) < _SINE / 2.0 * pitch * pitch:
            return None
        at = seen @ np.linalg.inv(basis)
        steps = np.rint(at)
        if fits_left:
            fitted = np.linalg.lstsq(np.column_stack((steps, np.ones(len(steps)))), seen, rcond=None)[0]
            basis, seen = fitted[:2], seen - fitted[2]
    alone = len(np.unique(steps, axis=0)) == len(steps)
    off = float(np.median(np.abs(at - steps).max(axis=1)))
    return steps.astype(np.int64) if alone and off <= _ON_LATTICE else None


def _common_way(
    ways: NDArray[np.float64], lengths: NDArray[np.float64], among: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """The mean of the ways, (m, 2), that are much like the shortest but few among some, either way."""
    shortest = np.flatnonzero(among)[np.argsort(lengths[among], kind="stable")]
    one = ways[shortest[len(shortest) // 8]]
    alike = ways * np.sign(ways @ one)[:, None]
    return alike[np.linalg.norm(alike - one, axis=1) < 0.3 * np.linalg.norm(one)].mean(axis=0)


def _grown(view: _View, points: NDArray[np.float64]) -> PinholeCamera | None:
    """The camera of all of some points, (m, 3), that lie ever farther from the patch that comes first; None if the
    pixels of those around are not those that it says."""
    k = len(view.steps)
    far = np.linalg.norm(points - points[0], axis=1)
    camera = _affine(points[:k], view.steps.astype(np.float64), view.direction)
    known, reach = k, float(far[k - 1])
    while True:
        among = np.linspace(0, known - 1, min(known, _COUNTED)).astype(np.int64)
        counted = np.zeros(len(among), bool)
        for _ in range(_FITS):
            at, depths = camera.pixels(points[among])
            pixels = np.rint(at)
            off = np.abs(at - pixels).max(axis=1)
            most = float(np.partition(off, int(_SURE * len(off)))[int(_SURE * len(off))])
            on = (off < min(max(_TIMES * most, _PRECISE), _OFF_PIXEL)) & (depths * depths[0] > 0.0)
            if not most < _ON_PIXEL or np.mean(on) < _MIN_INLIERS:
                return None
            if np.mean(on != counted) < _SETTLED:
                break
            camera, counted = _fitted(camera, points[among[on]], pixels[on], view.direction), on
        if known == len(points):
            return camera
        reach = max(reach * _GROWTH, float(far[known]))
        known = int(np.searchsorted(far, reach, "right"))


def _of_all(camera: PinholeCamera, points: NDArray[np.float64]) -> PinholeCamera | None:
    """The pinhole camera that sees points at the pixels of another, by the two shortest steps between these; None if
    all is a plane, so that there are many, if one without a place does as well, or if rows are not across columns."""
    pixels = np.rint(camera.pixels(points)[0])
    pinhole = resection(points, pixels, NO_PLANE)
    if pinhole is None:
        return None
    affine = _affine(points, pixels, pinhole.matrix[2, :3])
    if not _misses(pinhole, points, pixels) <= _BETTER * _misses(affine, points, pixels):
        return None
    across = pinhole.matrix[:2, :3] - np.outer(pinhole.matrix[:2, :3] @ pinhole.matrix[2, :3], pinhole.matrix[2, :3])
    across = across / max(float(np.abs(across).max()), _TINY)
    change = _to_shortest(np.linalg.pinv(across @ across.T).astype(np.float64))
    if change is None:
        return None
    matrix = pinhole.matrix.copy()
    matrix[:2] = np.rint(np.linalg.inv(change)) @ matrix[:2]
    return PinholeCamera(matrix)


def _to_shortest(products: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The two shortest steps of a lattice, columns in whole numbers of two others, whose scalar products are given,
    (2, 2); None if they are not at right angles.

    Notes
    -----
    Lagrange's reduction.
    """
    change = np.eye(2)
    for _ in range(_REDUCED):
        longer, shorter = (0, 1) if products[0, 0] > products[1, 1] else (1, 0)
        times = np.rint(products[0, 1] / products[shorter, shorter])
        if times == 0.0:
            across = abs(products[0, 1]) <= _SKEW * math.sqrt(products[0, 0] * products[1, 1])
            return change if across else None
        one = np.eye(2)
        one[shorter, longer] = -times
        products, change = one.T @ products @ one, change @ one
    return None


def _alike(camera: PinholeCamera, points: NDArray[np.float64], n: int) -> list[PinholeCamera]:
    """The cameras that see points, some of n, at whole pixels, if one does: where inverse depth comes in steps, some
    more pixels for each of them, or fewer, are whole, too. Of these those with the least pixels, but enough for n."""
    at, depths = camera.pixels(points)
    inverse = np.sort(np.abs(1.0 / depths))
    step = step_between(inverse)
    if step <= 0.0 or not are_whole((inverse - inverse[0]) / step):
        return [camera]
    steps, pixels = np.rint(np.sign(depths[0]) / (step * depths)), np.rint(at)
    slants = np.arange(-_SLANT, _SLANT + 1)
    rows, columns = (1.0 + np.ptp(line[:, None] - steps[:, None] * slants, axis=0) for line in pixels.T)
    areas = np.outer(rows, columns)
    areas[areas < _ALL * n] = np.inf
    found: list[PinholeCamera] = []
    for best in np.argsort(areas, axis=None, kind="stable")[:_SLANTED]:
        slant = slants[np.array(np.unravel_index(best, areas.shape))]
        row, column = (pixels - steps[:, None] * slant).T
        if len(found) < _TRIED and len(np.unique(row * (2 * MAX_PIXELS) + column)) == len(points):
            matrix = camera.matrix.copy()
            matrix[:2, 3] -= slant * (np.sign(depths[0]) / step)
            found.append(PinholeCamera(matrix))
    return found


def step_between(ascending: NDArray[np.float64]) -> float:
    """The distance between neighbours, if values are even: the mean, once known by how many each is from the last."""
    span = float(ascending[-1] - ascending[0]) if len(ascending) else 0.0
    steps = np.diff(ascending)
    steps = steps[steps > _LEAST * span]
    if len(steps) < MIN_LINES - 1:
        return 0.0
    step = span / float(np.rint(steps / np.quantile(steps, _ADJACENT)).sum())
    if not span <= MAX_PIXELS * step:
        return 0.0
    return step * int(np.gcd.reduce(np.rint((ascending - ascending[0]) / step).astype(np.int64)))  # it may be a half


def are_whole(values: NDArray[np.float64]) -> bool:
    """Whether all of some values are whole numbers, to a tenth."""
    return bool((np.abs(values - np.rint(values)) <= MAX_OFF_PIXEL).all())


def _fitted(
    before: PinholeCamera, points: NDArray[np.float64], pixels: NDArray[np.float64], direction: NDArray[np.float64]
) -> PinholeCamera:
    """The affine camera that sees points at pixels, or if that is better and they are many, or if it was before, the
    pinhole camera."""
    pinhole = resection(points, pixels) if len(points) >= _ENOUGH else None
    if pinhole is not None and before.matrix[2, :3].any():
        return pinhole
    affine = _affine(points, pixels, direction)
    better = pinhole is not None and _misses(pinhole, points, pixels) <= _BETTER * _misses(affine, points, pixels)
    return pinhole if pinhole is not None and better else affine


def _misses(camera: PinholeCamera, points: NDArray[np.float64], pixels: NDArray[np.float64]) -> float:
    """Mean square distance between where points are seen and their pixels."""
    return float(np.square(camera.pixels(points)[0] - pixels).sum(axis=1).mean())


def _affine(points: NDArray[np.float64], pixels: NDArray[np.float64], direction: NDArray[np.float64]) -> PinholeCamera:
    """The camera without a place that sees points at pixels, by least squares; along a direction, if on one plane."""
    middle = points.mean(axis=0)
    ways = points - middle
    weight = _ALONG * float(np.sqrt(np.square(ways).sum()))
    sides = np.vstack((ways, weight * direction))
    linear = np.linalg.lstsq(sides, np.vstack((pixels - pixels.mean(axis=0), np.zeros(2))), rcond=None)[0].T
    offset = pixels.mean(axis=0) - linear @ middle
    return PinholeCamera(np.vstack((np.column_stack((linear, offset)), [0.0, 0.0, 0.0, 1.0])))
