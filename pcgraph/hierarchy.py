# SPDX-License-Identifier: Apache-2.0
"""Hierarchies as arrays of parents: children, common ancestors, sums up the tree and values down it.

A hierarchy of k nodes is one array `parents`, (k,) int32: leaves first, every parent after its children, the last
node the root and its own parent. So one pass in ascending order meets children before parents, and one in
descending order parents before children. Trees, metrics and learning rest on these functions, named after those of
Higra. They do not check their input: callers do so once, with `checked_parents`.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.parallel import kernel

NONE = -1
"""Number that stands for no node, no edge, or the end of a list: -1, because real ones have numbers from 0 on."""
Reduction = Literal["sum", "max", "min"]
_REDUCTIONS: tuple[Reduction, ...] = ("sum", "max", "min")


def checked_parents(parents: ArrayLike) -> NDArray[np.int32]:
    """Parents as (k,) int32, if they are those of a hierarchy with any number of children per node.

    Raises
    ------
    ValueError
        Parents are not whole numbers, a parent does not come after its node, the root is not last, or a leaf comes
        after another node.
    """
    up = np.asarray(parents)
    if up.dtype.kind not in "iu":
        raise ValueError(f"expected parents that are whole numbers, got {up.dtype}; convert them first")
    k = len(up) if up.ndim == 1 else 0
    if k == 0 or up[-1] != k - 1 or (up[:-1] <= np.arange(k - 1)).any() or (up >= k).any():
        raise ValueError("expected parents (k,) each larger than its node, the last node its own parent")
    up = np.ascontiguousarray(up, np.int32)
    inner = np.bincount(up[:-1], minlength=k) > 0
    if not inner[num_leaves(up) :].all():
        raise ValueError("expected leaves before all other nodes, got a leaf among those; renumber the nodes")
    return up


def num_leaves(parents: NDArray[np.int32]) -> int:
    """Number of nodes without children, which come before the first node that is a parent."""
    return int(parents.min()) if len(parents) > 1 else 1


@kernel
def binary_children(parents: NDArray[np.int32]) -> NDArray[np.int32]:
    """The two children of each node of a binary hierarchy, (k, 2) int32, the smaller first; -1 for leaves."""
    pairs = np.full((len(parents), 2), -1, np.int32)
    for node in range(len(parents)):
        up = parents[node]
        if up != node:
            pairs[up, 1 if pairs[up, 0] >= 0 else 0] = node
    return pairs


class ChildLists(NamedTuple):
    """Children of nodes that may have any number of them: those of node i are ``nodes[starts[i] : starts[i + 1]]``.

    Attributes
    ----------
    starts : (k + 1,) int64
    nodes : (k - 1,) int64
        Ascending for each node.
    """

    starts: NDArray[np.int64]
    nodes: NDArray[np.int64]


def child_lists(parents: NDArray[np.int32]) -> ChildLists:
    """Children of each node of any hierarchy."""
    starts = np.zeros(len(parents) + 1, np.int64)
    np.cumsum(np.bincount(parents[:-1], minlength=len(parents)), out=starts[1:])
    return ChildLists(starts, np.argsort(parents[:-1], kind="stable"))


def accumulate_sequential(parents: NDArray[np.int32], values: NDArray[Any], reduce: Reduction = "sum") -> NDArray[Any]:
    """Values of all nodes from those of the leaves: the sum, the largest or the smallest of all at or below a node.

    Parameters
    ----------
    parents : (k,) int32
    values : (n_leaves, ...) or (k, ...) bool, int or float, without NaN
        If given for all nodes, the values of inner nodes count too.
    reduce : "sum", "max" or "min"

    Returns
    -------
    (k, ...) int64 or float64
        Sums add the children, in ascending order, to the node's own value.
    """
    dtype = np.dtype(np.float64 if values.dtype.kind == "f" else np.int64)
    totals = np.full((len(parents), *values.shape[1:]), _neutral(reduce, dtype), dtype)
    totals[: len(values)] = values
    _accumulate(parents, totals.reshape(len(parents), -1), _REDUCTIONS.index(reduce))
    return totals


def _neutral(reduce: Reduction, dtype: np.dtype[Any]) -> float:
    """Value that changes no result of the reduction."""
    if reduce == "sum":
        return 0
    if dtype.kind == "f":
        return -np.inf if reduce == "max" else np.inf
    return np.iinfo(dtype).min if reduce == "max" else np.iinfo(dtype).max


@kernel
def _accumulate(parents: NDArray[np.int32], values: NDArray[Any], reduction: int) -> None:
    for node in range(len(parents)):
        up = parents[node]
        if up == node:
            continue
        for column in range(values.shape[1]):
            if reduction == 0:
                values[up, column] += values[node, column]
            elif reduction == 1:
                values[up, column] = max(values[up, column], values[node, column])
            else:
                values[up, column] = min(values[up, column], values[node, column])


def propagate_sequential(
    parents: NDArray[np.int32], node_values: NDArray[Any], condition: NDArray[np.bool_]
) -> NDArray[Any]:
    """Values of all nodes, from the root down: a node takes its parent's new value where the condition holds.

    Parameters
    ----------
    parents : (k,) int32
    node_values : (k, ...) any dtype
    condition : (k,) bool
        The root keeps its value in any case.
    """
    return node_values[propagation_sources(parents, condition)]


def roots(parents: NDArray[np.int32]) -> NDArray[np.int32]:
    """Root above each node, (k,) int32, of a forest, which is several hierarchies in one array."""
    return propagation_sources(parents, np.ones(len(parents), np.bool_))


def propagation_sources(parents: NDArray[np.int32], condition: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Node whose value each node has after `propagate_sequential`, (k,) int32: it or one above it."""
    sources = np.empty(len(parents), np.int32)
    _set_sources(parents, condition, sources)
    return sources


