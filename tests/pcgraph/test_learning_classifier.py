# SPDX-License-Identifier: Apache-2.0
"""Node classification: what neighbours and ancestors tell, determinism, and the manners of scikit-learn."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from simulated_rooms import room
from sklearn.base import clone
from sklearn.tree import DecisionTreeClassifier

import pcgraph
from pcgraph.learning import NodeClassifier, leaf_descriptors
from pcgraph.learning.descriptors import _climb, _contact_means, _uniform_tops


@pytest.fixture(scope="module")
def rooms():
    """Segmentations, classes and up vectors of four simulated rooms."""
    views = [room(seed, shape=(120, 160)) for seed in range(4)]
    results = [pcgraph.segment(view.points, view.colors) for view in views]
    return results, [view.classes for view in views], [view.up for view in views]


def test_rooms_are_learned_from_rooms(rooms):
    results, classes, ups = rooms
    taught = NodeClassifier().fit(results[:3], classes[:3], ups[:3])
    assert taught.classes_.tolist() == [c for c in range(6) if any((truth == c).any() for truth in classes[:3])]
    floor_and_walls = (classes[3] == 0) | (classes[3] == 1)
    predicted = taught.predict(results[3], ups[3])
    assert np.mean(predicted[floor_and_walls] == classes[3][floor_and_walls]) > 0.97
    guess = np.bincount(classes[3][classes[3] >= 0]).max() / (classes[3] >= 0).sum()
    assert taught.score(results[3], classes[3], ups[3]) > guess + 0.2
    both = taught.score(results[2:], classes[2:], ups[2:])
    parts = [taught.score(results[i], classes[i], ups[i]) for i in (2, 3)]
    sizes = [(classes[i] >= 0).sum() for i in (2, 3)]
    assert both == pytest.approx(np.average(parts, weights=sizes))


def test_probabilities_and_labels_lie_on_the_points(rooms):
    _, classes, ups = rooms
    points = room(0, shape=(120, 160)).points
    points[10:14, 20:30] = np.nan
    holes = pcgraph.segment(points)
    taught = NodeClassifier(DecisionTreeClassifier(random_state=0)).fit(holes, classes[0], ups[0])
    share, labels = taught.predict_proba(holes, ups[0]), taught.predict(holes, ups[0])
    assert share.shape == (*points.shape[:2], len(taught.classes_))
    missing = np.isnan(points[..., 0])
    assert np.array_equal(np.isnan(share[..., 0]), missing)
    assert share[~missing].sum(axis=-1) == pytest.approx(1.0)
    assert np.array_equal(labels == -1, missing)
    assert np.array_equal(taught.classes_[share[~missing].argmax(axis=-1)], labels[~missing])


def test_labels_may_be_any_numbers(rooms):
    results, classes, ups = rooms
    renamed = np.where(classes[0] >= 0, 10 * classes[0] + 7, -3)
    plain = NodeClassifier().fit(results[0], classes[0], ups[0]).predict(results[1], ups[1])
    other = NodeClassifier().fit(results[0], renamed, ups[0]).predict(results[1], ups[1])
    assert np.array_equal(other, np.where(plain >= 0, 10 * plain + 7, -1))


def test_the_same_seed_gives_the_same_answer(rooms):
    results, classes, ups = rooms
    first, second = (NodeClassifier(random_state=3).fit(results[:2], classes[:2], ups[:2]) for _ in range(2))
    assert np.array_equal(first.predict_nodes(results[2], ups[2]), second.predict_nodes(results[2], ups[2]))


def test_params_and_clones():
    inner = DecisionTreeClassifier(max_depth=3)
    classifier = NodeClassifier(inner, neighbours=2)
    assert classifier.get_params(deep=False) == {
        "estimator": inner,
        "pose": True,
        "neighbours": 2,
        "ancestors": 3,
        "random_state": 0,
    }
    twin = clone(classifier)
    assert twin is not classifier
    assert twin.estimator is not inner
    assert twin.get_params()["estimator__max_depth"] == 3
    twin.set_params(ancestors=0, estimator__max_depth=5)
    assert (twin.ancestors, twin.estimator.max_depth, inner.max_depth) == (0, 5, 3)
    with pytest.raises(ValueError, match="neighbours"):
        twin.set_params(neighbors=1)
    with pytest.raises(ValueError, match="estimator"):
        NodeClassifier().set_params(estimator__n=1)


def test_columns_are_named_finite_and_nested(rooms):
    results, _, ups = rooms
    full, names = leaf_descriptors(results[0], ups[0])
    assert full.shape == (results[0].tree.n_leaves, len(names))
    assert len(set(names)) == len(names)
    assert np.isfinite(full).all()
    own, own_names = leaf_descriptors(results[0], ups[0], neighbours=0, ancestors=0)
    assert np.array_equal(own, full[:, : len(own_names)])
    assert not any("height" in name or "level" in name for name in leaf_descriptors(results[0], pose=False)[1])


def test_descriptors_do_not_depend_on_the_order_of_points(boxes):
    points, _, result = boxes
    order = np.random.default_rng(0).permutation(len(points))
    shuffled = pcgraph.segment(points[order], viewpoint=result.viewpoint)
    tables = [leaf_descriptors(s)[0] for s in (result, shuffled)]
    assert np.mean(np.abs(tables[0] - tables[1]) < 1e-5) > 0.99  # fits to exact lines and planes may go either way


def test_one_supervoxel_alone_has_descriptors():
    one = pcgraph.segment([[0.0, 0.0, 1.0]])
    table, names = leaf_descriptors(one)
    assert table.shape == (1, len(names))
    assert np.isfinite(table).all()


def test_contact_means_take_constants_to_themselves(boxes):
    _, _, result = boxes
    mean = _contact_means(result)
    assert mean @ np.ones(result.tree.n_leaves) == pytest.approx(1.0)
    (i, j), length = result.graph.edges.T, result.graph.edge_features.contact_length
    at = ((i == 0) | (j == 0)).nonzero()[0]
    other = np.where(i[at] == 0, j[at], i[at])
    values = np.random.default_rng(0).random(result.tree.n_leaves)
    assert (mean @ values)[0] == pytest.approx(np.average(values[other], weights=length[at]))


def test_climbing_a_tree_drawn_by_hand():
    #      6 (inf)
    #    4     5     leaves 0..3 of 1, 2, 3, 4 points
    #   0 1   2 3
    parents = np.array([4, 4, 5, 5, 6, 6, 6], np.int32)
    counts = np.array([1, 2, 3, 4, 3, 7, 10])
    altitudes = np.array([0, 0, 0, 0, 0.1, 0.2, np.inf])
    assert _climb(parents, altitudes, counts, 3.0)[:4].tolist() == [4, 4, 2, 3]
    assert _climb(parents, altitudes, counts, 100.0)[:4].tolist() == [4, 4, 5, 5]
    altitudes[6] = 0.3
    assert _climb(parents, altitudes, counts, 100.0)[:4].tolist() == [6, 6, 6, 6]
    labels = np.array([8, 8, 5, 6, 2**31 - 1, 2**31 - 1, 2**31 - 1], np.int32)
    highest = np.where(labels < 100, labels, -1).astype(np.int32)
    assert _uniform_tops(parents, labels, highest)[:4].tolist() == [4, 4, 2, 3]


def test_without_scikit_learn_the_error_says_what_to_install(rooms, monkeypatch):
    results, classes, _ = rooms
    monkeypatch.setitem(sys.modules, "sklearn.base", None)
    with pytest.raises(ImportError, match=r"pip install 'rangesim\[learn\]'"):
        NodeClassifier().fit(results[0], classes[0])


def test_scikit_learn_is_loaded_only_when_it_fits():
    code = "from pcgraph.learning import NodeClassifier; NodeClassifier(); import sys; print('sklearn' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


def test_wrong_input_is_refused(rooms):
    results, classes, _ = rooms
    for arguments in ({"neighbours": -1}, {"ancestors": -1}, {"ancestors": "a"}):
        with pytest.raises(ValueError, match="at least 0"):
            leaf_descriptors(results[0], **arguments)
    with pytest.raises(ValueError, match="call fit"):
        NodeClassifier().predict(results[0])
    with pytest.raises(ValueError, match="labelled point"):
        NodeClassifier().fit(results[0], np.full_like(classes[0], -1))
    with pytest.raises(ValueError, match="one truth"):
        NodeClassifier().fit(results[:2], classes[:1])
    with pytest.raises(ValueError, match="shape"):
        NodeClassifier().fit(results[0], classes[0][:5])
