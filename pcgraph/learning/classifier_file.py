# SPDX-License-Identifier: Apache-2.0
"""A fitted classifier of nodes as a file of plain numbers: decision trees as JSON, which cannot run code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from pcgraph.plumbing.short_repr import ShortRepr

_FORMAT = "pcgraph node classifier 1"
_WRITE = "write it with NodeClassifier.save"


@dataclass(frozen=True, eq=False)
class StoredForest(ShortRepr):
    """Decision trees whose mean is the probability of each class; predicts as scikit-learn's estimator did.

    Attributes
    ----------
    classes_ : (c,) int64 or str
    starts : (t + 1,) int64
        Nodes of tree i are ``starts[i] : starts[i + 1]``, its root first.
    left, right : (n,) int64
        Children, numbered within their tree and larger than the node; -1 at leaves.
    features : (n,) int64
        Column that each node compares.
    thresholds : (n,) float64
        Rows with at most this value in that column go left.
    fractions : (n, c) float64, 0..1
        Fraction of each class at each node.
    """

    classes_: NDArray[Any]
    starts: NDArray[np.int64]
    left: NDArray[np.int64]
    right: NDArray[np.int64]
    features: NDArray[np.int64]
    thresholds: NDArray[np.float64]
    fractions: NDArray[np.float64]

    @classmethod
    def of(cls, estimator: Any) -> StoredForest:
        """Trees of a fitted estimator of scikit-learn, or a stored forest itself; ValueError if it has no trees."""
        from sklearn.ensemble import ExtraTreesClassifier, RandomForestClassifier
        from sklearn.tree import DecisionTreeClassifier

        if isinstance(estimator, StoredForest):
            return estimator
        if isinstance(estimator, (RandomForestClassifier, ExtraTreesClassifier)):
            trees = [tree.tree_ for tree in estimator.estimators_]
        elif isinstance(estimator, DecisionTreeClassifier):
            trees = [estimator.tree_]
        else:
            raise ValueError(
                f"expected a classifier of decision trees to save, got {type(estimator).__name__}; "
                "use a RandomForestClassifier, or keep the estimator by means of its own"
            )
        return cls(
            np.asarray(estimator.classes_),
            np.cumsum([0, *(tree.node_count for tree in trees)]),
            np.concatenate([tree.children_left for tree in trees]).astype(np.int64),
            np.concatenate([tree.children_right for tree in trees]).astype(np.int64),
            np.maximum(np.concatenate([tree.feature for tree in trees]), 0).astype(np.int64),
            np.concatenate([np.where(tree.children_left < 0, 0.0, tree.threshold) for tree in trees]),
            np.concatenate([tree.value[:, 0, :] for tree in trees]),
        )

    def predict_proba(self, table: NDArray[np.float64]) -> NDArray[np.float64]:
        """Probability of each class for each row of descriptors, (m, c) float64."""
        with np.errstate(over="ignore"):
            rows = table.astype(np.float32)  # scikit-learn compares float32, too
        total = np.zeros((len(rows), len(self.classes_)))
        for first, last in zip(self.starts[:-1], self.starts[1:], strict=True):
            nodes = slice(first, last)
            total += self.fractions[nodes][_leaf(rows, self.left[nodes], self.right[nodes], self.features[nodes],
                                                 self.thresholds[nodes])]  # fmt: skip
        return total / (len(self.starts) - 1)


def _leaf(
    rows: NDArray[np.float32],
    left: NDArray[np.int64],
    right: NDArray[np.int64],
    features: NDArray[np.int64],
    thresholds: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Leaf of one tree for each row, (m,); the loop ends, because children have larger numbers."""
    node = np.zeros(len(rows), np.int64)
    descending = np.arange(len(rows)) if left[0] >= 0 else np.empty(0, np.int64)
    while len(descending):
        at = node[descending]
        low = rows[descending, features[at]] <= thresholds[at]
        node[descending] = np.where(low, left[at], right[at])
        descending = descending[left[node[descending]] >= 0]
    return node


