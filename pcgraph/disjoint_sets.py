# SPDX-License-Identifier: Apache-2.0
"""Disjoint sets as one array of links: each element leads to another of its set, the representative to itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csgraph

from pcgraph.parallel import routine


@routine
def root_of(links: NDArray[np.integer], element: int) -> int:
    """Representative of an element's set; paths are halved on the way (Tarjan and van Leeuwen 1984)."""
    while links[element] != element:
        links[element] = links[links[element]]
        element = links[element]
    return element


def connected_components(edges: NDArray[np.integer], n: int) -> NDArray[np.int32]:
    """Component of each of n nodes that edges, (m, 2) int, join, (n,) int32, numbered in the order of first nodes."""
    matrix = coo_array((np.ones(len(edges), np.bool_), (edges[:, 0], edges[:, 1])), shape=(n, n))
    return np.asarray(csgraph.connected_components(matrix, directed=False)[1], np.int32)
