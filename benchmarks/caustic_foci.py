# SPDX-License-Identifier: Apache-2.0
"""How noisy the projector's light through glass is for its cost, and how blurred, against Mitsuba's particle tracer.

Noise: a glass ball over a plane, white light, a default pass against `ptracer` with the `projector` plugin, in this
process, in turns, after warm-up. The figure is variance times processor time of `ptracer` over that of the pass:
above 1, the pass needs less time for the same noise. The variance that counts is that of single pixels over seeds,
summed over a region: `focus` is the dozen brightest pixels; `medium` is where caustics are three to ten times as bright
as the bare plane. Those of means over blocks of pixels are printed beside it. `ptracer` has no bias; that of the pass
is printed.

Blur: the edge between black and white columns, thrown through a pane, a prism and a lens onto a board that the camera
sees straight. Widths are from 10 to 90 % of the edge. The last line is JSON:

    focus, medium       variance x time of `ptracer` over that of the pass, single pixels
    blur_px             standard deviation of the Gaussian that blurs the edge behind the pane besides what the camera's
                        pixels do, in projector pixels
    max_edge_error      largest |width / width by `ptracer` - 1| of an edge
    flux_in_triangles   fraction of the light through the ball that triangles of the grid carry; photons carry the rest

Usage: python benchmarks/caustic_foci.py [--seeds 16] [--edge-spp 512]
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from caustic_energy import biconvex, triangular_prism, written
from plain_mitsuba import plain_scene, render, show
from reference_scenes import GLASS, MATTE, enlarged

from rangesim import Intrinsics, Rig, Scene, StructuredLight, load_scene, look_at, transport
from rangesim.environment.backend import select_variant
from rangesim.response import Images
from rangesim.scene.camera import MITSUBA_FROM_OPENCV

FILM = {"type": "hdrfilm", "pixel_format": "luminance"}
FOCUS_PIXELS = 12
"""Number of pixels of `focus`. The brightest one is 350 times as bright as the bare plane, the last one 63 times."""
MEDIUM = (3.0, 10.0)
"""Least and largest brightness of `medium`, in that of the bare plane."""
BLOCK_PX = 4
"""Edge of the blocks of pixels over which means are taken."""
PTRACER_SPP = 64
"""Samples of `ptracer` per pixel of the camera; takes about as long as a pass. Its variance times time does not depend
on it."""
EDGE_SEEDS = 4
"""Passes over which an edge is averaged."""
EDGE_REACH_PX, EDGE_ROWS_PX = 40, 70
"""How far from the middle of the image an edge is measured, camera pixels to the left and right, above and below."""
EDGE_BIN_PX = 0.125
"""Camera pixels between the places at which an edge is known. It is slanted, so its pixels lie at all fractions."""
WIDTH_OF_GAUSSIAN = 2.5631
"""Distance from 10 to 90 % of an error function, in standard deviations."""
BOARD_M, GLASS_M = 0.6, 0.3
"""Distances of board and glass from the projector."""
PRISM_SHIFT_M = 0.0432
"""How far to the side the prism bends the projector's axis, on the board."""
LENS_SHIFT_M = -0.02
"""How far the lens stands beside the projector's axis, and how far it bends it: light that its faces reflect twice has
its focus beside the edge."""


