# SPDX-License-Identifier: Apache-2.0
"""Pooling: values of points up the tree, values of nodes down to the points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.moments import accumulate_sums
from pcgraph.segmentation import Segmentation
from pcgraph.tree.tree import SegmentationTree

REDUCTIONS = ("sum", "mean", "max", "min")
_LARGEST_SUM = 2.0**62  # half of what int64 holds, so that rounding decides nothing


def pool_up(
    tree: SegmentationTree, values: ArrayLike, weights: ArrayLike | None = None, reduce: str = "mean"
) -> NDArray[Any]:
    """Values of all k nodes of a tree from those of its leaves.

    Parameters
    ----------
    tree : SegmentationTree of k nodes
    values : (n_leaves,) or (n_leaves, c) bool, int or float
        NaN stands for a missing value: it is left out.
    weights : (n_leaves,) float or int, >= 0, optional
        What a leaf counts in a mean; default: its number of points. The other reductions take none.
    reduce : "mean", "sum", "max" or "min"

    Returns
    -------
    (k,) or (k, c)
        The leaves come first, as they were. Sums of whole numbers are int64, and exact; all else is float64.
        A node without any value has NaN (0 as a sum).

    Raises
    ------
    ValueError
        A shape does not fit the tree, a weight is negative, `reduce` is unknown, or whole numbers are too large to be
        summed: their sizes may add up to 2**62.
    """
    table, flat = _table(values, tree.n_leaves, "values", "leaves")
    if reduce not in REDUCTIONS:
        raise ValueError(f"expected reduce as one of {', '.join(REDUCTIONS)}, got {reduce!r}")
    if weights is not None and reduce != "mean":
        raise ValueError(f"expected no weights for reduce={reduce!r}; only a mean weighs")
    if reduce == "mean":
        pooled = _mean_up(tree, table, _weights(weights, tree))
    elif reduce == "sum":
        pooled = _sum_up(tree, table)
    else:
        sign = 1.0 if reduce == "max" else -1.0
        known = ~np.isnan(table)
        highest = np.full((len(tree.parents), table.shape[1]), -np.inf)
        highest[: tree.n_leaves] = np.where(known, sign * table, -np.inf)
        _max_to_parents(tree.parents, highest)
        pooled = np.where(_sum_up(tree, known) > 0, sign * highest, np.nan)
    return pooled[:, 0] if flat else pooled


def pool_points(segmentation: Segmentation, values: ArrayLike, reduce: str = "mean") -> NDArray[Any]:
    """Values of all k nodes of the tree from those of the points below each of them.

    Parameters
    ----------
    segmentation : Segmentation
    values : the points' leading shape, or that + (c,); bool, int or float
        One row per point that was segmented. Points that are not finite are left out, and so is NaN.
    reduce : "mean", "sum", "max" or "min"
        Every point counts the same.

    Returns
    -------
    (k,) or (k, c)
        As `pool_up` returns it.

    Raises
    ------
    ValueError
        The shape is not that of the points, `reduce` is unknown, or whole numbers are too large to be summed.
    """
    if reduce not in REDUCTIONS:
        raise ValueError(f"expected reduce as one of {', '.join(REDUCTIONS)}, got {reduce!r}")
    leaf, table, flat = _on_finite_points(segmentation, values)
    tree, known = segmentation.tree, ~np.isnan(table)
    if reduce in ("max", "min"):
        extreme = np.full((tree.n_leaves, table.shape[1]), np.nan)
        (np.fmax if reduce == "max" else np.fmin).at(extreme, leaf, table.astype(np.float64))
        pooled = pool_up(tree, extreme, reduce=reduce)
    else:
        values = _summable(np.where(known, table, 0)) if reduce == "sum" else np.where(known, table, 0.0)
        pooled = _sum_up(tree, _sums(leaf, values, tree.n_leaves))
        if reduce == "mean":
            with np.errstate(invalid="ignore"):
                pooled = pooled / _sum_up(tree, _sums(leaf, known.astype(np.int64), tree.n_leaves))
    return pooled[:, 0] if flat else pooled


def down(segmentation: Segmentation, values: ArrayLike, nodes: ArrayLike | None = None) -> NDArray[Any]:
    """Values of nodes on the points, in the shape the points came in.

    Parameters
    ----------
    segmentation : Segmentation
    values : (n_leaves,) + s or (k,) + s
        One row per supervoxel, or one per node of the tree.
    nodes : (n_leaves,) int, optional
        Node from which each supervoxel takes its value, for example ``tree.cut_nodes(n=5)``; needs a row of
        `values` per node of the tree. Default: the supervoxels themselves.

    Returns
    -------
    the points' leading shape + s
        Points that are not finite have NaN, or -1 where the values are whole numbers, or False.

    Raises
    ------
    ValueError
        `values` has another number of rows, or `nodes` are not nodes of the tree.
    """
    array, tree = np.asarray(values), segmentation.tree
    n, k = tree.n_leaves, len(tree.parents)
    if array.ndim == 0 or len(array) not in (n, k):
        raise ValueError(f"expected one row of values per supervoxel ({n}) or per node ({k}), got {array.shape}")
    if nodes is None:
        array = array[:n]
    else:
        chosen = np.asarray(nodes)
        if chosen.shape != (n,) or chosen.dtype.kind not in "iu" or chosen.min() < 0 or chosen.max() >= k:
            raise ValueError(f"expected nodes as ({n},) whole numbers of 0..{k - 1}, got {nodes!r}")
        if len(array) != k:
            raise ValueError(f"expected one row of values per node ({k}) where nodes are given, got {len(array)}")
        array = array[chosen]
    return segmentation.on_points(array)


def _mean_up(tree: SegmentationTree, table: NDArray[Any], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    known = ~np.isnan(table) & (weights > 0.0)[:, None]
    sums = _sum_up(tree, np.where(known, table, 0) * weights[:, None])
    totals = _sum_up(tree, known * weights[:, None])
    means = np.full(sums.shape, np.nan)
    np.divide(sums, totals, out=means, where=totals > 0)
    means[: tree.n_leaves] = table
    return means


def _sum_up(tree: SegmentationTree, table: NDArray[Any]) -> NDArray[Any]:
    values = _summable(np.where(np.isnan(table), 0, table))
    sums = np.zeros((len(tree.parents), table.shape[1]), values.dtype)
    sums[: tree.n_leaves] = values
    accumulate_sums(tree.parents, sums)
    return sums


def _sums(leaf: NDArray[np.int32], table: NDArray[Any], n: int) -> NDArray[Any]:
    """Sums of the points' rows by leaf, (n, c), of the table's dtype."""
    sums = np.zeros((n, table.shape[1]), table.dtype)
    np.add.at(sums, leaf, table)
    return sums


def _summable(table: NDArray[Any]) -> NDArray[Any]:
    """The table as int64 if it holds whole numbers, as float64 otherwise."""
    if table.dtype.kind == "f":
        return table.astype(np.float64)
    if (np.abs(table.astype(np.float64)).sum(axis=0) > _LARGEST_SUM).any():
        raise ValueError(
            "expected whole numbers whose sizes add up to 2**62 at most, got larger ones; pass them as float"
        )
    return table.astype(np.int64)


@njit(cache=True)
def _max_to_parents(parents: NDArray[np.int32], values: NDArray[np.float64]) -> None:
    for node in range(len(parents)):
        up = parents[node]
        if up != node:
            for c in range(values.shape[1]):
                values[up, c] = max(values[up, c], values[node, c])


def _weights(weights: ArrayLike | None, tree: SegmentationTree) -> NDArray[np.float64]:
    if weights is None:
        return tree.moments.counts[: tree.n_leaves].astype(np.float64)
    array = np.asarray(weights, np.float64)
    if array.shape != (tree.n_leaves,) or not (np.isfinite(array) & (array >= 0)).all():
        raise ValueError(f"expected weights as ({tree.n_leaves},) finite numbers of at least 0, got {weights!r}")
    return array


def _table(values: ArrayLike, rows: int, name: str, what: str) -> tuple[NDArray[Any], bool]:
    """Values as (rows, c), and whether they came as (rows,)."""
    array = np.asarray(values)
    if array.dtype.kind not in "buif" or array.ndim not in (1, 2) or len(array) != rows:
        raise ValueError(f"expected {name} of {rows} {what} as numbers, one row each, got {array.shape} {array.dtype}")
    return array.reshape(rows, -1), array.ndim == 1


def _on_finite_points(segmentation: Segmentation, values: ArrayLike) -> tuple[NDArray[np.int32], NDArray[Any], bool]:
    """Leaf and values, (n, c), of the finite points, and whether there was one value per point."""
    array, shape = np.asarray(values), segmentation.supervoxels.shape
    if array.shape[: len(shape)] != shape or array.ndim > len(shape) + 1:
        raise ValueError(f"expected values of the points' shape {shape} or {(*shape, 'c')}, got {array.shape}")
    leaf = segmentation.supervoxels.ravel()
    table, flat = _table(array.reshape(leaf.size, *array.shape[len(shape) :]), leaf.size, "values", "points")
    finite = leaf >= 0
    return leaf[finite], table[finite], flat
