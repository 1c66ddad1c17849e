# SPDX-License-Identifier: Apache-2.0
"""Features of nodes: what a group of points looks like, read off its moments."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments

_NO_PLANE = 1e-5  # second over first standard deviation below which points lie on a line


@dataclass(frozen=True)
class NodeFeatures:
    """One row per node, of a graph or of a tree.

    Attributes
    ----------
    size : (k,) int64
        Number of points.
    centroid : (k, 3) float64, metres, the points' frame
    normal : (k, 3) float64
        Unit normal of the least-squares plane, on the viewpoint's side; of points on a line, the direction
        across it that faces the viewpoint most.
    covariance : (k, 3, 3) float64, square metres
    linearity, planarity, scattering : (k,) float64, 0..1
        (s1 - s2) / s1, (s2 - s3) / s1 and s3 / s1 for standard deviations s1 >= s2 >= s3; their sum is 1, and
        all are 0 where the points coincide. Source: Demantke et al. 2011.
    residual : (k,) float64, metres
        Root mean square distance to the plane, s3.
    color : (k, 3) float64, 0..1
        Mean colour; NaN if the cloud has none.
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

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """All features by name, in the order of the attributes."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def node_features(moments: Moments, viewpoint: NDArray[np.float64]) -> NodeFeatures:
    """Features of every group of points.

    Parameters
    ----------
    moments : Moments of k groups
    viewpoint : (3,) float64, metres, the points' frame
    """
    covariance = moments.covariances
    variances, vectors = np.linalg.eigh(covariance)
    deviations = np.sqrt(np.maximum(variances, 0.0))
    low, middle, high = deviations.T
    scale = np.where(high > 0.0, high, 1.0)
    colors = moments.colors
    return NodeFeatures(
        size=moments.counts,
        centroid=moments.centroids,
        normal=_plane_normals(deviations, vectors, viewpoint - moments.centroids),
        covariance=covariance,
        linearity=(high - middle) / scale,
        planarity=(middle - low) / scale,
        scattering=low / scale,
        residual=low,
        color=np.full((len(moments), 3), np.nan) if colors is None else colors,
    )


def _plane_normals(
    deviations: NDArray[np.float64], vectors: NDArray[np.float64], towards: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Direction of least spread on the viewpoint's side; of points on a line, across it."""
    normals = vectors[:, :, 0].copy()
    flat = deviations[:, 1] > _NO_PLANE * deviations[:, 2]
    line = np.where((deviations[:, 2] > 0.0)[:, None], vectors[:, :, 2], 0.0)
    across = towards - line * np.einsum("ij,ij->i", line, towards)[:, None]
    length = np.linalg.norm(across, axis=1)
    usable = ~flat & (length > 1e-12 * np.linalg.norm(towards, axis=1))
    normals[usable] = across[usable] / length[usable, None]
    away = np.einsum("ij,ij->i", normals, towards) < 0.0
    normals[away] *= -1.0
    return normals
