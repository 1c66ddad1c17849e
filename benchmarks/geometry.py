# SPDX-License-Identifier: Apache-2.0
"""Do the estimators of `rangesim.geometry` reach the Cramer-Rao bound, do they refuse what is degenerate, how fast
are they?

Each estimator meets random scenes with Gaussian noise, known to it or not as by default. `ratio` is the mean of e^T
C^-1 e over its degrees of freedom, e the error and C the bound (`tests/test_geometry_*.py` check that the covariance
of an exact fit is the bound): 1 is the best that any unbiased estimate can do. The last line is JSON:

    focal_error, principal_px, baseline_error, reprojection_px   of a camera and a rig calibrated on rendered boards
    projector_focal_error, projector_principal_px, projector_reprojection_px   the same of the projector
    triangulations_per_s   optimal, with the points in space, on one core (processor time, best of five)
    worst_bound_ratio      largest ratio of all estimators

Usage: python benchmarks/geometry.py [--trials 300]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim import StructuredLight
from rangesim.calibration import Checkerboard, calibrate_rig, default_rig, render_set
from rangesim.geometry import (
    fit_camera_pose,
    fit_fundamental,
    fit_homography,
    fit_relative_pose,
    fundamental_from_cameras,
    map_points,
    point_covariance,
    project,
    projection_matrix,
    triangulate_coordinates,
    triangulate_linear,
    triangulate_midpoint,
    triangulate_optimal,
)
from rangesim.rig import Intrinsics, Rig

K = np.array([[800.0, 0, 320], [0, 810, 240], [0, 0, 1]])
H = np.array([[1.1, 0.1, 30], [-0.05, 0.9, 20], [1e-4, 2e-4, 1]])
CAMERA = Intrinsics(640, 480, 800, 805, 321, 242, (-0.2, 0.05, 1e-3, -1e-3))
NOISE = 0.3


def rigid(turn: tuple[float, float, float], move: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), move
    return T


T = rigid((0.05, -0.2, 0.03), (0.3, 0.05, 0.1))
FIRST, SECOND, FORWARD = (
    projection_matrix(K),
    projection_matrix(K, T),
    projection_matrix(K, rigid((0, 0, 0), (0.02, 0.01, -0.5))),
)
OBJECT = rigid((0.3, -0.4, 0.2), (0.1, 0.05, 2.5))


def scene(random: np.random.Generator, n: int, plane: bool = False) -> np.ndarray:
    X = random.uniform([-1, -1, 3], [1, 1, 6], (n, 3))
    if plane:
        X[:, 2] = 4 + 0.3 * X[:, 0] - 0.2 * X[:, 1]
    return X


def noisy(random: np.random.Generator, *pixels: np.ndarray) -> list[np.ndarray]:
    return [x + random.normal(0, NOISE, x.shape) for x in pixels]


def whitened(error: np.ndarray, covariance: np.ndarray, rank: int) -> float:
    """e^T C^+ e / rank."""
    values, axes = np.linalg.eigh(covariance)
    return float((((error @ axes)[-rank:]) ** 2 / values[-rank:]).sum() / rank)


def unit(matrix: np.ndarray, like: np.ndarray) -> np.ndarray:
    matrix = matrix / np.linalg.norm(matrix)
    return np.asarray((matrix * np.sign((matrix * like).sum())).ravel())


def turn_and_move(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.concatenate(
        [Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).as_rotvec(), found[:3, 3] - true[:3, 3]]
    )


def homography(random: np.random.Generator, noisy_in: str) -> Callable[[], float]:
    a = random.uniform(0, 640, (20, 2))
    b = map_points(H, a)
    bound = fit_homography(a, b, noisy=noisy_in, noise_px=NOISE).covariance  # type: ignore[arg-type]

    def trial() -> float:
        x, y = noisy(random, a, b)
        found = fit_homography(x if noisy_in == "both" else a, y, noisy=noisy_in)  # type: ignore[arg-type]
        return whitened(unit(found.matrix, H) - unit(H, H), bound, 8)

    return trial


def fundamental(random: np.random.Generator) -> Callable[[], float]:
    X, F = scene(random, 25), fundamental_from_cameras(FIRST, SECOND)
    a, b = project(FIRST, X), project(SECOND, X)
    bound = fit_fundamental(a, b, noise_px=NOISE).covariance
    return lambda: whitened(unit(fit_fundamental(*noisy(random, a, b)).matrix, F) - unit(F, F), bound, 7)


def relative_pose(random: np.random.Generator) -> Callable[[], float]:
    X = scene(random, 20)
    a, b = project(FIRST, X), project(SECOND, X)
    bound = fit_relative_pose(a, b, K, K, noise_px=NOISE).covariance[:3, :3]

    def trial() -> float:
        found = fit_relative_pose(*noisy(random, a, b), K, K, noise_px=NOISE)  # type: ignore[call-arg, misc]
        return whitened(turn_and_move(found.T_second_first, T)[:3], bound, 3)

    return trial


def camera_pose(random: np.random.Generator, plane: bool) -> Callable[[], float]:
    X = random.uniform(-0.5, 0.5, (20, 3)) * ([1, 1, 0] if plane else [1, 1, 1])
    x = CAMERA.project(X @ OBJECT[:3, :3].T + OBJECT[:3, 3])
    bound = fit_camera_pose(X, x, CAMERA, noise_px=NOISE).covariance

    def trial() -> float:
        found = fit_camera_pose(X, noisy(random, x)[0], CAMERA)
        return whitened(turn_and_move(found.T_camera_object, OBJECT), bound, 6)

    return trial


def triangulation(random: np.random.Generator, second: np.ndarray) -> Callable[[], float]:
    X = scene(random, 1)
    bound = point_covariance(FIRST, second, X, NOISE, NOISE)[0]

    def trial() -> float:
        a, b = noisy(random, *(np.repeat(project(P, X), 100, axis=0) for P in (FIRST, second)))
        errors = triangulate_optimal(FIRST, second, a, b).points - X
        return float(np.mean([whitened(e, bound, 3) for e in errors]))

    return trial


def bounds(trials: int) -> float:
    """Print the table of estimators; the largest ratio."""
    random = np.random.default_rng(0)
    rows: dict[str, tuple[Callable[[], float], int]] = {
        "homography, noise in the second image": (homography(random, "second"), trials),
        "homography, noise in both": (homography(random, "both"), trials),
        "fundamental matrix": (fundamental(random), trials),
        "relative pose (rotation)": (relative_pose(random), trials // 2),
        "camera pose": (camera_pose(random, plane=False), trials // 2),
        "camera pose, plane": (camera_pose(random, plane=True), trials // 2),
        "triangulation, beside": (triangulation(random, SECOND), trials),
        "triangulation, forward": (triangulation(random, FORWARD), trials),
    }
    print("| estimator | ratio to the bound | ms |\n| --- | --- | --- |")
    worst = 0.0
    for name, (trial, times) in rows.items():
        start = time.perf_counter()
        ratio = float(np.mean([trial() for _ in range(times)]))
        each = 1e3 * (time.perf_counter() - start) / times
        print(f"| {name} | {ratio:.2f} | {'-' if name.startswith('tri') else f'{each:.1f}'} |")
        worst = max(worst, ratio)
    return worst


def methods() -> None:
    """Print what optimal triangulation gains over the others."""
    random, n = np.random.default_rng(1), 100_000
    print("\n| second camera, noise | linear px | midpoint px | optimal px | linear mm | midpoint mm | optimal mm |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, second in (("beside", SECOND), ("forward", FORWARD)):
        for noise in (0.3, 3.0):
            X = scene(random, n)
            a, b = (project(P, X) + random.normal(0, noise, (n, 2)) for P in (FIRST, second))
            found = [f(FIRST, second, a, b) for f in (triangulate_linear, triangulate_midpoint, triangulate_optimal)]
            known = np.all([np.isfinite(f.error_px) & np.isfinite(f.points).all(-1) for f in found], axis=0)
            assert (found[2].error_px[known] <= found[0].error_px[known] + 1e-6).all()
            errors = [f"{np.sqrt(np.mean(f.error_px[known] ** 2)):.4f}" for f in found]
            errors += [f"{1e3 * np.median(np.linalg.norm(f.points - X, axis=-1)[known]):.3f}" for f in found]
            print(f"| {name}, {noise:g} px | {' | '.join(errors)} |")


def projector() -> None:
    """Print what a second coded axis, and the nearest place on the epipolar line, gain for structured light."""
    random, n, z = np.random.default_rng(2), 200_000, 0.9
    print("\n| baseline against columns | columns alone | both, linear | both, optimal | bound |")
    print("| --- | --- | --- | --- | --- |")
    for tilt in (0, 30, 60, 85):
        t = np.radians(tilt)
        rig = Rig(
            Intrinsics(640, 480, 700, 700, 320, 240),
            Intrinsics(1024, 768, 1000, 1010, 512, 400),
            T_camera_projector=rigid((0.0, -0.15, 0.0), (0.2 * np.cos(t), 0.2 * np.sin(t), 0.03)),
        )
        ray = rig.camera.directions(np.array([250.0, 300.0]))
        P = np.linalg.inv(rig.T_camera_projector)
        at = [rig.projector.project(P[:3, :3] @ (ray * (z + h)) + P[:3, 3]) for h in (-1e-6, 0.0, 1e-6)]
        bound = NOISE / float(np.linalg.norm((at[2] - at[0]) / 2e-6))
        uv = at[1] + random.normal(0, NOISE, (n, 2))
        rays = np.repeat(ray[None], n, axis=0)
        a, b = rays @ rig.T_camera_projector[:3, :3], -rig.T_camera_projector[:3, 3] @ rig.T_camera_projector[:3, :3]
        xy, focal = rig.projector.normalise(uv), np.array([rig.projector.fx, rig.projector.fy])
        slope = focal * (b[:2] - xy * b[2])
        linear = (slope**2).sum(-1) / (slope * focal * (xy * a[:, 2:] - a[:, :2])).sum(-1)
        found = [
            triangulate_coordinates(rays, rig, uv[:, 0], None).z,
            linear,
            triangulate_coordinates(rays, rig, uv[:, 0], uv[:, 1]).z,
        ]
        cells = [f"{1e3 * np.sqrt(np.mean((f - z) ** 2)):.4f} mm" for f in found]
        print(f"| {tilt}° | {' | '.join(cells)} | {1e3 * bound:.4f} mm |")


def degenerate(trials: int) -> None:
    """Print how many pairs of views are refused."""
    random = np.random.default_rng(3)
    still = rigid((0.05, -0.2, 0.03), (0, 0, 0))
    print("\n| views, noise 0.3 px, unknown to the estimator | pairs | F refused | relative pose refused |")
    print("| --- | --- | --- | --- |")
    for name, plane, move in (
        ("plane", True, T),
        ("rotation alone", False, still),
        ("one view twice", False, np.eye(4)),
        ("sound", False, T),
    ):
        for n in (12, 60):
            refused = [0, 0]
            for _ in range(trials):
                X = scene(random, n, plane)
                a, b = noisy(random, project(FIRST, X), project(projection_matrix(K, move), X))
                for k, fit in enumerate((fit_fundamental, lambda x, y: fit_relative_pose(x, y, K, K))):
                    try:
                        fit(a, b)
                    except ValueError:
                        refused[k] += 1
            print(f"| {name} | {n} | {' | '.join(f'{r} of {trials}' for r in refused)} |")


def speed() -> float:
    """Optimal triangulations per second of one core."""
    random, n = np.random.default_rng(4), 1_000_000
    X = scene(random, n)
    a, b = noisy(random, project(FIRST, X), project(SECOND, X))
    triangulate_optimal(FIRST, SECOND, a[:10], b[:10])
    times = []
    for _ in range(5):
        start = time.process_time()  # of all threads: what one core would take
        triangulate_optimal(FIRST, SECOND, a, b)
        times.append(time.process_time() - start)
    return n / min(times)


def calibration() -> dict[str, float]:
    """Errors of a rendered rig of 12 poses, at 640 x 480 with the detector's noise."""
    true, board = default_rig(), Checkerboard(9, 6, 0.025)
    sensor = StructuredLight(projector_width=800, projector_height=600, axes=("columns", "rows"))
    captures = [replace(capture, rig=None) for capture in render_set(board, true, sensor).captures]
    found = calibrate_rig(board, captures, coefficients=4)
    baseline = float(np.linalg.norm(true.T_camera_projector[:3, 3]))
    focal, principal = {}, {}
    for name in ("camera", "projector"):
        device, truth = getattr(found.rig, name), getattr(true, name)
        focal[name] = max(abs(device.fx / truth.fx - 1), abs(device.fy / truth.fy - 1))
        principal[name] = max(abs(device.cx - truth.cx), abs(device.cy - truth.cy))
    result = {
        "focal_error": focal["camera"],
        "principal_px": principal["camera"],
        "baseline_error": abs(found.baseline_m / baseline - 1),
        "reprojection_px": found.camera_rms_px,
        "projector_focal_error": focal["projector"],
        "projector_principal_px": principal["projector"],
        "projector_reprojection_px": found.projector_rms_px,
    }
    print("\ncalibration of a rendered rig: " + ", ".join(f"{name} {value:.2g}" for name, value in result.items()))
    return {name: round(value, 6) for name, value in result.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=300)
    trials = parser.parse_args().trials
    worst = bounds(trials)
    methods()
    projector()
    degenerate(max(10, trials // 10))
    calibrated = calibration()
    rate = speed()
    print(f"\noptimal triangulation: {rate / 1e6:.1f} million points a second on one core\n")
    print(json.dumps(calibrated | {"triangulations_per_s": round(rate), "worst_bound_ratio": round(worst, 3)}))


if __name__ == "__main__":
    main()
