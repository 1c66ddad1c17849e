# SPDX-License-Identifier: Apache-2.0
"""Where one supervoxel hides another from the sensor without touching it, and what may go on behind.

The voxels are seen in an image of directions; depth edges are sought along its rows and columns, and gathered by pairs
of supervoxels.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.continuations import Continuations, continuations_of
from pcgraph.graph.spherical_image import SphericalImage, View, depth_jumps, spherical_image, surfels_of, view_from
from pcgraph.pairs import distinct_pairs
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.surface import Surface

REACH, MIN_GAP = 8.0, 3.0
"""How wide a gap without data is looked across, and what difference of range parts surfaces, in voxels."""


@dataclass(frozen=True, eq=False)
class Occlusions(ShortRepr):
    """Pairs of supervoxels next to each other as the sensor sees them, but apart in depth.

    A pair may touch elsewhere, and then has a contact edge as well; each may hide the other, in different places.

    Attributes
    ----------
    pairs : (q, 2) int32
        Supervoxel in front, supervoxel behind; rows in ascending order, once each.
    gap : (q,) float64, metres, > 0
        Mean difference of their ranges from the viewpoint along the boundary.
    length : (q,) float64, metres
        Sum of the edge lengths of the front's voxels along the boundary.
    direction : (q, 3) float64
        Unit mean direction from the front across the boundary, square to the line of sight; zero if it cancels.
    continuations : Continuations
        What may go on behind.
    """

    pairs: NDArray[np.int32]
    gap: NDArray[np.float64]
    length: NDArray[np.float64]
    direction: NDArray[np.float64]
    continuations: Continuations

    def columns(self) -> dict[str, NDArray[np.generic]]:
        """Features of the pairs by name, in the order of the attributes."""
        return {field.name: getattr(self, field.name) for field in fields(self)[1:4]}


def occlusions(
    surface: Surface,
    nodes: NodeFeatures,
    viewpoint: ArrayLike,
    image: ArrayLike | None = None,
    *,
    reach: float = REACH,
    least_gap: float = MIN_GAP,
) -> Occlusions:
    """Occlusions between supervoxels, as seen from the viewpoint.

    Parameters
    ----------
    surface : Surface of v voxels
    nodes : NodeFeatures of the k supervoxels
    viewpoint : (3,) float, metres, the points' frame
        Where the sensor stood.
    image : (h, w) integers, optional
        For organised clouds: voxel of each pixel, -1 where there is none. Default: a spherical image of the voxels
        themselves, about one cell per voxel, which serves any cloud seen from one place.
    reach : float, voxels, > 0
        How wide a gap without data, as structured light leaves one along depth edges, is looked across.
    least_gap : float, voxels, > 0
        Difference of range above which surfaces are apart. The front has to stand off the plane of what is behind by
        half as much, since a slanted surface gets deeper as well.

    Raises
    ------
    ValueError
        Something is not as above.

    Notes
    -----
    Features are means over pairs of neighbouring cells along the image's rows and columns.
    """
    position = np.asarray(viewpoint, dtype=np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise ValueError(f"expected a viewpoint of three finite coordinates in metres, got {viewpoint!r}")
    for name, value in (("reach", reach), ("least_gap", least_gap)):
        if not 0.0 < value < np.inf:
            raise ValueError(f"expected {name} as a finite number of voxels above 0, got {value!r}")
    view = view_from(position, surfels_of(surface))
    seen = spherical_image(view) if image is None else SphericalImage(_checked(image, surface.grid.n_voxels))
    jumps = depth_jumps(view, seen, reach, least_gap)
    return _collected(surface, view, jumps.edges, continuations_of(surface, nodes, jumps.occluded_spans))


def _checked(image: ArrayLike, n_voxels: int) -> NDArray[np.int32]:
    voxels = np.asarray(image)
    if voxels.ndim != 2 or voxels.dtype.kind not in "iu":
        raise ValueError(f"expected image as (h, w) integers, got {voxels.dtype} of shape {voxels.shape}")
    if voxels.size and not -1 <= voxels.min() <= voxels.max() < n_voxels:
        raise ValueError(f"expected image with voxels -1..{n_voxels - 1}, got {voxels.min()}..{voxels.max()}")
    return voxels.astype(np.int32)


def _collected(
    surface: Surface, view: View, depth_edges: NDArray[np.int32], continuations: Continuations
) -> Occlusions:
    """Depth edges by pair of supervoxels."""
    front, behind = depth_edges.T
    pairs, pair = distinct_pairs(surface.supervoxels[front], surface.supervoxels[behind])
    q, bearings, ranges = len(pairs), view.bearings, view.ranges
    gap = np.bincount(pair, ranges[behind] - ranges[front], q) / np.bincount(pair, minlength=q)
    boundary = np.unique(pair * np.int64(surface.grid.n_voxels) + front)
    boundary_pair, boundary_voxel = np.divmod(boundary, surface.grid.n_voxels)
    edge_lengths = surface.grid.edge_lengths[boundary_voxel]
    length = np.bincount(boundary_pair, edge_lengths, q).astype(np.float64)  # int64 if q is 0
    across = bearings[behind] - bearings[front]
    sums = np.stack([np.bincount(pair, across[:, axis], q) for axis in range(3)], axis=1)
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    return Occlusions(pairs, gap, length, sums / np.maximum(norms, 1e-12), continuations)
