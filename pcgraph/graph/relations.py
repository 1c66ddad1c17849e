# SPDX-License-Identifier: Apache-2.0
"""Features of edges: how two supervoxels that touch lie to each other."""

from __future__ import annotations

import numpy as np
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
    rim_i, rim_j = contacts.positions[:, 0], contacts.positions[:, 1]
    to_plane_i = _distance_to_plane(rim_j, nodes.centroid[i], nodes.normal[i])
    to_plane_j = _distance_to_plane(rim_i, nodes.centroid[j], nodes.normal[j])
    return EdgeFeatures(
        convexity=signed_convexity(nodes.normal[i], nodes.normal[j], nodes.centroid[j] - nodes.centroid[i]),
        contact_convexity=signed_convexity(contacts.normals[:, 0], contacts.normals[:, 1], rim_j - rim_i),
        normal_angle=angle_between(nodes.normal[i], nodes.normal[j]),
        color_contrast=np.nan_to_num(np.linalg.norm(nodes.color[j] - nodes.color[i], axis=1)),
        contact_voxels=contacts.voxels.sum(axis=1),
        contact_length=contacts.lengths,
        step=np.minimum(to_plane_i, to_plane_j),
    )


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
    opening = np.einsum("ij,ij->i", normal_j - normal_i, offset)
    return angle_between(normal_i, normal_j) * np.sign(opening)


def angle_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle, radians, 0..pi, (m,), between rows; by the tangent, which stays exact for small angles."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ij,ij->i", a, b))


def _distance_to_plane(
    points: NDArray[np.float64], origins: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.abs(np.einsum("ij,ij->i", points - origins, normals))
