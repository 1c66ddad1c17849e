# SPDX-License-Identifier: Apache-2.0
"""Bounding planes: floors, ceilings and walls, whose pieces are one, though nothing shows how they go on."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pcgraph.features.moments import Moments, grouped_moments
from pcgraph.features.nodes import NodeFeatures, node_features
from pcgraph.graph.continuations import Continuations, continuations_of
from pcgraph.parallel import in_blocks, kernel, routine
from pcgraph.voxels.surface import Surface

_LEAST_VOXELS = 40  # of a piece, some two supervoxels
_FLAT = 0.7  # voxel edges, root mean square of its distances to its plane, at most
_BEYOND = 2.5  # voxel edges off a plane lies what is behind it, or before it
_BEHIND, _BEFORE = 0.005, 0.2  # of all voxels lie so, at most and at least
_PARALLEL, _OFFSET = 0.98, 1.0  # cosine, and voxel edges, between two pieces of one plane, at least and at most
_GAP = 0.75  # times the width of the larger one lies between them, at most
_FACING = 2.0  # times as far apart as where they are nearest are borders that face each other, at most
_BETWEEN = 1.5  # times as long as the way between two pieces is one over a point between them, at most
_AROUND = 8  # voxels of its own piece that a voxel amid it has around it


def bounding_planes(surface: Surface, nodes: NodeFeatures, faces: NDArray[np.int32]) -> Continuations:
    """Supervoxels on the borders that pieces of one bounding plane turn to each other.

    A plane bounds the scene if nothing lies behind it, and much before it: the floor of a room, its ceiling, its outer
    walls, a street. What is missing of it is hidden, or was not scanned: through a hole something would be seen. So its
    pieces are one, whether or not something is seen to hide the rest, if what lies between them is at most three
    quarters as wide as the larger one, by the root of its area, which grows as they join.

    Parameters
    ----------
    surface : Surface of v voxels
    nodes : NodeFeatures of the k supervoxels
    faces : (k,) int32
        Which of them lie on one face.

    Returns
    -------
    Continuations
        All coplanar, as their pieces are, whatever their own normals. Crossings are pairs of voxels on the borders,
        each the other's nearest. What lies so near that gaps join it (`pcgraph.graph.gaps.gaps`) is left to these.
    """
    pieces = _bounding_pieces(surface, nodes, faces)
    pairs = _coplanar_pairs(pieces.planes.centroid, pieces.planes.normal, pieces.planes.covariance, pieces.edges)
    borders = _borders(surface, pieces.of_supervoxel, pairs)
    hidings = np.concatenate((np.empty((0, 2), np.int64), *_ways(pieces, pairs, borders, nodes)))
    ends = surface.grid.warped[hidings]
    far = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > surface.grid.warp.max_gap * surface.grid.size
    found = continuations_of(surface, nodes, hidings[far])
    return replace(found, coplanar=np.ones(len(found.pairs), np.bool_))


class _Pieces(NamedTuple):
    """Faces that lie on bounding planes.

    Attributes
    ----------
    planes : NodeFeatures of p pieces
        All voxels count the same.
    edges : (p,) float64, metres
        Mean edge length of their voxels.
    areas : (p,) float64, square metres
    of_supervoxel : (k,) int64
        Piece of each supervoxel, -1 of those on none.
    """

    planes: NodeFeatures
    edges: NDArray[np.float64]
    areas: NDArray[np.float64]
    of_supervoxel: NDArray[np.int64]


class _Border(NamedTuple):
    """Voxels at the border of a piece, their places and a tree of these."""

    voxels: NDArray[np.int64]
    places: NDArray[np.float64]
    tree: cKDTree


def _bounding_pieces(surface: Surface, nodes: NodeFeatures, faces: NDArray[np.int32]) -> _Pieces:
    """Faces that are large and flat and bound the scene."""
    k = len(nodes.size)
    voxels = np.bincount(surface.supervoxels, minlength=k)
    edges = np.bincount(surface.supervoxels, surface.grid.edge_lengths, k) / voxels
    large = np.bincount(faces, voxels) >= _LEAST_VOXELS
    on, n = np.flatnonzero(large[faces]), int(large.sum())
    face = (np.cumsum(large) - 1)[faces[on]]
    parts = Moments(voxels[on], nodes.centroid[on], voxels[on, None, None] * nodes.covariance[on], None)
    parts = replace(parts, normals=nodes.normal[on])  # outwards
    moments = grouped_moments(parts, face, n)
    planes = node_features(moments)
    mean_edges = np.bincount(face, voxels[on] * edges[on], n) / planes.size
    flat = np.flatnonzero(planes.residual <= _FLAT * mean_edges)
    bounding = np.empty(len(flat), np.bool_)
    scattered = np.random.default_rng(0).permutation(k)  # so that it is soon seen that a plane bounds nothing
    scene = nodes.centroid[scattered], _BEYOND * edges[scattered], voxels[scattered]
    in_blocks(_bound, len(flat), planes.centroid[flat], planes.normal[flat], *scene, bounding)
    kept = flat[bounding]
    number = np.full(n, -1)
    number[kept] = np.arange(len(kept))
    of_supervoxel = np.full(k, -1)
    of_supervoxel[on] = number[face]
    areas = np.bincount(face, (voxels * edges * edges)[on], n)[kept].astype(np.float64)
    return _Pieces(node_features(moments[kept]), mean_edges[kept], areas, of_supervoxel)


@kernel
def _bound(
    start: int,
    stop: int,
    centroids: NDArray[np.float64],
    normals: NDArray[np.float64],
    places: NDArray[np.float64],
    beyond: NDArray[np.float64],
    voxels: NDArray[np.int64],
    found: NDArray[np.bool_],
) -> None:
    """Set which planes have nearly nothing behind them and much before them, given the supervoxels."""
    total = voxels.sum()
    for plane in range(start, stop):
        behind = before = 0
        for s in range(len(places)):
            height = 0.0
            for axis in range(3):
                height += (places[s, axis] - centroids[plane, axis]) * normals[plane, axis]
            behind += voxels[s] if height < -beyond[s] else 0
            before += voxels[s] if height > beyond[s] else 0
            if behind > _BEHIND * total:
                break
        found[plane] = behind <= _BEHIND * total and before >= _BEFORE * total


@kernel
def _coplanar_pairs(
    centroids: NDArray[np.float64],
    normals: NDArray[np.float64],
    covariances: NDArray[np.float64],
    edges: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Pairs of pieces that lie on one plane, (q, 2), the smaller number first, ascending."""
    n = len(edges)
    partners, firsts = np.empty(n, np.int64), np.empty(0, np.int64)
    seconds = firsts
    for a in range(n):
        found = 0
        for b in range(a + 1, n):
            cosine = 0.0
            for axis in range(3):
                cosine += normals[a, axis] * normals[b, axis]
            if cosine < _PARALLEL:
                continue
            off = _square_off(centroids, normals, covariances, a, b)
            off = max(off, _square_off(centroids, normals, covariances, b, a))
            if off <= (_OFFSET * max(edges[a], edges[b])) ** 2:
                partners[found] = b
                found += 1
        firsts, seconds = np.append(firsts, np.full(found, a)), np.append(seconds, partners[:found])
    return np.stack((firsts, seconds), axis=1)


