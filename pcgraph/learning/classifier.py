# SPDX-License-Identifier: Apache-2.0
"""A classifier of supervoxels, learned from labelled clouds, with the interface of scikit-learn."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.learning.classifier_file import StoredForest, decode_classifier, encode_classifier
from pcgraph.learning.descriptors import leaf_descriptors
from pcgraph.learning.propagation import unpool, votes
from pcgraph.plumbing.plain_files import read_file, write_file
from pcgraph.segmentation import Segmentation

try:
    from sklearn.base import BaseEstimator, ClassifierMixin, clone
    from sklearn.utils.validation import check_is_fitted
except ImportError as missing:
    raise ImportError("NodeClassifier needs scikit-learn; pip install 'rangesim[learn]'") from missing


class NodeClassifier(ClassifierMixin, BaseEstimator):
    """Classifier of supervoxels, and so of their points.

    A supervoxel is described by its own features, those of its neighbours in the graph and those of its ancestors in
    the tree. An estimator of scikit-learn classifies these descriptors. A sample, to scikit-learn, is a whole segmented
    cloud: `clone`, `cross_val_score` and `GridSearchCV` take lists of segmentations and of true labels.

    Parameters
    ----------
    estimator : object with fit(X, y, sample_weight) and predict_proba(X), optional
        It is cloned, not changed. Default: a random forest of 100 trees.
    pose : bool
        Whether descriptors have height above the ground and slope.
    neighbours : int, >= 0
        Number of rings of neighbours in the descriptors.
    ancestors : int, >= 0
        Number of ancestors in the descriptors. See `pcgraph.learning.descriptors.leaf_descriptors`.
    random_state : int
        Seed of the default estimator.
    unlabelled : int or str, optional
        Label that means "no label". Default: -1, or "" if labels are text.

    Attributes
    ----------
    classes_ : (c,) int64 or str
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
        unlabelled: int | str | None = None,
    ) -> None:
        self.estimator = estimator
        self.pose = pose
        self.neighbours = neighbours
        self.ancestors = ancestors
        self.random_state = random_state
        self.unlabelled = unlabelled

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
        truths : the points' leading shape, int, bool or str, or a list of such
            True label of each point; `unlabelled` if it has none. A supervoxel has the label of most of its points, and
            counts as the number of points that have it.
        ups : (3,) float, or a list of such, optional
            Direction against gravity, in each cloud's frame. Default: the normal of its largest plane.

        Raises
        ------
        ValueError
            The lists differ in length, labels are neither whole numbers nor text, or no point is labelled.
        """
        clouds, labels, directions = _listed(segmentations, truths, ups)
        known = [truth != self._none(truth) for truth in labels]
        classes = np.unique(np.concatenate([truth[labelled] for truth, labelled in zip(labels, known, strict=True)]))
        if not len(classes):
            raise ValueError(f"expected at least one labelled point, got {self._none(classes)!r} only")
        rows, targets, weights = [], [], []
        for cloud, truth, labelled, up in zip(clouds, labels, known, directions, strict=True):
            number = np.where(labelled, np.searchsorted(classes, truth), -1)
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
        sklearn.exceptions.NotFittedError
            A ValueError: `fit` was not called before.
        ValueError
            The classifier was fitted on descriptors that this version does not have.
        """
        check_is_fitted(self, msg="expected a fitted %(name)s, got a new one; call fit first")
        if not isinstance(segmentation, Segmentation):
            raise ValueError(
                f"expected one Segmentation, as pcgraph.segment returns, got {type(segmentation).__name__}"
            )
        table, names = self._describe(segmentation, up)
        if names != self.feature_names_:
            raise ValueError("expected a classifier of this version's descriptors, got another's; fit it again")
        return self.estimator_.predict_proba(table)

    def predict_proba(self, segmentation: Segmentation, up: ArrayLike | None = None) -> NDArray[np.float64]:
        """Probability of each class at each point, the points' leading shape + (c,); NaN without a supervoxel.

        Parameters
        ----------
        segmentation : Segmentation
        up : (3,) float, optional
            As in `fit`.
        """
        return unpool(segmentation, self.predict_nodes(segmentation, up))

    def predict(self, segmentation: Segmentation, up: ArrayLike | None = None) -> NDArray[Any]:
        """Label of the most probable class at each point, in the points' shape; `unlabelled` without a supervoxel.

        Parameters
        ----------
        segmentation, up : as for `predict_proba`
        """
        number = unpool(segmentation, self.predict_nodes(segmentation, up).argmax(axis=1))
        none = np.asarray([self._none(self.classes_)])  # last, where the -1 of points without a supervoxel points
        return np.concatenate((self.classes_, none))[number]

    def score(
        self,
        segmentations: Segmentation | Sequence[Segmentation],
        truths: ArrayLike | Sequence[ArrayLike],
        ups: ArrayLike | Sequence[ArrayLike] | None = None,
    ) -> float:
        """Fraction of the labelled points that get their true label, 0..1; parameters as for `fit`."""
        right = total = 0
        for cloud, truth, up in zip(*_listed(segmentations, truths, ups), strict=True):
            known = (truth != self._none(truth)) & (cloud.supervoxels >= 0)
            right += int((self.predict(cloud, up)[known] == truth[known]).sum())
            total += int(known.sum())
        if total == 0:
            raise ValueError("expected at least one labelled point, got none")
        return right / total

    def save(self, path: str | PathLike[str]) -> None:
        """Write the fitted classifier as JSON, the whole file or none; an older file of that name is replaced.

        The file holds numbers and names, so loading it runs no code. `load` makes a classifier of it that predicts the
        same. A given `estimator` is not in the file, only the trees that it learned.

        Raises
        ------
        ValueError
            The classifier is not fitted, or its estimator is none of ``RandomForestClassifier``,
            ``ExtraTreesClassifier`` and ``DecisionTreeClassifier``.
        CloudWriteError
            The place cannot be written.
        """
        check_is_fitted(self, msg="expected a fitted %(name)s to save, got a new one; call fit first")
        settings = {name: value for name, value in self.get_params(deep=False).items() if name != "estimator"}
        forest = StoredForest.of(self.estimator_)
        write_file(Path(path), encode_classifier(settings, self.feature_names_, forest), CloudWriteError)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> NodeClassifier:
        """Classifier from a file that `save` wrote.

        Raises
        ------
        CloudReadError
            The file cannot be read.
        ValueError
            The file holds no such classifier.
        """
        settings, names, forest = decode_classifier(read_file(Path(path), CloudReadError), str(path))
        loaded = cls(**settings)
        loaded.feature_names_, loaded.estimator_, loaded.classes_ = names, forest, forest.classes_
        return loaded

    def _none(self, labels: NDArray[Any]) -> int | str:
        """The label that means "no label", of the type of these labels."""
        text = labels.dtype.kind == "U"
        if self.unlabelled is None:
            return "" if text else -1
        if isinstance(self.unlabelled, str) != text:
            kind = "text" if text else "whole numbers"
            raise ValueError(f"expected unlabelled of the labels' kind, {kind}, got {self.unlabelled!r}")
        return self.unlabelled

    def _describe(self, segmentation: Segmentation, up: ArrayLike | None) -> tuple[NDArray[np.float64], list[str]]:
        return leaf_descriptors(segmentation, up, pose=self.pose, neighbours=self.neighbours, ancestors=self.ancestors)

    def _fresh_estimator(self) -> Any:
        if self.estimator is not None:
            return clone(self.estimator)
        from sklearn.ensemble import RandomForestClassifier

        # 100 is the default of scikit-learn; leaves of 2 samples were chosen by eye, and not varied.
        return RandomForestClassifier(100, min_samples_leaf=2, random_state=self.random_state)


