# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim`: what works, and that what does not ends in one sentence and no files."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_result import ROOT, SCENES, SENSORS, small_result

import rangesim
from rangesim.cli import main
from rangesim.cli.progress import progress_bar
from rangesim.results.experiment_results import load_result
from rangesim.rig.calibration_files import save_calibration

PLANE = str(SCENES / "plane.xml")
TINY = ("--width", "48", "--height", "36", "--spp", "1")
IDEAL = ("--sensor", "ideal-tof")


@dataclass(frozen=True)
class Answer:
    """What a command left behind."""

    status: int
    out: str
    err: str


Command = Callable[..., Answer]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Calls the entry point with arguments."""

    def call(*arguments: str | Path) -> Answer:
        monkeypatch.setattr(sys, "argv", ["rangesim", *map(str, arguments)])
        try:
            main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
        text = capsys.readouterr()
        return Answer(status, text.out, text.err)

    return call


def test_run_writes_a_report(command: Command, tmp_path: Path) -> None:
    answer = command("run", PLANE, *IDEAL, *TINY, "--out", tmp_path / "new" / "result")
    assert (answer.status, answer.err) == (0, "")
    assert (tmp_path / "new" / "result" / "report.html").is_file()
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["result"]
    again = command("run", PLANE, *IDEAL, *TINY, "--seed", "1", "--out", tmp_path / "new" / "result")
    assert again.status == 0  # an older result is replaced


def test_run_says_in_one_line_what_light_it_leaves_out(command: Command, tmp_path: Path) -> None:
    """In passes of several rigs, the line is that of the pass that leaves out most."""
    sensors = ("--sensor", "ideal-tof", "--sensor", "gray")
    answer = command("run", "cornell", *sensors, *TINY, "--max-depth", "4", "--out", tmp_path / "a")
    assert answer.status == 0
    assert re.fullmatch(
        r"rangesim: about \d+% of the projector's light is left out: a max_depth of 4 ends light paths early; "
        r"a larger one includes this light\.\nrangesim: the exposure is automatic: gray [\d.]+ .?s per frame\. .*\n",
        answer.err,
    )


def test_run_takes_an_experiment_file_that_options_override(command: Command, tmp_path: Path) -> None:
    (tmp_path / "one.toml").write_text(
        f'scene = "{PLANE}"\nwidth = 640\nspp = 9\n[[instrument]]\nsensor = "amcw"\n', encoding="utf-8"
    )
    out = tmp_path / "out"
    options = ("--baseline", "0.1", "--noise-free", "--max-depth", "2")
    answer = command("run", "--config", tmp_path / "one.toml", *TINY, *options, "--out", out)
    assert answer.status == 0, answer.err
    info = (out / "experiment.json").read_text(encoding="utf-8")
    for text in ('"width": 48', '"spp": 1', '"max_depth": 2', '"baseline_m": 0.1', '"noise": false'):
        assert text in info
    assert sorted((out / "amcw" / "capture").glob("*.exr"))  # noise-free frames are radiance


OTHER_COMMANDS = ("dataset_", "sweep_")
"""First letters of the examples that are for other commands than `run`."""


@pytest.mark.parametrize(
    "example",
    sorted(p for p in (ROOT / "examples").glob("*.toml") if not p.stem.startswith(OTHER_COMMANDS)),
    ids=lambda p: p.stem,
)
def test_examples_run(command: Command, tmp_path: Path, example: Path) -> None:
    answer = command("run", "--config", example, *TINY, "--out", tmp_path / "out")
    assert answer.status == 0, answer.err


def test_run_takes_a_bare_mesh(command: Command, tmp_path: Path) -> None:
    corners = "0 0 0\n.1 0 0\n0 .1 0\n0 0 .1\n"
    faces = "3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
    header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "tetrahedron.ply").write_text(header + corners + faces, encoding="ascii")
    out = tmp_path / "out"
    answer = command("run", tmp_path / "tetrahedron.ply", "--material", "glossy", *IDEAL, *TINY, "--out", out)
    assert answer.status == 0, answer.err
    assert "| material glossy | ideal-tof |" in (out / "comparison.md").read_text(encoding="utf-8")


def test_decode_gives_the_range_image_of_the_pipeline(command: Command, tmp_path: Path) -> None:
    source = small_result() / "lines"
    answer = command("decode", source / "capture", "--out", tmp_path / "out")
    assert answer.status == 0, answer.err
    assert "% of the pixels measured, z from" in answer.out
    with np.load(tmp_path / "out" / "range.npz") as new, np.load(source / "range.npz") as old:
        np.testing.assert_array_equal(new["z"], old["z"])
    assert (tmp_path / "out" / "cloud.ply").read_bytes() == (source / "cloud.ply").read_bytes()
    assert (tmp_path / "out" / "columns.png").is_file()


def test_decode_of_bare_images(command: Command, tmp_path: Path) -> None:
    """Without a calibration: maps and no cloud; with one: a cloud of the same depths as the capture's."""
    (tmp_path / "images").mkdir()
    for frame in (small_result() / "lines" / "capture").glob("*.png"):
        shutil.copy(frame, tmp_path / "images")
    options = ("--code", "gray-phase", "--projector", "256x160", "--axes", "columns", "--bits", "12")
    answer = command("decode", tmp_path / "images", *options, "--out", tmp_path / "out")
    assert answer.status == 0, answer.err
    assert not (tmp_path / "out" / "cloud.ply").exists()
    rig = rangesim.load_capture(small_result() / "lines" / "capture").rig
    assert rig is not None
    save_calibration(rig, tmp_path / "rig.json")
    calibration = ("--calibration", tmp_path / "rig.json")
    answer = command("decode", tmp_path / "images", *options, *calibration, "--out", tmp_path / "out")
    assert answer.status == 0, answer.err
    assert (tmp_path / "out" / "cloud.ply").is_file()
    with np.load(tmp_path / "out" / "range.npz") as new, np.load(small_result() / "lines" / "range.npz") as old:
        assert np.isfinite(new["z"]).sum() > 0.75 * np.isfinite(old["z"]).sum()
        assert np.nanmedian(np.abs(new["z"] - old["z"])) < 1e-3


