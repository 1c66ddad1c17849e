# SPDX-License-Identifier: Apache-2.0
"""The graph in other libraries' forms: nothing lost, nothing doubled, also without edges."""

from __future__ import annotations

import json
import re
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from scenes.graphs import hand_graph
from scenes.images import plate_before_a_wall
from scenes.tables import two_boxes_on_a_plane
from scipy.sparse.csgraph import connected_components, dijkstra, minimum_spanning_tree

import pcgraph
from pcgraph.graph.occlusion import Continuations, Occlusions

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def coloured():
    """Graph of two boxes on a plane, with colours."""
    points, truth, viewpoint = two_boxes_on_a_plane()
    shades = np.array([[0.2, 0.3, 0.4], [0.9, 0.1, 0.2], [0.1, 0.8, 0.7]])[truth]
    return pcgraph.segment(points, shades, viewpoint=viewpoint).graph


@pytest.fixture(scope="module")
def lone():
    """A graph of one node."""
    return pcgraph.segment(np.ones((3, 3)), viewpoint=(0, 0, 0)).graph


@pytest.fixture(scope="module")
def pair():
    """A graph of two nodes that do not touch."""
    return pcgraph.segment(np.array([[0.0, 0, 1], [5.0, 0, 1]]), viewpoint=(0, 0, 0), voxel_size=0.1).graph


def test_csr_is_the_graph(coloured):
    matrix = coloured.to_csr("contact_length")
    i, j = coloured.edges.T
    assert matrix.shape == (coloured.n_nodes, coloured.n_nodes)
    assert matrix.nnz == 2 * len(coloured.edges)
    assert matrix.has_canonical_format
    assert matrix.dtype == np.float64
    assert matrix.indices.dtype == np.int32
    dense = matrix.toarray()
    assert np.array_equal(dense, dense.T)
    assert np.array_equal(dense[i, j], coloured.edge_features.contact_length)
    assert set(coloured.to_csr().data.tolist()) == {1.0}
    assert np.array_equal(coloured.to_csr(np.arange(len(i))).toarray()[i, j], np.arange(len(i)))


def test_csr_keeps_edges_of_weight_zero(coloured):
    zeros = np.zeros(len(coloured.edges))
    assert coloured.to_csr(zeros).nnz == 2 * len(coloured.edges)
    expected = nx.number_connected_components(coloured.to_networkx())
    assert connected_components(coloured.to_csr(zeros))[0] == expected
    tree = minimum_spanning_tree(coloured.to_csr(zeros + 1.0))  # as the docstring says
    assert tree.nnz == coloured.n_nodes - expected


def test_paths_agree_with_networkx(coloured):
    lengths = dijkstra(coloured.to_csr("contact_length"), indices=0)
    expected = nx.single_source_dijkstra_path_length(coloured.to_networkx(), 0, weight="contact_length")
    for node, length in expected.items():
        assert lengths[node] == pytest.approx(length)


@pytest.mark.parametrize("wrong", ["nonsense", [1.0, 2.0], "nan"])
def test_wrong_weights_are_refused(coloured, wrong):
    weights = np.full(len(coloured.edges), np.nan) if wrong == "nan" else wrong
    with pytest.raises(ValueError, match="expected"):
        coloured.to_csr(weights)


def test_networkx_holds_plain_numbers_that_json_and_gexf_take(coloured, boxes, plate, lone, tmp_path):
    gap = pcgraph.segment(np.array([[0.0, 0, 1], [5.0, 0, 1]]), viewpoint=(0, 0, 0), voxel_size=0.1).tree
    assert np.isinf(gap.altitudes[-1])
    trees = [boxes[2].tree.to_networkx(), gap.to_networkx()]
    for network in (coloured.to_networkx(), plate[0].to_networkx(plate[1]), lone.to_networkx(), *trees):
        rows = [row for _, row in network.nodes(data=True)] + [row for *_, row in network.edges(data=True)]
        assert {type(value) for row in rows for value in row.values()} <= {int, float, str}
        text = json.dumps(nx.node_link_data(network, edges="edges"), allow_nan=False)
        back = nx.node_link_graph(json.loads(text), edges="edges")
        assert nx.utils.graphs_equal(back, network)
        nx.write_gexf(network, tmp_path / "a.gexf")
        read = nx.read_gexf(tmp_path / "a.gexf", node_type=int)
        assert sorted(read.nodes) == sorted(network.nodes)
        assert read.number_of_edges() == network.number_of_edges()
        for node, row in network.nodes(data=True):
            assert {name: read.nodes[node][name] for name in row} == row
    for tree, network in ((boxes[2].tree, trees[0]), (gap, trees[1])):
        finite = {k: a for k, a in enumerate(tree.altitudes.tolist()) if np.isfinite(a)}
        assert dict(network.nodes(data="altitude")) == dict.fromkeys(range(len(tree.parents))) | finite
    assert coloured.to_networkx().nodes[0]["normal_z"] == coloured.node_features.normal[0, 2]


