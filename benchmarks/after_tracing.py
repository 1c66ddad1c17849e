# SPDX-License-Identifier: Apache-2.0
"""Time of what follows the tracing of light: exposure, decoding and the point cloud of one sensor.

The signals are those of a tilted matte plane in ambient light, computed without a renderer. Every stage runs once to
compile its kernels, then `--repeats` times; the fastest counts. The last line is JSON, seconds:

    gray-phase, amcw, direct-tof    of each: expose, decode, to_point_cloud

Usage: python benchmarks/after_tracing.py [--sensors gray-phase amcw direct-tof] [--width 1280 --height 1024]
           [--repeats 3]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np

from rangesim import Intrinsics, Rig, Sensor, Signals, StillSignals, decode, expose
from rangesim.response import LightPath, NumpyMath, Response, TransientHistogram
from rangesim.rig import translation
from rangesim.sensors import presets
from rangesim.signals import EnergySplit, GroundTruth

NORMAL = (0.2, 0.1, -1.0)
DISTANCE_M = 1.0
ALBEDO, AMBIENT = 0.5, 0.05
BASELINE_M = {"gray-phase": 0.2, "amcw": 0.03, "direct-tof": 0.03}
T = TypeVar("T")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", nargs="+", choices=BASELINE_M, default=list(BASELINE_M))
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()

    result = {}
    for name in args.sensors:
        sensor = presets()[name]
        result[name] = times(sensor, plane(args.width, args.height, sensor, BASELINE_M[name]), args.repeats)
        print(name, result[name], flush=True)
    print(json.dumps(result))


def times(sensor: Sensor, signals: Signals, repeats: int) -> dict[str, float]:
    """Seconds of each stage."""
    capture, expose_s = fastest(partial(expose, signals, sensor, sensor.default_detector), repeats)
    image, decode_s = fastest(partial(decode, capture), repeats)
    _, points_s = fastest(image.to_point_cloud, repeats)
    return {"expose": expose_s, "decode": decode_s, "to_point_cloud": points_s}


def fastest(call: Callable[[], T], repeats: int) -> tuple[T, float]:
    """What a call returns, and the seconds of the fastest of its `repeats` runs after the first."""
    value, seconds = call(), []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return value, round(min(seconds), 4)


def plane(width: int, height: int, sensor: Sensor, baseline_m: float) -> Signals:
    """Signals of a tilted matte plane for a sensor: direct light alone."""
    camera, projector = Intrinsics.from_fov(width, height, 45), Intrinsics.from_fov(1280, 800, 70)
    rig = Rig(camera=camera, projector=projector, T_camera_projector=translation(baseline_m, 0.0, 0.0))
    rays = camera.directions(camera.pixel_centres())
    z = DISTANCE_M * NORMAL[2] / (rays @ np.asarray(NORMAL))
    points = rays * z[..., None]
    in_projector = points - rig.T_camera_projector[:3, 3]
    range_m = np.linalg.norm(points, axis=-1)
    uv = projector.project(in_projector)
    lit = np.full(z.shape, True)
    path = LightPath(uv[..., 0], uv[..., 1], range_m + np.linalg.norm(in_projector, axis=-1), lit)
    radiance = (ALBEDO / np.pi * rig.projector_irradiance / in_projector[..., 2] ** 2).astype(np.float32)
    zero = np.zeros(z.shape, dtype=np.float32)
    energy = EnergySplit(radiance, zero, zero, zero, zero, np.full_like(zero, AMBIENT))
    normal, ids = np.full((*z.shape, 3), np.nan, dtype=np.float32), np.zeros(z.shape, dtype=np.int32)
    truth = GroundTruth(
        z.astype(np.float32), range_m.astype(np.float32), normal, ids, ids, uv.astype(np.float32), lit,
        ("plane",), ("matte",),
    )  # fmt: skip
    return StillSignals(rig, energy, truth, channels={r: channels(r, path, radiance) for r in sensor.responses()})


def channels(response: Response, path: LightPath, radiance: np.ndarray) -> np.ndarray:
    """(c, h, w) float32 of one light path per pixel."""
    if not isinstance(response, TransientHistogram):
        return np.stack([radiance * w for w in response.weights(path, NumpyMath())]).astype(np.float32)  # type: ignore[attr-defined]
    result = np.zeros((response.channels + 1, *radiance.shape), dtype=np.float32)  # the last takes what is in no bin
    for index, weight in response.bin_weights(path, NumpyMath()):
        place = np.asarray(index)[None]
        np.put_along_axis(result, place, np.take_along_axis(result, place, 0) + radiance * weight, 0)
    return result[:-1]


if __name__ == "__main__":
    main()
