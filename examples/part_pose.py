# SPDX-License-Identifier: Apache-2.0
"""Where does a known part stand? By the label on it (PnP), by its scan (ICP), and by its scan alone; against the truth.

Renders a bracket on a table before a camera and a projector, as structured light sees it, with noise. The corners of
the label that is glued to it give a pose from one image. That is the first guess for ICP of the scan against points of
the model's surface. Then the same without the label: the table is taken off and the scan registered without a guess.
The label is 0.2 mm thick and no part of the model: that is most of what ICP leaves.

Usage: python examples/part_pose.py [OUT.png] [--width 640] [--spacing-mm 1.5]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

import rangesim
from rangesim import StructuredLight
from rangesim.calibration import Checkerboard
from rangesim.geometry import find_camera_pose, icp, register

BOXES_M = np.array(
    [
        [[-0.08, -0.055, 0.0], [0.08, 0.055, 0.012]],  # the base
        [[-0.08, 0.043, 0.012], [0.08, 0.055, 0.082]],  # a wall along its back
        [[0.03, -0.04, 0.012], [0.07, -0.01, 0.047]],  # a block, so that it has but one pose
    ]
)
"""Least and largest x, y, z of the bracket's boxes; z up, the middle of the bottom at 0."""
LABEL = Checkerboard(5, 4, 0.01)


def label_pose() -> np.ndarray:
    """T_part_label: on the base, x to the right, z down into it."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (-0.055, 0.003, 0.0122)
    return T


def surface_points(spacing_m: float) -> np.ndarray:
    """(n, 3) points on the bracket's surface, those where boxes touch left out."""
    points = []
    for number, (low, high) in enumerate(BOXES_M):
        for axis in range(3):
            other = [k for k in range(3) if k != axis]
            grid = [np.arange(low[k] + spacing_m / 2, high[k], spacing_m) for k in other]
            for end in (low[axis], high[axis]):
                face = np.empty((len(grid[0]) * len(grid[1]), 3))
                face[:, other] = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 2)
                face[:, axis] = end
                others = np.delete(BOXES_M, number, axis=0)
                touching = ((face >= others[:, None, 0] - 1e-9) & (face <= others[:, None, 1] + 1e-9)).all(axis=-1)
                points.append(face[~touching.any(axis=0)])
    return np.concatenate(points)


def outside(points: np.ndarray) -> np.ndarray:
    """(n,) metres by which points lie outside of the bracket; negative inside."""
    middle, half = BOXES_M.mean(axis=1)[:, None], (BOXES_M[:, 1] - BOXES_M[:, 0])[:, None] / 2
    beyond = np.abs(points - middle) - half
    far = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return np.asarray((far + np.minimum(beyond.max(axis=-1), 0.0)).min(axis=0))


def scene(T_world_part: np.ndarray) -> rangesim.Scene:
    """The bracket with its label on a table."""
    matte = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.45}}
    label = LABEL.scene(T_world_part @ label_pose())["board"]  # also chooses the renderer's variant
    shapes: dict[str, Any] = {"type": "scene", "label": label}
    for number, (low, high) in enumerate(BOXES_M):
        placed = np.eye(4)
        placed[:3, :3], placed[:3, 3] = np.diag((high - low) / 2), (low + high) / 2
        to_world = mi.ScalarTransform4f(T_world_part @ placed)
        shapes[f"box_{number}"] = {"type": "cube", "to_world": to_world, "bsdf": matte}
    table = mi.ScalarTransform4f().scale([0.5, 0.5, 1.0])
    shapes["table"] = {"type": "rectangle", "to_world": table, "bsdf": matte}
    at = mi.ScalarTransform4f().look_at(origin=[0.05, -0.5, 0.5], target=[0, 0, 0.02], up=[0, 0, 1])
    shapes["camera"] = {"type": "perspective", "fov": 35.0, "to_world": at}
    return rangesim.load_scene(shapes)


def without_table(points: np.ndarray) -> np.ndarray:
    """The points above the largest plane."""
    import open3d as o3d

    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    plane, _ = cloud.segment_plane(0.001, 3, 1000)
    height = np.abs(points @ plane[:3] + plane[3])
    return points[height > 0.003]


