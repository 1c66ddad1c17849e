# SPDX-License-Identifier: Apache-2.0
"""Structure from motion between rendered scans: features of their images, matched, and the scans joined by them.

A hand-held scanner goes round painted things on a table: from each pose one transport, the white image and the scan.
SIFT features (OpenCV) are matched between all pairs of images and joined to tracks. `structure_from_motion` finds the
poses from them alone, up to a similarity. Its size comes from the scans: a feature's depth is read where it is seen. So
the scans stand in one frame, without a marker and without a known pose, and are compared with the true surfaces. The
faces of each box are painted alike, as in a warehouse: matches between different faces agree among themselves, but not
with the rest, and are left out.

Usage: python examples/rendered_motion.py [OUT.png] [--views 8] [--width 640]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import matplotlib as mpl
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

import rangesim
from rangesim import StructuredLight, look_at
from rangesim.environment.backend import select_variant
from rangesim.fusion.mesh_error import distances_to
from rangesim.multiview import StructureFromMotion, Tracks, structure_from_motion
from rangesim.scene.triangles import true_surfaces
from rangesim.triangle_mesh import TriangleMesh

RATIO = 0.75
"""Of the distances of the best to the next descriptor, Lowe's test."""
NOISE_PX = 0.4


def paint(seed: int, texels: int) -> dict[str, Any]:
    """A matte surface with blots of all sizes, which SIFT finds whatever the distance."""
    random = np.random.default_rng(seed)
    image = np.zeros((texels, texels), dtype=np.float32)
    for size in (4, 8, 16, 32, 64):
        coarse = random.normal(0, 1, (max(texels // size, 2),) * 2).astype(np.float32)
        image += cv2.resize(coarse, (texels, texels), interpolation=cv2.INTER_CUBIC)
    grey = 0.45 + 0.35 * np.tanh(0.6 * image)
    data = mi.TensorXf(np.ascontiguousarray(grey[:, :, None]))
    texture = {"type": "bitmap", "data": data, "raw": True}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}


def scene() -> rangesim.Scene:
    """Two boxes and a ball on a table, all painted."""
    select_variant()
    place = mi.ScalarTransform4f
    table = place().scale([0.35, 0.35, 1.0])
    box = place().translate([-0.1, 0.05, 0.06]).rotate([0, 0, 1], 25).scale([0.06, 0.05, 0.06])
    low = place().translate([0.1, -0.09, 0.025]).rotate([0, 0, 1], -15).scale([0.07, 0.04, 0.025])
    ball = place().translate([0.1, 0.09, 0.07]).scale(0.07)
    shapes: dict[str, Any] = {
        "type": "scene",
        "table": {"type": "rectangle", "to_world": table, "bsdf": paint(0, 1024)},
        "box": {"type": "cube", "to_world": box, "bsdf": paint(1, 256)},
        "low": {"type": "cube", "to_world": low, "bsdf": paint(2, 256)},
        "ball": {"type": "sphere", "to_world": ball, "bsdf": paint(3, 512)},
        "camera": {
            "type": "perspective",
            "fov": 42.0,
            "to_world": place().look_at(origin=[0.0, -0.55, 0.45], target=[0, 0, 0.03], up=[0, 0, 1]),
        },
    }
    return rangesim.load_scene(shapes)


def hand_held(views: int) -> np.ndarray:
    """(n, 4, 4) T_world_camera along a part of a turn, up and down."""
    angles = np.radians(np.linspace(-140, -140 + 14 * (views - 1), views))
    heights = 0.42 + 0.06 * np.sin(3 * angles)
    places = np.stack([0.6 * np.cos(angles), 0.6 * np.sin(angles), heights], axis=1)
    return np.stack([look_at(place, (0.0, 0.0, 0.03)) for place in places])


class View(NamedTuple):
    """grey : (h, w) uint8. depth : (h, w) metres, NaN without a reading. points : (k, 3) metres, camera."""

    grey: np.ndarray
    depth: np.ndarray
    points: np.ndarray


def scanned(world: rangesim.Scene, rig: rangesim.Rig, sensor: StructuredLight, T: np.ndarray, seed: int) -> View:
    """What the scanner takes at a pose."""
    signals = rangesim.transport(world, replace(rig, T_world_camera=T), [sensor], spp=16, seed=seed)
    capture = rangesim.expose(signals, sensor, sensor.default_detector, seed=seed)
    image = rangesim.decode(capture)
    white = capture.sensor.white_image(capture.frames).astype(np.float64)
    # equal light everywhere in the picture: the lamp is nearer here and farther there
    even = white / cv2.GaussianBlur(white, (0, 0), 0.05 * white.shape[1])
    grey = np.clip(110 * even, 0, 255).astype(np.uint8)
    points = image.to_point_cloud().points.reshape(-1, 3).astype(np.float64)
    return View(grey, np.where(image.valid, image.z, np.nan), points[np.isfinite(points).all(axis=1)])


def tracked(images: list[np.ndarray]) -> Tracks:
    """Features matched between all pairs of images, best for each other and better than the next, joined to tracks."""
    sift, matcher = cv2.SIFT_create(nfeatures=2500, contrastThreshold=0.02), cv2.BFMatcher()
    found = [sift.detectAndCompute(image, None) for image in images]
    first = np.cumsum([0, *(len(keys) for keys, _ in found)])
    links = []
    for i in range(len(images)):
        for j in range(i + 1, len(images)):
            pairs = []
            for one, two in ((i, j), (j, i)):
                near = matcher.knnMatch(found[one][1], found[two][1], k=2)
                pairs.append({(a.queryIdx, a.trainIdx) for a, b in near if a.distance < RATIO * b.distance})
            links += [(first[i] + a, first[j] + b) for a, b in pairs[0] if (b, a) in pairs[1]]
    a, b = np.array(links).T
    label = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(first[-1],) * 2), directed=False)[1]
    image = np.repeat(np.arange(len(images)), np.diff(first))
    # OpenCV's coordinates are those of pixel centres at integers
    pixels = np.array([key.pt for keys, _ in found for key in keys]) + 0.5
    count = np.bincount(label)
    different = np.bincount(np.unique(label * len(images) + image) // len(images), minlength=len(count))
    chosen = ((count >= 3) & (count == different))[label]  # twice in one image: some link is wrong
    return Tracks(image[chosen], np.unique(label[chosen], return_inverse=True)[1], pixels[chosen], len(images))


def metric_scale(found: StructureFromMotion, tracks: Tracks, views: list[View]) -> float:
    """Metres that the reconstruction's unit has: the median of the depths read over those found, where features are."""
    T, X = found.T_camera_world[tracks.image], found.points[tracks.point]
    z = np.einsum("nj,nj->n", T[:, 2, :3], X) + T[:, 2, 3]
    column, row = np.floor(tracks.pixels).astype(int).T
    read = np.array([views[i].depth[r, c] for i, r, c in zip(tracks.image, row, column, strict=True)])
    return float(np.nanmedian((read / z)[found.inliers]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", nargs="?", type=Path, default=Path("out/rendered_motion.png"))
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--width", type=int, default=640, help="of the camera's images")
    args = parser.parse_args()

    world, sensor = scene(), StructuredLight(1024, 768)
    rig = world.rig(baseline_m=0.1, projector_size=(1024, 768), width=args.width, height=args.width * 3 // 4)
    poses = hand_held(args.views)
    views = [scanned(world, rig, sensor, T, seed) for seed, T in enumerate(poses)]
    tracks = tracked([view.grey for view in views])
    print(tracks)

    found = structure_from_motion(tracks, rig.camera, noise_px=NOISE_PX)
    scale = metric_scale(found, tracks, views)
    T = np.linalg.inv(found.T_camera_world)  # T_first_camera
    T[:, :3, 3] *= scale
    true = np.linalg.inv(poses[0]) @ poses
    turn = np.degrees([Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude() for a, b in zip(T, true, strict=True)])
    off = 1e3 * np.linalg.norm(T[:, :3, 3] - true[:, :3, 3], axis=1)
    longest = 1e3 * np.linalg.norm(true[:, :3, 3], axis=1).max()
    print(f"{(~found.inliers).mean():.1%} of the observations left out as wrong; noise {found.noise_px:.2f} px")
    print(f"poses, relative to the first: off by {turn.max():.3f} degrees and {off.max():.2f} mm of {longest:.0f}")

    truth = TriangleMesh.joined(list(true_surfaces(world).values()))
    start = poses[0]

    def error_mm(points: np.ndarray) -> np.ndarray:
        return 1e3 * np.abs(distances_to(points @ start[:3, :3].T + start[:3, 3], truth))

    known = np.isfinite(found.points).all(axis=1)
    features = scale * found.points[known]
    scans = np.concatenate([v.points[::7] @ P[:3, :3].T + P[:3, 3] for v, P in zip(views, T, strict=True)])
    alone = np.concatenate([v.points[::7] @ P[:3, :3].T + P[:3, 3] for v, P in zip(views, true, strict=True)])
    print("distances to the true surface")
    for name, points in (("features", features), ("scans, poses found", scans), ("scans, true poses", alone)):
        print(f"{name:20s}{len(points):8d} points, median error {np.median(error_mm(points)):.2f} mm")
    draw(args.out, views, tracks, found, scans @ start[:3, :3].T + start[:3, 3], error_mm(scans), start @ T, poses)
    print(args.out)


def draw(
    out: Path,
    views: list[View],
    tracks: Tracks,
    found: StructureFromMotion,
    points: np.ndarray,
    error_mm: np.ndarray,
    T: np.ndarray,
    poses: np.ndarray,
) -> None:
    """Two images with what they share; the scans in the poses found, by their error, with the cameras."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (images, above) = plt.subplots(1, 2, figsize=(10, 5), width_ratios=(1, 1.45), layout="constrained")
    one, two = found.first_pair
    height = views[0].grey.shape[0]
    images.imshow(np.concatenate([views[one].grey, views[two].grey]), cmap="gray")
    common = tracks.common(one, two)
    agrees = np.zeros((tracks.n_images, tracks.n_points), dtype=bool)
    agrees[tracks.image[found.inliers], tracks.point[found.inliers]] = True
    right = agrees[one, common.point] & agrees[two, common.point]
    for chosen, colour in ((np.flatnonzero(right)[::6], "#2bd97c"), (np.flatnonzero(~right)[::3], "#ff6a00")):
        for a, b in zip(common.first[chosen] - 0.5, common.second[chosen] - 0.5, strict=True):
            images.plot([a[0], b[0]], [a[1], b[1] + height], "-", color=colour, linewidth=0.6)
    images.set_title("first pair: matches left out in orange", fontsize=10)
    images.set_axis_off()
    order = np.random.default_rng(0).permutation(len(points))[:30_000]
    order = order[np.argsort(points[order, 2])]
    shown = above.scatter(
        *points[order, :2].T, s=2.0, c=error_mm[order], cmap="viridis", vmin=0, vmax=1.0, linewidths=0
    )
    above.plot(*poses[:, :2, 3].T, "o-", color="0.6", markersize=7, linewidth=1, label="true cameras")
    above.plot(*T[:, :2, 3].T, "^", color="#d95f02", markersize=5, label="found")
    above.set_aspect("equal")
    above.set_title("all scans in the poses found, from above", fontsize=10)
    above.set_xlabel("x, metres")
    above.set_ylabel("y, metres")
    above.legend(fontsize=8, loc="upper left")
    figure.colorbar(shown, ax=above, label="mm to the true surface", extend="max", shrink=0.8)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=76)
    plt.close(figure)


if __name__ == "__main__":
    main()
