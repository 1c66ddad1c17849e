# SPDX-License-Identifier: Apache-2.0
"""The picture of docs/caustics.md: triangles of light through a glass ball, in the projector's image and on the plane
where they land, and the caustic that a camera sees there.

python scripts/caustic_picture.py
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from PIL import Image

from rangesim import Intrinsics, Rig, Scene, load_scene, look_at, transport
from rangesim.environment.backend import select_variant
from rangesim.light_transport.caustic_sheets import Sheets, trace_sheets
from rangesim.light_transport.traced_scene import TracedScene

PICTURE = Path(__file__).resolve().parent.parent / "docs" / "images" / "caustic_triangles.png"
BALL, RADIUS_M = np.array([0.0, 0.0, 0.06]), 0.04
PROJECTOR = np.array([-0.36, 0.0, 0.48])
MIDDLE, HALF_M = np.array([0.055, 0.0, 0.0]), 0.032
"""The part of the plane z = 0 that is shown."""
CAMERA = MIDDLE + np.array([0.0, 0.0, 0.3])
GRID, PHOTONS = "#1f5fbf", "#d9600a"
GAMMA = 2.2
"""Of the brightness of the caustic, as on a screen."""
COLOURS_OF_FILE = 192
"""Number of colours of the picture, which keeps its file small."""


def main() -> None:
    select_variant()
    rig, scene = rig_of(), ball_over_a_plane()
    sheets = trace_sheets(TracedScene.of(scene.mitsuba, rig), rig.projector_power_w, seed=0)
    assert sheets is not None
    signals = transport(scene, rig, [], spp=64, max_depth=2, glint=False, indirect="raw")
    draw(sheets, np.asarray(signals.energy.projector), rig.projector)


def ball_over_a_plane() -> Scene:
    matte = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.8}}
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    parts: dict[str, Any] = {
        "ball": {"type": "sphere", "center": BALL.tolist(), "radius": RADIUS_M, "bsdf": glass},
        "plane": {"type": "rectangle", "bsdf": matte},
    }
    return load_scene({"type": "scene", "sensor": {"type": "perspective", "fov": 40.0}, **parts})


def rig_of() -> Rig:
    """A camera that looks straight down on the plane, and a projector that shines on the ball from the left."""
    T_world_camera = look_at(CAMERA, MIDDLE, (0.0, 1.0, 0.0))
    return Rig(
        camera=Intrinsics.from_fov(320, 320, float(np.degrees(2 * np.arctan(HALF_M / CAMERA[2])))),
        projector=Intrinsics.from_fov(40, 40, 11),
        T_world_camera=T_world_camera,
        T_camera_projector=np.linalg.inv(T_world_camera) @ look_at(PROJECTOR, BALL, (0.0, 0.0, 1.0)),
    )


def draw(sheets: Sheets, seen: np.ndarray, projector: Intrinsics) -> None:
    """Write the picture."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.collections import PolyCollection

    in_image = np.stack([sheets.u, sheets.v], axis=-1)[sheets.triangles]
    on_plane = 1e3 * (sheets.position[:, :2] - MIDDLE[:2])[sheets.triangles]
    carried = sheets.in_triangles * sheets.flux.sum() * (1 + 1e-9)
    grid = int((np.cumsum(sheets.flux) <= carried).sum())  # its triangles come first
    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.9), layout="constrained")
    for name, which, colour in (("grid", slice(0, grid), GRID), ("photons", slice(grid, None), PHOTONS)):
        for a, triangles in ((axes[0], in_image[which]), (axes[1], on_plane[which])):
            a.add_collection(PolyCollection(triangles, facecolors="none", edgecolors=colour, linewidths=0.35))
        axes[0].plot([], [], color=colour, label=name)
    half = 1e3 * HALF_M
    frame = (-half, half, -half, half)
    axes[2].imshow(np.clip(seen / np.percentile(seen, 99.9), 0, 1) ** (1 / GAMMA), cmap="gray", extent=frame)
    axes[0].set(xlim=(0, projector.width), ylim=(projector.height, 0), title="triangles in the projector's image, px")
    axes[0].legend(loc="lower left", fontsize=8)
    axes[1].set(xlim=frame[:2], ylim=frame[2:], title="where they land, mm")
    axes[2].set(title="what a camera sees there, mm")
    for a in axes:
        a.set_aspect("equal")
    file = io.BytesIO()
    figure.savefig(file, dpi=100)
    with Image.open(file) as picture:
        picture.convert("RGB").quantize(COLOURS_OF_FILE).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
