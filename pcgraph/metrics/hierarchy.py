# SPDX-License-Identifier: Apache-2.0
"""Trees given as parents and altitudes: what is checked, who lies below, and which cuts there are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class Cuts:
    """All distinct horizontal cuts of a tree, from the leaves alone to the root.

    Attributes
    ----------
    order : (t,) int64
        Nodes other than leaves, in the order in which they come to be.
    done : (l,) int64
        How many of these have come to be at each cut; 0 first.
    altitudes : (l,) float64, ascending
        A cut holds from its altitude on, up to the next; -inf first.
    regions : (l,) int64
        Segments of each cut.
    """

    order: NDArray[np.int64]
    done: NDArray[np.int64]
    altitudes: NDArray[np.float64]
    regions: NDArray[np.int64]

    @classmethod
    def of(cls, parents: NDArray[np.int64], altitudes: ArrayLike) -> Cuts:
        """The cuts of a tree with such (checked) parents.

        Raises
        ------
        ValueError
            There is not one altitude per node, one is NaN, or they decrease from child to parent.
        """
        heights = np.asarray(altitudes, np.float64)
        if heights.shape != parents.shape:
            raise ValueError(f"expected one altitude per node, {parents.shape}, got {heights.shape}")
        n_leaves = count_leaves(parents)
        inner = heights[n_leaves:]
        if np.isnan(inner).any() or (heights[parents[n_leaves:]] < inner).any():
            raise ValueError("expected altitudes that are numbers and do not decrease from child to parent")
        order = n_leaves + np.argsort(inner, kind="stable")
        levels, first = np.unique(heights[order], return_index=True)
        done = np.append(first, len(order))
        fewer = np.bincount(parents[:-1], minlength=len(parents))[order] - 1
        regions = n_leaves - np.concatenate([[0], np.cumsum(fewer)])[done].astype(np.int64)
        return cls(order, done, np.concatenate([[-np.inf], levels]), regions)


def checked_parents(parents: ArrayLike) -> NDArray[np.int64]:
    """The parents as (k,) int64.

    Raises
    ------
    ValueError
        Parents are not whole numbers, a parent does not come after its node, the root is not last, or a leaf comes
        after another node.
    """
    up = np.asarray(parents)
    if up.dtype.kind not in "iu":
        raise ValueError(f"expected parents that are whole numbers, got {up.dtype}; convert them first")
    up = up.astype(np.int64)
    k = len(up) if up.ndim == 1 else 0
    if k == 0 or up[-1] != k - 1 or (up[:-1] <= np.arange(k - 1)).any() or (up >= k).any():
        raise ValueError("expected parents (k,) each larger than its node, the last node its own parent")
    inner = np.bincount(up[:-1], minlength=k) > 0
    if not inner[count_leaves(up) :].all():
        raise ValueError("expected leaves before all other nodes, got a leaf among those; renumber the nodes")
    return up


def count_leaves(parents: NDArray[np.int64]) -> int:
    """Number of nodes that are nobody's parent: all before the first that is."""
    return int(parents.min()) if len(parents) > 1 else 1


def children(parents: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Children of all nodes, ascending: where each node's begin (k + 1,), and the children in a row (k - 1,)."""
    row = np.argsort(parents[:-1], kind="stable")
    starts = np.zeros(len(parents) + 1, np.int64)
    np.cumsum(np.bincount(parents[:-1], minlength=len(parents)), out=starts[1:])
    return starts, row
