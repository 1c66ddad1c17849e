# SPDX-License-Identifier: Apache-2.0
"""What people use on point clouds with nothing but points: Felzenszwalb on normals, and a plane plus DBSCAN.

PCL is in `peers.py`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scores import largest

NEIGHBOURS = 8
NORMAL_NEIGHBOURS = 15
MIN_SIZE = 20  # points of a segment, as on meshes of rooms
BLOCK = 100_000  # points whose normals are computed at a time
BISECTIONS = 10
LOG_SCALE = np.log(100.0) + 7.0  # of the largest k that is tried, and of one over the least
CELLS_PER_RADIUS = 5.0  # DBSCAN sees one point per cube of this fraction of its radius


class NormalGraph(NamedTuple):
    """Edges between the 8 nearest points, (m, 2), the alike first, and their weights 1 - |n . n'|, (m,)."""

    n_points: int
    edges: NDArray[np.int64]
    weights: NDArray[np.float64]


def normal_graph(points: NDArray[np.number]) -> NormalGraph:
    """Graph of points (n, 3) with normals from 15 neighbours each."""
    position = np.ascontiguousarray(points, np.float64)
    near = cKDTree(position).query(position, NORMAL_NEIGHBOURS, workers=2)[1]
    normals = np.concatenate([_normals(position[rows]) for rows in np.array_split(near, len(near) // BLOCK + 1)])
    edges = np.stack((np.repeat(near[:, 0], NEIGHBOURS), near[:, 1 : NEIGHBOURS + 1].ravel()), axis=1)
    weights = 1.0 - np.abs(np.einsum("ij,ij->i", normals[edges[:, 0]], normals[edges[:, 1]]))
    order = np.argsort(weights, kind="stable")
    return NormalGraph(len(position), edges[order], weights[order])


def _normals(around: NDArray[np.float64]) -> NDArray[np.float64]:
    spread = around - around.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]


def felzenszwalb(graph: NormalGraph, scale: float) -> NDArray[np.int32]:
    """Segments (n,) of Felzenszwalb and Huttenlocher 2004: `scale` is their k; small segments join last."""
    roots = _joined(graph.n_points, graph.edges, graph.weights, scale, MIN_SIZE)
    return np.unique(roots, return_inverse=True)[1].astype(np.int32)


@njit(cache=True)
def _root(parents, node):  # type: ignore[no-untyped-def]
    while parents[node] != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node


@njit(cache=True)
def _joined(n, edges, weights, scale, min_size):  # type: ignore[no-untyped-def]
    parents, sizes, limits = np.arange(n), np.ones(n, np.int64), np.full(n, scale)
    for last in (False, True):
        for k in range(len(edges)):
            a, b = _root(parents, edges[k, 0]), _root(parents, edges[k, 1])
            if a == b:
                continue
            joins = min(sizes[a], sizes[b]) < min_size if last else weights[k] <= min(limits[a], limits[b])
            if joins:
                parents[b] = a
                sizes[a] += sizes[b]
                limits[a] = weights[k] + scale / sizes[a]
    return np.array([_root(parents, node) for node in range(n)])


def felzenszwalb_cut(graph: NormalGraph, number: int) -> NDArray[np.integer]:
    """Most segments that are no more than a number, by bisection of k."""
    low, high = -LOG_SCALE, LOG_SCALE
    best = largest(felzenszwalb(graph, float(np.exp(high))), number)  # more if there are gaps
    for _ in range(BISECTIONS):
        middle = (low + high) / 2.0
        labels = felzenszwalb(graph, float(np.exp(middle)))
        if labels.max() < number:
            high = middle
            best = labels if labels.max() >= best.max() else best
        else:
            low = middle
    return best


def plane_and_clusters(points: NDArray[np.number], ground: float, radius: float, min_points: int) -> NDArray[np.int32]:
    """Labels (n,): 0 for the largest plane by RANSAC, from 1 for the clusters of DBSCAN on the rest, -1 for none."""
    import open3d as o3d

    o3d.utility.random.seed(0)
    position = np.asarray(points, np.float64) - points.mean(axis=0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(position))
    inliers = cloud.segment_plane(ground, 3, 1000)[1]
    labels = np.zeros(len(position), np.int32)
    rest = np.setdiff1d(np.arange(len(position)), inliers)
    if len(rest):
        cells, cell = np.unique(np.floor(position[rest] * (CELLS_PER_RADIUS / radius)), axis=0, return_inverse=True)
        count = np.bincount(cell, minlength=len(cells))
        means = np.stack([np.bincount(cell, axis) / count for axis in position[rest].T], axis=1)
        thinned = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(means))
        found = np.array(thinned.cluster_dbscan(radius, min_points))
        labels[rest] = np.where(found < 0, -1, found + 1)[cell]
    return labels
