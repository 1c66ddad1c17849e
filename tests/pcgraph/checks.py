# SPDX-License-Identifier: Apache-2.0
"""What several test files ask of labels, segments and normals, and the seeds that they draw."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

import pcgraph
from pcgraph.metrics.labellings import contingency, intersections_over_union, largest_of_groups
from pcgraph.voxels.grid import voxel_grid

Labels = NDArray[np.integer]
SEEDS = st.integers(0, 2**32 - 1)
"""Strategy: seeds of random numbers."""
ON_ONE_FACE = 0.7
"""Least cosine, of either sign, of a voxel's normal and the true one of a point that lies on the voxel's plane."""


# --- Labels -----------------------------------------------------------------------------------------------------------


def same_partition(a: Labels, b: Labels) -> bool:
    """Whether two labellings are equal up to renaming."""
    pairs = len(np.unique(np.stack((a.ravel(), b.ravel()), axis=1), axis=0))
    return pairs == len(np.unique(a)) == len(np.unique(b))


def refines(fine: Labels, coarse: Labels) -> bool:
    """Whether every segment of the fine labelling lies in one segment of the coarse one."""
    return len(np.unique(np.stack((fine.ravel(), coarse.ravel()), axis=1), axis=0)) == len(np.unique(fine))


def main_object(labels: Labels, things: Labels, thing: int, least: float = 0.9) -> int:
    """The label that at least so large a fraction of a thing's labelled points have."""
    names, counts = np.unique(labels[(things == thing) & (labels >= 0)], return_counts=True)
    assert counts.max() > least * counts.sum()
    return int(names[counts.argmax()])


def objects_of(labels: Labels, things: Labels, thing: int) -> set[int]:
    """Labels that more than a tenth of a thing's labelled points have."""
    names, counts = np.unique(labels[(things == thing) & (labels >= 0)], return_counts=True)
    return set(names[counts > 0.1 * counts.sum()].tolist())


def overlaps(labels: Labels, truth: Labels, chosen: ArrayLike | None = None) -> NDArray[np.float64]:
    """Intersection over union of each thing and the segment that fits it best; of things 0, 1, ... unless told."""
    truth = truth.astype(np.int32)
    table = contingency(labels, truth)
    names = np.unique(truth[(truth >= 0) & (labels >= 0)])
    best = largest_of_groups(intersections_over_union(table), table.col, len(names))
    return best if chosen is None else best[np.isin(names, chosen)]


def assert_covered_and_connected(points: ArrayLike, result: pcgraph.Segmentation, outliers: float = 0.01) -> None:
    """Every finite point but outliers has a label; the voxels that hold points of a supervoxel are one piece."""
    flat = np.asarray(points, float).reshape(-1, 3)
    outlier = result.outliers.reshape(-1)
    finite = np.isfinite(flat).all(axis=1)
    assert np.array_equal(result.labels.reshape(-1) == -1, ~finite | outlier)
    assert finite[outlier].all()
    assert outlier.sum() < outliers * max(len(flat), 300)
    finite &= ~outlier
    for labels in (result.labels, result.supervoxels):
        assert labels.dtype == np.int32
        assert labels.shape == np.shape(points)[:-1]
        assert np.array_equal(labels.reshape(-1) >= 0, finite)
        assert np.bincount(labels[labels >= 0]).all()  # 0, 1, 2, ... with none left out
    of_result = result.surface.grid
    grid = voxel_grid(flat[finite], of_result.size, of_result.warp, of_result.grading)
    leaf = result.supervoxels.reshape(-1)[finite]
    # Of a voxel on a boundary the points may belong to several supervoxels: each of its shares is a piece.
    owners = int(leaf.max()) + 1
    shares = np.unique(grid.voxel_of_point.astype(np.int64) * owners + leaf)
    voxel, owner = np.divmod(shares, owners)
    assert np.array_equal(np.unique(voxel), np.arange(grid.n_voxels))
    degrees = np.diff(grid.indptr)[voxel]
    piece = np.repeat(np.arange(len(shares)), degrees)
    within = np.arange(len(piece)) - np.repeat(np.cumsum(degrees) - degrees, degrees)
    beside = grid.neighbours[grid.indptr[voxel[piece]] + within].astype(np.int64) * owners + owner[piece]
    other = np.searchsorted(shares, beside).clip(max=len(shares) - 1)
    linked = shares[other] == beside
    links = (piece[linked], other[linked])
    matrix = csr_array((np.ones(len(links[0])), links), shape=(len(shares),) * 2)
    pieces, _ = connected_components(matrix, directed=False)
    assert pieces == result.graph.n_nodes == leaf.max() + 1


# --- Normals ----------------------------------------------------------------------------------------------------------


def normals_of_points(result: pcgraph.Segmentation) -> NDArray[np.float64]:
    """The normal of each point's voxel, (n, 3), of the points that are no outliers."""
    return result.surface.normals[result.surface.grid.voxel_of_point]


def fraction_of_normals(result: pcgraph.Segmentation, normals: NDArray[np.float64]) -> float:
    """Fraction of points on the right side of their voxel's plane, of those that lie on it (not on another face).

    normals : (n, 3), true ones, of the points that are no outliers.
    """
    cosines = np.einsum("ij,ij->i", normals_of_points(result), normals)
    on_it = np.abs(cosines) > ON_ONE_FACE
    assert on_it.mean() > 0.8
    return float((cosines[on_it] > 0.0).mean())


def fraction_outward(points: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    """`fraction_of_normals` of a cloud that is segmented with nothing given, and has no outliers."""
    result = pcgraph.segment(points)
    assert not result.outliers.any()
    return fraction_of_normals(result, normals)


def fraction_facing(points: NDArray[np.float64], result: pcgraph.Segmentation, place: ArrayLike) -> float:
    """Fraction of the points whose voxel's normal points to the side of a place."""
    ways = place - points[~result.outliers]
    return float((np.einsum("ij,ij->i", ways, normals_of_points(result)) > 0).mean())
