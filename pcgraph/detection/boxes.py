# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes around points, standing on a plane or free; convex outlines and rectangles in a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from pcgraph.features.nodes import unit_vector
from pcgraph.features.primitives import finite_vectors
from pcgraph.plumbing.plain_dict import PlainDict
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.directions import plane_basis

FLAT = 1e-7
"""Ratio of width to length below which points lie on a line (or, a dimension up, in a plane), because Qhull needs
more."""
_NORMAL_STEPS = 1e6
"""Steps per unit in which normals of facets are told apart, because Qhull cuts one flat side into triangles with equal
normals up to rounding."""
_MAX_FACETS = 64
"""Count of facets that are tried, the largest first, because noise makes hundreds of small ones. Not varied."""


@dataclass(frozen=True, eq=False)
class OrientedBox(ShortRepr, PlainDict):
    """A box in any pose.

    Attributes
    ----------
    center : (3,) float64, metres, the points' frame
    axes : (3, 3) float64
        Rows are unit vectors and form a right-handed frame.
    size : (3,) float64, metres
        Full lengths along the axes; 0 where the points are flat.

    Examples
    --------
    `to_dict` is what JSON holds; the class takes it back:

    >>> box = OrientedBox(np.zeros(3), np.eye(3), np.array([0.3, 0.2, 0.1]))
    >>> box.to_dict()["size"]
    [0.3, 0.2, 0.1]
    >>> OrientedBox(**{name: np.array(value) for name, value in box.to_dict().items()}).volume == box.volume
    True
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
    rectangle = smallest_rectangle(outline(flat))
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
        corners, normals = local[hull.vertices], _facets(hull)
        volumes = _volumes(hull, normals)
        smallest = normals[volumes <= (1.0 + 1e-6) * volumes.min()]  # equal ones are told apart exactly
        best = min((_standing(corners, normal) for normal in smallest), key=lambda box: box.volume)
    order = np.argsort(-best.size, kind="stable")
    axes = best.axes[order]
    axes[2] *= np.sign(np.linalg.det(axes))
    return OrientedBox(best.center + middle, axes, best.size[order])


def boxes_of_labels(points: ArrayLike, labels: ArrayLike, up: ArrayLike | None = None) -> dict[int, OrientedBox]:
    """Box around the points of each label, by label in ascending order; negative labels have none.

    Parameters
    ----------
    points : (n, 3) or (h, w, 3) float, metres
        Points that are not finite do not count.
    labels : (n,) or (h, w) int
        For example ``result.labels`` or ``result.cut(n=50)``.
    up : (3,) float, any length but zero, optional
        Boxes stand along this direction, as `standing_box`. Default: free boxes, as `tight_box`.

    Raises
    ------
    ValueError
        There is not one label per point, labels are not whole numbers, or `up` is no direction.

    Examples
    --------
    >>> import numpy as np, pcgraph
    >>> corners = np.array([[x, y, z] for x in (0, 4) for y in (0, 2) for z in (0, 1)], float)
    >>> boxes = pcgraph.detection.boxes_of_labels(np.concatenate((corners, corners + 9)), np.repeat([0, 7], 8))
    >>> {label: box.size.tolist() for label, box in boxes.items()}
    {0: [4.0, 2.0, 1.0], 7: [4.0, 2.0, 1.0]}
    """
    places, numbers = np.asarray(points, np.float64), np.asarray(labels)
    if places.shape != (*numbers.shape, 3) or numbers.dtype.kind not in "iu":
        raise ValueError(
            f"expected one whole number per point as labels, got {numbers.dtype} of shape {numbers.shape} for points "
            f"of shape {places.shape}"
        )
    direction = None if up is None else unit_vector("up", up)
    places, numbers = places.reshape(-1, 3), numbers.reshape(-1)
    kept = np.flatnonzero((numbers >= 0) & np.isfinite(places).all(axis=1))
    order = kept[np.argsort(numbers[kept], kind="stable")]
    found, first = np.unique(numbers[order], return_index=True)
    groups = [places[rows] for rows in np.split(order, first[1:])][: len(found)]
    box = tight_box if direction is None else lambda group: _standing(group, direction)
    return {label: box(group) for label, group in zip(found.tolist(), groups, strict=True)}


def some_points(points: ArrayLike) -> NDArray[np.float64]:
    """The points as (n, 3) float64; ValueError if there is none, or if they are not three finite numbers each."""
    places = finite_vectors("points", points)
    if not len(places):
        raise ValueError("expected at least one point, got none")
    return places


def _facets(hull: ConvexHull) -> NDArray[np.float64]:
    """Unit normals of the hull's largest sides, one of each, (f, 3); opposite ones are the same."""
    normals = hull.equations[:, :3]
    largest = np.take_along_axis(normals, np.abs(normals).argmax(axis=1)[:, None], axis=1)
    whole = np.rint(normals * np.sign(largest) * _NORMAL_STEPS)
    _, first, side = np.unique(whole, axis=0, return_index=True, return_inverse=True)
    a, b, c = hull.points[hull.simplices].transpose(1, 0, 2)
    areas = np.bincount(side.ravel(), np.linalg.norm(np.cross(b - a, c - a), axis=1))
    return normals[first[np.argsort(-areas, kind="stable")[:_MAX_FACETS]]]


def _volumes(hull: ConvexHull, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Volume, up to rounding, of the smallest box around a hull that stands along each unit normal, (f,) float64.

    The outline seen along a normal consists of edges of the hull between a side that faces it and one that does not;
    the box has a side along one of these.
    """
    sides = np.repeat(np.arange(len(hull.simplices)), 3)
    across = hull.neighbors.ravel()  # of a triangle, the neighbour opposite each corner
    ends = np.stack((np.roll(hull.simplices, -1, axis=1), np.roll(hull.simplices, 1, axis=1)), axis=-1).reshape(-1, 2)
    once = sides < across
    along = hull.points[ends[once, 1]] - hull.points[ends[once, 0]]
    facing = hull.equations[:, :3] @ normals.T
    normal, edge = np.nonzero((facing[sides[once]] * facing[across[once]] <= 1e-9).T)
    first = along[edge] - np.einsum("ta,ta->t", along[edge], normals[normal])[:, None] * normals[normal]
    length = np.linalg.norm(first, axis=1)
    seen = length > 1e-9 * np.linalg.norm(along[edge], axis=1)  # others run along the normal
    normal, first = normal[seen], first[seen] / length[seen, None]
    corners = hull.points[hull.vertices]
    areas = np.ptp(corners @ first.T, axis=0) * np.ptp(corners @ np.cross(normals[normal], first).T, axis=0)
    least = np.full(len(normals), np.inf)
    np.minimum.at(least, normal, areas)
    return least * np.ptp(corners @ normals.T, axis=0)


# ----------------------------------------------------------------------------------- outlines and rectangles


@dataclass(frozen=True, eq=False)
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


def smallest_rectangle(hull: NDArray[np.float64]) -> Rectangle:
    """Rectangle of least area around a convex outline, (h, 2) float64, as `outline` returns it.

    Notes
    -----
    One side lies along a side of the outline (Freeman and Shapira 1975), so all of these are tried.
    """
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
