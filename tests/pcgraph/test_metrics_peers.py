# SPDX-License-Identifier: Apache-2.0
"""Agreement with libraries nobody here wrote, and laws, on random labellings."""

from __future__ import annotations

import numpy as np
import pytest
from checks import SEEDS
from hypothesis import given, settings
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from pcgraph import metrics

Labels = NDArray[np.int64]
random_cases = settings(max_examples=40, deadline=None)


def labelling(seed: int) -> tuple[Labels, Labels]:
    rng = np.random.default_rng(seed)
    n, found, true = rng.integers(1, 80), rng.integers(1, 12), rng.integers(1, 8)
    return rng.integers(0, found, n), rng.integers(0, true, n)


@given(SEEDS)
@random_cases
def test_scikit_learn_agrees(seed: int):
    cluster = pytest.importorskip("sklearn.metrics", reason="scikit-learn is in the test extra")
    found, true = labelling(seed)
    assert metrics.adjusted_rand_index(found, true) == pytest.approx(cluster.adjusted_rand_score(true, found))
    table = cluster.cluster.contingency_matrix(found, true)
    assert metrics.contingency(found, true).toarray().tolist() == table.tolist()
    halves = metrics.variation_of_information(found, true)
    mutual = cluster.mutual_info_score(true, found)
    entropy = {name: float(_entropy(labels)) for name, labels in (("found", found), ("true", true))}
    assert halves.split == pytest.approx(entropy["found"] - mutual / np.log(2), abs=1e-9)
    assert halves.merge == pytest.approx(entropy["true"] - mutual / np.log(2), abs=1e-9)
    homogeneity, completeness, _ = cluster.homogeneity_completeness_v_measure(true, found)
    assert halves.merge == pytest.approx((1 - homogeneity) * entropy["true"], abs=1e-9)
    assert halves.split == pytest.approx((1 - completeness) * entropy["found"], abs=1e-9)


@given(SEEDS)
@random_cases
def test_scikit_image_agrees(seed: int):
    image = pytest.importorskip("skimage.metrics", reason="scikit-image is in the test extra")
    found, true = labelling(seed)
    halves = metrics.variation_of_information(found, true)
    assert [halves.split, halves.merge] == pytest.approx(image.variation_of_information(true, found), abs=1e-9)
    # Its error is one less the F1 score of pairs in one segment of both, which our table gives as well.
    table = metrics.contingency(found, true).toarray().astype(float)
    together = (table**2).sum() - len(true)
    if together > 0:
        precision = together / ((table.sum(axis=1) ** 2).sum() - len(true))
        recall = together / ((table.sum(axis=0) ** 2).sum() - len(true))
        error, *fractions = image.adapted_rand_error(true, found, ignore_labels=())
        assert sorted(fractions) == pytest.approx(sorted([precision, recall]))
        assert error == pytest.approx(1 - 2 * precision * recall / (precision + recall))


@given(SEEDS)
@random_cases
def test_dense_definitions_agree(seed: int):
    found, true = labelling(seed)
    table = metrics.contingency(found, true).toarray()
    rows, columns, n = table.sum(axis=1), table.sum(axis=0), table.sum()
    overlap = table / (rows[:, None] + columns - table)
    assert metrics.segmentation_covering(found, true) == pytest.approx((overlap.max(axis=0) * columns).sum() / n)
    matched = linear_sum_assignment(overlap * columns, maximize=True)
    assert metrics.segmentation_covering(found, true, matching="one_to_one") == pytest.approx(
        (overlap * columns)[matched].sum() / n
    )
    leak = np.minimum(table, rows[:, None] - table)
    assert metrics.undersegmentation_error(found, true) == pytest.approx(leak.sum() / n)
    touched = ((table > 0) * rows[:, None]).sum(axis=0)
    papon = metrics.undersegmentation_error(found, true, definition="papon")
    assert papon == pytest.approx((touched.sum() - n) / n)
    levinshtein = metrics.undersegmentation_error(found, true, definition="levinshtein")
    assert levinshtein == pytest.approx(((touched - columns) / columns).mean())
    matches = overlap > 0.5
    quality = metrics.panoptic_quality(found, true)
    assert quality.pq == pytest.approx(overlap[matches].sum() / ((len(rows) + len(columns)) / 2))
    assert quality.matches.tolist() == [matches.sum()]


@given(SEEDS)
@random_cases
def test_refining_never_loses_what_segments_can_achieve(seed: int):
    coarse, true = labelling(seed)
    fine = coarse * 3 + np.random.default_rng(seed + 1).integers(0, 3, len(coarse))
    accuracies = [metrics.achievable_segmentation_accuracy(found, true) for found in (fine, coarse)]
    assert accuracies[0] >= accuracies[1]
    for definition in ("papon", "levinshtein"):
        errors = [metrics.undersegmentation_error(found, true, definition=definition) for found in (fine, coarse)]
        assert errors[0] <= errors[1] + 1e-12
    assert metrics.undersegmentation_error(fine, true) <= metrics.undersegmentation_error(coarse, true)
    halves, others = (metrics.variation_of_information(found, true) for found in (fine, coarse))
    assert halves.merge <= others.merge + 1e-12
    assert halves.split >= others.split - 1e-12
    values = np.random.default_rng(seed + 2).normal(size=(len(true), 3))
    assert metrics.explained_variation(values, fine) >= metrics.explained_variation(values, coarse) - 1e-12


@given(SEEDS)
@random_cases
def test_names_of_labels_and_order_of_points_change_nothing(seed: int):
    found, true = labelling(seed)
    rng = np.random.default_rng(seed)
    order, names = rng.permutation(len(true)), rng.permutation(40)
    assert scores(names[found][order], true[order]) == pytest.approx(scores(found, true), abs=1e-12)
    assert scores(found, names[true]) == pytest.approx(scores(found, true), abs=1e-12)


@given(SEEDS)
@random_cases
def test_the_truth_itself_scores_best(seed: int):
    _, true = labelling(seed)
    assert scores(true, true) == pytest.approx([1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0], abs=1e-12)


def scores(found: Labels, true: Labels) -> list[float]:
    halves, quality = metrics.variation_of_information(found, true), metrics.panoptic_quality(found, true)
    return [
        metrics.segmentation_covering(found, true),
        metrics.segmentation_covering(found, true, matching="one_to_one"),
        metrics.achievable_segmentation_accuracy(found, true),
        metrics.adjusted_rand_index(found, true),
        quality.pq,
        quality.rq,
        *(
            metrics.undersegmentation_error(found, true, definition=definition)
            for definition in ("neubert_protzel", "papon", "levinshtein")
        ),
        metrics.oversegmentation_rate(found, true),
        metrics.undersegmentation_rate(found, true),
        halves.split,
        halves.merge,
    ]


def _entropy(labels: Labels) -> float:
    fraction = np.unique(labels, return_counts=True)[1] / len(labels)
    return -(fraction * np.log2(fraction)).sum()
