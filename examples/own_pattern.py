# SPDX-License-Identifier: Apache-2.0
"""Patterns of your own on an object: any stack of images is projected in one pass.

Usage: python examples/own_pattern.py [OUT_FOLDER]
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from rangesim import load_scene, transport
from rangesim.response import Images

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "matte.xml"


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/own_pattern")
    out.mkdir(parents=True, exist_ok=True)
    height, width = 200, 320
    dots = (np.random.default_rng(0).random((height, width)) < 0.1).astype(np.float32)
    rings = 0.5 + 0.5 * np.cos(np.hypot(*np.mgrid[-100:100, -160:160]) / 4).astype(np.float32)
    patterns = Images(np.stack([dots, rings]))

    scene = load_scene(SCENE)
    rig = scene.rig(projector_size=(width, height), width=320, height=240)
    seen = transport(scene, rig, [patterns], spp=32).channels[patterns]  # (2, h, w), W/m2/sr
    for name, image in zip(("dots", "rings"), seen, strict=True):
        grey = np.uint8(255 * np.clip(image / np.quantile(image, 0.99), 0, 1) ** 0.45)
        Image.fromarray(grey).save(out / f"{name}.png")
        print(out / f"{name}.png")


if __name__ == "__main__":
    main()