def test_decode_of_a_real_capture(command: Command, tmp_path: Path, real_data: Path) -> None:
    board = real_data / "graycode_board"
    calibration = ("--calibration", board / "calibration_result.xml", "--code-step", "2")
    answer = command("decode", board / "capture_0", "--projector", "1024x768", *calibration, "--out", tmp_path / "out")
    assert answer.status == 0, answer.err
    assert (tmp_path / "out" / "cloud.ply").stat().st_size > 1e6


def test_compare_and_report(command: Command, tmp_path: Path) -> None:
    answer = command("compare", small_result())
    assert answer.status == 0
    assert all(word in answer.out for word in (*SENSORS, "transparent", "median error", "automatic"))
    assert answer.err.startswith("rangesim: the exposure is automatic: lines ")
    assert answer.err.endswith("state exposure_s to compare them.\n")
    answer = command("compare", small_result(), "--markdown")
    assert answer.out == (small_result() / "comparison.md").read_text(encoding="utf-8")
    copy = tmp_path / "copy"
    shutil.copytree(small_result(), copy)
    (copy / "report.html").unlink()
    assert command("report", copy).status == 0
    assert (copy / "report.html").read_bytes() == (small_result() / "report.html").read_bytes()


def test_compare_takes_another_tolerance(command: Command, tmp_path: Path) -> None:
    """A tolerance of the run prints its tables; another one counts the readings anew, and names no causes for them."""
    stored = command("compare", small_result(), "--markdown").out
    assert "Right readings are off by at most 10 mm." in stored
    assert command("compare", small_result(), "--markdown", "--tolerance", "1cm").out == stored
    loose = command("compare", small_result(), "--markdown", "--tolerance", "0.1").out
    assert "Right readings are off by at most 100 mm." in loose
    assert "because" not in loose

    def right(text: str) -> list[float]:
        lines = [line.split(" | ") for line in text.splitlines() if line.startswith("| object ")]
        return [float(cells[2]) for cells in lines if cells[2].replace(".", "").isdigit()]

    before, after = right(stored), right(loose)
    assert len(before) == len(after) > len(SENSORS)
    assert all(a >= b for a, b in zip(after, before, strict=True))
    assert sum(after) > sum(before)
    copy = tmp_path / "copy"
    shutil.copytree(small_result(), copy)
    for path in copy.glob("*/comparison.json"):
        path.write_text(path.read_text().replace('"tolerance_m": 0.01', '"tolerance_m": 0.002'))
    answer = command("compare", small_result(), copy)
    assert answer.status == 1
    assert re.search(r"expected results of one tolerance, got 10 mm \(.*\) and 2 mm \(.*\); state one", answer.err)
    assert command("compare", small_result(), copy, "--tolerance", "2mm").status == 0


