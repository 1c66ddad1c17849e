# SPDX-License-Identifier: Apache-2.0
"""Fringes of several periods decoded here and by the package `fringes` (GPL, installed apart).

Both decode the same 8-bit frames in this process, warm; times are medians of `RUNS` runs.

Usage: python benchmarks/fringes_peer.py
Prints JSON {worst_px, decoded, ours_ms, theirs_ms, ratio}; `decoded` is the fraction of pixels that are read here.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from fringes import Fringes

from rangesim import Capture, Status, StructuredLight
from rangesim.codes import MultiFrequency
from rangesim.codes.fringes import FringeConvention
from rangesim.sensors import StructuredLightDecoder

SIZE = 640, 480
"""Pixels of projector and camera."""

PERIODS_IN_AXIS = (1, 8, 64)
"""Fringes along the axis of each period: 640, 80 and 10 projector pixels."""

STEPS = 4
"""Phase shifts of each period."""

RUNS = 7
"""Runs of each. Medians of theirs varied from 70 to 210 ms with the load of the machine, so run it several times."""


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """The last result of a function, and the median of its times in ms."""
    result, times = run(), []
    for _ in range(RUNS):
        start = time.perf_counter()
        result = run()
        times.append(1e3 * (time.perf_counter() - start))
    return result, statistics.median(times)


def main() -> None:
    width, height = SIZE
    count = len(PERIODS_IN_AXIS)
    peer = Fringes(X=width, Y=height, axes=(1,), K=count, N=((STEPS,) * count,), v=(PERIODS_IN_AXIS,))
    periods = tuple(width / v for v in PERIODS_IN_AXIS)
    code = MultiFrequency(periods, STEPS, convention=FringeConvention("-cos", origin_px=0.5))
    sensor = StructuredLight(width, height, code, order=("columns_*",))
    shown = np.asarray(peer.encode()).reshape(-1, height, width)
    albedo = np.random.default_rng(0).uniform(0.4, 0.85, (height, width)).astype(np.float32)
    frames = np.rint(10 + albedo * shown).astype(np.uint8)  # of one albedo, the brightest value would look clipped
    capture = Capture(frames, sensor)
    theirs, theirs_ms = timed(lambda: peer.decode(frames))
    seen, ours_ms = timed(lambda: StructuredLightDecoder().coordinates(capture))
    column = np.asarray(theirs[2]).reshape(height, width) + 0.5
    ok = seen.status == Status.OK
    off = np.abs(seen.column - column)[ok]
    worst = float(np.minimum(off, np.abs(width - off)).max())  # theirs counts the centre of the first pixel as 0 or 640
    found = {"worst_px": worst, "decoded": float(ok.mean()), "ours_ms": ours_ms, "theirs_ms": theirs_ms}
    print(json.dumps({**found, "ratio": ours_ms / theirs_ms}))


if __name__ == "__main__":
    main()
