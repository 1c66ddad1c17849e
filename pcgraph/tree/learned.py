# SPDX-License-Identifier: Apache-2.0
"""Learned linkage: the probability that an edge is a boundary, fitted on labelled clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.boundary import in_whole_steps
from pcgraph.graph.contacts import angle_between
from pcgraph.plumbing.plain_files import read_file, write_file
from pcgraph.rounding import TINY
from pcgraph.tree.average_linkage import average_linkage
from pcgraph.tree.linkage import Linkage, Merges
from pcgraph.tree.tree import segmentation_tree

if TYPE_CHECKING:
    from pcgraph.segmentation import Segmentation

_MIN_AGREEING = 0.8
"""Least fraction of a supervoxel's points that are of one object, so that its edges teach anything. Chosen by eye; not
varied."""
_COVERING_TOLERANCE = 0.002
"""Covering, a fraction, below the best that still counts as best: the altitude is the median of a plateau, because the
peak itself is luck. Chosen by eye; not varied."""
_MAX_NUMBER = 1e100
"""Largest number of a model, of any unit, and one over its least scale, so that a product of three is still finite."""
_ALTITUDES = np.linspace(0.05, 0.95, 37)
"""Altitudes, probabilities, from which that of objects is chosen: steps of 0.025 over nearly all of 0..1."""


@dataclass(frozen=True)
class LearnedLinkage(Linkage):
    """Average linkage by the probability that an edge is a boundary, weighted by contact; altitudes are 0..1.

    Attributes
    ----------
    model : EdgeModel
        Logistic regression on `edge_evidence`; its `object_altitude`, fitted with it, is the linkage's default.

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
    def default_object_altitude(self) -> float:
        """Probability of a boundary above which two parts are two objects: the model's."""
        return self.model.object_altitude

    @property
    def default_part_altitude(self) -> float:
        """Half of the altitude of objects: the truths are objects, so nothing was learned about parts."""
        return 0.5 * self.model.object_altitude

    def merges(self, graph: AdjacencyGraph, leaves: Moments) -> Merges:
        """Merges, the least likely boundary first."""
        weights = graph.edge_features.contact_voxels.astype(np.float64)
        return average_linkage(graph.n_nodes, graph.edges, in_whole_steps(self.model(graph)), weights)

    @classmethod
    def fit(cls, segmentations: Sequence[Segmentation], truths: Sequence[ArrayLike]) -> LearnedLinkage:
        """Linkage fitted on labelled clouds, with the altitude of objects that covers them best on average.

        Parameters
        ----------
        segmentations : sequence of Segmentation
            Only their graphs count; the linkage with which they were made does not matter.
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
        coverings = [
            [t.covering(tree.cut(altitude=a)) for a in _ALTITUDES] for tree, t in zip(trees, tables, strict=True)
        ]
        mean = np.mean(coverings, axis=0)
        best = float(np.median(_ALTITUDES[mean >= mean.max() - _COVERING_TOLERANCE]))
        return cls(msgspec.structs.replace(model, object_altitude=best))

    def save(self, path: str | PathLike[str]) -> None:
        """Write the model as JSON (`EdgeModel.save`)."""
        self.model.save(path)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> LearnedLinkage:
        """Linkage from a file that `save` wrote; needs no scikit-learn (`EdgeModel.load`)."""
        return cls(EdgeModel.load(path))


# --- the model of an edge ---------------------------------------------------------------------------------------------


def edge_evidence(graph: AdjacencyGraph) -> dict[str, NDArray[np.float64]]:
    """Evidence about each edge: columns (m,) float64 by name, independent of the scene's scale.

    Angles are in radians, steps in voxel edges. No column depends on which end of an edge comes first.
    """
    features, nodes = graph.edge_features, graph.node_features
    i, j = graph.edges.T
    apart = nodes.centroid[i] - nodes.centroid[j]
    crease = angle_between(np.cross(nodes.normal[i], nodes.normal[j]), apart)
    apart /= np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), TINY)
    rise_i = np.einsum("ij,ij->i", apart, nodes.normal[i])
    rise_j = -np.einsum("ij,ij->i", apart, nodes.normal[j])
    return {
        "concavity": np.maximum(-features.convexity, 0.0),
        "convexity": np.maximum(features.convexity, 0.0),
        "contact_concavity": np.maximum(-features.contact_convexity, 0.0),
        "contact_convexity": np.maximum(features.contact_convexity, 0.0),
        "normal_angle": features.normal_angle,
        "crease_angle": np.minimum(crease, np.pi - crease),  # between the planes' crease and the line of centroids
        "color_contrast": features.color_contrast,
        "step_voxels": features.step / features.voxel_edge,
        "lower_rise": np.minimum(rise_i, rise_j),  # sines of the angles of that line with the two planes
        "upper_rise": np.maximum(rise_i, rise_j),
    }


class EdgeModel(msgspec.Struct, frozen=True):
    """Logistic regression on standardised evidence, as plain numbers, so that a file of it cannot run code.

    Attributes
    ----------
    names : tuple of str
        Columns of `edge_evidence` that the model uses.
    means, scales, coefficients : tuple of float
        One per name; a value adds coefficient x (value - mean) / scale to the logit.
    intercept : float
    object_altitude : float, 0..1
        Probability of a boundary above which two parts are two objects.
    """

    names: tuple[str, ...]
    means: tuple[float, ...]
    scales: tuple[float, ...]
    coefficients: tuple[float, ...]
    intercept: float
    object_altitude: float

    def __post_init__(self) -> None:
        columns = (self.means, self.scales, self.coefficients)
        numbers = [*self.means, *self.scales, *self.coefficients, self.intercept, self.object_altitude]
        if any(len(column) != len(self.names) for column in columns) or not np.isfinite(numbers).all():
            raise ValueError(f"expected one finite mean, scale and coefficient for each of {len(self.names)} names")
        if not all(scale > 0.0 for scale in self.scales):
            raise ValueError("expected scales above 0; fit the model again")
        bad = [value for value in numbers if abs(value) > _MAX_NUMBER]
        bad += [scale for scale in self.scales if scale < 1.0 / _MAX_NUMBER]
        if bad:
            raise ValueError(
                f"expected numbers up to {_MAX_NUMBER:g}, scales from {1.0 / _MAX_NUMBER:g}, got {bad[0]:g}; "
                "fit the model again"
            )

    def __call__(self, graph: AdjacencyGraph) -> NDArray[np.float64]:
        """Probability of a boundary at each edge, (m,) float64, 0..1.

        Raises
        ------
        ValueError
            The model was fitted on evidence that this version does not know.
        """
        evidence = edge_evidence(graph)
        unknown = sorted(set(self.names) - set(evidence))
        if unknown:
            raise ValueError(f"expected evidence of {sorted(evidence)}, got {unknown}; fit the model again")
        logit = np.full(len(graph.edges), self.intercept)
        for name, mean, scale, weight in zip(self.names, self.means, self.scales, self.coefficients, strict=True):
            logit += weight * (evidence[name] - mean) / scale
        return 0.5 * (1.0 + np.tanh(0.5 * logit))  # the logistic function without overflow

    def save(self, path: str | PathLike[str]) -> None:
        """Write the model as JSON, the whole file or none; an older file of that name is replaced.

        Raises
        ------
        CloudWriteError
            The place cannot be written.
        """
        file = _EdgeModelFile(**msgspec.structs.asdict(self), format="pcgraph edge model 1")
        write_file(Path(path), msgspec.json.format(msgspec.json.encode(file), indent=1), CloudWriteError)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> EdgeModel:
        """Model from a file that `save` wrote.

        Raises
        ------
        CloudReadError
            The file cannot be read.
        ValueError
            The file holds no such model.
        """
        text = read_file(Path(path), CloudReadError)
        try:
            file = msgspec.json.decode(text, type=_EdgeModelFile)
        except RecursionError:
            raise ValueError(
                f"expected JSON that LearnedLinkage.save wrote, got {path}, which is nested too deep"
            ) from None
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            reason = ascii(str(error))[1:-1][:200]  # it may quote the file
            raise ValueError(f"expected JSON that LearnedLinkage.save wrote, got {path}: {reason}") from None
        return cls(**{name: getattr(file, name) for name in cls.__struct_fields__})


class _EdgeModelFile(EdgeModel, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An `EdgeModel` as its file holds it."""

    format: Literal["pcgraph edge model 1"]


