# SPDX-License-Identifier: Apache-2.0
"""Node classification: what neighbours and ancestors tell, determinism, and the manners of scikit-learn.

It takes a second to import, so tests do that themselves: not every worker runs one of them.
"""

from __future__ import annotations

import importlib
import json

import numpy as np
import pytest
from scenes.rooms import view_of_a_room

import pcgraph
from pcgraph import learning
from pcgraph.learning import leaf_descriptors
from pcgraph.learning.descriptors import _climb, _contact_means, _uniform_tops

SHAPE = (120, 160)


@pytest.fixture(scope="module")
def rooms():
    """Segmentations, classes and up vectors of four simulated rooms."""
    views = [view_of_a_room(seed, SHAPE) for seed in range(4)]
    results = [pcgraph.segment(view.points, view.colors) for view in views]
    return results, [view.classes for view in views], [view.up for view in views]


@pytest.mark.validation
def test_rooms_are_learned_from_rooms(rooms):
    results, classes, ups = rooms
    taught = learning.NodeClassifier().fit(results[:3], classes[:3], ups[:3])
    assert taught.classes_.tolist() == [c for c in range(6) if any((truth == c).any() for truth in classes[:3])]
    floor_and_walls = (classes[3] == 0) | (classes[3] == 1)
    predicted = taught.predict(results[3], ups[3])
    assert np.mean(predicted[floor_and_walls] == classes[3][floor_and_walls]) > 0.97
    guess = np.bincount(classes[3][classes[3] >= 0]).max() / (classes[3] >= 0).sum()
    assert taught.score(results[3], classes[3], ups[3]) > guess + 0.2
    both = taught.score(results[2:], classes[2:], ups[2:])
    parts = [taught.score(results[i], classes[i], ups[i]) for i in (2, 3)]
    sizes = [((classes[i] >= 0) & (results[i].labels >= 0)).sum() for i in (2, 3)]
    assert both == pytest.approx(np.average(parts, weights=sizes))


def test_probabilities_and_labels_lie_on_the_points(rooms):
    from sklearn.tree import DecisionTreeClassifier

    _, classes, ups = rooms
    points = view_of_a_room(0, SHAPE).points
    points[10:14, 20:30] = np.nan
    holes = pcgraph.segment(points)
    taught = learning.NodeClassifier(DecisionTreeClassifier(random_state=0)).fit(holes, classes[0], ups[0])
    share, labels = taught.predict_proba(holes, ups[0]), taught.predict(holes, ups[0])
    assert share.shape == (*points.shape[:2], len(taught.classes_))
    missing = holes.labels < 0
    assert missing[np.isnan(points[..., 0])].all()
    assert np.mean(missing) < np.mean(np.isnan(points[..., 0])) + 0.01
    assert np.array_equal(np.isnan(share[..., 0]), missing)
    assert share[~missing].sum(axis=-1) == pytest.approx(1.0)
    assert np.array_equal(labels == -1, missing)
    assert np.array_equal(taught.classes_[share[~missing].argmax(axis=-1)], labels[~missing])


NAMES = np.array(["floor", "wall", "table", "box", "ball", "lamp", ""])


@pytest.mark.parametrize(
    ("rename", "unlabelled"),
    [
        (lambda c: np.where(c >= 0, 10 * c + 7, -1), None),
        (lambda c: np.where(c >= 0, -10 * c - 7, -1).astype(np.int16), None),
        (lambda c: np.where(c >= 0, c - 3, 99), 99),
        (lambda c: NAMES[c], None),
        (lambda c: np.where(c >= 0, NAMES[c], "none").astype(object), "none"),
    ],
)
def test_labels_may_be_any_numbers_and_text(rooms, rename, unlabelled, tmp_path):
    from sklearn.tree import DecisionTreeClassifier

    results, classes, ups = rooms
    plain = learning.NodeClassifier(DecisionTreeClassifier(random_state=0)).fit(results[0], classes[0], ups[0])
    inner = DecisionTreeClassifier(random_state=0)
    other = learning.NodeClassifier(inner, unlabelled=unlabelled).fit(results[0], rename(classes[0]), ups[0])
    expected = rename(plain.predict(results[0], ups[0]))
    # What was learned is known by heart; elsewhere other splits are as good, and the order of the classes decides.
    # Where two classes are as probable the first is taken.
    assert np.mean(other.predict(results[0], ups[0]) == expected) > 0.99
    assert np.array_equal(other.predict(results[0], ups[0]) == rename(np.array([-1]))[0], results[0].supervoxels < 0)
    assert other.score(results[0], rename(classes[0]), ups[0]) == pytest.approx(
        plain.score(results[0], classes[0], ups[0]), abs=0.01
    )
    other.save(tmp_path / "a.json")
    loaded = learning.NodeClassifier.load(tmp_path / "a.json")
    assert (
        loaded.classes_.tolist() == other.classes_.tolist() == sorted({*rename(classes[0][classes[0] >= 0]).tolist()})
    )
    assert np.array_equal(loaded.predict(results[0], ups[0]), other.predict(results[0], ups[0]))


