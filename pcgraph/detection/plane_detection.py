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
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.segmentation import Segmentation, check_segmentation
from pcgraph.voxels.directions import plane_basis

ROLE_ANGLE = np.radians(20.0)
"""Within this of level or upright: ramps and roofs are steeper, a camera held by hand knows `up` to some degrees."""


@dataclass(frozen=True, eq=False)
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


# -------------------------------------------------------------------------------------------- tolerances from the noise

NOISE_FACTOR = 3.5
"""Default tolerance over the noise: a supervoxel's residual is itself an estimate, and above the flattest quarter's."""
MIN_TOLERANCE = 0.02
"""Voxel edges: the least default tolerance, where there is no noise, so that rounding does not decide."""
MAX_TOLERANCE = 1.0
"""Voxel edges: the largest default tolerance, where nothing is flat; beyond it a step of a voxel would be a plane."""
MIN_WIDTH = 0.8
"""Width (second standard deviation) over tolerance below which a supervoxel is degenerate: what may
count as its thickness is then more than its width, so its normal may point anywhere."""


def planar_patches(segmentation: Segmentation, tolerance: float | None, angle: float) -> PlanarPatches:
    """Supervoxels of a segmentation, for this tolerance (metres; None: from the noise) and angle (radians)."""
    nodes, moments = segmentation.graph.node_features, segmentation.leaves
    edge = segmentation.surface.mean_edge_lengths(segmentation.tree.n_leaves)
    if tolerance is None:
        noise = surface_noise(nodes.residual, edge, nodes.size)
        tolerances = np.clip(NOISE_FACTOR * noise, MIN_TOLERANCE * edge, MAX_TOLERANCE * edge)
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


FLAT_FRACTION = 0.25
"""A quarter of any scene is taken to be flat enough to show the noise."""
NOISE_GROUPS = 8
"""Groups by distance through which the power law goes; with fewer supervoxels fewer, of at least 20 each, so that the
flat quarter of a group is five."""
MIN_GROUP = 20
MIN_EDGE_RATIO = 1.2
"""Ratio of largest to smallest voxel edge below which voxels count as equal: the scatter of the noise is larger then
than what distance does to it."""
MAX_EXPONENT = 3.0
"""The noise of stereo and structured light grows with the square of the distance, of phase-measuring time of flight, as
the signal fades, up to the cube; never less than linearly, as voxels do."""


def surface_noise(
    residuals: NDArray[np.float64], edges: NDArray[np.float64], counts: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Standard deviation of the noise at each supervoxel, (n,) float64, metres, read off the flattest parts.

    Parameters
    ----------
    residuals : (n,) float64, metres
        Root mean square distance of each supervoxel's points to its plane.
    edges : (n,) float64, metres
        Mean edge of its voxels; where voxels grow with the distance this stands for the distance.
    counts : (n,) int64
        Its number of points.

    Notes
    -----
    The quarter with the smallest residuals shows the noise; where voxels grow, that of eight groups by distance,
    through which goes a power law (exponent 1 to 3).
    """
    order = np.argsort(edges, kind="stable")
    n_groups = min(NOISE_GROUPS, len(edges) // MIN_GROUP)
    if n_groups < 2 or edges[order[-1]] < MIN_EDGE_RATIO * edges[order[0]]:
        return edges * _quantile(residuals / edges, counts)
    groups = np.array_split(order, n_groups)
    levels = np.array([_quantile(residuals[group], counts[group]) for group in groups])
    places = np.array([np.median(edges[group]) for group in groups])
    seen = levels > 0.0
    if seen.sum() < 2:
        return edges * _quantile(residuals / edges, counts)
    x, y = np.log(places[seen]), np.log(levels[seen])
    spread = float(((x - x.mean()) ** 2).sum())
    slope = float(((x - x.mean()) * (y - y.mean())).sum()) / spread if spread > 0.0 else 1.0
    slope = float(np.clip(slope, 1.0, MAX_EXPONENT))
    return np.exp(np.median(y - slope * x)) * edges**slope


def _quantile(values: NDArray[np.float64], weights: NDArray[np.int64]) -> float:
    """Smallest value such that values up to it have the flat fraction of the weights."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reached, FLAT_FRACTION * reached[-1])])
