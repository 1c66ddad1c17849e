# SPDX-License-Identifier: Apache-2.0
"""What the README promises runs as it stands, and so does every example."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()


def run(arguments: list[str], folder: Path) -> str:
    result = subprocess.run(arguments, capture_output=True, text=True, cwd=folder, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_the_python_of_the_readme_runs(tmp_path: Path) -> None:
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    ten_lines, *more = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len([line for line in ten_lines.splitlines() if line and not line.startswith("import")]) <= 10
    printed = run([sys.executable, "-c", "".join((ten_lines, *more))], tmp_path)
    assert "| material mirror |" in printed
    assert re.search(
        r"^\| material mirror \| [\d.]+ \| .*mirrored ghost [\d.]+", printed, re.MULTILINE
    )  # the report's words
    assert "sphere [" in printed
    assert (tmp_path / "out" / "tabletop.ply").stat().st_size > 100_000


def test_the_shell_lines_of_the_readme_run(tmp_path: Path) -> None:
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    (block,) = [b for b in re.findall(r"```sh\n(.*?)```", README, re.DOTALL) if "rangesim run" in b]
    for line in block.replace("--out out/compare", "--out out/compare --width 96 --height 72 --spp 2").splitlines():
        program, *arguments = line.split("#")[0].split()
        run([str(Path(sys.executable).parent / program), *arguments], tmp_path)
    assert (tmp_path / "out" / "decoded" / "cloud.ply").exists()
    assert list((tmp_path / "out" / "segments").glob("*.ply"))


ARGUMENTS = {
    "active_stereo_on_glass": ["--scale", "0.15", "--spp", "8"],
    "calibration": ["calibration.png", "--width", "320", "--poses", "3"],
    "gesture_sensor": ["gesture.png", "--spp", "8", "--places", "2"],
    "driving_lidar": ["driving_lidar.png", "--rings", "16", "--columns", "256", "--spp", "4"],
    "light_over_length": ["light_over_length.png", "--spp", "16"],
    "motion": ["motion", "--width", "48", "--speeds", "0", "1"],
    "part_pose": ["part.png", "--width", "280", "--spacing-mm", "3"],
    "rendered_motion": ["rendered_motion.png", "--views", "3", "--width", "160"],
    "rectification": ["rectification.png", "--width", "80"],
    "scan": ["--views", "3", "--width", "48", "--out", "out/scan.ply"],
    "segmentation": ["--width", "96"],
    "sparse_against_dense": [
        *("page.html", "--views", "2", "--width", "32", "--voxel-mm", "8", "--things", "opaque", "glass")
    ],
    "structure_from_motion": ["structure_from_motion.png", "--views", "6", "--points", "100"],
    "tof_calibration": ["tof.png", "--targets", "8", "--width", "120"],
    "two_cameras": ["--width", "80"],
}
"""Of the examples that can be had smaller."""
INTERPRETER = """
import contextlib, json, os, runpy, sys, traceback

for line in sys.stdin:
    folder, *sys.argv = json.loads(line)
    os.chdir(folder)
    sys.path[0] = os.path.dirname(sys.argv[0])
    with open("printed", "w") as printed, contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            runpy.run_path(sys.argv[0], run_name="__main__")
            failed = False
        except SystemExit as end:
            failed = end.code not in (None, 0)
        except BaseException:
            failed = True
            traceback.print_exc()
    print(json.dumps(failed), flush=True)
"""
"""One process for all examples, as importing the renderer and the viewers takes as long as many of them."""


@pytest.fixture(scope="module")
def interpreter() -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-c", INTERPRETER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield process


NEED_TORCH = {"train_on_dataset"}
"""Examples that need torch, which is no dependency; run by hand where it is installed."""


@pytest.mark.parametrize(
    "path", sorted(p for p in (ROOT / "examples").glob("*.py") if p.stem not in NEED_TORCH), ids=lambda p: p.stem
)
def test_examples_run(path: Path, tmp_path: Path, interpreter: subprocess.Popen[str]) -> None:
    assert interpreter.stdin is not None
    assert interpreter.stdout is not None
    asked = json.dumps([str(tmp_path), str(path), *ARGUMENTS.get(path.stem, [])])
    impatience = threading.Timer(300.0, interpreter.kill)
    impatience.start()
    print(asked, file=interpreter.stdin, flush=True)
    answer = interpreter.stdout.readline()
    impatience.cancel()
    printed = (tmp_path / "printed").read_text()
    assert json.loads(answer or "true") is False, printed
    assert printed


def test_links_between_documents_lead_somewhere() -> None:
    for document in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\(([^)#]+)", document.read_text()):
            if "://" not in target:
                assert (document.parent / target).exists(), f"{document.name} links to {target}"
