# SPDX-License-Identifier: Apache-2.0
"""The adjacency graph of supervoxels."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.acquisition.kinds import Acquisition, Told, UnknownAcquisition
from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.boundary import BoundaryStrength
from pcgraph.plumbing.short_repr import ShortRepr

if TYPE_CHECKING:
    import networkx
    from scipy.sparse import csr_array

    from pcgraph.graph.continuations import Continuations
    from pcgraph.graph.occlusion import Occlusions


@dataclass(frozen=True, eq=False)
class EdgeFeatures(ShortRepr):
    """One row per edge (i, j), i < j.

    Attributes
    ----------
    convexity : (m,) float64, radians
        Angle between the nodes' normals: positive where the two bend away from the viewer (convex), negative where they
        form a valley (concave). The sign is that of (n_j - n_i) . (x_j - x_i). Source: LCCP, Stein et al. 2014.
    contact_convexity : (m,) float64, radians
        The same, from the normals and positions of the touching voxels on either side.
    normal_angle : (m,) float64, radians, 0..pi
        Angle between the nodes' normals.
    color_contrast : (m,) float64, 0..sqrt(3)
        Distance of the nodes' mean colours; 0 if the cloud has none.
    contact_voxels : (m,) int64
        Number of voxels, on both sides, that touch the other side.
    contact_length : (m,) float64, metres
        Mean over both sides of the number of touching voxels times their edge length.
    step : (m,) float64, metres
        Offset between the surfaces at the contact: the distance of each side's boundary from the other node's plane,
        the smaller of the two. It is near 0 where surfaces meet in a crease, and the height of the step where one lies
        before the other.
    """

    convexity: NDArray[np.float64]
    contact_convexity: NDArray[np.float64]
    normal_angle: NDArray[np.float64]
    color_contrast: NDArray[np.float64]
    contact_voxels: NDArray[np.int64]
    contact_length: NDArray[np.float64]
    step: NDArray[np.float64]

    @property
    def voxel_edge(self) -> NDArray[np.float64]:
        """Mean edge length of the voxels at each contact, (m,) float64, metres."""
        return 2.0 * self.contact_length / self.contact_voxels

    @property
    def boundary_strength(self) -> NDArray[np.float64]:
        """Strength of each edge as an object's boundary, (m,) float64, 0..1, of the default `BoundaryStrength`."""
        return BoundaryStrength()(self)

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """All features by name, in the order of the attributes."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True, eq=False)
class Gaps(ShortRepr):
    """Supervoxels that lie close by without touching; one row per pair.

    Attributes
    ----------
    edges : (g, 2) int32
        Node pairs i < j in ascending order, none of which touch.
    edge_features : EdgeFeatures
        g rows; contacts are the voxels on either side that face the other.
    widths : (g,) float64, voxel edges
        Least distance between centroids of their voxels.
    weights : (g,) float64
        Weight of the gap, comparable to `contact_voxels`: the sum of e^(1 - width) over voxels that face the other
        side.
    """

    edges: NDArray[np.int32]
    edge_features: EdgeFeatures
    widths: NDArray[np.float64]
    weights: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Bridges(ShortRepr):
    """Edges that connect small components of the graph to the components around them; one row per edge.

    A component is small (a speck) if it has fewer points than the mean supervoxel.

    Attributes
    ----------
    edges : (b, 2) int32
        The two supervoxels of both components whose means lie nearest to each other, i < j, in ascending order.
    widths : (b,) float64, voxel edges
        Distance between centroids of two of their voxels, each the other's nearest; a million at most.
    voxel_edge : (b,) float64, metres
        Mean edge length of the voxels of both.
    between_specks : (b,) bool
        Whether both ends are specks of at most four points that lie about as near to each other as to anything. Specks
        of a surface that was sampled too thinly for the voxels do.
    """

    edges: NDArray[np.int32]
    widths: NDArray[np.float64]
    voxel_edge: NDArray[np.float64]
    between_specks: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class AdjacencyGraph(ShortRepr):
    """Supervoxels as nodes and their contacts as edges.

    Attributes
    ----------
    edges : (m, 2) int32
        Node pairs i < j in ascending order, one per pair of supervoxels that touch.
    edge_features : EdgeFeatures
        m rows.
    node_features : NodeFeatures
        One row per supervoxel.
    gaps : Gaps, optional
        Supervoxels that nearly touch. They are no edges, but a linkage may merge across them.
    continuations : Continuations, optional
        Flat surfaces that go on behind an object that hides a part of them, and pieces of one bounding plane or
        terrain. They are no edges either.
    bridges : Bridges, optional
        Edges from specks to the components around them, for the tree alone.
    color_evidence : float, 0..1
        Evidence of colours about shape: how much more they change at creases than on smooth surfaces
        (`pcgraph.voxels.column_evidence.crease_contrast`).
    acquisition : Acquisition
        What took the cloud: whether gaps mean much, and whether the outer side of surfaces is known. Default: unknown.
    """

    edges: NDArray[np.int32]
    edge_features: EdgeFeatures
    node_features: NodeFeatures
    gaps: Gaps | None = None
    continuations: Continuations | None = None
    bridges: Bridges | None = None
    color_evidence: float = 1.0
    acquisition: Acquisition = field(default_factory=lambda: UnknownAcquisition(Told()))

    def _counts(self) -> str:
        return f"{self.n_nodes} nodes, {len(self.edges)} edges"

    @property
    def n_nodes(self) -> int:
        """Number of supervoxels."""
        return len(self.node_features.size)

    @property
    def voxel_edge(self) -> float:
        """Edge length of a voxel, metres: the median over contacts, else over gaps, else over bridges.

        It is 1 if there are none of these, as the graph has no length then.
        """
        gaps = None if self.gaps is None else self.gaps.edge_features
        for beside in (self.edge_features, gaps, self.bridges):
            if beside is not None and len(beside.voxel_edge):
                return float(np.median(beside.voxel_edge))
        return 1.0

    @property
    def joined(self) -> NDArray[np.int32]:
        """Pairs of supervoxels joined by an edge, a gap or a continuation, (m + g + r, 2) int32."""
        beside = [] if self.gaps is None else [self.gaps.edges]
        hidden = [] if self.continuations is None else [self.continuations.pairs]
        return np.concatenate((self.edges, *beside, *hidden))

    def to_networkx(self, occlusions: Occlusions | None = None) -> networkx.Graph:
        """The graph as ``networkx.Graph``, with features and `boundary_strength` as attributes of the same names.

        Vectors are split (``normal_x``), and all numbers are Python's, so that JSON, GEXF and GraphML take the graph.
        Values that are not finite, such as missing colours, are left out, because JSON has neither NaN nor infinity.

        Parameters
        ----------
        occlusions : Occlusions, optional
            `Segmentation.occlusions()`. With them the graph is a ``MultiGraph``. The attribute `kind` of an edge is
            then "contact" or "occlusion"; occlusions have their own features, and the supervoxel in `front`.

        Raises
        ------
        ValueError
            The occlusions are those of other supervoxels.
        """
        from pcgraph.graph.export import network

        return network(self, occlusions)

    def to_csr(self, weights: str | ArrayLike | None = None) -> csr_array:
        """The graph as a symmetric SciPy matrix, (k, k) float64, 2 m stored entries, columns ascending.

        Parameters
        ----------
        weights : str or (m,) numbers, optional
            Name of an edge feature or `boundary_strength`, or a number per edge. Default: 1 for every edge.

        Raises
        ------
        ValueError
            There is no such feature, or the numbers are not (m,) or not finite.

        Notes
        -----
        Weights of zero are stored: for `connected_components` and `dijkstra` of `scipy.sparse.csgraph` they are edges.
        But `minimum_spanning_tree` leaves them out of its result. Pass ``weights + 1`` there: the tree is the same.
        """
        from pcgraph.graph.export import csr

        return csr(self, weights)

    def to_pyg(self, up: ArrayLike | None = None, occlusions: Occlusions | None = None) -> dict[str, object]:
        """Arrays named as PyTorch Geometric names them; every edge occurs in both directions.

        ``x`` (k, f) float32: size, normal, covariance, linearity, planarity, scattering, residual, and, if known,
        verticality and colours. ``x_names``: a list of their f names. ``pos`` (k, 3) float32, metres: centroids less
        their mean ``pos_origin`` (3,) float64, because float32 rounds coordinates far from the origin. ``edge_index``
        (2, 2 m) int64: first all edges as they are, then all reversed. ``edge_attr`` (2 m, g) float32 and
        ``edge_attr_names``: all edge features and `boundary_strength`, none of which has a direction.

        Parameters
        ----------
        up : (3,) float, the points' frame, optional
            Direction against gravity, for verticality, which is left out without it.
        occlusions : Occlusions, optional
            Adds ``occlusion_index`` (2, q) int64, from front to behind, ``occlusion_attr`` (q, c) float32 and
            ``occlusion_attr_names``.

        Raises
        ------
        ValueError
            `up` is no direction, the occlusions are those of other supervoxels, or float32 does not hold a feature.
        """
        from pcgraph.graph.export import pyg

        return pyg(self, up, occlusions)

    def write_graphml(self, path: str | PathLike[str], occlusions: Occlusions | None = None) -> None:
        """Write the graph as GraphML with all features, vectors as scalars (``normal_x``): the whole file, or none.

        An older file of that name is replaced. ``networkx.read_graphml(path, node_type=int)`` reads it back.

        Parameters
        ----------
        path : path of a file
        occlusions : Occlusions, optional
            As for `to_networkx`.

        Raises
        ------
        CloudWriteError
            The place cannot be written.
        ValueError
            The occlusions are those of other supervoxels.
        """
        from pcgraph.errors import CloudWriteError
        from pcgraph.graph.export import graphml
        from pcgraph.plumbing.plain_files import write_file

        write_file(Path(path), graphml(self, occlusions), CloudWriteError)
