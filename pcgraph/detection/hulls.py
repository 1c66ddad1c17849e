# SPDX-License-Identifier: Apache-2.0
"""Convex outlines in the plane and the smallest rectangle around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

FLAT = 1e-7  # width over length below which a set of points is a line (or, a dimension up, flat)


@dataclass(frozen=True)
class Rectangle:
    """Rectangle in a plane.

    Attributes
    ----------
    center : (2,) float64, metres
    axes : (2, 2) float64
        Rows are unit vectors, the second a quarter turn to the left of the first.
    size : (2,) float64, metres
        Full lengths along the axes, the longer first.
    """

    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    size: NDArray[np.float64]

    @property
    def area(self) -> float:
        """Length times width, square metres."""
        return float(self.size.prod())


def outline(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of the convex hull, (h, 2) float64, counterclockwise; two of points on a line, one of equal points.

    Parameters
    ----------
    points : (n, 2) float64, metres
        n >= 1.
    """
    middle = points.mean(axis=0)
    local = points - middle
    _, along = np.linalg.eigh(local.T @ local)
    spans = np.ptp(local @ along, axis=0)
    if spans[1] == 0.0:
        return points[:1].copy()
    if spans[0] <= FLAT * spans[1]:
        reach = local @ along[:, 1]
        return points[[int(reach.argmin()), int(reach.argmax())]]
    hull = ConvexHull(local)
    return local[hull.vertices] + middle


def smallest_rectangle(points: NDArray[np.float64]) -> Rectangle:
    """Rectangle of least area around points, (n, 2) float64, n >= 1.

    Notes
    -----
    One side lies along a side of the convex hull (Freeman and Shapira 1975), so all of these are tried.
    """
    hull = outline(points)
    origin = hull.mean(axis=0)
    local = hull - origin
    sides = np.roll(local, -1, axis=0) - local
    lengths = np.linalg.norm(sides, axis=1)
    along = sides[lengths > 0.0] / lengths[lengths > 0.0, None]
    if not len(along):
        along = np.array([[1.0, 0.0]])
    across = np.stack((-along[:, 1], along[:, 0]), axis=1)
    u, v = local @ along.T, local @ across.T
    spans = np.stack((np.ptp(u, axis=0), np.ptp(v, axis=0)), axis=1)
    best = int(spans.prod(axis=1).argmin())
    axes = np.stack((along[best], across[best]))
    middle = np.array([u[:, best].max() + u[:, best].min(), v[:, best].max() + v[:, best].min()]) / 2.0
    size = spans[best]
    center = origin + middle @ axes
    if size[0] < size[1]:
        axes, size = np.stack((axes[1], -axes[0])), size[::-1].copy()
    return Rectangle(center, axes, size)


def inside_outline(points: NDArray[np.float64], hull: NDArray[np.float64], margin: float) -> NDArray[np.bool_]:
    """Whether points, (n, 2), lie within a convex outline or nearer than `margin` to a side's line, (n,) bool.

    Parameters
    ----------
    points : (n, 2) float64, metres
    hull : (h, 2) float64, metres
        As `outline` returns it.
    margin : float, metres
    """
    if len(hull) < 3:
        a, b = hull[0], hull[-1]
        reach = np.clip((points - a) @ (b - a) / max(float((b - a) @ (b - a)), 1e-300), 0.0, 1.0)
        return np.linalg.norm(points - a - reach[:, None] * (b - a), axis=1) <= margin
    sides = np.roll(hull, -1, axis=0) - hull
    inward = np.stack((-sides[:, 1], sides[:, 0]), axis=1) / np.linalg.norm(sides, axis=1, keepdims=True)
    heights = points @ inward.T - np.einsum("ij,ij->i", hull, inward)
    return (heights >= -margin).all(axis=1)
