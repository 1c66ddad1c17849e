# SPDX-License-Identifier: Apache-2.0
"""Which code of structured light for which scene? All codes at equal total exposure, their exactness, and their speed.

Every code that has defaults is shown in every scene. All frames of a code together are exposed for `TOTAL_S`, so that a
code of few frames exposes each of them longer. One transport pass serves all codes; the moving scene takes a pass for
each of `MOMENTS` moments. Detector: deep, so that no code saturates where another does not. A cell of the table has

    completeness: percent of the pixels that the projector lights and that have a reading;
    median error of the readings, projector pixels;
    wrong: percent of the readings, with status OK, that err by more than a projector pixel.

`!` marks captures of which the decoder says that they contradict the code. The last line is JSON:

    codes               number of codes
    worst_subpixel_px   largest error of encoding and decoding without noise, over all columns and codes; null: a code
                        lost a column
    gray_agreement      fraction of OpenCV's pixels that decode to the same on the board of shared/data; null: not there
    decode_ms           coordinates of 44 frames of Gray code of 640 x 480 pixels, median; of 8 bits and with a known
                        detector, whichever takes longer
    expose_s            exposure of these frames, median

Usage: python benchmarks/codes.py [--scenes corner ...] [--codes gray ...] [--quick] [--data ../shared/data]
           [--out docs/codes_table.md]
"""

from __future__ import annotations

import argparse
import json
import math
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from after_tracing import plane

from rangesim import (
    Capture,
    Detector,
    Lens,
    Rig,
    Scene,
    StillSignals,
    StructuredLight,
    decode,
    expose,
    import_capture,
    load_scene,
    transport,
)
from rangesim.codes import Code
from rangesim.environment.backend import select_variant
from rangesim.errors import RangesimWarning
from rangesim.sensors import StructuredLightDecoder
from rangesim.settings.config import has_defaults

SCENES = Path(__file__).resolve().parent.parent / "scenes"
CAMERA = (160, 120)
PROJECTOR = (240, 180)
"""Pixels. A camera pixel covers 1.3 projector pixels; no size is a power of two."""
TOTAL_S = 5e-3
"""Exposure of all frames together, seconds: with it, a frame of Gray code has what the automatic exposure of the
default detector chooses for the scene `matte`."""
DETECTOR = Detector(full_well_e=200_000, bits=16)
WRONG_PX = 1.0
"""Error above which a reading is wrong, projector pixels. Gray code errs by half a pixel at most by itself."""
MOMENTS = 24
"""Number of moments at which the moving scene is rendered; a frame takes the nearest. From one to the next, the rig
moves by 1.25 mm, and what a pixel sees by less than a tenth of a projector pixel."""
IDENTITY_SIZES = (1280, 1000, 333)
"""Columns of the projectors on which encoding and decoding is tried."""


@dataclass(frozen=True)
class Case:
    """A scene with what is done to it.

    scene : function that returns it. baseline_m : metres. lens : Lens of the projector; None: all is in focus.
    gamma : of the projector. moved_m : way of the rig towards the scene in the whole acquisition, metres.
    max_depth : as for `transport`.
    """

    scene: Callable[[], Scene]
    baseline_m: float = 0.2
    lens: Lens | None = None
    gamma: float = 1.0
    moved_m: float = 0.0
    max_depth: int = 5

    def sensor(self, code: Code) -> StructuredLight:
        return StructuredLight(*PROJECTOR, code=code, projector_gamma=self.gamma)

    def rig(self, scene: Scene) -> Rig:
        rig = scene.rig(self.baseline_m, PROJECTOR, width=CAMERA[0], height=CAMERA[1])
        return rig if self.lens is None else replace(rig, projector_lens=self.lens)


