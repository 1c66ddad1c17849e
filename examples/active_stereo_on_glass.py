# SPDX-License-Identifier: Apache-2.0
"""A depth camera of the D435's kind looks at glass: what it loses, where it errs, and why.

Two infra-red cameras 50 mm apart, 424 x 240 pixels with the focal length of the D435 at 848 x 480 halved, and a
projector of dots between them. The decoder knows nothing of the dots. Prints completeness and error per material, the
causes of failures, and the difference that the refined matcher makes on the matte background.

Usage: python examples/active_stereo_on_glass.py [SCENE] [--spp 64] [--power-w 0.3] [--out FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from rangesim import (
    ActiveStereo,
    Intrinsics,
    compare,
    decode,
    errors_markdown,
    explain,
    expose,
    failures_markdown,
    load_scene,
    save_capture,
    transport,
)
from rangesim.geometry import DenseMatching
from rangesim.instrument.instrument import Instrument
from rangesim.sensors import StereoDecoder

CAMERA = Intrinsics(424, 240, 213.56, 213.56, 213.7, 117.6)
"""Half of 848 x 480 pixels, fx 427.12, c (426.93, 234.78), as a D435 states them."""
BASELINE_M = 0.05
"""Distance of the cameras of a D435, metres (realsense-ros)."""
STEP_PX = 1 / 32
"""Step of disparities; assumed."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scene", nargs="?", default="glassware")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel")
    parser.add_argument("--power-w", type=float, default=0.3, help="power of the projector, watts")
    parser.add_argument("--out", type=Path, help="folder for the capture of both cameras and the cloud")
    arguments = parser.parse_args()

    scene = load_scene(arguments.scene)
    sensor = ActiveStereo(baseline_m=BASELINE_M)
    device = Instrument("d435-like", sensor, camera=CAMERA, power_w=arguments.power_w)
    signals = transport(scene, device.rigs(scene), [sensor], spp=arguments.spp)  # one pass, two cameras
    capture = expose(signals, sensor, device.detector_in_use)
    image = decode(capture, StereoDecoder(step_px=STEP_PX))
    print(errors_markdown(compare(image, signals)))
    print(failures_markdown(explain(image, capture, signals).fractions(signals.truth)))

    background = signals.truth.classes()["matte"]
    for name, matching in (("refined", DenseMatching()), ("parabola alone", DenseMatching(refine=False))):
        error = decode(capture, StereoDecoder(matching)).z - signals.truth.z
        print(f"background, {name}: median error {1e3 * np.nanmedian(np.abs(error[background])):.2f} mm")
    if arguments.out is not None:
        save_capture(capture, arguments.out / "capture")
        image.to_point_cloud().save(arguments.out / "cloud.ply")


if __name__ == "__main__":
    main()
