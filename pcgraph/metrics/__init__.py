# SPDX-License-Identifier: Apache-2.0
"""How well a segmentation fits a true one; names load on first use. Definitions and sources: docs/metrics.md."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pcgraph.metrics.boundaries import NeighbourGraph, boundary_precision, boundary_recall
    from pcgraph.metrics.overlap import achievable_accuracy, contingency, undersegmentation_error, weighted_overlap

__all__ = [
    "NeighbourGraph",
    "achievable_accuracy",
    "boundary_precision",
    "boundary_recall",
    "contingency",
    "undersegmentation_error",
    "weighted_overlap",
]

_HOMES = {
    "NeighbourGraph": "boundaries",
    "achievable_accuracy": "overlap",
    "boundary_precision": "boundaries",
    "boundary_recall": "boundaries",
    "contingency": "overlap",
    "undersegmentation_error": "overlap",
    "weighted_overlap": "overlap",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'pcgraph.metrics' has no attribute {name!r}")
    return getattr(import_module(f"pcgraph.metrics.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
