# SPDX-License-Identifier: Apache-2.0
"""One small result of the whole pipeline, made once for all tests that look at it."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import carry_out, run
from rangesim.results.experiment_results import Result
from rangesim.rig import translation
from rangesim.scene import load_scene
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, StructuredLight

ROOT = Path(__file__).resolve().parents[1]
SCENES = ROOT / "scenes"
SENSORS = {
    "lines": StructuredLight(256, 160),
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
    """Two instruments that see the tabletop by cameras of different sizes in different places."""
    experiment = small_experiment()
    scene = load_scene(experiment.scene)
    T = scene.rig(0.03).T_world_camera @ translation(0.1, 0.0, 0.15)
    instruments = (
        Instrument("ideal", SENSORS["ideal"], width=96, height=72),
        Instrument("amcw", SENSORS["amcw"], width=64, height=36, T_world_camera=T),
    )
    return carry_out(replace(experiment, instruments=instruments), scene=scene)