def _listed(
    segmentations: Segmentation | Sequence[Segmentation],
    truths: ArrayLike | Sequence[ArrayLike],
    ups: ArrayLike | Sequence[ArrayLike] | None,
) -> tuple[list[Segmentation], list[NDArray[Any]], list[Any]]:
    """Lists of segmentations, truths and directions; a single one of each becomes a list of one."""
    single = isinstance(segmentations, Segmentation)
    clouds: list[Segmentation] = [segmentations] if isinstance(segmentations, Segmentation) else list(segmentations)
    labels = [_labels(truth) for truth in ([truths] if single else list(truths))]  # type: ignore[arg-type]
    directions: list[Any] = [ups] if single else [None] * len(clouds) if ups is None else list(ups)  # type: ignore[arg-type]
    if not clouds or not len(clouds) == len(labels) == len(directions):
        raise ValueError(
            f"expected one truth (and one up, if any) per segmentation, got {len(clouds)} segmentations and "
            f"{len(labels)} truths" + (f", {len(directions)} ups" if ups is not None else "")
        )
    for cloud, truth in zip(clouds, labels, strict=True):
        if truth.shape != cloud.supervoxels.shape:
            raise ValueError(f"expected a truth of the points' shape {cloud.supervoxels.shape}, got {truth.shape}")
    if len({truth.dtype.kind for truth in labels}) > 1:
        raise ValueError("expected labels of one kind, got whole numbers and text")
    return clouds, labels, directions


def _labels(truth: ArrayLike) -> NDArray[Any]:
    """Labels as int64 or text; raises ValueError if they are neither."""
    array = np.asarray(truth)
    if array.dtype.kind == "O" and all(isinstance(label, str) for label in array.flat):
        array = array.astype(str)
    if array.dtype.kind in "iub":
        return array.astype(np.int64)
    if array.dtype.kind not in "UT":
        raise ValueError(f"expected a truth of whole numbers or text, got {array.dtype}; number the classes")
    return array.astype(str)
