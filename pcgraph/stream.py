# SPDX-License-Identifier: Apache-2.0
"""Segmentation of a scene scan by scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pcgraph.acquisition.kinds import OrientedPlanes, SeveralScans, acquisition_of, far_along
from pcgraph.acquisition.pixels import with_pixels
from pcgraph.inputs import Features, Points, as_arrays, clean_cloud
from pcgraph.plausibility import warn_of_oversegmentation, warn_of_rounding, warn_of_viewpoint
from pcgraph.scan import Scan, segment_scan
from pcgraph.segmentation import Segmentation, Settings
from pcgraph.supervoxels.method import SupervoxelMethod
from pcgraph.tree.linkage import Linkage
from pcgraph.voxelisation.voxelised import Voxelised, voxelise_beside, without_flying_pixels
from pcgraph.voxels.grid import grid_union


def update(
    earlier: Segmentation,
    points: Points,
    colors: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    viewpoint: ArrayLike | None = None,
    *,
    features: Features = None,
    method: SupervoxelMethod | None = None,
    linkage: Linkage | None = None,
    object_altitude: float | None = None,
) -> Segmentation:
    """Segmentation of a scene after one more scan of it.

    Supervoxels keep their numbers and what they hold: the new points join those whose voxels they fall into, or
    beside which they lie on the same surface, or found new ones. Graph and tree are made anew, over all that has
    been seen. An object keeps its number as long as most of it stays together; the number of an object that has
    joined another is not given to a third. The points of earlier scans are not needed, and a scan costs time for its
    own points and for the voxels of the scene, not for the points seen before.

    Parameters
    ----------
    earlier : Segmentation
        Of the scans so far; its voxel size, seed size and grid are used again.
    points, colors, normals, viewpoint, features
        The new scan in the same frame; as for `pcgraph.segment`. Features are scaled as those of the first scan.
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
        lie in front of that camera (segment the first scan with ``camera=False``); or one scan has colours or
        features and the other none.

    Notes
    -----
    Nothing is ever taken away: what has moved between the scans is there twice. Voxels stay as large as the first scan
    needed, also where that had points far apart and a later one has many.
    """
    if not isinstance(earlier, Segmentation):
        raise ValueError(f"expected the Segmentation of the scans so far, got {type(earlier).__name__}")
    points, colors, normals, viewpoint, features = as_arrays(points, colors, normals, viewpoint, features)
    if object_altitude is None and linkage is None:
        object_altitude = earlier.object_altitude
    settings = Settings.of(
        earlier.method if method is None else method, earlier.linkage if linkage is None else linkage, object_altitude
    )
    cloud = with_pixels(clean_cloud(points, colors, normals, features, earlier.feature_scaling))
    last = acquisition_of(cloud, viewpoint)
    warn_of_rounding(points, cloud, None)  # type: ignore[arg-type]
    before = earlier.surface
    before.grid.warp.check(cloud.points)
    found = voxelise_beside(without_flying_pixels(cloud, last.told.image), before.grid)
    if viewpoint is not None and last.one_viewpoint is not None:
        warn_of_viewpoint(last.one_viewpoint, found.grid)
    union = grid_union(before.grid, found.grid)
    labels = np.full(union.grid.n_voxels, -1, np.int32)
    labels[union.first] = before.supervoxels
    viewpoint_of_voxel, place = np.empty((union.grid.n_voxels, 3)), last.one_viewpoint
    if place is None:
        planes, places = last.oriented(found.cloud, found.grid, settings.method.planes)
        viewpoint_of_voxel[union.second] = far_along(found.grid, planes.normals)
    else:
        viewpoint_of_voxel[union.second], places = place, place[None]
    viewpoint_of_voxel[union.first] = far_along(before.grid, before.normals)
    places = places if earlier.viewpoint.ndim > 1 else np.vstack((places, earlier.viewpoint))
    scan = Scan(
        Voxelised(found.cloud, union.grid),
        SeveralScans.of(earlier.acquisition, last.without_image()),
        OrientedPlanes(settings.method.planes(union.grid, viewpoint_of_voxel), np.unique(places, axis=0)),
        initial_labels=labels,
        seed_size=earlier.seed_size,
    )
    result = segment_scan(scan, earlier, settings)
    warn_of_oversegmentation(len(np.unique(result.objects)), result.tree.n_leaves, union.grid.size)
    return result
