# SPDX-License-Identifier: Apache-2.0
"""The adjacency graph in the forms that other libraries read."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.nodes import rows, scalar_columns

if TYPE_CHECKING:
    import networkx
    from scipy.sparse import csr_array

    from pcgraph.graph.adjacency import AdjacencyGraph
    from pcgraph.graph.occlusion import Occlusions


def edge_columns(graph: AdjacencyGraph) -> dict[str, NDArray[np.generic]]:
    """Edge features by name, and `boundary_strength`, which follows from them."""
    return {**graph.edge_features.columns(), "boundary_strength": graph.edge_features.boundary_strength}


def network(graph: AdjacencyGraph, occlusions: Occlusions | None) -> networkx.Graph:
    """The graph with scalar columns as attributes; see `AdjacencyGraph.to_networkx`."""
    from networkx import Graph, MultiGraph

    nodes = scalar_columns(graph.node_features.columns())
    result = Graph() if occlusions is None else MultiGraph()
    result.add_nodes_from(enumerate(rows(nodes, graph.n_nodes)))
    contacts = _joined(graph.edges, scalar_columns(edge_columns(graph)))
    if occlusions is None:
        result.add_edges_from(contacts)
        return result
    columns = {"front": _checked(graph, occlusions)[:, 0], **occlusions.columns()}
    hidden = _joined(occlusions.pairs, scalar_columns(columns))
    both = [("contact", edge) for edge in contacts] + [("occlusion", edge) for edge in hidden]
    # One key per edge: keys are the edges' ids in GraphML, and programs merge edges of one id.
    result.add_edges_from((i, j, key, {"kind": kind, **row}) for key, (kind, (i, j, row)) in enumerate(both))
    return result


def csr(graph: AdjacencyGraph, weights: str | ArrayLike | None) -> csr_array:
    """Symmetric matrix, (k, k) float64; see `AdjacencyGraph.to_csr`."""
    from scipy.sparse import csr_array

    both = np.concatenate((_weights(graph, weights),) * 2)
    source, target = _both_ways(graph.edges)
    order = np.lexsort((target, source))
    indptr = np.concatenate(([0], np.cumsum(np.bincount(source, minlength=graph.n_nodes)))).astype(np.int32)
    columns = target[order].astype(np.int32)  # csgraph would copy wider ones
    return csr_array((both[order], columns, indptr), shape=(graph.n_nodes, graph.n_nodes))


def pyg(graph: AdjacencyGraph, up: ArrayLike | None, occlusions: Occlusions | None) -> dict[str, object]:
    """Arrays and names of columns; see `AdjacencyGraph.to_pyg`."""
    nodes = graph.node_features.columns()
    centroids = graph.node_features.centroid
    del nodes["centroid"]
    if up is not None:
        nodes["verticality"] = graph.node_features.verticality(up)
    nodes = scalar_columns(nodes)
    edges = scalar_columns(edge_columns(graph))
    origin = centroids.mean(axis=0)
    attributes = _table(edges, len(graph.edges))
    arrays: dict[str, object] = {
        "x": _table(nodes, graph.n_nodes),
        "x_names": list(nodes),
        "pos": _single("pos", centroids - origin),
        "pos_origin": origin,
        "edge_index": _both_ways(graph.edges),
        "edge_attr": np.concatenate((attributes, attributes)),
        "edge_attr_names": list(edges),
    }
    if occlusions is not None:
        hidden = scalar_columns(occlusions.columns())
        arrays["occlusion_index"] = _checked(graph, occlusions).T.astype(np.int64)
        arrays["occlusion_attr"] = _table(hidden, len(occlusions.pairs))
        arrays["occlusion_attr_names"] = list(hidden)
    return arrays


def graphml(graph: AdjacencyGraph, occlusions: Occlusions | None) -> bytes:
    """A GraphML document; see `AdjacencyGraph.write_graphml`."""
    from networkx.readwrite.graphml import write_graphml_xml

    stream = io.BytesIO()
    write_graphml_xml(network(graph, occlusions), stream)
    return stream.getvalue()


def _joined(
    pairs: NDArray[np.int32], columns: dict[str, NDArray[np.generic]]
) -> list[tuple[int, int, dict[str, object]]]:
    """Pairs, each with its row of the columns."""
    return [(i, j, row) for (i, j), row in zip(pairs.tolist(), rows(columns, len(pairs)), strict=True)]


def _checked(graph: AdjacencyGraph, occlusions: Occlusions) -> NDArray[np.int32]:
    """The pairs of the occlusions; raises ValueError if one of them is not a node of the graph."""
    last = int(occlusions.pairs.max(initial=0))
    if last >= graph.n_nodes:
        raise ValueError(f"expected occlusions between the graph's {graph.n_nodes} nodes, got one of node {last}")
    return occlusions.pairs


def _weights(graph: AdjacencyGraph, weights: str | ArrayLike | None) -> NDArray[np.float64]:
    m = len(graph.edges)
    if weights is None:
        return np.ones(m)
    if isinstance(weights, str):
        columns = edge_columns(graph)
        if weights not in columns:
            raise ValueError(f"expected weights to name one of {', '.join(columns)}, got {weights!r}")
        return columns[weights].astype(np.float64)
    numbers = np.asarray(weights, dtype=np.float64)
    if numbers.shape != (m,) or not np.isfinite(numbers).all():
        raise ValueError(f"expected {m} finite weights, one per edge, got an array of shape {numbers.shape}")
    return numbers


def _both_ways(edges: NDArray[np.int32]) -> NDArray[np.int64]:
    """Sources and targets, (2, 2 m): the edges, then the reversed edges."""
    return np.concatenate((edges, edges[:, ::-1])).T.astype(np.int64)


def _table(columns: dict[str, NDArray[np.generic]], n: int) -> NDArray[np.float32]:
    table = np.empty((n, len(columns)), np.float32)
    for i, (name, column) in enumerate(columns.items()):
        table[:, i] = _single(name, column)
    return table


def _single(name: str, values: NDArray[np.generic]) -> NDArray[np.float32]:
    """The values as float32; raises ValueError if they are too large for it."""
    with np.errstate(over="ignore"):
        single = values.astype(np.float32)
    lost = np.isinf(single)
    if lost.any():
        raise ValueError(
            f"expected values that float32 holds, up to {np.finfo(np.float32).max:.2g}, "
            f"got {values[lost][0]:.3g} in {name}; scale the points before they are segmented"
        )
    return single