def test_run_takes_a_tolerance_with_a_unit(command: Command, tmp_path: Path) -> None:
    (tmp_path / "one.toml").write_text(f'scene = "{PLANE}"\ntolerance_m = "0.5 mm"\n[[instrument]]\nsensor = "amcw"\n')
    for options, tolerance_m in (((), 0.0005), (("--tolerance", "2mm"), 0.002)):
        answer = command("run", "--config", tmp_path / "one.toml", *TINY, *options, "--out", tmp_path / "out")
        assert answer.status == 0, answer.err
        result = load_result(tmp_path / "out")
        (m,) = result.measurements
        assert result.experiment.tolerance_m == m.causes.tolerance_m == tolerance_m
        off = np.abs(m.image.reading_m - m.true_m)
        assert m.row("all")["right"] == pytest.approx(np.mean(off <= tolerance_m))
        assert m.row("all")["missing"] == pytest.approx(np.isnan(off).mean())
        assert sum(m.row("all")["causes"].values()) == pytest.approx(1 - m.row("all")["right"])
    answer = command("run", PLANE, "--tolerance", "2 feet", "--out", tmp_path / "feet")
    assert answer.status == 2
    assert "such as" in answer.err
    assert "'2mm'" in answer.err


@pytest.mark.parametrize("options", [[], ["--markdown"]])
def test_names_are_printed_as_they_are(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str]
) -> None:
    """A folder in brackets, a material of another's result: no markup, no column, no order to the terminal."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "out[red]"
    shutil.copytree(small_result(), folder)
    for path in folder.glob("*/comparison.json"):
        path.write_text(path.read_text().replace('"glossy"', '"[/x]|\\u001b[3m<i>"'))
    answer = command("compare", folder.name, folder.name, *options)
    assert answer.status == 0
    assert "\x1b" not in answer.out
    plain = re.sub(r"\\([\\`<\[|])", r"\1", answer.out) if options else answer.out
    assert "out[red]" in plain
    assert r"[/x]|\u001b[3m<i>" in plain


def _write_bad_files(folder: Path) -> None:
    (folder / "broken.xml").write_text('<scene version="3.0.0"><shape', encoding="utf-8")
    (folder / "blind.xml").write_text('<scene version="3.0.0"><shape type="sphere"/></scene>', encoding="utf-8")
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (folder / "points.ply").write_text(header + "end_header\n0 0 0\n", encoding="ascii")
    (folder / "key.toml").write_text('scene = "a.xml"\nmaxdepth = 3\n', encoding="utf-8")
    (folder / "foreign").mkdir()
    (folder / "foreign" / "thesis.txt").write_text("do not delete", encoding="utf-8")
    (folder / "empty").mkdir()
    shutil.copytree(small_result() / "lines" / "capture", folder / "gap")
    next((folder / "gap").glob("*white.png")).unlink()
    shutil.copytree(small_result() / "lines" / "capture", folder / "crop")
    white = next((folder / "crop").glob("*white.png"))
    with Image.open(white) as image:
        smaller = image.crop((0, 0, 60, 60))
    smaller.save(white)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["run", "none.xml"], "none.xml does not exist"),
        (["run", "tabeltop"], "did you mean 'tabletop'"),
        (["run", "broken.xml"], "broken.xml is no scene that Mitsuba can load"),
        (["run", "blind.xml"], "perspective sensor, got none"),
        (["run", "points.ply"], "which has no faces"),
        (["run", PLANE, "--spp", "-3"], "spp .* at least 1, got -3"),
        (["run", PLANE, "--width", "0"], "width .* at least 1, got 0"),
        (["run", PLANE, "--sensor", "grey"], "did you mean 'gray'"),
        (["run", PLANE, "--baseline", "-1"], "baseline_m to be positive"),
        (["run", "points.ply", "--material", "glass"], "material"),
        (["run", PLANE, "--material", "glossy"], "names its own materials"),
        (["run", "--config", "none.toml"], "none.toml does not exist"),
        (["run", "--config", "key.toml"], "did you mean 'max_depth'"),
        (["decode", "none"], "none is no directory"),
        (["decode", "empty"], "--projector"),
        (["decode", "empty", "--projector", "wide"], "WIDTHxHEIGHT"),
        (["decode", "empty", "--projector", "64x64", "--code", "grey"], "did you mean 'gray'"),
        (["decode", "empty", "--projector", "64x64", "--axes", "row"], "columns, rows"),
        (["decode", "empty", "--projector", "64x64"], "expected 26 images .* got 0"),
        (["decode", "gap"], "white.png is missing"),
        (["decode", "gap", "--axes", "rows", "--bits", "12"], "how it was taken: leave out --axes, --bits"),
        (
            ["decode", "empty", "--projector", "64x64", "--unit", "1"],
            "--calibration FILE.xml, FILE.yml or FILE.json with",
        ),
        (["decode", "crop"], "expected 120 x 90 uint16 .* got 60 x 60"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], sentence: str
) -> None:
    _write_bad_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    answer = command(*arguments, "--out", "new/out")
    assert answer.status == 1
    assert re.search(sentence, answer.err)
    assert answer.err.startswith("rangesim: ")
    assert answer.err.count("\n") == 1
    assert answer.out == ""
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", ["run", "decode"])
def test_foreign_directories_are_left_alone(command: Command, tmp_path: Path, name: str) -> None:
    (tmp_path / "thesis.txt").write_text("do not delete", encoding="utf-8")
    source = PLANE if name == "run" else small_result() / "lines" / "capture"
    answer = command(name, source, "--out", tmp_path)
    assert answer.status == 1
    assert "holds something else" in answer.err
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
    answer = command(name, source, "--out", tmp_path / "thesis.txt")
    assert answer.status == 1
    assert "is no directory" in answer.err


@pytest.mark.parametrize("name", ["run", "decode"])
def test_a_directory_that_cannot_be_made_is_named(command: Command, tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    source = PLANE if name == "run" else small_result() / "lines" / "capture"
    answer = command(name, source, "--out", tmp_path / "file" / "out")
    out = tmp_path / "file" / "out"
    message = f"rangesim: cannot create the directory {out}: a file is in the way; name another place.\n"
    assert (answer.status, answer.err) == (1, message)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("name", ["compare", "report"])
def test_what_is_no_result_is_refused(command: Command, tmp_path: Path, name: str) -> None:
    answer = command(name, tmp_path)
    assert answer.status == 1
    assert "it has no experiment.json" in answer.err


@pytest.mark.parametrize(
    "arguments", [["run", PLANE], ["run", PLANE, "--ssp", "3", "--out", "x"], ["run", "--out", "x"]]
)
def test_wrong_usage_ends_with_2(command: Command, arguments: list[str]) -> None:
    assert command(*arguments).status == 2


def test_a_failure_halfway_leaves_nothing(command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("rangesim.report.render_report", fail)
    answer = command("run", PLANE, *IDEAL, *TINY, "--out", tmp_path / "a" / "b")
    assert (answer.status, answer.err) == (1, "rangesim: no space left on device\n")
    assert list(tmp_path.iterdir()) == []


def test_progress_shows_on_a_terminal_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with progress_bar() as progress:
        assert progress is None
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress_bar() as progress:
        assert progress is not None
        progress("Tracing light", 0.5)
    text = capsys.readouterr()
    assert text.out == ""
    assert "Tracing light" in text.err


def test_a_campaign_writes_a_line_into_a_log_at_times(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ten lines at most, and none of a short campaign. The exposures come first, as a stage of their own."""
    clock = itertools.count(0.0, 0.3)
    monkeypatch.setattr("rangesim.cli.progress.time.monotonic", lambda: next(clock))
    with progress_bar(is_campaign=True) as progress:
        assert progress is not None
        for _ in range(2):
            for k in range(101):
                progress(f"{k} of 100 items, 1 min left", k / 100)
            lines = capsys.readouterr().err.splitlines()
            assert 2 <= len(lines) <= 3
            assert lines[0].startswith("rangesim: ")
            assert lines[0].endswith(" of 100 items, 1 min left")


