# SPDX-License-Identifier: Apache-2.0
"""Felzenszwalb and Huttenlocher's segmentation as a tree over its scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph, EdgeFeatures
from pcgraph.tree.linkage import Linkage, Merges, check_numbers
from pcgraph.tree.scales import scale_linkage


@dataclass(frozen=True)
class FelzenszwalbLinkage(Linkage):
    """Felzenszwalb and Huttenlocher 2004 over all scales at once; altitudes are their k.

    Attributes
    ----------
    object_altitude, part_altitude : float
        Their k, in units of the edge weight times supervoxels.

    Notes
    -----
    Hierarchy: Guimaraes et al. 2017 (see `pcgraph.tree.scales`). Edge weight: ScanNet's, 1 - n . n' of the
    supervoxels' normals, squared if convex (Dai et al. 2017). A region's size is its number of supervoxels.
    """

    object_altitude: float = 20.0
    part_altitude: float = 0.5

    def __post_init__(self) -> None:
        check_numbers(self)

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the smallest scale first."""
        return Merges(*scale_linkage(graph.n_nodes, graph.edges, normal_contrast(graph.edge_features)))


def normal_contrast(features: EdgeFeatures) -> NDArray[np.float64]:
    """ScanNet's edge weight, (m,) float64, 0..4: 1 - cos of the angle between normals, squared if convex.

    Parameters
    ----------
    features : EdgeFeatures of m edges
    """
    contrast = 1.0 - np.cos(features.normal_angle)
    return np.where(features.convexity > 0.0, contrast**2, contrast)
