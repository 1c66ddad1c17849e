# SPDX-License-Identifier: Apache-2.0
"""How range sensors fail on glass: a real stereo depth camera beside simulated sensors.

Real: scenes of the ClearGrasp data set (Sajjan et al. 2020; RealSense D435), whose transparent objects were measured as
they are and again sprayed opaque. Simulated, with `--scene N`: scene N, rebuilt from its own data (`rebuilt_scene.py`),
and measured by a simulated D435. Without `--scene`: both scenes of the folder beside `scenes/glassware.xml`, which
structured light and time of flight measure with the same intrinsics at the same distance, with and without caustics
beyond glass. Figures on the objects, and on the background:

    lost       fraction of the pixels (whose true depth is known) without a measurement
    > 10 mm    fraction of the others that are off by more than 10 mm
    median     signed error in z, millimetres; positive is too far
    quartiles  25 % and 75 % of the signed error, millimetres
    behind     fraction of the measurements on glass within 10 mm of the table or wall behind it

The last line is JSON.
Usage: python benchmarks/cleargrasp.py [--data DIR] [--scene N [--variants] [--picture FILE]] [--width W] [--spp N]
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from rebuilt_scene import Glass, Rebuilt, rebuild, reflectances, scene_dictionary

from rangesim import (
    Ambient,
    AmcwToF,
    Detector,
    DirectToF,
    Intrinsics,
    Rig,
    StructuredLight,
    decode,
    expose,
    load_scene,
    presets,
    transport,
)
from rangesim.environment.backend import images_can_be_read, select_variant
from rangesim.geometry.dense_stereo import DenseMatching
from rangesim.instrument.instrument import Instrument
from rangesim.response import Dots
from rangesim.rig import translation
from rangesim.sensors import ActiveStereo, StereoDecoder
from rangesim.settings.config import to_dict
from rangesim.signals import Signals

SCENE = Path(__file__).resolve().parent.parent / "scenes" / "glassware.xml"
DATA = Path("../shared/data/cleargrasp_d435")
REAL_SCENES = (80, 123)
OFF_MM = 10.0
GAPS_M = (0.0, 0.04, 0.08, 0.12, 0.2)
"""Classes of the distance from the glass to what is behind it, metres; each begins here and ends at the next."""
LEAST_PIXELS = 500
"""Smaller classes say nothing: their pixels are those of a few windows of a matcher."""
SENSORS = {
    "structured light, gray-phase": StructuredLight(),
    "AMCW ToF, 20 + 80 + 100 MHz": AmcwToF(),
    "direct ToF, 100 ps bins": DirectToF(bins=128, pulse_fwhm_s=200e-12),
}
BASELINE_M = 0.05
TRANSPARENT = ("pet", "glass")
Figures = dict[str, float]

# ---- The D435 --------------------------------------------------------------------------------------------------------

LEFT_M = 0.015
"""Distance in metres by which the left infra-red camera stands to the right of the colour camera; source:
librealsense's extrinsics of a D435."""
PRESET = presets.load("d435")
"""The D435 of the package."""
D435 = replace(
    PRESET,
    sensor=ActiveStereo(Dots(1280, 800, spacing_px=13.8, dot_px=1.45), BASELINE_M),
    camera=Intrinsics(848, 480, fx=427.12, fy=427.12, cx=427.43, cy=235.28),
    projector=Intrinsics.from_fov(1280, 800, fov_x_deg=90.0),
    power_w=0.15,
    exposure_s=None,
    detector=Detector(bits=10, full_well_e=10_000.0, quantum_efficiency=0.3, band_width_m=0.9e-6),
    decoder=StereoDecoder(
        DenseMatching(
            small_penalty=20, large_penalty=100, uniqueness=0.05, min_advantage=-62.0, max_sigma_px=10.0,
            min_correlation=0.3, min_slope_correlation=-1.0, texture_around=False,
        )
    ),
)  # fmt: skip
"""The preset with what is known better here. Dots: those in a real pair of infra-red images of a D435 (SimSense), 9.2
camera pixels apart, with a standard deviation of 1.0 camera pixel, the blur of the camera's lens included. Camera: of
the same device. Power: librealsense's default setting, 150 mW, if all of it leaves the device; automatic exposure. The
cameras of a D435 have no filter, so they take visible light too; electrons are assumed. Matcher: census as in the
device, without the texture check, which the data set's authors had switched off. Its other thresholds are those with
which scene 080 loses about as little of its background as the real camera does (2 to 3 %)."""
ROOM_LUX = 400.0
"""Room light on the table, lux; assumed such that dots at 0.6 m are 2.7 times as bright as what is around them, as in
that real pair (in another room)."""
NEAREST_M, FARTHEST_M = 0.2, 4.0
"""Depths that are searched, metres."""
LEAST_DEPTH_M = 0.32
"""Depth that both infra-red cameras see along the whole edge of the colour image; the scenes are farther away."""
FRINGE = 8
"""Pixels around that part of the infra-red images, which windows of the matcher need."""
NOISE_PX = 0.08
"""Standard deviation of a disparity of a D435, pixels of an image of 1280."""
NOISE_Q = NOISE_PX / (D435.camera.fx * 1280 / D435.camera.width * BASELINE_M)
"""Standard deviation of 1 / z, per metre."""


