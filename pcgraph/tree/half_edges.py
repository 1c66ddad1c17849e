# SPDX-License-Identifier: Apache-2.0
"""Edges between clusters that merge: each hangs, by its halves 2e and 2e + 1, in a doubly linked list at both ends."""

from __future__ import annotations

import numpy as np
from numba import njit

NONE = -1


@njit(cache=True)
def hung_edges(n_nodes, edges):  # type: ignore[no-untyped-def]
    """Ends of the half-edges, their lists (after, before), first half-edge and degree of each node."""
    m = len(edges)
    ends = np.empty(2 * m, np.int64)
    after, before = np.full(2 * m, NONE), np.full(2 * m, NONE)
    first, degree = np.full(n_nodes, NONE), np.zeros(n_nodes, np.int64)
    for e in range(m):
        for side in range(2):
            ends[2 * e + side] = edges[e, side]
            hang(2 * e + side, ends, after, before, first, degree)
    return ends, after, before, first, degree


@njit(cache=True)
def hang(half, ends, after, before, first, degree):  # type: ignore[no-untyped-def]
    """Put a half-edge at the head of its end node's list."""
    node = ends[half]
    after[half], before[half] = first[node], NONE
    if first[node] != NONE:
        before[first[node]] = half
    first[node] = half
    degree[node] += 1


@njit(cache=True)
def unhang(half, ends, after, before, first, degree):  # type: ignore[no-untyped-def]
    """Take a half-edge out of its end node's list."""
    if before[half] == NONE:
        first[ends[half]] = after[half]
    else:
        after[before[half]] = after[half]
    if after[half] != NONE:
        before[after[half]] = before[half]
    degree[ends[half]] -= 1


@njit(cache=True)
def drop(e, ends, after, before, first, degree):  # type: ignore[no-untyped-def]
    """Remove an edge from both lists."""
    unhang(2 * e, ends, after, before, first, degree)
    unhang(2 * e + 1, ends, after, before, first, degree)


@njit(cache=True)
def find(a, b, ends, after, first, degree):  # type: ignore[no-untyped-def]
    """Edge between two clusters or -1, by a walk along the shorter list."""
    if degree[b] < degree[a]:
        a, b = b, a
    half = first[a]
    while half != NONE:
        if ends[half ^ 1] == b:
            return half >> 1
        half = after[half]
    return NONE


@njit(cache=True)
def hand_over(kept, gone, ends, after, before, first, degree, sums, twins, moved):  # type: ignore[no-untyped-def]
    """Number of edges of `gone` that fell together with one of `kept`, to the same third cluster.

    The others now hang at `kept`. Of each pair that fell together, `twins` names the edge that stays, with its
    `sums` (one column per edge) the sums of both, and `moved` the one that was dropped.
    """
    pairs = 0
    half = first[gone]
    while half != NONE:
        following = after[half]
        twin = find(kept, ends[half ^ 1], ends, after, first, degree)
        if twin == NONE:
            unhang(half, ends, after, before, first, degree)
            ends[half] = kept
            hang(half, ends, after, before, first, degree)
        else:
            twins[pairs], moved[pairs] = twin, half >> 1
            pairs += 1
            for row in range(len(sums)):
                sums[row, twin] += sums[row, half >> 1]
            drop(half >> 1, ends, after, before, first, degree)
        half = following
    return pairs
