# SPDX-License-Identifier: Apache-2.0
"""Scores of labels against the truth, for benchmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import pcgraph
from pcgraph.metrics.labellings import contingency, intersections_over_union, largest_of_groups

Row = dict[str, float]
"""Scores by name."""

EDGE_ON = 0.1  # cosine between a normal and the way to a place, below which noise says which way it faces


def fraction_facing(result: pcgraph.Segmentation, place: NDArray[np.float64]) -> float:
    """Fraction of the voxels that face a place, (3,), of those that are not seen edge-on from there."""
    rays = place - result.surface.grid.centroids
    cosines = np.einsum("ij,ij->i", rays, result.surface.normals) / np.linalg.norm(rays, axis=1)
    return float((cosines[np.abs(cosines) > EDGE_ON] > 0.0).mean())


def mean_overlap(labels: NDArray[np.integer], truth: NDArray[np.int32], chosen: NDArray[np.integer]) -> float:
    """Mean over some true segments of the IoU of the best segment."""
    table = contingency(labels, truth)
    names = np.unique(truth[(truth >= 0) & (labels >= 0)])
    best = largest_of_groups(intersections_over_union(table), table.col, len(names))
    return float(np.mean(best[np.isin(names, chosen)]))


def voted(truth: NDArray[np.int32], segments: NDArray[np.integer] | None) -> Row:
    """Purity, and mean IoU of the true segments, if every segment takes its most frequent true label."""
    assert segments is not None
    table = contingency(completed(segments), truth)
    order = np.argsort(table.data, kind="stable")
    vote = np.empty(table.shape[0], np.int64)
    vote[table.row[order]] = table.col[order]
    n = table.shape[1]
    right = vote[table.row] == table.col
    common = np.bincount(table.col[right], table.data[right], n)
    voted, true = np.bincount(vote[table.row], table.data, n), np.bincount(table.col, table.data, n)
    return {"purity": float(common.sum() / true.sum()), "mIoU": float(np.mean(common / (voted + true - common)))}


def completed(labels: NDArray[np.integer]) -> NDArray[np.int64]:
    """Labels with one more for all points that have none."""
    return np.where(labels >= 0, labels, labels.max() + 1).astype(np.int64)


def largest(labels: NDArray[np.integer], n: int) -> NDArray[np.int64]:
    """The n - 1 largest segments, and one of the others."""
    names, segment, sizes = np.unique(completed(labels), return_inverse=True, return_counts=True)
    rank = np.empty(len(names), np.int64)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(names))
    return np.minimum(rank[segment], n - 1).reshape(labels.shape)
