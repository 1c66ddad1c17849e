# SPDX-License-Identifier: Apache-2.0
"""Descriptors of supervoxels for a classifier: their own, their neighbours' and their ancestors'."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from pcgraph.detection.plane_detection import find_planes
from pcgraph.features.nodes import NodeFeatures
from pcgraph.features.primitives import Primitives, fit_primitives, primitive_moments, primitive_moments_up_tree
from pcgraph.hierarchy import accumulate_sequential, propagate_sequential
from pcgraph.segmentation import Segmentation

GROWTH = 4.0
"""Times the points of one ancestor that the next has at least, so that three reach 64 median supervoxels. Chosen by
eye; not varied."""
EDGE_COLUMNS = ("convexity", "contact_convexity", "normal_angle", "color_contrast", "step")


def leaf_descriptors(
    segmentation: Segmentation,
    up: ArrayLike | None = None,
    *,
    pose: bool = True,
    neighbours: int = 1,
    ancestors: int = 3,
) -> tuple[NDArray[np.float64], list[str]]:
    """Descriptors of each supervoxel, (n_leaves, f) float64, finite, and the names of the columns.

    Parameters
    ----------
    segmentation : Segmentation
    up : (3,) float, optional
        Direction against gravity, in the points' frame. Default: the normal of the largest plane.
    pose : bool
        Whether there are columns of height and slope. Heights are above the lowest supervoxel if `up` is given, else
        above the largest plane.
    neighbours : int, >= 0
        Number of rings around a supervoxel in the graph. Each adds its mean, weighted by length of contact. The first
        also adds the mean, least and most of the features of the supervoxel's edges.
    ancestors : int, >= 0
        Number of ancestors in the tree, with 4, 16, 64, ... times the points of the median supervoxel. Each adds the
        same columns as the supervoxel's own. The first also adds those of its segment in `Segmentation.objects`.

    Raises
    ------
    ValueError
        An argument is not as above.
    """
    for name, rings in (("neighbours", neighbours), ("ancestors", ancestors)):
        if not isinstance(rings, int | np.integer) or rings < 0:
            raise ValueError(f"expected {name} as a whole number of at least 0, got {rings!r}")
    tree = segmentation.tree
    direction, ground = _upright(segmentation, up) if pose else (None, 0.0)
    nodes, names = _node_descriptors(segmentation, direction, ground)
    leaves = nodes[: tree.n_leaves]
    blocks, titles = [leaves], list(names)
    if neighbours > 0:
        edges, edge_names = _edge_summary(segmentation)
        blocks.append(edges)
        titles += edge_names
        mean = _contact_means(segmentation)
        around = leaves
        for ring in range(1, neighbours + 1):
            around = mean @ around
            blocks.append(around - leaves)
            titles += [f"neighbours {ring}: {name}" for name in names]
    if ancestors > 0:
        heights = _finite(tree.altitudes)
        chosen = [("segment", _segments(segmentation))]
        size = float(np.median(tree.sizes[: tree.n_leaves]))
        for level in range(1, ancestors + 1):
            least = size * GROWTH**level
            chosen.append((f"ancestor {level}", _climb(tree.parents, tree.altitudes, tree.sizes, least)))
        for title, node in chosen:
            at = node[: tree.n_leaves]
            blocks += [nodes[at], heights[at, None], heights[tree.parents[at], None]]
            titles += [f"{title}: {name}" for name in [*names, "altitude", "altitude above"]]
    return np.concatenate(blocks, axis=1), titles


def _upright(segmentation: Segmentation, up: ArrayLike | None) -> tuple[NDArray[np.float64], float]:
    """Unit vector against gravity, and position of the ground along it."""
    planes = find_planes(segmentation, up=up)
    centroids = segmentation.graph.node_features.centroid
    if up is not None or not len(planes):
        direction = planes.up if planes.up.any() else segmentation.graph.node_features.normal[0]
        return direction, float((centroids @ direction).min())
    return planes.up, float(planes.offsets[0])


def _node_descriptors(
    segmentation: Segmentation, up: NDArray[np.float64] | None, ground: float
) -> tuple[NDArray[np.float64], list[str]]:
    """Descriptors of all k nodes of the tree, and the names of the columns."""
    features = segmentation.tree.features()
    deviations = features.deviations
    shades = np.sqrt(np.maximum(np.einsum("kii->ki", features.color_covariance), 0.0))
    columns = {
        "thickness": deviations[:, 0],
        "width": deviations[:, 1],
        "length": deviations[:, 2],
        "linearity": features.linearity,
        "planarity": features.planarity,
        "scattering": features.scattering,
        **{f"{name} mean": features.color[:, i] for i, name in enumerate(("red", "green", "blue"))},
        **{f"{name} spread": shades[:, i] for i, name in enumerate(("red", "green", "blue"))},
        **_curved(_primitives(segmentation), deviations[:, 2]),
    }
    if up is not None:
        columns |= _posed(features, up, ground)
    return np.nan_to_num(np.stack(list(columns.values()), axis=1), posinf=0.0), list(columns)


def _posed(features: NodeFeatures, up: NDArray[np.float64], ground: float) -> dict[str, NDArray[np.float64]]:
    rise = features.normal @ up
    spread = np.einsum("a,kab,b->k", up, features.covariance, up)
    return {
        "height": features.centroid @ up - ground,
        "facing up": rise,
        "level": np.abs(rise),
        "vertical spread": np.sqrt(np.maximum(spread, 0.0)),
    }


def _primitives(segmentation: Segmentation) -> Primitives:
    """Planes, spheres and cylinders through the voxels of every node."""
    tree, surface, own = segmentation.tree, segmentation.surface, segmentation.graph.node_features
    # The centroid of each supervoxel is added to its voxels, so that none is without points.
    places = np.concatenate((surface.grid.centroids, own.centroid))
    normals = np.concatenate((surface.normals, own.normal))
    leaf = np.concatenate((surface.supervoxels, np.arange(tree.n_leaves, dtype=np.int32)))
    return fit_primitives(
        primitive_moments_up_tree(primitive_moments(places, normals, leaf, tree.n_leaves), tree.parents)
    )


def _curved(fits: Primitives, length: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Roundness of nodes: residuals over length, and length over radius, which is 0 if flat."""
    scale = np.where(length > 0.0, length, 1.0)
    return {
        "plane residual": fits.plane_residual / scale,
        "sphere residual": fits.sphere_residual / scale,
        "cylinder residual": fits.cylinder_residual / scale,
        "sphere bend": length / fits.sphere_radius,
        "cylinder bend": length / fits.cylinder_radius,
    }


