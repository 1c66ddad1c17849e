# SPDX-License-Identifier: Apache-2.0
"""Sweeps: which passes they need, what they hold fast, their intervals, and that they go on where they ended."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig

from rangesim import decode, expose
from rangesim.codes import GrayPhase
from rangesim.errors import FileFormatError
from rangesim.evaluation.closed_forms import error_by_theory
from rangesim.instrument.instrument import Instrument
from rangesim.presets import instrument
from rangesim.sensors import StructuredLight
from rangesim.sweep import Sweep, carry_out, load_sweep, measure_pass, plan, sweep_from_dict, write_sweep
from rangesim.sweep import sweep_run as running
from rangesim.sweep.confidence_intervals import of_fraction, of_mean
from rangesim.sweep.measure_pass import item_bytes
from rangesim.sweep.sweep_tables import rows_table

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("sweep_*.toml"))
TINY = {"width": 32, "height": 24, "caustics": False, "spp": 4}


def wall(sensors: tuple[Any, ...] = ("amcw",), seeds: int = 2, **vary: Any) -> Sweep:
    varied = {path.replace("__", "."): values for path, values in vary.items()}
    return Sweep("wall", sensors, varied, TINY, seeds=seeds)


# ---- Settings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"vary": {"scene": {"distance": [1.0]}}}, "unknown path 'scene.distance' .did you mean 'scene.distance_m'"),
        ({"vary": {"amcw": {"power": [1.0]}}}, "did you mean 'amcw.power_w'"),
        ({"detectr": {"bits": 8}}, "unknown path 'detectr.bits' .did you mean 'detector.bits'"),
        ({"vary": {"power_w": [-1.0]}}, "expected power_w to be positive"),
        ({"vary": {"power_w": 2.0}}, "expected vary.power_w as a list"),
        ({"sensors": ["amcw", "amcw"]}, "expected sensors of different names, got 'amcw' twice"),
        ({"scene": "wal"}, "did you mean 'wall'"),
        ({"scene": {"name": "wall", "distance": 1.0}}, "did you mean 'distance_m'"),
        ({"exposure": "fix"}, "expected exposure"),
        ({"exposure": "auto", "exposure_s": 0.1}, "expected exposure or exposure_s, got both"),
        ({"exposure": "auto", "vary": {"exposure_s": [0.1, 0.2]}}, "expected exposure or exposure_s, got both"),
        ({"power_w": 1.0, "vary": {"power_w": [1.0, 2.0]}}, "expected power_w as one value or in vary, got both"),
        ({"vary": {"power_w": [1, 2.0, 1.0]}}, r"expected different values of vary\.power_w, got 1\.0 twice"),
        ({"vary": {key: [*range(1, 1001)] for key in ("power_w", "baseline_m", "exposure_s")}}, "at most 10000 combin"),
        ({"ambient": 1}, "expected ambient as a table of settings, got 1"),
        ({"tolerence_m": 0.1}, "did you mean 'tolerance_m'"),
    ],
)
def test_what_a_sweep_cannot_be_is_said_in_a_sentence(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        sweep_from_dict({"scene": "wall", "sensors": ["amcw"], **change})


def test_a_setting_reaches_the_sensors_that_have_it() -> None:
    sweep = sweep_from_dict(
        {
            "scene": {"name": "wall", "reflectance": 0.3},
            "sensors": ["amcw", "gray", "kinect-v2"],
            "vary": {"scene": {"distance_m": [1.0, 2.0]}, "sensor": {"contrast": [0.5]}},
            "detector": {"read_noise_e": 7.0},
            "kinect-v2": {"power_w": 3.0},
            "ambient": {"illuminance_lux": 100.0},
        }
    )
    point = sweep.points[1]
    assert point.scene.values == {"reflectance": 0.3, "distance_m": 2.0}
    assert point.ambient is not None
    assert point.ambient.illuminance_lux == 100.0
    amcw, gray, kinect = map(point.instrument, sweep.sensor_names)
    assert amcw.sensor.contrast == kinect.sensor.contrast == 0.5  # type: ignore[attr-defined]
    assert {i.detector.read_noise_e for i in (amcw, gray, kinect)} == {7.0}  # type: ignore[union-attr]
    assert [i.power_w for i in (amcw, gray, kinect)] == [1.0, 1.0, 3.0]
    assert gray.sensor == instrument("gray").sensor


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_sweeps_of_ten_lines(path: Path) -> None:
    lines = [line for line in path.read_text().splitlines() if line and not line.startswith("#")]
    assert len(lines) <= 10
    assert len(load_sweep(path).points) > 1


def test_a_file_that_is_no_sweep_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('scene = "wall"\n')
    with pytest.raises(FileFormatError, match=r"a\.toml: sweep: missing 'sensors'"):
        load_sweep(tmp_path / "a.toml")


# ---- Passes --------------------------------------------------------------------------------------------------------


def test_only_scene_emitter_and_camera_need_passes() -> None:
    codes = ("gray", "gray-phase", "xor")  # of one projector
    varied = {"power_w": (1.0, 2.0), "exposure_s": (1e-3, 2e-3), "ambient__illuminance_lux": (0.0, 100.0)}
    planned = plan(wall(codes, seeds=5, scene__distance_m=(1.0, 2.0), detector__read_noise_e=(1.0, 5.0), **varied))
    assert len(planned.passes) == 2  # of the two distances
    assert [len(one.jobs) for one in planned.passes] == [3 * 2 * 2 * 2 * 2] * 2
    assert all(len(job["seeds"]) == 5 for one in planned.passes for job in one.jobs)


def test_five_devices_at_twelve_distances_take_twelve_passes_each() -> None:
    planned = plan(load_sweep(next(path for path in EXAMPLES if "distance" in path.stem)))
    assert (len(planned.sweep.points), len(planned.sweep.given), planned.sweep.seeds) == (12, 5, 20)
    assert len(planned.passes) == 12 * 5
    assert not planned.probed  # devices state their exposures


def test_what_a_setting_does_not_change_is_measured_once() -> None:
    planned = plan(wall(("amcw", "gray"), sensor__contrast=(0.5, 0.8)))
    jobs = {name: {(c.light_pass, c.job) for c in planned.cells if c.sensor == name} for name in ("amcw", "gray")}
    assert (len(jobs["amcw"]), len(jobs["gray"])) == (2, 1)  # bits of patterns have no such contrast


def test_projectors_stay_where_they_are_while_the_scene_moves() -> None:
    planned = plan(wall(("gray",), scene__distance_m=(0.5, 1.0, 4.0)))
    assert planned.working_distance_m == pytest.approx(1.0, abs=0.01)
    assert len({one.rig.T_camera_projector.tobytes() for one in planned.passes}) == 1


def test_only_points_that_differ_in_the_light_transport_alone_share_their_noise() -> None:
    def seeds_of_passes(**vary: Any) -> list[set[int]]:
        return [{s for job in one.jobs for s in job["seeds"]} for one in plan(wall(("amcw",), 3, **vary)).passes]

    fine, coarse = seeds_of_passes(max_depth=(2, 3))
    assert fine == coarse
    for vary in ({"scene__distance_m": (1.0, 2.0)}, {"seed": (0, 1)}):
        one, other = seeds_of_passes(**vary)
        assert not one & other
    (both,) = seeds_of_passes(power_w=(1.0, 2.0))
    assert len(both) == 6


# ---- Results -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def result() -> Any:
    return carry_out(wall(("amcw",), 6, scene__distance_m=(0.5, 1.0), power_w=(1.0, 4.0)))


def test_rows_are_of_each_point_sensor_seed_and_surface(result: Any) -> None:
    table = rows_table(result)
    assert len(table["seed"]) == 4 * 1 * 6 * 2  # matte and all
    assert {len(column) for column in table.values()} == {48}
    assert set(zip(table["kind"], table["name"], strict=True)) == {("material", "matte"), ("all", "all")}
    sums = np.sum([table[kind] for kind in ("right", "wrong", "missing")], axis=0)
    np.testing.assert_allclose(sums, 1.0, atol=1e-12)


def test_exposure_is_fixed_where_no_point_saturates(result: Any) -> None:
    assert len({row["exposure_s"] for row in result.rows}) == 1
    chosen = result.exposures["amcw"]
    assert result.sweep.points[chosen.point].values == {"scene.distance_m": 0.5, "power_w": 4.0}  # the brightest
    assert all(row["missing"] < 0.05 for row in result.rows)


def test_power_scales_the_light_of_one_pass(result: Any) -> None:
    assert len(result.plan.passes) == 2
    by_power = {row["power_w"]: row["theory_m"] for row in result.summary if row["scene.distance_m"] == 1.0}
    assert 1 < by_power[1.0] / by_power[4.0] < 4  # between shot noise alone and read noise alone: 2 and 4


def test_theory_lies_near_the_error(result: Any) -> None:
    for row in result.summary:
        assert row["error_m"].mean == pytest.approx(row["theory_m"], rel=0.1)


def test_a_sweep_goes_on_where_it_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the engine replaced by a loop: `tests/test_campaign.py` is about the engine."""
    done: list[str] = []

    def run_items(function: Callable[[Any], bytes], items: Any, store: Any, *_: Any, retry: bool) -> Any:
        for key, item in items.items():
            if key not in store:
                done.append(key)
                store.write(key, function(item))
        return type("Outcome", (), {"quarantined": ()})

    monkeypatch.setattr(running, "run_items", run_items)
    sweep = Sweep("wall", ("ideal-tof",), {"scene.distance_m": (1.0, 2.0)}, TINY)
    first = write_sweep(carry_out(sweep, tmp_path), tmp_path).read_bytes()
    assert len(done) == 2
    store = running.ItemStore(tmp_path)
    store.discard(done[0])
    again = write_sweep(carry_out(sweep, tmp_path), tmp_path).read_bytes()
    assert done[2:] == done[:1]
    assert again == first