@routine
def _square_off(
    centroids: NDArray[np.float64], normals: NDArray[np.float64], covariances: NDArray[np.float64], a: int, b: int
) -> float:
    """Mean square distance of piece a to the plane of piece b."""
    shift = square = 0.0
    for i in range(3):
        shift += (centroids[a, i] - centroids[b, i]) * normals[b, i]
        for j in range(3):
            square += normals[b, i] * covariances[a, i, j] * normals[b, j]
    return square + shift * shift


def _borders(surface: Surface, of_supervoxel: NDArray[np.int64], pairs: NDArray[np.int64]) -> dict[int, _Border]:
    """The border of each piece in a pair: voxels with fewer than eight of the same piece around them."""
    if not len(pairs):
        return {}
    grid, piece = surface.grid, of_supervoxel[surface.supervoxels]
    voxels = np.flatnonzero(np.isin(piece, pairs))
    degrees = np.diff(grid.indptr)[voxels]
    row = np.repeat(np.arange(len(voxels)), degrees)
    at = np.arange(len(row)) + np.repeat(grid.indptr[voxels] - np.cumsum(degrees) + degrees, degrees)
    around = np.bincount(row, piece[grid.neighbours[at]] == piece[voxels[row]], len(voxels))
    voxels = voxels[around < _AROUND]
    voxels = voxels[np.argsort(piece[voxels], kind="stable")]
    numbers, starts = np.unique(piece[voxels], return_index=True)
    borders = {}
    for number, some in zip(numbers.tolist(), np.split(voxels, starts[1:]), strict=True):
        borders[number] = _Border(some, grid.centroids[some], cKDTree(grid.centroids[some]))
    return borders


