# SPDX-License-Identifier: Apache-2.0
"""Errors of noise-free sensors on scenes without speculars, at full resolution: what light transport and decoders cost.

Prints the median |z error| in millimetres over the valid pixels, per scene and sensor; the last line is JSON. The
AMCW camera sees direct light only (max_depth 2), since multipath is physics, not error of the method.

Usage: python benchmarks/accuracy.py [--width 640] [--height 480] [--spp 64]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from rangesim import AmcwToF, DirectToF, IdealToF, Sensor, StructuredLight, decode, expose, load_scene, transport

SCENES = Path(__file__).resolve().parent.parent / "scenes"
SENSORS: dict[str, tuple[Sensor, float, int]] = {  # sensor, baseline in metres, max_depth
    "structured-light gray-phase": (StructuredLight(), 0.2, 5),
    "ideal-tof": (IdealToF(), 0.03, 5),
    "amcw-tof": (AmcwToF(), 0.03, 2),
    "amcw-tof square": (AmcwToF(waveform="square"), 0.03, 2),
    "direct-tof, 200 ps pulse": (DirectToF(pulse_fwhm_s=200e-12), 0.03, 2),
    "direct-tof, 1 ns pulse": (DirectToF(), 0.03, 2),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("width", 640), ("height", 480), ("spp", 64)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()

    result: dict[str, dict[str, float]] = {}
    for name in ("plane", "matte"):
        scene = load_scene(SCENES / f"{name}.xml")
        result[name] = {}
        for label, (sensor, baseline_m, max_depth) in SENSORS.items():
            rig = scene.rig(baseline_m, width=args.width, height=args.height)
            signals = transport(scene, rig, [sensor], spp=args.spp, max_depth=max_depth)
            image = decode(expose(signals, sensor))
            error_mm = 1e3 * np.abs(image.z - signals.truth.z)
            result[name][label] = round(float(np.nanmedian(error_mm)), 4)
            print(
                f"{name:>6} {label:<28} median |z error| {result[name][label]:.4f} mm, {image.valid.mean():.1%} valid"
            )
    print(json.dumps(result))


if __name__ == "__main__":
    main()
