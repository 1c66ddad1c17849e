# SPDX-License-Identifier: Apache-2.0
"""Learned linkage: what it learns, what it sees, and files of it."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import fields, replace

import msgspec
import numpy as np
import pytest
from scenes.graphs import random_graph
from scenes.surfaces import patch
from scenes.tables import VIEWPOINT, box

import pcgraph
from pcgraph.graph.adjacency import EdgeFeatures
from pcgraph.tree.learned import EdgeModel, LearnedLinkage, edge_evidence, leaf_truth

MODEL = EdgeModel(("concavity", "step_voxels"), (0.2, 1.0), (0.5, 2.0), (1.5, 0.25), -0.5, 0.4)


def _box_on_a_plane(shift=0.0):
    """Another scene than `boxes`: one large box on a plane, and its truth."""
    plane = patch((0, 0, 0), (1.6, 0, 0), (0, 1.2, 0))
    on_top = box(0.5, 0.4, 0.4)
    hidden = (abs(plane[:, 0] - 0.7) < 0.2) & (plane[:, 1] > 0.4) & (plane[:, 1] < 1.0)
    points = np.vstack((plane[~hidden], on_top)) + shift
    truth = np.repeat([0, 1], [int((~hidden).sum()), len(on_top)])
    return pcgraph.segment(points, viewpoint=np.add(VIEWPOINT, shift)), truth


@pytest.fixture(scope="module")
def stack():
    return _box_on_a_plane()


def test_fitted_on_one_scene_it_finds_the_objects_of_another(boxes):
    """Of some twenty boundaries now and then too little is learned: what counts is the median of draws of voxels."""
    points, objects, _ = boxes
    overlaps = []
    for shift in (0.0, 0.011, 0.023, 0.037, 0.041, 0.053, 0.067):
        result, truth = _box_on_a_plane(shift)
        linkage = LearnedLinkage.fit([result], [truth])
        found = pcgraph.segment(points + shift, viewpoint=np.add(VIEWPOINT, shift), linkage=linkage)
        overlaps.append(pcgraph.metrics.weighted_overlap(found.labels, objects))
        assert 0.0 < linkage.default_part_altitude < linkage.default_object_altitude < 1.0
        assert found.tree.altitudes[np.isfinite(found.tree.altitudes)].max() <= 1.0
    assert np.median(overlaps) > 0.98
    assert np.mean(overlaps) > 0.9


def test_it_is_scikit_learns_regression(stack):
    result, truth = stack
    model = LearnedLinkage.fit([result], [truth]).model
    columns = np.stack(list(edge_evidence(result.graph).values()), axis=1)
    rows = (columns - model.means) / model.scales
    from sklearn.linear_model import LogisticRegression

    by_them = LogisticRegression()
    by_them.classes_ = np.array([False, True])
    by_them.coef_, by_them.intercept_ = np.array([model.coefficients]), np.array([model.intercept])
    assert model(result.graph) == pytest.approx(by_them.predict_proba(rows)[:, 1], rel=1e-9, abs=1e-12)


def test_probability_by_hand():
    graph, _, _, _ = random_graph("chain", 3, np.random.default_rng(0))
    features = replace(graph.edge_features, convexity=np.array([-0.7, 0.7]), step=np.array([3.0, 0.0]))
    # Voxels have an edge of 1 here. 1.5 (0.7 - 0.2) / 0.5 + 0.25 (3 - 1) / 2 - 0.5 = 1.25; the other: -1.225.
    graph = replace(graph, edge_features=features)
    expected = [1.0 / (1.0 + np.exp(-1.25)), 1.0 / (1.0 + np.exp(1.225))]
    assert MODEL(graph) == pytest.approx(expected)


def test_evidence_does_not_depend_on_units_nor_on_which_end_is_first():
    graph, _, _, _ = random_graph("random", 15, np.random.default_rng(1))
    swapped = replace(graph, edges=graph.edges[:, ::-1].copy())
    columns = {field.name: getattr(graph.edge_features, field.name) for field in fields(EdgeFeatures)}
    columns |= {name: 1000.0 * columns[name] for name in ("contact_length", "step")}
    nodes = replace(graph.node_features, centroid=1000.0 * graph.node_features.centroid)
    larger = replace(graph, edge_features=EdgeFeatures(**columns), node_features=nodes)
    for other in (swapped, larger):
        theirs = edge_evidence(other)
        for name, values in edge_evidence(graph).items():
            assert theirs[name] == pytest.approx(values, rel=1e-9, abs=1e-9), name


def test_files_hold_numbers_and_come_back_the_same(tmp_path, stack):
    path = tmp_path / "model.json"
    linkage = LearnedLinkage.fit([stack[0]], [stack[1]])
    linkage.save(path)
    assert LearnedLinkage.load(path) == linkage
    assert json.loads(path.read_text())["format"] == "pcgraph edge model 1"


def good():
    return {"format": "pcgraph edge model 1"} | msgspec.structs.asdict(MODEL)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x80\x04 pickle",
        b"[]",
        b"{}",
        json.dumps(good() | {"format": "another"}).encode(),
        json.dumps(good() | {"names": "concavity"}).encode(),
        json.dumps(good() | {"means": [1.0]}).encode(),
        json.dumps(good() | {"means": ["a", "b"]}).encode(),
        json.dumps(good() | {"scales": [0.0, 1.0]}).encode(),
        json.dumps(good() | {"intercept": None}).encode(),
        json.dumps(good() | {"intercept": float("nan")}).encode(),
        json.dumps(good() | {"coefficients": [1e308, 1.0]}).encode(),
        json.dumps(good() | {"means": [0.0, -1e308]}).encode(),
        json.dumps(good() | {"scales": [5e-324, 1.0]}).encode(),
        json.dumps(good() | {"intercept": -1e101}).encode(),
        json.dumps(good() | {"more": 1}).encode(),
        json.dumps(good() | {"\x1b[31m\n" + "m" * 1000: 1}).encode(),
        json.dumps({name: value for name, value in good().items() if name != "format"}).encode(),
        json.dumps(good() | {"intercept": True}).encode(),
        json.dumps(good() | {"object_altitude": "0.4"}).encode(),
        json.dumps(good() | {"intercept": 10**400}).encode(),
        json.dumps(good() | {"scales": [1e300, 1]}).encode().replace(b"1e+300", b"1e400"),
        json.dumps(good() | {"names": ["concavity", None]}).encode(),
        json.dumps({name: value for name, value in good().items() if name != "means"}).encode(),
        json.dumps(good()).encode()[:-9],
        json.dumps(good()).encode().replace(b"concavity", b"\xff\xfe"),
        json.dumps(good()).encode().replace(b"[", b"[" * 100_000),
    ],
)
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "model.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"^expected JSON that LearnedLinkage.save wrote, got .*model.json") as refusal:
        EdgeModel.load(path)
    assert str(refusal.value).isprintable()
    assert len(str(refusal.value)) < 300 + len(str(path))


@pytest.mark.parametrize("name", ["means", "scales", "coefficients", "intercept"])
@pytest.mark.parametrize("value", [1e308, 1e200, 1e101])
def test_numbers_that_overflow_later_are_refused_at_once(name, value):
    number = value if name == "intercept" else (value, 1.0)
    with pytest.raises(ValueError, match="^expected numbers up to .*got " + re.escape(f"{value:g};")):
        msgspec.structs.replace(MODEL, **{name: number})


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_largest_numbers_that_a_model_may_have_do_not_overflow(sign):
    result, _ = _box_on_a_plane()
    largest = (sign * 1e100, sign * 1e100)
    model = msgspec.structs.replace(MODEL, coefficients=largest, means=largest, scales=(1e-100, 1e-100))
    with np.errstate(all="raise"):
        probability = model(result.graph)
    assert (probability == 0.0).all()  # coefficient x (value - mean) / scale is -1e300


def test_truth_of_leaves_by_hand():
    supervoxels = np.array([0, 0, 0, 0, 0, 1, 1, 2, -1, 3], np.int32)
    truth = np.array([5, 5, 5, 5, 9, 9, 5, 9, 9, -1])
    table = leaf_truth(supervoxels, truth, 4)
    assert table.majority(0.8).tolist() == [0, -1, 1, -1]
    assert table.majority(0.5)[[0, 2, 3]].tolist() == [0, 1, -1]
    for segments in ([0, 1, 2, 3], [0, 0, 1, 1], [0, 1, 1, 0], [0, 0, 0, 0]):
        cut = np.array(segments, np.int32)
        known = truth >= 0
        labels = np.append(cut, -1)[supervoxels]
        assert table.covering(cut) == pytest.approx(pcgraph.metrics.weighted_overlap(labels[known], truth[known]))


def test_evidence_that_this_version_does_not_know_is_refused():
    graph, _, _, _ = random_graph("chain", 3, np.random.default_rng(0))
    with pytest.raises(ValueError, match="smell"):
        EdgeModel(("smell",), (0.0,), (1.0,), (1.0,), 0.0, 0.5)(graph)


def test_wrong_lessons_are_refused(stack):
    result, truth = stack
    with pytest.raises(ValueError, match="a truth for each"):
        LearnedLinkage.fit([result], [])
    with pytest.raises(ValueError, match="shape"):
        LearnedLinkage.fit([result], [truth[1:]])
    for constant in (0, -1):
        with pytest.raises(ValueError, match="between them"):
            LearnedLinkage.fit([result], [np.full(len(truth), constant)])


def test_only_the_fit_needs_scikit_learn(monkeypatch, stack):
    result, truth = stack
    monkeypatch.setitem(sys.modules, "sklearn.linear_model", None)
    with pytest.raises(ImportError, match=r"rangesim\[learn\]"):
        LearnedLinkage.fit([result], [truth])
    assert len(LearnedLinkage(MODEL).merges(result.graph, result.tree.moments).pairs) > 0
