# SPDX-License-Identifier: Apache-2.0
"""The clouds of a result or of a scan in pcgraph's viewer, with errors, causes and segmentation as columns."""

from __future__ import annotations

import numpy as np

from pcgraph.cloud import Cloud
from pcgraph.features.moments import moments_of_groups, moments_up_tree
from pcgraph.tree.region_linkage import RegionLinkage
from pcgraph.tree.tree import SegmentationTree
from pcgraph.viewer.cloud_data import Categories, Shown
from pcgraph.viewer.page import views_page
from pcgraph.viewer.tree_data import ShownTree
from rangesim.errors import one_line
from rangesim.report import palette, tables
from rangesim.results.experiment_results import Measurement, Result, Segmentation
from rangesim.results.scan_results import ScanResult

CAUSES = Categories(palette.OUTCOME_NAMES, palette.OUTCOME_COLORS)
STATUS = Categories(list(palette.STATUS_NAMES.values()), palette.STATUS_COLORS)


def render_clouds_page(result: Result) -> str:
    """HTML page with a menu of the clouds of all instruments, in the axes of their cameras.

    Raises
    ------
    ValueError
        The page would be too large for browsers.
    """
    titles = tables.titles(result.measurements)
    return views_page([_shown(m, titles[m.name]) for m in result.measurements], one_line(result.info.scene.name))


def render_scan_clouds_page(result: ScanResult, title: str) -> str:
    """HTML page with the points of all views of a scan, in world coordinates.

    Raises
    ------
    ValueError
        The page would be larger than browsers load.
    """
    clouds = [image.to_point_cloud("world").finite() for image in result.scan.images]
    views = np.repeat(np.arange(1, len(clouds) + 1), [len(cloud.points) for cloud in clouds])
    columns: dict[str, np.ndarray] = {"view": views.astype(np.uint16)}
    intensities = [cloud.intensity for cloud in clouds]
    if all(one is not None for one in intensities):
        columns["intensity"] = np.concatenate([one for one in intensities if one is not None])
    cloud = Cloud(np.concatenate([cloud.points for cloud in clouds]), columns=columns)
    return views_page([Shown("All views", cloud, camera=False)], title)


def _shown(m: Measurement, title: str) -> Shown:
    cloud = m.image.to_point_cloud()
    error_mm = np.where(m.image.valid, 1e3 * (m.image.reading_m - m.true_m), np.nan)
    materials = Categories(
        [*m.truth.material_names, "nothing"],
        np.array([palette.MATERIAL_COLORS.get(n, palette.NO_DATA) for n in (*m.truth.material_names, "")], np.uint8),
    )
    material = np.where(m.truth.material < 0, len(m.truth.material_names), m.truth.material)
    columns: dict[str, np.ndarray] = {
        "intensity": m.image.intensity,
        "error": error_mm.astype(np.float32),
        "cause": palette.outcomes(m),
        "material": material.astype(np.uint8),
        "status": m.image.status.astype(np.uint8),
    }
    tree = None if m.segmentation is None else _tree(m.segmentation, cloud.points)
    return Shown(
        title,
        Cloud(cloud.points, colors=cloud.colors, columns=columns),
        tree,
        camera=True,
        categories={"cause": CAUSES, "material": materials, "status": STATUS},
        units={"error": "mm"},
    )


def _tree(s: Segmentation, points: np.ndarray) -> ShownTree:
    """The stored tree, with moments of the points; the experiment segments with pcgraph's defaults."""
    inside = s.supervoxels >= 0
    leaf, n_leaves = s.supervoxels[inside], (len(s.parents) + 1) // 2
    leaves = moments_of_groups(points[inside].astype(np.float64), None, leaf, n_leaves)
    tree = SegmentationTree(s.parents, s.altitudes, moments_up_tree(leaves, s.parents))
    objects = np.zeros(n_leaves, np.int32)
    objects[leaf] = s.labels[inside]
    linkage = RegionLinkage()
    parts = tree.cut(altitude=min(linkage.default_part_altitude, linkage.default_object_altitude))
    return ShownTree(s.supervoxels, tree, objects, parts, type(linkage).__name__)
