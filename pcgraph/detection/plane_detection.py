# SPDX-License-Identifier: Apache-2.0
"""Planes of a scene: table, floor, walls, as sets of supervoxels."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.detection.boxes import outline, smallest_rectangle
from pcgraph.detection.region_growing import (
    PlanarPatches,
    coplanar_regions,
    moments_of_regions,
    patch_areas,
    region_areas,
)
from pcgraph.features.nodes import node_features, unit_vector
from pcgraph.inputs import positive
from pcgraph.plumbing.plain_dict import PlainDict
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.segmentation import Segmentation, check_segmentation
from pcgraph.voxels.directions import plane_basis

ROLE_ANGLE = np.radians(20.0)
"""Radians within which a plane counts as level or upright, because ramps and roofs are steeper, and a camera held by
hand knows `up` to some degrees. Not varied."""


@dataclass(frozen=True, eq=False)
class Planes(ShortRepr, PlainDict):
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

    def _counts(self) -> str:
        roles = [f"{np.count_nonzero(self.roles == role)} {role}" for role in sorted({*self.roles.tolist()})]
        return f"{len(self)} plane{'' if len(self) == 1 else 's'}" + (f" ({', '.join(roles)})" if roles else "")

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
        Largest root mean square distance of a supervoxel to its plane; planes of whole regions join within 0.4 of
        it. Default: 0.7 of the mean edge of its voxels, which grow with range where points lie further apart.
    angle : float, radians, 0..pi/2
        Largest angle between a supervoxel and its plane.
    min_area : float, square metres, optional
        What must be seen of a plane. Default: 8 supervoxels of median area.
    join : bool
        Whether coplanar pieces that do not touch are one plane, as of a table under its objects.

    Returns
    -------
    Planes
        None of them on a sphere or a cylinder: regions whose normals turn steadily are left out. Without any
        plane the arrays are empty.

    Raises
    ------
    ValueError
        An argument is not as above.

    Notes
    -----
    Regions grow over the graph as in Vo et al. 2015, here from supervoxel to supervoxel by exact moments
    (`pcgraph.detection.region_growing`).
    """
    check_segmentation(segmentation)
    if not isinstance(angle, Real) or not 0.0 < angle <= np.pi / 2:
        raise ValueError(f"expected an angle above 0 and up to pi/2 radians, got {angle!r}")
    if min_area is not None and not (isinstance(min_area, Real) and 0.0 < min_area < np.inf):
        raise ValueError(f"expected a finite min_area above 0 square metres, got {min_area!r}")
    upwards = None if up is None else unit_vector("up", up)
    patches = planar_patches(segmentation, tolerance, angle)
    areas = patch_areas(patches.moments)
    regions = coplanar_regions(patches, areas, min_area, join)
    return _described(segmentation, regions, region_areas(areas, regions), upwards)


def _described(
    segmentation: Segmentation,
    regions: NDArray[np.int32],
    areas: NDArray[np.float64],
    up: NDArray[np.float64] | None,
) -> Planes:
    """Planes of these regions of supervoxels, (n_leaves,), with these areas, (p,)."""
    p = len(areas)
    moments = moments_of_regions(segmentation.leaves, regions, p)
    features = node_features(moments)
    normals = features.normal
    corners, outlines = np.empty((p, 4, 3)), []
    voxels = members(regions[segmentation.surface.supervoxels], p)
    for i in range(p):
        basis, origin = plane_basis(normals[i]), moments.centroids[i]
        hull = outline((segmentation.surface.grid.centroids[voxels[i]] - origin) @ basis.T)
        rectangle = smallest_rectangle(hull)
        half = rectangle.size[:, None] / 2.0 * rectangle.axes
        around = np.stack((-half[0] - half[1], half[0] - half[1], half[0] + half[1], half[1] - half[0]))
        corners[i] = (rectangle.center + around) @ basis + origin
        outlines.append(hull @ basis + origin)
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
        areas=areas,
        corners=corners,
        outlines=tuple(outlines),
        roles=roles,
        up=up,
        plane_of_supervoxel=regions,
    )


def members(groups: NDArray[np.int32], n_groups: int) -> list[NDArray[np.int64]]:
    """Indices of the members of each group, ascending; groups : (n,) int, -1 for none."""
    order = np.argsort(groups, kind="stable")
    ends = np.searchsorted(groups[order], np.arange(n_groups + 1))
    return [order[ends[i] : ends[i + 1]] for i in range(n_groups)]


# ------------------------------------------------------------------------------------------------ planar supervoxels

TOLERANCE = 0.7
"""Default tolerance in voxel edges: voxels follow the spacing of the points, and grow with range as noise and roughness
do. From 0.5 to 0.8 tables (mOSD) change by 0.003 of their overlap, roads by 0.03 of their points; at 0.1 tables fall
apart, at 1.0 one object of 32 becomes part of its table. The residuals of supervoxels say less: one that holds points
of a single scan line has none, whatever the noise."""
MIN_WIDTH = 0.8
"""Least width in tolerances (second standard deviation of a supervoxel) of one that is not degenerate: what may count
as thickness is then less than the width, so that the normal means something. Not varied."""


def planar_patches(segmentation: Segmentation, tolerance: float | None, angle: float) -> PlanarPatches:
    """Supervoxels of a segmentation, for this tolerance (metres; None: `TOLERANCE`) and angle (radians)."""
    nodes, moments = segmentation.graph.node_features, segmentation.leaves
    if tolerance is None:
        tolerances = TOLERANCE * segmentation.surface.mean_edge_lengths(segmentation.tree.n_leaves)
    else:
        tolerances = np.full(len(moments), positive("tolerance", tolerance))
    i, j = segmentation.graph.edges.T
    edges = segmentation.graph.edge_features
    return PlanarPatches(
        moments=moments,
        normals=nodes.normal,
        tolerances=tolerances,
        degenerate=nodes.deviations[:, 1] < MIN_WIDTH * tolerances,
        cos_angle=float(np.cos(angle)),
        edges=segmentation.graph.edges,
        smooth=(edges.step <= np.minimum(tolerances[i], tolerances[j])) & (edges.normal_angle <= angle),
    )
