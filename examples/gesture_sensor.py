# SPDX-License-Identifier: Apache-2.0
"""A hand swipes over a multi-zone sensor: 8 x 8 zones, several returns in each, and a cover glass in front.

The sensor is like an ST VL53L5CX: 8 x 8 zones over 45 x 45 degrees, 940 nm, 60 images a second. Its pulse, its bins and
its light are not published; those here are assumed. A zone is traced as 8 x 8 pixels, and their light is added up
before it is counted. Where a zone sees fingers and the wall behind them, its histogram has a peak for each.

The script prints where the zones see the hand, and plots one image: the zones' first, strongest and last returns, and
the histogram of a zone over the edge of the hand.

Usage: python examples/gesture_sensor.py [OUT.png] [--spp 64] [--places 5]
"""

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from rangesim import (
    CoverGlass,
    DirectToF,
    Intrinsics,
    Rig,
    Scene,
    SpadDetector,
    Status,
    Zones,
    decode,
    expose,
    load_scene,
    look_at,
    transport,
)
from rangesim.environment.backend import select_variant
from rangesim.response import SPEED_OF_LIGHT
from rangesim.sensors import DirectToFDecoder

ZONES = 8
"""Number of zones along an axis, as in the device."""
FINE = 8
"""Number of pixels of the traced camera along an axis of a zone, so that a finger is five pixels wide."""
HAND_M = 0.25
"""Distance of the hand, metres."""
WALL_M = 0.6
"""Distance of the wall, metres: so far behind the hand that a pulse, which is 0.075 m wide, splits in two returns."""
SENSOR = DirectToF(bins=80, bin_s=125e-12, start_s=-1e-9, pulse_fwhm_s=500e-12)
"""The sensor. Its first eight bins precede the pulse, so that the peak of the cover glass is whole."""
DETECTOR = SpadDetector(wavelength_m=940e-9, spads=16, dark_counts_hz=2e4, bits=16)
DECODER = DirectToFDecoder(reading="first", max_returns=2, min_range_m=0.06)
EXPOSURE_S = 2e-3


def hand(x: float, z: float) -> dict:
    """Shapes of an open hand at (x, 0, z), metres, whose fingers point upwards (against y)."""
    import mitsuba as mi

    at, skin = mi.ScalarTransform4f(), {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.6}}
    palm = at.translate([x, 0.035, z]).scale([0.042, 0.045, 0.012])
    shapes = {"palm": {"type": "cube", "to_world": palm, "bsdf": skin}}
    for name, root_x, root_y, length, turn_deg in (
        ("thumb", -0.040, 0.040, 0.060, -50), ("index", -0.033, -0.008, 0.070, -9),
        ("middle", -0.011, -0.010, 0.078, -3), ("ring", 0.011, -0.010, 0.072, 4), ("little", 0.033, -0.006, 0.056, 13),
    ):  # fmt: skip
        root = np.array([x + root_x, root_y, z])
        tip = root + length * np.array([np.sin(np.radians(turn_deg)), -np.cos(np.radians(turn_deg)), 0.0])
        bone = {"p0": root.tolist(), "p1": tip.tolist(), "radius": 0.009}
        shapes[name] = {"type": "cylinder", **bone, "bsdf": skin}
        shapes[f"{name}_tip"] = {"type": "sphere", "center": tip.tolist(), "radius": 0.009, "bsdf": skin}
    return shapes


def scene_with_hand(x: float) -> Scene:
    select_variant()
    import mitsuba as mi

    at = mi.ScalarTransform4f()
    matte = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.7}}
    wall = {"type": "rectangle", "to_world": at.translate([0, 0, WALL_M]).scale([1, 1, -1]), "bsdf": matte}
    camera = {"type": "perspective", "fov": 45.0, "to_world": at.look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])}
    return load_scene({"type": "scene", "sensor": camera, "wall": wall, **hand(x, HAND_M)})


