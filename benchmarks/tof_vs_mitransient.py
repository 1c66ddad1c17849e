# SPDX-License-Identifier: Apache-2.0
"""The photon histogram of one pass against mitransient's: same bins, at what cost?

Needs the `bench` extra (mitransient 1.3.1). Same scene, camera, projector, bins, samples per pixel and path
depth, in this process, after warm-up, in turns. The last line printed is JSON:

    time_ratio      one pass over mitransient's render (medians)
    max_abs_z       largest |z| over the bins; z = mean difference over the image, over its standard error
    bins            number of bins that hold light
    sum_error       largest difference between the sum of a pixel's bins and its white image, over the brightest pixel
    steady_z        z of the white images

Usage: python benchmarks/tof_vs_mitransient.py [SCENE] [--width 256] [--height 256] [--spp 64] [--max-depth 5]
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from plain_mitsuba import plain_scene, timed, z_score

from rangesim import load_scene, transport
from rangesim.response import TransientHistogram

SCENES = Path(__file__).resolve().parent.parent / "scenes"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default=str(SCENES / "corner.xml"))
    for name, default in (("width", 256), ("height", 256), ("spp", 64), ("max-depth", 5), ("runs", 7)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()

    scene = load_scene(args.scene)
    import mitransient  # noqa: F401  (registers its plugins with Mitsuba)
    import mitsuba as mi

    rig = scene.rig(width=args.width, height=args.height)
    bins = TransientHistogram(start_m=0.0, width_m=0.04, channels=300)
    film = {
        "type": "transient_hdr_film",
        "start_opl": bins.start_m,
        "bin_width_opl": bins.width_m,
        "temporal_bins": bins.channels,
    }
    plain = plain_scene(scene, rig, film)
    integrator = mi.load_dict({"type": "transient_path", "max_depth": args.max_depth, "rr_depth": 5})

    def theirs(seed: int) -> tuple[np.ndarray, np.ndarray]:
        white, transient = mi.render(plain, integrator=integrator, spp=args.spp, seed=seed)
        return np.array(white).squeeze(), np.moveaxis(np.array(transient).squeeze(), -1, 0)

    def ours(seed: int) -> Any:
        alike = {"indirect": "raw", "sampling_error": False}  # neither is part of what mitransient does
        return transport(scene, rig, [bins], spp=args.spp, max_depth=args.max_depth, seed=seed, **alike)  # type: ignore[arg-type]

    ours(0), theirs(0)
    ours_s, theirs_s = [], []
    for run in range(1, args.runs + 1):
        signals, a = timed(partial(ours, run))
        (white, histogram), b = timed(partial(theirs, run))
        ours_s.append(a), theirs_s.append(b)
        print(f"run {run}: one pass {a:.2f} s, mitransient {b:.2f} s")

    mine = signals.channels[bins]
    # A bin needs enough lit pixels for its mean to be about normal
    scores = {b: z_score(mine[b], histogram[b]) for b in range(bins.channels) if (histogram[b] > 0).mean() > 0.01}
    for b, z in scores.items():
        print(f"bin {b:3d}: mean {mine[b].mean():.3e}, mitransient {histogram[b].mean():.3e}, z {z:+.2f}")
    projector = signals.energy.projector
    result = {
        "time_ratio": round(float(np.median(ours_s) / np.median(theirs_s)), 3),
        "max_abs_z": round(max(map(abs, scores.values())), 2),
        "bins": len(scores),
        "sum_error": float(np.abs(mine.sum(axis=0) - projector).max() / projector.max()),
        "steady_z": round(z_score(projector, white), 2),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
