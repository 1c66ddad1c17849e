# SPDX-License-Identifier: Apache-2.0
"""The result of a scanner is read back, and its report, summary and times speak of ranges and of a turn."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from rangesim import Beam, DirectToF, SpadDetector, Spinning
from rangesim.cli import app
from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import run
from rangesim.results.experiment_results import load_result

PERIOD_S = 0.1
COLUMNS = 40


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A turn of a head, and a pinhole camera, on the street."""
    sensor = DirectToF(bins=512, bin_s=1e-9, pulse_fwhm_s=4e-9, laser="single-shot")
    head = Spinning(elevations_deg=(1.0, -1.0, -4.0), columns=COLUMNS, period_s=PERIOD_S)
    lidar = Instrument(
        "lidar", sensor, SpadDetector(bits=16, pile_up=False), camera=head, projector=Beam((3e-3, 3e-3)),
        power_w=0.01, exposure_s=1e-6,
    )  # fmt: skip
    out = tmp_path_factory.mktemp("scanner") / "result"
    flash = Instrument("flash", sensor, SpadDetector(bits=16), width=16, height=12, power_w=1e3)
    run(Experiment("street", spp=2, caustics=False, max_depth=2, instruments=(lidar, flash)), out)
    return out


def test_an_acquisition_lasts_from_the_first_ray_to_the_last(result: Path) -> None:
    times = {m.name: m.metadata for m in load_result(result).measurements}
    assert times["lidar"].acquisition_s == pytest.approx(PERIOD_S * (1 - 1 / COLUMNS) + 1e-6, rel=1e-9)
    assert times["flash"].acquisition_s == times["flash"].exposure_s


def test_the_report_is_written_again_and_says_whose_readings_are_ranges(result: Path) -> None:
    assert CliRunner().invoke(app, ["report", str(result)]).exit_code == 0
    page = (result / "report.html").read_text(encoding="utf-8")
    assert "Here, z of Time of flight (direct), lidar is the range along the ray." in page


def test_the_summary_of_a_decoded_turn_states_ranges(result: Path, tmp_path: Path) -> None:
    answer = CliRunner().invoke(app, ["decode", str(result / "lidar" / "capture"), "--out", str(tmp_path / "decoded")])
    assert answer.exit_code == 0
    assert ", range from " in answer.output
