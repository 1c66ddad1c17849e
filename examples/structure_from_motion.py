# SPDX-License-Identifier: Apache-2.0
"""Structure from motion beside the truth: points of a mesh seen by a camera that goes round, found again from tracks.

Points of a statue-like shape are projected by a simulated lens where nothing hides them; tracks end, have noise, and
some are wrong. `structure_from_motion` finds cameras and points from the tracks alone. Then a shape that deforms, in
ten images without perspective, is found again by `adjust_nonrigid`. Draws both.

Usage: python examples/structure_from_motion.py [OUT.png] [--views 16] [--points 600]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim import Intrinsics, look_at
from rangesim.geometry.registration import nearest_similarity
from rangesim.multiview import Tracks, adjust_nonrigid, structure_from_motion

NOISE_PX, WRONG = 0.5, 0.03


def knot(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) on a knotted tube, metres, and their normals."""
    random = np.random.default_rng(0)
    t, a = random.uniform(0, 2 * np.pi, (2, count))

    def axis(t: np.ndarray) -> np.ndarray:
        return 0.12 * np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1)

    along = axis(t + 1e-4) - axis(t - 1e-4)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    first = np.cross(along, [0.0, 0, 1])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    normals = np.cos(a)[:, None] * first + np.sin(a)[:, None] * np.cross(along, first)
    return axis(t) + 0.07 * normals, normals


def photographed(views: int, count: int) -> tuple[Intrinsics, np.ndarray, np.ndarray, Tracks]:
    """The camera, its true poses, the true points, and tracks of those that face it."""
    random = np.random.default_rng(1)
    camera = Intrinsics(1280, 960, 1400, 1400, 640, 480, (-0.1, 0.02))
    X, normals = knot(count)
    angles = np.linspace(0, 1.6 * np.pi, views)
    places = np.stack([1.6 * np.cos(angles), 1.6 * np.sin(angles), 0.7 + 0.3 * np.sin(2 * angles)], axis=1)
    T = np.stack([np.linalg.inv(look_at(place, (0, 0, 0))) for place in places])
    pixels = np.stack([camera.project(X @ P[:3, :3].T + P[:3, 3]) for P in T])
    facing = np.einsum("npd,pd->np", places[:, None] - X, normals) > 0.2
    pixels += random.normal(0, NOISE_PX, pixels.shape)
    wrong = random.random(facing.shape) < WRONG
    pixels[wrong] += random.uniform(-100, 100, (wrong.sum(), 2))
    pixels[~facing | (facing.sum(axis=0) < 3)] = np.nan
    return camera, T, X, Tracks.from_dense(pixels)


