# SPDX-License-Identifier: Apache-2.0
"""The segmentation tree: from supervoxels to the whole scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.moments import Moments, moments_up_tree
from pcgraph.features.nodes import NodeFeatures, node_features, rows, scalar_columns
from pcgraph.hierarchy import (
    accumulate_sequential,
    binary_children,
    lowest_common_ancestors,
    propagation_sources,
    roots,
)
from pcgraph.inputs import non_negative
from pcgraph.pairs import nearest
from pcgraph.plumbing.plain_dict import plain
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.tree.cuts import horizontal_cut, numbered_segments, persistences
from pcgraph.tree.linkage import Merges
from pcgraph.tree.optimal_cut import Energy, appearance_scales

if TYPE_CHECKING:
    import networkx

_N_NEAREST = 8
"""Count of nearest leaves among which each leaf looks for one of a larger part: enough to look past its own part.
Chosen by eye; not varied."""


@dataclass(frozen=True, eq=False)
class SegmentationTree(ShortRepr):
    """Binary merge tree; every cut of it is a segmentation, and all cuts at altitudes nest.

    Attributes
    ----------
    parents : (k,) int32
        Parent of each node, larger than the node's own number; the root (last node) is its own parent. The first
        `n_leaves` nodes are the supervoxels, in their order. k = 2 n_leaves - 1.
    altitudes : (k,) float64, the linkage's unit
        Cost at which each node came to be: 0 for leaves, not decreasing with the node's number, infinite where parts
        that do not touch were joined.
    moments : Moments of k groups, or None
        Moments of the points below each node; None for a tree of a graph without points (`pcgraph.tree_of_graph`).
    leaf_sizes : (n_leaves,) int64, or None
        Number of points of each leaf of a tree without moments.

    Examples
    --------

    >>> import pcgraph
    >>> tree = pcgraph.tree_of_graph([[0, 1], [1, 2], [2, 3]], [0.1, 0.9, 0.2])
    >>> tree.root, tree.children[tree.root].tolist(), tree.leaves_of(4).tolist(), tree.path(0).tolist()
    (6, [4, 5], [0, 1], [0, 4, 6])
    """

    parents: NDArray[np.int32]
    altitudes: NDArray[np.float64]
    moments: Moments | None = None
    leaf_sizes: NDArray[np.int64] | None = None

    def _counts(self) -> str:
        apart = np.count_nonzero(np.isinf(self.altitudes))
        what = f", {apart + 1} parts that do not touch" if apart else ""
        return f"{self.n_leaves} leaves, {self.n_nodes} nodes{what}"

    @property
    def n_leaves(self) -> int:
        """Number of supervoxels."""
        return (len(self.parents) + 1) // 2

    @property
    def n_nodes(self) -> int:
        """Number of nodes, 2 n_leaves - 1."""
        return len(self.parents)

    @property
    def root(self) -> int:
        """The root, which is the last node."""
        return self.n_nodes - 1

    @cached_property
    def children(self) -> NDArray[np.int32]:
        """The two children of each node, (k, 2) int32, the smaller number first; -1 for leaves."""
        return binary_children(self.parents)

    @cached_property
    def sizes(self) -> NDArray[np.int64]:
        """Number of points of each node, (k,) int64; each leaf counts 1 without moments and without `leaf_sizes`."""
        if self.moments is not None:
            return self.moments.counts
        leaves = np.ones(self.n_leaves, np.int64) if self.leaf_sizes is None else self.leaf_sizes
        return accumulate_sequential(self.parents, leaves)

    def leaves_of(self, node: int) -> NDArray[np.int32]:
        """Leaves at or below a node, ascending, (s,) int32; each call takes time in proportion to the whole tree.

        Raises
        ------
        ValueError
            The tree has no such node.
        """
        top = self._node("node", node)
        above = propagation_sources(self.parents, np.arange(self.n_nodes) != top)[: self.n_leaves]
        return np.flatnonzero(above == top).astype(np.int32)

    def path(self, node: int) -> NDArray[np.int32]:
        """Nodes from a node up to the root, both included, (d,) int32.

        Raises
        ------
        ValueError
            The tree has no such node.
        """
        nodes = [self._node("node", node)]
        while nodes[-1] != self.root:
            nodes.append(int(self.parents[nodes[-1]]))
        return np.array(nodes, np.int32)

    def lowest_common_ancestor(self, a: int, b: int) -> int:
        """The lowest node above two nodes; the upper one of them if that is above the other.

        For many pairs use `lowest_common_ancestors`.

        Raises
        ------
        ValueError
            The tree has no such node.
        """
        return int(self.lowest_common_ancestors([[self._node("a", a), self._node("b", b)]])[0])

    def _node(self, name: str, node: int) -> int:
        if isinstance(node, bool) or not isinstance(node, (int, np.integer)) or not 0 <= node <= self.root:
            raise ValueError(f"expected {name} as a node of this tree, a whole number 0..{self.root}, got {node!r}")
        return int(node)

    @property
    def persistence(self) -> NDArray[np.float64]:
        """Range of altitudes over which each node is a segment of the cuts, (k,) float64.

        It is infinite for nodes that never merge below infinity, and 0 for nodes that come to be at infinity.
        """
        return persistences(self.parents, self.altitudes)

    def cut(self, n: int | None = None, altitude: float | None = None, min_size: int = 1) -> NDArray[np.int32]:
        """Segment of each leaf, (n_leaves,) int32, numbered from 0 in the order of their first leaf.

        Segments of points are ``tree.cut(n=5)[supervoxels]``, or `Segmentation.cut`, which keeps the -1 of points
        without a supervoxel.

        Parameters
        ----------
        n : int, 1..n_leaves
            Exact number of segments.
        altitude : float, the linkage's unit
            All merges up to and including this cost are done.
        min_size : int, points
            No segment has fewer, unless the whole tree has. A smaller one goes where the tree would have merged it: to
            the first node above with enough points, and from there down into the larger child. Cuts with the same
            `min_size` nest.

        Raises
        ------
        ValueError
            Not exactly one of the first two is given, n is out of range (for this `min_size`), altitude is not a
            number, or `min_size` is not a whole number of at least 1.
        """
        return self._segments(self.cut_nodes(n, altitude, min_size))

    def cut_nodes(self, n: int | None = None, altitude: float | None = None, min_size: int = 1) -> NDArray[np.int32]:
        """Node of the tree for each leaf after a cut, (n_leaves,) int32; parameters as for `cut`.

        The node is above the leaf, except for leaves that went to another segment because of `min_size`.
        """
        return horizontal_cut(self.parents, self.altitudes, self.sizes, n, altitude, min_size)

    def levels(self, altitudes: ArrayLike) -> NDArray[np.int32]:
        """Segment of each leaf at several altitudes, (n_leaves, l) int32.

        With rising altitudes every column refines the next one.

        Parameters
        ----------
        altitudes : (l,) float, the linkage's unit
            For example ``[0.0, 0.06, 0.5, np.inf]``.

        Raises
        ------
        ValueError
            An altitude is not a number.
        """
        columns = [self.cut(altitude=level) for level in np.ravel(altitudes).tolist()]
        return np.stack(columns, axis=1) if columns else np.empty((self.n_leaves, 0), np.int32)

    def cut_optimal(self, energy: Energy, scale: float) -> NDArray[np.int32]:
        """Segment of each leaf in the cut of least energy, (n_leaves,) int32, numbered as in `cut`.

        Of all ways to cut the tree, at one altitude or at several, it is the one with the least sum over its segments
        of data + scale x complexity. Cuts at rising scales nest. Parts that join at infinite altitude stay apart.

        Parameters
        ----------
        energy : Energy
            k rows, for example `plane_energy(tree)`.
        scale : float, >= 0, finite
            Lambda of Guigues et al. 2006.

        Raises
        ------
        ValueError
            `energy` is none or has another number of rows, or scale is not a finite number >= 0.
        """
        return self.by_energy(energy).cut(altitude=non_negative("scale", scale))

    def by_energy(self, energy: Energy) -> SegmentationTree:
        """Tree of the same merges with the scale as altitude: the persistent hierarchy of optimal cuts.

        Its cut at an altitude is the optimal cut at that scale (Guigues et al. 2006). A node that is in no optimal cut
        has the altitude of one above it. Inner nodes are renumbered in the order of scales.

        Raises
        ------
        ValueError
            `energy` is none, has another number of rows than the tree has nodes, or leaves with infinite data.
        """
        if not isinstance(energy, Energy):
            raise ValueError(f"expected an Energy, got {type(energy).__name__}; make it with plane_energy(tree)")
        if len(energy.data) != len(self.parents) or np.isinf(energy.data[: self.n_leaves]).any():
            raise ValueError(
                f"expected an energy with {len(self.parents)} rows, finite for leaves, got {len(energy.data)}; "
                "make it from this tree"
            )
        data = np.where(np.isinf(self.altitudes), np.inf, energy.data)
        return self.with_altitudes(appearance_scales(self.parents, data, energy.complexity.astype(np.float64)))

    def with_altitudes(self, altitudes: ArrayLike) -> SegmentationTree:
        """Tree of the same merges at other altitudes; inner nodes are renumbered so that altitudes do not decrease.

        Parameters
        ----------
        altitudes : (k,) float
            0 for leaves; a node's is not above its parent's. Nodes of equal altitudes keep their order.

        Raises
        ------
        ValueError
            The altitudes are not as above.
        """
        levels = np.asarray(altitudes, np.float64)
        leaves = slice(0, self.n_leaves)
        if levels.shape != self.parents.shape or levels[leaves].any() or not (levels <= levels[self.parents]).all():
            raise ValueError(
                f"expected altitudes ({len(self.parents)},), 0 for leaves and not above the parent's, "
                f"got shape {levels.shape}; give one per node in the tree's order"
            )
        inner = self.n_leaves + np.argsort(levels[self.n_leaves :], kind="stable")
        order = np.concatenate((np.arange(self.n_leaves), inner))
        rank = np.empty(len(order), np.int32)
        rank[order] = np.arange(len(order), dtype=np.int32)
        moments = None if self.moments is None else self.moments[order]
        return SegmentationTree(rank[self.parents[order]], levels[order], moments, self.leaf_sizes)

    def edge_saliency(self, pairs: ArrayLike) -> NDArray[np.float64]:
        """Altitude at which the two nodes of each pair become one segment, (m,) float64, the linkage's unit.

        On the edges of the graph this is the ultrametric contour map: edges above a level are the boundaries of the cut
        at that altitude.

        Parameters
        ----------
        pairs : (m, 2) int, 0..k - 1
            For example ``graph.edges``.

        Raises
        ------
        ValueError
            Pairs are not (m, 2) whole numbers, or not nodes of the tree.
        """
        return self.altitudes[self.lowest_common_ancestors(pairs)]

    def lowest_common_ancestors(self, pairs: ArrayLike) -> NDArray[np.int32]:
        """Lowest node above both nodes of each pair, (m,) int32; the upper one of them if that is above the other.

        Parameters
        ----------
        pairs : (m, 2) int, 0..k - 1

        Raises
        ------
        ValueError
            Pairs are not (m, 2) whole numbers, or not nodes of the tree.
        """
        nodes = np.asarray(pairs)
        if nodes.ndim != 2 or nodes.shape[1] != 2 or (nodes.size and nodes.dtype.kind not in "iu"):
            raise ValueError(f"expected pairs (m, 2) of nodes, whole numbers, got {nodes.dtype} of shape {nodes.shape}")
        if nodes.size and not 0 <= nodes.min() <= nodes.max() <= self.root:
            raise ValueError(f"expected pairs of this tree's nodes 0..{self.root}, got {nodes.min()}..{nodes.max()}")
        return lowest_common_ancestors(self.parents, *nodes.T.astype(np.int32))

    def known_moments(self) -> Moments:
        """The moments of all k nodes.

        Raises
        ------
        ValueError
            The tree has none.
        """
        if self.moments is None:
            raise ValueError("expected the tree of a segmented cloud, got one without moments, as of tree_of_graph")
        return self.moments

    def features(self) -> NodeFeatures:
        """Features of all k nodes, from their moments; raises ValueError if the tree has none."""
        return node_features(self.known_moments())

    def to_linkage_matrix(self) -> NDArray[np.float64]:
        """The merges as SciPy's linkage matrix, (n_leaves - 1, 4) float64.

        Row i is node n_leaves + i: its two children, its altitude, and its number of leaves (not of points). Nodes have
        the same numbers in the tree and in the matrix. ``scipy.cluster.hierarchy.dendrogram(matrix)`` draws it, and
        ``fcluster(matrix, t, "distance")`` cuts it as ``cut(altitude=t)`` does.

        Infinite altitudes cannot be drawn. They are replaced by twice the largest finite altitude, or by 1 if none is
        above 0. The matrix of a tree of one leaf has no rows; SciPy does not accept it.
        """
        altitudes = self.altitudes[self.n_leaves :]
        finite = altitudes[np.isfinite(altitudes)]
        at_infinity = 2.0 * finite.max(initial=0.0) or 1.0
        n_below = accumulate_sequential(self.parents, np.ones(self.n_leaves, np.int64))
        merged = slice(self.n_leaves, None)
        levels = np.where(np.isfinite(altitudes), altitudes, at_infinity)
        return np.column_stack((self.children[merged], levels, n_below[merged])).astype(np.float64)

    def to_dict(self) -> dict[str, Any]:
        """The tree as flat lists with one entry per node, for ``json.dumps(..., allow_nan=False)``.

        The keys are ``n_leaves``; ``parents``, where the root is its own parent; ``altitudes``, in the linkage's unit,
        None for infinite ones, where parts that do not touch were joined; and ``sizes``, numbers of points.
        """
        columns = {"parents": self.parents, "altitudes": self.altitudes, "sizes": self.sizes}
        return {"n_leaves": self.n_leaves, **plain(columns)}

    def to_networkx(self) -> networkx.DiGraph:
        """The tree as ``networkx.DiGraph``, from parent to child, with ``altitude`` and features as attributes.

        All attributes are numbers; without moments they are ``altitude`` and ``size``. Values that are not finite are
        left out, because JSON has no infinity: a node that joins parts that do not touch has no ``altitude``.
        """
        from networkx import DiGraph

        features = {"size": self.sizes} if self.moments is None else self.features().columns()
        tree = DiGraph()
        tree.add_nodes_from(enumerate(rows(scalar_columns({"altitude": self.altitudes, **features}), self.n_nodes)))
        tree.add_edges_from((up, node) for node, up in enumerate(self.parents.tolist()) if up != node)
        return tree

    def _segments(self, nodes: NDArray[np.int32]) -> NDArray[np.int32]:
        return numbered_segments(nodes, len(self.parents))


# --- from merges to a tree --------------------------------------------------------------------------------------------


def segmentation_tree(merges: Merges, leaves: Moments) -> SegmentationTree:
    """Tree over k leaves: a linkage's merges, then merges of the parts that are left.

    Parameters
    ----------
    merges : Merges of k leaves, along the edges of their graph
    leaves : Moments of k leaves

    Notes
    -----
    Parts that the merges leave apart are joined at infinite altitude, the smallest (in points) first, each to the
    nearest larger part. So cuts below infinity never mix them, and a cut into few segments keeps the large parts apart.
    `RegionLinkage` joins specks earlier, across bridges.
    """
    parents, altitudes = _joined(merges, leaves.counts, leaves.centroids)
    return SegmentationTree(parents, altitudes, moments_up_tree(leaves, parents))


def tree_without_points(merges: Merges, leaf_sizes: NDArray[np.int64]) -> SegmentationTree:
    """Tree over k leaves without positions, given their numbers of points; unconnected parts join the largest."""
    return SegmentationTree(*_joined(merges, leaf_sizes, None), leaf_sizes=leaf_sizes)


def _joined(
    merges: Merges, sizes: NDArray[np.int64], centroids: NDArray[np.float64] | None
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Parents and altitudes of the tree of these merges; `sizes` and `centroids` are those of the leaves."""
    n_leaves, n_merges = len(sizes), len(merges.pairs)
    parents = np.arange(2 * n_leaves - 1, dtype=np.int32)
    parents[merges.pairs] = np.arange(n_leaves, n_leaves + n_merges, dtype=np.int32)[:, None]
    parts = roots(parents[: n_leaves + n_merges])[:n_leaves]
    gaps = _join_parts(parts, sizes, centroids, n_leaves + n_merges)
    parents[gaps] = np.arange(n_leaves + n_merges, 2 * n_leaves - 1, dtype=np.int32)[:, None]
    return parents, np.concatenate((np.zeros(n_leaves), merges.altitudes, np.full(len(gaps), np.inf)))


