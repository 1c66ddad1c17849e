# SPDX-License-Identifier: Apache-2.0
"""Python files that are run find their neighbours, each its own, and leave nothing behind if they fail."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import pcgraph.user_modules  # noqa: F401  (the package around the modules of files)
from pcgraph.plumbing.python_files import run_python_file


@pytest.fixture(autouse=True)
def modules() -> Iterator[None]:
    """What was imported before, and from where, is restored."""
    before, path = dict(sys.modules), list(sys.path)
    yield
    sys.path[:] = path
    for name in set(sys.modules) - set(before):
        del sys.modules[name]


def write(folder: Path, **files: str) -> Path:
    """A folder with Python files; a name's double underscore stands for a folder."""
    for name, text in files.items():
        path = folder.joinpath(*f"{name}.py".split("__"))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder


@pytest.mark.parametrize("from_inside", [False, True])
def test_modules_packages_and_later_imports(from_inside: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "from aside_a import A\nfrom aside_b.inner import B\ndef later():\n from aside_c import C\n return C\n"
    write(
        tmp_path,
        mine=text,
        aside_a="A = 1",
        aside_b__inner="from aside_d import D as B",
        aside_c="C = 3",
        aside_d="D = 2",
    )
    if from_inside:
        monkeypatch.chdir(tmp_path)
    module = run_python_file(Path("mine.py") if from_inside else tmp_path / "mine.py", "pcgraph")
    monkeypatch.chdir(Path(__file__).parent)
    assert (module.A, module.B, module.later()) == (1, 2, 3)


def test_two_folders_have_neighbours_of_one_name(tmp_path: Path) -> None:
    text = "from aside_e import VALUE"
    first, second = (write(tmp_path / n, mine=text, aside_e=f"VALUE = '{n}'") / "mine.py" for n in ("one", "two"))
    for path in (first, second, first):
        assert path.parent.name == run_python_file(path, "pcgraph").VALUE


def test_files_of_one_folder_share_a_neighbour_until_it_changes(tmp_path: Path) -> None:
    write(tmp_path, f="from aside_f import Thing", g="from aside_f import Thing", aside_f="class Thing: n = 1")
    f, g = (run_python_file(tmp_path / f"{name}.py", "pcgraph") for name in "fg")
    assert f.Thing is g.Thing
    write(tmp_path, aside_f="class Thing: n = 22")
    os.utime(tmp_path / "aside_f.py", (1, 1))
    assert run_python_file(tmp_path / "f.py", "pcgraph").Thing.n == 22


def test_a_failure_leaves_no_modules_and_can_be_mended(tmp_path: Path) -> None:
    path = write(tmp_path, mine="import aside_g\nfrom aside_h import H", aside_g="G = 1") / "mine.py"
    before, places = set(sys.modules), len(sys.path)
    with pytest.raises(ModuleNotFoundError, match="aside_h"):
        run_python_file(path, "pcgraph")
    assert set(sys.modules) == before
    assert len(sys.path) <= places + 1
    write(tmp_path, aside_h="H = 8")
    assert run_python_file(path, "pcgraph").H == 8


def test_installed_modules_that_are_loaded_stay_what_they_are(tmp_path: Path) -> None:
    numpy = sys.modules["numpy"]
    path = write(tmp_path, mine="import numpy\nimport aside_i", numpy="", aside_i="") / "mine.py"
    assert run_python_file(path, "pcgraph").numpy is numpy
    assert sys.modules["numpy"] is numpy
    assert sys.path[0] != str(tmp_path)


@pytest.mark.parametrize("name", ["_aside_j", "aside_k", "aside_l__inner"])
def test_hidden_names_and_folders_without_init_are_each_their_own(name: str, tmp_path: Path) -> None:
    text = f"from {name.replace('__', '.') if name[0] != '_' else name} import VALUE"
    folders = [write(tmp_path / n, mine=text, **{name: f"VALUE = '{n}'"}) for n in ("one", "two")]
    found = [run_python_file(folder / "mine.py", "pcgraph").VALUE for folder in (*folders, folders[0])]
    assert found == ["one", "two", "one"]


def test_what_is_installed_below_the_folder_is_imported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a folder with an environment of its own: packages with binary parts must not be imported twice."""
    write(tmp_path / "environment", aside_m="VALUES = []")
    monkeypatch.syspath_prepend(str(tmp_path / "environment"))
    first = write(tmp_path, mine="import aside_m") / "mine.py"
    other = write(tmp_path / "other", mine="import aside_m") / "mine.py"
    assert run_python_file(first, "pcgraph").aside_m is run_python_file(other, "pcgraph").aside_m