def deforming() -> tuple[np.ndarray, Tracks]:
    """(10, 50, 3) a waving sheet of points in the frames of ten cameras, pixels, and noisy tracks with gaps."""
    random = np.random.default_rng(2)
    flat = np.stack(np.meshgrid(np.linspace(-100, 100, 10), np.linspace(-60, 60, 5)), axis=-1).reshape(-1, 2)
    x, y = (flat / [100, 60]).T
    dome = np.stack([*flat.T, 60 * np.cos(1.3 * x) * np.cos(1.2 * y)], axis=1)
    twist = np.stack([-0.4 * y * x, 0.5 * x**2 - 0.3, x * y], axis=1)
    wave = np.stack([0.4 * np.cos(2 * y), 0.3 * x * y, np.sin(np.pi * x)], axis=1)
    shapes = dome + np.einsum("nk,kpd->npd", random.normal(0, 30, (10, 2)), np.stack([twist, wave]))
    R = Rotation.from_rotvec(random.uniform(-0.8, 0.8, (10, 3))).as_matrix()
    seen = np.einsum("npd,ned->npe", shapes, R)
    dense = seen[..., :2] + 300 + random.normal(0, 0.3, (10, 50, 2))
    dense[random.random((10, 50)) < 0.08] = np.nan
    return seen - seen.mean(axis=1, keepdims=True), Tracks.from_dense(dense)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", nargs="?", help="picture to write")
    parser.add_argument("--views", type=int, default=16)
    parser.add_argument("--points", type=int, default=1200)
    arguments = parser.parse_args()

    camera, T, X, tracks = photographed(arguments.views, arguments.points)
    found = structure_from_motion(tracks, camera, noise_px=NOISE_PX)
    known = np.isfinite(found.points).all(axis=1)
    places = -np.einsum("nji,nj->ni", found.T_camera_world[:, :3, :3], found.T_camera_world[:, :3, 3])
    T_true = nearest_similarity(found.points[known], X[known])
    points, places = (some @ T_true[:3, :3].T + T_true[:3, 3] for some in (found.points[known], places))
    true_places = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    error = 1e3 * np.linalg.norm(points - X[known], axis=1)
    off = 1e3 * np.linalg.norm(places - true_places, axis=1)
    print(f"{tracks}: started from images {found.first_pair}")
    print(f"{(~found.inliers).mean():.1%} of the observations left out as wrong; noise {found.noise_px:.2f} px")
    print(f"{known.sum()} points, median error {np.median(error):.2f} mm; cameras {np.median(off):.2f} mm")

    true, sheet = deforming()
    shape = adjust_nonrigid(sheet, 3)
    seen = [np.einsum("nab,npb->npa", s.R_camera_world, s.shapes) for s in (shape, shape.reversed)]
    seen = [s - s.mean(axis=1, keepdims=True) for s in seen]
    best = min(seen, key=lambda s: float(np.linalg.norm(s - true)))
    print(f"deforming sheet, {sheet}: rms error {np.linalg.norm(best - true) / np.linalg.norm(true):.1%} of its extent")
    if arguments.out:
        draw(Path(arguments.out), points, error, places, true_places, best, true)
        print(arguments.out)


def draw(
    out: Path,
    points: np.ndarray,
    error: np.ndarray,
    places: np.ndarray,
    true_places: np.ndarray,
    best: np.ndarray,
    true: np.ndarray,
) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(10.5, 7.2), layout="constrained")
    grid = figure.add_gridspec(2, 6, height_ratios=(1.9, 1))
    scene = figure.add_subplot(grid[0, :3], projection="3d")
    scene.scatter(*points.T, s=2, c=points[:, 2], cmap="Blues_r", vmax=points[:, 2].max() + 0.15, depthshade=False)
    scene.plot(*true_places.T, "-", color="0.6", linewidth=1, label="true path")
    scene.scatter(*places.T, s=22, marker="^", c="#d95f02", depthshade=False, label="cameras found")
    scene.set_box_aspect(np.ptp(np.concatenate([points, places]), axis=0), zoom=1.5)
    scene.view_init(elev=35, azim=-100)
    scene.set_title("found from tracks alone", fontsize=10)
    scene.legend(fontsize=8, loc="upper left")
    scene.set_axis_off()
    near = figure.add_subplot(grid[0, 3:])
    order = np.argsort(points[:, 2])
    shown = near.scatter(
        *points[order, :2].T, s=9, c=error[order], cmap="viridis", vmin=0, vmax=np.quantile(error, 0.97)
    )
    near.set_aspect("equal")
    near.set_title("points from above, distance to the truth", fontsize=10)
    near.set_xlabel("x, metres")
    near.set_ylabel("y, metres")
    figure.colorbar(shown, ax=near, label="mm", shrink=0.8)
    for k, image in enumerate((0, 4, 8)):
        sheet = figure.add_subplot(grid[1, 2 * k : 2 * k + 2], projection="3d")
        x, y, z = true[image].T.reshape(3, 5, 10)
        sheet.plot_wireframe(x, z, -y, color="0.6", linewidth=1)
        x, y, z = best[image].T
        sheet.scatter(x, z, -y, s=9, c="#d95f02", depthshade=False)
        sheet.set_title(f"deforming sheet, image {image}", fontsize=9)
        sheet.set_axis_off()
        sheet.set_aspect("equal")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=90)
    plt.close(figure)


if __name__ == "__main__":
    main()
