# SPDX-License-Identifier: Apache-2.0
"""Disjoint sets as one array of links: each element leads to another of its set, the representative to itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.parallel import kernel


@kernel
def root_of(links: NDArray[np.integer], element: int) -> int:
    """Representative of an element's set; paths are halved on the way (Tarjan and van Leeuwen 1984)."""
    while links[element] != element:
        links[element] = links[links[element]]
        element = links[element]
    return element


@kernel
def connected_components(edges: NDArray[np.int32], n: int) -> NDArray[np.int32]:
    """Component of each of n nodes that edges, (m, 2) int32, join, (n,) int32, numbered in the order of first nodes."""
    links = np.arange(n)
    for edge in range(len(edges)):
        a, b = root_of(links, edges[edge, 0]), root_of(links, edges[edge, 1])
        links[max(a, b)] = min(a, b)
    components, found = np.empty(n, np.int32), 0
    for node in range(n):
        root = root_of(links, node)
        if root == node:
            components[node], found = found, found + 1
        else:
            components[node] = components[root]
    return components
