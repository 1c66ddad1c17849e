# SPDX-License-Identifier: Apache-2.0
"""Metrics of supervoxels that need no truth: compactness of shape, and explained variation of values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.metrics.boundary_metrics import NeighbourGraph
from pcgraph.metrics.labellings import as_floats, as_labels, relabel_sequential


def compactness(points: ArrayLike | NeighbourGraph, labels: ArrayLike, *, k: int = 24) -> float:
    """Compactness CO, 0..1: mean over the points of the circularity of their segment, which is 1 for a disc.

    Schick et al. 2012 take 4 pi area / perimeter^2. But the perimeter of a patch of points, some of it at depth edges,
    depends on the sampling. So this is the circularity of Zunic et al. 2010, from second moments: area / (2 pi mean
    square distance from the centroid). It is 1 for a disc, 3 / pi for a square, and less for segments that are
    stretched, ragged, with holes or in pieces. Every point is weighted by the area that it represents. Bent segments
    can have more than 1 (a hemisphere 4 / 3), which counts as 1.

    Parameters
    ----------
    points : (n, 3) or (h, w, 3) float, or NeighbourGraph
        Any frame and unit. A graph, with its own k, saves the search for neighbours.
    labels : (n,) or (h, w) int
        Points with negative labels are left out; a graph must have none of them.
    k : int, >= 1
        Number of neighbours from which areas are estimated, if no graph is given.

    Raises
    ------
    ValueError
        The shapes differ, labels are not whole numbers, a labelled point is not finite, or no point is labelled.
    """
    graph = points if isinstance(points, NeighbourGraph) else NeighbourGraph.of(points, as_labels(labels) >= 0, k)
    segment, n = relabel_sequential(graph.of_members(labels))
    counts = np.bincount(segment, minlength=n)
    return float(counts @ _circularity(graph.points, graph.areas(), segment, n) / counts.sum())


def _circularity(
    points: NDArray[np.float64], areas: NDArray[np.float64], segment: NDArray[np.int64], n: int
) -> NDArray[np.float64]:
    """Circularity of each segment, (n,), 0..1: 0 for a line, 1 for points at one place."""
    area = np.bincount(segment, areas, n)
    weights = np.where(area[segment] > 0, areas, 1.0)
    whole = np.bincount(segment, weights, n)
    centroids = np.stack([np.bincount(segment, weights * axis, n) for axis in points.T], axis=1) / whole[:, None]
    squares = ((points - centroids[segment]) ** 2).sum(axis=1)
    # Each point is a small disc of its area, which has a second moment of its own.
    moment = np.bincount(segment, weights * (squares + areas / (2 * np.pi)), n) / whole
    somewhere = moment > 0
    return np.where(somewhere, np.minimum(1.0, area / (2 * np.pi * np.where(somewhere, moment, 1.0))), 1.0)


def explained_variation(values: ArrayLike, labels: ArrayLike) -> float:
    """Explained variation EV, 0..1 (Moore et al. 2008): fraction of the values' variance that lies between segments.

    Parameters
    ----------
    values : (n,), (n, c), (h, w) or (h, w, c) float
        Colours, normals or positions. The unit does not count, if all channels have the same.
    labels : (n,) or (h, w) int
        Points with negative labels are left out.

    Returns
    -------
    float
        1 if the values do not vary.

    Raises
    ------
    ValueError
        Shapes do not fit, labels are not whole numbers, no point has one, or a labelled point's value is not finite.
    """
    segments, given = as_labels(labels), as_floats(values)
    if given.shape[: segments.ndim] != segments.shape or given.ndim > segments.ndim + 1:
        raise ValueError(f"expected values for labels {segments.shape}, got {given.shape}")
    inside = segments >= 0
    if not inside.any():
        raise ValueError("expected at least one point with a label, got none")
    chosen = given[inside].reshape(np.count_nonzero(inside), -1)
    if not np.isfinite(chosen).all():
        raise ValueError("expected finite values, got NaN or infinity at a labelled point; give it the label -1")
    chosen = chosen - chosen.mean(axis=0)
    segment, n = relabel_sequential(segments[inside])
    counts = np.bincount(segment, minlength=n)
    sums = np.stack([np.bincount(segment, channel, n) for channel in chosen.T])
    total = float((chosen**2).sum())
    return min(1.0, float((sums**2 / counts).sum()) / total) if total > 0 else 1.0
