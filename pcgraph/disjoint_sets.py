# SPDX-License-Identifier: Apache-2.0
"""Disjoint sets as one array of links: each element is linked to another of its set, the representative to itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csgraph

from pcgraph.parallel import kernel


@kernel
def root_of(links: NDArray[np.integer], element: int) -> int:
    """Representative of an element's set; paths are halved on the way (Tarjan and van Leeuwen 1984)."""
    while links[element] != element:
        links[element] = links[links[element]]
        element = links[element]
    return element


@kernel
def renumbered(labels: NDArray[np.int32], names: NDArray[np.int32], used: int) -> NDArray[np.int32]:
    """Labels renamed by `names`, one per label; those named -1 get new names from `used` on, in the order of elements.

    `names` is overwritten.
    """
    numbered = np.empty(len(labels), np.int32)
    for i in range(len(labels)):
        if names[labels[i]] < 0:
            names[labels[i]] = used
            used += 1
        numbered[i] = names[labels[i]]
    return numbered


def connected_components(edges: NDArray[np.integer], n: int) -> NDArray[np.int32]:
    """Connected component of each of n nodes, (n,) int32, by edges, (m, 2) int; numbered in order of first nodes."""
    matrix = coo_array((np.ones(len(edges), np.bool_), (edges[:, 0], edges[:, 1])), shape=(n, n))
    return np.asarray(csgraph.connected_components(matrix, directed=False)[1], np.int32)
