# SPDX-License-Identifier: Apache-2.0
"""Cuts: the node of the tree that each leaf ends up in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.tree.cores import core_of_leaf, size_cores
from pcgraph.tree.segments import children_of, tops_below
from pcgraph.tree.stability import stable_nodes


def horizontal_cut(
    parents: NDArray[np.int32],
    altitudes: NDArray[np.float64],
    counts: NDArray[np.int64],
    n: int | None,
    altitude: float | None,
    min_size: int,
) -> NDArray[np.int32]:
    """Node of each leaf, (n_leaves,) int32, after the merges up to an altitude or down to a number of segments.

    Parameters
    ----------
    parents, altitudes : (k,) int32, (k,) float64
        As in `SegmentationTree`.
    counts : (k,) int64
        Points of each node.
    n, altitude, min_size
        As for `SegmentationTree.cut`, with its errors.
    """
    n_leaves = (len(parents) + 1) // 2
    if _whole("min_size", min_size) == 1:
        last = n_leaves + _merges(altitudes[n_leaves:], n, altitude, n_leaves)
        return tops_below(parents, last)[:n_leaves].copy()
    cores = size_cores(parents, counts, min_size)
    merges = _merges(altitudes[n_leaves:], n, altitude, len(cores.joins) + 1)
    last = n_leaves + merges
    if n is not None:  # so many of the merges that join cores
        last = int(cores.joins[merges - 1]) + 1 if merges > 0 else 0
    return tops_below(parents, last)[cores.of_leaf]


def stable_cut(
    parents: NDArray[np.int32], altitudes: NDArray[np.float64], counts: NDArray[np.int64], min_size: int
) -> NDArray[np.int32]:
    """Node of each leaf, (n_leaves,) int32, in the most stable segmentation; see `SegmentationTree.cut_stable`."""
    least = min(_whole("min_size", min_size), int(counts[-1]))
    chosen = stable_nodes(parents, altitudes, counts, least)
    if not chosen.any():  # only parts that do not touch, each too small
        chosen[-1] = True
    return core_of_leaf(parents, children_of(parents), counts, chosen)


def _merges(merge_altitudes: NDArray[np.float64], n: int | None, altitude: float | None, most: int) -> int:
    """Number of merges that a cut does; of a tree with `most` segments at its finest."""
    if n is not None and altitude is None:
        if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or not 1 <= n <= most:
            raise ValueError(f"expected a whole number n of 1..{most} segments, got {n!r}")
        return most - int(n)
    if altitude is None or n is not None:
        raise ValueError(f"expected either n or altitude, got n={n} and altitude={altitude}")
    level = np.asarray(altitude)
    if level.ndim or level.dtype.kind not in "fiu" or np.isnan(level):
        raise ValueError(f"expected altitude as a number in the linkage's unit, got {altitude!r}")
    return int(np.searchsorted(merge_altitudes, float(level), side="right"))


def _whole(name: str, value: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"expected {name} as a whole number of at least 1, got {value!r}")
    return int(value)
