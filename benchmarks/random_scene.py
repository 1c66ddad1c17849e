# SPDX-License-Identifier: Apache-2.0
"""Processor time of a random scene: ten objects on a table, 160 x 120 pixels, three sensors, from loading to causes.

Three scenes warm the caches up, then the median over `--scenes` counts. Dr.Jit and numba run on one thread, as in a
worker of a campaign; `--threads 0` leaves them as they are. The last line is JSON:

    cpu_s, wall_s          median seconds of a scene
    smallest_s, largest_s  processor time of the quickest and of the slowest scene
    stages_s               median seconds by stage
    load                   load of the machine at the end, processes

Usage: python benchmarks/random_scene.py [--scenes 8] [--width 160 --height 120] [--sensors gray-phase amcw direct-tof]
           [--threads 1] [--with-sampling-error]
"""

from __future__ import annotations

import argparse
import json
import os
import time
import warnings
from typing import Any

import numpy as np

OBJECTS = 10
WARM_UP = 3
FIRST_OF_WARM_UP = 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("scenes", 8), ("width", 160), ("height", 120), ("threads", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--sensors", nargs="+", default=["gray-phase", "amcw", "direct-tof"])
    parser.add_argument("--with-sampling-error", action="store_true")
    args = parser.parse_args()
    if args.threads:
        os.environ["NUMBA_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = str(args.threads)

    from rangesim.environment.backend import select_variant

    select_variant(None)
    import drjit as dr

    if args.threads:
        dr.set_thread_count(args.threads)
    warnings.simplefilter("ignore")  # of readings out of range, and of sampling noise
    for number in range(FIRST_OF_WARM_UP, FIRST_OF_WARM_UP + WARM_UP):
        seconds_of(number, args)
    found = [seconds_of(number, args) for number in range(args.scenes)]
    cpu, wall, stages = zip(*found, strict=True)
    names = sorted({name for one in stages for name in one})
    result = {
        "cpu_s": round(float(np.median(cpu)), 2),
        "wall_s": round(float(np.median(wall)), 2),
        "smallest_s": round(min(cpu), 2),
        "largest_s": round(max(cpu), 2),
        "stages_s": {name: round(float(np.median([one.get(name, 0.0) for one in stages])), 3) for name in names},
        "load": round(os.getloadavg()[0], 1),
    }
    print(json.dumps(result))


def seconds_of(number: int, args: argparse.Namespace) -> tuple[float, float, dict[str, float]]:
    """Processor time and time of a scene in seconds, and the seconds of its stages."""
    from rangesim.experiment import Experiment
    from rangesim.pipeline.experiment_run import carry_out
    from rangesim.presets import instrument
    from rangesim.scene import load_scene

    settings = Experiment(
        f"scene {number}", width=args.width, height=args.height, seed=number,
        instruments=tuple(instrument(name) for name in args.sensors),
    )  # fmt: skip
    cpu, wall = time.process_time(), time.perf_counter()
    result = carry_out(settings, scene=load_scene(scene(number)), sampling_error=args.with_sampling_error)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    stages = {"transport" if name.startswith("transport") else name: 0.0 for name in result.info.times_s}
    for name, seconds in result.info.times_s.items():
        stages["transport" if name.startswith("transport") else name] += seconds
    for one in result.measurements:
        for name, seconds in one.metadata.times_s.items():
            stages[name] = stages.get(name, 0.0) + seconds
    print(f"scene {number}: {cpu:.2f} s of processor time, {wall:.2f} s", flush=True)
    return cpu, wall, stages


def scene(number: int) -> dict[str, Any]:
    """A Mitsuba dictionary: balls, cubes and cylinders, matte, of rough metal, of rough plastic and of glass."""
    import mitsuba as mi

    draw, T = np.random.default_rng(number), mi.ScalarTransform4f
    made: dict[str, Any] = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 50,
            "to_world": T().look_at([0, -0.9, 0.8], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 160, "height": 120},
        },
        "table": {"type": "rectangle", "bsdf": matte(0.6)},
    }
    for i in range(OBJECTS):
        (x, y), size = draw.uniform(-0.3, 0.3, 2), draw.uniform(0.03, 0.08)
        materials = [
            matte(draw.uniform(0.1, 0.9)),
            {"type": "roughconductor", "alpha": 0.1},
            {"type": "roughplastic", "alpha": 0.1},
            {"type": "dielectric"},
        ]
        made[f"object-{i}"] = {
            "bsdf": materials[draw.integers(4)],
            "type": ("sphere", "cube", "cylinder")[draw.integers(3)],
            "to_world": T().translate([float(x), float(y), float(size)]).scale(float(size)),
        }
    return made


def matte(reflectance: float) -> dict[str, Any]:
    """A diffuse surface."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": float(reflectance)}}


if __name__ == "__main__":
    main()
