# SPDX-License-Identifier: Apache-2.0
"""Many views: does bundle adjustment reach the noise, and how fast; what does online cost; are factorisations at their
bound; is a deforming shape found; how good are fused scans, poses found from readings, and the dense counterpart?

Each part returns rows of the table and keys of the last line, which is JSON:

    bundle_s               100 views of 20 000 points, every point in every view, from a perturbed start, seconds
    bundle_ratio_to_noise  standard deviation that the residuals tell over that of the noise
    online_ratio           error of the positions of a moving camera, sliding window over all frames at once
    nonrigid_error         rms error of a shape of 4 basis shapes, 50 points in 10 images, 10 % missing, 0.5 px of
                           noise, over the rms extent of the shape
    fusion_s, fusion_gain, registration_mm    of `fused_scans.py`
    ct_error               of `tomography.py`

Usage: python benchmarks/many_views.py [PART ...] [--views 100] [--points 20000] [--trials 20]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from fused_scans import fusion, registration, weights
from scipy.spatial.transform import Rotation
from tomography import tomography

from rangesim.geometry.registration import nearest_similarity
from rangesim.geometry.reprojection import moved_pose
from rangesim.multiview import (
    NonRigidShape,
    Tracks,
    adjust_nonrigid,
    adjust_online,
    bundle_adjust,
    count_unknowns,
    factorise_nonrigid,
    factorise_orthographic,
    factorise_projective,
)
from rangesim.rig import Intrinsics, look_at

NOISE = 0.5


class Part(NamedTuple):
    """rows : (what, figure) of the table. keys : of the last line."""

    rows: list[tuple[str, str]]
    keys: dict[str, float]


# ------------------------------------------------------------------------------------------- scenes with their truth


class Scene(NamedTuple):
    """camera; T : (n, 4, 4) T_camera_world; X : (p, 3); tracks of them, with noise."""

    camera: Intrinsics
    T: np.ndarray
    X: np.ndarray
    tracks: Tracks


def observed(camera: Intrinsics, T: np.ndarray, X: np.ndarray) -> np.ndarray:
    """(n, p, 2) pixels."""
    return np.stack([camera.project(X @ pose[:3, :3].T + pose[:3, 3]) for pose in T])


def around(views: int, points: int, *, fraction: float = 1.0, noise: float = NOISE, seed: int = 0) -> Scene:
    """Cameras all around a cube of points, each seen in a fraction of the images."""
    random = np.random.default_rng(seed)
    camera = Intrinsics(1280, 960, 1200, 1205, 640, 480, (-0.1, 0.02))
    X = random.uniform(-1, 1, (points, 3))
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    places = np.stack([5 * np.cos(angles), 5 * np.sin(angles), 1.5 + 0.5 * np.sin(3 * angles)], axis=1)
    T = np.stack([np.linalg.inv(look_at(place, (0, 0, 0))) for place in places])
    pixels = observed(camera, T, X)
    seen = random.random((views, points)) < fraction
    seen[:3, seen.sum(axis=0) < 3] = True  # in three images at least
    image, point = np.nonzero(seen)
    x = pixels[image, point] + random.normal(0, noise, (len(image), 2))
    return Scene(camera, T, X, Tracks(image, point, x, views, points))


def walk(frames: int, points: int, life: int, *, noise: float = NOISE, seed: int = 0) -> Scene:
    """A camera that walks along a wall; each point is tracked for `life` frames at most."""
    random = np.random.default_rng(seed)
    camera = Intrinsics(640, 480, 600, 600, 320, 240)
    k = 0.1 * np.arange(frames)
    T = np.stack(
        [np.linalg.inv(look_at((s, 0.1 * np.sin(3 * s), -3), (s + 0.2 * np.sin(2 * s), 0, 1), (0, -1, 0))) for s in k]
    )
    X = random.uniform([-3, -2, 0], [0.1 * frames + 3, 2, 3], (points, 3))
    pixels = observed(camera, T, X)
    seen = (pixels > 0).all(axis=2) & (pixels < [camera.width, camera.height]).all(axis=2)
    for j in range(points):
        when = np.flatnonzero(seen[:, j])
        if len(when) > life:
            start = random.integers(0, len(when) - life + 1)
            seen[:, j] = False
            seen[when[start : start + life], j] = True
    seen[:, seen.sum(axis=0) < 2] = False
    image, point = np.nonzero(seen)
    x = pixels[image, point] + random.normal(0, noise, (len(image), 2))
    return Scene(camera, T, X, Tracks(image, point, x, frames, points))


def perturbed(scene: Scene, turn: float, move: float, shift: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Poses and points off the truth by these standard deviations, radians and metres."""
    random = np.random.default_rng(seed)
    n = len(scene.T)
    steps = np.concatenate([random.normal(0, turn, (n, 3)), random.normal(0, move, (n, 3))], axis=1)
    return moved_pose(scene.T, steps), scene.X + random.normal(0, shift, scene.X.shape)


