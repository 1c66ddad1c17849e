# SPDX-License-Identifier: Apache-2.0
"""The segments that last longest: excess of mass, as in HDBSCAN, over altitudes."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.tree.segments import children_of


def persistences(parents: NDArray[np.int32], altitudes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Range of altitudes over which each node is a segment of the horizontal cuts, (k,) float64.

    Parent's altitude less the node's own; infinite for what never merges below infinity, 0 for nodes that are
    born at infinity.
    """
    above = altitudes[parents]
    above[-1] = np.inf
    born = np.isfinite(altitudes)
    return np.subtract(above, altitudes, out=np.zeros(len(parents)), where=born)


def stable_nodes(
    parents: NDArray[np.int32], altitudes: NDArray[np.float64], counts: NDArray[np.int64], min_size: int
) -> NDArray[np.bool_]:
    """Whether each node is chosen, (k,) bool: nodes of the largest total stability, none above another.

    A branch is a segment from where it first has `min_size` points; a merge with something smaller does not end
    it. Its stability is the sum of points x persistence over its nodes. Persistence ends at the largest finite
    altitude. The nodes chosen are the tops of branches; of equal stability the coarser one is taken. Leaves
    below no chosen node are left to the caller.

    Parameters
    ----------
    parents, altitudes : (k,)
        As in `SegmentationTree`.
    counts : (k,) int64
        Points of each node.
    min_size : int

    Notes
    -----
    Source: Campello et al. 2015, with altitude in place of 1 / density, so what lasts long at high altitude
    counts as much as what lasts long at low altitude.
    """
    finite = altitudes[np.isfinite(altitudes)].max()
    levels = np.minimum(altitudes, finite)
    return _choose(parents, children_of(parents), levels, np.isinf(altitudes), counts, min_size)


@njit(cache=True)
def _choose(parents, children, levels, across_gap, counts, min_size):  # type: ignore[no-untyped-def]
    k = len(parents)
    own, best = np.zeros(k), np.zeros(k)
    taken = np.zeros(k, np.bool_)
    for node in range(k):
        a, b = children[node]
        up = parents[node]
        below = 0.0
        if a >= 0:
            below = best[a] + best[b]
        if counts[node] < min_size or across_gap[node]:
            best[node] = below
            continue
        if a >= 0 and (counts[a] < min_size) != (counts[b] < min_size):
            own[node] = own[a] if counts[a] >= min_size else own[b]  # the branch goes on
        own[node] += counts[node] * (levels[up] - levels[node])
        # Where a branch goes on, the node above has all of this and more, so it takes over by itself.
        taken[node] = own[node] >= below
        best[node] = max(own[node], below)
    for node in range(k - 2, -1, -1):
        if taken[parents[node]]:
            taken[node] = True
    for node in range(k - 1):  # the highest of each chain of taken nodes
        if taken[parents[node]]:
            taken[node] = False
    return taken
