# SPDX-License-Identifier: Apache-2.0
"""Continuations: surfaces that vanish behind something on one side and appear from behind it on the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.disjoint_sets import connected_components
from pcgraph.features.moments import Moments, grouped_moments
from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.adjacency import EdgeFeatures
from pcgraph.graph.contacts import angle_between
from pcgraph.graph.spherical_image import (
    View,
    apart,
    depth_jumps,
    line_buffers,
    spherical_image,
    surfels_along,
    surfels_of,
    view_from,
)
from pcgraph.pairs import distinct_pairs, not_among, pair_keys
from pcgraph.parallel import kernel
from pcgraph.plumbing.short_repr import ShortRepr
from pcgraph.voxels.surface import Surface

REACH, MIN_GAP = 8.0, 3.0
"""How wide a gap without data is looked across, and what difference of range parts surfaces, in voxels."""
_SMOOTH_RAD = 0.2  # surfaces at most this far apart in angle
_SMOOTH_VOXELS = 2.0  # and in height may be one
_MIN_CROSSINGS = 2
_SUPPORT = 2.0  # times as wide as what is hidden is the larger of the faces, at least
_LEVEL = 3.0  # times what two faces are uneven by they may lie off each other's planes,
_EVEN = 0.05  # voxel edges at least
_OPEN = 0.5  # of the lines along which borders are hidden, at most, may find them open


@dataclass(frozen=True, eq=False)
class Continuations(ShortRepr):
    """Pairs of supervoxels that vanish behind something on one side and appear from behind it on the other.

    Attributes
    ----------
    pairs : (r, 2) int32
        Supervoxels i < j, rows in ascending order, once each.
    crossings : (r,) int64
        Lines of the spherical image along which that happens, or ways across a gap in a bounding plane.
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
        tenth of the width; or they lie on one bounding plane (`pcgraph.graph.bounding_planes.bounding_planes`). Those
        that are not are pieces of one terrain (`pcgraph.graph.terrain.terrain`).
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

    def with_others(self, others: Continuations) -> Continuations:
        """These rows and those of others whose pairs are not among them."""
        columns = self.__dataclass_fields__
        others = others.without(self.pairs)
        both = Continuations(*(np.concatenate((getattr(self, name), getattr(others, name))) for name in columns))
        order = np.argsort(pair_keys(*both.pairs.T), kind="stable")
        return Continuations(*(getattr(both, name)[order] for name in columns))

    def without(self, pairs: NDArray[np.int32]) -> Continuations:
        """Those that are not among these pairs, (m, 2) int32, the smaller first, in ascending order."""
        return self.chosen(not_among(self.pairs, pairs))


def faces_of(edges: NDArray[np.int32], features: EdgeFeatures, k: int) -> NDArray[np.int32]:
    """Face of each of k supervoxels, (k,) int32: those that touch, and go on smoothly as each other, are on one."""
    smooth = (features.normal_angle <= _SMOOTH_RAD) & (features.step <= features.voxel_edge)
    return connected_components(edges[smooth], k)


def continuations(
    surface: Surface, nodes: NodeFeatures, faces: NDArray[np.int32], places: NDArray[np.float64]
) -> Continuations:
    """Flat surfaces that go on behind what hides them, as seen from some places; supervoxels may touch elsewhere.

    Parameters
    ----------
    surface : Surface of v voxels
    nodes : NodeFeatures of the k supervoxels
    faces : (k,) int32
        Which of them lie on one face.
    places : (p, 3) float64, metres
        From where the cloud was seen, or from where its outside is.

    Notes
    -----
    Pairs are coplanar, along two lines at least. Two faces that lie in one plane by chance, as fronts of houses do, end
    in the open: their borders are theirs, where those of a floor behind a chair are the chair's. So the borders of both
    faces decide: on the lines from one to the other they lie open at most half as often as they are hidden. Where
    something stands before each gap in a row of equal things, nothing tells; so the larger of the two faces is at least
    twice as wide, by the root of its area, as what is hidden.

    Completion behind what hides a surface: Kellman and Shipley 1991; borders: Nakayama et al. 1989.
    """
    surfels = surfels_of(surface, some=True)
    views = [view_from(place, surfels) for place in places]
    images = [spherical_image(view) for view in views]
    jumps = [depth_jumps(view, image, REACH, MIN_GAP) for view, image in zip(views, images, strict=True)]
    occluded_spans = surfels.voxels[np.concatenate([of_view.occluded_spans for of_view in jumps])]
    found = continuations_of(surface, nodes, occluded_spans)
    found = found.chosen(found.coplanar & (found.crossings >= _MIN_CROSSINGS))
    sides = np.sort(faces[found.pairs], axis=1)
    between, pair = distinct_pairs(sides[:, 0], sides[:, 1])
    hidden, opened = np.bincount(pair, found.crossings, len(between)), np.zeros(len(between), np.int64)
    n_faces, face = int(faces.max()) + 1, faces[surfels.supervoxels]
    both_ways = _both_ways(between, n_faces)
    for view, image in zip(views, images, strict=True):
        for lines, wraps in image.lines:
            last, ends_open = np.full(n_faces, -1), np.zeros(n_faces, np.bool_)
            _count_open(lines, wraps, view, face, both_ways, last, ends_open, line_buffers(lines), opened)
    one_face = between[:, 0] == between[:, 1]
    areas = np.bincount(faces[surface.supervoxels], np.square(surface.grid.edge_lengths / surface.grid.size))
    wide = np.sqrt(areas[faces[found.pairs]].max(axis=1)) >= _SUPPORT * found.width / surface.grid.size
    return found.chosen(wide & (one_face | (opened <= _OPEN * hidden))[pair] & _are_level(surface, nodes, faces, found))