def test_labels_of_other_kinds_are_refused(rooms):
    results, classes, _ = rooms
    for wrong in (classes[0] + 0.5, np.full(classes[0].shape, None), [[1, 2], [3]]):
        with pytest.raises(ValueError, match=r"truth|inhomogeneous"):
            learning.NodeClassifier().fit(results[0], wrong)
    with pytest.raises(ValueError, match="one kind"):
        learning.NodeClassifier().fit(results[:2], [classes[0], NAMES[classes[1]]])
    with pytest.raises(ValueError, match="unlabelled of the labels' kind"):
        learning.NodeClassifier(unlabelled="none").fit(results[0], classes[0])


def test_cross_validation_over_whole_clouds(rooms):
    from sklearn.base import clone
    from sklearn.model_selection import GridSearchCV, cross_val_score
    from sklearn.tree import DecisionTreeClassifier

    results, classes, ups = rooms
    tree = learning.NodeClassifier(DecisionTreeClassifier(random_state=0))
    scores = cross_val_score(tree, results, classes, cv=2, error_score="raise")
    own = [clone(tree).fit(results[2:], classes[2:]).score(results[:2], classes[:2])]
    own += [clone(tree).fit(results[:2], classes[:2]).score(results[2:], classes[2:])]
    assert scores.tolist() == own
    told = cross_val_score(tree, results, classes, cv=2, params={"ups": ups}, error_score="raise")
    assert told.shape == (2,)
    search = GridSearchCV(tree, {"neighbours": [0, 1], "estimator__max_depth": [2]}, cv=2, error_score="raise")
    assert search.fit(results, classes).best_params_["estimator__max_depth"] == 2


def test_cross_validation_of_clouds_of_different_sizes(rooms):
    from sklearn.model_selection import cross_val_score
    from sklearn.tree import DecisionTreeClassifier

    results, classes, _ = rooms
    small = view_of_a_room(7, (60, 80))
    clouds, truths = [*results[:2], pcgraph.segment(small.points)], [*classes[:2], small.classes]
    scores = cross_val_score(
        learning.NodeClassifier(DecisionTreeClassifier()), clouds, truths, cv=3, error_score="raise"
    )
    assert scores.shape == (3,)


@pytest.mark.parametrize(
    "estimator",
    [
        None,
        ("ensemble", "RandomForestClassifier", {"n_estimators": 7, "max_depth": 6, "random_state": 1}),
        ("ensemble", "ExtraTreesClassifier", {"n_estimators": 5, "random_state": 1}),
        ("tree", "DecisionTreeClassifier", {"random_state": 2}),
    ],
)
def test_what_is_saved_predicts_the_same(rooms, estimator, tmp_path):
    if estimator is not None:
        module, name, settings = estimator
        estimator = getattr(importlib.import_module(f"sklearn.{module}"), name)(**settings)
    results, classes, ups = rooms
    taught = learning.NodeClassifier(estimator, ancestors=2, pose=False).fit(results[0], classes[0], ups[0])
    taught.save(tmp_path / "rooms.json")
    loaded = learning.NodeClassifier.load(tmp_path / "rooms.json")
    assert loaded.get_params() == {**taught.get_params(deep=False), "estimator": None}
    assert np.array_equal(loaded.predict_nodes(results[3]), taught.predict_nodes(results[3]))
    loaded.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "rooms.json").read_bytes()
    assert loaded.fit(results[0], classes[0]).score(results[0], classes[0]) > 0.5


