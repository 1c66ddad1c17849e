# SPDX-License-Identifier: Apache-2.0
"""A binary heap of edges whose costs may change: the cheapest first, of equals the first in number.

It lives in two index arrays and a size: ``order[:size[0]]`` is the heap, ``place[e]`` where edge e stands in it.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def queued_edges(costs):  # type: ignore[no-untyped-def]
    """Heap of all edges: order, place and size."""
    m = len(costs)
    order, place = np.arange(m), np.arange(m)
    size = np.array([m])
    for at in range(m // 2 - 1, -1, -1):
        _sink(at, costs, order, place, size)
    return order, place, size


@njit(cache=True)
def requeue(e, costs, order, place, size):  # type: ignore[no-untyped-def]
    """Put an edge in its place after its cost changed."""
    _rise(place[e], costs, order, place)
    _sink(place[e], costs, order, place, size)


@njit(cache=True)
def unqueue(e, costs, order, place, size):  # type: ignore[no-untyped-def]
    """Take an edge out."""
    at, last = place[e], size[0] - 1
    size[0] = last
    if at != last:
        moved = order[last]
        order[at], place[moved] = moved, at
        requeue(moved, costs, order, place, size)


@njit(cache=True)
def _before(a, b, costs):  # type: ignore[no-untyped-def]
    return costs[a] < costs[b] or (costs[a] == costs[b] and a < b)


@njit(cache=True)
def _rise(at, costs, order, place):  # type: ignore[no-untyped-def]
    e = order[at]
    while at > 0:
        above = (at - 1) // 2
        if not _before(e, order[above], costs):
            break
        order[at] = order[above]
        place[order[at]] = at
        at = above
    order[at], place[e] = e, at


@njit(cache=True)
def _sink(at, costs, order, place, size):  # type: ignore[no-untyped-def]
    e = order[at]
    while True:
        below = 2 * at + 1
        if below >= size[0]:
            break
        if below + 1 < size[0] and _before(order[below + 1], order[below], costs):
            below += 1
        if not _before(order[below], e, costs):
            break
        order[at] = order[below]
        place[order[at]] = at
        at = below
    order[at], place[e] = e, at
