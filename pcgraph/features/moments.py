# SPDX-License-Identifier: Apache-2.0
"""Moments of groups of points: number, means and scatters, which add up over groups and up a tree."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.columns import group_means
from pcgraph.parallel import kernel, routine, side_by_side
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.eigen import SYMMETRIC_INDICES


@dataclass(frozen=True, eq=False)
class Moments(ShortRepr):
    """Number, means and scatter of k groups of points.

    Scatter is about each group's own centroid, not about the origin, so no digits cancel if a cloud lies far from the
    origin of its frame.

    Attributes
    ----------
    counts : (k,) int64
        Number of points of each group, >= 1.
    centroids : (k, 3) float64, metres
    scatters : (k, 3, 3) float64, square metres
        Sum over the points of (x - centroid)(x - centroid)^T.
    colors : (k, 3) float64, 0..1, or None
        Mean colour.
    color_scatters : (k, 3, 3) float64, or None
        Sum over the points of (c - mean colour)(c - mean colour)^T.
    normals : (k, 3) float64, or None
        Mean of the surface's unit normals, on its outer side; it is short if they point in many directions.
    features : (k, d) float64, -4..4, or None
        Means of the points' scaled features (`pcgraph.columns.RobustScaling`).
    """

    counts: NDArray[np.int64]
    centroids: NDArray[np.float64]
    scatters: NDArray[np.float64]
    colors: NDArray[np.float64] | None
    color_scatters: NDArray[np.float64] | None = None
    normals: NDArray[np.float64] | None = None
    features: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        """Number of groups."""
        return len(self.counts)

    def __getitem__(self, groups: slice | NDArray[np.int64]) -> Moments:
        """Moments of some of the groups."""
        return replace(self, **{name: values[groups] for name, values in self.columns().items()})

    def columns(self) -> dict[str, NDArray[Any]]:
        """The arrays by name, without those that are None."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: values for name, values in columns.items() if values is not None}

    @property
    def covariances(self) -> NDArray[np.float64]:
        """Scatters over numbers of points, (k, 3, 3) float64, square metres."""
        return self.scatters / self.counts[:, None, None]

    @property
    def color_covariances(self) -> NDArray[np.float64] | None:
        """Scatters of colours over numbers of points, (k, 3, 3) float64, or None."""
        return None if self.color_scatters is None else self.color_scatters / self.counts[:, None, None]


def moments_of_groups(
    points: NDArray[np.float64],
    colors: NDArray[np.float64] | None,
    groups: NDArray[np.int32],
    n_groups: int,
    features: NDArray[np.float32] | None = None,
) -> Moments:
    """Moments of points by group.

    Parameters
    ----------
    points : (n, 3) float64, metres
    colors : (n, 3) float64, 0..1, or None
    groups : (n,) int32, 0..n_groups - 1
        Every group has at least one point.
    n_groups : int
    features : (n, d) float32, scaled, or None
    """
    of_features = None if features is None else group_means(features, groups, n_groups)
    if colors is None:
        counts, centroids, scatters = _mean_and_scatter(points, groups, n_groups)
        return Moments(counts, centroids, scatters, None, features=of_features)
    (counts, centroids, scatters), (_, means, color_scatters) = side_by_side(
        partial(_mean_and_scatter, points, groups, n_groups),
        partial(_mean_and_scatter, colors, groups, n_groups),
    )
    return Moments(counts, centroids, scatters, means, color_scatters, features=of_features)


