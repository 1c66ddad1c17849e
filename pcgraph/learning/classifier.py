# SPDX-License-Identifier: Apache-2.0
"""Classes of supervoxels, learned from labelled clouds in scikit-learn's manner."""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.learning.descriptors import leaf_descriptors
from pcgraph.learning.pooling import down
from pcgraph.learning.voting import votes
from pcgraph.segmentation import Segmentation

_TREES = 100


class NodeClassifier:
    """Classifier of supervoxels, whose classes go to their points.

    A supervoxel is described by itself, its neighbours in the graph and its ancestors in the tree; an estimator of
    scikit-learn does the rest. `get_params`, `set_params` and `sklearn.base.clone` work as for its own.

    Parameters
    ----------
    estimator : object with fit(X, y, sample_weight) and predict_proba(X), optional
        It is cloned, not changed. Default: a random forest of 100 trees.
    pose : bool
        Whether height above the ground and slope are told.
    neighbours : int, >= 0
        Rings of neighbours that are told; 0: none.
    ancestors : int, >= 0
        Ancestors that are told; 0: none. See `pcgraph.learning.descriptors.leaf_descriptors`.
    random_state : int
        Seed of the default estimator.

    Attributes
    ----------
    classes_ : (c,) int64
        Labels seen in `fit`, ascending.
    estimator_ : the fitted estimator
    feature_names_ : list of str
    """

    def __init__(
        self,
        estimator: Any = None,
        *,
        pose: bool = True,
        neighbours: int = 1,
        ancestors: int = 3,
        random_state: int = 0,
    ) -> None:
        self.estimator = estimator
        self.pose = pose
        self.neighbours = neighbours
        self.ancestors = ancestors
        self.random_state = random_state

    def fit(
        self,
        segmentations: Segmentation | Sequence[Segmentation],
        truths: ArrayLike | Sequence[ArrayLike],
        ups: ArrayLike | Sequence[ArrayLike] | None = None,
    ) -> NodeClassifier:
        """This classifier, fitted.

        Parameters
        ----------
        segmentations : Segmentation, or a list of them
        truths : the points' leading shape, int, or a list of such
            True label of each point; negative: unlabelled. A supervoxel learns the label most of its points have,
            and counts as many points as have it.
        ups : (3,) float, or a list of such, optional
            Against gravity, in each cloud's frame. Default: the normal of its largest plane.

        Raises
        ------
        ImportError
            scikit-learn is not installed.
        ValueError
            The lists differ in length, or no point is labelled.
        """
        clouds, labels, directions = _listed(segmentations, truths, ups)
        known = [np.unique(truth[truth >= 0]) for truth in labels]
        classes = np.unique(np.concatenate(known)).astype(np.int64)
        if not len(classes):
            raise ValueError("expected at least one labelled point, got only negative labels")
        rows, targets, weights = [], [], []
        for cloud, truth, up in zip(clouds, labels, directions, strict=True):
            number = np.where(truth >= 0, np.searchsorted(classes, truth), -1)
            counts = votes(cloud, number, len(classes))[: cloud.tree.n_leaves]
            voted = counts.any(axis=1)
            table, names = self._describe(cloud, up)
            rows.append(table[voted])
            targets.append(classes[counts[voted].argmax(axis=1)])
            weights.append(counts[voted].max(axis=1))
        self.feature_names_ = names
        self.estimator_ = self._fresh_estimator()
        self.estimator_.fit(np.concatenate(rows), np.concatenate(targets), sample_weight=np.concatenate(weights))
        self.classes_ = np.asarray(self.estimator_.classes_)
        return self

    def predict_nodes(self, segmentation: Segmentation, up: ArrayLike | None = None) -> NDArray[np.float64]:
        """Probability of each class for each supervoxel, (n_leaves, c) float64; parameters as for `predict_proba`.

        Raises
        ------
        ValueError
            `fit` was not called before.
        """
        if not hasattr(self, "estimator_"):
            raise ValueError("expected a fitted classifier, got a new one; call fit first")
        return self.estimator_.predict_proba(self._describe(segmentation, up)[0])

    def predict_proba(self, segmentation: Segmentation, up: ArrayLike | None = None) -> NDArray[np.float64]:
        """Probability of each class at each point, the points' leading shape + (c,); NaN where not finite.

        Parameters
        ----------
        segmentation : Segmentation
        up : (3,) float, optional
            As in `fit`.
        """
        return down(segmentation, self.predict_nodes(segmentation, up))

    def predict(self, segmentation: Segmentation, up: ArrayLike | None = None) -> NDArray[np.int64]:
        """Most probable label of each point, in the points' shape; -1 where not finite; parameters as above."""
        best = self.predict_nodes(segmentation, up).argmax(axis=1)
        return down(segmentation, self.classes_[best])

    def score(
        self,
        segmentations: Segmentation | Sequence[Segmentation],
        truths: ArrayLike | Sequence[ArrayLike],
        ups: ArrayLike | Sequence[ArrayLike] | None = None,
    ) -> float:
        """Share of the labelled points that get their true label, 0..1; parameters as for `fit`."""
        right = total = 0
        for cloud, truth, up in zip(*_listed(segmentations, truths, ups), strict=True):
            known = (truth >= 0) & (cloud.supervoxels >= 0)
            right += int((self.predict(cloud, up)[known] == truth[known]).sum())
            total += int(known.sum())
        if total == 0:
            raise ValueError("expected at least one labelled point, got only negative labels")
        return right / total

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Parameters of the constructor by name; with `deep` also those of the estimator, as estimator__name."""
        own = {name: getattr(self, name) for name in signature(type(self)).parameters}
        if deep and hasattr(self.estimator, "get_params"):
            own |= {f"estimator__{name}": value for name, value in self.estimator.get_params().items()}
        return own

    def set_params(self, **params: Any) -> NodeClassifier:
        """This classifier, after parameters named as in `get_params` were changed.

        Raises
        ------
        ValueError
            There is no parameter of that name, or no estimator to have it.
        """
        known = self.get_params(deep=False)
        inner = {}
        for name, value in params.items():
            if name.startswith("estimator__"):
                inner[name.removeprefix("estimator__")] = value
            elif name in known:
                setattr(self, name, value)
            else:
                raise ValueError(f"expected one of the parameters {', '.join(known)}, got {name!r}")
        if inner and not hasattr(self.estimator, "set_params"):
            raise ValueError(
                f"expected an estimator to set {', '.join(inner)} of, got {self.estimator!r}; give one first"
            )
        if inner:
            self.estimator.set_params(**inner)
        return self

    def _describe(self, segmentation: Segmentation, up: ArrayLike | None) -> tuple[NDArray[np.float64], list[str]]:
        return leaf_descriptors(segmentation, up, pose=self.pose, neighbours=self.neighbours, ancestors=self.ancestors)

    def _fresh_estimator(self) -> Any:
        try:
            from sklearn.base import clone
            from sklearn.ensemble import RandomForestClassifier
        except ImportError as missing:
            raise ImportError("NodeClassifier needs scikit-learn; pip install 'rangesim[learn]'") from missing
        if self.estimator is not None:
            return clone(self.estimator)
        return RandomForestClassifier(_TREES, min_samples_leaf=2, random_state=self.random_state)


def _listed(
    segmentations: Segmentation | Sequence[Segmentation],
    truths: ArrayLike | Sequence[ArrayLike],
    ups: ArrayLike | Sequence[ArrayLike] | None,
) -> tuple[list[Segmentation], list[NDArray[Any]], list[Any]]:
    """Lists of segmentations, truths and directions, also of a single one of each."""
    single = isinstance(segmentations, Segmentation)
    clouds: list[Segmentation] = [segmentations] if isinstance(segmentations, Segmentation) else list(segmentations)
    labels = [np.asarray(truth) for truth in ([truths] if single else list(truths))]  # type: ignore[arg-type]
    directions: list[Any] = [ups] if single else [None] * len(clouds) if ups is None else list(ups)  # type: ignore[arg-type]
    if not clouds or not len(clouds) == len(labels) == len(directions):
        raise ValueError(
            f"expected one truth (and one up, if any) per segmentation, got {len(clouds)} segmentations, "
            f"{len(labels)} truths, {len(directions)} ups"
        )
    for cloud, truth in zip(clouds, labels, strict=True):
        if truth.shape != cloud.supervoxels.shape or truth.dtype.kind not in "iu":
            raise ValueError(
                f"expected a truth of whole numbers of shape {cloud.supervoxels.shape}, got {truth.shape} {truth.dtype}"
            )
    return clouds, labels, directions
