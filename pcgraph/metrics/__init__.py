# SPDX-License-Identifier: Apache-2.0
"""Metrics of a segmentation against a true one; names load on first use. Definitions and sources: docs/metrics.md."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from pcgraph.metrics.boundary_metrics import NeighbourGraph as NeighbourGraph
    from pcgraph.metrics.boundary_metrics import boundary_precision as boundary_precision
    from pcgraph.metrics.boundary_metrics import boundary_recall as boundary_recall
    from pcgraph.metrics.labellings import PanopticQuality as PanopticQuality
    from pcgraph.metrics.labellings import VariationOfInformation as VariationOfInformation
    from pcgraph.metrics.labellings import achievable_accuracy as achievable_accuracy
    from pcgraph.metrics.labellings import achievable_segmentation_accuracy as achievable_segmentation_accuracy
    from pcgraph.metrics.labellings import adjusted_rand_index as adjusted_rand_index
    from pcgraph.metrics.labellings import contingency as contingency
    from pcgraph.metrics.labellings import oversegmentation_rate as oversegmentation_rate
    from pcgraph.metrics.labellings import panoptic_quality as panoptic_quality
    from pcgraph.metrics.labellings import segmentation_covering as segmentation_covering
    from pcgraph.metrics.labellings import undersegmentation_error as undersegmentation_error
    from pcgraph.metrics.labellings import undersegmentation_rate as undersegmentation_rate
    from pcgraph.metrics.labellings import variation_of_information as variation_of_information
    from pcgraph.metrics.labellings import weighted_overlap as weighted_overlap
    from pcgraph.metrics.level_curves import BestScales as BestScales
    from pcgraph.metrics.level_curves import BoundaryCurve as BoundaryCurve
    from pcgraph.metrics.level_curves import LevelCurve as LevelCurve
    from pcgraph.metrics.level_curves import best_scales as best_scales
    from pcgraph.metrics.level_curves import boundary_curve as boundary_curve
    from pcgraph.metrics.level_curves import level_curve as level_curve
    from pcgraph.metrics.level_curves import level_score as level_score
    from pcgraph.metrics.tree_metrics import FragmentationCurve as FragmentationCurve
    from pcgraph.metrics.tree_metrics import dendrogram_purity as dendrogram_purity
    from pcgraph.metrics.tree_metrics import fragmentation_curve as fragmentation_curve
    from pcgraph.metrics.tree_metrics import tree_oracle as tree_oracle
    from pcgraph.metrics.unsupervised_metrics import compactness as compactness
    from pcgraph.metrics.unsupervised_metrics import explained_variation as explained_variation
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "boundary_metrics": ["NeighbourGraph", "boundary_precision", "boundary_recall"],
            "labellings": [
                "PanopticQuality",
                "VariationOfInformation",
                "achievable_accuracy",
                "achievable_segmentation_accuracy",
                "adjusted_rand_index",
                "contingency",
                "oversegmentation_rate",
                "panoptic_quality",
                "segmentation_covering",
                "undersegmentation_error",
                "undersegmentation_rate",
                "variation_of_information",
                "weighted_overlap",
            ],
            "level_curves": [
                "BestScales",
                "BoundaryCurve",
                "LevelCurve",
                "best_scales",
                "boundary_curve",
                "level_curve",
                "level_score",
            ],
            "tree_metrics": ["FragmentationCurve", "dendrogram_purity", "fragmentation_curve", "tree_oracle"],
            "unsupervised_metrics": ["compactness", "explained_variation"],
        },
    )