@dataclass(frozen=True)
class Matter:
    """What the objects are rebuilt as, see `rebuilt_scene.scene_dictionary`; by default as the bottles of
    `scenes/glassware.xml`."""

    glass: Glass = "two walls"
    wall_m: float = 0.8e-3
    int_ior: float = 1.57
    alpha: float = 0.0


@dataclass(frozen=True)
class Trial:
    """What is simulated: the objects, and what the camera does with them.

    device : the instrument.
    dots : whether the projector is on.
    room : factor on the light of the room.
    matching : settings of the matcher that differ from those of the device.
    """

    matter: Matter = Matter()
    device: Instrument = D435
    dots: bool = True
    room: float = 1.0
    matching: dict[str, Any] = field(default_factory=dict)


MAIN_TRIALS = {"preset d435": Trial(device=PRESET), "d435 as in real images": Trial()}
"""The device of the package as it is, and with the dots and the light of a real pair of images."""
VARIANTS = {
    "  product's default matcher": Trial(matching=to_dict(DenseMatching())),
    "  window of 5 px": Trial(matching={"window_px": 5}),
    "  window of 15 px": Trial(matching={"window_px": 15}),
    "  uniqueness 0.2 instead of 0.05": Trial(matching={"uniqueness": 0.2}),
    "  no speckle filter": Trial(matching={"min_region_px": 0}),
    "  dots off": Trial(dots=False),
    "  room light off": Trial(room=0.0),
    "  room light x 4": Trial(room=4.0),
    "  front wall alone": Trial(Matter("wall")),
    "  front wall alone, 2.5 mm of glass": Trial(Matter("wall", 2.5e-3, 1.5)),
    "  front wall as thindielectric": Trial(Matter("thin")),
    "  two walls of 2.5 mm of glass": Trial(Matter("two walls", 2.5e-3, 1.5)),
    "  solid": Trial(Matter("solid")),
    "  rough walls, alpha 0.05": Trial(Matter(alpha=0.05)),
    "  no objects": Trial(Matter("none")),
}
"""What `--variants` runs besides, each differing from the last of the main trials. Trials with the same objects share a
pass."""


class RealScene(NamedTuple):
    """A scene of the data set, as the colour camera sees it.

    camera : Intrinsics of the colour camera.
    opaque, transparent : (h, w) float64, measured z of the sprayed and of the bare objects, metres, NaN: lost.
    mask : (h, w) bool, where the objects are.
    grey : (h, w) uint8, colour image with the sprayed objects.
    """

    camera: Intrinsics
    opaque: np.ndarray
    transparent: np.ndarray
    mask: np.ndarray
    grey: np.ndarray