def timed(work: Callable[[], np.ndarray]) -> tuple[np.ndarray, float]:
    """Result of `work` and the processor time of all threads in seconds."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


# ---- Noise ------------------------------------------------------------------------------------------


def ball_over_a_plane(is_large: bool = False) -> tuple[Scene, Rig]:
    """The plane is near the ball's focus, which the camera sees beside the ball.

    `is_large`: as large as the reference needs it (`reference_scenes.ENLARGEMENT`).
    """
    select_variant()  # before Mitsuba's transforms
    import mitsuba as mi

    eye, up = (-0.1, -0.5, 0.4), (0.0, 0.0, 1.0)
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.3), "bsdf": MATTE}
    ball = {"type": "sphere", "center": [0.01, 0.0, 0.09], "radius": 0.05, "bsdf": GLASS}
    T_world_camera = look_at(eye, (0.0, 0.0, 0.0), up)
    rig = Rig(
        camera=Intrinsics.from_fov(320, 240, 20),
        projector=Intrinsics.from_fov(1280, 800, 28),
        T_world_camera=T_world_camera,
        T_camera_projector=np.linalg.inv(T_world_camera) @ look_at((0.08, 0.03, 0.6), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    )
    shapes = {"plane": plane, "ball": ball}
    if is_large:
        shapes, rig = enlarged(shapes, rig, ball["center"])
    to_world = mi.ScalarTransform4f(rig.T_world_camera @ MITSUBA_FROM_OPENCV)
    return load_scene(
        {"type": "scene", "sensor": {"type": "perspective", "fov": 20.0, "to_world": to_world}, **shapes}
    ), rig


def noise(seeds: int) -> dict[str, float]:
    """Print the table and return `focus` and `medium`."""
    import mitsuba as mi

    scene, rig = ball_over_a_plane()
    white = Images(np.ones((1, rig.projector.height, rig.projector.width), np.float32))
    plain, integrator = plain_scene(*ball_over_a_plane(is_large=True), FILM), mi.load_dict({"type": "ptracer"})
    sides: dict[str, Callable[[int], np.ndarray]] = {
        "ours": lambda seed: transport(scene, rig, [white], seed=seed).channels[white][0],
        "ptracer": lambda seed: render(plain, integrator, PTRACER_SPP, seed),
    }
    for side in sides.values():
        side(seeds)  # warm-up
    images: dict[str, list[np.ndarray]] = {name: [] for name in sides}
    spent: dict[str, list[float]] = {name: [] for name in sides}
    for seed in range(seeds):
        for name, side in sides.items():
            image, seconds = timed(partial(side, seed))
            images[name].append(image)
            spent[name].append(seconds)
    stacks = {name: np.stack(image) for name, image in images.items()}
    seconds = {name: float(np.median(s)) for name, s in spent.items()}
    light = StructuredLight(rig.projector.width, rig.projector.height, code="gray", axes=("columns", "rows"))
    many = [timed(lambda: transport(scene, rig, light.responses()).energy.caustic)[1] for _ in range(4)][1:]
    print(f"processor time: a pass {seconds['ours']:.2f} s, with {light.n_frames} patterns {np.median(many):.2f} s; "
          f"ptracer {seconds['ptracer']:.2f} s; {seeds} seeds")  # fmt: skip

    expected = stacks["ptracer"].mean(axis=0)
    bare = transport(scene, rig, [white], caustics=False).energy.direct
    lit = np.median(bare[bare > 0])
    brightest = expected >= np.sort(expected.ravel())[-FOCUS_PIXELS]
    # Where no light arrives straight, behind the ball
    medium = (bare == 0) & ~brightest & (expected > MEDIUM[0] * lit) & (expected < MEDIUM[1] * lit)
    result = {}
    for name, region in (("focus", brightest), ("medium", medium)):
        single = {k: x[:, region] for k, x in stacks.items()}
        blocks = {k: block_means(x, region) for k, x in stacks.items()}
        ratios = [ratio(x, seconds) for x in (single, blocks)]
        result[name] = round(ratios[0], 4)
        off = single["ours"].mean() / single["ptracer"].mean() - 1
        relative = {k: np.sqrt((x.var(axis=0, ddof=1)).mean()) / x.mean() for k, x in single.items()}
        print(f"{name:<7} {region.sum():4d} pixels, {expected[region].mean() / lit:.1f} of the bare plane; variance x "
              f"time of ptracer / ours: single pixels {ratios[0]:.3f}, means of blocks {ratios[1]:.3f}; noise of a "
              f"pixel {relative['ours']:.1%}, ptracer {relative['ptracer']:.1%}; mean {off:+.2%}")  # fmt: skip
    return result


def flux_in_triangles() -> float:
    """Fraction of the light through the ball that triangles of the grid carry."""
    from rangesim.light_transport.caustic_sheets import trace_sheets
    from rangesim.light_transport.traced_scene import TracedScene

    scene, rig = ball_over_a_plane()
    sheets = trace_sheets(TracedScene.of(scene.mitsuba, rig), rig.projector_power_w, seed=0)
    assert sheets is not None
    return round(sheets.in_triangles, 4)


def block_means(stack: np.ndarray, region: np.ndarray) -> np.ndarray:
    """(seeds, k) means over the pixels of a region that lie in each of k blocks, empty blocks left out."""
    row, column = np.nonzero(region)
    _, block = np.unique(row // BLOCK_PX * region.shape[1] + column // BLOCK_PX, return_inverse=True)
    sums = np.stack([np.bincount(block, image[region]) for image in stack])
    return np.asarray(sums / np.bincount(block))


def ratio(values: dict[str, np.ndarray], seconds: dict[str, float]) -> float:
    """Variance times time of `ptracer` over ours, of (seeds, k) values."""
    cost = {name: x.var(axis=0, ddof=1).sum() * seconds[name] for name, x in values.items()}
    return float(cost["ptracer"] / cost["ours"])


# ---- Blur -------------------------------------------------------------------------------------------


class Edge(NamedTuple):
    """Glass before the board, as shapes, and the x at which its light of the projector's middle lands, metres."""

    shapes: dict[str, Any]
    x_m: float


