# SPDX-License-Identifier: Apache-2.0
"""Learned linkage: the probability of a boundary, fitted on labelled clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.tree.average import average_linkage
from pcgraph.tree.edge_model import EdgeModel, edge_evidence
from pcgraph.tree.growth import segmentation_tree
from pcgraph.tree.leaf_truth import LeafTruth, leaf_truth
from pcgraph.tree.linkage import Linkage, Merges

if TYPE_CHECKING:
    from pcgraph.segmentation import Segmentation

_STEPS = float(1 << 20)
_PURE = 0.8  # share of a supervoxel's points that must agree before an edge at it teaches anything
_PLATEAU = 0.002  # overlap below the best that still counts as best
_ALTITUDES = np.linspace(0.05, 0.95, 37)


@dataclass(frozen=True)
class LearnedLinkage(Linkage):
    """Average linkage of the probability of a boundary, weighted by contact; altitudes are 0..1.

    Attributes
    ----------
    model : EdgeModel
        Logistic regression on `edge_evidence`; its `object_altitude` is the linkage's.

    Notes
    -----
    Few edges are boundaries (1.2 % on tables with things), so both classes weigh the same in the fit. On twelve
    such clouds boosted trees on the same columns did much worse than this linear model (docs/tree.md).
    """

    model: EdgeModel

    def __post_init__(self) -> None:
        if not isinstance(self.model, EdgeModel):
            raise ValueError(f"expected an EdgeModel, got {type(self.model).__name__}; fit one or load it")

    @property
    def object_altitude(self) -> float:  # type: ignore[override]
        """Probability of a boundary above which two parts are two objects: the model's."""
        return self.model.object_altitude

    @property
    def part_altitude(self) -> float:  # type: ignore[override]
        """Half of that: what is learned from are objects, so nothing was learned about parts."""
        return 0.5 * self.model.object_altitude

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the least likely boundary first."""
        costs = np.rint(self.model(graph) * _STEPS) / _STEPS  # whole multiples, so that sums of them are exact
        weights = graph.edge_features.contact_voxels.astype(np.float64)
        return Merges(*average_linkage(graph.n_nodes, graph.edges, costs, weights))

    @classmethod
    def fit(cls, segmentations: Sequence[Segmentation], truths: Sequence[ArrayLike]) -> LearnedLinkage:
        """Linkage fitted on labelled clouds; its `object_altitude` is amid those with the best mean overlap on these.

        Parameters
        ----------
        segmentations : sequence of Segmentation
            Their graphs are what is learned from; the linkage that they were made with does not matter.
        truths : sequence of int arrays
            True object of each point, in the shape of each segmentation's labels; negative where unknown.

        Raises
        ------
        ImportError
            scikit-learn is not installed.
        ValueError
            These are not sequences of one length, shapes do not fit, or the edges are not of both kinds.
        """
        if not isinstance(segmentations, Sequence) or not isinstance(truths, (Sequence, np.ndarray)):
            kinds = f"{type(segmentations).__name__} and {type(truths).__name__}"
            raise ValueError(f"expected a list of segmentations and a list of truths, got {kinds}")
        if len(segmentations) != len(truths) or not len(truths):
            raise ValueError(f"expected a truth for each segmentation, got {len(segmentations)} and {len(truths)}")
        pairs = zip(segmentations, truths, strict=True)
        tables = [leaf_truth(result.supervoxels, truth, result.graph.n_nodes) for result, truth in pairs]
        model = _fit_edges([result.graph for result in segmentations], tables)
        linkage = cls(model)
        trees = [segmentation_tree(linkage.merges(r.graph, r.leaves), r.leaves) for r in segmentations]
        overlaps = [
            [t.overlap(tree.cut(altitude=a)) for a in _ALTITUDES] for tree, t in zip(trees, tables, strict=True)
        ]
        mean = np.mean(overlaps, axis=0)
        best = float(np.median(_ALTITUDES[mean >= mean.max() - _PLATEAU]))  # not the peak: the peak is luck
        return cls(replace(model, object_altitude=best))

    def save(self, path: str | PathLike[str]) -> None:
        """Nothing; writes the model as JSON (`EdgeModel.save`)."""
        self.model.save(path)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> LearnedLinkage:
        """Linkage from a file that `save` wrote; needs no scikit-learn (`EdgeModel.load`)."""
        return cls(EdgeModel.load(path))


def _fit_edges(graphs: list[AdjacencyGraph], tables: list[LeafTruth]) -> EdgeModel:
    try:
        from sklearn.linear_model import LogisticRegression
    except ModuleNotFoundError as error:
        raise ImportError("expected scikit-learn for LearnedLinkage.fit; install the extra `learn`") from error
    evidence, answers = [], []
    for graph, table in zip(graphs, tables, strict=True):
        sides = table.majority(_PURE)[graph.edges]
        known = (sides >= 0).all(axis=1)
        columns = edge_evidence(graph)
        evidence.append(np.stack(list(columns.values()), axis=1)[known])
        answers.append((sides[:, 0] != sides[:, 1])[known])
    rows, boundary = np.concatenate(evidence), np.concatenate(answers)
    if boundary.all() or not boundary.any():
        raise ValueError("expected edges inside objects and edges between them; give clouds where objects touch")
    means, scales = rows.mean(axis=0), rows.std(axis=0)
    scales[scales == 0.0] = 1.0
    regression = LogisticRegression(class_weight="balanced", max_iter=1000).fit((rows - means) / scales, boundary)
    weights, intercept = regression.coef_[0].tolist(), float(regression.intercept_[0])
    return EdgeModel(tuple(columns), tuple(means.tolist()), tuple(scales.tolist()), tuple(weights), intercept, 0.5)
