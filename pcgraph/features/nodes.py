# SPDX-License-Identifier: Apache-2.0
"""Features of nodes, which are groups of points, from their moments; and tables of features."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.moments import Moments
from pcgraph.parallel import kernel, routine
from pcgraph.plumbing.plain_dict import plain
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.eigen import symmetric_eigen

_MAX_WIDTH_OF_LINE = 1e-5
"""Ratio of the second to the first standard deviation up to which points lie on a line: well above the rounding of
float32, 6e-8. Chosen by eye; not varied."""


@dataclass(frozen=True, eq=False)
class NodeFeatures(ShortRepr):
    """One row per node, of a graph or of a tree.

    Attributes
    ----------
    size : (k,) int64
        Number of points.
    centroid : (k, 3) float64, metres, the points' frame
    normal : (k, 3) float64
        Unit normal of the least-squares plane, on the outer side of the surface, to which the mean of its voxels'
        normals points. For points on a line it is the direction across the line that is nearest to that mean.
    covariance : (k, 3, 3) float64, square metres
    linearity, planarity, scattering : (k,) float64, 0..1
        (s1 - s2) / s1, (s2 - s3) / s1 and s3 / s1 of the standard deviations s1 >= s2 >= s3. Their sum is 1; all are 0
        if the points coincide. Source: Demantke et al. 2011.
    residual : (k,) float64, metres
        Root mean square distance from the plane, s3.
    color : (k, 3) float64, 0..1
        Mean colour; NaN if the cloud has none.
    color_covariance : (k, 3, 3) float64
        Covariance of the points' colours; NaN if the cloud has none.
    deviations : (k, 3) float64, metres
        s3, s2 and s1: square roots of the covariance's eigenvalues, ascending. They are not among the `columns`.
    features : (k, d) float64, -4..4
        Means of the columns given as `features`, in robust spreads from their medians. If there are none, d = 0, and
        they are not among the `columns`.
    """

    size: NDArray[np.int64]
    centroid: NDArray[np.float64]
    normal: NDArray[np.float64]
    covariance: NDArray[np.float64]
    linearity: NDArray[np.float64]
    planarity: NDArray[np.float64]
    scattering: NDArray[np.float64]
    residual: NDArray[np.float64]
    color: NDArray[np.float64]
    color_covariance: NDArray[np.float64]
    deviations: NDArray[np.float64]
    features: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """All features by name, in the order of the attributes."""
        names = [column.name for column in fields(self) if column.name != "deviations"]
        return {name: getattr(self, name) for name in names if name != "features" or self.features.size}

    def verticality(self, up: ArrayLike = (0.0, 0.0, 1.0)) -> NDArray[np.float64]:
        """Steepness of each node's plane, 1 - |normal . up|, (k,) float64: 0 for a floor, 1 for a wall.

        Parameters
        ----------
        up : (3,) float, the points' frame, any length but zero
            Direction against gravity. For organised clouds of a level camera, whose y points down, it is (0, -1, 0).

        Raises
        ------
        ValueError
            `up` is not three finite numbers, or all are zero.

        Notes
        -----
        Source: Hackel et al. 2016. It follows from the moments, so merged nodes have it, too.
        """
        return np.maximum(1.0 - np.abs(self.normal @ unit_vector("up", up)), 0.0)


def unit_vector(name: str, vector: ArrayLike) -> NDArray[np.float64]:
    """The direction of a vector, (3,) float64 of length 1; ValueError if it is not three finite numbers or all zero."""
    try:
        direction = np.asarray(vector, dtype=np.float64)
    except (TypeError, ValueError):
        direction = np.empty(0)
    if direction.shape != (3,) or not np.isfinite(direction).all() or not direction.any():
        raise ValueError(f"expected {name} as three finite numbers, not all zero, got {vector!r}")
    direction = direction / np.abs(direction).max()  # so that squares neither overflow nor become 0
    return direction / np.linalg.norm(direction)


def node_features(moments: Moments) -> NodeFeatures:
    """Features of every group of points.

    Parameters
    ----------
    moments : Moments of k groups
        Without normals, the signs of the planes' normals are arbitrary.
    """
    covariance = moments.covariances
    towards = np.zeros_like(moments.centroids) if moments.normals is None else moments.normals
    k = len(moments)
    deviations, normals = np.empty((k, 3)), np.empty((k, 3))
    _principal(covariance, towards, deviations, normals)
    low, middle, high = np.ascontiguousarray(deviations.T)
    scale = np.where(high > 0.0, high, 1.0)
    colors, spreads = moments.colors, moments.color_covariances
    return NodeFeatures(
        size=moments.counts,
        centroid=moments.centroids,
        normal=normals,
        covariance=covariance,
        linearity=(high - middle) / scale,
        planarity=(middle - low) / scale,
        scattering=low / scale,
        residual=low,
        color=np.full((k, 3), np.nan) if colors is None else colors,
        color_covariance=np.full((k, 3, 3), np.nan) if spreads is None else spreads,
        deviations=deviations,
        features=np.empty((k, 0)) if moments.features is None else moments.features,
    )


@kernel
def _principal(
    covariances: NDArray[np.float64],
    towards: NDArray[np.float64],
    deviations: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> None:
    """Set standard deviations, ascending, (k, 3), and plane normals, (k, 3)."""
    matrix, vectors, axes = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for s in range(len(covariances)):
        for i in range(3):
            for j in range(3):
                matrix[i, j] = covariances[s, i, j]
        symmetric_eigen(matrix, vectors)
        for axis in range(3):
            rank = 0
            for other in range(3):  # ties go by number, so that ranks differ
                below = matrix[other, other] - matrix[axis, axis]
                rank += below < 0.0 or (below == 0.0 and other < axis)
            deviations[s, rank] = np.sqrt(max(matrix[axis, axis], 0.0))
            for i in range(3):
                axes[rank, i] = vectors[i, axis]
        _plane_normal(deviations[s, 1], deviations[s, 2], axes, towards[s], normals[s])


@routine
def _plane_normal(
    middle: float,
    high: float,
    axes: NDArray[np.float64],
    towards: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> None:
    """Set `normal` to the axis of least spread, or for a line to an axis across it, on the outer side."""
    for i in range(3):
        normal[i] = axes[0, i]
    if middle <= _MAX_WIDTH_OF_LINE * high:
        along = 0.0
        if high > 0.0:
            for i in range(3):
                along += axes[2, i] * towards[i]
        squares = reach = 0.0
        for i in range(3):
            squares += (towards[i] - along * axes[2, i]) ** 2
            reach += towards[i] ** 2
        if squares > 1e-24 * reach:  # else `towards` lies along the line, but for rounding
            for i in range(3):
                normal[i] = (towards[i] - along * axes[2, i]) / np.sqrt(squares)
    facing = 0.0
    for i in range(3):
        facing += normal[i] * towards[i]
    if facing < 0.0:
        for i in range(3):
            normal[i] = -normal[i]


# --- tables of features: one array per column ---


def rows(columns: dict[str, NDArray[np.generic]], n: int) -> list[dict[str, object]]:
    """One dict of Python's own values per row, from one array (n,) per column.

    A number that is not finite is left out of its row, because JSON has neither NaN nor infinity.
    """
    lists = {name: plain(column) for name, column in columns.items()}
    return [{name: values[i] for name, values in lists.items() if values[i] is not None} for i in range(n)]


def scalar_columns(columns: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    """The same table with one column per number: vectors become x, y, z, colours r, g, b, matrices xx, xy and so on.

    Features are numbered: feature_0, feature_1 and so on. Symmetric matrices keep their upper triangle. Columns that
    are all NaN, as colours of a cloud without any, are left out.
    """
    split: dict[str, NDArray[np.generic]] = {}
    for name, column in columns.items():
        axes = "rgb" if name.startswith("color") else "xyz"
        if column.ndim == 1:
            split[name] = column
        elif name == "features":
            split |= {f"feature_{i}": column[:, i] for i in range(column.shape[1])}
        elif column.ndim == 2:
            split |= {f"{name}_{axes[i]}": column[:, i] for i in range(3)}
        else:
            split |= {f"{name}_{axes[i]}{axes[j]}": column[:, i, j] for i in range(3) for j in range(i, 3)}
    return {name: column for name, column in split.items() if not len(column) or not _unknown(column)}


def _unknown(column: NDArray[np.generic]) -> bool:
    return column.dtype.kind == "f" and bool(np.isnan(column.astype(np.float64)).all())
