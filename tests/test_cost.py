# SPDX-License-Identifier: Apache-2.0
"""The cost of an experiment: counted, said before the work, and refused where the memory is not there."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from small_result import ROOT

from rangesim import load_scene
from rangesim.cli import main
from rangesim.experiment import Experiment
from rangesim.motion import ConstantTwist, Motion, Timing
from rangesim.pipeline import cost, experiment_run
from rangesim.pipeline.cost import Cost, available_memory_bytes, estimate_cost
from rangesim.pipeline.shared_passes import group_by_rig
from rangesim.presets import instrument
from rangesim.sensors import DirectToF
from rangesim.settings import limits

MATTE = str(ROOT / "scenes" / "matte.xml")


def of(experiment: Experiment, trial: bool = False) -> Cost:
    scene = load_scene(experiment.scene)
    return estimate_cost(experiment, scene, group_by_rig(experiment, scene), trial)


def test_light_paths_are_pixels_times_samples_times_passes() -> None:
    usual = Experiment(MATTE, width=64, height=48, spp=4, max_depth=7)
    found = of(usual)
    assert (found.light_paths, found.passes, found.segments) == (2 * 64 * 48 * 4, 2, 7)


def test_caustics_cost_time_and_memory_in_scenes_with_glass_alone() -> None:
    for scene, has_glass in (("tabletop", True), ("matte", False)):
        usual = Experiment(str(ROOT / "scenes" / f"{scene}.xml"), width=64, height=48, spp=4)
        on, off = of(usual), of(replace(usual, caustics=False))
        assert on.seconds - off.seconds == pytest.approx(has_glass * on.passes * cost.CAUSTICS_S)
        assert on.memory_bytes - off.memory_bytes == has_glass * cost.CAUSTICS_BYTES


def test_each_frame_of_a_scene_that_moves_is_a_pass() -> None:
    moves = Motion({"floor": ConstantTwist(velocity_m_s=(0.1, 0.0, 0.0))})
    one = replace(instrument("gray"), timing=Timing(frame_period_s=0.01))
    found = of(Experiment(MATTE, width=64, height=48, spp=4, instruments=(one,), motion=moves))
    assert found.passes == one.sensor.n_frames + 1  # and the middle of the acquisition
    assert found.light_paths == found.passes * 64 * 48 * 4


def test_memory_grows_with_pixels_and_bins() -> None:
    few = Experiment(
        MATTE, width=640, height=480, instruments=(replace(instrument("direct-tof"), sensor=DirectToF(64)),)
    )
    many = replace(few, instruments=(replace(few.instruments[0], sensor=DirectToF(6400)),))
    frames = 640 * 480 * 6400 * 4
    assert of(few).memory_bytes < 2e9
    assert 6 * frames < of(many).memory_bytes < 12 * frames  # two halves, smooth light apart, and a capture to judge by


def test_what_exceeds_the_memory_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "available_memory_bytes", lambda: 16 * 10**9)
    large = Experiment(MATTE, width=8000, height=8000, spp=1)
    start = time.process_time()
    with pytest.raises(ValueError, match=r"expected a run within the .* GB .* this one takes about 128 M light paths"):
        experiment_run.run(large, tmp_path / "out")
    assert time.process_time() - start < 5
    assert not list(tmp_path.iterdir())


def test_the_memory_that_a_run_may_take_can_be_set(tmp_path: Path) -> None:
    small = Experiment(MATTE, width=32, height=24, spp=1)
    with limits.raised(memory=10**6), pytest.raises(ValueError, match=r"within the 0\.0 GB"):
        experiment_run.run(small, tmp_path / "out")
    with limits.raised(memory=10**15):
        Cost(1, 1, 1, 10**14, 1.0).check_memory()


def test_where_the_memory_is_unknown_nothing_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "_meminfo", lambda: None)
    monkeypatch.setattr(cost, "_cgroup", lambda: [None])
    assert available_memory_bytes() is None
    Cost(1, 1, 1, 1, 10**18, 1.0).check_memory()


def test_the_least_of_all_limits_on_memory_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "memory.max").write_text("1000\n")
    (tmp_path / "memory.current").write_text("300\n")
    left = cost._bytes_left(tmp_path, "memory.max", "memory.current")
    assert left == 700
    (tmp_path / "memory.max").write_text("max\n")
    assert cost._bytes_left(tmp_path, "memory.max", "memory.current") is None
    monkeypatch.setattr(cost, "_meminfo", lambda: 500)
    monkeypatch.setattr(cost, "_cgroup", lambda: [None, left])
    assert available_memory_bytes() == 500


def command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *arguments: str
) -> tuple[int, str, str]:
    monkeypatch.setattr("sys.argv", ["rangesim", "run", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    output = capsys.readouterr()
    return int(end.value.code or 0), output.out, output.err


def test_an_estimate_writes_nothing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    size = ("--width", "64", "--height", "48", "--spp", "4")
    for place in (("--out", str(tmp_path / "out")), ()):
        code, out, err = command(capsys, monkeypatch, MATTE, *size, *place, "--estimate")
        assert (code, err) == (0, "")
        assert out.startswith("about 24.6 k light paths of up to 5 segments in 2 passes, 0.4 GB, ")
    assert not list(tmp_path.iterdir())
    code, _, err = command(capsys, monkeypatch, MATTE, *size)
    assert code == 2
    assert "expected --out DIRECTORY" in err


def test_no_caustics_reaches_the_experiment(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It makes the run of a scene with glass cheaper."""
    small = ("tabletop", "--width", "64", "--height", "48", "--spp", "4", "--estimate")
    (_, with_them, _), (_, without, _) = (
        command(capsys, monkeypatch, *small, *more) for more in ((), ("--no-caustics",))
    )
    assert with_them != without
    assert with_them.split(",")[0] == without.split(",")[0]