def device() -> Rig:
    """The sensor at the origin, looking along z; the emitter stands 4 mm beside it and lights 50 degrees."""
    zones = Zones(Intrinsics.from_fov(ZONES * FINE, ZONES * FINE, 45.0), ZONES, ZONES, blur_px=0.1 * FINE)
    return Rig(
        zones,
        Intrinsics.from_fov(64, 64, 50.0),
        look_at((0, 0, 0), (0, 0, 1), (0, -1, 0)),
        look_at((0.004, 0, 0), (0.004, 0, 1), (0, -1, 0)),
        projector_power_w=2e-3,
        cover_glass=CoverGlass(fraction=3e-9, path_m=0.006),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out/gesture_sensor.png"))
    parser.add_argument("--spp", type=int, default=64, help="paths of a traced pixel")
    parser.add_argument("--places", type=int, default=5, help="places of the hand on its way")
    args = parser.parse_args()
    rig = device()
    print("hand at x  zones that see it  they say x  their median range")
    for number, x in enumerate(np.linspace(-0.08, 0.08, args.places)):
        scene = scene_with_hand(float(x))
        signals = transport(scene, rig, [SENSOR], spp=args.spp)
        capture = expose(signals, SENSOR, DETECTOR, EXPOSURE_S, seed=number)
        image = decode(capture, DECODER)
        sees = image.range_m < (HAND_M + WALL_M) / 2
        points = image.to_point_cloud().points[sees]
        seen = f"{np.median(points[:, 0]):+10.3f}  {np.median(image.range_m[sees]):.3f}" if sees.any() else ""
        print(f"{x:+9.3f}  {sees.sum():17d}  {seen}")
        if number == args.places // 2:
            fine = transport(scene, rig.traced, [], spp=args.spp).energy.direct
            middle = fine, signals.truth.nearest_m, capture, image
    plot(*middle, args.out)
    print(args.out)


def plot(fine, nearest_m, capture, image, out: Path) -> None:
    ranges = np.where(image.returns.status == Status.OK, image.returns.range_m, np.nan)
    strongest = decode(capture, replace(DECODER, reading="strongest"))
    figure, axes = plt.subplots(1, 6, figsize=(16, 2.9), layout="constrained", width_ratios=(1, 1, 1, 1, 1, 1.7))
    axes[0].imshow(fine ** (1 / 2.2), cmap="gray")
    axes[0].set(title="what is traced", xticks=[], yticks=[])
    titles = ("nearest surface in a zone", "first return", "strongest return", "last return")
    images = (nearest_m, np.nanmin(ranges, axis=0), strongest.range_m, np.nanmax(ranges, axis=0))
    for axis, title, values in zip(axes[1:], titles, images, strict=False):
        shown = axis.imshow(values, vmin=0.2, vmax=0.65, cmap="viridis_r")
        axis.set(title=title, xticks=[], yticks=[])
    figure.colorbar(shown, ax=axes[:5], label="range, m", shrink=0.8)
    weaker = np.where(image.returns.number == 2, np.nan_to_num(np.sort(image.returns.strength, axis=0)[-2]), 0)
    row, column = np.unravel_index(weaker.argmax(), weaker.shape)
    axes[2].add_patch(plt.Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, color="#e97c01", lw=2))
    at_m = 0.5 * SPEED_OF_LIGHT * (SENSOR.start_s + SENSOR.bin_s * (np.arange(SENSOR.bins) + 0.5))
    axes[5].step(at_m, capture.frames[:, row, column], where="mid", color="#1b2330")
    for range_m, status in zip(
        image.returns.range_m[:, row, column], image.returns.status[:, row, column], strict=True
    ):
        if np.isfinite(range_m):
            axes[5].axvline(range_m, color="#963246" if status else "#e97c01", lw=1)
    axes[5].set(title=f"zone ({column}, {row})", xlabel="half of the path length, m", ylabel="counts", yscale="log")
    axes[5].set(xlim=(-0.15, 1.0))
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
