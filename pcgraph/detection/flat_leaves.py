# SPDX-License-Identifier: Apache-2.0
"""Supervoxels as the search for planes sees them: with a tolerance each, and which meet without step or bend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.detection.noise import surface_noise
from pcgraph.features.moments import Moments
from pcgraph.inputs import positive
from pcgraph.segmentation import Segmentation

NOISE_FACTOR = 3.5  # tolerance over that noise: on real tables no supervoxel is worse
LEAST_TOLERANCE = 0.02  # of a voxel's edge, where there is no noise
MOST_TOLERANCE = 1.0  # of a voxel's edge, where nothing is flat
SHAPELESS = 0.8  # width (standard deviation) over tolerance below which noise decides the normal


@dataclass(frozen=True)
class FlatLeaves:
    """Supervoxels as the search for planes sees them.

    Attributes
    ----------
    moments : Moments of n supervoxels
    normals : (n, 3) float64
    tolerances : (n,) float64, metres
        Largest root mean square distance of a supervoxel to its plane.
    shapeless : (n,) bool
        Supervoxels too small, next to the tolerance, for their normal to mean anything.
    cos_angle : float
        Cosine of the largest angle between a supervoxel and its plane.
    edges : (m, 2) int32
        Which of them touch.
    flush : (m,) bool
        Whether they meet there without step or bend.
    """

    moments: Moments
    normals: NDArray[np.float64]
    tolerances: NDArray[np.float64]
    shapeless: NDArray[np.bool_]
    cos_angle: float
    edges: NDArray[np.int32]
    flush: NDArray[np.bool_]


def flat_leaves(segmentation: Segmentation, tolerance: float | None, angle: float) -> FlatLeaves:
    """Supervoxels of a segmentation, for this tolerance (metres; None: from the noise) and angle (radians)."""
    nodes, moments = segmentation.graph.node_features, segmentation.leaves
    n = len(moments)
    edge = voxel_edges(segmentation)
    if tolerance is None:
        noise = surface_noise(nodes.residual, edge, nodes.size)
        tolerances = np.clip(NOISE_FACTOR * noise, LEAST_TOLERANCE * edge, MOST_TOLERANCE * edge)
    else:
        tolerances = np.full(n, positive("tolerance", tolerance))
    middle = np.sqrt(np.maximum(np.linalg.eigvalsh(nodes.covariance)[:, 1], 0.0))
    i, j = segmentation.graph.edges.T
    edges = segmentation.graph.edge_features
    flush = (edges.step <= np.minimum(tolerances[i], tolerances[j])) & (edges.normal_angle <= angle)
    return FlatLeaves(
        moments=moments,
        normals=nodes.normal,
        tolerances=tolerances,
        shapeless=middle < SHAPELESS * tolerances,
        cos_angle=float(np.cos(angle)),
        edges=segmentation.graph.edges,
        flush=flush,
    )


def voxel_edges(segmentation: Segmentation) -> NDArray[np.float64]:
    """Mean edge of each supervoxel's voxels, (n_leaves,) float64, metres."""
    surface, n = segmentation.surface, segmentation.tree.n_leaves
    sums = np.bincount(surface.supervoxels, surface.grid.edge_lengths, n)
    return sums / np.bincount(surface.supervoxels, minlength=n)