def test_sizes_without_measure_are_one_sentence_at_once(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    start = time.process_time()
    for size in (
        ("--width", "1000000", "--height", "1000000"),
        ("--spp", "1" + "0" * 30),
        ("--max-depth", "1" + "0" * 18),
    ):
        code, out, err = command(capsys, monkeypatch, MATTE, *size, "--out", str(tmp_path / "out"))
        assert (code, out) == (1, "")
        assert err.startswith("rangesim: expected at most ")
        assert err.count("\n") == 1
    assert time.process_time() - start < 3


def test_only_long_or_large_runs_are_announced() -> None:
    assert not Cost(1, 1, 1, 10**8, 10.0).is_large
    assert Cost(1, 1, 1, 10**8, 100.0).is_large
    assert Cost(1, 1, 1, 10**10, 1.0).is_large


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.2, "1 s"), (42.4, "42 s"), (150, "2.5 min"), (7200, "2 h"), (864000, "10 d")]
)
def test_durations_are_readable(seconds: float, text: str) -> None:
    assert str(Cost(20_000_000, 5, 1, 1_100_000_000, seconds)) == (
        f"about 20 M light paths of up to 5 segments in 1 pass, 1.1 GB, {text}"
    )
    assert str(Cost(2, 5, 1, 10**8, 9.0, "2 idle cores")).endswith(", 0.1 GB, 9 s on 2 idle cores")


class BusyClock:
    """The module `time` on a machine where other work takes all but a part of the processors."""

    def __init__(self, slowness: float) -> None:
        self.slowness = slowness
        self.thread_time, self.process_time = time.thread_time, time.process_time

    def monotonic(self) -> float:
        return self.slowness * time.monotonic()


@pytest.mark.parametrize(("width", "spp", "slowness"), [(640, 4000, 50.0), (320, 20_000, 3.0)])
def test_other_work_on_the_machine_does_not_lengthen_an_estimate(
    width: int, spp: int, slowness: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An estimate of 6 minutes once became 4.9 hours."""
    experiment = Experiment(MATTE, width=width, height=3 * width // 4, spp=spp, instruments=(instrument("ideal-tof"),))
    of(experiment, trial=True)  # compiles
    usual = of(experiment, trial=True)
    monkeypatch.setattr(cost, "time", BusyClock(slowness))
    busy = of(experiment, trial=True)
    assert usual.seconds / 1.5 < busy.seconds < 1.5 * usual.seconds
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert busy.machine == (f"{cores} idle cores" if cores != 1 else "1 idle core")


@pytest.mark.validation
def test_a_long_run_is_estimated_by_a_trial_within_a_factor_of_two() -> None:
    experiment = Experiment(MATTE, width=320, height=240, spp=64, instruments=(instrument("ideal-tof"),))
    scene = load_scene(experiment.scene)
    ((rig, instruments),) = group_by_rig(experiment, scene)
    from rangesim import transport

    compile_s, fixed_s, path_s = cost._timed_trial(experiment, scene, (rig, instruments))
    assert compile_s >= 0
    start = cost._Elapsed.now()
    transport(scene, rig, [i.sensor for i in instruments], spp=64)
    took = (cost._Elapsed.now() - start).idle_s
    assert took / 2 < fixed_s + 320 * 240 * 64 * path_s < took * 2


@pytest.mark.validation
def test_an_estimate_stays_beside_real_work() -> None:
    """Three busy processes for each core."""
    experiment = Experiment(MATTE, width=640, height=480, spp=4000, instruments=(instrument("ideal-tof"),))
    of(experiment, trial=True)  # compiles
    usual = of(experiment, trial=True)
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3 * (os.cpu_count() or 1))]
    try:
        found = of(experiment, trial=True)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert usual.seconds / 1.5 < found.seconds < 1.5 * usual.seconds
