# SPDX-License-Identifier: Apache-2.0
"""Gaps: supervoxels that do not touch but lie close by, where a surface was sampled too thinly or is hidden in part."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.adjacency import Gaps
from pcgraph.graph.contacts import edge_features, facing_sides
from pcgraph.voxels.grid import MAX_GAP, VoxelGrid, boundary_voxels, voxels_within


def gaps(
    grid: VoxelGrid,
    normals: NDArray[np.float64],
    supervoxels: NDArray[np.int32],
    nodes: NodeFeatures,
    touching: NDArray[np.int32],
) -> Gaps:
    """Pairs of supervoxels that do not touch, but whose boundary voxels come within three voxel edges of each other.

    Parameters
    ----------
    grid : VoxelGrid of v voxels
    normals : (v, 3) float64
        Unit normals of the voxels.
    supervoxels : (v,) int32
        Supervoxel of each voxel.
    nodes : NodeFeatures of k supervoxels
    touching : (m, 2) int32
        Pairs of supervoxels that touch, the smaller first.

    Notes
    -----
    Only voxels with fewer than eight around them are looked at: those at the ends of surfaces.
    """
    k = np.int64(len(nodes.size))
    is_boundary = boundary_voxels(grid)
    boundary = np.flatnonzero(is_boundary)
    near = voxels_within(grid, boundary, MAX_GAP, is_boundary)
    source, target = np.repeat(boundary, np.diff(near.indptr)), near.neighbours.astype(np.int64)
    pairs: NDArray[np.int64] = np.stack((source, target), axis=1)
    pairs = pairs[(pairs[:, 0] < pairs[:, 1]) & (supervoxels[pairs[:, 0]] != supervoxels[pairs[:, 1]])]
    width = np.linalg.norm((grid.warped[pairs[:, 0]] - grid.warped[pairs[:, 1]]) / grid.size, axis=1)
    voxel = pairs.T.ravel()  # each side of each pair
    other = supervoxels[pairs[:, ::-1].T.ravel()].astype(np.int64)
    own, width = supervoxels[voxel].astype(np.int64), np.tile(width, 2)
    key = np.minimum(own, other) * k + np.maximum(own, other)
    new = ~np.isin(key, touching[:, 0].astype(np.int64) * k + touching[:, 1])
    voxel, own, other, width, key = voxel[new], own[new], other[new], width[new], key[new]
    order = np.lexsort((width, other, voxel))  # of each voxel the shortest way to each other supervoxel
    first = order[np.flatnonzero(np.diff(voxel[order] * k + other[order], prepend=-1))]
    voxel, own, other, width, key = voxel[first], own[first], other[first], width[first], key[first]
    keys, edge = np.unique(key, return_inverse=True)
    edges = np.stack((keys // k, keys % k), axis=1).astype(np.int32)
    facing = facing_sides(grid, normals, edges, voxel, 2 * edge + (own > other))
    shortest = np.full(len(edges), np.inf)
    np.minimum.at(shortest, edge, width)
    weights = np.bincount(edge, np.exp(1.0 - width), len(edges)).astype(np.float64)
    return Gaps(edges, edge_features(nodes, facing), shortest, weights)
