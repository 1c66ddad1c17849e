# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes around points: standing on a plane, or free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from pcgraph.detection.hulls import FLAT, smallest_rectangle
from pcgraph.features.nodes import unit_vector
from pcgraph.features.primitives import finite_vectors
from pcgraph.short_repr import ShortRepr

_SAME_NORMAL = 1e6  # steps per unit in which normals of facets are told apart
_MOST_FACETS = 64  # the largest ones; noise makes hundreds of small ones


@dataclass(frozen=True)
class OrientedBox(ShortRepr):
    """A box in any pose.

    Attributes
    ----------
    center : (3,) float64, metres, the points' frame
    axes : (3, 3) float64
        Rows are unit vectors and form a right-handed frame.
    size : (3,) float64, metres
        Full lengths along the axes; 0 where the points are flat.
    """

    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    size: NDArray[np.float64]

    @property
    def volume(self) -> float:
        """Product of the lengths, cubic metres."""
        return float(self.size.prod())

    def corners(self) -> NDArray[np.float64]:
        """Corners, (8, 3) float64, metres; corner 4 a + 2 b + c lies on side a, b, c (0 or 1) of the three axes."""
        signs = np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)])
        return self.center + (signs * self.size) @ self.axes

    def local(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points, (..., 3), in the box's own frame: from its centre along its axes, metres."""
        return (np.asarray(points, np.float64) - self.center) @ self.axes.T

    def contains(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether points, (..., 3), lie in the box or nearer than `margin` metres to it along each axis; NaN do not."""
        return np.all(np.abs(self.local(points)) <= self.size / 2.0 + margin, axis=-1)

    def distances(self, points: ArrayLike) -> NDArray[np.float64]:
        """Distance of points, (..., 3), to the surface of the box, metres, from within as from without."""
        outside = np.abs(self.local(points)) - self.size / 2.0
        beyond = np.linalg.norm(np.maximum(outside, 0.0), axis=-1)
        return np.where((outside <= 0.0).all(axis=-1), -outside.max(axis=-1), beyond)


def standing_box(points: ArrayLike, up: ArrayLike, bottom: float | None = None) -> OrientedBox:
    """Box on a plane: the smallest rectangle around the points' footprint, times their height.

    Parameters
    ----------
    points : (n, 3) float, metres
        n >= 1, finite.
    up : (3,) float, any length but zero
        Normal of the plane; the third axis of the box.
    bottom : float, metres, optional
        Position of the box's underside along `up`; default: that of the lowest point.

    Returns
    -------
    OrientedBox
        Its first axis is the longer side of the footprint.

    Raises
    ------
    ValueError
        Points or `up` are not as above.
    """
    return _standing(some_points(points), unit_vector("up", up), bottom)


def _standing(places: NDArray[np.float64], up: NDArray[np.float64], bottom: float | None = None) -> OrientedBox:
    basis = plane_basis(up)
    flat, heights = places @ basis.T, places @ up
    rectangle = smallest_rectangle(flat)
    low = float(heights.min()) if bottom is None else bottom
    high = max(float(heights.max()), low)
    axes = np.vstack((rectangle.axes @ basis, up))
    center = rectangle.center @ basis + (low + high) / 2.0 * up
    return OrientedBox(center, axes, np.append(rectangle.size, high - low))


def tight_box(points: ArrayLike) -> OrientedBox:
    """Free box around points, (n, 3) float, n >= 1: the smallest of those flush with a large facet of their hull.

    Returns
    -------
    OrientedBox
        Axes in descending order of length.

    Raises
    ------
    ValueError
        There is no point, or not all are finite.

    Notes
    -----
    The smallest box of all need not be flush with a facet (O'Rourke 1985), but is rarely smaller by much.
    """
    places = some_points(points)
    middle = places.mean(axis=0)
    local = places - middle
    _, principal = np.linalg.eigh(local.T @ local)
    spans = np.ptp(local @ principal, axis=0)
    if spans.min() <= FLAT * spans.max():
        best = _standing(local, principal[:, 0])
    else:
        hull = ConvexHull(local)
        corners = local[hull.vertices]
        best = min((_standing(corners, normal) for normal in _facets(hull)), key=lambda box: box.volume)
    order = np.argsort(-best.size, kind="stable")
    axes = best.axes[order]
    axes[2] *= np.sign(np.linalg.det(axes))
    return OrientedBox(best.center + middle, axes, best.size[order])


def some_points(points: ArrayLike) -> NDArray[np.float64]:
    """The points as (n, 3) float64; ValueError if there is none, or if they are not three finite numbers each."""
    places = finite_vectors("points", points)
    if not len(places):
        raise ValueError("expected at least one point, got none")
    return places


def plane_basis(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors, rows of (2, 3), that form a right-handed frame with a unit normal as the third."""
    helper = np.zeros(3)
    helper[int(np.abs(normal).argmin())] = 1.0
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first)
    return np.stack((first, np.cross(normal, first)))


def _facets(hull: ConvexHull) -> NDArray[np.float64]:
    """Unit normals of the hull's largest sides, one of each, (f, 3); opposite ones are the same."""
    normals = hull.equations[:, :3]
    largest = np.take_along_axis(normals, np.abs(normals).argmax(axis=1)[:, None], axis=1)
    whole = np.rint(normals * np.sign(largest) * _SAME_NORMAL)
    _, first, side = np.unique(whole, axis=0, return_index=True, return_inverse=True)
    a, b, c = hull.points[hull.simplices].transpose(1, 0, 2)
    areas = np.bincount(side.ravel(), np.linalg.norm(np.cross(b - a, c - a), axis=1))
    return normals[first[np.argsort(-areas, kind="stable")[:_MOST_FACETS]]]