def _are_level(
    surface: Surface, nodes: NodeFeatures, faces: NDArray[np.int32], found: Continuations
) -> NDArray[np.bool_]:
    """Whether each supervoxel of a pair lies as near to the plane of the other's face as that can tell, (r,) bool.

    What noise leaves open grows with the way from the middle of a face, what curvature does with the square of it.
    Noise is the distance of points from the planes of their supervoxels, and what the face adds is curvature.
    """
    n_faces, scatters = int(faces.max()) + 1, nodes.size[:, None, None] * nodes.covariance
    planes = grouped_moments(Moments(nodes.size, nodes.centroid, scatters, None), faces, n_faces)
    edges = surface.mean_edge_lengths(len(nodes.size))
    variances = np.square(nodes.residual) + np.square(_EVEN * edges)
    noise = np.sqrt(np.bincount(faces, nodes.size * variances, n_faces) / planes.counts)
    level = np.ones(len(found.pairs), np.bool_)
    for own, other in (found.pairs.T, found.pairs.T[::-1]):
        face = faces[own]
        spreads, across = np.linalg.eigh(planes.covariances[face])
        ways = np.einsum("ij,ijk->ik", nodes.centroid[other] - planes.centroids[face], across)
        reach = (np.square(ways) / np.maximum(spreads, np.square(noise[face])[:, None]))[:, 1:].sum(axis=1)
        curvature = np.sqrt(np.maximum(spreads[:, 0] - np.square(noise[face]), 0.0))
        uneven = noise[face] * (1.0 + np.sqrt(reach)) + curvature * (1.0 + reach) + noise[faces[other]]
        level &= np.abs(ways[:, 0]) <= _LEVEL * uneven
    return level


class _Ways(NamedTuple):
    """``others[starts[i]:starts[i + 1]]`` are the faces that may go on as face i, by the pairs in `pair`."""

    starts: NDArray[np.int64]
    others: NDArray[np.int32]
    pair: NDArray[np.int64]


def _both_ways(pairs: NDArray[np.int32], n_faces: int) -> _Ways:
    ends = np.concatenate((pairs, pairs[:, ::-1]))
    order = np.argsort(ends[:, 0], kind="stable")
    starts = np.searchsorted(ends[order, 0], np.arange(n_faces + 1))
    return _Ways(starts, ends[order, 1], order % max(len(pairs), 1))


@kernel
def _count_open(
    image: NDArray[np.int32],
    wraps: bool,
    view: View,
    face: NDArray[np.int32],
    ways: _Ways,
    last: NDArray[np.int64],
    ends_open: NDArray[np.bool_],
    buffers: NDArray[np.int32],
    opened: NDArray[np.int64],
) -> None:
    """Add how often, along the rows of an image, one face of each pair ends in the open on the way to the other.

    A face, `face` says which of each surfel, ends or begins in the open where something farther, or nothing, or the
    other face itself lies beside it. Where each face was last, -1 at first, and whether it ended in the open are kept
    in `last` and `ends_open`.
    """
    widths, around, line, columns = view.surfels.widths, image.shape[1], buffers[0], buffers[1]
    farthest = around // 2 if wraps else around  # the way from one to the other is no more than half a turn
    for row in range(image.shape[0]):
        stop, lap = surfels_along(image[row], wraps, line, columns)
        start = 2 * row * around
        for at in range(1, stop):
            before, i = line[at - 1], line[at]
            here, begins_open = face[i], False
            if before >= 0 and face[before] != here:
                deeper, width = view.ranges[i] - view.ranges[before], max(widths[before], widths[i])
                hole = apart(before, i, view, REACH)
                ends_open[face[before]], begins_open = hole or deeper > width, hole or -deeper > width
            column = start + columns[at]
            if (before < 0 or face[before] != here) and (at >= lap or not wraps):
                for way in range(ways.starts[here], ways.starts[here + 1]):
                    other = ways.others[way]
                    beside = before >= 0 and face[before] == other
                    follows = last[other] > max(last[here], start - 1, column - farthest)
                    opened[ways.pair[way]] += follows and (begins_open or ends_open[other] or beside)
            last[here] = column


def continuations_of(surface: Surface, nodes: NodeFeatures, occluded_spans: NDArray[np.integer]) -> Continuations:
    """Continuations from the ends of occluded spans, (c, 2) voxels, by pair of supervoxels."""
    owners = surface.supervoxels[occluded_spans]
    swap = owners[:, 0] > owners[:, 1]
    occluded_spans, owners = (np.where(swap[:, None], both[:, ::-1], both) for both in (occluded_spans, owners))
    pairs, pair = distinct_pairs(owners[:, 0], owners[:, 1])
    r, (i, j) = len(pairs), pairs.T
    crossings = np.bincount(pair, minlength=r)
    ends = surface.grid.centroids[occluded_spans]
    width = np.bincount(pair, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), r) / crossings
    heights = [
        np.bincount(pair, np.abs(_heights(ends[:, 1 - side], owners[:, side], nodes)), r) / crossings for side in (0, 1)
    ]
    edge = np.bincount(pair, surface.grid.edge_lengths[occluded_spans].mean(axis=1), r) / crossings
    angle, offset = angle_between(nodes.normal[i], nodes.normal[j]), np.maximum(*heights)
    contrast = np.nan_to_num(np.linalg.norm(nodes.color[j] - nodes.color[i], axis=1))
    coplanar = (angle <= _SMOOTH_RAD) & (offset <= np.maximum(_SMOOTH_VOXELS * edge, 0.1 * width))
    return Continuations(pairs, crossings, width, angle, offset, contrast, coplanar)


def _heights(points: NDArray[np.float64], owners: NDArray[np.int32], nodes: NodeFeatures) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", points - nodes.centroid[owners], nodes.normal[owners])