def test_pyg_arrays(coloured):
    data = coloured.to_pyg(up=(0, 0, 1))
    k, m = coloured.n_nodes, len(coloured.edges)
    x, names = data["x"], data["x_names"]
    assert x.dtype == np.float32
    assert x.shape == (k, len(names))
    assert np.isfinite(x).all()
    assert {"size", "normal_x", "covariance_xx", "covariance_yz", "verticality", "color_b", "color_covariance_rg"} < {
        *names
    }
    assert len(set(names)) == len(names)
    assert np.array_equal(x[:, names.index("normal_z")], coloured.node_features.normal[:, 2].astype(np.float32))
    index, attributes = data["edge_index"], data["edge_attr"]
    assert index.dtype == np.int64
    assert index.shape == (2, 2 * m)
    assert attributes.dtype == np.float32
    assert attributes.shape == (2 * m, len(data["edge_attr_names"]))
    assert np.array_equal(index[:, m:], index[::-1, :m])
    assert np.array_equal(attributes[m:], attributes[:m])
    assert np.array_equal(index[:, :m], coloured.edges.T)
    convexity = attributes[:m, data["edge_attr_names"].index("convexity")]
    assert np.array_equal(convexity, coloured.edge_features.convexity.astype(np.float32))
    assert data["pos"] + data["pos_origin"] == pytest.approx(coloured.node_features.centroid, abs=1e-6)


def test_pyg_leaves_out_what_is_unknown(boxes):
    data = boxes[2].graph.to_pyg()
    assert not {"verticality", "color_r", "color_covariance_rr"} & {*data["x_names"]}
    assert np.isfinite(data["x"]).all()


@pytest.mark.parametrize("scale", [1e30, 1e45, 1e90])
def test_pyg_refuses_what_float32_does_not_hold(scale):
    points = two_boxes_on_a_plane()[0]
    graph = pcgraph.segment(points * scale).graph
    with pytest.raises(ValueError, match=r"expected values that float32 holds, up to 3.4e\+38, got -?\d.*e\+\d+ in "):
        graph.to_pyg()
    assert np.isfinite(pcgraph.segment(points * 1e15).graph.to_pyg()["x"]).all()


@pytest.mark.parametrize("with_colors", [True, False])
def test_graphml_reads_back_as_the_same_graph(coloured, boxes, with_colors, tmp_path):
    graph = coloured if with_colors else boxes[2].graph
    graph.write_graphml(tmp_path / "graph.graphml")
    read = nx.read_graphml(tmp_path / "graph.graphml", node_type=int)
    assert sorted(read.nodes) == list(range(graph.n_nodes))
    assert sorted(tuple(sorted(edge)) for edge in read.edges) == [tuple(edge) for edge in graph.edges.tolist()]
    for node, known in read.nodes(data=True):
        assert known["size"] == graph.node_features.size[node]
        assert [known[f"centroid_{axis}"] for axis in "xyz"] == graph.node_features.centroid[node].tolist()
        assert known["covariance_xz"] == graph.node_features.covariance[node, 0, 2]
        assert ("color_g" in known) == with_colors
        assert np.isfinite(list(known.values())).all()
    columns = {**graph.edge_features.columns(), "boundary_strength": graph.edge_features.boundary_strength}
    for (i, j), *row in zip(graph.edges.tolist(), *columns.values(), strict=True):
        assert read.edges[i, j] == dict(zip(columns, row, strict=True))
    assert [path.name for path in tmp_path.iterdir()] == ["graph.graphml"]


def test_graphml_writes_whole_or_not_at_all(lone, tmp_path):
    with pytest.raises(pcgraph.CloudWriteError):
        lone.write_graphml(tmp_path / "nowhere" / "graph.graphml")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["lone", "pair"])
def test_graphs_without_edges(name, request, tmp_path):
    graph = request.getfixturevalue(name)
    k = graph.n_nodes
    assert k == {"lone": 1, "pair": 2}[name]
    assert graph.to_csr("step").nnz == graph.to_csr().nnz == 0
    assert connected_components(graph.to_csr())[0] == k
    data = graph.to_pyg()
    assert data["edge_index"].shape == (2, 0)
    assert data["edge_attr"].shape == (0, len(data["edge_attr_names"]))
    assert len(data["edge_attr_names"]) == 8
    assert data["x"].shape == (k, len(data["x_names"]))
    assert graph.to_networkx().number_of_edges() == 0
    graph.write_graphml(tmp_path / "graph.graphml")
    assert sorted(nx.read_graphml(tmp_path / "graph.graphml", node_type=int).nodes) == list(range(k))


