# SPDX-License-Identifier: Apache-2.0
"""Colours of a tree's nodes, which segments keep from level to level."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def node_colors(parents: NDArray[np.integer], sizes: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Colour of each node of a tree, (k, 3) uint8, red green blue; a node has the colour of its largest child.

    So a finer cut changes the colours of small parts only. The cut into n segments has the first n colours of
    `distinct_colors`.

    Parameters
    ----------
    parents : (k,) int
        Parent of each node; the leaves come first, and the root, which is its own parent, last.
    sizes : (n_leaves,) int
        Number of points of each leaf.

    Examples
    --------
    >>> import numpy as np
    >>> colors = node_colors(np.array([3, 3, 4, 4, 4]), np.array([1, 7, 5]))
    >>> (colors[3] == colors[1]).all() and (colors[4] == colors[1]).all()
    np.True_
    """
    leaves, nodes = len(sizes), len(parents)
    total, largest, chief = np.zeros(nodes, np.int64), np.full(nodes, -1, np.int64), np.arange(nodes)
    total[:leaves] = sizes
    for node in range(nodes - 1):  # children come before parents
        parent = parents[node]
        total[parent] += total[node]
        if total[node] > largest[parent]:
            largest[parent], chief[parent] = total[node], chief[node]
    rank = np.zeros(leaves, np.int64)
    highest = np.flatnonzero((chief != chief[parents]) | (np.arange(nodes) == parents))[::-1]  # the root first
    rank[chief[highest[np.argsort(-parents[highest], kind="stable")]]] = np.arange(leaves)
    return distinct_colors(leaves)[rank[chief]]


def distinct_colors(count: int) -> NDArray[np.uint8]:
    """Colours, (count, 3) uint8, red green blue; neighbours in the list have very different hues."""
    from matplotlib.colors import hsv_to_rgb

    i = np.arange(count)
    hue = (0.58 + i * 0.618033988749895) % 1  # from a blue on
    hsv = np.stack([hue, 0.45 + 0.35 * ((i * 0.754877666) % 1), 0.62 + 0.33 * ((i * 0.569840296) % 1)], axis=-1)
    return np.rint(255 * hsv_to_rgb(hsv)).astype(np.uint8)
