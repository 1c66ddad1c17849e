# SPDX-License-Identifier: Apache-2.0
"""How well a segmentation fits a true one; names load on first use. Definitions and sources: docs/metrics.md."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pcgraph.metrics.boundaries import boundary_precision, boundary_recall
    from pcgraph.metrics.boundary_levels import BoundaryCurve, boundary_curve
    from pcgraph.metrics.circularity import compactness
    from pcgraph.metrics.explained import explained_variation
    from pcgraph.metrics.fragmentation import FragmentationCurve, fragmentation_curve
    from pcgraph.metrics.information import VariationOfInformation, variation_of_information
    from pcgraph.metrics.levels import LevelCurve, level_curve
    from pcgraph.metrics.neighbours import NeighbourGraph
    from pcgraph.metrics.oracle import dendrogram_purity, tree_oracle
    from pcgraph.metrics.overlap import (
        achievable_accuracy,
        oversegmentation_rate,
        undersegmentation_rate,
        weighted_overlap,
    )
    from pcgraph.metrics.panoptic import PanopticQuality, panoptic_quality
    from pcgraph.metrics.rand_index import adjusted_rand_index
    from pcgraph.metrics.scales import BestScales, best_scales
    from pcgraph.metrics.table import contingency
    from pcgraph.metrics.undersegmentation import undersegmentation_error

__all__ = [
    "BestScales",
    "BoundaryCurve",
    "FragmentationCurve",
    "LevelCurve",
    "NeighbourGraph",
    "PanopticQuality",
    "VariationOfInformation",
    "achievable_accuracy",
    "adjusted_rand_index",
    "best_scales",
    "boundary_curve",
    "boundary_precision",
    "boundary_recall",
    "compactness",
    "contingency",
    "dendrogram_purity",
    "explained_variation",
    "fragmentation_curve",
    "level_curve",
    "oversegmentation_rate",
    "panoptic_quality",
    "tree_oracle",
    "undersegmentation_error",
    "undersegmentation_rate",
    "variation_of_information",
    "weighted_overlap",
]

_HOMES = {
    "BestScales": "scales",
    "BoundaryCurve": "boundary_levels",
    "FragmentationCurve": "fragmentation",
    "LevelCurve": "levels",
    "NeighbourGraph": "neighbours",
    "PanopticQuality": "panoptic",
    "VariationOfInformation": "information",
    "achievable_accuracy": "overlap",
    "adjusted_rand_index": "rand_index",
    "best_scales": "scales",
    "boundary_curve": "boundary_levels",
    "boundary_precision": "boundaries",
    "boundary_recall": "boundaries",
    "compactness": "circularity",
    "contingency": "table",
    "dendrogram_purity": "oracle",
    "explained_variation": "explained",
    "fragmentation_curve": "fragmentation",
    "level_curve": "levels",
    "oversegmentation_rate": "overlap",
    "panoptic_quality": "panoptic",
    "tree_oracle": "oracle",
    "undersegmentation_error": "undersegmentation",
    "undersegmentation_rate": "overlap",
    "variation_of_information": "information",
    "weighted_overlap": "overlap",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'pcgraph.metrics' has no attribute {name!r}")
    return getattr(import_module(f"pcgraph.metrics.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
