# SPDX-License-Identifier: Apache-2.0
"""Planes of a scene: table, floor, walls, as sets of supervoxels."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from pcgraph.detection.boxes import plane_basis
from pcgraph.detection.coplanar import FlatLeaves, absorb, bends, join_planes, numbered
from pcgraph.detection.hulls import outline, smallest_rectangle
from pcgraph.detection.noise import surface_noise
from pcgraph.detection.regions import grow_planes, moments_of_regions
from pcgraph.features.moments import Moments
from pcgraph.features.nodes import node_features, unit_vector
from pcgraph.inputs import positive
from pcgraph.segmentation import Segmentation

NOISE_FACTOR = 3.5  # tolerance over that noise: on real tables no supervoxel is worse
LEAST_TOLERANCE = 0.02  # of a voxel's edge, where there is no noise
MOST_TOLERANCE = 1.0  # of a voxel's edge, where nothing is flat
SHAPELESS = 0.8  # width (standard deviation) over tolerance below which noise decides the normal
MOST_BEND = 0.05  # radians
LEAST_SUPERVOXELS = 8.0
ROLE_ANGLE = np.radians(20.0)


@dataclass(frozen=True)
class Planes:
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
        None of them on a ball or a cylinder: pieces whose normals turn steadily are left out. Without any
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
    leaves = _flat_leaves(segmentation, tolerance, angle)
    leaf_areas = _areas(leaves.moments)
    least = LEAST_SUPERVOXELS * float(np.median(leaf_areas)) if min_area is None else min_area
    regions = _without_bends(leaves, _grown(leaves))
    regions = join_planes(leaves, regions, apart=False)
    if join:
        regions = join_planes(leaves, regions, apart=True)
    big = _region_areas(leaf_areas, regions) >= least
    regions = numbered(np.where(np.append(big, False)[regions], regions, -1).astype(np.int32))
    regions = absorb(leaves, regions, apart=join)
    return _describe(segmentation, leaves, _by_size(leaf_areas, regions), leaf_areas, upwards)


def voxel_edges(segmentation: Segmentation) -> NDArray[np.float64]:
    """Mean edge of each supervoxel's voxels, (n_leaves,) float64, metres."""
    surface, n = segmentation.surface, segmentation.tree.n_leaves
    sums = np.bincount(surface.supervoxels, surface.grid.edge_lengths, n)
    return sums / np.bincount(surface.supervoxels, minlength=n)


def _flat_leaves(segmentation: Segmentation, tolerance: float | None, angle: float) -> FlatLeaves:
    nodes, moments = segmentation.graph.node_features, segmentation.leaves
    n = len(moments)
    edge = voxel_edges(segmentation)
    if tolerance is None:
        noise = surface_noise(nodes.residual, edge, nodes.size)
        tolerances = np.clip(NOISE_FACTOR * noise, LEAST_TOLERANCE * edge, MOST_TOLERANCE * edge)
    else:
        tolerances = np.full(n, positive("tolerance", tolerance))
    middle = np.sqrt(np.maximum(np.linalg.eigvalsh(nodes.covariance)[:, 1], 0.0))
    i, j = segmentation.graph.edges.T
    edges = segmentation.graph.edge_features
    flush = (edges.step <= np.minimum(tolerances[i], tolerances[j])) & (edges.normal_angle <= angle)
    return FlatLeaves(
        moments=moments,
        normals=nodes.normal,
        tolerances=tolerances,
        shapeless=middle < SHAPELESS * tolerances,
        cos_angle=float(np.cos(angle)),
        edges=segmentation.graph.edges,
        flush=flush,
    )


def _grown(leaves: FlatLeaves) -> NDArray[np.int32]:
    n, edges = len(leaves.normals), leaves.edges
    both = np.concatenate((edges, edges[:, ::-1]))
    lists = csr_array((np.tile(1 + leaves.flush, 2), both.T), shape=(n, n))  # 2 where flush: zeros would be dropped
    residual = np.sqrt(np.maximum(np.linalg.eigvalsh(leaves.moments.covariances)[:, 0], 0.0)) / leaves.tolerances
    # In steps, so that the rounding of sums cannot change who comes first.
    order = np.lexsort((np.arange(n), -leaves.moments.counts, np.rint(residual * 16.0)))
    seeds = order[(residual <= 1.0)[order] & ~leaves.shapeless[order]]
    return grow_planes(
        lists.indptr,
        lists.indices,
        lists.data == 2,
        seeds,
        leaves.moments.counts,
        leaves.moments.centroids,
        leaves.moments.scatters,
        leaves.normals,
        leaves.tolerances,
        leaves.shapeless,
        leaves.cos_angle,
    )


def _without_bends(leaves: FlatLeaves, regions: NDArray[np.int32]) -> NDArray[np.int32]:
    p = int(regions.max(initial=-1)) + 1
    if p == 0:
        return regions
    straight = bends(leaves, regions, p) <= MOST_BEND
    return numbered(np.where(np.append(straight, False)[regions], regions, -1).astype(np.int32))


def _areas(leaves: Moments) -> NDArray[np.float64]:
    """Area of each supervoxel, square metres: that of the rectangle with the same variances."""
    variances = np.maximum(np.linalg.eigvalsh(leaves.covariances), 0.0)
    return 12.0 * np.sqrt(variances[:, 1] * variances[:, 2])


def _region_areas(leaf_areas: NDArray[np.float64], regions: NDArray[np.int32]) -> NDArray[np.float64]:
    member = regions >= 0
    return np.bincount(regions[member], leaf_areas[member], int(regions.max(initial=-1)) + 1).astype(np.float64)


def _by_size(leaf_areas: NDArray[np.float64], regions: NDArray[np.int32]) -> NDArray[np.int32]:
    areas = _region_areas(leaf_areas, regions)
    rank = np.empty(len(areas) + 1, np.int32)
    rank[np.argsort(-areas, kind="stable")] = np.arange(len(areas), dtype=np.int32)
    rank[-1] = -1
    return rank[regions]


def _describe(
    segmentation: Segmentation,
    leaves: FlatLeaves,
    regions: NDArray[np.int32],
    leaf_areas: NDArray[np.float64],
    up: NDArray[np.float64] | None,
) -> Planes:
    p = int(regions.max(initial=-1)) + 1
    moments = moments_of_regions(leaves.moments, regions, p)
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
        areas=_region_areas(leaf_areas, regions),
        corners=corners,
        outlines=tuple(outlines),
        roles=roles,
        up=up,
        plane_of_supervoxel=regions,
    )
