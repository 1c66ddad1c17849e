# SPDX-License-Identifier: Apache-2.0
"""Error of a measured surface against the true one: accuracy, completeness, F-score, Chamfer distance.

Points are sampled evenly over the area of each surface. Their distances are those to the *triangles* of the other
surface. Distances to its samples would be too large, because samples have a spacing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.settings.config import ShortRepr, shown
from rangesim.triangle_mesh import TriangleMesh

SAMPLES = 100_000
"""Default number of points on each surface. The standard error of a mean distance is then 0.3 % of the spread of the
distances, and that of a fraction 0.2 % at most."""


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceError(ShortRepr):
    """Distances between a measured surface and the true one.

    accuracy_m : metres, mean distance from the measured surface to the true one.
    accuracy_rms_m, accuracy_p95_m : metres, root mean square and 95th percentile of the same distances.
    completeness_m : metres, mean distance from the true surface to the measured one.
    chamfer_m : metres, Chamfer distance: the mean of `accuracy_m` and `completeness_m`.
    precision : fraction of the measured area that is within `threshold_m` of the true surface.
    recall : fraction of the true area that is within `threshold_m` of the measured surface.
    f_score : harmonic mean of precision and recall (Knapitsch et al.: "Tanks and Temples", 2017).
    threshold_m : metres.
    measured_points, true_points : (n, 3) float64, metres, world, samples of the two surfaces.
    measured_m, true_m : (n,) float64, metres, distances of the samples to the other surface.
    """

    accuracy_m: float
    accuracy_rms_m: float
    accuracy_p95_m: float
    completeness_m: float
    chamfer_m: float
    precision: float
    recall: float
    f_score: float
    threshold_m: float
    measured_points: np.ndarray
    measured_m: np.ndarray
    true_points: np.ndarray
    true_m: np.ndarray


def surface_error(
    measured: TriangleMesh, truth: TriangleMesh, threshold_m: float, *, samples: int = SAMPLES, seed: int = 0
) -> SurfaceError:
    """Distances between a measured surface and the true one.

    Parameters
    ----------
    measured, truth : meshes, metres, in the same coordinates.
    threshold_m : metres, distance up to which the measured surface counts as correct (precision), and the true surface
        as found (recall).
    samples : number of points on each surface.
    seed : seed of the random points; the same seed gives the same points.

    Raises
    ------
    ValueError
        A mesh without area, or a threshold or a number of samples that is not positive.

    Examples
    --------
    A square that is measured 1 mm too high:

    >>> import numpy as np
    >>> from rangesim.fusion import surface_error
    >>> from rangesim.triangle_mesh import TriangleMesh
    >>> corners, faces = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), [[0, 1, 2], [0, 2, 3]]
    >>> square, higher = TriangleMesh(corners, faces), TriangleMesh(corners + [0, 0, 0.001], faces)
    >>> error = surface_error(higher, square, threshold_m=0.002, samples=1000)
    >>> round(error.accuracy_m, 6), round(error.chamfer_m, 6), error.f_score
    (0.001, 0.001, 1.0)
    """
    if not threshold_m > 0:
        raise ValueError(f"expected a positive threshold_m in metres, got {shown(threshold_m)}.")
    if samples < 1:
        raise ValueError(f"expected one sample or more, got {shown(samples)}.")
    measured_points, true_points = measured.sample(samples, seed)[0], truth.sample(samples, seed)[0]
    forward, back = distances_to(measured_points, truth), distances_to(true_points, measured)
    precision, recall = float((forward <= threshold_m).mean()), float((back <= threshold_m).mean())
    return SurfaceError(
        accuracy_m=float(forward.mean()),
        accuracy_rms_m=float(np.sqrt((forward**2).mean())),
        accuracy_p95_m=float(np.percentile(forward, 95)),
        completeness_m=float(back.mean()),
        chamfer_m=float(forward.mean() + back.mean()) / 2,
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / (precision + recall) if precision + recall else 0.0,
        threshold_m=float(threshold_m),
        measured_points=measured_points,
        measured_m=forward,
        true_points=true_points,
        true_m=back,
    )


def distances_to(points: np.ndarray, mesh: TriangleMesh) -> np.ndarray:
    """Distance of points to the triangles of a mesh: (n,) float64, metres.

    points : (n, 3), metres, in the coordinates of the mesh.
    """
    return np.asarray(np.linalg.norm(nearest_on(points, mesh) - points, axis=-1))


def nearest_on(points: np.ndarray, mesh: TriangleMesh) -> np.ndarray:
    """Nearest points on the triangles of a mesh: (n, 3) float64, metres.

    Open3D finds the nearest triangle in single precision, in coordinates about the mean of the mesh's vertices. The
    point on the triangle is then computed in double precision.

    points : (n, 3), metres, in the coordinates of the mesh.
    """
    scene, middle = raycasting_scene(mesh)
    import open3d as o3d

    found = scene.compute_closest_points(o3d.core.Tensor((points - middle).astype(np.float32)))
    return np.asarray(_on_triangle(points, mesh.corners[found["primitive_ids"].numpy()]))


def raycasting_scene(mesh: TriangleMesh):  # type: ignore[no-untyped-def]
    """Open3D's RaycastingScene of a mesh, and the point (3,), metres, that is the scene's origin.

    The origin is the mean of the vertices, because Open3D computes in single precision.
    """
    import open3d as o3d

    if not len(mesh.faces):
        raise ValueError("expected a mesh with triangles, got none.")
    middle = mesh.vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    vertices = o3d.core.Tensor((mesh.vertices - middle).astype(np.float32))
    scene.add_triangles(vertices, o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    return scene, middle


def _on_triangle(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Point of the triangle corners[i] (n, 3, 3) that is nearest to p[i] (n, 3): (n, 3) float64.

    It is the foot of the perpendicular on the triangle's plane, if that lies inside the triangle. Otherwise it is the
    nearest point of the three edges.
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    best, least = a, np.full(len(p), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        with np.errstate(divide="ignore", invalid="ignore"):
            s = np.clip(np.nan_to_num(((p - start) * along).sum(-1) / (along**2).sum(-1)), 0, 1)
        foot = start + s[:, None] * along
        squared = ((p - foot) ** 2).sum(-1)
        best, least = np.where((squared < least)[:, None], foot, best), np.minimum(squared, least)
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        foot = p - ((p - a) * normal).sum(-1, keepdims=True) / (normal**2).sum(-1, keepdims=True) * normal
    sides = [(np.cross(e - s, foot - s) * normal).sum(-1) >= 0 for s, e in ((a, b), (b, c), (c, a))]
    inside = sides[0] & sides[1] & sides[2] & np.isfinite(foot).all(axis=-1)
    return np.where(inside[:, None], foot, best)
