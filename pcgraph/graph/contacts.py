# SPDX-License-Identifier: Apache-2.0
"""Contacts: where two supervoxels touch, and the features of the edge between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.adjacency import EdgeFeatures
from pcgraph.parallel import kernel, routine
from pcgraph.rounding import NEARLY_ZERO
from pcgraph.voxels.grid import Neighbourhood, most_around
from pcgraph.voxels.surface import Surface


@dataclass(frozen=True, eq=False)
class Contacts:
    """Pairs of touching supervoxels, and means over the voxels at their contact; m pairs, side 0 is the smaller number.

    Attributes
    ----------
    edges : (m, 2) int32
        Supervoxels, the smaller first, rows in ascending order.
    voxels : (m, 2) int64
        Number of voxels of each side that touch the other side.
    positions : (m, 2, 3) float64, metres
        Mean centroid of those voxels.
    normals : (m, 2, 3) float64
        Mean of their normals, of unit length (zero if they cancel).
    lengths : (m,) float64, metres
        Sum of those voxels' edge lengths, mean of both sides.
    """

    edges: NDArray[np.int32]
    voxels: NDArray[np.int64]
    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    lengths: NDArray[np.float64]


def contacts(surface: Surface) -> Contacts:
    """Contacts between supervoxels: one per pair with voxels in each other's 26-neighbourhood."""
    supervoxels = surface.supervoxels
    voxel, other, pair, keys = _boundary_voxels(surface.grid.neighbourhood, supervoxels)
    order = np.argsort(keys)
    edge_of_pair = np.empty(len(keys), np.int64)
    edge_of_pair[order] = np.arange(len(keys))
    edges = np.stack((keys[order] >> 32, keys[order] & 0xFFFFFFFF), axis=1).astype(np.int32)
    edge = edge_of_pair[pair]
    return facing_sides(surface, edges, voxel, 2 * edge + (supervoxels[voxel] > other))


def facing_sides(
    surface: Surface,
    edges: NDArray[np.int32],
    voxel: NDArray[np.integer],
    side: NDArray[np.int64],
) -> Contacts:
    """Contacts, given the voxels on either side of each.

    Parameters
    ----------
    surface : Surface
    edges : (m, 2) int32
    voxel : (b,) int
        Voxels that face the other side of a contact; a voxel may occur once for each contact.
    side : (b,) int64
        2 e for a voxel on the smaller supervoxel's side of edge e, 2 e + 1 for one on the other side.
    """
    grid, n_sides = surface.grid, 2 * len(edges)
    voxels, lengths = np.zeros(n_sides, np.int64), np.zeros(len(edges))
    places, directions = np.zeros((n_sides, 3)), np.zeros((n_sides, 3))
    sides = _Sides(voxels, places, directions, lengths)
    _sum_up_sides(voxel.astype(np.int32, copy=False), side, grid.centroids, surface.normals, grid.edge_lengths, sides)
    x, y, z = directions.T
    norms = np.sqrt(x * x + y * y + z * z)
    return Contacts(
        edges=edges,
        voxels=voxels.reshape(-1, 2),
        positions=(places / voxels[:, None]).reshape(-1, 2, 3),
        normals=(directions / np.maximum(norms, NEARLY_ZERO)[:, None]).reshape(-1, 2, 3),  # normals may cancel
        lengths=lengths,
    )


class _Sides(NamedTuple):
    """Sums over the voxels on each of s sides of contacts, zero at first; see `Contacts`.

    Attributes
    ----------
    voxels : (s,) int64
    places, directions : (s, 3) float64
        Sums of centroids and of normals.
    lengths : (s / 2,) float64
        Edge lengths of both sides of a contact, halved.
    """

    voxels: NDArray[np.int64]
    places: NDArray[np.float64]
    directions: NDArray[np.float64]
    lengths: NDArray[np.float64]


@kernel
def _sum_up_sides(
    voxel: NDArray[np.int32],
    side: NDArray[np.int64],
    centroids: NDArray[np.float64],
    normals: NDArray[np.float64],
    edge_lengths: NDArray[np.float64],
    sums: _Sides,
) -> None:
    """Add each voxel to the sums of its side."""
    for row in range(len(voxel)):
        v, s = voxel[row], side[row]
        sums.voxels[s] += 1
        for axis in range(3):
            sums.places[s, axis] += centroids[v, axis]
            sums.directions[s, axis] += normals[v, axis]
        sums.lengths[s >> 1] += 0.5 * edge_lengths[v]


