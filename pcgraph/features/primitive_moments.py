# SPDX-License-Identifier: Apache-2.0
"""Moments from which planes, spheres and cylinders follow; additive, so every node of a tree has them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.moments import moments_of_groups
from pcgraph.features.pooling import pool_moments
from pcgraph.features.powers import N_POWERS, add_moved, sums_of_powers, tensor
from pcgraph.short_repr import ShortRepr


@dataclass(frozen=True)
class PrimitiveMoments(ShortRepr):
    """Moments of k groups of points up to the fourth order, and second moments of their normals.

    Attributes
    ----------
    counts : (k,) int64
        Points per group, >= 1.
    centers : (k, 3) float64, metres
        The group's centroid as rounded to float64: origin of its powers.
    scales : (k,) float64, metres
        Unit of its powers: a power of two near the group's root mean square radius, 1 if that is 0.
    powers : (k, 35) float64, dimensionless
        Sums over the points of x^a y^b z^c, with (x, y, z) = (point - center) / scale, for a + b + c <= 4, rows in the
        order of `pcgraph.features.powers.EXPONENTS`.
    normal_sums : (k, 3) float64
        Sum of the points' normals.
    normal_scatters : (k, 3, 3) float64
        Sum of n n^T.

    Notes
    -----
    Groups only ever get larger up a tree, so nothing cancels. Do not subtract a small group from one far larger or
    far away: fourth powers lose four times as many digits as distances do.
    """

    counts: NDArray[np.int64]
    centers: NDArray[np.float64]
    scales: NDArray[np.float64]
    powers: NDArray[np.float64]
    normal_sums: NDArray[np.float64]
    normal_scatters: NDArray[np.float64]

    def __len__(self) -> int:
        """Number of groups."""
        return len(self.counts)


def primitive_moments(
    points: ArrayLike, normals: ArrayLike, groups: NDArray[np.int32], n_groups: int
) -> PrimitiveMoments:
    """Moments of points by group.

    Parameters
    ----------
    points : (n, 3) float64, metres
    normals : (n, 3) float64
        Unit normals; those of the points' voxels will do: ``surface.normals[surface.grid.voxel_of_point]``.
    groups : (n,) int32, 0..n_groups - 1
        Every group has a point at least.
    n_groups : int

    Raises
    ------
    ValueError
        A shape is not as above, a number is not finite, or a group is out of range or has no point.
    """
    places, directions = finite_vectors("points", points), finite_vectors("normals", normals)
    if not len(places) == len(directions) == len(groups):
        raise ValueError(
            f"expected one normal and one group per point, got {len(places)} points, {len(directions)} normals, "
            f"{len(groups)} groups"
        )
    if groups.min(initial=0) < 0 or groups.max(initial=-1) != n_groups - 1 or not np.bincount(groups).all():
        raise ValueError(f"expected all of the groups 0..{n_groups - 1}, with a point each, and no others")
    low = moments_of_groups(places, None, groups, n_groups)
    scales = _scales(low.counts, low.scatters)
    powers = sums_of_powers(places, groups, low.centroids, scales)
    sums, scatters = _normal_moments(directions, groups, n_groups)
    return PrimitiveMoments(low.counts, low.centroids, scales, powers, sums, scatters)


def finite_vectors(name: str, vectors: ArrayLike) -> NDArray[np.float64]:
    """The vectors as (n, 3) float64; ValueError if they have another shape or are not all finite numbers."""
    array = np.asarray(vectors)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise ValueError(f"expected {name} as numbers of shape (n, 3), got {array.shape} {array.dtype}")
    if not np.isfinite(array).all():
        raise ValueError(f"expected {name} as finite numbers; leave out points that have NaN or infinite ones")
    return array.astype(np.float64, copy=False)


def pool_up_tree(leaves: PrimitiveMoments, parents: NDArray[np.int32]) -> PrimitiveMoments:
    """Moments of every node of a tree, from those of its leaves.

    Parameters
    ----------
    leaves : PrimitiveMoments
        Of the first nodes, in order.
    parents : (k,) int32
        Parent of each node; larger than the node's own number, except for the root, which is its own parent.
    """
    k, n = len(parents), len(leaves)
    counts, centers, scatters = np.zeros(k, np.int64), np.zeros((k, 3)), np.zeros((k, 3, 3))
    counts[:n], centers[:n] = leaves.counts, leaves.centers
    scatters[:n] = tensor(leaves.powers, 2) * (leaves.scales**2)[:, None, None]
    pool_moments(parents, counts, centers, scatters)  # says where inner nodes are and how large, before they are summed
    scales = np.concatenate((leaves.scales, _scales(counts[n:], scatters[n:])))
    powers = np.zeros((k, N_POWERS))
    normal_sums, normal_scatters = np.zeros((k, 3)), np.zeros((k, 3, 3))
    powers[:n], normal_sums[:n], normal_scatters[:n] = leaves.powers, leaves.normal_sums, leaves.normal_scatters
    _pool(parents, centers, scales, powers, normal_sums, normal_scatters)
    return PrimitiveMoments(counts, centers, scales, powers, normal_sums, normal_scatters)


def _scales(counts: NDArray[np.int64], scatters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Powers of two, by which a product is exact, next above the root mean square radius."""
    radius = np.sqrt(np.trace(scatters, axis1=1, axis2=2) / counts)
    return np.where(radius > 0.0, np.ldexp(1.0, np.frexp(radius)[1]), 1.0)


@njit(cache=True, nogil=True)
def _normal_moments(  # type: ignore[no-untyped-def]
    normals: NDArray[np.float64], groups: NDArray[np.int32], n_groups: int
):
    """Sum of n and sum of n n^T by group."""
    sums, scatters = np.zeros((n_groups, 3)), np.zeros((n_groups, 3, 3))
    for i in range(len(groups)):
        for a in range(3):
            sums[groups[i], a] += normals[i, a]
            for b in range(3):
                scatters[groups[i], a, b] += normals[i, a] * normals[i, b]
    return sums, scatters


@njit(cache=True, nogil=True)
def _pool(parents, centers, scales, powers, normal_sums, normal_scatters):  # type: ignore[no-untyped-def]
    """Nothing; adds every node's sums to its parent's, children first."""
    for node in range(len(parents)):
        up = parents[node]
        if up == node:
            continue
        add_moved(powers[up], powers[node], (centers[node] - centers[up]) / scales[up], scales[node] / scales[up])
        for a in range(3):
            normal_sums[up, a] += normal_sums[node, a]
            for b in range(3):
                normal_scatters[up, a, b] += normal_scatters[node, a, b]
