# SPDX-License-Identifier: Apache-2.0
"""Smooth normals of meshes whose file has none, the same in every load.

Mitsuba gives a vertex the mean normal of its faces, weighted by their angles there (G. Thuermer and C. A. Wuethrich,
Computing vertex normals from polygonal facets, Journal of Graphics Tools 3, 1998). Its threads add into the sums in
whatever order they come, so that the last digits differ from load to load, and with them every path through the
surface. Here the faces are added in their order.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

EPSILON = float(np.finfo(np.float32).eps)
UNKNOWN = (1.0, 0.0, 0.0)
"""What Mitsuba too takes at a vertex whose faces have no normal, or cancel."""


def repeat_normals(scene: Any) -> Any:
    """The mitsuba.Scene itself, whose meshes have vertex normals that every load repeats where Mitsuba has made them.

    Normals of a file stay. Mitsuba's are told from them by their values: all of a mesh agree with the sums here, up to
    the rounding of additions. A mesh whose faces cancel at every vertex (a sheet wound both ways) stays as it is too,
    since nothing tells where its normals came from.
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
        if not decisive.any() or not agrees[decisive].all():  # those of the file
            continue
        normals = np.tile(UNKNOWN, (len(sums), 1))
        normals[clear] = sums[clear] / lengths[clear, None]
        parameters["vertex_normals"] = mi.Float(np.float32(normals).ravel())
        parameters.update()
    return scene


def _sums_at_vertices(vertices: Any, indices: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sum of the normals of the faces at each vertex times their angles there, and how far Mitsuba's may be from it.

    Returns
    -------
    sums : (n, 3) float64. The summands come from the operations of Mitsuba's `Mesh::recompute_vertex_normals`, in
        single precision, so that they equal its own in slivers too.
    errors : (n,) float64, bound of the error of Mitsuba's sum, which is added in single precision.
    is_exact : (n,) bool, False where a face has no area and so no normal: it is left out here, but may spoil
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
