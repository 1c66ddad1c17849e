# SPDX-License-Identifier: Apache-2.0
"""Scale sets: the scale from which each node belongs to the cut of least energy."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.tree.segments import children_of

_NONE = -1


def appearance_scales(
    parents: NDArray[np.int32], data: NDArray[np.float64], complexity: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Least scale at which each node or one above it is a segment of the optimal cut, (k,) float64, 0..inf.

    The optimal cut at a scale is that of least sum over its segments of data + scale x complexity. It consists
    of the highest nodes whose value here is at most the scale. Of cuts with equal energy the coarsest is taken.

    Parameters
    ----------
    parents : (k,) int32
        As in `SegmentationTree`.
    data : (k,) float64
        Infinite where a node must never be a segment; finite for leaves.
    complexity : (k,) float64
        A node's is at most the sum of its children's; otherwise optimal cuts need not nest.

    Notes
    -----
    Source: Guigues, Cocquerez and Le Men 2006, whose lambda is our scale. The least energy below a node is a
    concave, piecewise linear function of the scale, and a node's own energy is a line that cuts off its end. The
    bends of the function wait in a heap with the last one on top; two heaps merge in constant time, and every
    bend leaves once: O(k log k) in any tree, however deep.
    """
    scales = _appearances(children_of(parents), data, complexity)
    _not_above_parents(parents, scales)
    return scales


@njit(cache=True)
def _not_above_parents(parents: NDArray[np.int32], scales: NDArray[np.float64]) -> None:
    for node in range(len(parents) - 2, -1, -1):
        scales[node] = min(scales[node], scales[parents[node]])


@njit(cache=True)
def _appearances(
    children: NDArray[np.int32], data: NDArray[np.float64], complexity: NDArray[np.float64]
) -> NDArray[np.float64]:
    k = len(children)
    scales = np.zeros(k)
    # The last piece of each node's function: energy at large scales is last_data + scale x last_complexity.
    last_data, last_complexity = data.copy(), complexity.copy()
    # At its bend each node's function changes from the children's piece to the node's own line.
    data_change, complexity_change = np.zeros(k), np.zeros(k)
    top = np.full(k, _NONE, np.int32)  # the node's heap of bends, named by the node at whose scale they are
    first, following = np.full(k, _NONE, np.int32), np.full(k, _NONE, np.int32)
    for node in range(k):
        a, b = children[node]
        if a < 0:
            continue
        heap = _meld(top[a], top[b], scales, first, following)
        energy, count = last_data[a] + last_data[b], last_complexity[a] + last_complexity[b]
        if data[node] == np.inf:
            scales[node], top[node] = np.inf, heap
            last_data[node], last_complexity[node] = energy, count
            continue
        crossing = _crossing(data[node], complexity[node], energy, count)
        while heap != _NONE and crossing <= scales[heap]:
            energy -= data_change[heap]
            count -= complexity_change[heap]
            heap = _pop(heap, scales, first, following)
            crossing = _crossing(data[node], complexity[node], energy, count)
        scales[node] = crossing
        if crossing == np.inf:
            top[node], last_data[node], last_complexity[node] = heap, energy, count
        else:
            data_change[node], complexity_change[node] = data[node] - energy, complexity[node] - count
            top[node] = _meld(node, heap, scales, first, following)
    return scales


@njit(cache=True)
def _crossing(data: float, complexity: float, data_below: float, complexity_below: float) -> float:
    """Least scale >= 0 from which on the node's own energy is no larger than that below it."""
    if data <= data_below:
        return 0.0
    if complexity >= complexity_below:
        return np.inf
    return (data - data_below) / (complexity_below - complexity)


@njit(cache=True)
def _meld(a, b, key, first, following):  # type: ignore[no-untyped-def]
    """Two pairing heaps as one, the larger key on top."""
    if a == _NONE:
        return b
    if b == _NONE:
        return a
    if key[b] > key[a]:
        a, b = b, a
    following[b] = first[a]
    first[a] = b
    return a


@njit(cache=True)
def _pop(heap, key, first, following):  # type: ignore[no-untyped-def]
    """A pairing heap without its top: children melded in pairs, then the pairs from the last to the first."""
    child, pairs = first[heap], _NONE
    first[heap] = _NONE
    while child != _NONE:
        second = following[child]
        following[child] = _NONE
        rest = _NONE
        if second != _NONE:
            rest = following[second]
            following[second] = _NONE
        pair = _meld(child, second, key, first, following)
        following[pair] = pairs
        pairs = pair
        child = rest
    merged = _NONE
    while pairs != _NONE:
        rest = following[pairs]
        following[pairs] = _NONE
        merged = _meld(merged, pairs, key, first, following)
        pairs = rest
    return merged
