# SPDX-License-Identifier: Apache-2.0
"""Point clouds as supervoxels, an adjacency graph and a segmentation tree.

Names load on first use, so that ``import pcgraph`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pcgraph import metrics
    from pcgraph.cloud import Cloud
    from pcgraph.errors import CloudReadError, CloudWriteError, PcgraphError
    from pcgraph.features.moments import Moments
    from pcgraph.features.nodes import NodeFeatures
    from pcgraph.graph.adjacency import AdjacencyGraph, EdgeFeatures
    from pcgraph.graph.boundary import BoundaryCost
    from pcgraph.io import read_cloud, write_segmentation
    from pcgraph.pipeline import segment, update
    from pcgraph.segmentation import Segmentation
    from pcgraph.supervoxels.method import SupervoxelMethod, SurfaceGrowth, Vccs
    from pcgraph.tree.linkage import ConvexityLinkage, Linkage
    from pcgraph.tree.tree import SegmentationTree

__all__ = [
    "AdjacencyGraph",
    "BoundaryCost",
    "Cloud",
    "CloudReadError",
    "CloudWriteError",
    "ConvexityLinkage",
    "EdgeFeatures",
    "Linkage",
    "Moments",
    "NodeFeatures",
    "PcgraphError",
    "Segmentation",
    "SegmentationTree",
    "SupervoxelMethod",
    "SurfaceGrowth",
    "Vccs",
    "metrics",
    "read_cloud",
    "segment",
    "update",
    "write_segmentation",
]

_HOMES = {
    "AdjacencyGraph": "graph.adjacency",
    "BoundaryCost": "graph.boundary",
    "Cloud": "cloud",
    "CloudReadError": "errors",
    "CloudWriteError": "errors",
    "ConvexityLinkage": "tree.linkage",
    "EdgeFeatures": "graph.adjacency",
    "Linkage": "tree.linkage",
    "Moments": "features.moments",
    "NodeFeatures": "features.nodes",
    "PcgraphError": "errors",
    "Segmentation": "segmentation",
    "SegmentationTree": "tree.tree",
    "SupervoxelMethod": "supervoxels.method",
    "SurfaceGrowth": "supervoxels.method",
    "Vccs": "supervoxels.method",
    "read_cloud": "io",
    "segment": "pipeline",
    "update": "pipeline",
    "write_segmentation": "io",
}


def __getattr__(name: str) -> object:
    if name == "metrics":
        return import_module("pcgraph.metrics")
    if name not in _HOMES:
        raise AttributeError(f"module 'pcgraph' has no attribute {name!r}")
    return getattr(import_module(f"pcgraph.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
