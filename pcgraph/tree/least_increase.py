# SPDX-License-Identifier: Apache-2.0
"""Region merging along a graph by energy: what raises the energy least, per boundary removed, merges first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.tree.edge_queue import queued_edges, requeue, unqueue
from pcgraph.tree.half_edges import NONE, drop, hand_over, hung_edges
from pcgraph.voxels.eigen import symmetric_eigen


@dataclass(frozen=True, eq=False)
class Regions:
    """What the energy of n regions is made of.

    The energy of a region is the sum over its mass of the squared distance of `values` to their mean, plus
    `plane` times the sum over its mass of the squared distance to its least-squares plane.

    Attributes
    ----------
    masses : (n,) float64, > 0
    values : (n, d) float64
        Mean values, d >= 0.
    centroids : (n, 3) float64
    scatters : (n, 3, 3) float64
        Sum over the mass of (x - centroid)(x - centroid)^T.
    plane : float, >= 0
    """

    masses: NDArray[np.float64]
    values: NDArray[np.float64]
    centroids: NDArray[np.float64]
    scatters: NDArray[np.float64]
    plane: float


def least_increase_linkage(
    regions: Regions, edges: NDArray[np.int32], lengths: NDArray[np.float64] | None
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Binary merges of regions along edges until every connected component is one.

    Parameters
    ----------
    regions : Regions, n of them
    edges : (m, 2) int32
        Pairs of distinct regions, each pair once.
    lengths : (m,) float64, > 0, or None
        Boundary that a merge removes; lengths of edges to the same region add up. None: 1 for every merge.

    Returns
    -------
    pairs : (t, 2) int32
        Merge i joins these two into the new node n + i.
    altitudes : (t,) float64
        Increase of energy per length, made not to decrease: a merge below the altitude of an earlier one, which
        a graph allows, takes that altitude. Of equal increases the first edge merges first.

    Notes
    -----
    Source: Koepfler, Lopez and Morel 1994 (Mumford-Shah by merging); Ward 1963 where lengths are None and
    `plane` is 0. After a merge all edges of the merged region get new costs, so the time is the sum of degrees of
    the merged regions times a logarithm: n log n on graphs of bounded degree, n^2 log n around a hub.
    """
    per_length = lengths is not None
    boundary = np.ones(len(edges)) if lengths is None else lengths.astype(np.float64)
    pairs, altitudes = _merge(
        edges,
        boundary,
        per_length,
        regions.masses.copy(),
        np.ascontiguousarray(regions.values, np.float64).copy(),
        regions.centroids.copy(),
        regions.scatters.copy(),
        float(regions.plane),
    )
    return pairs, np.maximum.accumulate(np.maximum(altitudes, 0.0))


@njit(cache=True)
def _merge(edges, lengths, per_length, masses, values, centroids, scatters, plane):  # type: ignore[no-untyped-def]
    n = len(masses)
    ends, after, before, first, degree = hung_edges(n, edges)
    residuals = np.zeros(n)
    for a in range(n):
        if plane > 0.0:
            residuals[a] = _least_eigenvalue(scatters[a].copy())
    costs = np.empty(len(edges))
    sums = lengths.reshape(1, -1) if per_length else np.empty((0, len(edges)))  # the same memory
    twins, moved = np.empty(len(edges), np.int64), np.empty(len(edges), np.int64)
    for e in range(len(edges)):
        increase = _increase(edges[e, 0], edges[e, 1], masses, values, centroids, scatters, residuals, plane)
        costs[e] = increase / lengths[e]
    order, place, size = queued_edges(costs)
    name = np.arange(n)  # a region lives on under the slot of one of its leaves; this is its tree node
    pairs, altitudes = np.empty((max(n - 1, 0), 2), np.int32), np.empty(max(n - 1, 0))
    t = 0
    while size[0] > 0:
        e = order[0]
        kept, gone = ends[2 * e], ends[2 * e + 1]
        pairs[t, 0], pairs[t, 1] = min(name[kept], name[gone]), max(name[kept], name[gone])
        altitudes[t] = costs[e]
        if degree[gone] > degree[kept]:
            kept, gone = gone, kept
        name[kept] = n + t
        t += 1
        drop(e, ends, after, before, first, degree)
        unqueue(e, costs, order, place, size)
        for pair in range(hand_over(kept, gone, ends, after, before, first, degree, sums, twins, moved)):
            unqueue(moved[pair], costs, order, place, size)
        _unite(kept, gone, masses, values, centroids, scatters, residuals, plane)
        half = first[kept]
        while half != NONE:
            e = half >> 1
            increase = _increase(kept, ends[half ^ 1], masses, values, centroids, scatters, residuals, plane)
            costs[e] = increase / lengths[e]
            requeue(e, costs, order, place, size)
            half = after[half]
    return pairs[:t].copy(), altitudes[:t].copy()


@njit(cache=True)
def _increase(a, b, masses, values, centroids, scatters, residuals, plane):  # type: ignore[no-untyped-def]
    """Energy of the union of two regions less the sum of theirs."""
    reduced = masses[a] * masses[b] / (masses[a] + masses[b])
    increase = 0.0
    for i in range(values.shape[1]):
        gap = values[a, i] - values[b, i]
        increase += reduced * gap * gap
    if plane > 0.0:
        union = _scatter_of_union(a, b, reduced, centroids, scatters)
        increase += plane * (_least_eigenvalue(union) - residuals[a] - residuals[b])
    return increase


@njit(cache=True)
def _unite(kept, gone, masses, values, centroids, scatters, residuals, plane):  # type: ignore[no-untyped-def]
    total = masses[kept] + masses[gone]
    share = masses[gone] / total
    if plane > 0.0:
        scatters[kept] = _scatter_of_union(kept, gone, masses[kept] * share, centroids, scatters)
        residuals[kept] = _least_eigenvalue(scatters[kept].copy())
    for i in range(values.shape[1]):
        values[kept, i] += share * (values[gone, i] - values[kept, i])
    for i in range(3):
        centroids[kept, i] += share * (centroids[gone, i] - centroids[kept, i])
    masses[kept] = total


@njit(cache=True)
def _scatter_of_union(a, b, reduced, centroids, scatters):  # type: ignore[no-untyped-def]
    union = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            shift = (centroids[a, i] - centroids[b, i]) * (centroids[a, j] - centroids[b, j])
            union[i, j] = scatters[a, i, j] + scatters[b, i, j] + reduced * shift
    return union


@njit(cache=True)
def _least_eigenvalue(matrix: NDArray[np.float64]) -> float:
    """Of a symmetric positive semi-definite matrix, which is overwritten."""
    symmetric_eigen(matrix, np.empty((3, 3)))
    return max(min(matrix[0, 0], matrix[1, 1], matrix[2, 2]), 0.0)