@pytest.fixture(scope="module")
def plate():
    """A plate before a wall, as a camera sees it: segmentation and occlusions."""
    result = pcgraph.segment(plate_before_a_wall())
    return result.graph, result.occlusions()


def test_networkx_has_occlusions_beside_contacts(plate, tmp_path):
    graph, hidden = plate
    network = graph.to_networkx(hidden)
    graph.write_graphml(tmp_path / "graph.graphml", hidden)
    read = nx.read_graphml(tmp_path / "graph.graphml", node_type=int, force_multigraph=True)
    assert len(hidden.pairs) >= 4
    for multi in (network, read):
        assert multi.is_multigraph()
        edges = sorted(multi.edges(data=True, keys=True), key=lambda edge: edge[2])
        assert len({key for _, _, key, _ in edges}) == len(edges) == len(graph.edges) + len(hidden.pairs)
        contacts, across = edges[: len(graph.edges)], edges[len(graph.edges) :]
        assert {row["kind"] for *_, row in contacts} == {"contact"}
        assert [sorted(edge[:2]) for edge in contacts] == graph.edges.tolist()
        assert [row["step"] for *_, row in contacts] == graph.edge_features.step.tolist()
        assert {row["kind"] for *_, row in across} == {"occlusion"}
        assert [row["front"] for *_, row in across] == hidden.pairs[:, 0].tolist()
        assert [sum(edge[:2]) for edge in across] == hidden.pairs.sum(axis=1).tolist()
        assert [row["gap"] for *_, row in across] == hidden.gap.tolist()
    along = [row["direction_y"] for *_, row in sorted(read.edges(data=True, keys=True), key=lambda edge: edge[2])[-3:]]
    assert along == hidden.direction[-3:, 1].tolist()


def test_pyg_has_occlusions_from_front_to_behind(plate):
    graph, hidden = plate
    data, plain = graph.to_pyg(occlusions=hidden), graph.to_pyg()
    assert [*data] == [*plain, "occlusion_index", "occlusion_attr", "occlusion_attr_names"]
    assert data["occlusion_attr_names"] == ["gap", "length", "direction_x", "direction_y", "direction_z"]
    assert data["occlusion_index"].dtype == np.int64
    assert np.array_equal(data["occlusion_index"], hidden.pairs.T)
    assert data["occlusion_attr"].dtype == np.float32
    assert np.array_equal(data["occlusion_attr"][:, 0], hidden.gap.astype(np.float32))
    assert np.array_equal(data["occlusion_attr"][:, 2:], hidden.direction.astype(np.float32))


def test_pairs_that_hide_each_other_and_touch_keep_all_edges(tmp_path):
    graph = hand_graph([[0, 1]], n=2)
    nothing = Continuations(np.empty((0, 2), np.int32), *([np.empty(0)] * 6))
    hidden = Occlusions(np.array([[0, 1], [1, 0]], np.int32), np.ones(2), np.ones(2), np.zeros((2, 3)), nothing)
    assert graph.to_networkx(hidden).number_of_edges(0, 1) == 3
    graph.write_graphml(tmp_path / "graph.graphml", hidden)
    read = nx.read_graphml(tmp_path / "graph.graphml", node_type=int)
    assert sorted(str(row.get("front")) for row in read.get_edge_data(0, 1).values()) == ["0", "1", "None"]


def test_without_occlusions_there_are_contacts_only(lone):
    empty = np.empty(0)
    hidden = Occlusions(np.empty((0, 2), np.int32), empty, empty, np.empty((0, 3)), None)
    assert lone.to_networkx(hidden).number_of_edges() == 0
    assert lone.to_pyg(occlusions=hidden)["occlusion_attr"].shape == (0, 5)


def test_occlusions_of_other_supervoxels_are_refused(plate, pair, tmp_path):
    for export in (
        lambda: pair.to_networkx(plate[1]),
        lambda: pair.to_pyg(occlusions=plate[1]),
        lambda: pair.write_graphml(tmp_path / "graph.graphml", plate[1]),
    ):
        with pytest.raises(ValueError, match="graph's 2 nodes"):
            export()
    assert not list(tmp_path.iterdir())


def test_the_snippets_of_the_docs_run(tmp_path, monkeypatch):
    text = (ROOT / "docs" / "graph.md").read_text(encoding="utf-8")
    snippets = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(snippets) >= 2
    monkeypatch.chdir(tmp_path)
    exec(compile("".join(snippets), "graph.md", "exec"), {})
    assert (tmp_path / "graph.graphml").exists()


def test_the_docs_name_every_feature(coloured):
    text = (ROOT / "docs" / "graph.md").read_text(encoding="utf-8")
    for name in [*coloured.node_features.columns(), *coloured.edge_features.columns(), "boundary_strength"]:
        assert f"`{name}`" in text, name