def test_only_trees_are_saved(rooms, tmp_path):
    from sklearn.naive_bayes import GaussianNB
    from sklearn.tree import DecisionTreeClassifier

    results, classes, _ = rooms
    tree = DecisionTreeClassifier(random_state=0)
    with pytest.raises(ValueError, match="call fit"):
        learning.NodeClassifier().save(tmp_path / "a.json")
    with pytest.raises(ValueError, match="decision trees to save, got GaussianNB"):
        learning.NodeClassifier(GaussianNB()).fit(results[0], classes[0]).save(tmp_path / "a.json")
    rng = np.random.RandomState(0)
    with pytest.raises(ValueError, match="plain settings"):
        learning.NodeClassifier(tree, random_state=rng).fit(results[0], classes[0]).save(tmp_path / "a.json")
    with pytest.raises(pcgraph.CloudWriteError):
        learning.NodeClassifier(tree).fit(results[0], classes[0]).save(tmp_path / "no" / "a.json")
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A small file as plain data: one tree of three nodes."""
    content = {
        "format": "pcgraph node classifier 1",
        "settings": {"pose": False, "neighbours": 0, "ancestors": 0, "random_state": 0, "unlabelled": None},
        "feature_names": ["a", "b"],
        "classes": [3, 5],
        "starts": [0, 3],
        "left": [1, -1, -1],
        "right": [2, -1, -1],
        "features": [1, 0, 0],
        "thresholds": [0.5, 0.0, 0.0],
        "fractions": [[0.5, 0.5], [1.0, 0.0], [0.0, 1.0]],
    }
    return tmp_path_factory.mktemp("stored"), content


LIES = {
    "circle": {"left": [0, -1, -1]},
    "beyond": {"right": [3, -1, -1]},
    "one child": {"right": [-1, -1, -1]},
    "half a leaf": {"right": [2, -1, 1]},
    "no such column": {"features": [2, 0, 0]},
    "negative column": {"features": [-1, 0, 0]},
    "nan": {"thresholds": [None, 0.0, 0.0]},
    "huge": {"thresholds": [0.5, 0.0, 10**400]},
    "huge child": {"left": [10**30, -1, -1]},
    "short": {"thresholds": [0.5]},
    "ragged": {"fractions": [[1.0], [1.0, 0.0], [0.0, 1.0]]},
    "no fraction": {"fractions": [[0.5, 0.5], [2.0, 0.0], [0.0, 1.0]]},
    "no classes": {"classes": [], "fractions": [[], [], []]},
    "twice": {"classes": [3, 3]},
    "mixed": {"classes": [3, "a"]},
    "endless": {
        "settings": {"pose": False, "neighbours": 10**9, "ancestors": 0, "random_state": 0, "unlabelled": None}
    },
    "starts": {"starts": [0, 2]},
    "no trees": {"starts": [0]},
    "empty tree": {"starts": [0, 0, 3]},
    "unknown field": {"code": "import os"},
    "other format": {"format": "pcgraph node classifier 2"},
    "no settings": {"settings": 3},
}


def test_a_file_by_hand_is_read(stored):
    folder, content = stored
    (folder / "good.json").write_text(json.dumps(content))
    forest = learning.NodeClassifier.load(folder / "good.json").estimator_
    assert forest.predict_proba(np.array([[0.0, 0.4], [9.0, 0.6]])).tolist() == [[1.0, 0.0], [0.0, 1.0]]


@pytest.mark.parametrize("name", LIES)
def test_lying_files_are_refused(name, stored):
    folder, content = stored
    (folder / "bad.json").write_text(json.dumps(content | LIES[name]))
    with pytest.raises(ValueError, match="expected a classifier of nodes in") as refusal:
        learning.NodeClassifier.load(folder / "bad.json")
    assert len(str(refusal.value).splitlines()) == 1
    assert len(str(refusal.value)) < 600


@pytest.mark.parametrize(
    "content", [b"", b"\x80\x04pickle", b"[]", b'"a"', b"[" * 100_000, b'{"format":', b'{"format": [1]}', b"\xff\xfe{}"]
)
def test_other_files_are_refused(content, tmp_path):
    (tmp_path / "bad.json").write_bytes(content)
    with pytest.raises(ValueError, match="expected a classifier of nodes in"):
        learning.NodeClassifier.load(tmp_path / "bad.json")
    with pytest.raises(pcgraph.CloudReadError):
        learning.NodeClassifier.load(tmp_path / "none.json")


def test_the_same_seed_gives_the_same_answer(rooms):
    results, classes, ups = rooms
    first, second = (learning.NodeClassifier(random_state=3).fit(results[0], classes[0], ups[0]) for _ in range(2))
    assert np.array_equal(first.predict_nodes(results[2], ups[2]), second.predict_nodes(results[2], ups[2]))


def test_params_and_clones():
    from sklearn.base import clone
    from sklearn.tree import DecisionTreeClassifier

    inner = DecisionTreeClassifier(max_depth=3)
    classifier = learning.NodeClassifier(inner, neighbours=2)
    assert classifier.get_params(deep=False) == {
        "unlabelled": None,
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
    assert _uniform_tops(parents, np.array([8, 8, 5, 6], np.int32))[:4].tolist() == [4, 4, 2, 3]


def test_wrong_input_is_refused(rooms):
    results, classes, _ = rooms
    for arguments in ({"neighbours": -1}, {"ancestors": -1}, {"ancestors": "a"}):
        with pytest.raises(ValueError, match="at least 0"):
            leaf_descriptors(results[0], **arguments)
    with pytest.raises(ValueError, match="call fit"):
        learning.NodeClassifier().predict(results[0])
    with pytest.raises(ValueError, match="labelled point"):
        learning.NodeClassifier().fit(results[0], np.full_like(classes[0], -1))
    with pytest.raises(ValueError, match="one truth"):
        learning.NodeClassifier().fit(results[:2], classes[:1])
    with pytest.raises(ValueError, match="shape"):
        learning.NodeClassifier().fit(results[0], classes[0][:5])
