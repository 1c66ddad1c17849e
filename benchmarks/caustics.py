# SPDX-License-Identifier: Apache-2.0
"""What caustics cost, and how noisy they are.

Default transport (640 x 480, 64 spp, default sensors) with and without caustics, glint on both sides, in this process,
after warm-up, in turns. A third turn goes without glint. The last line is JSON:

    cost_ratio        median time with caustics over that without
    cpu_ratio         the same in processor time, which other load on the machine disturbs less
    glint_cpu_ratio   median processor time with glint over that without, both without caustics
    triangles         of light
    in_triangles      fraction of the light that triangles of the grid carry; photons carry the rest
    trace_s           to trace them (median)
    build_s           to build the scene in which they are found (median)
    noise             standard deviation over seeds of pixels where caustics outshine all else, over their mean (median)
    noisy_pixels      how many these are

Usage: python benchmarks/caustics.py [SCENE] [--width 640] [--height 480] [--spp 64] [--repeats 5]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rangesim import AmcwToF, IdealToF, StructuredLight, load_scene, transport

SCENES = Path(__file__).resolve().parent.parent / "scenes"


def timed(task: Callable[[], Any]) -> tuple[Any, np.ndarray]:
    """The result of a task, and its (wall, processor) time in seconds."""
    before, cpu = time.perf_counter(), os.times()
    result = task()
    after = os.times()
    return result, np.array([time.perf_counter() - before, after.user + after.system - cpu.user - cpu.system])


def triangle_times(scene: Any, rig: Any, spp: int, repeats: int) -> tuple[Any, np.ndarray]:
    """The triangles of light, and (repeats, 2) seconds to trace them and to build the scene in which they are found."""
    from rangesim.light_transport.caustics import caustic_sheets, sheet_scene
    from rangesim.light_transport.traced_scene import TracedScene
    from rangesim.light_transport.transport_settings import TransportSettings

    here, seconds = scene.in_renderer(rig), []
    traced = TracedScene.of(scene.mitsuba, here)
    for seed in range(repeats + 1):
        sheets, tracing = timed(partial(caustic_sheets, traced, [here], TransportSettings(seed=seed)))
        _, building = timed(partial(sheet_scene, sheets, here, spp, 0))
        seconds.append([tracing[0], building[0]])
    return sheets, np.array(seconds[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default=str(SCENES / "tabletop.xml"))
    for name, default in (("width", 640), ("height", 480), ("spp", 64), ("repeats", 5)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()

    scene = load_scene(args.scene)
    rig = scene.rig(width=args.width, height=args.height)
    sensors = [StructuredLight(rig.projector.width, rig.projector.height), AmcwToF(), IdealToF()]
    render = partial(transport, scene, rig, sensors, spp=args.spp)
    sides = {
        "caustics": render,
        "without": partial(render, caustics=False),
        "dark": partial(render, caustics=False, glint=False),
    }
    for side in sides.values():
        side(seed=99)  # warm-up
    seconds: dict[str, list[np.ndarray]] = {name: [] for name in sides}
    images = []
    for seed in range(args.repeats):
        for name, side in sides.items():
            signals, spent = timed(partial(side, seed=seed))
            seconds[name].append(spent)
            if name == "caustics":
                images.append(signals.energy)
        print("  ".join(f"{name} {spent[-1][0]:.2f} s, cpu {spent[-1][1]:.2f} s" for name, spent in seconds.items()))

    caustic = np.stack([e.caustic for e in images])
    mean = caustic.mean(axis=0)
    bright = mean > np.mean([e.projector - e.caustic for e in images], axis=0)
    sheets, triangle_s = triangle_times(scene, rig, args.spp, args.repeats)
    median = {name: np.median(spent, axis=0) for name, spent in seconds.items()}
    ratio, glint = median["caustics"] / median["without"], median["without"] / median["dark"]
    result = {
        "cost_ratio": round(float(ratio[0]), 3),
        "cpu_ratio": round(float(ratio[1]), 3),
        "glint_cpu_ratio": round(float(glint[1]), 3),
        "triangles": len(sheets.flux),
        "in_triangles": round(sheets.in_triangles, 4),
        "trace_s": round(float(np.median(triangle_s[:, 0])), 3),
        "build_s": round(float(np.median(triangle_s[:, 1])), 3),
        "noise": round(float(np.median(caustic.std(axis=0, ddof=1)[bright] / mean[bright])), 3),
        "noisy_pixels": int(bright.sum()),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
