# SPDX-License-Identifier: Apache-2.0
"""One small result of the whole pipeline, made once for all tests that look at it."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec

from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import carry_out, run
from rangesim.results.experiment_results import Result
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


@cache
def result_of_two_cameras() -> Result:
    """Two instruments that see the tabletop by cameras of different sizes, each in its own pass."""
    found = []
    for name, width, height in (("ideal", 96, 72), ("amcw", 64, 36)):
        instruments = (Instrument(name, SENSORS[name]),)
        found.append(carry_out(replace(small_experiment(), instruments=instruments, width=width, height=height)))
    first, second = found
    (other,), (record,) = second.measurements, second.info.instruments
    info = msgspec.structs.replace(
        first.info,
        experiment={
            **first.info.experiment,
            "instrument": [*first.info.experiment["instrument"], *second.info.experiment["instrument"]],
        },
        passes=2,
        instruments=[*first.info.instruments, msgspec.structs.replace(record, light_pass=2)],
        times_s={**first.info.times_s, "transport_2": second.info.times_s["transport_1"]},
    )
    return Result(
        replace(first.experiment, instruments=(*first.experiment.instruments, *second.experiment.instruments)),
        (*first.measurements, replace(other, light_pass=2)),
        (*first.passes, *second.passes),
        info,
    )
