# SPDX-License-Identifier: Apache-2.0
"""Where one supervoxel hides another from the sensor without touching it."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.bearings import BearingImage, bearing_image
from pcgraph.graph.relations import angle_between
from pcgraph.graph.scanlines import scan
from pcgraph.short_repr import ShortRepr
from pcgraph.voxels.surface import Surface

_FLUSH_RAD = 0.2
_FLUSH_VOXELS = 2.0


@dataclass(frozen=True, eq=False)
class Continuations(ShortRepr):
    """Pairs of supervoxels that vanish behind something on one side and appear from behind it on the other.

    Attributes
    ----------
    pairs : (r, 2) int32
        Supervoxels i < j, rows in ascending order, once each.
    crossings : (r,) int64
        Lines of the bearing image along which that happens.
    width : (r,) float64, metres
        Mean distance across what hides the surface between.
    angle : (r,) float64, radians, 0..pi
        Angle between the supervoxels' normals.
    offset : (r,) float64, metres
        Mean distance of either's rim from the other's plane, the larger of the two.
    color_contrast : (r,) float64, 0..sqrt(3)
        Distance of mean colours; 0 if the cloud has none.
    coplanar : (r,) bool
        Whether the two could be one flat surface: angle of at most 0.2 rad, and offset of at most two voxels or a
        tenth of the width.
    """

    pairs: NDArray[np.int32]
    crossings: NDArray[np.int64]
    width: NDArray[np.float64]
    angle: NDArray[np.float64]
    offset: NDArray[np.float64]
    color_contrast: NDArray[np.float64]
    coplanar: NDArray[np.bool_]


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
    reach: float = 8.0,
    least_gap: float = 3.0,
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
    grid = surface.grid
    seen = bearing_image(surface, position) if image is None else BearingImage(_checked(image, grid.n_voxels))
    rays = grid.centroids - position
    ranges = np.maximum(np.sqrt(np.einsum("ij,ij->i", rays, rays)), 1e-300)
    bearings = rays / ranges[:, None]
    found = [
        scan(
            np.ascontiguousarray(lines), wraps, bearings, ranges, surface.normals, grid.edge_lengths,
            surface.supervoxels, grid.indptr, grid.neighbours, reach, least_gap,
        )
        for lines, wraps in ((seen.voxels, seen.wraps), (seen.voxels.T, False))
    ]  # fmt: skip
    depth_edges, hidings = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _collected(surface, bearings, ranges, depth_edges, _continuations(surface, nodes, hidings))


def _checked(image: ArrayLike, n_voxels: int) -> NDArray[np.int32]:
    voxels = np.asarray(image)
    if voxels.ndim != 2 or voxels.dtype.kind not in "iu":
        raise ValueError(f"expected image as (h, w) integers, got {voxels.dtype} of shape {voxels.shape}")
    if voxels.size and not -1 <= voxels.min() <= voxels.max() < n_voxels:
        raise ValueError(f"expected image with voxels -1..{n_voxels - 1}, got {voxels.min()}..{voxels.max()}")
    return voxels.astype(np.int32)


def _collected(
    surface: Surface,
    bearings: NDArray[np.float64],
    ranges: NDArray[np.float64],
    depth_edges: NDArray[np.int32],
    continuations: Continuations,
) -> Occlusions:
    """Depth edges by pair of supervoxels."""
    front, behind = depth_edges.T
    pairs, pair = _pairs(surface.supervoxels[front], surface.supervoxels[behind])
    q = len(pairs)
    gap = np.bincount(pair, ranges[behind] - ranges[front], q) / np.bincount(pair, minlength=q)
    rims = np.unique(pair * np.int64(surface.grid.n_voxels) + front)
    rim_pair, rim_voxel = np.divmod(rims, surface.grid.n_voxels)
    length = np.bincount(rim_pair, surface.grid.edge_lengths[rim_voxel], q).astype(np.float64)  # int64 if q is 0
    across = bearings[behind] - bearings[front]
    sums = np.stack([np.bincount(pair, across[:, axis], q) for axis in range(3)], axis=1)
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    return Occlusions(pairs, gap, length, sums / np.maximum(norms, 1e-12), continuations)


def _continuations(surface: Surface, nodes: NodeFeatures, hidings: NDArray[np.int32]) -> Continuations:
    """Hidings by pair of supervoxels."""
    owners = surface.supervoxels[hidings]
    swap = owners[:, 0] > owners[:, 1]
    hidings, owners = (np.where(swap[:, None], both[:, ::-1], both) for both in (hidings, owners))
    pairs, pair = _pairs(owners[:, 0], owners[:, 1])
    r, (i, j) = len(pairs), pairs.T
    crossings = np.bincount(pair, minlength=r)
    ends = surface.grid.centroids[hidings]
    width = np.bincount(pair, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), r) / crossings
    heights = [
        np.bincount(pair, np.abs(_heights(ends[:, 1 - side], owners[:, side], nodes)), r) / crossings for side in (0, 1)
    ]
    edge = np.bincount(pair, surface.grid.edge_lengths[hidings].mean(axis=1), r) / crossings
    angle, offset = angle_between(nodes.normal[i], nodes.normal[j]), np.maximum(*heights)
    contrast = np.nan_to_num(np.linalg.norm(nodes.color[j] - nodes.color[i], axis=1))
    coplanar = (angle <= _FLUSH_RAD) & (offset <= np.maximum(_FLUSH_VOXELS * edge, 0.1 * width))
    return Continuations(pairs, crossings, width, angle, offset, contrast, coplanar)


def _heights(points: NDArray[np.float64], owners: NDArray[np.int32], nodes: NodeFeatures) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", points - nodes.centroid[owners], nodes.normal[owners])


def _pairs(first: NDArray[np.int32], second: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Distinct pairs in ascending order, (q, 2) int32, and the pair of each row."""
    keys, inverse = np.unique((first.astype(np.int64) << 32) + second, return_inverse=True)
    return np.stack((keys >> 32, keys & 0xFFFFFFFF), axis=1).astype(np.int32), inverse
