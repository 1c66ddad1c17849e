# SPDX-License-Identifier: Apache-2.0
"""Disjoint sets as one array of links: each element is linked to another of its set, the representative to itself."""

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


@routine
def renumber(labels: NDArray[np.int32], names: NDArray[np.int32], used: int) -> None:
    """Rename labels by `names`, one per label; those named -1 get new names from `used` on, in the order of elements.

    `names` is overwritten.
    """
    for i in range(len(labels)):
        if names[labels[i]] < 0:
            names[labels[i]] = used
            used += 1
        labels[i] = names[labels[i]]


def connected_components(edges: NDArray[np.integer], n: int) -> NDArray[np.int32]:
    """Connected component of each of n nodes, (n,) int32, by edges, (m, 2) int; numbered in order of first nodes."""
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
