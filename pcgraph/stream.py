# SPDX-License-Identifier: Apache-2.0
"""Segmentation of a scene scan by scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pcgraph.acquisition.kinds import OrientedPlanes, SeveralScans, acquisition_of, far_along
from pcgraph.acquisition.pixels import with_pixels
from pcgraph.history import History
from pcgraph.inputs import Features, Points, as_arrays, clean_cloud, whole_number
from pcgraph.plausibility import warn_of_frame, warn_of_oversegmentation, warn_of_rounding, warn_of_viewpoint
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
    max_age: int | None = None,
    carve_free_space: bool = False,
) -> Segmentation:
    """Segmentation of a scene after one more scan of it.

    Supervoxels keep their points. A new point joins the supervoxel whose voxel it falls into, or one beside it on the
    same surface; other points form new supervoxels. Graph and tree are computed again for all that is remembered. An
    object keeps its number as long as most of it stays together. The number of an object that has joined another is not
    used again. The points of earlier scans are not needed: a scan takes time for its own points and for the voxels of
    the scene. `max_age` and `carve_free_space` forget what is old or has moved away.

    Parameters
    ----------
    earlier : Segmentation
        Of the scans so far; its voxel size, seed size and grid are used again.
    points, colors, normals, viewpoint, features
        The new scan in the same frame; as for `pcgraph.segment`. Features are scaled as those of the first scan.
    method, linkage, object_altitude
        As for `pcgraph.segment`; default: those of the earlier scan.
    max_age : int, >= 0, optional
        Number of scans for which a supervoxel is remembered after a scan last saw it. Older ones are forgotten before
        the new scan is added; 0 forgets all. A stream without end needs a limit, so that time and memory are bounded.
        Default: no limit.
    carve_free_space : bool
        Whether to forget supervoxels that the new scan sees through, because they have moved away. The scan must have
        one viewpoint. True keeps the scene as it is now, False keeps a map of everything that was seen.

    Returns
    -------
    Segmentation
        `labels` and `supervoxels` are those of the new points; `graph`, `tree` and `surface` those of the whole
        scene. If no supervoxel is forgotten, all keep their numbers. The objects of an earlier scan's points are then
        ``result.objects[earlier.supervoxels]``. If some are forgotten, the others are numbered without gaps, in the
        same order; `Segmentation.of_earlier` returns the new numbers. Objects keep their numbers.

    Raises
    ------
    ValueError
        As for `pcgraph.segment`; or the earlier scan's voxels grow with a camera's depth and a new point does not
        lie in front of that camera (segment the first scan with ``camera=False``); or one scan has colours or
        features and the other none. Or `max_age` is not a whole number. Or `carve_free_space` is True, but the new scan
        has no viewpoint, or one for each point.

    Warns
    -----
    CloudWarning
        As `pcgraph.segment`. Also if the new scan sees through most earlier voxels in its view, as it would in another
        frame; this needs one viewpoint.

    Notes
    -----
    A supervoxel is remembered or forgotten as a whole: its points are not kept, so that no part can be subtracted from
    its moments. It is seen through if most of its voxels that nothing nearer hides have a measurement more than two
    voxel edges behind them. A ray that met nothing is no measurement, so supervoxels before the sky stay, and so do
    hidden ones. A still scene loses up to 0.005 of its voxels per scan if poses are right to two voxel edges, its
    leaves and glass up to 0.08 (docs/pcgraph_method.md). Sources: free space as in OctoMap (Hornung et al. 2013), but
    without counts of hits and misses; `max_age` as in trackers such as SORT (Bewley et al. 2016).

    Voxels keep the size that the first scan needed, even where a later scan is denser. Where voxels grow with depth or
    range, these are measured from the first viewpoint. If the sensor moves, segment the first scan with
    ``camera=False, range_growth=0``.

    Examples
    --------
    >>> import numpy as np, pcgraph
    >>> x, y = np.meshgrid(np.linspace(0.0, 1.0, 50), np.linspace(0.0, 1.0, 50))
    >>> patch = np.stack((x, y, np.zeros_like(x)), axis=-1).reshape(-1, 3)
    >>> result = pcgraph.segment(patch, viewpoint=(0.5, 0.5, 2.0))
    >>> for step in range(1, 6):
    ...     moved = patch + np.array([0.5 * step, 0.0, 0.0])
    ...     place = (0.5 + 0.5 * step, 0.5, 2.0)
    ...     result = pcgraph.update(result, moved, viewpoint=place, max_age=1)
    >>> bool(result.surface.grid.centroids[:, 0].min() > 1.8), int(result.ages.max())
    (True, 1)
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
    place, n_gone = last.one_viewpoint, 0
    if carve_free_space and place is None:
        raise ValueError("expected one viewpoint of the new scan to carve free space, got none, or one per point")
    warn_of_rounding(points, cloud, None)  # type: ignore[arg-type]
    earlier.surface.grid.warp.check(cloud.points)
    history = History.of(earlier)
    if max_age is not None:
        history = history.without(history.ages >= whole_number("max_age", max_age, least=0))
    found = voxelise_beside(without_flying_pixels(cloud, last.told.image), history.surface.grid)
    if place is not None:
        order = history.depth_order(place, found.grid)
        n_gone = int(np.count_nonzero(order > 0))
        if carve_free_space:
            history = history.without(history.seen_through(order))
    if viewpoint is not None and place is not None:
        warn_of_viewpoint(place, found.grid)
    before = history.surface
    union = grid_union(before.grid, found.grid)
    n_there = before.grid.n_voxels + found.grid.n_voxels - union.grid.n_voxels
    warn_of_frame(n_gone, n_there, found.grid.n_voxels)
    labels = np.full(union.grid.n_voxels, -1, np.int32)
    labels[union.first] = before.supervoxels
    viewpoint_of_voxel = np.empty((union.grid.n_voxels, 3))
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
    result = segment_scan(scan, history, settings)
    warn_of_oversegmentation(len(np.unique(result.objects)), result.tree.n_leaves, union.grid.size)
    return result
