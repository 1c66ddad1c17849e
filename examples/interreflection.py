# SPDX-License-Identifier: Apache-2.0
"""How far off is a time-of-flight camera in a corner? Measures the bias by the number of bounces.

Light that bounces between two walls arrives late, and an AMCW camera averages it into its phase. A dToF sensor,
which takes the strongest peak of a histogram, hardly notices.

Usage: python examples/interreflection.py
"""

import warnings
from pathlib import Path

import numpy as np

from rangesim import AmcwToF, DirectToF, decode, expose, load_scene, transport
from rangesim.errors import TruncationWarning

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "corner.xml"


def main() -> None:
    scene = load_scene(SCENE)
    rig = scene.rig(baseline_m=0.03, width=160, height=120)
    sensors = {"AMCW, 20 MHz": AmcwToF((20e6,)), "dToF, 100 ps bins": DirectToF(pulse_fwhm_s=200e-12)}
    warnings.simplefilter("ignore", TruncationWarning)  # light is left out on purpose
    for max_depth in (2, 3, 6):
        signals = transport(scene, rig, list(sensors.values()), spp=64, max_depth=max_depth)
        for name, sensor in sensors.items():
            error = decode(expose(signals, sensor)).range_m - signals.truth.range_m
            print(f"{max_depth - 2} bounces, {name:<18} median range error {1e3 * np.nanmedian(error):+.1f} mm")


if __name__ == "__main__":
    main()
