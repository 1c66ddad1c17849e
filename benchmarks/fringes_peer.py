# SPDX-License-Identifier: Apache-2.0
"""Fringes of one and of several periods decoded here and by the package `fringes` (GPL, installed apart).

Both decode the same 8-bit frames in this process, in as many threads, warm and in turn. Times are medians of `RUNS`
runs: of the clock, and of the processor in all threads, which other programs of the machine change less.

Only ours looks for a gamma, refuses pixels (weak, saturated, ambiguous), and checks whether the frames contradict the
code; `checks_ms` is the time of these checks, which `ours_ms` contains.

Usage: python benchmarks/fringes_peer.py
Prints a line of JSON per number of periods {periods, worst_px, decoded, ours_ms, theirs_ms, checks_ms, ours_cpu_ms,
theirs_cpu_ms, checks_cpu_ms, ratio, cpu_ratio}; `decoded` is the fraction of pixels that are read here.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from fringes import Fringes

from rangesim import Capture, Status, StructuredLight
from rangesim.codes import MultiFrequency
from rangesim.codes.axis_code import AxisFrames
from rangesim.codes.fringes import FringeConvention
from rangesim.sensors import StructuredLightDecoder

SIZE = 640, 480
"""Pixels of projector and camera."""

PERIODS_IN_AXIS = ((1,), (1, 8, 64))
"""Fringes along the axis of each period. Of three periods: 640, 80 and 10 projector pixels."""

STEPS = 4
"""Phase shifts of each period."""

RUNS = 9
"""Runs of each."""


def medians(runs: dict[str, Callable[[], Any]]) -> tuple[dict[str, float], dict[str, float]]:
    """Medians of the clock and of the processor's time of functions that run in turn, in ms, by their names."""
    clock: dict[str, list[float]] = {name: [] for name in runs}
    processor: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(RUNS):
        for name, run in runs.items():
            start, busy = time.perf_counter(), time.process_time()
            run()
            clock[name].append(time.perf_counter() - start)
            processor[name].append(time.process_time() - busy)
    wall, cpu = (
        {name: round(1e3 * float(np.median(times)), 1) for name, times in each.items()} for each in (clock, processor)
    )
    return wall, cpu


def compare(in_axis: tuple[int, ...]) -> dict[str, Any]:
    """What is printed of fringes of one or several periods."""
    width, height = SIZE
    count = len(in_axis)
    peer = Fringes(X=width, Y=height, axes=(1,), K=count, N=((STEPS,) * count,), v=(in_axis,))
    code = MultiFrequency(tuple(width / v for v in in_axis), STEPS, convention=FringeConvention("-cos", origin_px=0.5))
    sensor = StructuredLight(width, height, code, order=("columns_*",))
    shown = np.asarray(peer.encode()).reshape(-1, height, width)
    albedo = np.random.default_rng(0).uniform(0.4, 0.85, (height, width)).astype(np.float32)
    frames = np.rint(10 + albedo * shown).astype(np.uint8)  # of one albedo, the brightest value would look clipped
    capture, decoder = Capture(frames, sensor), StructuredLightDecoder()
    names, coded = sensor.coded_frames(frames, "columns")
    seen = AxisFrames(capture, "columns", width, names, coded, decoder.contrast(capture, sensor))
    decoded = code.decode(seen, decoder.thresholds)
    runs: dict[str, Callable[[], Any]] = {
        "ours": lambda: decoder.coordinates(capture),
        "theirs": lambda: peer.decode(frames),
        "checks": lambda: code.contradiction(seen, decoded),
    }
    wall, cpu = medians(runs)
    here = decoder.coordinates(capture)
    column = np.asarray(peer.decode(frames)[2]).reshape(height, width) + 0.5
    ok = here.status == Status.OK
    assert here.column is not None
    off = np.abs(here.column - column)[ok]
    worst = float(np.minimum(off, np.abs(width - off)).max())  # theirs counts the centre of the first pixel as 0 or 640
    return {
        "periods": count,
        "worst_px": worst,
        "decoded": float(ok.mean()),
        **{f"{name}_ms": ms for name, ms in wall.items()},
        **{f"{name}_cpu_ms": ms for name, ms in cpu.items()},
        "ratio": round(wall["ours"] / wall["theirs"], 2),
        "cpu_ratio": round(cpu["ours"] / cpu["theirs"], 2),
    }


def main() -> None:
    for in_axis in PERIODS_IN_AXIS:
        print(json.dumps(compare(in_axis)), flush=True)


if __name__ == "__main__":
    main()
