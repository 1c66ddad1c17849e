# SPDX-License-Identifier: Apache-2.0
"""A fused surface against the true one: accuracy, completeness, F-score, Chamfer distance.

Points are sampled evenly over the area of either surface, and their distances to the other's *triangles* are taken, not
to its samples: a distance between samples would never fall below their spacing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.settings.config import ShortRepr, shown
from rangesim.triangle_mesh import TriangleMesh

SAMPLES = 100_000
"""Points on each surface."""


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceError(ShortRepr):
    """How two surfaces differ; metres, and fractions of area.

    accuracy_m : mean distance of the measured surface to the true one. accuracy_rms_m, accuracy_p95_m : root mean
    square, 95th percentile. completeness_m : mean distance of the true surface to the measured one. chamfer_m : the
    mean of the two means, Chamfer distance.
    precision, recall : fraction of the measured (true) surface within `threshold_m` of the other; recall is
    completeness as a fraction. f_score : their harmonic mean (Knapitsch et al.: "Tanks and Temples", 2017).
    measured_points, true_points : (n, 3) float64, metres, samples. measured_m, true_m : (n,) float64, their distances.
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
    """Distances between a measured and a true surface.

    Parameters
    ----------
    threshold_m : metres, within which surface counts as right (precision) and as found (recall).
    samples : points on each surface.

    Raises
    ------
    ValueError
        A mesh without area, or a threshold or a number of samples that is not positive.
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
    """(n,) float64, metres, distance of points (n, 3), world, to the nearest point of a mesh's triangles."""
    return np.asarray(np.linalg.norm(nearest_on(points, mesh) - points, axis=-1))


def nearest_on(points: np.ndarray, mesh: TriangleMesh) -> np.ndarray:
    """(n, 3) float64, metres, world, the point of a mesh's triangles that is nearest to each point (n, 3).

    Open3D finds the triangle in single precision, about the mesh's own middle.
    """
    scene, middle = raycasting_scene(mesh)
    import open3d as o3d

    found = scene.compute_closest_points(o3d.core.Tensor((points - middle).astype(np.float32)))
    return np.asarray(_on_triangle(points, mesh.corners[found["primitive_ids"].numpy()]))


def raycasting_scene(mesh: TriangleMesh):  # type: ignore[no-untyped-def]
    """Open3D's scene of a mesh's triangles, and the point (3,), metres, world, that is its origin."""
    import open3d as o3d

    if not len(mesh.faces):
        raise ValueError("expected a mesh with triangles, got none.")
    middle = mesh.vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    vertices = o3d.core.Tensor((mesh.vertices - middle).astype(np.float32))
    scene.add_triangles(vertices, o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    return scene, middle


def _on_triangle(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n, 3) the point of triangle corners[i] (n, 3, 3) nearest to p[i] (n, 3), in double precision.

    Inside the triangle its foot on the plane, else the nearest point of the three edges.
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