def test_items_are_plain_data_and_give_the_same_bytes() -> None:
    ((key, item),) = plan(wall(("gray",), scene__distance_m=(1.0,))).items({"gray": 1e-4})
    assert json.loads(json.dumps(item)) == item
    assert item_bytes(json.loads(json.dumps(item))) == item_bytes(item)
    other = plan(wall(("gray",), seeds=3, scene__distance_m=(1.0,))).items({"gray": 1e-4})[0][0]
    assert other != key


def test_a_scene_of_a_file_of_the_user_has_its_parameters(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "from rangesim.scene.parametric import wall\n\n\ndef far(extra_m=0.5):\n    return wall(1.0 + extra_m)\n"
    )
    table = {"scene": "own.py:far", "sensors": ["ideal-tof"], "vary": {"scene": {"extra_m": [0.5, 1.0]}}, **TINY}
    planned = plan(sweep_from_dict(table, tmp_path))
    assert planned.working_distance_m == pytest.approx(1.75, abs=0.01)
    before = planned.items({})[0][0]
    (tmp_path / "own.py").write_text((tmp_path / "own.py").read_text() + "# changed\n")
    assert plan(sweep_from_dict(table, tmp_path)).items({})[0][0] != before


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("    return 1 / (distance_m - 1.0)", "own.py, line 3, fails: ZeroDivisionError"),
        ("    import sys; sys.exit(0)", "own.py, line 3, fails: SystemExit: 0"),
        ("    return {'type': 'no scene'}", "own.py fails: "),
        ("    return (", "own.py, line 3, fails: SyntaxError"),
    ],
)
def test_a_scene_function_that_fails_ends_in_a_sentence_with_file_and_line(
    tmp_path: Path, body: str, sentence: str
) -> None:
    (tmp_path / "own.py").write_text(f"\ndef own(distance_m=2.0):\n{body}\n")
    table = {"scene": "own.py:own", "sensors": ["amcw"], "vary": {"scene": {"distance_m": [1.0, 2.0]}}}
    with pytest.raises(FileFormatError, match=f"^.*{sentence}"):
        plan(sweep_from_dict(table, tmp_path))


