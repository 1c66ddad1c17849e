# SPDX-License-Identifier: Apache-2.0
"""Point clouds as supervoxels, an adjacency graph and a segmentation tree.

Names load on first use, so that ``import pcgraph`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # the module typing would double the time of this import
if TYPE_CHECKING:
    from pcgraph import detection, learning, metrics
    from pcgraph.cloud import Cloud
    from pcgraph.errors import CloudReadError, CloudWriteError, PcgraphError
    from pcgraph.features.moments import Moments
    from pcgraph.features.nodes import NodeFeatures
    from pcgraph.features.primitives import Primitive, Primitives
    from pcgraph.graph.adjacency import AdjacencyGraph, EdgeFeatures
    from pcgraph.graph.boundary import BoundaryCost, BoundaryStrength
    from pcgraph.graph.occlusion import Continuations, Occlusions
    from pcgraph.io import read_cloud, write_segmentation
    from pcgraph.scan import segment, update
    from pcgraph.segmentation import Segmentation
    from pcgraph.supervoxels.method import SupervoxelMethod
    from pcgraph.supervoxels.surface_growth import SurfaceGrowth
    from pcgraph.supervoxels.vccs import Vccs
    from pcgraph.tree.average_linkage import ConvexityLinkage
    from pcgraph.tree.energies import plane_energy, variance_energy
    from pcgraph.tree.felzenszwalb import FelzenszwalbLinkage
    from pcgraph.tree.lccp import LccpLinkage
    from pcgraph.tree.learned import LearnedLinkage
    from pcgraph.tree.least_increase import MumfordShahLinkage, WardLinkage
    from pcgraph.tree.linkage import Linkage, Merges
    from pcgraph.tree.optimal_cut import Energy
    from pcgraph.tree.single_linkage import QuasiFlatLinkage
    from pcgraph.tree.tree import SegmentationTree
    from pcgraph.voxels.surface import Surface

__all__ = [
    "AdjacencyGraph",
    "BoundaryCost",
    "BoundaryStrength",
    "Cloud",
    "CloudReadError",
    "CloudWriteError",
    "Continuations",
    "ConvexityLinkage",
    "EdgeFeatures",
    "Energy",
    "FelzenszwalbLinkage",
    "LccpLinkage",
    "LearnedLinkage",
    "Linkage",
    "Merges",
    "Moments",
    "MumfordShahLinkage",
    "NodeFeatures",
    "Occlusions",
    "PcgraphError",
    "Primitive",
    "Primitives",
    "QuasiFlatLinkage",
    "Segmentation",
    "SegmentationTree",
    "SupervoxelMethod",
    "Surface",
    "SurfaceGrowth",
    "Vccs",
    "WardLinkage",
    "detection",
    "learning",
    "metrics",
    "plane_energy",
    "read_cloud",
    "segment",
    "update",
    "variance_energy",
    "write_segmentation",
]

_SUBPACKAGES = ("detection", "learning", "metrics")

_HOMES = {
    "AdjacencyGraph": "graph.adjacency",
    "BoundaryCost": "graph.boundary",
    "BoundaryStrength": "graph.boundary",
    "Cloud": "cloud",
    "CloudReadError": "errors",
    "CloudWriteError": "errors",
    "Continuations": "graph.occlusion",
    "ConvexityLinkage": "tree.average_linkage",
    "EdgeFeatures": "graph.adjacency",
    "Energy": "tree.optimal_cut",
    "FelzenszwalbLinkage": "tree.felzenszwalb",
    "LccpLinkage": "tree.lccp",
    "LearnedLinkage": "tree.learned",
    "Linkage": "tree.linkage",
    "Merges": "tree.linkage",
    "Moments": "features.moments",
    "MumfordShahLinkage": "tree.least_increase",
    "NodeFeatures": "features.nodes",
    "Occlusions": "graph.occlusion",
    "PcgraphError": "errors",
    "Primitive": "features.primitives",
    "Primitives": "features.primitives",
    "QuasiFlatLinkage": "tree.single_linkage",
    "Segmentation": "segmentation",
    "SegmentationTree": "tree.tree",
    "SupervoxelMethod": "supervoxels.method",
    "Surface": "voxels.surface",
    "SurfaceGrowth": "supervoxels.surface_growth",
    "Vccs": "supervoxels.vccs",
    "WardLinkage": "tree.least_increase",
    "plane_energy": "tree.energies",
    "read_cloud": "io",
    "segment": "scan",
    "update": "scan",
    "variance_energy": "tree.energies",
    "write_segmentation": "io",
}


def __getattr__(name: str) -> object:
    if name in _SUBPACKAGES:
        return import_module(f"pcgraph.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'pcgraph' has no attribute {name!r}")
    return getattr(import_module(f"pcgraph.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