@kernel
def _boundary_voxels(around: Neighbourhood, supervoxels: NDArray[np.int32]):  # type: ignore[no-untyped-def]
    """Voxels on boundaries, once per other supervoxel that each touches: voxel, other, pair; and the pairs' keys.

    Pairs are numbered in the order in which they are found; their key is (smaller << 32) + larger.
    """
    indptr, neighbours = around
    voxel, other = np.empty(len(neighbours), np.int32), np.empty(len(neighbours), np.int32)
    pair = np.empty(len(neighbours), np.int32)
    keys, slots = np.empty(512, np.int64), np.full(2048, -1, np.int32)  # a hash table, at most a quarter full
    seen = np.empty(most_around(indptr) + 1, np.int32)
    used = n_keys = 0
    for i in range(len(supervoxels)):
        own = last = supervoxels[i]
        n_seen = 0
        for a in range(indptr[i], indptr[i + 1]):  # without a branch, which would often be mispredicted
            seen[n_seen] = supervoxels[neighbours[a]]
            n_seen += (seen[n_seen] != own) & (seen[n_seen] != last)
            last = supervoxels[neighbours[a]]
        for b in range(n_seen):
            for earlier in range(b):
                if seen[earlier] == seen[b]:
                    break
            else:
                if n_keys == len(keys):
                    keys, slots = _grown(keys)
                key = (np.int64(min(seen[b], own)) << 32) + np.int64(max(seen[b], own))
                slot = _slot(key, keys, slots)
                if slots[slot] < 0:
                    slots[slot], keys[n_keys] = n_keys, key
                    n_keys += 1
                voxel[used], other[used], pair[used] = i, seen[b], slots[slot]
                used += 1
    return voxel[:used], other[:used], pair[:used], keys[:n_keys]


@routine
def _slot(key: int, keys: NDArray[np.int64], slots: NDArray[np.int32]) -> int:
    """Slot of a key in the hash table, or the empty slot where it belongs."""
    mask = len(slots) - 1
    # Multiplicative hashing by the golden ratio (Knuth 1973, 6.4).
    at = ((key * 0x9E3779B97F4A7C1) >> 32) & mask
    while slots[at] >= 0 and keys[slots[at]] != key:
        at = (at + 1) & mask
    return at


@routine
def _grown(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The same keys in an array twice as long, and their hash table of four slots per place."""
    wide, slots = np.empty(2 * len(keys), np.int64), np.full(8 * len(keys), -1, np.int32)
    for number in range(len(keys)):
        wide[number] = keys[number]
        slots[_slot(keys[number], wide, slots)] = number
    return wide, slots


# --- features of edges ---


def edge_features(nodes: NodeFeatures, contacts: Contacts) -> EdgeFeatures:
    """Features of every contact.

    Parameters
    ----------
    nodes : NodeFeatures of k supervoxels
    contacts : Contacts, m of them, between these supervoxels
    """
    i, j = contacts.edges.T
    at_i, at_j = contacts.positions[:, 0], contacts.positions[:, 1]
    of_i, of_j = contacts.normals[:, 0], contacts.normals[:, 1]
    angle = angle_between(nodes.normal[i], nodes.normal[j])
    off_i = np.abs(_dot(at_j - nodes.centroid[i], nodes.normal[i]))
    off_j = np.abs(_dot(at_i - nodes.centroid[j], nodes.normal[j]))
    return EdgeFeatures(
        convexity=angle * _turn(nodes.normal[i], nodes.normal[j], nodes.centroid[i], nodes.centroid[j]),
        contact_convexity=angle_between(of_i, of_j) * _turn(of_i, of_j, at_i, at_j),
        normal_angle=angle,
        color_contrast=np.nan_to_num(np.linalg.norm(nodes.color[j] - nodes.color[i], axis=1)),
        contact_voxels=contacts.voxels.sum(axis=1),
        contact_length=contacts.lengths,
        step=np.minimum(off_i, off_j),
    )


def angle_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle between rows, radians, 0..pi, (m,); by the arc tangent, which is exact for small angles, too."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return np.arctan2(np.sqrt(x * x + y * y + z * z), _dot(a, b))


def _turn(
    normal_i: NDArray[np.float64], normal_j: NDArray[np.float64], at_i: NDArray[np.float64], at_j: NDArray[np.float64]
) -> NDArray[np.float64]:
    """1 if the surface bends away from its outside on the way from i to j, -1 if it bends towards it, else 0; (m,)."""
    return np.sign(_dot(normal_j - normal_i, at_j - at_i))


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Products of rows, (m,)."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return ax * bx + ay * by + az * bz
