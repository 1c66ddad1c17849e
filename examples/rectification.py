# SPDX-License-Identifier: Apache-2.0
"""What rectification is for: two cameras that look at a painted scene, turned towards each other, matched along rows.

Renders the pair through distorted lenses with the noise of a camera, matches it as it is and rectified, and compares
both with the true depth. Draws the pair, its rows and the depth.

Usage: python examples/rectification.py [OUT.png] [--width 320]
"""

from __future__ import annotations

import argparse
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from rangesim import StructuredLight, expose, load_scene, look_at, transport
from rangesim.geometry import match_rows, rectify
from rangesim.signals import StillSignals

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "matte.xml"
BASELINE_M, NEAR_M, FAR_M = 0.12, 0.6, 2.2
WITHIN_PX = 1.0
"""A match is right if it leads to the true place in the other image within a pixel."""


def painted(folder: Path) -> Path:
    """The scene with every surface painted in blotches of all sizes, as a file in `folder`."""
    random = np.random.default_rng(0)
    paint = np.zeros((512, 512))
    for size in (256, 128, 64, 32, 16, 8):
        grain = Image.fromarray(random.random((512 // size * 8,) * 2).astype(np.float32))
        paint += np.asarray(grain.resize((512, 512), Image.Resampling.BICUBIC))
    paint = (paint - paint.min()) / np.ptp(paint)
    Image.fromarray(np.uint8(20 + 215 * paint)).save(folder / "paint.png")
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="paint.png"/></texture>'
    text = re.sub(r'<spectrum name="reflectance" value="[\d.]+"/>', texture, SCENE.read_text())
    (folder / "painted.xml").write_text(text)
    return folder / "painted.xml"


def photographs(width: int) -> tuple[list[StillSignals], list[np.ndarray]]:
    """What both cameras see, with the truth, and their images (h, w) in digital numbers."""
    sensor = StructuredLight(640, 400, code="gray")
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(painted(Path(folder)))
        left = scene.rig(projector_size=(640, 400), width=width, height=width * 3 // 4)
        left = replace(left, camera=replace(left.camera, distortion=(-0.15, 0.03)))
        # the second camera beside the first, a little lower and forward, turned inwards and tilted
        move = look_at((BASELINE_M, 0.01, 0.02), (0.03, 0.02, scene.working_distance_m), up=(0.03, -1, 0))
        right = left.with_camera(move, replace(left.camera, distortion=(-0.1, 0.02)))
        signals = transport(scene, [left, right], [sensor], spp=32)
    return signals, [expose(s, sensor, sensor.default_detector).frames[-2].astype(float) for s in signals]


def true_matches(signals: list[StillSignals]) -> np.ndarray:
    """(h, w, 2) where the second camera has what each pixel of the first one sees; NaN where it cannot see it."""
    left, right = (s.rig for s in signals)
    T = np.linalg.inv(right.T_world_camera) @ left.T_world_camera
    X = left.camera.directions(left.camera.pixel_centres()) * signals[0].truth.z[..., None]
    X = X @ T[:3, :3].T + T[:3, 3]
    there = right.camera.project(X)
    row, column = (np.nan_to_num(there[..., k], nan=-1).astype(int) for k in (1, 0))
    inside = (there >= 0).all(axis=-1) & (column < right.camera.width) & (row < right.camera.height)
    seen = np.zeros(inside.shape, dtype=bool)
    z = signals[1].truth.z[row[inside], column[inside]]
    seen[inside] = np.abs(z - X[inside][:, 2]) < 0.02  # what is nearer hides it
    there[~seen] = np.nan
    return there


def judge(name: str, matched: np.ndarray, there: np.ndarray, true: np.ndarray) -> None:
    """Print how many of the pixels that both cameras see are matched, and rightly. there : (n, 2) matches of
    `matched`."""
    known = np.isfinite(true).all(axis=-1)
    off = np.linalg.norm(there - true[matched], axis=-1)
    right = np.isfinite(off) & (off < WITHIN_PX)
    print(
        f"{name}: {right.sum() / known.sum():.1%} of the pixels that both cameras see are matched to {WITHIN_PX:g} px"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", nargs="?", help="picture to write")
    parser.add_argument("--width", type=int, default=320, help="pixels of each camera")
    arguments = parser.parse_args()

    signals, images = photographs(arguments.width)
    left, right = (s.rig for s in signals)
    pair = rectify(left.camera, right.camera, np.linalg.inv(right.T_world_camera) @ left.T_world_camera)
    least, largest = pair.parallel.disparity([FAR_M, NEAR_M])
    true = true_matches(signals)

    # as the images are: rows of one number, though they do not correspond
    shift = np.nanmedian(left.camera.pixel_centres()[..., 0] - true[..., 0])
    middle = pair.parallel.disparity(0.5 * (NEAR_M + FAR_M))
    raw = match_rows(*images, (least - middle + shift, largest - middle + shift))
    matched = np.isfinite(raw)
    there = left.camera.pixel_centres()[matched] - np.stack([raw[matched], np.zeros(matched.sum())], axis=-1)
    judge("without rectification", matched, there, true)

    # rectified: the disparity of each left pixel, read where it lies in the rectified image
    warped = pair.warp(*images)
    disparity = match_rows(*warped, (least, largest))
    place = pair.pixels_of_first(left.camera.pixel_centres())
    column, row = (place[..., k].astype(int) for k in (0, 1))
    d = disparity[row, column]
    z = (pair.camera.directions(place) * pair.parallel.depth(d)[..., None] @ pair.R_rectified_first)[..., 2]
    matched = np.isfinite(d)
    rays = pair.camera.directions(place[matched] - np.stack([d[matched], np.zeros(matched.sum())], axis=-1))
    judge("rectified", matched, right.camera.project(rays @ pair.R_rectified_second), true)

    off = 1e3 * np.abs(z[matched] - signals[0].truth.z[matched])
    print(f"depth at 1 m, with 0.1 px of disparity: {1e3 * pair.parallel.depth_error(1.0, 0.1):.1f} mm by the formula")
    print(f"depth: median error {np.nanmedian(off):.1f} mm, 90 % within {np.nanquantile(off, 0.9):.0f} mm")
    if arguments.out:
        draw(Path(arguments.out), images, warped, z, signals[0].truth.z)
        print(arguments.out)


def draw(
    out: Path, images: list[np.ndarray], warped: tuple[np.ndarray, np.ndarray], z: np.ndarray, truth: np.ndarray
) -> None:
    """The pair with rows across it, before and after, and the depth beside the true one."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(3, 2, figsize=(9, 9.6), layout="constrained")
    titles = ("left, as taken", "right, as taken"), ("left, rectified", "right, rectified")
    for row, (both, names) in enumerate(zip((images, warped), titles, strict=True)):
        top = np.nanquantile(np.concatenate([image.ravel() for image in both]), 0.99)
        for axis, image, name in zip(axes[row], both, names, strict=True):
            shade = np.sqrt(np.clip(np.where(np.isfinite(image), image, top) / top, 0, 1))
            axis.imshow(shade, cmap="gray", vmin=0, vmax=1)
            for y in np.linspace(0.12, 0.88, 7) * len(image):
                axis.axhline(y, color="#d95f02", linewidth=0.8)
            axis.set_title(name, fontsize=10)
    low, high = np.nanquantile(truth, [0.01, 0.99])
    for axis, depth, name in zip(axes[2], (z, truth), ("depth by rectified rows", "true depth"), strict=True):
        shown = axis.imshow(depth, cmap="viridis", vmin=low, vmax=high)
        axis.set_title(name, fontsize=10)
    figure.colorbar(shown, ax=axes[2], label="z in metres", shrink=0.9)
    for axis in axes.ravel():
        axis.set_xticks([])
        axis.set_yticks([])
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=90)
    plt.close(figure)


if __name__ == "__main__":
    main()
