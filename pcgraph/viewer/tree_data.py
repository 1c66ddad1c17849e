# SPDX-License-Identifier: Apache-2.0
"""A segmentation as the page holds it: the tree with colours and features of its nodes, the graph, and boxes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.detection.boxes import boxes_of_labels
from pcgraph.features.nodes import scalar_columns
from pcgraph.segmentation import Segmentation
from pcgraph.viewer.node_colors import distinct_colors, node_colors
from pcgraph.viewer.packing import pack

MAX_BOXES = 300
"""Count of objects that get a box, those with most points; a box of 10^4 points takes some 10 ms."""
CONVEX, CONCAVE, GAP = 0, 1, 2
"""Kinds of edges."""
LEFT_OUT = ("size", "color_covariance", "features")
"""Features of nodes that the page does not list: the size is shown anyway, the others say nothing by themselves."""
UNITS = {"centroid": "m", "residual": "m"}
"""Units of features; others have none."""


def tree_data(segmentation: Segmentation, index: NDArray[np.int64], points: NDArray[np.float64]) -> dict[str, Any]:
    """Tree and graph as JSON takes them; arrays are text of `pack`.

    Parameters
    ----------
    segmentation : Segmentation
    index : (n,) int
        Flat indices of the points that are shown.
    points : (n, 3) float64, metres
        These points.

    Returns
    -------
    leaf : uint16 or (wide) uint32 per point, 1 + its supervoxel, 0 for none
    parents, altitudes, sizes, colors : one row per node
    featureNames, featureUnits, features : float32, all of the first feature, then all of the second and so on
    centroids : float32, 3 per leaf, metres from `origin`
    objects, parts : per leaf, the object and the part it is in
    objectCount, partCount, objectAltitude, partAltitude : of the default cuts
    edges, edgeKinds : pairs of leaves; convex 0, concave 1, gap 2
    boxes : of objects, with their numbers of points
    """
    tree, graph = segmentation.tree, segmentation.graph
    leaf = segmentation.supervoxels.reshape(-1)[index]
    wide = tree.n_leaves >= 65535
    sizes = tree.moments.counts
    colors = node_colors(tree.parents, sizes[: tree.n_leaves])
    part_altitude = min(segmentation.linkage.default_part_altitude, segmentation.object_altitude)
    features = _features(segmentation)
    centroids = graph.node_features.centroid
    origin = centroids.mean(axis=0)
    edges, kinds = _edges(segmentation)
    return {
        "leaves": tree.n_leaves,
        "linkage": type(segmentation.linkage).__name__,
        "acquisition": segmentation.acquisition.in_words,
        "wide": wide,
        "leaf": pack((leaf + 1).astype(np.uint32 if wide else np.uint16)),
        "parents": pack(tree.parents.astype(np.int32)),
        "altitudes": pack(tree.altitudes.astype(np.float32)),
        "sizes": pack(sizes.astype(np.uint32)),
        "colors": pack(colors),
        "leafColors": pack(distinct_colors(tree.n_leaves)),
        "featureNames": list(features),
        "featureUnits": [UNITS.get(name.rsplit("_", 1)[0], UNITS.get(name, "")) for name in features],
        "features": pack(np.stack([column.astype(np.float32) for column in features.values()])),
        "origin": origin.tolist(),
        "centroids": pack((centroids - origin).astype(np.float32)),
        "objects": pack(segmentation.objects.astype(np.int32)),
        "parts": pack(tree.cut(altitude=part_altitude)),
        "objectCount": int(tree.cut(altitude=segmentation.object_altitude).max()) + 1,
        "partCount": int(tree.cut(altitude=part_altitude).max()) + 1,
        "objectAltitude": float(np.nan_to_num(segmentation.object_altitude, posinf=1e30)),
        "partAltitude": float(np.nan_to_num(part_altitude, posinf=1e30)),
        "edges": pack(edges.astype(np.int32)),
        "edgeKinds": pack(kinds),
        "boxes": _boxes(segmentation, leaf, points),
    }


def _features(segmentation: Segmentation) -> dict[str, NDArray[np.generic]]:
    """Features of all nodes, one number each, by name."""
    columns = scalar_columns(segmentation.tree.features().columns())
    is_left_out = tuple(LEFT_OUT)
    return {
        name: column
        for name, column in columns.items()
        if not name.startswith((*is_left_out, "covariance", "feature_"))
    }


def _edges(segmentation: Segmentation) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Pairs of leaves, (m, 2), that touch or nearly touch, and the kind of each."""
    graph = segmentation.graph
    concave = graph.edge_features.convexity < 0.0
    pairs, kinds = [graph.edges], [np.where(concave, CONCAVE, CONVEX).astype(np.uint8)]
    if graph.gaps is not None:
        pairs.append(graph.gaps.edges)
        kinds.append(np.full(len(graph.gaps.edges), GAP, np.uint8))
    return np.concatenate(pairs), np.concatenate(kinds)


def _boxes(segmentation: Segmentation, leaf: NDArray[np.integer], points: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Tight box of each object, the largest first."""
    objects = np.append(segmentation.objects, -1)[leaf]
    counts = np.bincount(objects[objects >= 0])
    boxed = np.argsort(-counts, kind="stable")[:MAX_BOXES]
    boxes = boxes_of_labels(points, np.where(np.isin(objects, boxed), objects, -1))
    return [{"object": k, "count": int(counts[k]), **boxes[k].to_dict()} for k in boxed.tolist() if k in boxes]
