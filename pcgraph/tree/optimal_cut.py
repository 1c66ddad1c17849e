# SPDX-License-Identifier: Apache-2.0
"""Optimal cuts: energies of segmentations, and the scale from which on each node is in the cut of least energy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.hierarchy import NONE, binary_children
from pcgraph.parallel import kernel
from pcgraph.plumbing.short_repr import ShortRepr


@dataclass(frozen=True, eq=False)
class Energy(ShortRepr):
    """Energy of a segmentation at a scale: sum over its segments of data + scale x complexity.

    Attributes
    ----------
    data : (k,) float64
        Misfit of each node of a tree to its points as one segment.
    complexity : (k,) float64
        Cost of each node as a segment; a node's is at most the sum of its children's. With ones, segments are counted.

    Raises
    ------
    ValueError
        The two are not arrays of one dimension and one length, a value is NaN, or a complexity infinite.
    """

    data: NDArray[np.float64]
    complexity: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name, values in (("data", self.data), ("complexity", self.complexity)):
            if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
                raise ValueError(f"expected {name} as an array of numbers, got {_kind(values)}; use np.asarray")
        if self.data.ndim != 1 or self.data.shape != self.complexity.shape:
            raise ValueError(
                f"expected data and complexity (k,) of one length, got {self.data.shape} and {self.complexity.shape}"
            )
        if np.isnan(self.data).any() or not np.isfinite(self.complexity).all():
            raise ValueError("expected data without NaN and finite complexity; check the values given")


def _kind(values: object) -> object:
    return values.dtype if isinstance(values, np.ndarray) else type(values).__name__


def appearance_scales(
    parents: NDArray[np.int32], data: NDArray[np.float64], complexity: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Least scale at which each node, or one above it, is a segment of the optimal cut, (k,) float64, 0..inf.

    The optimal cut at a scale has the least sum over its segments of data + scale x complexity. It consists of the
    highest nodes for which the result is at most that scale. Of cuts with equal energy the coarsest is taken.

    Parameters
    ----------
    parents : (k,) int32
        As in `SegmentationTree`.
    data : (k,) float64
        Infinite for nodes that must never be a segment; finite for leaves.
    complexity : (k,) float64
        A node's is at most the sum of its children's; otherwise optimal cuts need not nest.

    Notes
    -----
    Source: Guigues, Cocquerez and Le Men 2006, whose lambda is our scale. The least energy below a node is a concave,
    piecewise linear function of the scale, and a node's own energy is a line that cuts off the end of that function.
    The bends of the function are in a heap with the last one on top. Two heaps merge in constant time, and every bend
    is taken out once: O(k log k) in any tree, however deep.
    """
    return _appearances(parents, binary_children(parents), data, complexity)


class _Bends(NamedTuple):
    """Pairing heaps of bends, those at the largest scales on top; a bend has the number of the node that made it.

    Attributes
    ----------
    scales : (k,) float64
    first, following : (k,) int32
        First child of a bend in its heap, and next child of the same parent; -1 if there is none.
    """

    scales: NDArray[np.float64]
    first: NDArray[np.int32]
    following: NDArray[np.int32]


@kernel
def _appearances(
    parents: NDArray[np.int32],
    children: NDArray[np.int32],
    data: NDArray[np.float64],
    complexity: NDArray[np.float64],
) -> NDArray[np.float64]:
    k = len(parents)
    scales = np.zeros(k)
    bends = _Bends(scales, np.full(k, NONE, np.int32), np.full(k, NONE, np.int32))
    # The last piece of each node's function: energy at large scales is last_data + scale x last_complexity.
    last_data, last_complexity = data.copy(), complexity.copy()
    # At its bend each node's function changes from the children's piece to the node's own line.
    data_change, complexity_change = np.zeros(k), np.zeros(k)
    top = np.full(k, NONE, np.int32)  # the node's heap of bends
    for node in range(k):
        a, b = children[node]
        if a < 0:
            continue
        heap = _meld(bends, top[a], top[b])
        energy, count = last_data[a] + last_data[b], last_complexity[a] + last_complexity[b]
        if data[node] == np.inf:
            scales[node], top[node] = np.inf, heap
            last_data[node], last_complexity[node] = energy, count
            continue
        crossing = _crossing(data[node], complexity[node], energy, count)
        while heap != NONE and crossing <= scales[heap]:
            energy -= data_change[heap]
            count -= complexity_change[heap]
            heap = _pop(bends, heap)
            crossing = _crossing(data[node], complexity[node], energy, count)
        scales[node] = crossing
        if crossing == np.inf:
            top[node], last_data[node], last_complexity[node] = heap, energy, count
        else:
            data_change[node], complexity_change[node] = data[node] - energy, complexity[node] - count
            top[node] = _meld(bends, node, heap)
    for node in range(k - 2, -1, -1):  # a node above takes its place if it appears earlier
        scales[node] = min(scales[node], scales[parents[node]])
    return scales


@kernel
def _crossing(data: float, complexity: float, data_below: float, complexity_below: float) -> float:
    """Least scale >= 0 from which on a node's own energy is no larger than the least energy below it."""
    if data <= data_below:
        return 0.0
    if complexity >= complexity_below:
        return np.inf
    return (data - data_below) / (complexity_below - complexity)


@kernel
def _meld(bends: _Bends, a: int, b: int) -> int:
    """Two heaps as one."""
    if a == NONE:
        return b
    if b == NONE:
        return a
    if bends.scales[b] > bends.scales[a]:
        a, b = b, a
    bends.following[b] = bends.first[a]
    bends.first[a] = b
    return a


@kernel
def _pop(bends: _Bends, heap: int) -> int:
    """A heap without its top: children melded in pairs, then the pairs from the last to the first."""
    first, following = bends.first, bends.following
    child, pairs = first[heap], NONE
    first[heap] = NONE
    while child != NONE:
        second = following[child]
        following[child] = NONE
        rest = NONE
        if second != NONE:
            rest = following[second]
            following[second] = NONE
        pair = _meld(bends, child, second)
        following[pair] = pairs
        pairs = pair
        child = rest
    merged = NONE
    while pairs != NONE:
        rest = following[pairs]
        following[pairs] = NONE
        merged = _meld(bends, merged, pairs)
        pairs = rest
    return merged
