# SPDX-License-Identifier: Apache-2.0
"""Values over the tree, classes of nodes, labels for new points; names load on first use. See docs/learning.md.

Only `NodeClassifier` needs scikit-learn, which is imported when that name is used.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from pcgraph.learning.classifier import NodeClassifier as NodeClassifier
    from pcgraph.learning.descriptors import leaf_descriptors as leaf_descriptors
    from pcgraph.learning.propagation import accumulate as accumulate
    from pcgraph.learning.propagation import accumulate_points as accumulate_points
    from pcgraph.learning.propagation import majority as majority
    from pcgraph.learning.propagation import propagate_labels as propagate_labels
    from pcgraph.learning.propagation import pure_ancestors as pure_ancestors
    from pcgraph.learning.propagation import supervoxels_at as supervoxels_at
    from pcgraph.learning.propagation import unpool as unpool
    from pcgraph.learning.propagation import votes as votes
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "classifier": ["NodeClassifier"],
            "descriptors": ["leaf_descriptors"],
            "propagation": [
                "accumulate",
                "accumulate_points",
                "majority",
                "propagate_labels",
                "pure_ancestors",
                "supervoxels_at",
                "unpool",
                "votes",
            ],
        },
    )
