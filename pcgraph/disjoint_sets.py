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
