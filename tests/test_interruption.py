# SPDX-License-Identifier: Apache-2.0
"""Work is cut into launches of bounded time: a signal ends it soon, progress is told often, no byte depends on it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from synthetic import all_bytes
from tiers import to_validate

import rangesim
from rangesim import AmcwToF, DirectToF, Scene, StructuredLight, transport
from rangesim.light_transport import kernel_launches
from rangesim.light_transport.loop import _dealt
from rangesim.response import FirstReturn

SCENES = Path(__file__).resolve().parent.parent / "scenes"
STOPS_WITHIN_S = 2.0
SLOW_MACHINE = 2.5
"""Others may be at work on the machine of the tests."""

LONG: dict[str, tuple[str, dict[str, int], dict[str, Any]]] = {
    "many pixels": ("tabletop", {"width": 1920, "height": 1440}, {"spp": 4096, "caustics": False, "glint": False}),
    "many samples": ("tabletop", {"width": 64, "height": 48}, {"spp": 1_000_000, "caustics": False, "glint": False}),
    "deep paths": ("cornell", {"width": 160, "height": 120}, {"spp": 100_000, "max_depth": 64, "rr_depth": 64}),
}
SCRIPT = """
import signal, sys
import rangesim
{handler}
for is_last, scene, size, options in {cases!r}:
    scene = rangesim.load_scene(scene)
    rig = scene.rig(**size)
    rangesim.transport(scene, scene.rig(width=64, height=48), [], spp=2)  # compiles
    print("started", flush=True)
    try:
        rangesim.transport(scene, rig, [], **options)
        print("finished", flush=True)
    except KeyboardInterrupt:
        if is_last:
            raise
        print("interrupted", flush=True)
