# SPDX-License-Identifier: Apache-2.0
"""Noise of the renderer in a reading, against the noise of the sensor.

A reading without detector noise, at the settings a user gets who sets nothing, against the mean of two readings at 512
samples per pixel whose indirect light is not filtered: what is left is sampling, and the bias of the filter; the noise
of the reference, half the difference of its two readings, is subtracted in quadrature. And a reading of the reference
through the detector, against that without: the sensor's own noise. All as 1.4826 times the median of |difference|, over
the pixels of a material class that are valid in both. For structured light, AMCW and direct time of flight. With
`--no-caustics`, all passes leave caustics out: what is left is the noise of camera paths.

The last line is JSON:

    plane, matte, tabletop  for each material class: sampling sigma over detector sigma, of the worst sensor
    demo_s_ratio            time of `rangesim run` on tabletop over that of the revision `--before`, in turns (median);
                            null without it

Usage: python benchmarks/sampling_noise.py [--scenes plane matte tabletop] [--spp N] [--reference-spp 512]
           [--width W --height H] [--seeds 2] [--no-caustics] [--before REVISION]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from rangesim import Capture, Signals, decode, expose, load_scene, transport
from rangesim.evaluation.range_noise import robust_sigma
from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.shared_passes import group_by_rig
from rangesim.presets import instrument
from rangesim.scene import Scene
from rangesim.signals import ALL

ROOT = Path(__file__).resolve().parent.parent
SENSORS = ("gray-phase", "amcw", "direct-tof")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["plane", "matte", "tabletop"])
    parser.add_argument("--spp", type=int)
    parser.add_argument("--reference-spp", type=int, default=512)
    parser.add_argument("--width", type=int)
    parser.add_argument("--height", type=int)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--no-caustics", action="store_true")
    parser.add_argument("--before")
    args = parser.parse_args()

    result: dict[str, Any] = {name: worst_ratios(name, args) for name in args.scenes}
    result["demo_s_ratio"] = demo_ratio(args.before) if args.before else None
    print(json.dumps(result))


def worst_ratios(name: str, args: argparse.Namespace) -> dict[str, float]:
    """Sampling sigma over detector sigma of the worst of the sensors by material class; a line for each."""
    instruments = tuple(instrument(sensor) for sensor in SENSORS)
    given = {"width": args.width, "height": args.height, "spp": args.spp, "instruments": instruments}
    experiment = Experiment(name, **{key: value for key, value in given.items() if value is not None})
    scene = load_scene(name)
    worst: dict[str, float] = {}
    for rig, group in group_by_rig(experiment, scene):
        sensors = [one.sensor for one in group]

        def traced(seed: int, spp: int, rig: Any = rig, sensors: Any = sensors, **options: Any) -> Signals:
            options |= {"max_depth": experiment.max_depth, "caustics": not args.no_caustics}
            return transport(scene, rig, sensors, spp=spp, seed=seed, **options)

        references = [traced(10_000 + i, args.reference_spp, indirect="raw") for i in range(2)]
        passes = [traced(seed, experiment.spp or "auto") for seed in range(args.seeds)]
        for one in group:
            for material, ratio in ratios_of(one, scene, references, passes).items():
                worst[material] = max(worst.get(material, 0.0), ratio)
    return worst


def ratios_of(one: Instrument, scene: Scene, references: list[Signals], passes: list[Signals]) -> dict[str, float]:
    """Sampling sigma over detector sigma of one instrument by material class; lines also say the median error."""
    first, second = (noise_free(one, signals) for signals in references)
    converged = (first + second) / 2
    errors = [noise_free(one, signals) - converged for signals in passes]
    detected = depth_mm(expose(references[0], one.sensor, one.detector, one.exposure_s, 1))
    classes, ratios = references[0].truth.classes(), {}
    classes.pop(ALL)
    for material, mask in classes.items():
        left_over = spread((first - second)[mask] / 2)
        sampling = float(np.sqrt(max(0.0, np.mean([spread(e[mask]) ** 2 for e in errors]) - left_over**2)))
        detector = spread((detected - first)[mask])
        bias = statistics.mean(float(np.nanmedian(e[mask])) for e in errors)
        ratios[material] = round(sampling / max(detector, 1e-9), 3)
        print(
            f"{scene.name:9} {one.name:11} {material:11} sampling {sampling:7.4f} mm  detector {detector:7.4f} mm  "
            f"ratio {ratios[material]:6.3f}  median error {bias:8.4f} mm  noise of the reference {left_over:7.4f} mm",
            flush=True,
        )
    return ratios


def spread(errors: np.ndarray) -> float:
    """Robust standard deviation about 0; infinite without any reading."""
    sigma = robust_sigma(errors)
    return np.inf if sigma is None else sigma


def noise_free(one: Instrument, signals: Signals) -> np.ndarray:
    return depth_mm(expose(signals, one.sensor, None))


def depth_mm(capture: Capture) -> np.ndarray:
    """(h, w) float64; NaN where nothing was measured."""
    return 1e3 * decode(capture).z.astype(np.float64)


def demo_ratio(before: str, repeats: int = 5) -> float:
    """Wall time of `rangesim run tabletop` here over that of an older revision, in turns, each warm."""
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "before"
        old.mkdir()
        archive = subprocess.run(["git", "archive", before], cwd=ROOT, check=True, capture_output=True).stdout
        subprocess.run(["tar", "-x"], cwd=old, input=archive, check=True)
        seconds: dict[Path, list[float]] = {old: [], ROOT: []}
        for turn in range(repeats + 1):
            for root, times in seconds.items():
                taken = seconds_of_demo(root, Path(folder) / "out")
                if turn:
                    times.append(taken)
        print(*(f"{root.name}: {statistics.median(times):.2f} s" for root, times in seconds.items()), flush=True)
        return statistics.median(new / old for new, old in zip(seconds[ROOT], seconds[old], strict=True))


def seconds_of_demo(root: Path, out: Path) -> float:
    line = [sys.executable, "-c", "from rangesim.cli import main; main()", "run", "scenes/tabletop.xml", "--out"]
    start = time.perf_counter()
    subprocess.run(
        [*line, str(out / root.name)],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        check=True,
        capture_output=True,
    )
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
