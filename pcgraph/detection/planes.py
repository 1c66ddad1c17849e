# SPDX-License-Identifier: Apache-2.0
"""Planes of a scene: table, floor, walls, as sets of supervoxels."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.detection.boxes import plane_basis
from pcgraph.detection.flat_leaves import flat_leaves
from pcgraph.detection.hulls import outline, smallest_rectangle
from pcgraph.detection.plane_search import leaf_areas, plane_regions, region_areas
from pcgraph.detection.regions import moments_of_regions
from pcgraph.features.nodes import node_features, unit_vector
from pcgraph.segmentation import Segmentation
from pcgraph.short_repr import ShortRepr

ROLE_ANGLE = np.radians(20.0)


@dataclass(frozen=True)
class Planes(ShortRepr):
    """p planes, the one of largest area first.

    Attributes
    ----------
    normals : (p, 3) float64
        Unit normals on the viewpoint's side.
    offsets : (p,) float64, metres
        normal . x of the points x of the plane, in the points' frame.
    centroids : (p, 3) float64, metres
    residuals : (p,) float64, metres
        Root mean square distance of the plane's points.
    counts : (p,) int64
        Number of points.
    areas : (p,) float64, square metres
        What was seen of it: sum over its supervoxels.
    corners : (p, 4, 3) float64, metres
        Smallest rectangle in the plane around its voxels, counterclockwise as seen from the viewpoint's side.
    outlines : tuple of p arrays (h, 3) float64, metres
        Convex outline of its voxels in the plane, counterclockwise.
    roles : (p,) str
        "horizontal", "vertical" or "other", within 20 degrees, next to `up`.
    up : (3,) float64
        Unit vector; as given, or the normal of the largest plane (zero if there is no plane).
    plane_of_supervoxel : (n_leaves,) int32
        -1 for none.
    """

    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    centroids: NDArray[np.float64]
    residuals: NDArray[np.float64]
    counts: NDArray[np.int64]
    areas: NDArray[np.float64]
    corners: NDArray[np.float64]
    outlines: tuple[NDArray[np.float64], ...]
    roles: NDArray[np.str_]
    up: NDArray[np.float64]
    plane_of_supervoxel: NDArray[np.int32]

    def __len__(self) -> int:
        """Number of planes."""
        return len(self.offsets)

    def supervoxels(self, plane: int) -> NDArray[np.int64]:
        """Supervoxels of one plane, ascending, (s,) int64."""
        return np.flatnonzero(self.plane_of_supervoxel == plane)

    def distances(self, points: ArrayLike) -> NDArray[np.float64]:
        """Signed distance of points, (..., 3), to every plane, (..., p), metres; positive on the normal's side."""
        return np.asarray(points, np.float64) @ self.normals.T - self.offsets


def find_planes(
    segmentation: Segmentation,
    *,
    up: ArrayLike | None = None,
    tolerance: float | None = None,
    angle: float = float(np.radians(15.0)),
    min_area: float | None = None,
    join: bool = True,
) -> Planes:
    """Planes of a segmented cloud: maximal sets of supervoxels that lie in one plane.

    Parameters
    ----------
    segmentation : Segmentation
    up : (3,) float, optional
        Against gravity, in the points' frame; decides roles only. Default: the normal of the largest plane.
    tolerance : float, metres, optional
        Largest root mean square distance of a supervoxel to its plane. Default: from the noise, 3.5 times the
        plane residual of the flattest quarter of the points, in proportion to the size of the voxels there.
    angle : float, radians, 0..pi/2
        Largest angle between a supervoxel and its plane.
    min_area : float, square metres, optional
        What must be seen of a plane. Default: 8 supervoxels of median area.
    join : bool
        Whether coplanar pieces that do not touch are one plane, as of a table under its objects.

    Returns
    -------
    Planes
        None of them on a sphere or a cylinder: pieces whose normals turn steadily are left out. Without any
        plane the arrays are empty.

    Raises
    ------
    ValueError
        An argument is not as above.

    Notes
    -----
    Regions grow over the graph as in Vo et al. 2015, here from supervoxel to supervoxel by exact moments.
    """
    if not isinstance(angle, Real) or not 0.0 < angle <= np.pi / 2:
        raise ValueError(f"expected an angle above 0 and up to pi/2 radians, got {angle!r}")
    if min_area is not None and not (isinstance(min_area, Real) and 0.0 < min_area < np.inf):
        raise ValueError(f"expected a finite min_area above 0 square metres, got {min_area!r}")
    upwards = None if up is None else unit_vector("up", up)
    leaves = flat_leaves(segmentation, tolerance, angle)
    areas = leaf_areas(leaves)
    regions = plane_regions(leaves, areas, min_area, join)
    return _describe(segmentation, regions, areas, upwards)


def _describe(
    segmentation: Segmentation,
    regions: NDArray[np.int32],
    areas: NDArray[np.float64],
    up: NDArray[np.float64] | None,
) -> Planes:
    p = int(regions.max(initial=-1)) + 1
    moments = moments_of_regions(segmentation.leaves, regions, p)
    features = node_features(moments)
    normals = features.normal
    grid, plane_of_voxel = segmentation.surface.grid, regions[segmentation.surface.supervoxels]
    corners, outlines = np.empty((p, 4, 3)), []
    for i in range(p):
        basis, origin = plane_basis(normals[i]), moments.centroids[i]
        flat = (grid.centroids[plane_of_voxel == i] - origin) @ basis.T
        rectangle = smallest_rectangle(flat)
        half = rectangle.size[:, None] / 2.0 * rectangle.axes
        around = np.stack((-half[0] - half[1], half[0] - half[1], half[0] + half[1], half[1] - half[0]))
        corners[i] = (rectangle.center + around) @ basis + origin
        outlines.append(outline(flat) @ basis + origin)
    if up is None:
        up = normals[0] if p else np.zeros(3)
    rise = np.abs(normals @ up)
    level = np.where(rise >= np.cos(ROLE_ANGLE), "horizontal", "other")
    roles = np.where(rise <= np.sin(ROLE_ANGLE), "vertical", level)
    return Planes(
        normals=normals,
        offsets=np.einsum("pa,pa->p", normals, moments.centroids),
        centroids=moments.centroids,
        residuals=features.residual,
        counts=moments.counts,
        areas=region_areas(areas, regions),
        corners=corners,
        outlines=tuple(outlines),
        roles=roles,
        up=up,
        plane_of_supervoxel=regions,
    )
