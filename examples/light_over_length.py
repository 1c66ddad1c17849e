# SPDX-License-Identifier: Apache-2.0
"""When does the light of each kind arrive? Plots one pixel in a corner, and one beneath a glass ball, over path length.

In the corner, light by way of the other wall arrives after the direct light, and an AMCW camera, which sees but one
phase, reads the mean of both: too far. Under the ball the light arrives through the glass.

Usage: python examples/light_over_length.py [OUT.png] [--spp 4096]
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from rangesim import AmcwToF, decode, expose, load_scene, transport
from rangesim.response import KINDS, LengthSplit

SCENES = Path(__file__).resolve().parent.parent / "scenes"
PIXELS = {"corner": (10, 15), "tabletop": (15, 20)}
"""(row, column) in an image of 40 x 30 pixels."""
FAINTEST = 1e-4
"""Lower end of the scale, as a fraction of the brightest bin."""
COLORS = ("#1b2330", "#963246", "#e97c01", "#d44197", "#c9b000")
"""Of the kinds of light, as in the cause map of the report."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out/light_over_length.png"))
    parser.add_argument("--spp", type=int, default=4096, help="paths of a pixel")
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    for axis, (name, (row, column)) in zip(axes, PIXELS.items(), strict=True):
        scene, sensor = load_scene(SCENES / f"{name}.xml"), AmcwToF((20e6,))
        split = LengthSplit(start_m=0.0, width_m=0.04, bins=250)
        signals = transport(scene, scene.rig(0.03, width=40, height=30), [sensor, split], spp=args.spp, max_depth=8)
        light = signals.channels[split][:, row, column].reshape(len(KINDS), split.bins)
        first = np.flatnonzero(light.sum(axis=0))[0]
        shown = slice(max(0, first - 5), first + 45)
        length = split.start_m + split.width_m * (np.arange(split.bins)[shown] + 0.5)
        floor = FAINTEST * light.max()
        print(f"{name}, pixel ({column}, {row}):")
        for kind, values, color in zip(KINDS, light, COLORS, strict=True):
            if values.any():
                axis.step(length, np.maximum(values, floor)[shown], where="mid", color=color, label=kind)
                mean = (values * (np.arange(split.bins) + 0.5) * split.width_m).sum() / values.sum()
                print(f"  {kind:<10} {values.sum() / light.sum():6.1%} of the light, mean path length {mean:.3f} m")
        error = (decode(expose(signals, sensor)).range_m - signals.truth.range_m)[row, column]
        print(f"  AMCW camera at 20 MHz: error of range {1e3 * error:+.1f} mm")
        axis.set(title=f"{name}, pixel ({column}, {row})", xlabel="path length, m", ylabel="W/m²/sr", yscale="log")
        axis.legend(frameon=False)
    figure.savefig(args.out, dpi=120)
    print(args.out)


if __name__ == "__main__":
    main()