def _contact_means(segmentation: Segmentation) -> csr_array:
    """Matrix, (n_leaves, n_leaves), that maps values to means over neighbours; supervoxels without any keep theirs."""
    graph = segmentation.graph
    (i, j), weight = graph.edges.T, graph.edge_features.contact_length
    n = graph.n_nodes
    links = csr_array((np.tile(weight, 2), (np.append(i, j), np.append(j, i))), shape=(n, n))
    total = np.asarray(links.sum(axis=1)).ravel()
    alone = total == 0.0  # these are their own neighbours
    links.data /= np.repeat(np.where(alone, 1.0, total), np.diff(links.indptr))
    return links + csr_array((alone.astype(float), (np.arange(n), np.arange(n))), shape=(n, n))


def _edge_summary(segmentation: Segmentation) -> tuple[NDArray[np.float64], list[str]]:
    """Mean, least and most of each feature over a supervoxel's edges; 0 if it has none."""
    graph = segmentation.graph
    n, ends = graph.n_nodes, np.append(graph.edges[:, 0], graph.edges[:, 1])
    weight = np.tile(graph.edge_features.contact_length, 2)
    total = np.bincount(ends, weight, n)
    columns, names = [], []
    for name in EDGE_COLUMNS:
        values = np.tile(np.asarray(getattr(graph.edge_features, name), np.float64), 2)
        least, most = np.full(n, np.inf), np.full(n, -np.inf)
        np.minimum.at(least, ends, values)
        np.maximum.at(most, ends, values)
        columns += [np.bincount(ends, weight * values, n) / np.where(total > 0.0, total, 1.0), least, most]
        names += [f"edges: {kind} {name}" for kind in ("mean", "least", "most")]
    table = np.stack(columns, axis=1)
    table[~np.isfinite(table)] = 0.0
    return table, names


def _segments(segmentation: Segmentation) -> NDArray[np.int32]:
    """Highest node above each node whose supervoxels are all of one object (`Segmentation.objects`), (k,) int32."""
    return _uniform_tops(segmentation.tree.parents, segmentation.objects)


def _finite(altitudes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Altitudes, with twice the highest finite one in place of infinity."""
    known = np.isfinite(altitudes)
    return np.where(known, altitudes, 2.0 * altitudes[known].max(initial=0.0))


def _climb(
    parents: NDArray[np.int32], altitudes: NDArray[np.float64], counts: NDArray[np.int64], least: float
) -> NDArray[np.int32]:
    """First node at or above each node with `least` points, (k,); else the highest below infinite altitude."""
    smaller = (counts < least) & np.isfinite(altitudes[parents])
    return propagate_sequential(parents, np.arange(len(parents), dtype=np.int32), smaller)


def _uniform_tops(parents: NDArray[np.int32], values: NDArray[np.int32]) -> NDArray[np.int32]:
    """Highest node above each node whose leaves all have one value, (k,); `values` are those of the leaves."""
    lowest, highest = (accumulate_sequential(parents, values, extreme) for extreme in ("min", "max"))
    uniform = (lowest == highest)[parents]
    return propagate_sequential(parents, np.arange(len(parents), dtype=np.int32), uniform)
