# SPDX-License-Identifier: Apache-2.0
"""How far off is a time-of-flight camera by its waveform and its pixels, and what does calibration leave?

Renders a board at many distances with a camera of square waves, read by the formula for sines, so that it wiggles; the
electronics of each pixel add a delay. The board is found in the camera's own images, which gives its true range, and
`calibrate_tof` takes wiggling and delays off. Judged on walls that the calibration has not seen, against the truth.

Usage: python examples/tof_calibration.py [OUT.png] [--targets 20] [--width 160]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from scipy.spatial.transform import Rotation

import rangesim
from rangesim import AmcwToF, Capture, Intrinsics, RangeImage, Rig
from rangesim.calibration import Checkerboard, ToFCalibration, calibrate_tof, find_board_ranges
from rangesim.response import SPEED_OF_LIGHT, Phasor, Response
from rangesim.signals import StillSignals

BOARD = Checkerboard(6, 5, 0.12)
SENSOR = AmcwToF((20e6, 80e6), waveform="square")


def rig(width: int) -> Rig:
    """A camera with the lamp 3 cm beside it."""
    camera = Intrinsics.from_fov(width, width * 3 // 4, 45.0)
    T_camera_lamp = np.eye(4)
    T_camera_lamp[0, 3] = 0.03
    return Rig(replace(camera, distortion=(-0.08, 0.02)), Intrinsics.from_fov(64, 48, 60.0), np.eye(4), T_camera_lamp)


def delays(camera: Intrinsics) -> np.ndarray:
    """(h, w) metres of path that the pixels' electronics add: a gradient along the rows, columns of their own,
    scatter."""
    random = np.random.default_rng(7)
    along = np.linspace(0.0, 0.04, camera.width)
    columns = random.normal(0.0, 0.004, camera.width)
    return np.asarray(0.02 + along + columns + random.normal(0.0, 0.004, (camera.height, camera.width)))


def photograph(rig: Rig, T_camera_board: np.ndarray, delay_m: np.ndarray, seed: int) -> tuple[Capture, np.ndarray]:
    """A capture of the board by pixels with delays, and the true range."""
    scene = rangesim.load_scene(BOARD.scene(T_camera_board, rig.camera.width, rig.camera.height))
    signals = rangesim.transport(scene, rig, [SENSOR], spp=16, seed=seed)
    late = replace(signals, channels={r: later(c, r, signals, delay_m) for r, c in signals.channels.items()})
    capture = rangesim.expose(late, SENSOR, SENSOR.default_detector, seed=seed)
    return capture, signals.truth.range_m.astype(np.float64)


def later(channels: np.ndarray, response: Response, signals: StillSignals, delay_m: np.ndarray) -> np.ndarray:
    """(2, h, w) correlations of light that comes by one way, `delay_m` (h, w) later: triangle waves, a quarter of a
    period apart, read at another place."""
    assert isinstance(response, Phasor)
    light = signals.energy.projector
    cosine, sine = channels / np.maximum(light, 1e-12)
    quarter = np.clip(sine / np.maximum(np.abs(cosine) + np.abs(sine), 1e-12), -1.0, 1.0)
    phase = 0.25 * np.where(cosine >= 0, quarter, 2.0 - quarter) + delay_m * response.modulation_hz / SPEED_OF_LIGHT
    waves = [light * (4.0 * np.abs(p - np.floor(p) - 0.5) - 1.0) for p in (phase, phase - 0.25)]
    return np.stack(waves).astype(np.float32)


def pose(turn_deg: tuple[float, float, float], z_m: float) -> np.ndarray:
    """T_camera_board with the middle of the points on the optical axis."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    T[:3, 3] = [0.0, 0.0, z_m] - T[:3, :3] @ BOARD.points.mean(axis=0)
    return T


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out/tof_calibration.png"))
    parser.add_argument("--targets", type=int, default=20)
    parser.add_argument("--width", type=int, default=160, help="of the camera's images")
    args = parser.parse_args()

    camera_and_lamp = rig(args.width)
    delay = delays(camera_and_lamp.camera)
    random = np.random.default_rng(0)
    captures, true = [], []
    for k, z in enumerate(np.linspace(1.1, 2.0, args.targets)):
        turn = tuple(random.uniform(-6.0, 6.0, 3))
        capture, truth = photograph(camera_and_lamp, pose(turn, z), delay, k)  # type: ignore[arg-type]
        captures.append(capture)
        true.append(truth)
    found = find_board_ranges(BOARD, captures)
    off = np.concatenate([(a - b)[np.isfinite(a)] for a, b in zip(found, true, strict=True)])
    print(f"range of the boards by their corners: off by {1e3 * np.nanstd(off):.2f} mm")
    calibration = calibrate_tof(captures, found)
    calibration.save(args.out.with_suffix(".npz"))

    readings = []
    for k, z in enumerate(np.linspace(1.15, 1.9, 9)):
        capture, truth = photograph(camera_and_lamp, pose((3.0, -4.0, 90.0), z), delay, 100 + k)
        image = calibration.decoder.decode(capture)
        readings.append((image, calibration.correct(image), truth))
    both = [corrected.valid & np.isfinite(truth) for _, corrected, truth in readings]
    for name, which in (("as read", 0), ("calibrated", 1)):
        off_each = [1e3 * (r[which].range_m - r[2])[seen] for r, seen in zip(readings, both, strict=True)]
        errors, targets = np.concatenate(off_each), [float(np.median(e)) for e in off_each]
        print(
            f"{name:10s}  error of range: mean {errors.mean():+7.2f} mm, deviation {errors.std():6.2f} mm; medians of "
            f"targets {min(targets):+.2f} to {max(targets):+.2f} mm"
        )
    print(f"noise of a reading {500 * calibration.noise_m:.2f} mm")
    got = calibration.offset_m - delay
    print(f"delays: off by {500 * np.nanstd(got):.2f} mm of range, of {500 * np.std(delay):.2f} mm")
    draw(args.out, calibration, readings)
    print(args.out)


def draw(
    out: Path,
    calibration: ToFCalibration,
    readings: list[tuple[RangeImage, RangeImage, np.ndarray]],
) -> None:
    """The wiggling found, the delays found, the errors before and after."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 3.6), layout="constrained")
    length = np.linspace(calibration.shortest_m, calibration.longest_m, 600)
    axes[0].plot(length / 2, 500 * calibration.wiggling_m(length), color="tab:blue")
    axes[0].set(title="wiggling found", xlabel="half the path length / m", ylabel="mm of range")
    shown = axes[1].imshow(500 * calibration.offset_m, cmap="viridis")
    axes[1].set_title("offset of each pixel found")
    axes[1].set_axis_off()
    figure.colorbar(shown, ax=axes[1], label="mm of range")
    for which, name, color in ((0, "as read", "tab:orange"), (1, "calibrated", "tab:blue")):
        errors = [1e3 * (r[which].range_m - r[2])[r[1].valid] for r in readings]
        where = [float(np.nanmedian(r[2][r[1].valid])) for r in readings]
        middle, scatter = ([float(f(e)) for e in errors] for f in (np.nanmean, np.nanstd))
        axes[2].errorbar(where, middle, scatter, fmt="o", color=color, label=name, capsize=2)
    axes[2].axhline(0.0, color="0.6", linewidth=0.8)
    axes[2].legend()
    axes[2].set(title="error on other targets: mean, deviation", xlabel="range / m", ylabel="mm")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