def edges(folder: Path) -> dict[str, Edge]:
    """The edge behind nothing, pane, prism and lens; meshes are written to `folder`."""
    select_variant()  # before Mitsuba's transforms
    import mitsuba as mi

    here = mi.ScalarTransform4f().translate([0, 0, GLASS_M])
    pane = {"type": "cube", "to_world": here.scale([0.07, 0.06, 0.005]), "bsdf": GLASS}
    wedge = {**written(folder / "wedge.ply", triangular_prism(0.04, 0.14, 0.12)), "face_normals": True}
    lens = written(folder / "lens.ply", biconvex(0.3, 0.055, 0.001))
    return {
        "nothing": Edge({}, 0.0),
        "pane": Edge({"pane": pane}, 0.0),
        "prism": Edge({"prism": {**wedge, "to_world": here.rotate([0, 1, 0], 90), "bsdf": GLASS}}, PRISM_SHIFT_M),
        "lens": Edge({"lens": {**lens, "to_world": here.translate([LENS_SHIFT_M, 0, 0]), "bsdf": GLASS}}, LENS_SHIFT_M),
    }


def edge_scene(edge: Edge) -> tuple[Scene, Rig]:
    """The camera looks past the glass at the board where the edge lands; it is turned about its axis by 5 degrees."""
    import mitsuba as mi

    eye, at = (0.3, 0.0, 0.0), (edge.x_m, 0.0, BOARD_M)
    up = (np.sin(np.radians(5.0)), -np.cos(np.radians(5.0)), 0.0)
    # Turned, not mirrored: `ptracer` finds a mirrored rectangle black
    place = mi.ScalarTransform4f().translate([0, 0, BOARD_M]).rotate([1, 0, 0], 180).scale(0.4)
    board = {"type": "rectangle", "to_world": place, "bsdf": MATTE}
    to_world = mi.ScalarTransform4f().look_at(list(eye), list(at), list(up))
    sensor = {"type": "perspective", "fov": 9.5, "to_world": to_world}
    T_world_camera = look_at(eye, at, up)
    rig = Rig(
        camera=Intrinsics.from_fov(320, 240, 9.5),
        projector=Intrinsics.from_fov(640, 400, 24),
        T_world_camera=T_world_camera,
        T_camera_projector=np.linalg.inv(T_world_camera) @ look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    )
    return load_scene({"type": "scene", "sensor": sensor, "board": board, **edge.shapes}), rig


