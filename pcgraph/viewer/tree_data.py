# SPDX-License-Identifier: Apache-2.0
"""Data of a segmentation in the page: the tree with colours and features of its nodes, the graph, and boxes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.detection.boxes import boxes_of_labels
from pcgraph.features.nodes import scalar_columns
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.segmentation import Segmentation
from pcgraph.tree.tree import SegmentationTree
from pcgraph.viewer.node_colors import distinct_colors, node_colors
from pcgraph.viewer.packing import pack

MAX_BOXES = 300
"""Largest count of objects with a box, those with the most points, because a box of 10^4 points takes some 10 ms."""
CONVEX, CONCAVE, GAP = 0, 1, 2
"""Codes of the kinds of edges in the page's data."""
MIN_CONCAVITY = math.radians(10.0)
"""Angle of a valley, radians, below which its edge counts as convex: the tolerance of LCCP (Stein et al. 2014)."""
LEFT_OUT = ("size", "color_covariance", "covariance", "feature_")
"""Prefixes of node features that the page does not list: it shows the size elsewhere, and the others are long."""
UNITS = {"centroid_x": "m", "centroid_y": "m", "centroid_z": "m", "residual": "m"}
"""Units of node features; the others are dimensionless."""


@dataclass(frozen=True, eq=False)
class ShownTree(ShortRepr):
    """Tree of a cloud for the viewer: the leaf of each point, and the object and the part of each leaf.

    It can also hold the result of another program.

    Attributes
    ----------
    supervoxels : (n,) or (h, w) int
        Leaf of the tree that each point belongs to; -1 for none.
    tree : SegmentationTree
    objects, parts : (n_leaves,) int
        Object and part of each leaf.
    linkage : str
        Name of the method that made the tree.
    graph : AdjacencyGraph, optional
        Graph of the leaves, whose edges can be shown.

    Examples
    --------
    >>> import numpy as np, pcgraph
    >>> from pcgraph.viewer import ShownTree
    >>> x, y = np.meshgrid(np.linspace(-1.0, 1.0, 64), np.linspace(-1.0, 1.0, 64))
    >>> roof = ShownTree.of(pcgraph.segment(np.stack((x, y, 2.0 + np.abs(x)), axis=-1)))
    >>> roof.linkage, len(roof.objects) == roof.tree.n_leaves
    ('RegionLinkage', True)
    """

    supervoxels: NDArray[np.integer]
    tree: SegmentationTree
    objects: NDArray[np.integer]
    parts: NDArray[np.integer]
    linkage: str
    graph: AdjacencyGraph | None = None

    @classmethod
    def of(cls, segmentation: Segmentation) -> ShownTree:
        """The tree of a segmentation, with the segmentation's objects and parts."""
        part_altitude = min(segmentation.linkage.default_part_altitude, segmentation.object_altitude)
        parts = segmentation.tree.cut(altitude=part_altitude)
        linkage = type(segmentation.linkage).__name__
        return cls(
            segmentation.supervoxels, segmentation.tree, segmentation.objects, parts, linkage, segmentation.graph
        )


def tree_data(shown: ShownTree, rows: NDArray[np.int64], points: NDArray[np.float64]) -> dict[str, Any]:
    """Tree and graph as plain values for JSON; arrays are strings made by `pack`.

    Parameters
    ----------
    shown : ShownTree
    rows : (n,) int
        Flat indices of the points that are shown.
    points : (n, 3) float64, metres
        These points.

    Returns
    -------
    leaf : 1 + the supervoxel of each point, 0 for none; uint16, or uint32 if `wide`
    parents, altitudes, sizes, colors : one row per node
    featureNames, featureUnits, features : float32, all of the first feature, then all of the second and so on
    origin, centroids : float32, 3 per leaf, metres from the origin
    objects, parts : per leaf, the object and the part it is in
    objectCount, partCount : how many there are
    edges, edgeKinds : pairs of leaves; convex 0, concave 1, gap 2
    boxes : of objects, with their numbers of points

    Raises
    ------
    ValueError
        The tree has no moments.
    """
    tree, moments = shown.tree, shown.tree.moments
    if moments is None:
        raise ValueError("expected a tree with moments of its points, got one without: give it moments")
    leaf = shown.supervoxels.reshape(-1)[rows]
    wide = tree.n_leaves >= 65535
    sizes = moments.counts
    features = _features(tree)
    centroids = moments.centroids[: tree.n_leaves]
    origin = centroids.mean(axis=0)
    edges, kinds = _edges(shown.graph)
    return {
        "leaves": tree.n_leaves,
        "linkage": shown.linkage,
        "wide": wide,
        "leaf": pack((leaf + 1).astype(np.uint32 if wide else np.uint16)),
        "parents": pack(tree.parents.astype(np.int32)),
        "altitudes": pack(tree.altitudes.astype(np.float32)),
        "sizes": pack(sizes.astype(np.uint32)),
        "colors": pack(node_colors(tree.parents, sizes[: tree.n_leaves])),
        "leafColors": pack(distinct_colors(tree.n_leaves)),
        "featureNames": list(features),
        "featureUnits": [UNITS.get(name, "") for name in features],
        "features": pack(np.stack([column.astype(np.float32) for column in features.values()])),
        "origin": origin.tolist(),
        "centroids": pack((centroids - origin).astype(np.float32)),
        "objects": pack(shown.objects.astype(np.int32)),
        "parts": pack(shown.parts.astype(np.int32)),
        "objectCount": len(np.unique(shown.objects)),
        "partCount": len(np.unique(shown.parts)),
        "edges": pack(edges.astype(np.int32)),
        "edgeKinds": pack(kinds),
        "boxes": _boxes(shown, leaf, points),
    }


def _features(tree: SegmentationTree) -> dict[str, NDArray[np.generic]]:
    """Features of all nodes by name, one number per node."""
    columns = scalar_columns(tree.features().columns())
    return {name: column for name, column in columns.items() if not name.startswith(LEFT_OUT)}


def _edges(graph: AdjacencyGraph | None) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Pairs of leaves, (m, 2), that touch or nearly touch, and the kind of each edge, (m,)."""
    if graph is None:
        return np.empty((0, 2), np.int32), np.empty(0, np.uint8)
    concave = graph.edge_features.convexity < -MIN_CONCAVITY
    pairs, kinds = [graph.edges], [np.where(concave, CONCAVE, CONVEX).astype(np.uint8)]
    if graph.gaps is not None:
        pairs.append(graph.gaps.edges)
        kinds.append(np.full(len(graph.gaps.edges), GAP, np.uint8))
    return np.concatenate(pairs), np.concatenate(kinds)


def _boxes(shown: ShownTree, leaf: NDArray[np.integer], points: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Tight boxes of the objects with the most points, the largest object first."""
    objects = np.append(shown.objects, -1)[leaf]
    counts = np.bincount(objects[objects >= 0])
    boxed = np.argsort(-counts, kind="stable")[:MAX_BOXES]
    boxes = boxes_of_labels(points, np.where(np.isin(objects, boxed), objects, -1))
    return [{"object": k, "count": int(counts[k]), **boxes[k].to_dict()} for k in boxed.tolist() if k in boxes]
