# SPDX-License-Identifier: Apache-2.0
"""How far is a calibration off from one set of poses to another, and do its standard deviations say so?

Renders the set of `examples/calibration.py` (12 poses, 640 x 480, the default detector's noise) with other seeds, which
give other poses, other samples and other noise, and prints the errors of each, what they are in standard deviations,
and worst and median. The last line is JSON:

    misses                    sets that miss a bar: focal lengths 0.1 % (projector 0.2 %), principal points 0.5 px (1
                              px), baseline 0.2 %, reprojection 0.1 px in the camera
    worst_..., median_...     of the largest error of each set
    rms_of_errors_in_deviations   1 if the standard deviations are right

Usage: python benchmarks/calibration_seeds.py [--seeds 1 2 3 4 5] [--poses 12]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import numpy as np

from rangesim import StructuredLight
from rangesim.calibration import Checkerboard, calibrate_rig, default_rig, render_set

BARS = {
    "camera_focal_percent": 0.1,
    "camera_principal_px": 0.5,
    "projector_focal_percent": 0.2,
    "projector_principal_px": 1.0,
    "baseline_percent": 0.2,
    "camera_reprojection_px": 0.1,
}


def measure(seed: int, poses: int) -> tuple[dict[str, float], list[float]]:
    """Errors of a set, and errors over standard deviations."""
    true, board = default_rig(), Checkerboard(9, 6, 0.025)
    sensor = StructuredLight(projector_width=800, projector_height=600, axes=("columns", "rows"))
    # seeds of renderings count up from the set's own: sets must not share them
    captures = render_set(board, true, sensor, poses, seed=1000 * seed).captures
    found = calibrate_rig(board, [replace(capture, rig=None) for capture in captures], coefficients=4)
    errors: dict[str, float] = {}
    in_deviations = []
    for name in ("camera", "projector"):
        device, truth = getattr(found.rig, name), getattr(true, name)
        off = np.array([getattr(device, p) - getattr(truth, p) for p in ("fx", "fy", "cx", "cy")])
        errors[f"{name}_focal_percent"] = 100 * float(np.abs(off[:2] / [truth.fx, truth.fy]).max())
        errors[f"{name}_principal_px"] = float(np.abs(off[2:]).max())
        in_deviations += (off / getattr(found, f"{name}_deviations")[:4]).tolist()
    off_m = found.baseline_m - true.baseline_m
    errors["baseline_percent"] = 100 * abs(off_m) / true.baseline_m
    in_deviations.append(off_m / found.baseline_deviation_m)
    errors["camera_reprojection_px"] = found.camera_rms_px
    errors["projector_reprojection_px"] = found.projector_rms_px
    return errors, in_deviations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--poses", type=int, default=12)
    args = parser.parse_args()

    every, deviations, misses = [], [], 0
    for seed in args.seeds:
        errors, in_deviations = measure(seed, args.poses)
        missed = [name for name, bar in BARS.items() if errors[name] > bar]
        misses += bool(missed)
        every.append(errors)
        deviations.append(in_deviations)
        print(f"seed {seed}: " + ", ".join(f"{name} {value:.3f}" for name, value in errors.items()))
        print("  in deviations: " + " ".join(f"{value:+.1f}" for value in in_deviations), flush=True)
        if missed:
            print(f"  misses {', '.join(missed)}", flush=True)
    result: dict[str, float] = {"sets": len(every), "misses": misses}
    for name in every[0]:
        values = [errors[name] for errors in every]
        result[f"worst_{name}"] = round(max(values), 4)
        result[f"median_{name}"] = round(float(np.median(values)), 4)
    result["rms_of_errors_in_deviations"] = round(float(np.sqrt(np.mean(np.square(deviations)))), 2)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
