# SPDX-License-Identifier: Apache-2.0
"""Fringes on a board behind glass, with a wall far behind that fills most of the image.

A board at 0.6 m, a thin pane at 0.5 m before it, a wall at 0.9, 2 or 6 m; two panes; a hollow glass ball, which bends
the light. 320 x 240 pixels, fringes of 16 projector pixels, samples by default. Two references: the same
board without any glass, for contrast and depth where glass shifts nothing; and a path tracer that shares no
code with the pass (`finite_aperture.py`), for means, and for the contrast behind the ball. The last line is JSON:

    min_contrast        least contrast of fringes over that of the reference
    max_contrast_error  largest difference of the contrast from that of the path tracer
    max_z_mm            largest median |z error| of Gray code and phase shift behind panes
    max_mean_error      largest relative error of a region's mean radiance of white against the path tracer

Usage: python benchmarks/glass.py [--spp N] [--reference-samples 16000000]
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from finite_aperture import Lamp, finite_aperture
from reference_scenes import GLASS, MATTE, Guide

from rangesim import Intrinsics, Rig, Scene, Signals, StructuredLight, decode, expose, load_scene, look_at, transport
from rangesim.codes import GrayPhase
from rangesim.environment.backend import select_variant
from rangesim.response import Fringes

BOARD_M, PERIOD_PX, MAX_DEPTH = 0.6, 16.0, 12
BALL_M, BALL_RADIUS_M, SHELL_M = 0.5, 0.05, 0.0015
LAMP_RADIUS_M = 0.004
SENSOR = StructuredLight(code=GrayPhase(PERIOD_PX))


class Case(NamedTuple):
    """Shapes before the board; depth of the wall behind, None: none; whether glass leaves light where it was."""

    glass: dict[str, Any]
    wall_m: float | None
    is_flat: bool = True


class Seen(NamedTuple):
    """What n pixels of a region show: radiance of white (n,), of fringes (n,) complex; median |z error| in mm, fraction
    of pixels decoded."""

    white: np.ndarray
    fringes: np.ndarray
    z_mm: float
    decoded: float


def square(z: float, half_size: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([0, 0, z]).scale([half_size, half_size, -1])
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def cases() -> dict[str, Case]:
    thin = {**GLASS, "type": "thindielectric"}
    pane = {"pane": square(0.5, 0.06, thin)}
    panes = {**pane, "second": square(0.52, 0.06, thin)}
    centre = {"type": "sphere", "center": [0.0, 0.0, BALL_M]}
    ball = {
        "outside": {**centre, "radius": BALL_RADIUS_M, "bsdf": GLASS},
        "inside": {**centre, "radius": BALL_RADIUS_M - SHELL_M, "flip_normals": True, "bsdf": GLASS},
    }
    return {
        **{f"pane, wall at {z} m" if z else "pane, no wall": Case(pane, z) for z in (None, 0.9, 2.0, 6.0)},
        "two panes, wall at 6 m": Case(panes, 6.0),
        "hollow ball, wall at 6 m": Case(ball, 6.0, is_flat=False),
    }


def scene_of(glass: dict[str, Any], wall_m: float | None) -> Scene:
    wall = {} if wall_m is None else {"wall": square(wall_m, 10 * wall_m, MATTE)}
    return load_scene({"type": "scene", "board": square(BOARD_M, 0.05, MATTE), **wall, **glass, "sensor": SENSOR_AT})


SENSOR_AT: dict[str, Any] = {"type": "perspective", "fov": 40.0}


def rig_of() -> Rig:
    import mitsuba as mi

    SENSOR_AT["to_world"] = mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])
    down, ahead = (0.0, -1.0, 0.0), (0.0, 0.0, BOARD_M)
    return Rig(
        camera=Intrinsics.from_fov(320, 240, 40),
        projector=Intrinsics.from_fov(1280, 800, 44),
        T_world_camera=look_at((0.0, 0.0, 0.0), ahead, down),
        T_camera_projector=look_at((0.15, 0.0, 0.0), ahead, down),
    )


def region_of(rig: Rig, case: Case) -> np.ndarray:
    """(h, w) bool: the board's inner pixels, or those in the middle of the ball."""
    rays = rig.camera.normalise(rig.camera.pixel_centres())
    if case.is_flat:
        return np.asarray(np.abs(rays * BOARD_M).max(axis=-1) < 0.04)
    return np.asarray(np.linalg.norm(rays * BALL_M, axis=-1) < 0.4 * BALL_RADIUS_M)


