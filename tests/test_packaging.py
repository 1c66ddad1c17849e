# SPDX-License-Identifier: Apache-2.0
"""What is delivered: a wheel that works without the checkout, an sdist that holds its tests, pins and licences."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
CONSTRAINTS = ROOT / "constraints.txt"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NOT_DELIVERED = {"build", "dist", "out", "htmlcov", "__pycache__"}
"""What a checkout gathers beside its own files, names with a dot aside."""


def run(arguments: list[str | Path], folder: Path, **environment: str) -> str:
    result = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, **environment},
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory with the wheel and the sdist of this checkout."""
    folder = tmp_path_factory.mktemp("built")
    run(["-m", "hatchling", "build", "-d", folder], ROOT)
    return folder


def test_the_wheel_holds_scenes_devices_templates_and_types(built: Path) -> None:
    with zipfile.ZipFile(next(built.glob("*.whl"))) as wheel:
        names = set(wheel.namelist())
    scenes = {f"rangesim/scene/catalogue/{p.relative_to(ROOT / 'scenes')}" for p in delivered(ROOT / "scenes")}
    assert len(scenes) > 60
    assert scenes <= names
    assert {"rangesim/py.typed", "pcgraph/py.typed"} <= names
    assert {
        f"rangesim/report/{n}"
        for n in ("print.css", "print.js", "report.html.j2", "report.js", "scroll.js", "sensor_views.js", "style.css")
    } <= names
    viewer = ("viewer.html", "viewer.css", "viewer.js", "points.js", "boxes.js", "tree.js", "three.js")
    assert {f"pcgraph/viewer/{n}" for n in (*viewer, "three.LICENSE.txt")} <= names
    devices = {f"rangesim/presets/devices/{p.name}" for p in (ROOT / "rangesim" / "presets" / "devices").glob("*.toml")}
    assert len(devices) >= 7
    assert devices <= names
    assert {name.split("/")[0] for name in names} == {"rangesim", "pcgraph", f"rangesim-{PROJECT['version']}.dist-info"}


def test_the_sdist_holds_what_its_tests_need(built: Path) -> None:
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    top = [p for p in ROOT.iterdir() if p.name not in NOT_DELIVERED and (p.name == ".ci" or not p.name.startswith("."))]
    wanted = {p.relative_to(ROOT).as_posix() for entry in top for p in delivered(entry)}
    assert {"Makefile", "constraints.txt", "tests/conftest.py", "scripts/setup", ".ci/run"} <= wanted
    assert wanted <= names


@pytest.mark.validation
def test_an_installed_wheel_measures_its_own_scenes(built: Path, tmp_path: Path) -> None:
    """Outside the checkout, with the package from the wheel and its dependencies from here. The kernels are left as
    Python: to compile all of them for a place of their own takes longer than to run them on a few pixels."""
    site = tmp_path / "site"
    wheel = next(built.glob("*.whl"))
    run(["-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", site, wheel], tmp_path)
    code = "import rangesim; print(rangesim.__file__, rangesim.load_scene('plane').source)"
    for path in run(["-c", code], tmp_path, PYTHONPATH=str(site)).split():
        assert Path(path).is_relative_to(site)
    small = "run glassware --sensor ideal-tof --spp 1 --width 32 --height 24 --no-caustics --out x"
    code = "from rangesim.cli import main; main()"
    run(["-c", code, *small.split()], tmp_path, PYTHONPATH=str(site), NUMBA_DISABLE_JIT="1")
    assert (tmp_path / "x" / "report.html").stat().st_size > 50_000


def test_every_dependency_is_pinned_within_its_range() -> None:
    pins = {r.name.lower(): r for r in map(Requirement, lines(CONSTRAINTS))}
    assert all(re.fullmatch(r"==[\w.+]+", str(r.specifier)) for r in pins.values())
    extras = PROJECT["optional-dependencies"]
    for wanted in map(Requirement, [*PROJECT["dependencies"], *extras["learn"], *extras["test"]]):
        if wanted.name == "rangesim" or (wanted.marker and not wanted.marker.evaluate()):
            continue
        pin = str(pins[wanted.name.lower()].specifier).removeprefix("==")
        assert wanted.specifier.contains(pin), f"constraints.txt pins {wanted.name} {pin}, outside {wanted.specifier}"


def test_dependencies_have_permissive_licences_and_are_listed() -> None:
    """Of everything that an install brings along, as its metadata state it."""
    printed = run([ROOT / "scripts" / "licences.py"], ROOT)
    listed = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8")
    names = re.findall(r"^\| ([\w.-]+) \|", printed, re.MULTILINE)
    assert {"mitsuba", "drjit", "numpy", "jinja2"} <= {name.lower() for name in names}
    assert [name for name in names if name not in ("package", "---") and f"| {name} |" not in listed] == []


def delivered(path: Path) -> list[Path]:
    """A file, or the files of a directory without caches."""
    found = sorted(path.rglob("*")) if path.is_dir() else [path]
    return [p for p in found if p.is_file() and "__pycache__" not in p.parts and not p.name.endswith(".pyc")]


def lines(path: Path) -> list[str]:
    """Requirements of a file, without comments."""
    return [line.split("#")[0].strip() for line in path.read_text().splitlines() if line.split("#")[0].strip()]


def test_the_system_is_looked_at_before_anything_is_installed(tmp_path: Path) -> None:
    """With the standard library alone, as on a new machine: the module's checks, which install nothing."""
    check = (
        "import runpy, sys; sys.argv[1:] = []\n"
        f"names = runpy.run_path({str(ROOT / 'scripts' / 'system_libraries.py')!r}, run_name='checks')\n"
        "print(sorted(names['missing_parts']()))"
    )
    done = subprocess.run([sys.executable, "-I", "-S", "-c", check], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[]\n"