def _fit_edges(graphs: list[AdjacencyGraph], tables: list[LeafTruth]) -> EdgeModel:
    try:
        from sklearn.linear_model import LogisticRegression
    except ModuleNotFoundError as error:
        raise ImportError("LearnedLinkage.fit needs scikit-learn; pip install 'rangesim[learn]'") from error
    evidence, answers = [], []
    for graph, table in zip(graphs, tables, strict=True):
        sides = table.majority(_MIN_AGREEING)[graph.edges]
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


# --- true segments of leaves ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LeafTruth:
    """Numbers of points in r pairs of a leaf and a true segment.

    Attributes
    ----------
    leaf, truth : (r,) int64
        Leaf, and true segment, numbered from 0 in ascending order of the true labels.
    points : (r,) int64
        Number of points in both.
    n_leaves : int
    """

    leaf: NDArray[np.int64]
    truth: NDArray[np.int64]
    points: NDArray[np.int64]
    n_leaves: int

    def majority(self, fraction: float) -> NDArray[np.int64]:
        """True segment of each leaf, (n_leaves,) int64; -1 where no segment has this fraction of the leaf's points."""
        order = np.argsort(self.points, kind="stable")
        best, most = np.full(self.n_leaves, -1, np.int64), np.zeros(self.n_leaves)
        best[self.leaf[order]] = self.truth[order]
        most[self.leaf[order]] = self.points[order]
        total = np.bincount(self.leaf, self.points, self.n_leaves)
        return np.where(most >= fraction * np.maximum(total, 1), best, -1)

    def covering(self, segments: NDArray[np.int32]) -> float:
        """Segmentation covering, 0..1, of the true segments by the leaves' segments.

        It equals `pcgraph.metrics.weighted_overlap` of the points, without a pass over the points.

        Parameters
        ----------
        segments : (n_leaves,) int32
        """
        segment, n_true = segments[self.leaf].astype(np.int64), int(self.truth.max()) + 1
        keys, pair = np.unique(segment * n_true + self.truth, return_inverse=True)
        common = np.bincount(pair, self.points)
        found, true = keys // n_true, keys % n_true
        size, extent = np.bincount(segment, self.points), np.bincount(self.truth, self.points)
        best = np.zeros(n_true)
        np.maximum.at(best, true, common / (size[found] + extent[true] - common))
        return float(best @ extent / extent.sum())


def leaf_truth(supervoxels: NDArray[np.int32], truth: ArrayLike, n_leaves: int) -> LeafTruth:
    """Numbers of points in each pair of a leaf and a true segment.

    Parameters
    ----------
    supervoxels : (n,) or (h, w) int32
        Leaf of each point; negative if it has none.
    truth : same shape, int
        True segment of each point; negative if unknown.
    n_leaves : int

    Raises
    ------
    ValueError
        The shapes differ, or the truth is not whole numbers.
    """
    true = np.asarray(truth)
    if true.shape != supervoxels.shape:
        raise ValueError(f"expected a truth of shape {supervoxels.shape}, got {true.shape}")
    if true.dtype.kind not in "iub":
        raise ValueError(f"expected a truth of whole numbers, got {true.dtype}; convert it first")
    both = (true >= 0) & (supervoxels >= 0)
    names, column = np.unique(true[both], return_inverse=True)
    n_true = np.int64(max(len(names), 1))
    keys, points = np.unique(supervoxels[both] * n_true + column, return_counts=True)
    return LeafTruth(keys // n_true, keys % n_true, points, n_leaves)