def test_the_page_and_the_tables_are_written(result: Any, tmp_path: Path) -> None:
    page = write_sweep(result, tmp_path).read_text()
    rows = list(csv.DictReader((tmp_path / "rows.csv").read_text().splitlines()))
    assert len(rows) == len(result.rows)
    reach = next(line for line in page.split("<p>") if "95 % of the readings are within 10 mm" in line)
    assert "amcw" in reach
    (lowest, highest) = (
        next(r for r in result.summary if r["sensor"] == "amcw" and r["kind"] == "all" and r["scene.distance_m"] == d)
        for d in (min(result.sweep.vary["scene.distance_m"]), max(result.sweep.vary["scene.distance_m"]))
    )
    grown = next(line for line in page.split("<p>") if line.startswith("Error over distance"))
    for row in (lowest, highest):
        assert f"{1e3 * row['error_m'].mean:.3g} mm at {row['scene.distance_m']:g} m" in grown
    assert "Exposures are fixed" in page
    import pyarrow.parquet as pq

    assert pq.read_table(tmp_path / "rows.parquet").num_rows == len(rows)


def test_theory_ends_with_the_range_of_a_sensor(tmp_path: Path) -> None:
    """A wall at 4 m is read at 0.16 m by direct time of flight, whose histogram ends at 3.84 m."""
    result = carry_out(wall(("direct-tof",), 3, scene__distance_m=(2.0, 3.0, 4.0)))
    near, middle, far = (row for row in result.summary if row["kind"] == "all")
    assert near["theory_m"] < middle["theory_m"] < 0.01
    assert far["theory_m"] is None
    assert far["error_m"].mean > 3.0
    assert "m at 3 m (beyond its range at 4 m)" in write_sweep(result, tmp_path).read_text()
    middle["theory_m"], far["causes"] = None, {"shadowed": 1.0}  # no theory for other reasons: within its range
    assert "beyond its range" not in write_sweep(result, tmp_path).read_text()


