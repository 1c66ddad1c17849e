# SPDX-License-Identifier: Apache-2.0
"""Small adjacency graphs made by hand or at random."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from pcgraph.features.moments import Moments, moments_of_groups
from pcgraph.features.nodes import NodeFeatures, node_features
from pcgraph.graph.adjacency import AdjacencyGraph, EdgeFeatures
from pcgraph.graph.contacts import angle_between
from pcgraph.tree.linkage import Linkage, Merges
from pcgraph.tree.tree import SegmentationTree, segmentation_tree

SHAPES = ("random", "chain", "star", "complete", "parts", "no edges")
CHAIN = [[0, 1], [1, 2], [2, 3], [3, 4]]
"""Edges of five nodes in a row."""


def signed_convexity(normal_i: np.ndarray, normal_j: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Angle between normals, positive where they open on the way from i to j."""
    return angle_between(normal_i, normal_j) * np.sign(((normal_j - normal_i) * offset).sum(axis=1))


def edges_of(shape: str, n: int, rng: np.random.Generator) -> np.ndarray:
    """Edges (m, 2) int32, i < j ascending, of a graph of n nodes."""
    i, j = np.triu_indices(n, 1)
    if shape == "chain":
        keep = j == i + 1
    elif shape == "star":
        keep = i == 0
    elif shape == "complete":
        keep = i >= 0
    elif shape == "no edges":
        keep = i < 0
    else:
        keep = rng.random(len(i)) < min(1.0, 2.5 / n)
        if shape == "parts":
            keep &= (i % 3) == (j % 3)
        else:
            keep |= j == i + 1
    return np.stack((i[keep], j[keep]), axis=1).astype(np.int32)


def random_graph(
    shape: str, n: int, rng: np.random.Generator, ties: bool = False
) -> tuple[AdjacencyGraph, Moments, np.ndarray, np.ndarray]:
    """Graph, its leaves' moments, the points behind them (p, 3) and the leaf of each point (p,)."""
    leaf = np.concatenate((np.arange(n), np.arange(n), np.arange(n), rng.integers(0, n, 3 * n))).astype(np.int32)
    places = rng.integers(0, 3, (n, 3)).astype(float) * 4.0 if ties else rng.normal(size=(n, 3)) * 4.0
    points = places[leaf] + rng.normal(size=(len(leaf), 3)) * np.array([1.0, 1.0, 0.2])
    leaves = moments_of_groups(points, rng.random(points.shape), leaf, n)
    nodes = node_features(leaves)
    edges = edges_of(shape, n, rng)
    i, j = edges.T
    angles = rng.integers(-2, 3, len(edges)) * 0.5 if ties else rng.uniform(-1.5, 1.5, len(edges))
    touching = rng.integers(1, 9, len(edges))
    features = made(
        EdgeFeatures,
        len(edges),
        convexity=signed_convexity(nodes.normal[i], nodes.normal[j], nodes.centroid[j] - nodes.centroid[i]),
        contact_convexity=angles,
        normal_angle=angle_between(nodes.normal[i], nodes.normal[j]),
        color_contrast=rng.random(len(edges)),
        contact_voxels=touching,
        contact_length=touching / 2.0,
        step=np.zeros(len(edges)) if ties else rng.random(len(edges)),
    )
    return AdjacencyGraph(edges, features, nodes), leaves, points, leaf


def hand_graph(
    edges: list[list[int]], centroids: object = None, normals: object = None, n: int = 5, **columns: object
) -> AdjacencyGraph:
    """Graph of n nodes with these edges; features that are not given are zeros (contact: one voxel a side)."""
    values = {name: np.asarray(column, float) for name, column in columns.items()}
    values.setdefault("contact_voxels", np.full(len(edges), 2))
    values.setdefault("contact_length", values["contact_voxels"] / 2.0)
    given = {"normal": normals, "centroid": centroids}
    places = {name: np.asarray(value, float) for name, value in given.items() if value is not None}
    nodes = made(NodeFeatures, n, **places)
    return AdjacencyGraph(np.array(edges, np.int32).reshape(-1, 2), made(EdgeFeatures, len(edges), **values), nodes)


def made(kind, rows, **given):
    """A table with the columns given; the others (n,) zeros, or (n, 3), (n, 3, 3) where they are vectors."""
    wide = {"centroid": (3,), "normal": (3,), "color": (3,), "covariance": (3, 3)}
    names = [field.name for field in fields(kind)]
    return kind(**{name: given[name] if name in given else np.zeros((rows, *wide.get(name, ()))) for name in names})


def unit_leaves(n: int, counts: object = None, x: object = None) -> Moments:
    """Moments of n leaves on the x axis, one point each unless told, without extent."""
    sizes = np.ones(n, np.int64) if counts is None else np.asarray(counts, np.int64)
    centroids = np.zeros((n, 3))
    centroids[:, 0] = np.arange(n) if x is None else x
    return Moments(sizes, centroids, np.zeros((n, 3, 3)), None)


def tree_of(linkage: Linkage, graph: AdjacencyGraph, leaves: Moments) -> SegmentationTree:
    return segmentation_tree(linkage.merges(graph, leaves), leaves)


def hand_tree(pairs: list[list[int]], altitudes: list[float], counts: object = None) -> SegmentationTree:
    """Tree of these merges over leaves of so many points."""
    leaves = unit_leaves(len(pairs) + 1, counts)
    return segmentation_tree(Merges(np.array(pairs, np.int32).reshape(-1, 2), np.array(altitudes, float)), leaves)


def leaf_sets(tree: SegmentationTree) -> list[frozenset[int]]:
    """Leaves below each node."""
    below: list[set[int]] = [{node} if node < tree.n_leaves else set() for node in range(len(tree.parents))]
    for node, up in enumerate(tree.parents.tolist()):
        if up != node:
            below[up] |= below[node]
    return [frozenset(leaves) for leaves in below]
