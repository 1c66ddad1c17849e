# SPDX-License-Identifier: Apache-2.0
"""What the order of organised points tells: from where they were seen, and whether a camera took them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.inputs import CleanCloud

_SOME_PIXELS, _IN_ORDER = 2048, 0.95  # pixels that are looked at, and how well their order on an image fits their rays
_SOME_PAIRS, _FEW_PAIRS = 8192, 64  # neighbours of which it is asked whether they are so from the origin,
_FAR_APART, _HARDLY_ANY = 2.5, 0.001  # or this many times as far apart as most; and how many of them may be
_ON_PIXEL, _NEARLY_ALL = 1.0, 0.95  # pixels by which points may be off their own, and how many are not
_DEGENERATE = 1e-4  # of the largest singular value: where the last but one is less, as of a plane, no camera is told
_FAR_OFF = 100.0  # extents of the points: a camera so far off is none


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


def _rank_correlation(a: NDArray[np.number], b: NDArray[np.number]) -> float:
    """How far one column rises or falls with another, 0..1 (Spearman); 1 where one is constant."""
    ranks = []
    for values in (a, b):
        _, place, number = np.unique(values, return_inverse=True, return_counts=True)
        if len(number) == 1:
            return 1.0
        ranks.append((np.cumsum(number) - 0.5 * number)[place])
    return abs(float(np.corrcoef(*ranks)[0, 1]))