"""
RAISES = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))"


@pytest.fixture(scope="module")
def tabletop() -> Scene:
    return rangesim.load_scene(SCENES / "tabletop.xml")


def sensors() -> list[rangesim.Sensor]:
    return [StructuredLight(160, 100, axes=("columns",)), AmcwToF(), DirectToF(bins=32, bin_s=400e-12)]


# ---- A signal ends the work soon --------------------------------------------------------------------


def script(*names: str, handler: str = "") -> list[str]:
    """Command line of a process that traces these of the `LONG` passes, one after the other when it is interrupted."""
    cases = [(name == names[-1], str(SCENES / f"{LONG[name][0]}.xml"), *LONG[name][1:]) for name in names]
    return [sys.executable, "-c", SCRIPT.format(cases=cases, handler=handler)]


@pytest.mark.validation
def test_ctrl_c_ends_a_pass_without_progress_within_two_seconds() -> None:
    with subprocess.Popen(script(*LONG), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            for name in LONG:
                assert process.stdout.readline() == "started\n"
                time.sleep(1.5)  # launches have found their size by then
                start = time.monotonic()
                process.send_signal(signal.SIGINT)
                is_last = name == list(LONG)[-1]
                assert process.stdout.readline() == ("" if is_last else "interrupted\n"), name
                assert time.monotonic() - start < STOPS_WITHIN_S * SLOW_MACHINE, name
            assert process.stderr.read().endswith("KeyboardInterrupt\n")
            assert process.wait(timeout=30) in (-signal.SIGINT, 130)
        finally:
            process.kill()


@pytest.mark.parametrize(("handler", "expected"), [("", -signal.SIGTERM), *to_validate((RAISES, 7))])
def test_sigterm_ends_a_pass_by_default_and_by_a_handler_that_raises(handler: str, expected: int) -> None:
    line = script("many samples", handler=handler)
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "started\n"
            time.sleep(1.5 if handler else 0.1)  # by default it is the system that ends it
            start = time.monotonic()
            process.send_signal(signal.SIGTERM)
            assert process.stdout.readline() == ""
            assert process.wait(timeout=30) == expected
            assert time.monotonic() - start < STOPS_WITHIN_S * SLOW_MACHINE
        finally:
            process.kill()


@pytest.mark.parametrize("threads", [1, 2])
def test_the_time_that_a_launch_takes_is_known_on_any_number_of_threads(tabletop: Scene, threads: int) -> None:
    """Dr.Jit's only thread runs kernels before it comes back, and what is not waited for must be counted, too: on one
    core launches took for instantaneous grew to a minute each."""
    before = dr.thread_count()
    dr.set_thread_count(threads)
    try:
        for last in range(2):  # first it is compiled
            x = dr.arange(mi.Float, 1 << 20)
            k, turns = mi.UInt32(0), dr.opaque(mi.UInt32, 1000 + last)
            x, *_ = dr.while_loop(
                (x, k, turns), lambda x, k, turns: k < turns, lambda x, k, turns: (dr.fma(x, x, 1.0), k + 1, turns)
            )
            start = time.perf_counter()
            told = kernel_launches.evaluate(x)
            whole = time.perf_counter() - start
    finally:
        dr.set_thread_count(before)
    assert 0.8 * whole < told <= whole


def test_after_an_interruption_the_same_process_traces_the_same_bytes(tabletop: Scene) -> None:
    """Raised where a signal would be, between launches of every kind: caustics, paths, glint."""
    rig, settings = tabletop.rig(projector_size=(160, 100), width=32, height=24), {"spp": 2, "seed": 3}
    expected = all_bytes(transport(tabletop, rig, sensors(), **settings))
    calls = 0

    def interrupt(original: Any, at: int) -> Any:
        def evaluate(arrays: Any) -> float:
            nonlocal calls
            calls += 1
            seconds = original(arrays)
            if calls == at:
                raise KeyboardInterrupt
            return float(seconds)

        return evaluate

    at = 1
    while True:
        calls = 0
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kernel_launches, "evaluate", interrupt(kernel_launches.evaluate, at))
            try:
                transport(tabletop, rig, sensors(), **settings)
            except KeyboardInterrupt:
                at += 1
            else:
                break
    assert at > 5  # projector's and camera's surfaces, caustics, paths, probes, truth
    assert all_bytes(transport(tabletop, rig, sensors(), **settings)) == expected


def test_a_signal_while_a_loop_is_traced_comes_out_as_what_its_handler_raised(tabletop: Scene) -> None:
    class Interrupting(FirstReturn):
        type_name = "interrupting"

        def weights(self, path: Any, m: Any) -> list[Any]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        transport(tabletop, tabletop.rig(width=16, height=12), [Interrupting()], spp=1)
    transport(tabletop, tabletop.rig(width=16, height=12), [FirstReturn()], spp=1)


# ---- No byte depends on where the work is cut -------------------------------------------------------


@pytest.fixture(scope="module")
def uncut(tabletop: Scene) -> tuple[bytes, Callable[[], bytes]]:
    """What a pass gives with launches of the usual size, and the pass once more."""
    rig = tabletop.rig(projector_size=(160, 100), width=31, height=23)
    settings: dict[str, Any] = {"spp": 5, "seed": 3, "max_depth": 7}

    def trace() -> bytes:
        return all_bytes(transport(tabletop, rig, sensors(), **settings))

    return trace(), trace


@pytest.mark.parametrize(
    ("launch_s", "units", "lanes"), [(1e-9, 8000, 512), (1e-9, 15_000, 1 << 18), (1e9, 1 << 40, 1)]
)
def test_launches_of_any_size_give_the_same_bytes(
    uncut: tuple[bytes, Callable[[], bytes]],
    monkeypatch: pytest.MonkeyPatch,
    launch_s: float,
    units: int,
    lanes: int,
) -> None:
    """Few pixels at a time, few turns of the loop at a time, and all at once."""
    expected, trace = uncut
    monkeypatch.setattr(kernel_launches, "LAUNCH_S", launch_s)
    monkeypatch.setattr(kernel_launches, "MAX_OVERRUN", 1.0)
    monkeypatch.setattr(kernel_launches, "FIRST_UNITS", units)
    for module in (rangesim.light_transport.loop, rangesim.light_transport.glint):
        monkeypatch.setattr(module, "min_lanes", lambda: lanes)
    number = 0

    def evaluate(arrays: Any) -> float:
        nonlocal number
        number += 1
        original(arrays)
        return 0.0  # says nothing of the work: its size stays

    original = kernel_launches.evaluate
    monkeypatch.setattr(kernel_launches, "evaluate", evaluate)
    monkeypatch.setattr(kernel_launches, "MAX_GROWTH", 1.0)
    assert trace() == expected
    assert (number > 20) == (units < 1 << 30)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, 100, 255, 256, 1200, 5003])
def test_runs_of_pixels_are_dealt_out_once_each_and_evenly(n: int) -> None:
    order = _dealt(n)
    np.testing.assert_array_equal(np.sort(order), np.arange(n))
    some = np.sort(order[: max(2, n // 10)])
    if n >= 100:
        assert np.diff(some).max() <= 8 * n / len(some)


# ---- Progress ---------------------------------------------------------------------------------------


def test_progress_grows_to_one(tabletop: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_launches.Launches, "learn", lambda *_: None)  # launches of one size
    monkeypatch.setattr(kernel_launches, "FIRST_UNITS", 1 << 17)
    monkeypatch.setattr(kernel_launches, "REPORT_S", 0.0)
    fractions: list[float] = []
    transport(tabletop, tabletop.rig(width=160, height=120), [], spp=16, progress=fractions.append)
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert len(set(fractions)) > 3


def test_progress_is_told_at_most_ten_times_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    clock_s = 0.0
    monkeypatch.setattr(kernel_launches.time, "monotonic", lambda: clock_s)
    told_s: list[float] = []
    progress = kernel_launches.Progress(lambda _: told_s.append(clock_s))
    for step in range(1000):  # 3 s in steps of 3 ms
        clock_s = 0.003 * step
        progress(step / 1000)
    assert len(told_s) == 30  # every 34 steps: 0.102 s
    assert (np.diff(told_s) >= kernel_launches.REPORT_S).all()
    progress(1.0)  # the last one whatever the time
    assert told_s[-2:] == [told_s[-2], clock_s]
    assert len(told_s) == 31


def test_what_progress_raises_ends_the_pass(tabletop: Scene) -> None:
    def cancel(fraction: float) -> None:
        raise StopIteration(fraction)

    with pytest.raises(StopIteration, match=r"^0\.0$"):  # photons come first
        transport(tabletop, tabletop.rig(width=32, height=24), [], spp=1_000_000, progress=cancel)
