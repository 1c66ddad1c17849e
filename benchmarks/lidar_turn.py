# SPDX-License-Identifier: Apache-2.0
"""One turn of a 64 x 1024 LiDAR in a moving car, in one pass, beside a still pinhole pass of as many pixels.

Both passes trace the same street with the same number of samples per pixel and the same depth, in this process, after
warm-up, in turns. The scanner has a ray, a place and a beam of its own for each pixel. The last line is JSON:

    turn_s            one turn, moving (median)
    pinhole_s         a still pass of a pinhole camera with a time-of-flight lamp, as many pixels (median)
    ratio             turn_s / pinhole_s
    wall_error_mm     median of (measured - true) over the readings on one house wall, without the detector's noise
    wall_spread_mm    median absolute deviation there
    deskewed_error_mm median distance of the de-skewed cloud from the true surfaces along the rays, in the world
    still_error_mm    the same of a scanner that stands still
    skewed_error_mm   the same of the cloud as the scanner reports it, which ignores its motion

Usage: python benchmarks/lidar_turn.py [--spp 16] [--speed 15] [--rounds 5]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rangesim import Beam, DirectToF, Intrinsics, Rig, Spinning, decode, expose, load_scene, transport
from rangesim.decoding.range_image import RangeImage
from rangesim.motion import ConstantTwist, as_reported, moving_scanner
from rangesim.signals import Signals

STREET = Path(__file__).resolve().parent.parent / "scenes" / "street.xml"
RINGS, COLUMNS = 64, 1024
FIELD_RAD = (3e-3, 3e-3)
"""Field of each ray and divergence of its beam, radians: 0.18 degrees, that of an Ouster OS1."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--speed", type=float, default=15.0, help="metres per second")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()

    scene = load_scene(STREET)
    head = Spinning(
        tuple(np.linspace(16.6, -16.6, RINGS)), COLUMNS, 0.1, origin_m=(0.0, 0.0, 0.015806), field_rad=FIELD_RAD
    )
    sensor = DirectToF(bins=800, bin_s=1e-9, pulse_fwhm_s=4e-9, laser="single-shot")
    pose = scene.rig().T_world_camera
    still = Rig(head, Beam(FIELD_RAD), pose)
    # Forward, which is the scanner's azimuth 0
    moving = moving_scanner(still, ConstantTwist(velocity_m_s=tuple((args.speed * pose[:3, 2]).tolist())))
    pinhole = scene.rig(0.03, (256, 256), camera=Intrinsics.from_fov(COLUMNS, RINGS, 90.0))
    options: dict[str, Any] = {"spp": args.spp, "max_depth": 5, "glint": False, "caustics": False}

    took: dict[str, list[float]] = {"turn": [], "pinhole": []}
    for number in range(args.rounds + 1):
        for name, rig in (("turn", moving), ("pinhole", pinhole)):
            begin = time.perf_counter()
            signals = transport(scene, rig, [sensor], seed=number, **options)
            if number:  # the first compiles
                took[name].append(time.perf_counter() - begin)
            if name == "turn":
                turn = signals
    seconds = {name: float(np.median(values)) for name, values in took.items()}
    print(f"{RINGS} x {COLUMNS} rays, {args.spp} samples each; load {os.getloadavg()[0]:.1f}")

    image = decode(expose(turn, sensor, None))
    unmoved = transport(scene, still, [sensor], seed=1, **options)
    error = image.range_m - turn.truth.range_m
    wall = _largest_house(turn)
    on_wall = error[wall & image.valid]
    print(f"wall of {turn.truth.instance_names[int(turn.truth.instance[wall][0])]}: {on_wall.size} readings")
    results = {
        **{f"{name}_s": round(value, 3) for name, value in seconds.items()},
        "ratio": round(seconds["turn"] / seconds["pinhole"], 3),
        "wall_error_mm": round(1e3 * float(np.median(on_wall)), 3),
        "wall_spread_mm": round(1e3 * float(np.median(np.abs(on_wall - np.median(on_wall)))), 3),
        "deskewed_error_mm": round(1e3 * _away(image, turn), 3),
        "still_error_mm": round(1e3 * _away(decode(expose(unmoved, sensor, None)), unmoved), 3),
        "skewed_error_mm": round(1e3 * _away(as_reported(image), turn), 3),
    }
    print(json.dumps(results))


def _largest_house(signals: Signals) -> np.ndarray:
    """(h, w) bool, the pixels of the house that most rays meet."""
    truth = signals.truth
    houses = [i for i, name in enumerate(truth.instance_names) if "house" in name]
    counts = [int((truth.instance == i).sum()) for i in houses]
    return np.asarray(truth.instance == houses[int(np.argmax(counts))])


def _away(image: RangeImage, signals: Signals) -> float:
    """Median distance, metres, of measured points in the world from the true ones, on matte surfaces."""
    truth = signals.truth
    matte = truth.material == truth.material_names.index("matte")
    exact = _true_points(image, signals)
    distance = np.linalg.norm(image.to_point_cloud("world").points - exact, axis=-1)
    return float(np.median(distance[image.valid & matte]))


def _true_points(image: RangeImage, signals: Signals) -> np.ndarray:
    """(h, w, 3) true points in the world, where the rays of the pass met them."""
    camera = signals.rig.camera
    perfect = replace(image, camera=camera, z=signals.truth.z, range_m=signals.truth.range_m)
    return np.asarray(perfect.to_point_cloud("world").points)


if __name__ == "__main__":
    main()
