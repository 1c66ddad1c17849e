# SPDX-License-Identifier: Apache-2.0
"""Time to load and to trace scenes of many objects.

    python benchmarks/many_shapes.py [--materials one|own|glass] [--counts 500 2000 10000]

Balls in a box seen by a camera of 160 x 120 pixels, one sample for each, photons and glint included. The balls share
one material (`one`), have one each (`own`), or every tenth of them is of glass (`glass`). Each count is traced twice:
the first time compiles kernels, unless they are in Dr.Jit's cache. The last line is JSON: seconds of the second.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import numpy as np

from rangesim import AmcwToF, Scene, load_scene, transport
from rangesim.environment.backend import select_variant

COUNTS = (500, 2000, 10_000)
MATERIALS = ("one", "own", "glass")


def balls(count: int, materials: str = "one") -> dict[str, Any]:
    """Scene dictionary with so many balls before a wall; random places, the same for each call."""
    import mitsuba as mi

    select_variant()
    to_world = mi.ScalarTransform4f()
    look = to_world.look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])
    grey = {"type": "diffuse", "reflectance": 0.5}
    scene: dict[str, Any] = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 50.0, "to_world": look},
        "wall": {"type": "rectangle", "to_world": to_world.translate([0, 0, 2.5]).scale([2, 2, -1]), "bsdf": grey},
        "grey": {"type": "diffuse", "reflectance": 0.4},
        "glass": {"type": "dielectric", "int_ior": 1.5},
    }
    rng = np.random.default_rng(1)
    centres = rng.uniform((-0.9, -0.7, 1.4), (0.9, 0.7, 2.4), (count, 3))
    reflectances = rng.uniform(0.2, 0.8, count)
    for i, (centre, reflectance) in enumerate(zip(centres, reflectances, strict=True)):
        ball = {"type": "sphere", "center": centre.tolist(), "radius": 0.4 / np.cbrt(count)}
        if materials == "own" or (materials == "glass" and i % 10):
            ball["bsdf"] = {"type": "diffuse", "reflectance": float(reflectance)}
        else:
            ball["bsdf"] = {"type": "ref", "id": "glass" if materials == "glass" else "grey"}
        scene[f"ball_{i}"] = ball
    return scene


def seconds_to_trace(scene: Scene, **options: Any) -> float:
    """Of one pass of 160 x 120 pixels with one sample each."""
    rig = scene.rig(width=160, height=120)
    start = time.perf_counter()
    transport(scene, rig, [AmcwToF()], spp=1, **options)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--materials", choices=MATERIALS, default="one")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    given = parser.parse_args()
    results: dict[str, Any] = {"materials": given.materials}
    for count in given.counts:
        source = balls(count, given.materials)
        start = time.perf_counter()
        scene = load_scene(source)
        loading = time.perf_counter() - start
        first, second = seconds_to_trace(scene), seconds_to_trace(scene)
        print(
            f"{count:6} balls: loaded in {loading:.2f} s, traced in {first:.2f} s, again in {second:.2f} s", flush=True
        )
        results[str(count)] = {"load_s": round(loading, 3), "first_s": round(first, 3), "trace_s": round(second, 3)}
    print(json.dumps(results))


if __name__ == "__main__":
    main()