def edge_width(bright: np.ndarray, dark: np.ndarray) -> float:
    """Distance from 10 to 90 % of an edge across the middle of two images (h, w), of a pattern and of its inverse, in
    pixels."""
    middle_row, middle_column = (n // 2 for n in bright.shape)
    rows = np.arange(middle_row - EDGE_ROWS_PX, middle_row + EDGE_ROWS_PX)
    columns = np.arange(middle_column - EDGE_REACH_PX, middle_column + EDGE_REACH_PX)
    a, b = (x[np.ix_(rows, columns)] for x in (bright, dark))
    # Columns left of the edge, row by row, from the fraction of light that is bright; the edge bends slowly
    share = a / (a + b)
    if share[:, -1].mean() < share[:, 0].mean():
        a, b, share = b, a, 1 - share
    line = np.polynomial.Polynomial.fit(rows, columns[-1] + 0.5 - share.sum(axis=1), 3)
    across = (columns - line(rows)[:, None]) / np.hypot(1, line.deriv()(rows))[:, None]
    n = int(EDGE_REACH_PX / 2 / EDGE_BIN_PX)
    index = np.floor(across / EDGE_BIN_PX).astype(int) + n
    inside = (index >= 0) & (index < 2 * n)
    sums = [np.bincount(index[inside], x[inside], 2 * n) for x in (a, b)]
    profile = sums[0] / (sums[0] + sums[1])
    low, high = (EDGE_BIN_PX * crossing(profile, level) for level in (0.1, 0.9))
    return high - low


def crossing(profile: np.ndarray, level: float) -> float:
    """Place at which a rising profile passes a level, in steps; the mean of its first and last passage."""
    above = profile >= level
    places = np.flatnonzero(above[1:] != above[:-1])
    if not len(places):
        raise ValueError(f"expected an edge that passes {level}, got {profile.min():.3f} to {profile.max():.3f}.")
    return float(np.mean([i + (level - profile[i]) / (profile[i + 1] - profile[i]) for i in places]))


def blur(edge_spp: int) -> dict[str, float]:
    """Print the table and return `blur_px` and `max_edge_error`."""
    import mitsuba as mi

    integrator = mi.load_dict({"type": "ptracer"})
    found: dict[str, tuple[float, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, edge in edges(Path(folder)).items():
            scene, rig = edge_scene(edge)
            step = np.zeros((2, rig.projector.height, rig.projector.width), np.float32)
            step[0, :, rig.projector.width // 2 :] = 1
            step[1] = 1 - step[0]
            response = Images(step)
            passes = [transport(scene, rig, [response], seed=seed) for seed in range(EDGE_SEEDS)]
            ours = edge_width(*np.mean([s.channels[response] for s in passes], axis=0))
            if name == "nothing":
                across = np.gradient(passes[0].truth.projector_uv[..., 0])
                h, w = across[0].shape
                pixel = float(np.hypot(across[0][h // 2, w // 2], across[1][h // 2, w // 2]))
            plain, images = plain_scene(scene, rig, FILM), []
            for seed, pattern in enumerate(step):
                show(plain, pattern)
                images.append(render(plain, integrator, edge_spp, seed))
            found[name] = ours, edge_width(*images)
            print(f"edge behind {name:<8} width {found[name][0]:.3f} camera pixels, by ptracer {found[name][1]:.3f}; "
                  f"{ours / found[name][1] - 1:+.1%}", flush=True)  # fmt: skip
    print(f"a camera pixel is {pixel:.3f} projector pixels")
    wider = found["pane"][0] ** 2 - found["nothing"][0] ** 2
    return {
        "blur_px": round(pixel * float(np.sqrt(max(wider, 0))) / WIDTH_OF_GAUSSIAN, 3),
        "max_edge_error": round(max(abs(a / b - 1) for a, b in found.values()), 4),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--edge-spp", type=int, default=512, help="samples of ptracer per pixel, for edges")
    args = parser.parse_args()
    select_variant()
    print(json.dumps({**noise(args.seeds), **blur(args.edge_spp), "flux_in_triangles": flux_in_triangles()}))


if __name__ == "__main__":
    main()
