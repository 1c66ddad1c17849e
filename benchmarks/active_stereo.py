# SPDX-License-Identifier: Apache-2.0
"""Stereo with dots: planes, a table, a white wall, glass and sunlight, and a real pair of infra-red images.

Cameras 50 mm apart, a projector of some 7000 dots between them, 320 x 240 pixels. Each case says how many of the lit
pixels have a reading, how far the readings are off, and why the others fail. The real pair (848 x 480, a box, a book
and a bottle on a carpet, from angli66/simsense) has no truth: the carpet must be a plane in it, things must stand on
that plane, and OpenCV's matcher must agree. The last line is JSON:

    planar_px            root mean square error of disparities on a fronto-parallel plane, without noise of the detector
    tabletop_complete    fraction of the lit pixels of the tabletop with a reading
    tabletop_median_mm   median |z error| there

Usage: python benchmarks/active_stereo.py [--data ../shared/data/simsense] [--width 320] [--spp 64] [--picture FILE.png]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from rebuilt_scene import largest_plane
from scipy.ndimage import label

from rangesim import (
    ActiveStereo,
    Ambient,
    Capture,
    CaptureSet,
    Intrinsics,
    RangeImage,
    Rig,
    compare,
    decode,
    explain,
    expose,
    load_scene,
    transport,
)
from rangesim.geometry import DenseMatching, match_rows
from rangesim.instrument.instrument import Instrument
from rangesim.rig import translation
from rangesim.sensors import ReferencePatternStereo, Sensor, StereoDecoder
from rangesim.signals import Signals

ACTIVE, PASSIVE, REFERENCE = ActiveStereo(), ActiveStereo(pattern=None), ReferencePatternStereo()
MATCHERS = {
    "census, semi-global": DenseMatching(),
    "ZNCC, semi-global": DenseMatching("zncc"),
    "census, local": DenseMatching("census", "local"),
    "OpenCV SGM": DenseMatching("opencv"),
    "OpenCV SGM, not refined": DenseMatching("opencv", refine=False),
}
SUN_LUX = (1e2, 1e3, 1e4, 1e5)
"""Illuminance from a lit room to bright sunlight, lux."""
SUN_EXPOSURE_S, SUN_POWER_W = 1e-4, 0.5
"""Exposure and power of the emitter that make the dots bright on the tabletop in the dark."""
CARPET_PX, ABOVE_M, MIN_THING_PX = 0.5, 0.02, 3000
"""Largest distance from the carpet's plane in disparity, pixels; least height of things above it, metres; least number
of pixels of one."""


def signals_of(name: str, sensor: Sensor, width: int, spp: int, **settings: Any) -> Signals:
    """Signals of a scene of the package, for all cameras of a sensor."""
    scene = load_scene(name)
    rigs = Instrument("stereo", sensor, **settings).rigs(scene, width, width * 3 // 4)
    return transport(scene, rigs[0] if len(rigs) == 1 else rigs, [sensor], spp=spp)


def row(name: str, signals: Signals, sensor: Sensor, decoder: Any = None, **exposure: Any) -> tuple[RangeImage, Any]:
    """Print what a sensor reads: fraction read of the lit pixels, median error, readings off by 10 mm, causes."""
    capture = expose(signals, sensor, sensor.default_detector, **exposure)
    image = decode(capture, decoder)
    compared = compare(image, signals)
    found = compared.row("all")
    causes = explain(image, capture, signals).fractions(signals.truth)[-1]["causes"]
    because = ", ".join(f"{cause.replace('_', ' ')} {100 * f:.1f}" for cause, f in list(causes.items())[:5])
    read = image.valid.any()
    median = f"{1e3 * found.median_abs_m:.2f}" if read else "-"
    wrong = f"{100 * found.wrong / (found.right + found.wrong):.1f} %" if read else "-"
    print(f"| {name} | {100 * found.completeness:.1f} % | {median} | {wrong} | {because} |")
    return image, compared


def planar_px(width: int, spp: int) -> float:
    """Root mean square error of disparities of a fronto-parallel plane without noise, for each matcher; the default's
    is returned."""
    signals = signals_of("plane", ACTIVE, width, spp)
    taken = expose(signals, ACTIVE)
    truth = signals.rig.pinhole.fx * ACTIVE.baseline_m / signals.truth.z
    result = []
    print("\n| matcher | error, px (rms) | bias, px | stated, px | read |\n| --- | --- | --- | --- | --- |")
    for name, matching in MATCHERS.items():
        found = StereoDecoder(matching).coordinates(taken)  # type: ignore[arg-type]
        error = found.disparity_px - truth
        result.append(float(np.sqrt(np.nanmean(error**2))))
        print(
            f"| {name} | {result[-1]:.3f} | {np.nanmedian(error):+.3f} | {np.nanmedian(found.sigma_px):.3f} | "
            f"{100 * found.valid.mean():.1f} % |"
        )
    return result[0]


def real_pair(data: Path) -> np.ndarray | None:
    """Depths (h, w) of the real pair, and what they say of carpet and things; None without the data."""
    paths = [data / "left1.png", data / "right1.png"]
    if not all(path.is_file() for path in paths):
        print(f"\nreal pair: {data} has no left1.png and right1.png; skipped")
        return None
    from rangesim.files.image_files import read_stack

    frames = read_stack(paths)
    camera = Intrinsics(848, 480, 427.12, 427.12, 426.93 + 0.5, 234.78 + 0.5)  # OpenCV's centres lie at integers
    rig = Rig(camera, Intrinsics.from_fov(640, 400, 90.0), T_camera_projector=translation(0.025, 0, 0))
    sensor = ActiveStereo(baseline_m=0.05)
    pair = CaptureSet(tuple(Capture(f[None], sensor, r) for f, r in zip(frames, sensor.rigs(rig), strict=True)))
    found = StereoDecoder().coordinates(pair)
    image = found.range_image(rig)
    other = match_rows(*frames.astype(float), (0, 128), 9)
    both = np.isfinite(other) & found.valid
    apart = (found.disparity_px - other)[both]
    print(
        f"\nreal pair: {100 * found.valid.mean():.1f} % read, z {np.nanpercentile(image.z, 1):.2f} to "
        f"{np.nanpercentile(image.z, 99):.2f} m; OpenCV's SGBM reads {100 * np.isfinite(other).mean():.1f} %; where "
        f"both read, {100 * np.mean(np.abs(apart) < 1):.1f} % agree within a pixel, median difference "
        f"{np.median(np.abs(apart)):.2f} px"
    )
    y, x = np.nonzero(found.valid)
    scale = camera.fx * sensor.baseline_m
    d = found.disparity_px[y, x].astype(np.float64)
    plane, on = largest_plane(x, y, d / scale, CARPET_PX / scale, np.random.default_rng(0))
    q_of_carpet = plane.inverse_depth(x, y)
    rest = d - scale * q_of_carpet
    above = np.zeros(found.valid.shape, dtype=bool)
    above[y, x] = 1 / q_of_carpet - image.z[y, x] > ABOVE_M
    sizes = np.bincount(label(above)[0].ravel())[1:]
    things = sorted(sizes[sizes > MIN_THING_PX].tolist(), reverse=True)
    print(
        f"the carpet: {100 * on.mean():.0f} % of the readings lie on one plane, within "
        f"{np.sqrt(np.mean(rest[on] ** 2)):.3f} px (rms); {len(things)} things stand out of it by "
        f"{1e3 * ABOVE_M:.0f} mm or more, of {things} pixels"
    )
    return image.z


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data/simsense"))
    parser.add_argument("--width", type=int, default=320, help="pixels of each camera")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel")
    parser.add_argument("--picture", type=Path, help="PNG of the tabletop and of the real pair")
    arguments = parser.parse_args()
    width, spp = arguments.width, arguments.spp

    error_px = planar_px(width, 4 * spp)
    print("\n| scene | read of the lit pixels | median, mm | off by 10 mm | why pixels fail, % of all pixels |")
    print("| --- | --- | --- | --- | --- |")
    table = signals_of("tabletop", ACTIVE, width, spp)
    image, compared = row("tabletop, dots", table, ACTIVE)
    row("tabletop, dots, ZNCC", table, ACTIVE, StereoDecoder(DenseMatching("zncc")))
    row("tabletop, dots, OpenCV SGM", table, ACTIVE, StereoDecoder(DenseMatching("opencv")))
    row("tabletop, dots, steps of 1/8 px", table, ACTIVE, StereoDecoder(step_px=0.125))
    row("tabletop, room light alone", signals_of("tabletop", PASSIVE, width, spp), PASSIVE)
    row("tabletop, dots against a reference image", signals_of("tabletop", REFERENCE, width, spp), REFERENCE)
    wall = signals_of("plane", ACTIVE, width, spp)
    row("white wall, dots", wall, ACTIVE)
    row("white wall, room light alone", signals_of("plane", PASSIVE, width, spp), PASSIVE)
    row("glassware, dots", signals_of("glassware", ACTIVE, width, spp), ACTIVE)
    bright = signals_of("tabletop", ACTIVE, width, spp, power_w=SUN_POWER_W)
    for lux in SUN_LUX:
        sun = Ambient("sun", illuminance_lux=lux)
        name = f"tabletop, dots of {SUN_POWER_W:g} W, sun of {lux:g} lx"
        row(name, bright, ACTIVE, exposure_s=SUN_EXPOSURE_S, ambient=sun)
    real = real_pair(arguments.data)
    if arguments.picture is not None:
        save_picture(arguments.picture, image, table, real)
    row_all = compared.row("all")
    figures = {
        "planar_px": round(error_px, 4),
        "tabletop_complete": round(row_all.completeness, 4),
        "tabletop_median_mm": round(1e3 * row_all.median_abs_m, 3),
    }
    print(json.dumps(figures))


def save_picture(path: Path, image: RangeImage, signals: Signals, real: np.ndarray | None) -> None:
    """Left to right: what the first camera sees of the tabletop, its depths, their errors; the real pair's depths."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    taken = expose(signals, ACTIVE, ACTIVE.default_detector)
    columns = 3 if real is None else 4
    figure, axes = plt.subplots(1, columns, figsize=(3.2 * columns, 2.7), constrained_layout=True)
    axes[0].imshow(taken.reference.frames[0], cmap="gray", vmax=np.percentile(taken.reference.frames[0], 99.5))
    axes[0].set_title("infrared, first camera")
    shown = axes[1].imshow(image.z, cmap="viridis")
    figure.colorbar(shown, ax=axes[1], shrink=0.7, label="z, m")
    axes[1].set_title("depth of the tabletop")
    off = axes[2].imshow(1e3 * (image.z - signals.truth.z), cmap="RdBu_r", vmin=-10, vmax=10)
    figure.colorbar(off, ax=axes[2], shrink=0.7, label="error, mm")
    axes[2].set_title("measured - true")
    if real is not None:
        shown = axes[3].imshow(real, cmap="viridis", vmax=np.nanpercentile(real, 99))
        figure.colorbar(shown, ax=axes[3], shrink=0.7, label="z, m")
        axes[3].set_title("a real pair")
    for axis in axes:
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_facecolor("0.8")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
