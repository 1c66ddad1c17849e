# SPDX-License-Identifier: Apache-2.0
"""Digests of all that the stages hand on, for changes that must not change results: five scenes, every sensor.

Each array is named by what it means, not by what the code calls it, so that digests outlive renamed fields:

    python benchmarks/digest.py --out before.json
    (a change of the code)
    python benchmarks/digest.py --against before.json

The second lists the digests that differ, and ends with status 1 if any do. Results are the same bytes on one kind of
machine alone: compare on one and the same. The last line is JSON: `digests`, `differ`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

import rangesim
from rangesim import AmcwToF, DirectToF, IdealToF, Sensor, StructuredLight
from rangesim.codes import GrayPhase
from rangesim.instrument.instrument import Instrument
from rangesim.motion import Motion, PoseTrack, Timing, transport_moving

SCENES = Path(__file__).resolve().parents[1] / "scenes"
NAMES = ("plane", "corner", "matte", "tabletop", "glassware")
WIDTH, HEIGHT, SPP, SEED = 120, 90, 5, 7
PROJECTOR = (256, 160)
SENSORS: dict[str, Sensor] = {
    "gray": StructuredLight(*PROJECTOR, code="gray", axes=("columns", "rows")),
    "gray-phase": StructuredLight(*PROJECTOR, axes=("columns",)),
    "fringes-both": StructuredLight(*PROJECTOR, GrayPhase(20.0, 5), axes=("columns", "rows")),
    "amcw": AmcwToF(),
    "amcw-square": AmcwToF((30e6, 50e6), waveform="square"),
    "direct": DirectToF(),
    "direct-gated": DirectToF(64, 200e-12, start_s=2e-9, pulse_fwhm_s=0.0, laser="single-shot"),
    "ideal": IdealToF(),
}
ENERGY = ("direct", "multipath", "specular", "caustic", "glint", "ambient")
TRUTH = ("z", "range", "normal", "instance", "material", "projector_uv", "projector_visible")


def digest(value: Any) -> str:
    """Sixteen hexadecimal digits of an array's bytes, type and shape, or of plain data."""
    if isinstance(value, np.ndarray):
        text = f"{value.dtype.str}{value.shape}".encode()
        return hashlib.sha256(text + np.ascontiguousarray(value).tobytes()).hexdigest()[:16]
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def in_order(value: Any, names: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    """The first fields of a dataclass under other names."""
    return ((name, getattr(value, f.name)) for name, f in zip(names, fields(value), strict=False))


def of_signals(signals: Any, sensor: Sensor) -> Iterator[tuple[str, Any]]:
    yield from ((f"energy/{name}", value) for name, value in in_order(signals.energy, ENERGY))
    yield from ((f"truth/{name}", value) for name, value in in_order(signals.truth, TRUTH))
    yield "frames/mean", signals.frames(sensor)
    if signals.sampling is not None:
        yield "frames/with sampling error", signals.frames(sensor, sampling_errors=1.0)
    if signals.truncation is not None:
        yield "truncation", [float(f"{x:.9g}") for x in np.nan_to_num(astuple(signals.truncation))]


def of_readings(signals: Any, one: Instrument, noise: bool) -> Iterator[tuple[str, Any]]:
    """Frames, range image, comparison, causes and points of a capture."""
    capture = rangesim.expose(signals, one.sensor, one.detector if noise else None, seed=SEED)
    image = rangesim.decode(capture)
    maps = ("z", "range_m", "confidence", "status", "intensity", "projector_column", "projector_row")
    comparison = rangesim.compare(image, signals.truth)
    causes = rangesim.explain(image, capture, signals, tolerance_m=comparison.tolerance_m)
    yield "capture", capture.frames
    yield from ((f"range image/{name}", getattr(image, name)) for name in maps if getattr(image, name) is not None)
    yield "comparison", [list(row.values()) for row in comparison.rows()]
    yield "causes", causes.cause
    if image.valid.sum() > 3:
        yield "points", image.to_point_cloud().points


def of_scene(name: str) -> Iterator[tuple[str, Any]]:
    scene = rangesim.load_scene(str(SCENES / f"{name}.xml"))
    for key, sensor in SENSORS.items():
        one = Instrument(key, sensor, power_w=0.02)
        rig = one.rig(scene, WIDTH, HEIGHT)
        signals = rangesim.transport(scene, rig, [sensor], spp=SPP, seed=SEED)
        yield from ((f"{name}/{key}/{k}", v) for k, v in of_signals(signals, sensor))
        for noise in (True, False):
            kind = "noisy" if noise else "noise-free"
            yield from ((f"{name}/{key}/{kind}/{k}", v) for k, v in of_readings(signals, one, noise))


def of_media() -> Iterator[tuple[str, Any]]:
    """A ball that scatters light inside, absorbing glass before it, a coat with holes, and lamps."""
    grey = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.5}}
    milk = {"type": "homogeneous", "sigma_t": 60.0, "albedo": 0.95, "phase": {"type": "hg", "g": 0.4}}
    ink = {"type": "homogeneous", "sigma_t": 8.0, "albedo": 0.0}
    shapes: dict[str, Any] = {
        "wall": {"type": "rectangle", "to_world": at(0, 0, 1.4).scale(1.5).rotate([0, 1, 0], 180), "bsdf": grey},
        "milk": {"type": "sphere", "center": [-0.12, 0, 1], "radius": 0.1, "bsdf": {"type": "null"}, "interior": milk},
        "ink": {"type": "sphere", "center": [0.12, 0, 0.9], "radius": 0.1, "bsdf": {"type": "dielectric"}},
        "mesh": {"type": "rectangle", "to_world": at(0, 0.2, 0.8).scale(0.1).rotate([0, 1, 0], 180)},
        "lamp": {"type": "sphere", "center": [0.5, -0.5, 0.3], "radius": 0.05, "emitter": {"type": "area"}},
    }
    shapes["ink"]["interior"] = ink
    shapes["mesh"]["bsdf"] = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "plastic"}}
    camera = {"type": "perspective", "fov": 40, "to_world": at(0, 0, 0), "film": {"type": "hdrfilm"}}
    scene = rangesim.load_scene({"type": "scene", "camera": camera, **shapes})
    for key in ("gray-phase", "direct"):
        one = Instrument(key, SENSORS[key], power_w=0.02)
        rig = one.rig(scene, WIDTH, HEIGHT)
        signals = rangesim.transport(scene, rig, [one.sensor], spp=SPP, seed=SEED)
        yield from ((f"media/{key}/{k}", v) for k, v in of_signals(signals, one.sensor))