def matte(factor: float = 1.0, more: str = "") -> Scene:
    """The scene `matte` with all reflectances multiplied, and further elements."""
    text = (SCENES / "matte.xml").read_text(encoding="utf-8")
    text = re.sub(r'("reflectance" value=")([\d.]+)', lambda m: f"{m[1]}{factor * float(m[2]):.6g}", text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.xml"
        path.write_text(text.replace("</scene>", f"{more}</scene>"), encoding="utf-8")
        return load_scene(path)


def corner(left_deg: float = 60.0, right_deg: float = 15.0, albedo: float = 0.9, wall_m: float = 0.5) -> Scene:
    """Two white walls that meet 0.8 m in front of the camera, at these angles with its axis.

    The projector, to the right of the camera, lights the right wall at a grazing angle. That wall gets more light from
    the left wall than from the projector.
    """
    select_variant()
    import mitsuba as mi

    transform = mi.ScalarTransform4f
    parts: dict[str, Any] = {}
    for name, angle in (("left", -math.radians(left_deg)), ("right", math.radians(right_deg))):
        along = np.array([math.sin(angle), -math.cos(angle), 0.0])  # from the edge towards the camera
        up = np.array([0.0, 0.0, 1.0])
        frame = np.eye(4)
        frame[:3, :3] = np.column_stack([0.5 * wall_m * along, 0.5 * wall_m * up, np.cross(along, up)])
        frame[:3, 3] = np.array([0.0, 0.8, 0.0]) + 0.5 * wall_m * along
        paint = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": albedo}}
        parts[name] = {"type": "rectangle", "to_world": transform(frame), "bsdf": {"type": "twosided", "paint": paint}}
    camera = {
        "type": "perspective",
        "fov": 40.0,
        "to_world": transform().look_at(origin=[0, 0, 0], target=[0, 1, 0], up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": CAMERA[0], "height": CAMERA[1]},
    }
    return load_scene({"type": "scene", "sensor": camera, **parts})


CASES = {
    "matte": Case(matte),
    "corner": Case(corner, baseline_m=0.12, max_depth=12),
    "defocus": Case(matte, lens=Lens(15e-3, focus_m=0.5)),
    "low albedo": Case(lambda: matte(0.03)),
    "ambient": Case(lambda: matte(1.0, '<emitter type="constant"><spectrum name="radiance" value="150"/></emitter>')),
    "gamma 2.2": Case(matte, gamma=2.2),
    "glass, mirror": Case(lambda: load_scene(SCENES / "tabletop.xml")),
    "moving": Case(matte, moved_m=0.03),
}


@dataclass(frozen=True)
class Score:
    """How a code did in a scene; see the table's explanation above."""

    completeness: float
    median_px: float
    wrong: float
    is_doubted: bool

    def __str__(self) -> str:
        doubt = " !" if self.is_doubted else ""
        error = "-" if math.isnan(self.median_px) else f"{self.median_px:.2f}"
        return f"{100 * self.completeness:.0f} / {error} / {100 * self.wrong:.1f}{doubt}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--codes", nargs="+", default=None, help="names of codes; default: all")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--quick", action="store_true", help="fewer samples, moments, sizes and repeats")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, help="file that the table is written to")
    args = parser.parse_args()

    codes = {name: kind() for name, kind in sorted(Code.known.items()) if has_defaults(kind)}
    if args.codes:
        codes = {name: codes[name] for name in args.codes}
    worst = worst_error(codes, IDENTITY_SIZES[1:2] if args.quick else IDENTITY_SIZES)
    spp, moments = (16, 4) if args.quick else (args.spp, MOMENTS)
    scores = {name: scores_of(name, codes, spp, moments) for name in args.scenes}
    table = markdown(codes, scores)
    print(f"\n{table}\n")
    if args.out:
        args.out.write_text(document(table, len(codes)), encoding="utf-8")
    decode_ms, expose_s = speed(3 if args.quick else 9)
    result = {
        "codes": len(codes),
        "worst_subpixel_px": worst,
        "gray_agreement": gray_agreement(args.data / "graycode_board" / "capture_0", 16 if args.quick else 4),
        "decode_ms": decode_ms,
        "expose_s": expose_s,
    }
    print(json.dumps(result))


# ---- The table -------------------------------------------------------------------------------------------------------


def scores_of(case_name: str, codes: dict[str, Code], spp: int, moments: int) -> dict[str, Score]:
    """How each code does in a scene; codes that do not fit the projector are left out."""
    case = CASES[case_name]
    sensors: dict[str, StructuredLight] = {}
    for name, code in codes.items():
        try:
            sensors[name] = case.sensor(code)
        except ValueError as error:
            print(f"{name} is left out: {error}")
    scene = case.scene()
    rig, start = case.rig(scene), time.perf_counter()
    ways = (np.arange(moments) + 0.5) / moments - 0.5 if case.moved_m else np.zeros(1)
    passes = [traced(scene, moved(rig, way * case.moved_m), list(sensors.values()), case, spp) for way in ways]
    truth = passes[0] if len(passes) == 1 else traced(scene, rig, [], case, spp)
    print(f"{case_name}: {len(passes)} passes, {time.perf_counter() - start:.1f} s", flush=True)
    result = {}
    for name, sensor in sensors.items():
        result[name] = score(taken(passes, sensor, rig), truth)
        print(f"    {name:<24} {sensor.n_frames:4d} frames   {result[name]}", flush=True)
    return result


def moved(rig: Rig, way_m: float) -> Rig:
    """The rig, moved along the axis of its camera."""
    step = np.eye(4)
    step[2, 3] = way_m
    return replace(rig, T_world_camera=rig.T_world_camera @ step)


def traced(scene: Scene, rig: Rig, sensors: Sequence[StructuredLight], case: Case, spp: int) -> StillSignals:
    """Signals of one pass for all sensors."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RangesimWarning)  # truncated light of glass
        return transport(scene, rig, sensors, spp=spp, max_depth=case.max_depth, sampling_error=False)


def taken(passes: Sequence[StillSignals], sensor: StructuredLight, rig: Rig) -> Capture:
    """The capture of a sensor, each frame of the pass that is nearest in time; all frames together take `TOTAL_S`."""
    exposure_s = TOTAL_S / sensor.n_frames
    if len(passes) == 1:
        capture: Capture = expose(passes[0], sensor, DETECTOR, exposure_s=exposure_s)
        return capture
    frames = np.empty((sensor.n_frames, rig.camera.height, rig.camera.width), dtype=DETECTOR.dtype)
    nearest = ((np.arange(sensor.n_frames) + 0.5) * len(passes) / sensor.n_frames).astype(int)
    for number in np.unique(nearest):
        whole = expose(passes[number], sensor, DETECTOR, exposure_s=exposure_s).frames
        frames[nearest == number] = whole[nearest == number]
    return Capture(frames, sensor, rig, DETECTOR, exposure_s)


def score(capture: Capture, signals: StillSignals) -> Score:
    """Readings of a capture against the truth."""
    truth = signals.truth
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RangesimWarning)
        image = decode(capture)
    assert image.projector_column is not None
    lit, valid = truth.projector_visible & np.isfinite(truth.z), image.valid & np.isfinite(truth.z)
    is_doubted = any(issubclass(one.category, RangesimWarning) for one in caught)  # and not of NumPy
    error = np.abs(image.projector_column - truth.projector_uv[..., 0])[valid]
    wrong = float(np.mean(error > WRONG_PX)) if error.size else 0.0
    median = float(np.median(error)) if error.size else math.nan
    return Score(float(np.mean(valid[lit])), median, wrong, is_doubted)


def markdown(codes: dict[str, Code], scores: dict[str, dict[str, Score]]) -> str:
    """The table: a row per code, a column per scene."""
    rows = [["code", "frames", *scores], ["---"] * (2 + len(scores))]
    for name, code in codes.items():
        frames = str(len(code.names(PROJECTOR[0])) + 2)
        rows.append([f"`{name}`", frames, *(str(of.get(name, "does not fit")) for of in scores.values())])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def document(table: str, number: int) -> str:
    """The page of the table."""
    camera, projector = (f"{width} x {height}" for width, height in (CAMERA, PROJECTOR))
    return f"""# Codes in difficult scenes

{number} codes of structured light in eight scenes ([what the codes are](codes.md)). All frames of a code together are
exposed for {1e3 * TOTAL_S:g} ms, so that a code of few frames exposes each of them longer. The camera has {camera}
pixels, the projector {projector}; columns alone, the defaults of each code, white and black included.
`python benchmarks/codes.py --out docs/codes_table.md` makes this page.

A cell has three numbers: the completeness (percentage of the lit pixels that have a reading), the median error in
projector pixels, and the percentage of the readings that err by more than one projector pixel although their status
is OK. `!` means that the decoder says that the frames contradict the code.

{table}

- *corner*: two white walls (albedo 0.9) at 75 degrees. The projector lights one of them at a grazing angle, so that
  it gets more light from the other wall than from the projector.
- *defocus*: the projector's blur has a standard deviation of about 1.7 projector pixels.
- *low albedo*: all reflectances of *matte* times 0.03. *ambient*: strong constant light from everywhere.
- *gamma 2.2*: the projector shows the patterns with that gamma, and the decoder is not told.
- *glass, mirror*: the scene `tabletop`.
- *moving*: the rig moves 30 mm towards the scene in the whole acquisition, about 1.4 projector pixels.
"""


# ---- Exactness -------------------------------------------------------------------------------------------------------


def worst_error(codes: dict[str, Code], sizes: Sequence[int]) -> float | None:
    """Largest error of encoding and decoding, projector pixels, over all columns; None if a code loses a column."""
    worst, lost = 0.0, False
    for name, code in codes.items():
        for size in sizes:
            try:
                sensor = StructuredLight(size, 2, code=code)
            except ValueError as error:
                print(f"{name} does not tell {size} columns apart: {error}")
                continue
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RangesimWarning)
                seen = StructuredLightDecoder().coordinates(Capture(sensor.patterns(), sensor))
            assert seen.column is not None
            error_px = np.abs(seen.column - (np.arange(size) + 0.5))
            refused = int(np.count_nonzero(seen.status[0]))
            most = float(error_px[seen.status == 0].max(initial=0.0))
            print(f"{name:<24} {size:5d} columns: largest error {most:.5f} px, {refused} columns lost", flush=True)
            worst, lost = max(worst, most), lost or refused > 0
    return None if lost else round(worst, 5)


def gray_agreement(folder: Path, step: int) -> float | None:
    """Fraction of the pixels on a grid that OpenCV decodes which decode to the same cell."""
    try:
        import cv2

        reference = cv2.structured_light.GrayCodePattern.create(1024, 768)
    except (ImportError, AttributeError):
        return None
    if not folder.is_dir():
        return None
    reference.setWhiteThreshold(5)
    capture = import_capture(folder, StructuredLight(1024, 768, code="gray", axes=("columns", "rows")))
    seen = StructuredLightDecoder().coordinates(capture)
    assert seen.column is not None
    assert seen.row is not None
    frames = list(capture.frames[:-2])
    contrast = capture.frames[-2].astype(int) - capture.frames[-1]
    theirs = same = 0
    for y, x in np.ndindex(*(-(-n // step) for n in contrast.shape)):
        failed, (column, row) = reference.getProjPixel(frames, x * step, y * step)
        if failed or contrast[y * step, x * step] <= 40:
            continue
        at = y * step, x * step
        theirs += 1
        same += bool(seen.status[at] == 0 and seen.column[at] == column + 0.5 and seen.row[at] == row + 0.5)
    return round(same / max(theirs, 1), 5)


# ---- Speed -----------------------------------------------------------------------------------------------------------


def speed(repeats: int) -> tuple[float, float]:
    """Milliseconds of decoding and seconds of exposing 44 frames of 640 x 480 pixels, medians."""
    sensor, decoder = StructuredLight(1280, 800, code="gray", axes=("columns", "rows")), StructuredLightDecoder()
    signals = plane(640, 480, sensor, 0.2)
    capture = expose(signals, sensor, Detector())
    of_8_bits = Capture((capture.frames >> 4).astype(np.uint8), sensor)
    expose_s = median_s(lambda: expose(signals, sensor, Detector()), repeats)
    decode_s = [median_s(lambda c=c: decoder.coordinates(c), repeats) for c in (capture, of_8_bits)]  # type: ignore[misc]
    known, unknown = (f"{1e3 * seconds:.0f} ms" for seconds in decode_s)
    print(f"decode {sensor.n_frames} frames: known detector {known}, 8 bits {unknown}; expose: {expose_s:.2f} s")
    return round(1e3 * max(decode_s), 1), round(expose_s, 3)


def median_s(call: Callable[[], object], repeats: int) -> float:
    """Median of the seconds that a call takes, after a first one that compiles its kernels."""
    call()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


if __name__ == "__main__":
    main()
