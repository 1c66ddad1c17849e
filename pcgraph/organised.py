# SPDX-License-Identifier: Apache-2.0
"""What the order of organised points tells: from where they were seen, and whether a camera took them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import CleanCloud
from pcgraph.voxels.spacing import VOXELS_PER_SPACING, median_spacing
from pcgraph.voxels.warp import Warp

_SOME_PIXELS, _IN_ORDER = 2048, 0.95  # pixels that are looked at, and how well their order on an image fits their rays
_SOME_PAIRS, _FEW_PAIRS = 2048, 64  # neighbours of which it is asked whether they are so from the origin,
_FAR_APART, _HARDLY_ANY = 2.5, 0.001  # or this many times as far apart as most; and how many of them may be
_ON_PIXEL, _NEARLY_ALL = 1.0, 0.95  # pixels by which points may be off their own, and how many are not
_DEGENERATE = 1e-4  # of the largest singular value: where the last but one is less, as of a plane, no camera is told
_FAR_OFF = 100.0  # extents of the points: a camera so far off is none
_SOME_TRIPLES, _DIFFERING = 1 << 15, 0.1  # neighbours in a row at which steps of depth are read; and how many have one,
_ROUNDING = 1e-6  # of the largest inverse depth, and more
_FAR, _STEP, _MOST_TIMES = 0.8, 0.75, 4.0  # quantile of depth at which a step is so many voxel edges, at most, if
# voxels need not be more than so many times as large as pixels would have them


def image_viewpoint(cloud: CleanCloud) -> NDArray[np.float64] | None:
    """From where an organised cloud was seen, (3,) float64, metres; None if it does not tell, or is a list of points.

    The origin, if neighbours lie side by side as seen from there, as in the frame of their sensor; else the centre of
    the pinhole camera that sees each point at its pixel, whatever frame the points are in.
    """
    if len(cloud.shape) != 2:
        return None
    return np.zeros(3) if _seen_from_origin(cloud) else _camera_centre(cloud)


def _seen_from_origin(cloud: CleanCloud) -> bool:
    """Whether neighbours in a row, or in a column, lie side by side as seen from the origin.

    Then the ways to them make much the same angle, also where one of them hides what lies behind it. From elsewhere
    those at such edges lie far apart.
    """
    width = cloud.shape[1]
    some = np.sort(np.random.default_rng(0).integers(len(cloud.kept), size=_SOME_PAIRS))
    far_apart = []
    for step in (1, width):
        beside = np.minimum(np.searchsorted(cloud.kept, cloud.kept[some] + step), len(cloud.kept) - 1)
        pairs = cloud.kept[beside] == cloud.kept[some] + step
        if step == 1:
            pairs &= cloud.kept[some] % width < width - 1
        one, other = (_directions(cloud.points[at[pairs]]) for at in (some, beside))
        angles = np.linalg.norm(one - other, axis=1)
        if len(angles) >= _FEW_PAIRS:
            far_apart.append(float(np.mean(angles > _FAR_APART * np.median(angles))))
    return not far_apart or min(far_apart) <= _HARDLY_ANY


def _directions(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows, (n, 3), of length 1; of zeros zeros."""
    scaled = rows / np.maximum(np.abs(rows).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return scaled / np.maximum(np.linalg.norm(scaled, axis=1, keepdims=True), np.finfo(np.float64).tiny)


def _camera_centre(cloud: CleanCloud) -> NDArray[np.float64] | None:
    """The centre, (3,), of the camera that sees each point at its pixel; None if there is none, or all is one plane.

    Notes
    -----
    Resection by the direct linear transform (Hartley and Zisserman 2004, 7.1). Noise of a depth camera is along the
    rays, so it does not move the pixels.
    """
    some = np.random.default_rng(0).integers(len(cloud.kept), size=_SOME_PIXELS)
    low, high = cloud.bounds
    scale = max(float((high - low).max()) / 2.0, np.finfo(np.float64).tiny)
    places = np.column_stack(((cloud.points[some] - (low + high) / 2.0) / scale, np.ones(len(some))))
    half = max(cloud.shape) / 2.0
    pixels = np.stack(np.divmod(cloud.kept[some], cloud.shape[1]), axis=1) / half - 1.0
    none = np.zeros_like(places)
    rows = [np.hstack((*sides, -pixels[:, [i]] * places)) for i, sides in enumerate(((places, none), (none, places)))]
    values, vectors = np.linalg.svd(np.concatenate(rows), full_matrices=False)[1:]
    if values[-2] <= _DEGENERATE * values[0]:
        return None
    camera = vectors[-1].reshape(3, 4)
    row, column, depth = camera @ places.T
    if not (depth > 0.0).all() and not (depth < 0.0).all():
        return None
    off = np.hypot(row / depth - pixels[:, 0], column / depth - pixels[:, 1]) * half
    if np.mean(off <= _ON_PIXEL) < _NEARLY_ALL:
        return None
    centre = np.linalg.svd(camera)[2][-1]
    if not np.linalg.norm(centre[:3]) <= _FAR_OFF * abs(centre[3]):
        return None
    return (low + high) / 2.0 + scale * centre[:3] / centre[3]


def is_camera(cloud: CleanCloud, viewpoint: NDArray[np.float64]) -> bool:
    """Whether a camera at the viewpoint may have taken this as one image: what lies to the right is in a column there.

    Other organised clouds, as height maps and the rows of a turning scanner, may also lie in front of a place.
    """
    if len(cloud.shape) != 2 or viewpoint.ndim != 1:
        return False
    if not cloud.points[:, 2].min() > viewpoint[2]:
        return False
    some = np.random.default_rng(0).integers(len(cloud.points), size=_SOME_PIXELS)
    rays = cloud.points[some] - viewpoint
    with np.errstate(over="ignore"):  # of points in the camera
        x, y = (rays[:, :2] / rays[:, 2:]).T
    row, column = np.divmod(cloud.kept[some], cloud.shape[1])
    orders = ((x, column), (y, row)), ((x, row), (y, column))  # the second of an image on its side
    return any(all(_rank_correlation(a, b) >= _IN_ORDER for a, b in order) for order in orders)


def spacing_of_image(cloud: CleanCloud, warp: Warp) -> float:
    """How far apart points are that a camera at the warp's place tells from each other, metres, in the warp's space.

    It is the median distance to the nearest; more, up to four times that, where the camera's depth is coarser than the
    voxels that this makes, at the depth of what is far.

    Notes
    -----
    Depth by triangulation comes in steps of inverse depth, so of z^2 in depth (Khoshelham and Elberink 2012), while
    pixels are z apart: from some depth on a surface is a stack of sheets that touch no other.
    """
    camera = np.zeros(3) if warp.seen_from is None else warp.seen_from
    inverse = np.full(cloud.shape, np.nan)
    inverse.reshape(-1)[cloud.kept] = 1.0 / (cloud.points[:, 2] - camera[2])
    rows = [image[:: max(1, image.size // _SOME_TRIPLES)] for image in (inverse, inverse.T)]
    far = 1.0 / float(np.nanquantile(rows[0], 1.0 - _FAR))
    step = (
        min(filter(None, map(_step_along, rows)), default=0.0)
        * far
        * far
        / float(warp.scale(camera[None] + [0.0, 0.0, far])[0])
    )
    spacing = median_spacing(cloud.points, warp)
    return max(spacing, min(step / (_STEP * VOXELS_PER_SPACING), _MOST_TIMES * spacing))


def _step_along(rows: NDArray[np.float64]) -> float:
    """Twice what the inverse depth of a pixel differs by from the mean of its two neighbours' in a row, 1/metres.

    It is the median over those where it differs at all; 0 where it hardly differs anywhere. On a plane inverse depth is
    linear in the pixels, whatever its slant, so what is left is noise, or steps.
    """
    differences = np.abs(rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:])
    differences = differences[np.isfinite(differences)]
    differing = differences[differences > _ROUNDING * np.nanmax(rows)]
    return float(np.median(differing)) if len(differing) > _DIFFERING * len(differences) else 0.0


def _rank_correlation(a: NDArray[np.number], b: NDArray[np.number]) -> float:
    """How far one column rises or falls with another, 0..1 (Spearman); 1 where one is constant."""
    ranks = []
    for values in (a, b):
        _, place, number = np.unique(values, return_inverse=True, return_counts=True)
        if len(number) == 1:
            return 1.0
        ranks.append((np.cumsum(number) - 0.5 * number)[place])
    return abs(float(np.corrcoef(*ranks)[0, 1]))
