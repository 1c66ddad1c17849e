# SPDX-License-Identifier: Apache-2.0
"""Energies as linkages: Ward's and Mumford and Shah's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.tree.least_increase import Regions, least_increase_linkage
from pcgraph.tree.linkage import Linkage, Merges, check_numbers


@dataclass(frozen=True)
class WardLinkage(Linkage):
    """Ward's linkage along the graph: the merge that adds least to the sum of squares comes first.

    Attributes
    ----------
    position : float, per voxel, >= 0
        Weight of places, in voxel edges.
    normal : float, >= 0
        Weight of unit normals.
    color : float, >= 0
        Weight of colours, 0..1.
    object_altitude, part_altitude : float
        Increase of the sum of squares above which two pieces are two objects, or two parts.

    Notes
    -----
    A merge of A and B costs |A| |B| / (|A| + |B|) ||f_A - f_B||^2 (Ward 1963), where f are weighted means and
    |A| is the number of points over the mean number of points of a supervoxel, so that altitudes do not depend
    on the units of length or the density of points.
    """

    position: float = 0.0
    normal: float = 1.0
    color: float = 0.0
    object_altitude: float = 6.0
    part_altitude: float = 0.5

    def __post_init__(self) -> None:
        check_numbers(self, "position", "normal", "color")

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the smallest increase first."""
        regions = _regions(graph, leaves, self.position, self.normal, self.color, 0.0)
        return Merges(*least_increase_linkage(regions, graph.edges, None))


@dataclass(frozen=True)
class MumfordShahLinkage(Linkage):
    """Merging by Mumford and Shah's energy; altitudes are its scale lambda.

    Attributes
    ----------
    plane : float, per voxel, >= 0
        Weight of distances to a region's least-squares plane, in voxel edges.
    normal, color : float, >= 0
        Weights of unit normals and of colours, 0..1, as piecewise constant data.
    object_altitude, part_altitude : float
        Scale at which objects, or parts, are read off.

    Notes
    -----
    Energy: sum over the regions of |A| (plane^2 mean d^2 + normal^2 var n + color^2 var c) + lambda x length of
    boundaries, in voxel edges. Two regions merge at lambda = increase of the first / length of their contact, the
    smallest first (Koepfler et al. 1994). |A| as for `WardLinkage`.
    """

    plane: float = 1.0
    normal: float = 0.0
    color: float = 0.0
    object_altitude: float = 10.0
    part_altitude: float = 0.1

    def __post_init__(self) -> None:
        check_numbers(self, "plane", "normal", "color")

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the smallest scale first."""
        regions = _regions(graph, leaves, 0.0, self.normal, self.color, self.plane**2)
        lengths = graph.edge_features.contact_voxels / 2.0  # two rims
        return Merges(*least_increase_linkage(regions, graph.edges, lengths))


def _regions(
    graph: AdjacencyGraph, leaves: Moments, position: float, normal: float, color: float, plane: float
) -> Regions:
    """Supervoxels as regions, in lengths of a voxel edge and masses of a mean supervoxel."""
    unit = float(np.median(graph.edge_features.voxel_edge)) if len(graph.edges) else 1.0
    mean_count = leaves.counts.mean()
    centroids = leaves.centroids / unit
    columns: list[NDArray[np.float64]] = []
    if position > 0.0:
        columns.append(position * centroids)
    if normal > 0.0:
        columns.append(normal * graph.node_features.normal)
    if color > 0.0 and leaves.colors is not None:
        columns.append(color * leaves.colors)
    values = np.hstack(columns) if columns else np.zeros((len(leaves), 0))
    return Regions(leaves.counts / mean_count, values, centroids, leaves.scatters / (unit**2 * mean_count), plane)