@kernel
def _set_sources(parents: NDArray[np.int32], condition: NDArray[np.bool_], sources: NDArray[np.int32]) -> None:
    """Set what `propagation_sources` returns."""
    for node in range(len(parents) - 1, -1, -1):
        parent = parents[node]
        sources[node] = sources[parent] if condition[node] and parent != node else node


class AncestorIndex(NamedTuple):
    """Index that finds lowest common ancestors in a time that does not depend on the hierarchy's depth.

    Where parts merge, the representative leaf of each smaller part is linked to that of the largest part. With each
    link a leaf's part at least doubles, so no chain of links is longer than log2 of the number of leaves.

    Attributes
    ----------
    representatives : (k,) int32
        Leaf at or below each node that represents it.
    links : (n_leaves,) int32
        Representative to which each representative was linked; itself for the last one.
    merges : (n_leaves,) int32
        Node at which it was linked; k, larger than any node, for the last one.
    """

    representatives: NDArray[np.int32]
    links: NDArray[np.int32]
    merges: NDArray[np.int32]


def ancestor_index(parents: NDArray[np.int32]) -> AncestorIndex:
    """Index of a hierarchy, for many calls of `lowest_common_ancestor`."""
    return AncestorIndex(*_linked(parents, num_leaves(parents)))


def lowest_common_ancestors(
    parents: NDArray[np.int32], first: NDArray[np.integer], second: NDArray[np.integer]
) -> NDArray[np.int32]:
    """Lowest common ancestor of each pair of nodes, (m,) int32; the upper node if one is above the other.

    Parameters
    ----------
    parents : (k,) int32
    first, second : (m,) int, 0..k - 1
    """
    ends = np.ascontiguousarray(first, np.int32), np.ascontiguousarray(second, np.int32)
    return _ancestors_of_pairs(ancestor_index(parents), *ends)


@kernel
def lowest_common_ancestor(index: AncestorIndex, a: int, b: int) -> int:
    """Lowest common ancestor of two nodes; the upper one if it is above the other.

    Of the two representatives, the one that was linked first climbs until both meet. If neither node is above the
    other, the nodes meet at the same place, above both. Otherwise the representatives meet at the upper node or below
    it. So the answer is the largest of the three numbers.
    """
    upper = max(a, b)
    a, b = index.representatives[a], index.representatives[b]
    node = a
    while a != b:
        if index.merges[a] < index.merges[b]:
            node, a = index.merges[a], index.links[a]
        else:
            node, b = index.merges[b], index.links[b]
    return max(node, upper)


@kernel
def _ancestors_of_pairs(index: AncestorIndex, first: NDArray[np.int32], second: NDArray[np.int32]) -> NDArray[np.int32]:
    nodes = np.empty(len(first), np.int32)
    for i in range(len(first)):
        nodes[i] = lowest_common_ancestor(index, first[i], second[i])
    return nodes


@kernel
def _linked(
    parents: NDArray[np.int32], n_leaves: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    k = len(parents)
    links, merges = np.arange(n_leaves).astype(np.int32), np.full(n_leaves, k, np.int32)
    representative, leaves = np.arange(k).astype(np.int32), np.zeros(k, np.int64)
    leaves[:n_leaves] = 1
    for node in range(k - 1):
        up = parents[node]
        if leaves[up] == 0:
            representative[up] = representative[node]
        else:
            large, small = representative[up], representative[node]
            if leaves[node] > leaves[up]:
                large, small = small, large
            links[small], merges[small] = large, up
            representative[up] = large
        leaves[up] += leaves[node]
    return representative, links, merges