def test_an_error_that_theory_expects_is_no_outlier() -> None:
    """Windows of whole bins give readings of two places; of the rarer one, the robust deviation knows nothing."""
    errors = np.append(np.linspace(0.9, 1.1, 90), np.full(10, -1.5)) * 1e-3
    found = measure_pass._errors(np.append(errors, 0.5), np.full(101, 1e-3))
    assert found["error_m"] == pytest.approx(np.sqrt(np.mean(errors**2)))
    alone = measure_pass._errors(errors, None)
    assert alone["theory_m"] is None
    assert alone["error_m"] == pytest.approx(1e-3, rel=0.01)  # without the rarer readings


# ---- Intervals -----------------------------------------------------------------------------------------------------


def test_intervals_of_means_cover_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(1)
    found = [of_mean(list(rng.normal(3.0, 2.0, 5))) for _ in range(2000)]
    covered = np.mean([one.low <= 3.0 <= one.high for one in found])
    assert covered == pytest.approx(0.95, abs=0.015)  # three standard errors


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.9])
def test_intervals_of_fractions_cover_the_truth_nearly_as_often_as_they_say(fraction: float) -> None:
    rng = np.random.default_rng(2)
    counts = rng.binomial(200, fraction, 2000)
    covered = np.mean([of_fraction(int(k), 200).low <= fraction <= of_fraction(int(k), 200).high for k in counts])
    assert covered == pytest.approx(0.95, abs=0.03)  # Wilson's steps: few counts are possible


def test_nothing_known_has_no_interval() -> None:
    assert all(math.isnan(x) for x in of_mean([None, math.nan]))
    assert all(math.isnan(x) for x in of_fraction(0, 0))


# ---- Closed forms --------------------------------------------------------------------------------------------------


WIDE = StructuredLight(code=GrayPhase(period_px=64.0))
"""Fringes so wide that the pixels, which are points here, would average none of them away."""


@pytest.mark.parametrize(
    "used", [Instrument("fringes", WIDE), *map(instrument, ("amcw", "direct-tof", "gray"))], ids=lambda used: used.name
)
def test_closed_forms_are_the_errors_of_decoded_frames(used: Instrument) -> None:
    signals = plane_signals(stereo_rig(320, 16), used.sensor, distance_m=1.5)
    errors, theory = [], []
    for seed in range(3):
        capture = expose(signals, used.sensor, used.detector, seed=seed)
        image = decode(capture)
        errors.append((image.z - signals.truth.z)[image.valid])
        expected = error_by_theory(signals, capture, used.sensor.default_decoder)
        assert expected is not None
        theory.append(expected[image.valid])
    ratio = np.sqrt(np.mean(np.square(np.concatenate(errors))) / np.mean(np.square(np.concatenate(theory))))
    assert ratio == pytest.approx(1.0, abs=0.04)
