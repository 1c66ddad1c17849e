# SPDX-License-Identifier: Apache-2.0
"""How well does a rendered board calibrate a rig, and how far does what is left move depth?

Renders a board in random poses with a known rig, calibrates camera and projector from the images alone, compares with
the truth, then decodes one of the captures with both rigs. Draws a view with the points found, the errors of
reprojection, and the difference of the two depths.

Usage: python examples/calibration.py [OUT.png] [--poses 12] [--width 640]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np

from rangesim import StructuredLight, decode
from rangesim.calibration import Checkerboard, RigCalibration, calibrate_rig, default_rig, render_set


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out/calibration.png"))
    parser.add_argument("--poses", type=int, default=12)
    parser.add_argument("--width", type=int, default=640, help="of the camera's images")
    args = parser.parse_args()

    true = default_rig(args.width, args.width * 3 // 4)
    sensor = StructuredLight(projector_width=800, projector_height=600, axes=("columns", "rows"))
    board = Checkerboard(9, 6, 0.025)
    rendered = render_set(board, true, sensor, args.poses)
    found = calibrate_rig(board, [replace(capture, rig=None) for capture in rendered.captures], coefficients=4)

    print(f"{'':10s}{'true':>10s}{'found':>10s}{'error':>9s}{'deviation':>11s}")
    for name, device, truth, deviations in (
        ("camera", found.rig.camera, true.camera, found.camera_deviations),
        ("projector", found.rig.projector, true.projector, found.projector_deviations),
    ):
        print(name)
        for k, parameter in enumerate(("fx", "fy", "cx", "cy")):
            value, wanted = getattr(device, parameter), getattr(truth, parameter)
            print(f"  {parameter:8s}{wanted:10.2f}{value:10.2f}{value - wanted:9.3f}{deviations[k]:11.3f}")
    baseline = float(np.linalg.norm(true.T_camera_projector[:3, 3]))
    off = 100 * (found.baseline_m / baseline - 1)
    print(
        f"baseline {1e3 * found.baseline_m:.3f} mm, {off:+.3f} %, deviation {1e6 * found.baseline_deviation_m:.0f} um"
    )
    print(f"reprojection {found.camera_rms_px:.3f} px in the camera, {found.projector_rms_px:.3f} px in the projector")

    capture = rendered.captures[0]
    depths = [decode(replace(capture, rig=rig)).z for rig in (true, found.rig)]
    moved = 1e3 * (depths[1] - depths[0])
    print(f"depth moves by {np.nanmedian(moved):+.3f} mm in the median at {np.nanmedian(depths[0]):.2f} m")
    draw(args.out, capture.frames[-2], board.find(capture.frames[-2]).pixels, found, moved)
    print(args.out)


def draw(out: Path, image: np.ndarray, corners: np.ndarray, found: RigCalibration, moved: np.ndarray) -> None:
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 3.6), layout="constrained")
    axes[0].imshow(image, cmap="gray", vmax=np.quantile(image, 0.999))
    axes[0].plot(*(corners - 0.5).T, "+", color="tab:red", markersize=5)
    axes[0].set_title("a view, and the corners found")
    for residuals, name, color in (
        (found.projector_residuals, "projector", "tab:orange"),
        (found.camera_residuals, "camera", "tab:blue"),
    ):
        axes[1].plot(*np.concatenate(residuals).T, ".", markersize=3, color=color, label=name)
    axes[1].set_aspect("equal")
    axes[1].legend(loc="upper right")
    axes[1].set(title="errors of reprojection", xlabel="x / px", ylabel="y / px")
    limit = max(float(np.nanquantile(np.abs(moved), 0.98)), 1e-6)
    shown = axes[2].imshow(moved, cmap="RdBu", vmin=-limit, vmax=limit)
    axes[2].set_title("depth, calibrated less true rig")
    figure.colorbar(shown, ax=axes[2], label="mm")
    for axis in (axes[0], axes[2]):
        axis.set_axis_off()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
