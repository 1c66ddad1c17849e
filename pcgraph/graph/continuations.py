# SPDX-License-Identifier: Apache-2.0
"""Continuations: surfaces that vanish behind something on one side and appear from behind it on the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.bearing_image import BearingImage, View, bearing_image, depth_jumps, range_seen, view_from
from pcgraph.graph.contacts import angle_between
from pcgraph.parallel import in_blocks, kernel
from pcgraph.short_repr import ShortRepr
from pcgraph.voxels.surface import Surface

REACH, LEAST_GAP = 8.0, 3.0
"""How wide a gap without data is looked across, and what difference of range parts surfaces, in voxels."""
_SMOOTH_RAD = 0.2  # surfaces at most this far apart in angle
_SMOOTH_VOXELS = 2.0  # and in height may be one
_LEAST_CROSSINGS = 2
_SEEN_THROUGH = 0.1  # of the looks at what should be hidden, at most, go through it,
_THROUGH = 1.5  # voxels at least
_SAMPLES = 3  # on the way from one side to the other


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
        Mean distance of either's boundary from the other's plane, the larger of the two.
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

    def chosen(self, some: NDArray[np.bool_]) -> Continuations:
        """Some of the rows."""
        return Continuations(*(getattr(self, name)[some] for name in self.__dataclass_fields__))

    def without(self, pairs: NDArray[np.int32]) -> Continuations:
        """Those that are not among these pairs, (m, 2), the smaller first."""
        keys, others = (both[:, 0].astype(np.int64) << 32 | both[:, 1] for both in (self.pairs, pairs))
        return self.chosen(~np.isin(keys, others))


def continuations(surface: Surface, nodes: NodeFeatures, places: NDArray[np.float64]) -> Continuations:
    """Flat surfaces that go on behind what hides them, as seen from some places; supervoxels may touch elsewhere.

    Parameters
    ----------
    surface : Surface of v voxels
    nodes : NodeFeatures of the k supervoxels
    places : (p, 3) float64, metres
        From where the cloud was seen, or from where its outside is.

    Notes
    -----
    Only pairs that are coplanar, along two lines at least, and whose way from one to the other is hidden: what is seen
    from one of the places through where the surface should be, is no surface.
    """
    views = [view_from(surface, place, some=True) for place in places]
    images = [bearing_image(view) for view in views]
    found = [_hidings(view, image) for view, image in zip(views, images, strict=True)]
    hidings = np.concatenate([view.voxels[rows] for view, rows in zip(views, found, strict=True)])
    all_of_them, pair = continuations_of(surface, nodes, hidings)
    likely = all_of_them.coplanar & (all_of_them.crossings >= _LEAST_CROSSINGS)
    looked_at = np.flatnonzero(likely[pair])
    through = _seen_through(surface, hidings[looked_at], views, images)
    sums = np.bincount(pair[looked_at], through, len(likely))
    return all_of_them.chosen(likely & (sums <= _SEEN_THROUGH * all_of_them.crossings))


def _hidings(view: View, image: BearingImage) -> NDArray[np.int32]:
    return depth_jumps(view, image, REACH, LEAST_GAP).hidings


def _seen_through(
    surface: Surface, hidings: NDArray[np.int64], views: list[View], images: list[BearingImage]
) -> NDArray[np.float64]:
    """Fraction, for each way between two voxels, of the looks at it that go on to something behind it, (c,)."""
    looks = np.zeros(len(hidings))
    edge_lengths = surface.grid.edge_lengths
    for view, image in zip(views, images, strict=True):
        if image.lattice is not None:
            arguments = surface.grid.centroids, edge_lengths, hidings, view, image.voxels, image.lattice
            in_blocks(_count_looks_through, len(hidings), *arguments, looks)
    return looks / (_SAMPLES * len(views))


@kernel
def _count_looks_through(  # type: ignore[no-untyped-def]
    start, stop, centroids, edge_lengths, hidings, view, voxels, lattice, looks
):
    """Add the samples of each way that something is seen behind."""
    sample = np.empty(3)
    for i in range(start, stop):
        a, b = hidings[i]
        edge = _THROUGH * max(edge_lengths[a], edge_lengths[b])
        for step in range(1, _SAMPLES + 1):
            part = step / (_SAMPLES + 1.0)
            for axis in range(3):
                sample[axis] = (1.0 - part) * centroids[a, axis] + part * centroids[b, axis]
            seen, away = range_seen(sample, view, voxels, lattice)
            looks[i] += away + edge < seen < np.inf


def continuations_of(
    surface: Surface, nodes: NodeFeatures, hidings: NDArray[np.integer]
) -> tuple[Continuations, NDArray[np.int64]]:
    """Hidings, (c, 2) voxels, by pair of supervoxels, and which pair each belongs to, (c,)."""
    owners = surface.supervoxels[hidings]
    swap = owners[:, 0] > owners[:, 1]
    hidings, owners = (np.where(swap[:, None], both[:, ::-1], both) for both in (hidings, owners))
    pairs, pair = distinct_pairs(owners[:, 0], owners[:, 1])
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
    coplanar = (angle <= _SMOOTH_RAD) & (offset <= np.maximum(_SMOOTH_VOXELS * edge, 0.1 * width))
    return Continuations(pairs, crossings, width, angle, offset, contrast, coplanar), pair


def _heights(points: NDArray[np.float64], owners: NDArray[np.int32], nodes: NodeFeatures) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", points - nodes.centroid[owners], nodes.normal[owners])


def distinct_pairs(first: NDArray[np.int32], second: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Distinct pairs in ascending order, (q, 2) int32, and the pair of each row."""
    keys, inverse = np.unique((first.astype(np.int64) << 32) + second, return_inverse=True)
    return np.stack((keys >> 32, keys & 0xFFFFFFFF), axis=1).astype(np.int32), inverse
