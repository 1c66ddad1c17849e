# SPDX-License-Identifier: Apache-2.0
"""Sizes beyond the limits: one sentence, before memory is allocated, and how to raise the limit."""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rangesim.codes import GrayPhase
from rangesim.experiment import Experiment
from rangesim.motion import Timing
from rangesim.response import Images
from rangesim.rig import Intrinsics
from rangesim.sensors import AmcwToF, DirectToF, StructuredLight
from rangesim.settings import limits

ROOT = Path(__file__).resolve().parent.parent

TOO_LARGE: dict[str, tuple[str, Callable[[], Any]]] = {
    "steps": ("steps", lambda: GrayPhase(steps=10**30)),
    "bins": ("bins", lambda: DirectToF(bins=10**9)),
    "fine bins": ("bins", lambda: DirectToF(bins=60_000, pulse_fwhm_s=1e-10)),
    "projector": ("projector", lambda: StructuredLight(projector_width=10**6)),
    "projector area": ("pixels", lambda: StructuredLight(projector_width=65_000, projector_height=65_000)),
    "pixels": ("pixels", lambda: Intrinsics.from_fov(10**6, 10**6, 45)),
    "experiment": ("pixels", lambda: Experiment("a.xml", width=10**6, height=10**6)),
    "spp": ("spp", lambda: Experiment("a.xml", spp=10**30)),
    "depth": ("depth", lambda: Experiment("a.xml", max_depth=1 << 63)),
    "frequencies": ("frequencies", lambda: AmcwToF(tuple(1e6 + i for i in range(1000)))),
    "a kilohertz apart": ("wraps", lambda: AmcwToF((1e12, 1e12 - 1e3))),
    "bands": ("passes", lambda: Timing(bands=10**9)),
    "passes": ("passes", lambda: Timing(line_period_s=1e-6, bands=5000).exposure_times_s(StructuredLight())),
}


@pytest.mark.parametrize("case", TOO_LARGE)
def test_what_is_too_large_is_one_sentence_at_once(case: str) -> None:
    limit, make = TOO_LARGE[case]
    start = time.process_time()
    with pytest.raises(ValueError, match=rf"expected at most .*, got .*RANGESIM_LIMITS={limit}=N"):
        make()
    assert time.process_time() - start < 1


def test_a_frequency_beyond_any_modulator_is_refused() -> None:
    for wrong in (2.0**63, 1 << 63, float("inf")):
        with pytest.raises(ValueError, match=r"expected modulation_hz.* to be positive and finite, 1 to 1e\+12"):
            AmcwToF((wrong,))


def test_a_limit_can_be_raised_for_a_block() -> None:
    with limits.raised(bins=100_000):
        sensor = DirectToF(bins=90_000)
        with limits.raised(steps=2000):
            assert (limits.current().bins, limits.current().steps) == (100_000, 2000)
        assert limits.current().steps == limits.Limits().steps
    assert sensor.bins == 90_000
    with pytest.raises(ValueError, match="expected at most 65536 "):
        DirectToF(bins=90_000)


def test_a_limit_can_be_raised_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(limits.VARIABLE, "bins=1e5, pixels=1e9")
    assert DirectToF(bins=90_000).bins == 90_000
    assert limits.current() == dataclasses.replace(limits.Limits(), bins=10**5, pixels=10**9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pixel=3", r"unknown key 'pixel' \(did you mean 'pixels'\?\)"),
        ("pixels", "NAME=NUMBER"),
        ("pixels=many", "NAME=NUMBER"),
        ("pixels=nan", "at least 1, got nan"),
        ("pixels=inf", "at least 1, got inf"),
        ("pixels=-1", "at least 1, got -1"),
        ("pixels=1.5", "whole number"),
    ],
)
def test_a_wrong_environment_is_one_sentence(monkeypatch: pytest.MonkeyPatch, text: str, message: str) -> None:
    monkeypatch.setenv(limits.VARIABLE, text)
    with pytest.raises(ValueError, match=rf"{limits.VARIABLE}: .*{message}"):
        limits.current()


def test_unknown_limits_are_refused_in_python() -> None:
    with pytest.raises(ValueError, match="did you mean 'frames'"), limits.raised(frame=3):
        pass


def test_the_documentation_lists_all_limits_with_their_defaults() -> None:
    rows = re.findall(r"^\| `(\w+)` \| ([\d ]+) \|", (ROOT / "docs" / "limits.md").read_text(), re.MULTILINE)
    assert {name: int(number.replace(" ", "")) for name, number in rows} == dataclasses.asdict(limits.Limits())


def test_patterns_too_large_for_memory_are_refused() -> None:
    with pytest.raises(ValueError, match=r"bytes of .* patterns"):
        StructuredLight(projector_width=20_000, projector_height=5000).patterns()


def test_patterns_that_are_no_images_are_refused() -> None:
    for wrong in (None, [[1]], "x"):
        with pytest.raises(ValueError, match="expected patterns to be an array"):
            Images(wrong)  # type: ignore[arg-type]