def aligned(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Points (k, 3) moved by the similarity that brings them nearest to the true ones (Umeyama 1991)."""
    T = nearest_similarity(found, true)
    return np.asarray(found @ T[:3, :3].T + T[:3, 3])


def centres(T: np.ndarray) -> np.ndarray:
    return -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])


def position_error(T: np.ndarray, true: np.ndarray, *, is_scaled: bool = True) -> float:
    """Root mean square distance of cameras from the true ones, metres, after a similarity; not `is_scaled`: after a
    rotation and a translation, so that a wrong scale counts."""
    found, places = centres(T), centres(true)
    if is_scaled:
        return float(np.sqrt(((aligned(found, places) - places) ** 2).sum(axis=1).mean()))
    turn = nearest_similarity(found, places)[:3, :3]
    turn = turn / np.cbrt(np.linalg.det(turn))
    off = (found - found.mean(axis=0)) @ turn.T - (places - places.mean(axis=0))
    return float(np.sqrt((off**2).sum(axis=1).mean()))


class Deforming(NamedTuple):
    """seen : (n, p, 3) the shape in each camera's frame, pixels, its mean at 0. exact : (n, p, 2). tracks of it."""

    seen: np.ndarray
    exact: np.ndarray
    tracks: Tracks


def deforming(
    seed: int,
    *,
    images: int = 10,
    points: int = 50,
    basis: int = 4,
    amplitude: float = 0.25,
    noise: float = NOISE,
    missing: float = 0.1,
    scale: bool = False,
) -> Deforming:
    """A box of 200 px with random deformations, seen without perspective from random directions."""
    random = np.random.default_rng(seed)
    shapes = random.normal(0, 58 * amplitude, (points, basis, 3))
    shapes[:, 0] = random.uniform(-100, 100, (points, 3))
    weights = random.normal(0, 1, (images, basis))
    weights[:, 0] = 1
    R = Rotation.random(images, random_state=random).as_matrix()
    seen = np.einsum("nk,pkd,ned->npe", weights, shapes, R)
    if scale:
        seen *= np.exp(random.normal(0, 0.1, (images, 1, 1)))
    exact = seen[..., :2] + random.normal(320, 20, (images, 1, 2))
    x = exact + random.normal(0, noise, exact.shape)
    gone = random.random((images, points)) < missing
    gone[:3, (~gone).sum(axis=0) < 3] = False  # in three images at least
    x[gone] = np.nan
    return Deforming(seen - seen.mean(axis=1, keepdims=True), exact, Tracks.from_dense(x))


def shape_error(found: NonRigidShape, true: np.ndarray) -> float:
    """Root mean square error over the extent, of points that were found, of the better of the two reversals."""
    errors = []
    for answer in (found, found.reversed):
        known = np.isfinite(answer.basis[:, 0, 0])
        seen = np.einsum("nab,npb->npa", answer.R_camera_world, answer.shapes)[:, known]
        wanted = true[:, known]
        wanted = wanted - wanted.mean(axis=1, keepdims=True)
        errors.append(np.linalg.norm(seen - seen.mean(axis=1, keepdims=True) - wanted) / np.linalg.norm(wanted))
    return float(min(errors))


# ------------------------------------------------------------------------------------------- the parts


def bundle(options: argparse.Namespace) -> Part:
    scene = around(options.views, options.points)
    T, X = perturbed(scene, 0.02, 0.05, 0.1)
    small = around(3, 30)
    bundle_adjust(small.tracks, small.camera, small.T, small.X)  # compiles
    start = time.perf_counter()
    found = bundle_adjust(scene.tracks, scene.camera, T, X)
    seconds = time.perf_counter() - start
    ratio = found.noise_px / NOISE
    sparse = around(options.views, options.points, fraction=0.1)
    start = time.perf_counter()
    thin = bundle_adjust(sparse.tracks, sparse.camera, *perturbed(sparse, 0.02, 0.05, 0.1))
    thin_seconds = time.perf_counter() - start
    rows = [
        (f"bundle adjustment, {scene.tracks}, {found.steps} steps", f"{seconds:.1f} s, noise x {ratio:.4f}"),
        (
            f"bundle adjustment, {sparse.tracks}, {thin.steps} steps",
            f"{thin_seconds:.1f} s, noise x {thin.noise_px / NOISE:.4f}",
        ),
    ]
    return Part(rows, {"bundle_s": round(seconds, 2), "bundle_ratio_to_noise": round(ratio, 4)})


def online(options: argparse.Namespace) -> Part:
    rows, ratios = [], []
    for life in (10, 20, 40):
        errors = []
        for seed in range(2):
            scene = walk(60, 800, life, seed=seed)
            T_start, _ = perturbed(scene, 0.002, 0.002, 0.0)
            found = adjust_online(scene.tracks, scene.camera, T_start[:8], window=10, noise_px=NOISE)
            offline = bundle_adjust(scene.tracks, scene.camera, found.T_camera_world, found.points)
            errors.append(
                [
                    position_error(T, scene.T, is_scaled=is_scaled)
                    for is_scaled in (True, False)
                    for T in (found.T_camera_world, offline.T_camera_world)
                ]
            )
        of_online, of_offline, online_unscaled, offline_unscaled = np.sqrt(np.mean(np.square(errors), axis=0))
        ratios.append(of_online / of_offline)
        rows.append(
            (
                f"positions of 60 frames, tracks of {life}: window of 10 against all at once",
                f"{1e3 * of_online:.2f} mm / {1e3 * of_offline:.2f} mm = {ratios[-1]:.2f}; with the error of the scale "
                f"{1e3 * online_unscaled:.1f} mm / {1e3 * offline_unscaled:.1f} mm",
            )
        )
    return Part(rows, {"online_ratio": round(float(np.max(ratios)), 3)})


def factorisation(options: argparse.Namespace) -> Part:
    """(e / noise)^2 / parameters, e the error of predicted pixels, which no gauge touches: 1 is the Cramer-Rao
    bound."""
    rows = []
    for name, scale in (("orthographic, rank 3", False), ("weak perspective, rank 3", True)):
        for missing in (0.0, 0.2):
            ratios, n, p = [], 8, 40
            for seed in range(options.trials):
                true = deforming(seed, images=n, points=p, basis=1, missing=missing, scale=scale)
                found = factorise_orthographic(true.tracks, has_scale=scale)
                turned = np.einsum("nad,pd->npa", found.R_camera_world[:, :2], found.points)
                off = found.scale[:, None, None] * turned + found.t[:, None] - true.exact
                ratios.append((off[true.tracks.seen()] ** 2).sum() / NOISE**2 / (n * (5 + scale) + 3 * p - 6 - scale))
            rows.append((f"{name}, {missing:.0%} missing: error^2 over the bound", f"{np.mean(ratios):.3f}"))
    for missing in (0.0, 0.2):
        ratios = []
        for seed in range(options.trials):
            scene = around(8, 40, fraction=1 - missing, seed=seed)
            camera = Intrinsics(1280, 960, 1200, 1205, 640, 480)
            exact = observed(camera, scene.T, scene.X)
            noise = np.random.default_rng(seed).normal(0, NOISE, scene.tracks.pixels.shape)
            image, point = scene.tracks.image, scene.tracks.point
            tracks = Tracks(image, point, exact[image, point] + noise, 8, 40)
            off = factorise_projective(tracks).project() - exact
            ratios.append((off[tracks.seen()] ** 2).sum() / NOISE**2 / (11 * 8 + 3 * 40 - 15))
        rows.append((f"projective, rank 4, {missing:.0%} missing: error^2 over the bound", f"{np.mean(ratios):.3f}"))
    return Part(rows, {})


def nonrigid(options: argparse.Namespace) -> Part:
    count = count_unknowns(10, 50, 4)
    rows = [
        (
            "50 points, 10 images, 4 basis shapes: equations, unknowns, of which gauge",
            f"{count.equations}, {count.unknowns}, {count.gauge}",
        )
    ]
    keys = {}
    for method in (factorise_nonrigid, adjust_nonrigid):
        errors, refused = [], 0
        for seed in range(options.trials):
            true = deforming(seed)
            try:
                errors.append(shape_error(method(true.tracks, 4), true.seen))
            except ValueError:
                refused += 1
        rows.append(
            (
                f"{method.__name__}, 10 % missing, {NOISE} px: rms error over extent, median and largest of "
                f"{len(errors)}, refused",
                f"{np.median(errors):.3%}, {np.max(errors):.3%}, {refused}",
            )
        )
        keys["nonrigid_error"] = round(float(np.median(errors)), 5)
    return Part(rows, keys)


PARTS: dict[str, Callable[[argparse.Namespace], Part]] = {
    "bundle": bundle,
    "online": online,
    "factorisation": factorisation,
    "nonrigid": nonrigid,
}
OF_SCANS: dict[str, Callable[[], dict[str, float]]] = {
    "fusion": fusion,
    "weights": weights,
    "registration": registration,
    "tomography": tomography,
}
"""These print what they find themselves."""
KEYS = (
    "fusion_s",
    "fusion_gain",
    "registration_mm",
    "bundle_s",
    "bundle_ratio_to_noise",
    "online_ratio",
    "nonrigid_error",
    "ct_error",
)


def main() -> None:
    names = [*PARTS, *OF_SCANS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(names)}; all if none is named")
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--trials", type=int, default=20)
    options = parser.parse_args()
    unknown = set(options.parts) - set(names)
    if unknown:
        parser.error(f"expected parts of {', '.join(names)}, got {', '.join(sorted(unknown))}")
    chosen, keys = options.parts or names, dict[str, float]()
    print("| what | figure |\n| --- | --- |")
    for name in [n for n in chosen if n in PARTS]:
        part = PARTS[name](options)
        for what, figure in part.rows:
            print(f"| {what} | {figure} |", flush=True)
        keys |= part.keys
    for name in [n for n in chosen if n in OF_SCANS]:
        print(f"\n{name}", flush=True)
        keys |= OF_SCANS[name]()
    print()
    print(json.dumps({key: keys[key] for key in KEYS if key in keys}))


if __name__ == "__main__":
    main()
