# SPDX-License-Identifier: Apache-2.0
"""Vertex normals of meshes whose file has none, computed so that every load gives the same.

Mitsuba gives a vertex the mean normal of its faces, weighted by their angles at the vertex (G. Thuermer and
C. A. Wuethrich, Computing vertex normals from polygonal facets, Journal of Graphics Tools 3, 1998). Its threads add to
the sums in a random order, so the last digits differ from load to load, and with them every light path. Here the faces
are added in their order.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

EPSILON = float(np.finfo(np.float32).eps)
"""Relative spacing of numbers in single precision, 1.2e-7."""
UNKNOWN = (1.0, 0.0, 0.0)
"""Unit normal of a vertex whose faces have no area or cancel each other; it is the one that
Mitsuba uses, so that such a vertex is shaded as in Mitsuba."""


def repeat_normals(scene: Any) -> Any:
    """Replace the vertex normals that Mitsuba has computed for the meshes of a mitsuba.Scene, and return the scene.

    Normals from a file stay. They are told apart by their values: the normals of a mesh count as Mitsuba's if all of
    them agree with the sums computed here, up to rounding. A mesh whose faces cancel at every vertex (a sheet with
    faces on both sides) keeps its normals, because nothing shows where they came from.
    """
    for shape in scene.shapes():
        parameters = mi.traverse(shape) if shape.is_mesh() else {}
        if "vertex_normals" not in parameters or not dr.width(parameters["vertex_normals"]):
            continue
        sums, errors, is_exact = _sums_at_vertices(parameters["vertex_positions"], parameters["faces"])
        lengths = np.linalg.norm(sums, axis=1)
        clear = lengths > errors
        loaded = np.array(parameters["vertex_normals"], dtype=np.float64).reshape(-1, 3)
        agrees = np.linalg.norm(sums - lengths[:, None] * loaded, axis=1) <= errors
        decisive = clear & is_exact
        if not decisive.any() or not agrees[decisive].all():  # they come from the file
            continue
        normals = np.tile(UNKNOWN, (len(sums), 1))
        normals[clear] = sums[clear] / lengths[clear, None]
        parameters["vertex_normals"] = mi.Float(np.float32(normals).ravel())
        parameters.update()
    return scene


def _sums_at_vertices(vertices: Any, indices: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums of the face normals at each vertex, weighted by the angles of the faces there.

    Returns
    -------
    sums : (n, 3) float64. The summands are computed in single precision with the operations of Mitsuba's
        `Mesh::recompute_vertex_normals`, so that they are equal to those of Mitsuba even for very thin triangles.
    errors : (n,) float64, upper bound of the rounding error of Mitsuba's sum, which it adds in single precision.
    is_exact : (n,) bool, False where a face has no area and hence no normal. The face is left out here, but may spoil
        Mitsuba's sum.
    """
    faces = [dr.gather(mi.UInt32, indices, 3 * dr.arange(mi.UInt32, dr.width(indices) // 3) + i) for i in range(3)]
    corners = [dr.gather(mi.Point3f, vertices, face) for face in faces]
    normal = dr.normalize(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))
    summands = []
    for i in range(3):
        to_next, to_last = corners[(i + 1) % 3] - corners[i], corners[(i + 2) % 3] - corners[i]
        summands.append(normal * dr.safe_acos(dr.dot(dr.normalize(to_next), dr.normalize(to_last))))
    dr.eval(faces, summands)
    at = np.concatenate([np.array(face) for face in faces])
    values = np.concatenate([np.array(summand) for summand in summands], axis=1, dtype=np.float64)
    is_number = np.all(np.isfinite(values), axis=0)
    values[:, ~is_number] = 0.0

    def added(weights: np.ndarray | None) -> np.ndarray:
        return np.bincount(at, weights, minlength=dr.width(vertices) // 3)

    sums = np.stack([added(axis) for axis in values], axis=1)
    errors = (added(None) + 20) * EPSILON * added(np.linalg.norm(values, axis=0))
    return sums, errors, added(~is_number) == 0
