# SPDX-License-Identifier: Apache-2.0
"""A surface that a time-of-flight sensor cannot place is told, as the scene's depth is known."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from small_result import SCENES
from synthetic import signals_of_depth, stereo_rig

from rangesim.capture.exposure import expose
from rangesim.causes.range_limits import fraction_beyond_range
from rangesim.decoding import decode
from rangesim.errors import RangesimWarning
from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import run
from rangesim.response import SPEED_OF_LIGHT
from rangesim.sensor import Sensor
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, StructuredLight


@pytest.mark.parametrize(
    ("sensor", "nearest_m", "farthest_m"),
    [
        (DirectToF(), 0.0, 256 * 100e-12 * SPEED_OF_LIGHT / 2),
        (DirectToF(bins=64, bin_s=400e-12), 0.0, 64 * 400e-12 * SPEED_OF_LIGHT / 2),
        (DirectToF(start_s=10e-9, laser="single-shot"), 10e-9 * SPEED_OF_LIGHT / 2, 35.6e-9 * SPEED_OF_LIGHT / 2),
        (AmcwToF((50e6,)), 0.0, SPEED_OF_LIGHT / 100e6),
        (IdealToF(), 0.0, np.inf),
        (StructuredLight(), 0.0, np.inf),
    ],
)
@pytest.mark.parametrize("farthest", [4.0, 8.0])
def test_the_fraction_outside_the_range_is_that_of_its_limits(
    sensor: Sensor, nearest_m: float, farthest_m: float, farthest: float
) -> None:
    rig = stereo_rig(baseline_m=0.0)
    signals = signals_of_depth(rig, np.linspace(0.5, farthest, 160 * 120).reshape(120, 160), [])
    seen = signals.truth.projector_visible
    range_m = signals.truth.range_m[seen]
    outside = (range_m < nearest_m) | (range_m > farthest_m)
    fraction, middle_m = fraction_beyond_range(sensor, rig, signals.truth)
    assert fraction == pytest.approx(outside.mean(), abs=1e-3)
    if outside.any():
        assert middle_m == pytest.approx(np.median(range_m[outside]), abs=0.01)
    else:
        assert np.isnan(middle_m)


@pytest.mark.parametrize(
    ("modulation_hz", "farthest_m"),
    [((1e6,), 149.9), ((1e6, 2e6), 149.9), ((0.7e6,), 214.1), ((1e5,), 1499.0), ((15e6, 37e6), 100.0)],
)
def test_what_a_low_frequency_reads_right_is_within_its_range(
    modulation_hz: tuple[float, ...], farthest_m: float
) -> None:
    """A whole period of the highest frequency is told apart, even where it is longer than the search."""
    sensor, rig = AmcwToF(modulation_hz), stereo_rig(baseline_m=0.0)
    signals = signals_of_depth(rig, np.linspace(0.5, 0.7 * farthest_m, 160 * 120).reshape(120, 160), [sensor])
    image = decode(expose(signals, sensor))
    within = signals.truth.range_m < farthest_m
    assert within.any()
    np.testing.assert_allclose(image.range_m[within], signals.truth.range_m[within], rtol=1e-3, atol=1e-3)
    assert not sensor.is_beyond_range(2 * signals.truth.range_m[within]).any()
    assert sensor.is_beyond_range(np.array([2.05 * farthest_m])).all()


def test_a_scene_without_a_surface_is_not_outside() -> None:
    rig = stereo_rig(baseline_m=0.0)
    truth = signals_of_depth(rig, np.full((120, 160), np.nan), []).truth
    assert fraction_beyond_range(DirectToF(), rig, truth)[0] == 0


@pytest.mark.parametrize("bins", [32, 64])
def test_run_warns_of_a_wall_beyond_the_range_and_of_no_other(bins: int, tmp_path: Path) -> None:
    """The wall is 1 m away; bins of 100 ps reach 15 mm each."""
    instruments = tuple(Instrument(n, DirectToF(bins=b)) for n, b in (("short", bins), ("long", 256)))
    experiment = Experiment(str(SCENES / "plane.xml"), width=32, height=24, spp=4, instruments=instruments)
    told = "outside the sensor's range, .*: short, 100 % of the lit surface (around 1.0"
    with pytest.warns(RangesimWarning, match=told.replace("(", re.escape("("))) as caught:
        run(experiment, tmp_path / "result")
    assert not any("long" in str(w.message) for w in caught)
