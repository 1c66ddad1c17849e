# SPDX-License-Identifier: Apache-2.0
"""What pcgraph finds in a structured-light scan: normals, supervoxels, boundary strength, objects, side by side.

Objects are read off the tree where boundaries are concave; a mirror's picture, the inside of glass and stray points are
surfaces to it like any other.

Usage: python examples/segmentation.py [OUT.png] [--width 640]
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import hsv_to_rgb

import pcgraph
from pcgraph.detection import find_planes, objects_on
from rangesim import StructuredLight, decode, expose, load_scene, transport

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "tabletop.xml"
GOLDEN = 0.618
"""Hues this far apart around the circle differ for any two neighbouring numbers."""
FEWEST = 1000
"""Points of a thing worth a line."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("out", nargs="?", type=Path, default=Path("out/segmentation.png"))
    parser.add_argument("--width", type=int, default=640, help="pixels; the height is three quarters of it")
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)

    scene, sensor = load_scene(SCENE), StructuredLight(code="gray-phase")
    rig = scene.rig(baseline_m=0.2, width=arguments.width, height=3 * arguments.width // 4)
    capture = expose(transport(scene, rig, [sensor], spp=16), sensor, sensor.default_detector)
    cloud = decode(capture).to_point_cloud()
    result = pcgraph.segment(cloud.points, cloud.colors)
    print(f"{(result.supervoxels >= 0).sum()} points, {result.graph.n_nodes} supervoxels")

    planes = find_planes(result)
    print(f"{len(planes.normals)} planes; on the largest level one:")
    for thing in objects_on(result, planes, points=cloud.points):
        if thing.count >= FEWEST:
            size = " x ".join(f"{1e3 * edge:.0f}" for edge in thing.box.size)
            print(f"  {thing.shape.kind:<9} {size} mm, {thing.count} points")
    draw(result, arguments.out)
    print(f"written: {arguments.out}")


def draw(result: pcgraph.Segmentation, out: Path) -> None:
    """Four pictures of an organised segmentation."""
    grid, inside = result.surface.grid, result.supervoxels >= 0
    normals = np.ones((*inside.shape, 3))
    normals[inside] = 0.5 + result.surface.normals[grid.voxel_of_point] * (0.5, -0.5, -0.5)
    strength = np.nan_to_num(np.minimum(result.saliency(), 1.0))  # of parts that do not touch it is infinite
    figure, axes = plt.subplots(2, 2, figsize=(10.24, 7.9), layout="constrained")
    pictures = {
        "normals": normals,
        "supervoxels": paint(result.supervoxels),
        "boundary strength, 0 to 1 rad": strength,
        "objects": paint(result.labels),
    }
    for axis, (title, picture) in zip(axes.flat, pictures.items(), strict=True):
        axis.imshow(picture, cmap="magma", interpolation="nearest")
        axis.set_title(title, fontsize=10)
        axis.axis("off")
    figure.savefig(out, dpi=100)
    plt.close(figure)


def paint(labels: np.ndarray) -> np.ndarray:
    """One colour per label, white where there is none, (h, w, 3)."""
    number = np.arange(labels.max() + 1)
    palette = hsv_to_rgb(
        np.stack((number * GOLDEN % 1.0, 0.45 + 0.2 * (number % 3), 0.95 - 0.1 * (number % 4)), axis=1)
    )
    return np.vstack([palette, np.ones(3)])[np.maximum(labels, -1)]


if __name__ == "__main__":
    main()
