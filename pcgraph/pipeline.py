# SPDX-License-Identifier: Apache-2.0
"""From points to supervoxels, graph, tree and objects: a first scan, and those that follow."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.inputs import CleanCloud, Points, as_arrays, clean_cloud, clean_viewpoint, fraction, positive
from pcgraph.scan import Scan, Settings, segmentation
from pcgraph.segmentation import Segmentation
from pcgraph.supervoxels.method import SupervoxelMethod, SurfaceGrowth
from pcgraph.tree.linkage import ConvexityLinkage, Linkage
from pcgraph.voxels.bounds import bounding_box
from pcgraph.voxels.grid import VoxelGrid, voxel_grid, voxel_means
from pcgraph.voxels.spacing import median_spacing
from pcgraph.voxels.union import grid_union
from pcgraph.voxels.warp import choose_warp

VOXELS_PER_SPACING = 3.5
SEEDS_PER_VOXEL = 6.0


def segment(
    points: Points,
    colors: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    viewpoint: ArrayLike | None = None,
    *,
    voxel_size: float | None = None,
    seed_size: float | None = None,
    camera: bool | None = None,
    range_growth: float = 0.0,
    method: SupervoxelMethod | None = None,
    linkage: Linkage | None = None,
    object_altitude: float | None = None,
) -> Segmentation:
    """Segmentation of a point cloud: supervoxels, their adjacency graph, and the tree on it.

    Parameters
    ----------
    points : (n, 3) or (h, w, 3) float or integer, metres, any frame; or a Cloud, or the name of a file
        Of a `Cloud`, and of a file that `read_cloud` reads, colours, normals and viewpoint are used too where none
        are given (not a viewpoint of zeros, which PCD files hold where none is known).
        NaN and infinite points are left out and labelled -1. Organised points (h, w, 3) are taken for a
        camera's image in the camera's frame (z forward) unless `viewpoint` or `camera` say otherwise.
    colors : same shape, uint8 0..255 or float 0..1, optional
    normals : same shape, float, optional
        Outward normals; kept in their direction. Where zero or NaN, and without them, they are estimated.
    viewpoint : (3,) or points' shape float, metres, the points' frame, optional
        Where the sensor stood, for all points or for each; estimated normals point to its side, and convexity
        depends on that. Default: the origin for organised clouds and for clouds whose bounding box leaves the
        origin out; otherwise a place high above (+z) the box.
    voxel_size : float, metres, optional
        Their r. Default: 3.5 times the median distance between nearest points, whatever the unit.
    seed_size : float, metres, optional
        Their R_seed, spacing of supervoxels, at least `voxel_size`. Default: 6 times `voxel_size`.
    camera : bool, optional
        Whether voxels grow in proportion to depth z from the viewpoint, being `voxel_size` at the median
        depth, as a camera's pixels do. Default: organised clouds that lie in front of the one viewpoint, unless
        voxels grow with range. (A missing point stored as (0, 0, 0) lies at the viewpoint: make it NaN.)
    range_growth : float, 0..1, without 1
        Power of the range from the viewpoint with which voxels grow, being `voxel_size` at the median range; for
        scanners, whose points thin out with range. 0.5 keeps near detail and far surfaces in one piece.
    method : SupervoxelMethod, optional
        How voxels become supervoxels; default `SurfaceGrowth()`.
    linkage : Linkage, optional
        How the graph becomes a tree; default `ConvexityLinkage()`, whose altitudes are radians of concavity.
    object_altitude : float, the linkage's unit, optional
        Altitude above which two parts are two objects: the cut that gives `labels`. Default: the linkage's.

    Returns
    -------
    Segmentation
        Every finite point has a supervoxel; the voxels that hold points of a supervoxel are connected
        (26-neighbourhood). The same points give the same supervoxels in any order, and node features up to the
        rounding of sums; the number of threads changes nothing.

    Raises
    ------
    ValueError
        A shape, dtype or value is not as above, or no point is finite.
    CloudReadError
        `points` names a file that cannot be read.

    Notes
    -----
    Supervoxels: Papon et al. 2013 (VCCS). Convexity: Stein et al. 2014 (LCCP).
    """
    points, colors, normals, viewpoint = as_arrays(points, colors, normals, viewpoint)
    settings = Settings.of(method or SurfaceGrowth(), linkage or ConvexityLinkage(), object_altitude)
    cloud = clean_cloud(points, colors, normals)
    position = clean_viewpoint(viewpoint, cloud)
    voxel_size, seed_size = _sizes(cloud, voxel_size, seed_size)
    growth = fraction("range_growth", range_growth)
    warp = choose_warp(
        cloud.points, position, _is_camera(cloud, position, growth) if camera is None else camera, growth
    )
    grid = voxel_grid(cloud.points, cloud.colors, voxel_size, warp)
    scan = Scan(cloud, position, grid, _outside(grid, position), np.full(grid.n_voxels, -1, np.int32), seed_size)
    return segmentation(scan, None, settings)


def update(
    earlier: Segmentation,
    points: Points,
    colors: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    viewpoint: ArrayLike | None = None,
    *,
    method: SupervoxelMethod | None = None,
    linkage: Linkage | None = None,
    object_altitude: float | None = None,
) -> Segmentation:
    """Segmentation of a scene after one more scan of it.

    Supervoxels keep their numbers and what they hold: the new points join those whose voxels they fall into, or
    beside which they lie on the same surface, or found new ones. Graph and tree are made anew, over all that has
    been seen. The points of earlier scans are not needed, and a scan costs time for its own points and for the
    voxels of the scene, not for the points seen before.

    Parameters
    ----------
    earlier : Segmentation
        Of the scans so far; its voxel size, seed size and grid are used again.
    points, colors, normals, viewpoint
        The new scan in the same frame; as for `pcgraph.segment`.
    method, linkage, object_altitude
        As for `pcgraph.segment`; default: those of the earlier scan.

    Returns
    -------
    Segmentation
        `labels` and `supervoxels` are those of the new points; `graph`, `tree` and `surface` those of the whole
        scene. Points of an earlier scan keep their supervoxels, so their objects are now
        ``result.objects[earlier.supervoxels]``.

    Raises
    ------
    ValueError
        As for `pcgraph.segment`; or the earlier scan's voxels grow with a camera's depth and a new point does not
        lie in front of that camera (segment the first scan with ``camera=False``); or one scan has colours and
        the other none.

    Notes
    -----
    Nothing is ever taken away: what has moved between the scans is there twice.
    """
    points, colors, normals, viewpoint = as_arrays(points, colors, normals, viewpoint)
    if object_altitude is None and linkage is None:
        object_altitude = earlier.object_altitude
    settings = Settings.of(method or earlier.method, linkage or earlier.linkage, object_altitude)
    cloud = clean_cloud(points, colors, normals)
    position = clean_viewpoint(viewpoint, cloud)
    before = earlier.surface
    before.grid.warp.check(cloud.points)
    seen = voxel_grid(cloud.points, cloud.colors, before.grid.size, before.grid.warp)
    union = grid_union(before.grid, seen)
    known = np.full(union.grid.n_voxels, -1, np.int32)
    known[union.first] = before.supervoxels
    outside = np.empty((union.grid.n_voxels, 3))
    outside[union.second] = _outside(seen, position)
    outside[union.first] = before.grid.centroids + before.normals * (1e3 * before.grid.edge_lengths)[:, None]
    scan = Scan(cloud, position, union.grid, outside, known, earlier.seed_size)
    return segmentation(scan, earlier, settings)


def _outside(grid: VoxelGrid, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """From where the voxels were seen: one place, (3,), or the mean of those of each voxel's points, (v, 3)."""
    if position.ndim == 1:
        return position
    low, high = bounding_box(position)
    middle, reach = (low + high) / 2.0, max(float((high - low).max()), np.finfo(np.float64).tiny)
    return middle + reach * voxel_means((position - middle) / reach, grid)


def _sizes(cloud: CleanCloud, voxel_size: float | None, seed_size: float | None) -> tuple[float, float]:
    if voxel_size is None:
        spacing = VOXELS_PER_SPACING * median_spacing(cloud.points)
        voxel_size = spacing if seed_size is None else min(spacing, positive("seed_size", seed_size))
    voxel = positive("voxel_size", voxel_size)
    seed = SEEDS_PER_VOXEL * voxel if seed_size is None else positive("seed_size", seed_size)
    if seed < voxel:
        raise ValueError(f"expected seed_size of at least voxel_size, got {seed:g} m < {voxel:g} m")
    return voxel, seed


def _is_camera(cloud: CleanCloud, viewpoint: NDArray[np.float64], range_growth: float) -> bool:
    """Whether a camera at the viewpoint may have taken this as one image."""
    if len(cloud.shape) != 2 or viewpoint.ndim != 1 or range_growth:
        return False
    return bool(cloud.points[:, 2].min() > viewpoint[2])