def _mean_and_scatter(
    values: NDArray[np.float64], groups: NDArray[np.int32], n_groups: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Counts (k,), means (k, 3) and scatters (k, 3, 3), from sums about each group's first value."""
    counts, sums, first = np.zeros(n_groups, np.int64), np.zeros((n_groups, 9)), np.empty((n_groups, 3))
    _sum_up(values, groups, counts, first, sums)
    scatters = np.empty((n_groups, 3, 3))
    for column, (one, other) in enumerate(SYMMETRIC_INDICES):
        about = sums[:, 3 + column] - sums[:, one] * sums[:, other] / counts
        scatters[:, one, other] = scatters[:, other, one] = np.maximum(about, 0.0) if one == other else about
    return counts, first + sums[:, :3] / counts[:, None], scatters


@kernel
def _sum_up(
    values: NDArray[np.float64],
    groups: NDArray[np.int32],
    counts: NDArray[np.int64],
    first: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Add up counts, differences from each group's first value, and their products xx, yy, zz, xy, xz, yz."""
    for i in range(len(groups)):
        s = groups[i]
        if counts[s] == 0:
            first[s, 0], first[s, 1], first[s, 2] = values[i, 0], values[i, 1], values[i, 2]
        x, y, z = values[i, 0] - first[s, 0], values[i, 1] - first[s, 1], values[i, 2] - first[s, 2]
        counts[s] += 1
        sums[s, 0] += x
        sums[s, 1] += y
        sums[s, 2] += z
        sums[s, 3] += x * x
        sums[s, 4] += y * y
        sums[s, 5] += z * z
        sums[s, 6] += x * y
        sums[s, 7] += x * z
        sums[s, 8] += y * z


def moments_up_tree(leaves: Moments, parents: NDArray[np.int32]) -> Moments:
    """Moments of every node of a tree, from those of its leaves.

    Parameters
    ----------
    leaves : Moments
        Moments of the first nodes, in order.
    parents : (k,) int32
        Parent of each node; larger than the node's own number, except for the root, which is its own parent.
    """
    counts = _with_room(leaves.counts, len(parents))
    centroids, scatters = _with_room(leaves.centroids, len(parents)), _with_room(leaves.scatters, len(parents))
    accumulate_moments(parents, counts, centroids, scatters)
    colors = color_scatters = normals = features = None
    if leaves.colors is not None:
        again, colors = _with_room(leaves.counts, len(parents)), _with_room(leaves.colors, len(parents))
        spread = np.zeros((len(leaves), 3, 3)) if leaves.color_scatters is None else leaves.color_scatters
        spreads = _with_room(spread, len(parents))
        accumulate_moments(parents, again, colors, spreads)
        color_scatters = None if leaves.color_scatters is None else spreads
    if leaves.normals is not None:
        normals = _with_room(leaves.normals, len(parents))
        accumulate_means(parents, counts, len(leaves), normals)
    if leaves.features is not None:
        features = _with_room(leaves.features, len(parents))
        accumulate_means(parents, counts, len(leaves), features)
    return Moments(counts, centroids, scatters, colors, color_scatters, normals, features)


def joined_moments(first: Moments, second: Moments, groups: NDArray[np.integer], n_groups: int) -> Moments:
    """Moments of two sets of groups as one set: the first keep their numbers, and the second are added to `groups`.

    Parameters
    ----------
    first : Moments of k groups, k <= n_groups
    second : Moments of q groups
        They have colours, normals and features if the first have.
    groups : (q,) int
        Distinct; numbers from k on are new groups. Each of the n_groups occurs in one of the two sets.
    """
    columns = {name: np.concatenate((values, getattr(second, name))) for name, values in first.columns().items()}
    both = replace(first, **columns)
    return grouped_moments(both, np.concatenate((np.arange(len(first)), groups)), n_groups)


def grouped_moments(parts: Moments, groups: NDArray[np.integer], n_groups: int) -> Moments:
    """Moments of groups of parts, which are those of all their points.

    Parameters
    ----------
    parts : Moments of q parts
    groups : (q,) int, 0..n_groups - 1
        Every group has at least one part.
    n_groups : int
    """
    above = len(parts) + np.concatenate((groups, np.arange(n_groups)))
    return moments_up_tree(parts, above.astype(np.int32))[len(parts) :]


def _with_room(values: NDArray, k: int) -> NDArray:  # type: ignore[type-arg]
    """The values in the first of k rows, zeros below."""
    rows = np.zeros((k, *values.shape[1:]), values.dtype)
    rows[: len(values)] = values
    return rows


# --- sums from leaves to root ---


@routine
def add_moments(counts, means, scatters, to, source):  # type: ignore[no-untyped-def]
    """Add the points of row `source` to those of row `to`: number, mean and scatter become those of both.

    Parameters
    ----------
    counts, means, scatters : (k,) numbers, (k, 3) float64, (k, 3, 3) float64
        Row `to` is overwritten. Rows are given by number, because views of rows take six times as long.
    to, source : int

    Notes
    -----
    Source: Chan, Golub and LeVeque 1979, pairwise update of sums of squares. An empty group becomes an exact copy,
    because the mean of a single part must not move by rounding.
    """
    before = counts[to]
    total = before + counts[source]
    fraction = counts[source] / total
    spread = before * fraction
    for i in range(3):
        for j in range(3):
            shift = (means[source, i] - means[to, i]) * (means[source, j] - means[to, j])
            scatters[to, i, j] += scatters[source, i, j] + spread * shift
    for i in range(3):
        if before == 0:
            means[to, i] = means[source, i]
        else:
            means[to, i] += fraction * (means[source, i] - means[to, i])
    counts[to] = total


@kernel
def accumulate_moments(
    parents: NDArray[np.int32],
    counts: NDArray[np.int64],
    means: NDArray[np.float64],
    scatters: NDArray[np.float64],
) -> None:
    """Set the rows of inner nodes, zero at first, to the moments of all their leaves.

    Parameters
    ----------
    parents : (k,) int32
        Larger than the node's own number, so one pass in ascending order meets children before parents.
    counts, means, scatters : (k,), (k, 3), (k, 3, 3)
        As in `pcgraph.Moments`, of positions or of colours; overwritten.
    """
    for node in range(len(parents)):
        if parents[node] != node:
            add_moments(counts, means, scatters, parents[node], node)


@kernel
def accumulate_means(
    parents: NDArray[np.int32], counts: NDArray[np.int64], n_leaves: int, means: NDArray[np.float64]
) -> None:
    """Set the rows of inner nodes, zero at first, to the means over all their points.

    Parameters
    ----------
    parents : (k,) int32
        Larger than the node's own number.
    counts : (k,) int64
        Points of every node.
    n_leaves : int
        The first rows, which are given.
    means : (k, c) float64
        Overwritten.
    """
    for node in range(len(parents)):
        up = parents[node]
        for column in range(means.shape[1]):
            if node >= n_leaves:
                means[node, column] /= counts[node]
            if up != node:
                means[up, column] += counts[node] * means[node, column]