def read_scene(folder: Path, number: int) -> RealScene:
    """Scene `number` of a folder of the data set.

    Raises
    ------
    SystemExit
        A file is missing.
    """
    import mitsuba as mi

    select_variant()
    stem = folder / f"{number:09d}"
    names = [f"{stem}-{part}" for part in ("opaque-depth-img.exr", "transparent-depth-img.exr", "mask.png",
                                           "opaque-rgb-img.jpg")]  # fmt: skip
    for name in (*names, folder / "camera_intrinsics.yaml"):
        if not Path(name).is_file():
            raise SystemExit(f"expected scene {number} of the ClearGrasp data set, found no file {name}")
    numbers = dict(
        re.findall(r"^(xres|yres|fx|fy|cx|cy): *([\d.]+)", (folder / "camera_intrinsics.yaml").read_text(), re.M)
    )
    fx, fy, cx, cy = (float(numbers[key]) for key in ("fx", "fy", "cx", "cy"))
    camera = Intrinsics(int(numbers["xres"]), int(numbers["yres"]), fx, fy, cx + 0.5, cy + 0.5)

    def first_channel(name: str) -> np.ndarray:
        with images_can_be_read():
            image = np.array(mi.Bitmap(name), dtype=np.float64)
        return image if image.ndim == 2 else image[..., 0]

    def depth(name: str) -> np.ndarray:
        z = first_channel(name)
        return np.where(np.isfinite(z) & (z > 0), z, np.nan)

    grey = cv2.imread(names[3], cv2.IMREAD_GRAYSCALE)
    return RealScene(camera, depth(names[0]), depth(names[1]), first_channel(names[2]) > 0, grey)


def figures(measured: np.ndarray, true: np.ndarray, mask: np.ndarray, behind: np.ndarray | None = None) -> Figures:
    """Figures of the module's docstring over the pixels of `mask` whose true z (metres, NaN: unknown) is known."""
    known = mask & np.isfinite(true)
    read = known & np.isfinite(measured)
    if not read.any():
        return {"lost": 1.0} | dict.fromkeys(("off", "median_mm", "low_mm", "high_mm", "behind"), float("nan"))
    error_mm = 1e3 * (measured - true)[read]
    low, median, high = np.percentile(error_mm, [25, 50, 75])
    result = {
        "lost": round(1 - error_mm.size / int(known.sum()), 3),
        "off": round(float((np.abs(error_mm) > OFF_MM).mean()), 3),
        "median_mm": round(float(median), 1),
        "low_mm": round(float(low), 1),
        "high_mm": round(float(high), 1),
    }
    if behind is not None:
        result["behind"] = round(float((np.abs(measured - behind)[read] < 1e-3 * OFF_MM).mean()), 3)
    return result


# ---- A rebuilt scene -------------------------------------------------------------------------------------------------


def rigs_of(device: Instrument, colour: Intrinsics, width: int) -> tuple[Rig, ...]:
    """Rigs of both infra-red cameras.

    width : pixels of their images before they are cut to what the colour camera sees, which is all that is compared.
    """
    whole = device.camera.resized(width, round(device.camera.height * width / device.camera.width))
    left, right = -colour.cx / colour.fx, (colour.width - colour.cx) / colour.fx
    top, bottom = -colour.cy / colour.fy, (colour.height - colour.cy) / colour.fy
    left -= (LEFT_M + BASELINE_M) / LEAST_DEPTH_M  # of what the right camera needs to match the left edge
    x0, x1 = (int(whole.cx + whole.fx * x) for x in (left, right))
    y0, y1 = (int(whole.cy + whole.fy * y) for y in (top, bottom))
    x0, x1, y0, y1 = max(0, x0 - FRINGE), min(width, x1 + FRINGE), max(0, y0 - FRINGE), min(whole.height, y1 + FRINGE)
    camera = replace(whole, width=x1 - x0, height=y1 - y0, cx=whole.cx - x0, cy=whole.cy - y0)
    first = Rig(
        camera, device.projector, translation(LEFT_M, 0, 0), device.T_camera_projector, device.camera_lens,
        device.projector_lens, device.power_w, device.emitter_wavelength_m,
    )  # fmt: skip
    return device.sensor.rigs(first)