def at(x: float, y: float, z: float) -> Any:
    """Transform of something at this place that looks along z."""
    import mitsuba as mi

    return mi.ScalarTransform4f().translate([x, y, z])


def of_motion() -> Iterator[tuple[str, Any]]:
    """An object that moves while each of three sensors takes its frames."""
    scene = rangesim.load_scene(str(SCENES / "plane.xml"))
    far = np.eye(4)
    far[2, 3] = 0.01
    motion = Motion(objects={"wall": PoseTrack(np.array([0.0, 0.4]), np.stack([np.eye(4), far]))})
    for key in ("gray-phase", "amcw", "direct"):
        one = Instrument(key, SENSORS[key], power_w=0.02)
        timing = Timing(frame_period_s=0.01)
        rig = one.rig(scene, WIDTH // 2, HEIGHT // 2)
        (signals,) = transport_moving(scene, rig, {one.sensor: timing}, motion, spp=SPP, seed=SEED).values()
        yield f"motion/{key}/frames", signals.frames(one.sensor)
        yield f"motion/{key}/motion", signals.motion_m if signals.motion_m is not None else []
        if key != "direct":
            one = replace(one, timing=timing)
            yield from ((f"motion/{key}/{k}", v) for k, v in of_readings(signals, one, True))


def compared(description: str, values: Iterable[tuple[str, Any]]) -> None:
    """Write or compare digests of named values, as the command line asks; ends the process."""
    parser = argparse.ArgumentParser(description=description.partition("\n")[0])
    parser.add_argument("--out", type=Path, help="write the digests to this file")
    parser.add_argument("--against", type=Path, help="compare with the digests of this file")
    options = parser.parse_args()
    found = {name: digest(value) for name, value in values}
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    before = json.loads(options.against.read_text(encoding="utf-8")) if options.against else found
    differ = sorted(k for k in {*before, *found} if before.get(k) != found.get(k))
    print("\n".join(differ))
    print(json.dumps({"digests": len(found), "differ": len(differ)}))
    sys.exit(1 if differ else 0)


def all_values() -> Iterator[tuple[str, Any]]:
    for name in NAMES:
        yield from of_scene(name)
    yield from of_media()
    yield from of_motion()


if __name__ == "__main__":
    compared(__doc__ or "", all_values())
