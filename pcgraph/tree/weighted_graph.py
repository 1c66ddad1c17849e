# SPDX-License-Identifier: Apache-2.0
"""Trees of weighted graphs without points: pairs of nodes, and a dissimilarity for each pair."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.tree.average_linkage import average_linkage
from pcgraph.tree.felzenszwalb import scale_linkage
from pcgraph.tree.linkage import Merges
from pcgraph.tree.single_linkage import single_linkage
from pcgraph.tree.tree import SegmentationTree, tree_without_points

_MAX_NODES = 2**30
"""Largest count of nodes in a graph, because a tree has twice as many, less one, and numbers them in int32."""
_LINKAGES: dict[str, Callable[[int, NDArray[np.int32], NDArray[np.float64]], Merges]] = {
    "single": single_linkage,
    "average": lambda n_nodes, edges, weights: average_linkage(n_nodes, edges, weights, np.ones(len(edges))),
    "felzenszwalb": scale_linkage,
}


def tree_of_graph(
    edges: ArrayLike,
    weights: ArrayLike,
    n_nodes: int | None = None,
    *,
    linkage: str = "single",
    sizes: ArrayLike | None = None,
) -> SegmentationTree:
    """Tree of a weighted graph of your own; no points are needed.

    Parameters
    ----------
    edges : (m, 2) int, 0..n_nodes - 1
        Pairs of distinct nodes, each pair once, in any order.
    weights : (m,) float, >= 0, finite
        Dissimilarity of the two nodes of each edge: small where they belong together.
    n_nodes : int, optional
        Number of nodes. Default: the largest in `edges`, plus one.
    linkage : "single", "average" or "felzenszwalb"
        Altitude at which two parts merge. "single": the least weight of the edges between them (quasi-flat zones).
        "average": the mean weight of the edges between them (UPGMA along the graph). "felzenszwalb": Felzenszwalb and
        Huttenlocher's scale k, in units of the weights times nodes.
    sizes : (n_nodes,) int, >= 1, optional
        Number of points that each node stands for. It matters for `min_size` and for parts that no path connects, not
        for the altitudes. Default: 1.

    Returns
    -------
    SegmentationTree
        Tree whose leaves are the nodes. It has no moments, and so no `features` and no `plane_energy`. Parts that no
        path connects join at infinite altitude, the smallest first, each to the largest part.

    Raises
    ------
    ValueError
        An argument has another type, shape or range than described above.

    Notes
    -----
    On the complete graph of all pairs, "single" and "average" are SciPy's linkages of those names.

    Examples
    --------
    >>> tree = tree_of_graph([[0, 1], [1, 2], [2, 3]], [0.1, 0.9, 0.2])
    >>> tree.cut(n=2)
    array([0, 0, 1, 1], dtype=int32)
    >>> tree.lowest_common_ancestor(0, 1), tree.leaves_of(4), tree.path(0)
    (4, array([0, 1], dtype=int32), array([0, 4, 6], dtype=int32))
    """
    if not isinstance(linkage, str) or linkage not in _LINKAGES:
        raise ValueError(f"expected linkage as one of {', '.join(_LINKAGES)}, got {linkage!r}")
    pairs, costs = _checked_edges(edges), np.asarray(weights)
    if costs.shape != (len(pairs),) or costs.dtype.kind not in "fiu":
        raise ValueError(
            f"expected {len(pairs)} weights, one number per edge, got {costs.dtype} of shape {costs.shape}"
        )
    if not (np.isfinite(costs) & (costs >= 0)).all():
        raise ValueError("expected weights that are finite and not negative: dissimilarities, small within a segment")
    n = _node_count(n_nodes, int(pairs.max(initial=-1)))
    _check_each_pair_once(pairs, n)
    merges = _LINKAGES[linkage](n, pairs.astype(np.int32), costs.astype(np.float64))
    return tree_without_points(merges, _checked_sizes(sizes, n))


def _checked_edges(edges: ArrayLike) -> NDArray[np.integer]:
    pairs = np.asarray(edges)
    if not pairs.size:
        return np.empty((0, 2), np.int32)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu":
        raise ValueError(f"expected edges (m, 2) of whole numbers, got {pairs.dtype} of shape {pairs.shape}")
    if pairs.min() < 0 or (pairs[:, 0] == pairs[:, 1]).any():
        raise ValueError("expected edges between two different nodes, numbered from 0; leave out loops")
    return pairs


def _node_count(n_nodes: int | None, last: int) -> int:
    """Number of nodes of a graph; `last` is the largest node in its edges."""
    n = last + 1 if n_nodes is None else n_nodes
    if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or not max(last, 0) < n <= _MAX_NODES:
        raise ValueError(f"expected n_nodes as a whole number from {max(last, 0) + 1} to {_MAX_NODES}, got {n!r}")
    return int(n)


def _check_each_pair_once(pairs: NDArray[np.integer], n_nodes: int) -> None:
    low, high = np.sort(pairs.astype(np.int64), axis=1).T
    codes, times = np.unique(low * n_nodes + high, return_counts=True)
    if len(codes) < len(pairs):
        again = divmod(int(codes[times > 1][0]), n_nodes)
        raise ValueError(f"expected each pair of nodes once, got {again} twice or in both directions; keep one of them")


def _checked_sizes(sizes: ArrayLike | None, n_nodes: int) -> NDArray[np.int64]:
    counts = np.ones(n_nodes, np.int64) if sizes is None else np.asarray(sizes)
    if counts.shape != (n_nodes,) or counts.dtype.kind not in "iu" or (counts < 1).any():
        raise ValueError(f"expected sizes ({n_nodes},) of whole numbers, at least 1, got {counts.dtype} {counts.shape}")
    return counts.astype(np.int64)
