# SPDX-License-Identifier: Apache-2.0
"""Boundary recall and precision on the k-nearest-neighbour graph of the points."""

from __future__ import annotations

from numpy.typing import ArrayLike

from pcgraph.metrics.neighbours import NeighbourGraph
from pcgraph.metrics.table import whole_numbers


def boundary_recall(
    points: ArrayLike,
    labels: ArrayLike,
    truth: ArrayLike,
    *,
    hops: int = 1,
    k: int = 8,
    tolerance: float | None = None,
) -> float:
    """Boundary recall BR, 0..1: share of true boundary points with a boundary point of the labels near.

    A boundary point is one with another label among its k nearest neighbours. For many labellings of one cloud
    build the graph once: ``NeighbourGraph.of(points, truth >= 0).recall(labels, truth)``.

    Parameters
    ----------
    points : (n, 3) or (h, w, 3) float
        Any frame; metres if `tolerance` is.
    labels, truth : (n,) or (h, w) int
        Points negative in either are left out, of the graph too.
    hops : int, >= 0
        Near is within as many steps from neighbour to neighbour, away from the true boundary point.
    k : int, >= 1
        Neighbours per point, the nearest ones, itself not counted.
    tolerance : float, the points' unit, optional
        Near is within this distance instead.

    Returns
    -------
    float
        1 if the truth has no boundary.

    Raises
    ------
    ValueError
        Shapes differ, labels are not whole numbers, nothing is labelled in both, a labelled point is not finite, or a
        number is out of range.
    """
    return _graph_of_labelled(points, labels, truth, k).recall(labels, truth, hops=hops, tolerance=tolerance)


def boundary_precision(
    points: ArrayLike,
    labels: ArrayLike,
    truth: ArrayLike,
    *,
    hops: int = 1,
    k: int = 8,
    tolerance: float | None = None,
) -> float:
    """Boundary precision BP, 0..1: share of the labels' boundary points with a true boundary point near.

    Parameters and errors as for `boundary_recall`; 1 if the labels have no boundary. Supervoxels cut where nothing
    true ends, so theirs is low by design.
    """
    return _graph_of_labelled(points, labels, truth, k).precision(labels, truth, hops=hops, tolerance=tolerance)


def _graph_of_labelled(points: ArrayLike, labels: ArrayLike, truth: ArrayLike, k: int) -> NeighbourGraph:
    found, true = whole_numbers(labels), whole_numbers(truth)
    if found.shape != true.shape:
        raise ValueError(f"expected labels and truth of one shape, got {found.shape} and {true.shape}")
    return NeighbourGraph.of(points, (found >= 0) & (true >= 0), k)