def test_version_and_help(command: Command) -> None:
    assert command("--version").out == f"rangesim {rangesim.__version__}\n"
    for name in ("run", "decode", "compare", "report", "verify", "doctor"):
        assert name in command("--help").out
        assert command(name, "--help").status == 0


def test_the_command_line_loads_nothing_heavy() -> None:
    code = (
        "import sys, rangesim.cli; "
        "print([m for m in ('mitsuba', 'drjit', 'open3d', 'numpy', 'matplotlib', 'numba') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert answer.stdout.strip() == "[]"


@pytest.mark.parametrize("letters", [256, 3000])
def test_an_operating_systems_error_is_said_in_words(command: Command, letters: int) -> None:
    name = "n" * letters
    answer = command("verify", name)
    assert answer.status == 1
    assert answer.err.startswith("rangesim: cannot use nnn")
    assert answer.err.endswith("n/experiment.json: File name too long\n")
    assert "Errno" not in answer.err
    assert len(answer.err) <= 300


@pytest.mark.parametrize("order", ["\x1b[2J", "\u202e", "\n", "\x9b1m"])
def test_names_of_shapes_give_no_orders_to_a_terminal(order: str) -> None:
    from rangesim.cli.scan import _table

    name = f"a{order}b"
    result: Any = SimpleNamespace(
        things=(name, "sphere"),
        shapes={
            name: SimpleNamespace(material=order, accuracy_m=None, recall=None),
            "sphere": SimpleNamespace(material="matte", accuracy_m=1e-3, recall=0.5),
        },
        seen=SimpleNamespace(shapes=dict.fromkeys((name, "sphere"), SimpleNamespace(surface=0.25))),
        poses=None,
    )
    code = {"\n": "\\n"}.get(order[0], f"\\u{ord(order[0]):04x}") + order[1:]
    lines = _table(result).split("\n")
    assert lines[1].split() == [f"a{code}b", code, "-", "-", "25.0%"]
    assert lines[2].split() == ["sphere", "matte", "1.000", "mm", "50.0%", "25.0%"]
    assert len(lines) == 3


def test_names_of_directories_give_no_orders_to_a_terminal(command: Command, tmp_path: Path) -> None:
    place = tmp_path / "a\x1b[2J\u202e\nb"
    assert (
        command("run", PLANE, *IDEAL, *TINY, "--out", place).out == f"{tmp_path}/a\\u001b[2J\\u202e\\nb/report.html\n"
    )
    answer = command("verify", place)
    assert answer.out.startswith(f"{tmp_path}/a\\u001b[2J\\u202e\\nb: all ")


@pytest.mark.parametrize(
    "poses", [[], 3, "x", None, {"T_world_camera": 5}, [[1, 2]], [[[float("nan")] * 4] * 4], [[[2.0] * 4] * 4]]
)
def test_a_wrong_list_of_poses_is_named(tmp_path: Path, poses: Any) -> None:
    from rangesim.cli.scan import _path
    from rangesim.experiment.camera_paths import Dome

    place = tmp_path / "poses.json"
    place.write_text(json.dumps(poses))
    with pytest.raises(ValueError, match=re.escape(f"{place}: expected ")):
        _path(Dome(), str(place), None)
