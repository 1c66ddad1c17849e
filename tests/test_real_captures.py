# SPDX-License-Identifier: Apache-2.0
"""The commands of docs/decoding.md for real captures, each run as it stands there, against its reference."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from typer.testing import CliRunner

from rangesim.cli import app
from rangesim.decoding.status import Status

DOC = Path(__file__).resolve().parent.parent / "docs" / "decoding.md"
ROW = re.compile(r"^\| `(captures/[\w-]+)` \| `(rangesim decode .*?)` \|", re.MULTILINE)
COMMANDS = dict(ROW.findall(DOC.read_text(encoding="utf-8")))

pytestmark = pytest.mark.validation


class Decoded(NamedTuple):
    """What a command wrote: arrays of range.npz, decoded.json, and what it printed."""

    maps: dict[str, np.ndarray]
    info: dict[str, Any]
    said: str

    @property
    def ok(self) -> np.ndarray:
        return np.asarray(self.maps["status"] == Status.OK)


def run(name: str, real_data: Path, tmp_path: Path) -> Decoded:
    folder = real_data / name
    words = shlex.split(COMMANDS[name])[1:]
    words = [word.replace("C", str(folder), 1) if word == "C" or word.startswith("C/") else word for word in words]
    answer = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert answer.exit_code == 0, answer.output
    with np.load(tmp_path / "out" / "range.npz") as maps:
        return Decoded(dict(maps), json.loads((tmp_path / "out" / "decoded.json").read_text()), answer.output)


def test_every_capture_of_the_test_data_has_a_command(real_data: Path) -> None:
    assert set(COMMANDS) == {f"captures/{folder.name}" for folder in (real_data / "captures").iterdir()}


def test_the_skull_in_gray_code_is_where_its_authors_have_it(real_data: Path, tmp_path: Path) -> None:
    found = run("captures/slstudio_skull_gray", real_data, tmp_path)
    with np.load(real_data / "captures" / "slstudio_skull_gray" / "authors_points.npz") as theirs:
        z = 1e-3 * theirs["points"][..., 2]
    both = found.ok & np.isfinite(z) & (z > 0)
    assert both.sum() > 0.75 * (np.isfinite(z) & (z > 0)).sum()  # the others are too dark for our thresholds
    off = np.abs(found.maps["z"] - z)[both]
    assert np.median(off) < 5e-4
    assert (off < 1e-3).mean() > 0.9
    assert found.info["doubts"] == []


def test_two_by_three_fringes_follow_the_authors_formula(real_data: Path, tmp_path: Path) -> None:
    """slstudio: the phase of each period, the fine one unwrapped by the coarse one; phase 0 at a pixel's centre."""
    from rangesim.files.image_files import read_stack

    found = run("captures/slstudio_skull_2x3", real_data, tmp_path)
    frames = read_stack(sorted((real_data / "captures" / "slstudio_skull_2x3").glob("*.png"))).astype(np.float64)
    turns = []
    for first, second, third in (frames[:3], frames[3:]):
        turns.append(np.arctan2(np.sqrt(3) * (second - third), 2 * first - second - third) / (2 * np.pi) % 1)
    fine, coarse = turns
    cycles = np.rint(coarse * 1824 / 114 - fine)
    columns = (cycles + fine) * 114 + 0.5
    off = found.maps["projector_column"] - columns
    off -= 1824 * np.rint(off / 1824)
    assert found.ok.mean() > 0.15
    assert (np.abs(off[found.ok]) < 0.01).mean() > 0.99
    assert found.info["doubts"] == []


@pytest.mark.parametrize("name", ["micro_phase_shifting_32-08", "micro_phase_shifting_64-15"])
def test_micro_phase_shifting_agrees_with_its_authors_columns(name: str, real_data: Path, tmp_path: Path) -> None:
    found = run(f"captures/{name}", real_data, tmp_path)
    with np.load(real_data / "captures" / name / "authors_columns.npz") as theirs:
        column = theirs["column"] - 0.5  # theirs count pixels from 1
    both = found.ok & np.isfinite(column) & (column > 0)
    assert both.sum() > 0.9 * found.ok.sum()
    assert (np.abs(found.maps["projector_column"] - column)[both] < 0.501).mean() > 0.99
    assert found.info["doubts"] == []
    assert "there are no white and black images" in found.said


@pytest.mark.parametrize(
    ("name", "least"), [("kamino410_object1", 0.5), ("gray_jpeg", 0.2)], ids=["kamino410", "gray_jpeg"]
)
def test_neighbours_see_neighbouring_places(name: str, least: float, real_data: Path, tmp_path: Path) -> None:
    found = run(f"captures/{name}", real_data, tmp_path)
    assert found.ok.mean() > least
    assert found.info["doubts"] == []
    for key in ("projector_column", "projector_row"):
        for axis in (0, 1):
            steps = np.abs(np.diff(found.maps[key], axis=axis))
            assert np.nanpercentile(steps, 95) < 10
