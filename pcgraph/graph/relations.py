# SPDX-License-Identifier: Apache-2.0
"""Features of edges: how two supervoxels that touch lie to each other."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pcgraph.features.nodes import NodeFeatures
from pcgraph.graph.adjacency import EdgeFeatures
from pcgraph.graph.contacts import Contacts


def edge_features(nodes: NodeFeatures, contacts: Contacts) -> EdgeFeatures:
    """Features of every contact.

    Parameters
    ----------
    nodes : NodeFeatures of k supervoxels
    contacts : Contacts, m of them, between these
    """
    i, j = contacts.edges.T
    convexity, contact_convexity, normal_angle, step = _relations(
        contacts.edges, nodes.centroid, nodes.normal, contacts.positions, contacts.normals
    )
    return EdgeFeatures(
        convexity=convexity,
        contact_convexity=contact_convexity,
        normal_angle=normal_angle,
        color_contrast=np.nan_to_num(np.linalg.norm(nodes.color[j] - nodes.color[i], axis=1)),
        contact_voxels=contacts.voxels.sum(axis=1),
        contact_length=contacts.lengths,
        step=step,
    )


@njit(cache=True, nogil=True)
def signed_convexity(
    normal_i: NDArray[np.float64], normal_j: NDArray[np.float64], offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Angle between normals, radians, (m,): positive if convex, negative if concave.

    Parameters
    ----------
    normal_i, normal_j : (m, 3) float64
        Unit normals that point out of the surface.
    offset : (m, 3) float64, metres
        From the place of i to the place of j.
    """
    signs = np.empty(len(offset))
    origin = np.zeros(3)
    for row in range(len(offset)):
        signs[row] = _bend(normal_i[row], normal_j[row], origin, offset[row])
    return angle_between(normal_i, normal_j) * signs


@njit(cache=True, nogil=True)
def angle_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle, radians, 0..pi, (m,), between rows; by the tangent, which stays exact for small angles."""
    angles = np.empty(len(a))
    for row in range(len(a)):
        angles[row] = _angle(a[row], b[row])
    return angles


@njit(cache=True, nogil=True)
def _relations(edges, centroids, normals, rims, rim_normals):  # type: ignore[no-untyped-def]
    """Convexity of nodes and of rims, angle between nodes' normals, and step, (m,) each."""
    m = len(edges)
    convexity, contact_convexity, angle, step = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    for e in range(m):
        i, j = edges[e]
        angle[e] = _angle(normals[i], normals[j])
        convexity[e] = angle[e] * _bend(normals[i], normals[j], centroids[i], centroids[j])
        contact_convexity[e] = _angle(rim_normals[e, 0], rim_normals[e, 1])
        contact_convexity[e] *= _bend(rim_normals[e, 0], rim_normals[e, 1], rims[e, 0], rims[e, 1])
        step[e] = min(_height(rims[e, 1], centroids[i], normals[i]), _height(rims[e, 0], centroids[j], normals[j]))
    return convexity, contact_convexity, angle, step


@njit(cache=True, nogil=True)
def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return np.arctan2(np.sqrt(x * x + y * y + z * z), a[0] * b[0] + a[1] * b[1] + a[2] * b[2])  # type: ignore[no-any-return]


@njit(cache=True, nogil=True)
def _bend(
    normal_i: NDArray[np.float64], normal_j: NDArray[np.float64], at_i: NDArray[np.float64], at_j: NDArray[np.float64]
) -> float:
    """1 where the surface bends away from its outside on the way from i to j, -1 where towards it, 0 where neither."""
    opening = 0.0
    for axis in range(3):
        opening += (normal_j[axis] - normal_i[axis]) * (at_j[axis] - at_i[axis])
    return np.sign(opening)  # type: ignore[no-any-return]


@njit(cache=True, nogil=True)
def _height(point: NDArray[np.float64], origin: NDArray[np.float64], normal: NDArray[np.float64]) -> float:
    """Distance of a point to a plane."""
    height = 0.0
    for axis in range(3):
        height += (point[axis] - origin[axis]) * normal[axis]
    return abs(height)