def _join_parts(
    parts: NDArray[np.int32], leaf_sizes: NDArray[np.int64], centroids: NDArray[np.float64] | None, next_node: int
) -> NDArray[np.int32]:
    """Merges, (p - 1, 2) int32, of p parts; `parts` is the root above each leaf."""
    tops, part = np.unique(parts, return_inverse=True)
    if len(tops) == 1:
        return np.empty((0, 2), np.int32)
    sizes = np.bincount(part, leaf_sizes)
    order = np.lexsort((-tops, sizes))  # ascending size; of equal parts the later one merges first
    rank = np.empty(len(tops), np.int64)
    rank[order] = np.arange(len(tops))
    target = np.full(len(tops), order[-1]) if centroids is None else _nearest_larger(part, rank, centroids)
    name = tops.copy()
    merges = np.empty((len(tops) - 1, 2), np.int32)
    for step, small in enumerate(order[:-1].tolist()):
        merges[step] = sorted((name[small], name[target[small]]))
        name[target[small]] = next_node + step
    return merges


def _nearest_larger(
    part: NDArray[np.int64], rank: NDArray[np.int64], centroids: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Larger part that has the leaf nearest to each part's own leaves, (p,) int64; the largest part if none is near."""
    n_near = min(_N_NEAREST + 1, len(centroids))
    seeking = np.flatnonzero(rank[part] < len(rank) - 1)  # the largest part looks for none
    distance, leaf = nearest(centroids, centroids[seeking], n_near)
    row, column = np.nonzero(rank[part[leaf]] > rank[part[seeking]][:, None])
    source, candidate = part[seeking[row]], part[leaf[row, column]]
    best = np.lexsort((candidate, distance[row, column], source))
    source_part = source[best]
    first = np.flatnonzero(np.diff(source_part, prepend=-1))
    target = np.full(len(rank), int(np.argmax(rank)), np.int64)
    target[source_part[first]] = candidate[best][first]
    return target
