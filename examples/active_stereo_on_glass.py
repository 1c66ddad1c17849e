# SPDX-License-Identifier: Apache-2.0
"""A RealSense D435 looks at glass: what it loses, where it errs, and why.

The device comes by name (`rangesim presets`): two infra-red cameras 50 mm apart, a projector of dots between them, and
a decoder that knows nothing of the dots. Its images are made at half of their 848 x 480 pixels, so that a run takes one
minute. Prints completeness and error per material, the causes of failures, and what the refinement of disparities
gains on the matte background.

Usage: python examples/active_stereo_on_glass.py [SCENE] [--device d435] [--scale 0.5] [--spp 64] [--out FOLDER]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesim import (
    Intrinsics,
    compare,
    decode,
    errors_markdown,
    explain,
    expose,
    failures_markdown,
    load_scene,
    presets,
    save_capture,
    transport,
)
from rangesim.geometry import DenseMatching
from rangesim.instrument.instrument import Instrument
from rangesim.sensors import StereoDecoder


def scaled(device: Instrument, scale: float) -> Instrument:
    """The device with fewer pixels over the same field of view."""
    camera = device.camera
    assert isinstance(camera, Intrinsics)
    return replace(device, camera=camera.resized(round(scale * camera.width), round(scale * camera.height)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scene", nargs="?", default="glassware")
    parser.add_argument("--device", choices=("d435", "d415"), default="d435")
    parser.add_argument("--scale", type=float, default=0.5, help="fraction of the device's pixels across and down")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel")
    parser.add_argument("--out", type=Path, help="folder for the capture of both cameras and the cloud")
    arguments = parser.parse_args()

    scene, device = load_scene(arguments.scene), scaled(presets.load(arguments.device), arguments.scale)
    signals = transport(scene, device.rigs(scene), [device.sensor], spp=arguments.spp)  # one pass, two cameras
    capture = expose(signals, device.sensor, device.detector_in_use, device.exposure_s)
    image = decode(capture, device.decoder)
    print(errors_markdown(compare(image, signals)))
    print(failures_markdown(explain(image, capture, signals).fractions(signals.truth)))

    background = signals.truth.classes()["matte"]
    for name, matching in (("refined", DenseMatching()), ("not refined", DenseMatching(refine=False))):
        error = decode(capture, StereoDecoder(matching)).z - signals.truth.z
        print(f"background, {name}: median error {1e3 * np.nanmedian(np.abs(error[background])):.2f} mm")
    if arguments.out is not None:
        save_capture(capture, arguments.out / "capture")
        image.to_point_cloud().save(arguments.out / "cloud.ply")


if __name__ == "__main__":
    main()
