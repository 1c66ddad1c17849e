# SPDX-License-Identifier: Apache-2.0
"""Point clouds as supervoxels, an adjacency graph and a segmentation tree.

Names load on first use, so that ``import pcgraph`` costs nothing. Type checkers and editors read the first block.
"""

from __future__ import annotations

__version__ = "0.1.0"

TYPE_CHECKING = False  # the module typing would double the time of this import
if TYPE_CHECKING:
    from pcgraph import detection as detection
    from pcgraph import learning as learning
    from pcgraph import metrics as metrics
    from pcgraph import viewer as viewer
    from pcgraph.acquisition.kinds import Acquisition as Acquisition
    from pcgraph.cloud import Cloud as Cloud
    from pcgraph.cloud_sources import as_cloud as as_cloud
    from pcgraph.columns import RobustScaling as RobustScaling
    from pcgraph.errors import CloudReadError as CloudReadError
    from pcgraph.errors import CloudWriteError as CloudWriteError
    from pcgraph.errors import PcgraphError as PcgraphError
    from pcgraph.features.moments import Moments as Moments
    from pcgraph.features.nodes import NodeFeatures as NodeFeatures
    from pcgraph.features.primitives import Primitive as Primitive
    from pcgraph.features.primitives import Primitives as Primitives
    from pcgraph.graph.adjacency import AdjacencyGraph as AdjacencyGraph
    from pcgraph.graph.adjacency import Bridges as Bridges
    from pcgraph.graph.adjacency import EdgeFeatures as EdgeFeatures
    from pcgraph.graph.adjacency import Gaps as Gaps
    from pcgraph.graph.boundary import BoundaryCost as BoundaryCost
    from pcgraph.graph.boundary import BoundaryStrength as BoundaryStrength
    from pcgraph.graph.continuations import Continuations as Continuations
    from pcgraph.graph.occlusion import Occlusions as Occlusions
    from pcgraph.io import read_cloud as read_cloud
    from pcgraph.io import sample_surface as sample_surface
    from pcgraph.io import write_cloud as write_cloud
    from pcgraph.labelling import labelled_cloud as labelled_cloud
    from pcgraph.labelling import write_segmentation as write_segmentation
    from pcgraph.plausibility import CloudWarning as CloudWarning
    from pcgraph.saved_segmentation import load_segmentation as load_segmentation
    from pcgraph.scan import segment as segment
    from pcgraph.scan import supervoxel_clustering as supervoxel_clustering
    from pcgraph.segmentation import Segmentation as Segmentation
    from pcgraph.segmentation import Supervoxels as Supervoxels
    from pcgraph.stream import update as update
    from pcgraph.supervoxels.method import SupervoxelMethod as SupervoxelMethod
    from pcgraph.supervoxels.surface_growth import SurfaceGrowth as SurfaceGrowth
    from pcgraph.supervoxels.vccs import Vccs as Vccs
    from pcgraph.tree.average_linkage import ConvexityLinkage as ConvexityLinkage
    from pcgraph.tree.energies import plane_energy as plane_energy
    from pcgraph.tree.energies import variance_energy as variance_energy
    from pcgraph.tree.felzenszwalb import FelzenszwalbLinkage as FelzenszwalbLinkage
    from pcgraph.tree.lccp import LccpLinkage as LccpLinkage
    from pcgraph.tree.learned import EdgeModel as EdgeModel
    from pcgraph.tree.learned import LearnedLinkage as LearnedLinkage
    from pcgraph.tree.least_increase import MumfordShahLinkage as MumfordShahLinkage
    from pcgraph.tree.least_increase import WardLinkage as WardLinkage
    from pcgraph.tree.linkage import Linkage as Linkage
    from pcgraph.tree.linkage import Merges as Merges
    from pcgraph.tree.optimal_cut import Energy as Energy
    from pcgraph.tree.region_linkage import RegionLinkage as RegionLinkage
    from pcgraph.tree.single_linkage import QuasiFlatLinkage as QuasiFlatLinkage
    from pcgraph.tree.tree import SegmentationTree as SegmentationTree
    from pcgraph.tree.weighted_graph import tree_of_graph as tree_of_graph
    from pcgraph.voxels.grid import VoxelGrid as VoxelGrid
    from pcgraph.voxels.surface import LocalPlanes as LocalPlanes
    from pcgraph.voxels.surface import Surface as Surface
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submodules={"detection", "learning", "metrics", "viewer"},
        submod_attrs={
            "acquisition.kinds": ["Acquisition"],
            "cloud": ["Cloud"],
            "cloud_sources": ["as_cloud"],
            "columns": ["RobustScaling"],
            "errors": ["CloudReadError", "CloudWriteError", "PcgraphError"],
            "features.moments": ["Moments"],
            "features.nodes": ["NodeFeatures"],
            "features.primitives": ["Primitive", "Primitives"],
            "graph.adjacency": ["AdjacencyGraph", "Bridges", "EdgeFeatures", "Gaps"],
            "graph.boundary": ["BoundaryCost", "BoundaryStrength"],
            "graph.continuations": ["Continuations"],
            "graph.occlusion": ["Occlusions"],
            "io": ["read_cloud", "sample_surface", "write_cloud"],
            "labelling": ["labelled_cloud", "write_segmentation"],
            "plausibility": ["CloudWarning"],
            "saved_segmentation": ["load_segmentation"],
            "scan": ["segment", "supervoxel_clustering"],
            "segmentation": ["Segmentation", "Supervoxels"],
            "stream": ["update"],
            "supervoxels.method": ["SupervoxelMethod"],
            "supervoxels.surface_growth": ["SurfaceGrowth"],
            "supervoxels.vccs": ["Vccs"],
            "tree.average_linkage": ["ConvexityLinkage"],
            "tree.energies": ["plane_energy", "variance_energy"],
            "tree.felzenszwalb": ["FelzenszwalbLinkage"],
            "tree.lccp": ["LccpLinkage"],
            "tree.learned": ["EdgeModel", "LearnedLinkage"],
            "tree.least_increase": ["MumfordShahLinkage", "WardLinkage"],
            "tree.linkage": ["Linkage", "Merges"],
            "tree.optimal_cut": ["Energy"],
            "tree.region_linkage": ["RegionLinkage"],
            "tree.single_linkage": ["QuasiFlatLinkage"],
            "tree.tree": ["SegmentationTree"],
            "tree.weighted_graph": ["tree_of_graph"],
            "voxels.grid": ["VoxelGrid"],
            "voxels.surface": ["LocalPlanes", "Surface"],
        },
    )