def seen(signals: Signals, region: np.ndarray) -> Seen:
    white, fringes = signals.energy.projector[region], signals.channels[Fringes(0, PERIOD_PX)][:, region]
    z = decode(expose(signals, SENSOR, None)).z[region]
    error = float(np.nanmedian(1e3 * np.abs(z - BOARD_M)))
    return Seen(white, fringes[0] + 1j * fringes[1], error, float(np.isfinite(z).mean()))


def contrast(one: Seen, phases: Seen) -> float:
    """Amplitude in phase with the fringes of another image over white: noise and stray light do not add to it."""
    turned = one.fringes * np.exp(-1j * np.angle(phases.fringes))
    return float(turned.real.sum() / one.white.sum())


def traced(scene: Scene, rig: Rig, region: np.ndarray, samples: int) -> Seen:
    """Mean and contrast by brute force."""
    u = 2 * np.pi / PERIOD_PX * (np.arange(rig.projector.width) + 0.5)
    # The lamp shows no negative light
    patterns = np.stack([np.tile(0.5 + 0.5 * f(u), (rig.projector.height, 1)) for f in (np.cos, np.sin)])
    row, column = np.nonzero(region)
    lamp = Lamp(rig, LAMP_RADIUS_M, BOARD_M, patterns)
    guide = Guide(tuple(rig.T_world_projector[:3, 3]), 0.02)
    pixels = np.stack([column, row], axis=-1)
    white, _, c, s = finite_aperture(scene.mitsuba, lamp, guide, pixels, samples // len(pixels), 1)
    return Seen(white, 2 * c - white + 1j * (2 * s - white), np.nan, np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spp", type=int, default=argparse.SUPPRESS)
    parser.add_argument("--reference-samples", type=int, default=16_000_000)
    args = parser.parse_args()

    select_variant()
    rig = rig_of()
    options = {k: v for k, v in vars(args).items() if k == "spp"}
    render = partial(transport, rig=rig, sensors=[SENSOR], max_depth=MAX_DEPTH, glint=False, **options)
    contrasts, off, depths, means = [], [], [], []
    without: dict[float | None, Signals] = {}
    for name, case in cases().items():
        region = region_of(rig, case)
        if case.wall_m not in without:
            without[case.wall_m] = render(scene_of({}, case.wall_m))
        scene = scene_of(case.glass, case.wall_m)
        ours, free = seen(render(scene), region), seen(without[case.wall_m], region)
        brute = traced(scene, rig, region, args.reference_samples)
        found, plain, expected = contrast(ours, ours), contrast(free, free), contrast(brute, ours)
        contrasts.append(found / (plain if case.is_flat else expected))
        off.append(found - expected)
        means.append(ours.white.mean() / brute.white.mean() - 1)
        if case.is_flat:
            depths.append(ours.z_mm)
        print(f"{name:<26} contrast {found:.3f}, without glass {plain:.3f}, by path tracer {expected:.3f}; "
              f"|z| {ours.z_mm:.3f} mm, without {free.z_mm:.3f}; decoded {ours.decoded:.1%}; mean {means[-1]:+.2%}",
              flush=True)  # fmt: skip
    result = {
        "min_contrast": round(min(contrasts), 4),
        "max_contrast_error": round(max(map(abs, off)), 4),
        "max_z_mm": round(max(depths), 4),
        "max_mean_error": round(max(map(abs, means)), 4),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
