# SPDX-License-Identifier: Apache-2.0
"""Pooling over the tree, classes of nodes, labels for new points; names load on first use. See docs/learning.md."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pcgraph.learning.classifier import NodeClassifier
    from pcgraph.learning.descriptors import leaf_descriptors
    from pcgraph.learning.pooling import down, pool_points, pool_up
    from pcgraph.learning.transfer import supervoxels_at
    from pcgraph.learning.voting import majority, pure_ancestors, spread_votes, votes

__all__ = [
    "NodeClassifier",
    "down",
    "leaf_descriptors",
    "majority",
    "pool_points",
    "pool_up",
    "pure_ancestors",
    "spread_votes",
    "supervoxels_at",
    "votes",
]

_HOMES = {
    "NodeClassifier": "classifier",
    "down": "pooling",
    "leaf_descriptors": "descriptors",
    "majority": "voting",
    "pool_points": "pooling",
    "pool_up": "pooling",
    "pure_ancestors": "voting",
    "spread_votes": "voting",
    "supervoxels_at": "transfer",
    "votes": "voting",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'pcgraph.learning' has no attribute {name!r}")
    return getattr(import_module(f"pcgraph.learning.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
