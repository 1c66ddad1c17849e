# SPDX-License-Identifier: Apache-2.0
"""What does a sensor make of an object that moves while it looks? Measures the error on a ball that slides sideways.

Structured light takes one exposure per pattern, so what moves smears; an AMCW camera takes the four taps of a
frequency in one exposure, or one after another if its pixels have but one tap; a flash camera that reads line by line
sees each at its own time, which shears what moves. Direct light only, to leave other errors out. The errors are
against the truth at the middle of each acquisition. The picture has a row per speed and a column per sensor; near is
bright.

Usage: python examples/motion.py [OUT_FOLDER] [--width 160] [--speeds 0 0.1 0.3 1]
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from rangesim import AmcwToF, DirectToF, StructuredLight, decode, expose, load_scene
from rangesim.motion import ConstantTwist, Motion, Timing, transport_moving

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "matte.xml"
BALL = "large_ball"
CAMERAS = {
    "structured light, 120 patterns/s": (StructuredLight(), Timing(frame_period_s=1 / 120)),
    "AMCW, four taps, 3 x 2 ms": (AmcwToF(), Timing(frame_period_s=2e-3)),
    "AMCW, single tap, 12 x 2 ms": (AmcwToF(), Timing(frame_period_s=2e-3, single_tap=True)),
    "dToF read by lines, 120 in 0.1 s": (DirectToF(pulse_fwhm_s=200e-12), Timing(line_period_s=1 / 1200, bands=30)),
}
SPEEDS_M_S = (0.0, 0.1, 0.3, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out/motion"))
    parser.add_argument("--width", type=int, default=160, help="of the camera's images")
    parser.add_argument("--speeds", nargs="+", type=float, default=SPEEDS_M_S, help="of the ball, m/s")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    scene = load_scene(SCENE)
    rig = scene.rig(width=args.width, height=args.width * 3 // 4)
    pictures = []
    for speed in args.speeds:
        print(f"ball at {speed} m/s")
        motion = Motion({BALL: ConstantTwist((speed, 0.0, 0.0))})
        for name, (sensor, timing) in CAMERAS.items():
            # All see the ball at its place in the scene file in the middle of their acquisition
            centred = replace(timing, start_s=-timing.reference_s(sensor, rig.camera))
            signals = transport_moving(scene, rig, {sensor: centred}, motion, spp=8, max_depth=2)[sensor]
            z = decode(expose(signals, sensor)).z
            ball = signals.truth.instance == signals.truth.instance_names.index(BALL)
            error = np.abs(z - signals.truth.z)[ball]
            failed = np.mean(~(error < 0.01))
            print(f"  {name:<33} median error {1e3 * np.nanmedian(error):4.1f} mm, lost or off by 1 cm {failed:4.0%}")
            pictures.append(z)
    # A window around the ball, from 0.7 m (white) to 1.2 m
    quarter = rig.camera.height // 4
    window = np.stack(pictures)[:, quarter : 3 * quarter, : rig.camera.width // 2]
    grid = window.reshape(len(args.speeds), len(CAMERAS), *window.shape[1:])
    z = grid.transpose(0, 2, 1, 3).reshape(len(args.speeds) * 2 * quarter, -1).repeat(2, axis=0).repeat(2, axis=1)
    Image.fromarray(np.uint8(255 * np.clip((1.2 - np.nan_to_num(z, nan=9.0)) / 0.5, 0, 1))).save(args.out / "depth.png")
    print(args.out / "depth.png")


if __name__ == "__main__":
    main()
