# SPDX-License-Identifier: Apache-2.0
"""The adjacency graph in the forms that other libraries read."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.columns import rows, scalar_columns

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from pcgraph.graph.adjacency import AdjacencyGraph


def csr(graph: AdjacencyGraph, weights: str | ArrayLike | None) -> csr_array:
    """Symmetric matrix, (k, k) float64; see `AdjacencyGraph.to_csr`."""
    from scipy.sparse import csr_array

    both = np.concatenate((_weights(graph, weights),) * 2)
    source, target = _both_ways(graph.edges)
    order = np.lexsort((target, source))
    indptr = np.concatenate(([0], np.cumsum(np.bincount(source, minlength=graph.n_nodes)))).astype(np.int32)
    columns = target[order].astype(np.int32)  # csgraph copies wider ones
    return csr_array((both[order], columns, indptr), shape=(graph.n_nodes, graph.n_nodes))


def pyg(graph: AdjacencyGraph, up: ArrayLike | None) -> dict[str, object]:
    """Arrays and names of columns; see `AdjacencyGraph.to_pyg`."""
    nodes = graph.node_features.columns()
    centroids = graph.node_features.centroid
    del nodes["centroid"]
    if up is not None:
        nodes["verticality"] = graph.node_features.verticality(up)
    nodes = scalar_columns(nodes)
    edges = scalar_columns(graph.edge_features.columns())
    origin = centroids.mean(axis=0)
    attributes = _table(edges, len(graph.edges))
    return {
        "x": _table(nodes, graph.n_nodes),
        "x_names": list(nodes),
        "pos": (centroids - origin).astype(np.float32),
        "pos_origin": origin,
        "edge_index": _both_ways(graph.edges),
        "edge_attr": np.concatenate((attributes, attributes)),
        "edge_attr_names": list(edges),
    }


def graphml(graph: AdjacencyGraph) -> bytes:
    """A GraphML document; see `AdjacencyGraph.write_graphml`."""
    from networkx import Graph
    from networkx.readwrite.graphml import write_graphml_xml

    plain = Graph()
    plain.add_nodes_from(enumerate(rows(scalar_columns(graph.node_features.columns()), graph.n_nodes)))
    features = rows(scalar_columns(graph.edge_features.columns()), len(graph.edges))
    plain.add_edges_from((i, j, row) for (i, j), row in zip(graph.edges.tolist(), features, strict=True))
    stream = io.BytesIO()
    write_graphml_xml(plain, stream)
    return stream.getvalue()


def _weights(graph: AdjacencyGraph, weights: str | ArrayLike | None) -> NDArray[np.float64]:
    m = len(graph.edges)
    if weights is None:
        return np.ones(m)
    if isinstance(weights, str):
        columns = graph.edge_features.columns()
        if weights not in columns:
            raise ValueError(f"expected weights to name one of {', '.join(columns)}, got {weights!r}")
        return columns[weights].astype(np.float64)
    numbers = np.asarray(weights, dtype=np.float64)
    if numbers.shape != (m,) or not np.isfinite(numbers).all():
        raise ValueError(f"expected {m} finite weights, one per edge, got an array of shape {numbers.shape}")
    return numbers


def _both_ways(edges: NDArray[np.int32]) -> NDArray[np.int64]:
    """Sources and targets, (2, 2 m): the edges, then the same reversed."""
    return np.concatenate((edges, edges[:, ::-1])).T.astype(np.int64)


def _table(columns: dict[str, NDArray[np.generic]], n: int) -> NDArray[np.float32]:
    table = np.empty((n, len(columns)), np.float32)
    for i, column in enumerate(columns.values()):
        table[:, i] = column
    return table