def aligned(z: np.ndarray, camera: Intrinsics, colour: Intrinsics) -> np.ndarray:
    """(h, w) z of the colour camera's pixels, metres, NaN: none: of the depth pixels that cover them, the nearest.

    Each depth pixel covers the rectangle between the images of its corners, as in librealsense's `align`.
    """
    row, column = np.nonzero(np.isfinite(z))
    depth = z[row, column]

    def image(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        points = camera.directions(np.stack([x, y], axis=-1).astype(np.float64)) * depth[:, None]
        return np.floor(colour.project(points + np.array([LEFT_M, 0.0, 0.0]))).astype(int)

    first, last = image(column, row), image(column + 1, row + 1)
    nearest = np.full((colour.height, colour.width), np.inf)
    for down in range(int((last - first)[:, 1].max(initial=0)) + 1):
        for across in range(int((last - first)[:, 0].max(initial=0)) + 1):
            x, y = first[:, 0] + across, first[:, 1] + down
            covered = (x <= last[:, 0]) & (y <= last[:, 1])
            covered &= (x >= 0) & (y >= 0) & (x < colour.width) & (y < colour.height)
            np.minimum.at(nearest, (y[covered], x[covered]), depth[covered])
    return np.where(np.isfinite(nearest), nearest, np.nan)


class Simulated(NamedTuple):
    """z, (h, w) metres at the colour camera's pixels, NaN: lost; and the left infra-red image, (h, w) uint8."""

    z: np.ndarray
    infrared: np.ndarray


def light_of(real: RealScene, rebuilt: Rebuilt, trial: Trial, width: int, spp: int, seed: int) -> Signals:
    """Signals of both infra-red cameras in a rebuilt scene."""
    matter, device = trial.matter, trial.device
    with tempfile.TemporaryDirectory() as folder:
        paint = reflectances(real.grey, real.mask)
        description = scene_dictionary(
            rebuilt, paint, Path(folder), matter.glass, matter.wall_m, matter.int_ior, matter.alpha
        )
        return transport(
            load_scene(description), rigs_of(device, real.camera, width), [device.sensor], spp=spp, max_depth=3,
            sampling_error=False, seed=seed,
        )  # fmt: skip


def simulate(signals: Signals, trial: Trial, colour: Intrinsics, seed: int = 0) -> Simulated:
    """What a stereo camera makes of the light in a rebuilt scene."""
    device = trial.device
    sensor = device.sensor if trial.dots else replace(device.sensor, pattern=None)
    light = Ambient("led", illuminance_lux=trial.room * ROOM_LUX)
    pair = expose(signals, sensor, device.detector, device.exposure_s, seed, light)
    camera = signals.rig.camera
    least, largest = (camera.fx * BASELINE_M / z for z in (FARTHEST_M, NEAREST_M))
    decoder = replace(
        device.decoder, matching=replace(device.decoder.matching, **trial.matching), least_px=least,
        disparities=int(np.ceil(largest - least)),
    )  # fmt: skip
    image = decode(pair, decoder)
    frame = pair.reference.frames[0] / device.detector.max_dn
    shown = np.round(255 * np.sqrt(np.clip(frame, 0, 1))).astype(np.uint8)
    return Simulated(aligned(np.where(image.valid, image.z, np.nan), camera, colour), shown)


def by_object(real: RealScene, rebuilt: Rebuilt, simulated: np.ndarray) -> list[dict[str, float]]:
    """Fraction lost and median error of both cameras on each object, from left to right, printed too."""
    rows = []
    for front in sorted(rebuilt.fronts, key=lambda front: float(np.nonzero(np.isfinite(front))[1].mean())):
        own = np.isfinite(front)
        first = figures(real.transparent, real.opaque, own)
        second = figures(simulated, front, own & np.isfinite(real.opaque))
        z = round(float(np.nanmedian(front)), 3)
        rows.append({"z_m": z} | {f"{who}_{key}": of[key] for who, of in (("real", first), ("simulated", second))
                                  for key in ("lost", "median_mm")})  # fmt: skip
        cells = [f"lost {of['lost']:.0%}, {of['median_mm']:+.0f} mm" for of in (first, second)]
        print(f"    object at {z:.2f} m: real {cells[0]}; simulated {cells[1]}", flush=True)
    return rows


def by_gap(real: RealScene, rebuilt: Rebuilt, simulated: np.ndarray) -> list[dict[str, float]]:
    """What both cameras read, over the distance from the glass to what is behind it, printed too.

    Each row holds the fraction lost, and the fractions of the measurements within 10 mm of the front of the glass and
    of what is behind it.
    """
    front, behind, rows = rebuilt.front, rebuilt.behind, []
    for near, far in zip(GAPS_M, (*GAPS_M[1:], np.inf), strict=True):
        own = real.mask & np.isfinite(real.opaque) & (behind - front >= near) & (behind - front < far)
        if own.sum() < LEAST_PIXELS:
            continue
        row: dict[str, float] = {"gap_from_m": near, "pixels": int(own.sum())}
        for who, z, true in (("real", real.transparent, real.opaque), ("simulated", simulated, front)):
            of = figures(z, true, own, behind)
            row |= {f"{who}_lost": of["lost"], f"{who}_front": round(1 - of["off"], 3), f"{who}_behind": of["behind"]}
        rows.append(row)
        cells = [f"{row[f'{who}_lost']:.0%} lost, {row[f'{who}_front']:.0%} front, {row[f'{who}_behind']:.0%} behind"
                 for who in ("real", "simulated")]  # fmt: skip
        print(f"    gap from {100 * near:.0f} cm: real {cells[0]}; simulated {cells[1]}", flush=True)
    return rows


def report_scene(real: RealScene, number: int, args: argparse.Namespace) -> dict[str, Any]:
    """Figures on glass and on the background of the real camera and of simulated ones, printed as they come."""
    rebuilt = rebuild(real.camera, real.opaque, real.mask, NOISE_Q)
    front, behind, mask = rebuilt.front, rebuilt.behind, real.mask
    compared = np.isfinite(real.opaque)  # truth is known to both
    result: dict[str, Any] = {}

    def add(label: str, z: np.ndarray, on_glass: np.ndarray, elsewhere: np.ndarray) -> None:
        result[label] = (
            figures(z, on_glass, mask & compared, behind),
            figures(z, elsewhere, ~mask & compared),
        )
        show(label, *result[label])

    add(f"real D435, scene {number:03d}", real.transparent, real.opaque, real.opaque)
    signals, of = None, None
    result["objects"], result["gaps"] = {}, {}
    for label, trial in (MAIN_TRIALS | (VARIANTS if args.variants else {})).items():
        if signals is None or (trial.matter, trial.device) != of:
            signals = light_of(real, rebuilt, trial, args.width or D435.camera.width, args.spp, args.seed)
            of = trial.matter, trial.device
        seen = simulate(signals, trial, real.camera, args.seed)
        add(label, seen.z, front, behind)
        lost, lost_too = (np.isnan(z)[mask & compared] for z in (real.transparent, seen.z))
        there, elsewhere = round(float(lost_too[lost].mean()), 3), round(float(lost_too[~lost].mean()), 3)
        result[label][0].update(lost_where_real_is=there, lost_elsewhere=elsewhere)
        print(f"    lost {there:.0%} of what the real one lost, {elsewhere:.0%} of what it measured", flush=True)
        if label in MAIN_TRIALS:
            result["objects"][label] = by_object(real, rebuilt, seen.z)
            result["gaps"][label] = by_gap(real, rebuilt, seen.z)
        if args.picture and trial == Trial():
            cv2.imwrite(str(args.picture), picture(real, seen))
    return result


def picture(real: RealScene, seen: Simulated, width: int = 300) -> np.ndarray:
    """(h, w, 3) uint8, BGR, side by side: colour image and depth of the real camera, depth and infra-red image of the
    simulated one; each `width` pixels wide. Lost pixels are black."""

    def coloured(z: np.ndarray) -> np.ndarray:
        low, high = np.nanquantile(real.opaque, [0.01, 0.99])
        image = cv2.applyColorMap(
            np.uint8(255 * np.clip((np.nan_to_num(z) - low) / (high - low), 0, 1)), cv2.COLORMAP_VIRIDIS
        )
        image[np.isnan(z)] = 0
        return image

    grey, infrared = (cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in (real.grey, seen.infrared))
    height = round(width * real.camera.height / real.camera.width)
    cells = [grey, coloured(real.transparent), coloured(seen.z), infrared]
    return np.hstack([cv2.resize(cell, (width, height), interpolation=cv2.INTER_AREA) for cell in cells])


# ---- The other sensors on comparable objects -------------------------------------------------------------------------


def depth_behind(rig: Rig) -> np.ndarray:
    """(h, w) true z of the scene without its transparent objects."""
    tree = ET.parse(SCENE)
    root = tree.getroot()
    for shape in root.findall("shape"):
        if any(ref.get("id") in TRANSPARENT for ref in shape.findall("ref")):
            root.remove(shape)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "empty.xml"
        tree.write(path)
        return transport(load_scene(path), rig, [], spp=1, caustics=False).truth.z


def show(label: str, on_glass: Figures, background: Figures) -> None:
    """One line of the table."""
    cells = [f"{f['lost']:>6.1%} {f['off']:>8.1%} {f['median_mm']:>+8.1f} {f['low_mm']:>+8.1f}..{f['high_mm']:<+8.1f}"
             for f in (on_glass, background)]  # fmt: skip
    behind = f" {on_glass['behind']:>6.1%}" if "behind" in on_glass else ""
    print(f"{label:<46} {cells[0]}{behind} | {cells[1]}", flush=True)


def report_sensors(args: argparse.Namespace) -> dict[str, Any]:
    """Figures of both real scenes, if they are there, and of structured light and time of flight on glassware."""
    result: dict[str, Any] = {}
    if args.data.is_dir():
        for number in REAL_SCENES:
            scene = read_scene(args.data, number)
            key, measured, true, mask = f"real D435, scene {number:03d}", scene.transparent, scene.opaque, scene.mask
            result[key] = figures(measured, true, mask), figures(measured, true, ~mask)
            show(key, *result[key])
    else:
        print(f"no real data: there is no directory {args.data}; name it with --data")

    scene = load_scene(SCENE)
    rig = scene.rig(BASELINE_M, width=args.width or 320)
    behind = depth_behind(rig)
    for light, settings in (("all light", {}), ("no light beyond glass", {"caustics": False, "glint": False})):
        signals = transport(scene, rig, list(SENSORS.values()), spp=args.spp, max_depth=12, **settings)
        truth = signals.truth
        mask = truth.material == truth.material_names.index("transparent")
        for label, sensor in SENSORS.items():
            image = decode(expose(signals, sensor))
            z = np.where(image.valid, image.z, np.nan)
            key = f"{label}, {light}"
            result[key] = figures(z, truth.z, mask), figures(z, truth.z, ~mask)
            show(key, *result[key])
            if light == "all light":
                result[f"{key}, against what is behind"] = figures(z, behind, mask), result[key][1]
                show("    against what is behind", *result[f"{key}, against what is behind"])
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the data set's images")
    parser.add_argument("--scene", type=int, help="number of the scene to rebuild")
    parser.add_argument("--variants", action="store_true", help="vary the rebuilt scene and the camera")
    parser.add_argument("--picture", type=Path, help="PNG file of the real and the simulated depth")
    parser.add_argument("--width", type=int, help="pixels; by default 848 of a rebuilt scene, 320 of the others")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--spp", type=int, help="samples per pixel; default: 512 with --scene, else 64")
    args = parser.parse_args()
    if args.spp is None:  # the renderer's noise counts as noise of the camera, see docs/cleargrasp.md
        args.spp = 64 if args.scene is None else 512
    print(f"{'':<46} on glass: lost, > 10 mm, median, quartiles in mm, behind | background")
    if args.scene is None:
        result = report_sensors(args)
    else:
        result = report_scene(read_scene(args.data, args.scene), args.scene, args)
    lists = {key: result.pop(key) for key in ("objects", "gaps") if key in result}
    table: dict[str, Any] = {k: {"glass": a, "background": b} for k, (a, b) in result.items()}
    print(json.dumps(table | lists))


if __name__ == "__main__":
    main()
