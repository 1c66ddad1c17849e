# SPDX-License-Identifier: Apache-2.0
"""One small result of the whole pipeline, made once for all tests that look at it."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import run
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, StructuredLight

ROOT = Path(__file__).resolve().parents[1]
SCENES = ROOT / "scenes"
SENSORS = {
    "lines": StructuredLight(256, 160, period_px=16),
    "amcw": AmcwToF(),
    "histogram": DirectToF(bins=64, bin_s=400e-12),
    "ideal": IdealToF(),
}


def small_experiment() -> Experiment:
    """All kinds of sensors on the tabletop, small and noisy."""
    instruments = tuple(Instrument(name, sensor) for name, sensor in SENSORS.items())
    return Experiment(str(SCENES / "tabletop.xml"), width=120, height=90, spp=4, seed=3, instruments=instruments)


@cache
def small_result() -> Path:
    """Directory of the result."""
    folder = Path(tempfile.mkdtemp(prefix="rangesim-test-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    run(small_experiment(), folder / "result")
    return folder / "result"