def errors(T_camera_part: np.ndarray, true: np.ndarray, X: np.ndarray) -> tuple[float, float]:
    """Degrees of turn, and millimetres by which the surface is off (root mean square) at its points X."""
    turn = Rotation.from_matrix(true[:3, :3].T @ T_camera_part[:3, :3]).magnitude()
    off = X @ (T_camera_part - true)[:3, :3].T + (T_camera_part - true)[:3, 3]
    return float(np.degrees(turn)), 1e3 * float(np.sqrt(np.square(off).sum(axis=-1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out/part_pose.png"))
    parser.add_argument("--width", type=int, default=640, help="of the camera's images")
    parser.add_argument("--spacing-mm", type=float, default=1.5, help="between points of the model")
    args = parser.parse_args()

    T_world_part = np.eye(4)
    T_world_part[:3, :3] = Rotation.from_euler("z", 17.0, degrees=True).as_matrix()
    T_world_part[:3, 3] = (0.02, -0.01, 1e-4)
    sensor = StructuredLight(1024, 768, axes=("columns", "rows"))
    world = scene(T_world_part)
    rig = world.rig(baseline_m=0.12, projector_size=(1024, 768), width=args.width, height=args.width * 3 // 4)
    signals = rangesim.transport(world, rig, [sensor], spp=16)
    capture = rangesim.expose(signals, sensor, sensor.default_detector)
    true = np.linalg.inv(rig.T_world_camera) @ T_world_part

    view = LABEL.find(capture.sensor.white_image(capture.frames))
    T = label_pose()
    on_part = LABEL.points[view.indices] @ T[:3, :3].T + T[:3, 3]
    by_label = find_camera_pose(on_part, view.pixels, rig.camera, noise_px=0.3)
    print(f"{len(view.indices)} corners of the label, noise {by_label.noise_px:.2f} px")

    scan = rangesim.decode(capture).to_point_cloud().points.reshape(-1, 3).astype(np.float64)
    scan = scan[np.isfinite(scan).all(axis=1)]
    model = surface_points(args.spacing_mm * 1e-3)
    guess = np.linalg.inv(by_label.T_camera_object)
    in_part = scan @ guess[:3, :3].T + guess[:3, 3]
    near = ((in_part > BOXES_M[:, 0].min(axis=0) - 0.004) & (in_part < BOXES_M[:, 1].max(axis=0) + 0.004)).all(axis=1)
    near &= in_part[:, 2] > 0.003  # the table belongs to no part
    fitted = icp(scan[near], model, guess, max_distance_m=0.004)
    alone = register(without_table(scan), model)
    poses = {
        "label, PnP": by_label.T_camera_object,
        "label, then ICP of the scan": np.linalg.inv(fitted.T_target_source),
        "scan alone": np.linalg.inv(alone.T_target_source),
    }
    print(f"{'':30s}{'turned by':>12s}{'surface off by':>16s}")
    for name, found in poses.items():
        degrees, off_mm = errors(found, true, model)
        print(f"{name:30s}{degrees:10.3f} °{off_mm:13.3f} mm")
    draw(
        args.out,
        capture.sensor.white_image(capture.frames),
        rig.camera,
        poses["label, then ICP of the scan"],
        scan[near],
        true,
    )
    print(args.out)


def draw(
    out: Path, image: np.ndarray, camera: rangesim.Intrinsics, found: np.ndarray, scan: np.ndarray, true: np.ndarray
) -> None:
    """The image with the edges of the part where it was found, and how far the scan lies off it there."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    axes[0].imshow(image, cmap="gray", vmax=np.quantile(image, 0.995))
    for low, high in BOXES_M:
        corners = low + (high - low) * np.indices((2, 2, 2)).reshape(3, 8).T
        pixels = camera.project(corners @ found[:3, :3].T + found[:3, 3]) - 0.5
        for a in range(8):
            for b in (a ^ 1, a ^ 2, a ^ 4):
                if a < b:
                    axes[0].plot(*pixels[[a, b]].T, color="tab:orange", linewidth=1)
    axes[0].set_title("the model's edges where it was found")
    back = np.linalg.inv(found)
    distance = outside(scan @ back[:3, :3].T + back[:3, 3])
    pixels = camera.project(scan) - 0.5
    shown = axes[1].scatter(*pixels.T, c=1e3 * distance, s=0.6, vmin=-0.5, vmax=0.5, cmap="RdBu_r")
    axes[1].set_xlim(axes[0].get_xlim())
    axes[1].set_ylim(axes[0].get_ylim())
    axes[1].set_aspect("equal")
    axes[1].set_title("scan outside of the model, where it was found")
    figure.colorbar(shown, ax=axes[1], label="mm", extend="both")
    for axis in axes:
        axis.set_axis_off()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=100)


if __name__ == "__main__":
    main()