def _ways(
    pieces: _Pieces, pairs: NDArray[np.int64], borders: dict[int, _Border], nodes: NodeFeatures
) -> list[NDArray[np.int64]]:
    """Voxels on borders that face each other, (c, 2), of each pair of pieces that joins what was not yet one."""
    box = np.empty((2, len(pieces.edges), 3))
    for piece, border in borders.items():
        box[:, piece] = border.places.min(axis=0), border.places.max(axis=0)
    (low_a, low_b), (high_a, high_b) = box[:, pairs.T]
    apart = np.linalg.norm(np.maximum(np.maximum(low_a - high_b, low_b - high_a), 0.0), axis=1)
    whole, areas = np.arange(len(pieces.edges)), pieces.areas.copy()
    facing: dict[int, tuple[float, NDArray[np.int64]]] = {}
    ways, order, joined = [], np.argsort(apart, kind="stable"), True
    while joined:  # as what is one grows, wider gaps are bridged
        joined, order = False, order[whole[pairs[order, 0]] != whole[pairs[order, 1]]]
        for pair in order.tolist():
            a, b = whole[pairs[pair]]
            reach = _GAP * np.sqrt(max(areas[a], areas[b]))
            if a == b or apart[pair] > reach:
                continue
            one, other = (borders[piece] for piece in pairs[pair].tolist())
            if pair not in facing:
                facing[pair] = _facing(one, other)
            width, between = facing[pair]
            if width > reach:
                continue
            if any(_shows_behind(pieces, piece, nodes, one, other, width) for piece in pairs[pair]):
                apart[pair] = np.inf
                continue
            ways.append(between)
            areas[a] += areas[b]
            whole[whole == b] = a
            joined = True
    return ways


def _facing(one: _Border, other: _Border) -> tuple[float, NDArray[np.int64]]:
    """How far apart two borders are, metres, and their voxels that are each the other's nearest, (c, 2)."""
    distance, nearest = other.tree.query(one.places)
    _, back = one.tree.query(other.places)
    facing = (back[nearest] == np.arange(len(nearest))) & (distance <= _FACING * distance.min())
    return float(distance.min()), np.stack((one.voxels[facing], other.voxels[nearest[facing]]), axis=1)


def _shows_behind(pieces: _Pieces, piece: int, nodes: NodeFeatures, one: _Border, other: _Border, width: float) -> bool:
    """Whether a supervoxel behind the plane of a piece is seen between two, through what would be a hole."""
    normal = pieces.planes.normal[piece]
    heights = (nodes.centroid - pieces.planes.centroid[piece]) @ normal
    behind = heights < -_BEYOND * pieces.edges[piece]
    feet = nodes.centroid[behind] - heights[behind, None] * normal
    return bool(len(feet)) and bool((one.tree.query(feet)[0] + other.tree.query(feet)[0] <= _BETWEEN * width).any())
