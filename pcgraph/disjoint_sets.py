# SPDX-License-Identifier: Apache-2.0
"""Disjoint sets as one array of links: each element leads to another of its set, the representative to itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import kernel, routine


@routine
def root_of(links: NDArray[np.integer], element: int) -> int:
    """Representative of an element's set; paths are halved on the way (Tarjan and van Leeuwen 1984)."""
    while links[element] != element:
        links[element] = links[links[element]]
        element = links[element]
    return element


def connected_components(edges: NDArray[np.integer], n: int) -> NDArray[np.int32]:
    """Component of each of n nodes that edges, (m, 2) int, join, (n,) int32, numbered in the order of first nodes."""
    links, component = np.arange(n, dtype=np.int32), np.empty(n, np.int32)
    _connect(np.ascontiguousarray(edges, np.int64), links, component)
    return component


@kernel
def _connect(edges: NDArray[np.int64], links: NDArray[np.int32], component: NDArray[np.int32]) -> None:
    """Set the component of each node; the representative of a set is its first node."""
    for e in range(len(edges)):
        a, b = root_of(links, edges[e, 0]), root_of(links, edges[e, 1])
        links[max(a, b)] = min(a, b)
    n = 0
    for node in range(len(links)):
        root = root_of(links, node)
        if root == node:
            component[node] = n
            n += 1
        else:
            component[node] = component[root]