class _Settings(msgspec.Struct, forbid_unknown_fields=True):
    """Arguments of the constructor of `NodeClassifier`."""

    pose: bool
    neighbours: int
    ancestors: int
    random_state: int | None
    unlabelled: int | str | None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """Contents of the JSON file; the lists are the arrays of `StoredForest`."""

    format: str
    settings: _Settings
    feature_names: list[str]
    classes: list[int | str]
    starts: list[int]
    left: list[int]
    right: list[int]
    features: list[int]
    thresholds: list[float]
    fractions: list[list[float]]


def encode_classifier(settings: dict[str, Any], names: list[str], forest: StoredForest) -> bytes:
    """JSON of a fitted classifier: its settings, the names of its descriptors, and its trees."""
    columns = {name: getattr(forest, name).tolist() for name in StoredForest.__annotations__ if name != "classes_"}
    given = {"settings": settings, "feature_names": names, "classes": forest.classes_.tolist(), **columns}
    try:
        return msgspec.json.encode(msgspec.convert({"format": _FORMAT, **given}, _File))
    except msgspec.ValidationError as error:
        raise ValueError(f"expected a classifier with plain settings to save: {error}") from None


def decode_classifier(content: bytes, name: str) -> tuple[dict[str, Any], list[str], StoredForest]:
    """Settings, names of descriptors and trees of a file; raises ValueError if `save` did not write it."""
    try:
        # The format is checked first, because a file of a later version may have other fields.
        said = msgspec.json.decode(content, type=dict[str, msgspec.Raw]).get("format")
        if said is None or msgspec.json.decode(said) != _FORMAT:
            raise ValueError(f"it is not of the format {_FORMAT!r}")
        file = msgspec.json.decode(content, type=_File)
        forest = _forest(file)
    except (msgspec.DecodeError, RecursionError, OverflowError, ValueError) as error:
        reason = ascii(str(error))[1:-1][:200]  # it may quote the file
        raise ValueError(f"expected a classifier of nodes in {name}: {reason}; {_WRITE}") from None
    settings = {field: getattr(file.settings, field) for field in _Settings.__struct_fields__}
    return settings, file.feature_names, forest


def _forest(file: _File) -> StoredForest:
    """The trees of a file, after checks of every index."""
    starts, left, right, features = (
        np.array(column, np.int64).reshape(-1) for column in (file.starts, file.left, file.right, file.features)
    )
    thresholds, c = np.array(file.thresholds, np.float64), len(file.classes)
    if any(len(row) != c for row in file.fractions):
        raise ValueError("a node has not one fraction per class")
    fractions = np.array(file.fractions, np.float64).reshape(-1, c) if c else np.empty((0, 0))
    n, text = len(left), isinstance(file.classes[0], str) if c else False
    if any(isinstance(label, str) != text for label in file.classes):
        raise ValueError("its classes are numbers and text")
    classes = np.array(file.classes, str if text else np.int64)
    if not c or len(set(file.classes)) < c:
        raise ValueError("its classes are missing or named twice")
    if not len(right) == len(features) == len(thresholds) == len(fractions) == n:
        raise ValueError("its columns differ in length")
    if len(starts) < 2 or starts[0] != 0 or starts[-1] != n or (np.diff(starts) < 1).any():
        raise ValueError("its trees do not follow one another")
    size = np.repeat(np.diff(starts), np.diff(starts))
    number = np.arange(n) - np.repeat(starts[:-1], np.diff(starts))
    inner = left >= 0
    children = np.stack((left, right))
    if not ((children[:, inner] > number[inner]) & (children[:, inner] < size[inner])).all():
        raise ValueError("a child does not come after its parent in a tree")
    if (children[:, ~inner] != -1).any():
        raise ValueError("a node has one child")
    if ((features < 0) | (features >= len(file.feature_names))).any() or not np.isfinite(thresholds).all():
        raise ValueError("a node asks for no descriptor")
    if not ((fractions >= 0.0) & (fractions <= 1.0)).all():
        raise ValueError("a fraction is not within 0..1")
    rings = (file.settings.neighbours, file.settings.ancestors)
    if min(rings) < 0 or sum(rings) > len(file.feature_names):
        raise ValueError("its neighbours and ancestors do not fit its descriptors")
    return StoredForest(classes, starts, left, right, features, thresholds, fractions)
