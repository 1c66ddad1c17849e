# SPDX-License-Identifier: Apache-2.0
"""What a cloud becomes: supervoxels, graph, tree and objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.tree.tree import SegmentationTree
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.warp import CameraWarp


@dataclass(frozen=True)
class Segmentation:
    """A cloud from fine to coarse.

    Attributes
    ----------
    labels : (n,) or (h, w) int32
        Object of each point, the default cut of the tree; -1 where the point is not finite.
    supervoxels : (n,) or (h, w) int32
        Supervoxel of each point, that is leaf of the tree and node of the graph; -1 where the point is not
        finite.
    graph : AdjacencyGraph
    tree : SegmentationTree
    surface : Surface
        The voxels behind the points.
    seed_size : float, metres
        What was used, given or derived.
    viewpoint : (3,) or (n, 3) float64, metres, the points' frame
        What was used, given or derived; one per finite point if so given.
    """

    labels: NDArray[np.int32]
    supervoxels: NDArray[np.int32]
    graph: AdjacencyGraph
    tree: SegmentationTree
    surface: Surface
    seed_size: float
    viewpoint: NDArray[np.float64]

    @property
    def voxel_size(self) -> float:
        """Edge length of a voxel where the grid's warp keeps lengths, metres: what was used, given or derived."""
        return self.surface.grid.size

    @property
    def camera(self) -> bool:
        """Whether voxels grew with depth."""
        return isinstance(self.surface.grid.warp, CameraWarp)

    @property
    def leaves(self) -> Moments:
        """Moments of the supervoxels."""
        return self.tree.moments[: self.tree.n_leaves]

    def cut(self, n: int | None = None, altitude: float | None = None) -> NDArray[np.int32]:
        """Segment of each point in the input's shape, -1 where not finite; see `SegmentationTree.cut`."""
        return self.on_points(self.tree.cut(n, altitude))

    def on_points(self, values: NDArray[np.int32], missing: int = -1) -> NDArray[np.int32]:
        """Values of supervoxels, (k,) int32, on the points; `missing` where a point is not finite."""
        return np.append(values, values.dtype.type(missing))[self.supervoxels]
