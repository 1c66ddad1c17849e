# SPDX-License-Identifier: Apache-2.0
"""A LiDAR on the roof of a car that drives along a street: one turn in one light-transport pass, raw and de-skewed.

Each ray has its own place, time and beam. The scanner reports its points as if it had stood still: at 15 m/s the street
is stretched by 1.5 m within a turn of 0.1 s. De-skewing puts the points where they are. `benchmarks/lidar_turn.py`
compares the time of a turn with that of a camera at rest.

Usage: python examples/driving_lidar.py [OUT.png] [--rings 64] [--columns 1024] [--speed 15] [--spp 16]
"""

from __future__ import annotations

import argparse
import base64
import io
import time
from pathlib import Path

import matplotlib as mpl
import numpy as np

from rangesim import DirectToF, Rig, Signals, decode, expose, load_scene, transport
from rangesim.motion import ConstantTwist, as_reported, deskewed, moving_scanner
from rangesim.point_cloud import PointCloud
from rangesim.report.figures import unrolled
from rangesim.rig import Beam, Spinning

DIVERGENCE_RAD = (3e-3, 3e-3)
"""Full divergence of the beams, 1/e^2; 1 to 3 mrad are common."""
SENSOR = DirectToF(bins=512, bin_s=1e-9, pulse_fwhm_s=4e-9, laser="single-shot")
"""Histograms that reach 77 m."""
HOUSES_X_M = {"the house ahead": 60.0, "the house behind": -60.0}
"""Houses across the ends of the street: their fronts are planes at these x, metres, world."""
GROUND_M = 0.3
"""Height in metres up to which points count as the ground in the picture."""


def off_front(cloud: PointCloud, front_x_m: float) -> np.ndarray:
    """Distances of points from the plane of a house's front, metres."""
    x, y, z = np.moveaxis(cloud.finite().points.astype(np.float64), -1, 0)
    near = (np.abs(x - front_x_m) < 2.0) & (np.abs(y - 0.5) < 3.0) & (z > 0.5)
    return np.asarray(x[near] - front_x_m)


def picture(path: Path, ranges: np.ndarray, directions: np.ndarray, clouds: dict[str, PointCloud]) -> None:
    """The turn unrolled, and clouds seen from above, one on the other."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    turn = unrolled(ranges, directions)
    pixels = plt.imread(io.BytesIO(base64.b64decode(turn.uri.partition(",")[2])))
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(11, 10), layout="constrained")
    top.imshow(pixels, interpolation="nearest")
    top.set_title(turn.caption, fontsize=10)
    top.axis("off")
    for (name, cloud), color in zip(clouds.items(), ("#e8590c", "#1c7ed6"), strict=True):
        points = cloud.finite().points
        above = points[(points[:, 2] > GROUND_M) & (points[:, 2] < 3.0)]
        bottom.scatter(above[:, 0], above[:, 1], s=2, c=color, linewidths=0, label=name)
    bottom.set(xlim=(-21, 29), ylim=(-13, 11), aspect="equal", title="Seen from above, metres")
    bottom.legend(markerscale=5, loc="lower right")
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", nargs="?", type=Path, help="picture to write")
    parser.add_argument("--rings", type=int, default=64)
    parser.add_argument("--columns", type=int, default=1024)
    parser.add_argument("--speed", type=float, default=15.0, help="metres per second")
    parser.add_argument("--spp", type=int, default=16, help="light paths per ray")
    arguments = parser.parse_args()

    scene = load_scene("street")
    elevations = tuple(np.linspace(22.5, -22.5, arguments.rings).tolist())
    head = Spinning(
        elevations, arguments.columns, period_s=0.1, first_azimuth_deg=-180.0, field_rad=DIVERGENCE_RAD,
        acceptance="gaussian",
    )  # fmt: skip
    still = Rig(head, Beam(DIVERGENCE_RAD), scene.T_world_camera)
    drive = ConstantTwist(velocity_m_s=(arguments.speed, 0.0, 0.0))
    moving = moving_scanner(still, drive)

    def trace(rig: Rig) -> Signals:
        return transport(scene, rig, [SENSOR], spp=arguments.spp, max_depth=3)

    start = time.perf_counter()
    signals = trace(moving)
    seconds = time.perf_counter() - start
    image = decode(expose(signals, SENSOR))
    straight = image.to_point_cloud("world")
    raw = as_reported(image).to_point_cloud("world")
    again = deskewed(raw, drive)
    error = float(np.nanmax(np.abs(again.points - straight.points)))
    print(f"{arguments.rings} x {arguments.columns} rays at {arguments.speed:g} m/s: {seconds:.1f} s in one pass")
    print(
        f"{image.valid.mean():.0%} of the rays have a reading; a raw cloud, de-skewed, is off by {1e6 * error:.0f} um"
    )
    standing = decode(expose(trace(still), SENSOR)).to_point_cloud("world")
    for name, cloud in (("standing", standing), ("driving, raw", raw), ("driving, de-skewed", straight)):
        for house, front_x_m in HOUSES_X_M.items():
            off = off_front(cloud, front_x_m)
            print(f"{name}: {house} is off by {1e3 * off.mean():+.1f} mm, spread {1e3 * off.std():.1f} mm")
    if arguments.out:
        picture(
            arguments.out, image.range_m, head.rays.directions, {"as the scanner reports": raw, "de-skewed": straight}
        )
        print(f"wrote {arguments.out}")


if __name__ == "__main__":
    main()
