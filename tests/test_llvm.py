# SPDX-License-Identifier: Apache-2.0
"""The choice of LLVM: the newest suitable one, whatever is found first, and never a known bad one."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from rangesim.environment import llvm
from rangesim.environment.llvm import MINIMUM, NEWEST_TESTED, VARIABLE, ensure_llvm, find_llvm
from rangesim.errors import EnvironmentProblem


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """No library named by the user, no Dr.Jit imported; both come back after the test."""
    monkeypatch.setenv(VARIABLE, "")
    monkeypatch.delitem(sys.modules, "drjit", raising=False)


def folder_with(folder: Path, *names: str) -> Path:
    """A folder of files that are libraries by name only."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"")
    return folder


@pytest.mark.parametrize(
    ("names", "version"),
    [
        (["libLLVM-15.so.1", "libLLVM.so.19.1"], (19, 1)),
        (["libLLVM-14.so.1", "libLLVM-17.so.1", "libLLVM-16.so.1"], (17,)),
        (["libLLVM-18.so.18.1", "libLLVM-9.so.1"], (18,)),
        (["libLLVM.so.19.1", "libLLVM.so.22.1", "libLLVM.so.20.1"], (22, 1)),
        (["libLLVM-17.dylib", "libLLVM-15.dylib"], (17,)),
        (["libLLVM.so.19.1", "libLLVM.so.21.1-rust-1.90.0-stable", "libLLVMCore.so.20"], (19, 1)),
    ],
)
def test_newest_suitable_library_wins(tmp_path: Path, names: list[str], version: tuple[int, ...]) -> None:
    assert find_llvm([folder_with(tmp_path, *names)]).version == version


def test_an_older_library_in_an_earlier_folder_does_not_win(tmp_path: Path) -> None:
    folders = [
        folder_with(tmp_path / "a", "libLLVM-15.so.1"),
        folder_with(tmp_path / "b", "libLLVM.so.18.1"),
        folder_with(tmp_path / "c", "libLLVM.so.22.1"),
        tmp_path / "missing",
    ]
    assert find_llvm(folders).path == tmp_path / "c" / "libLLVM.so.22.1"


def test_a_tested_version_is_preferred_to_an_untested_newer_one(tmp_path: Path) -> None:
    newer = f"libLLVM.so.{NEWEST_TESTED + 1}.1"
    alone = folder_with(tmp_path / "alone", newer)
    both = folder_with(tmp_path / "both", newer, "libLLVM.so.19.1")
    assert find_llvm([alone]).version == (NEWEST_TESTED + 1, 1)
    assert find_llvm([both]).version == (19, 1)


def test_a_link_counts_by_the_file_it_leads_to(tmp_path: Path) -> None:
    folder = folder_with(tmp_path, "libLLVM-15.so.1", "libLLVM.so.19.1")
    (folder / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    (folder / "libLLVM.so").symlink_to("libLLVM-15.so.1")
    assert find_llvm([folder]).path == folder / "libLLVM.so.19.1"


def test_a_library_of_another_processor_is_passed_over(tmp_path: Path) -> None:
    own = Path(sys.executable).read_bytes()[:20]
    if not own.startswith(b"\x7fELF"):
        pytest.skip("libraries are not ELF files here")
    folder = folder_with(tmp_path)
    (folder / "libLLVM.so.19.1").write_bytes(own)
    (folder / "libLLVM.so.20.1").write_bytes(own[:18] + b"\x99\x99")
    assert find_llvm([folder]).version == (19, 1)


@pytest.mark.parametrize("names", [[], ["libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1"]])
def test_without_a_suitable_library_the_error_names_what_is_there_and_the_fix(tmp_path: Path, names: list[str]) -> None:
    with pytest.raises(EnvironmentProblem) as caught:
        find_llvm([folder_with(tmp_path, *names)])
    message = str(caught.value)
    assert f"LLVM {MINIMUM} or newer" in message
    assert VARIABLE in message
    assert "install" in message
    assert "\n" not in message
    for name in names or ["none"]:
        assert name in message


@pytest.mark.parametrize("name", ["libLLVM-14.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1", "libLLVM.so.16.0"])
def test_a_bad_library_is_refused_when_the_user_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv(VARIABLE, str(folder_with(tmp_path, name) / name))
    with pytest.raises(EnvironmentProblem, match=f"names LLVM 1[456].*{MINIMUM} or newer.*install"):
        ensure_llvm()


def test_a_named_library_that_is_missing_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "libLLVM.so.19.1"))
    with pytest.raises(EnvironmentProblem, match="not a file"):
        ensure_llvm()


def test_a_named_file_that_is_no_library_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(folder_with(tmp_path, "libLLVM.so") / "libLLVM.so"))
    with pytest.raises(EnvironmentProblem, match="of unknown version"):
        ensure_llvm()


def test_a_good_named_library_is_kept_even_if_a_newer_one_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = folder_with(tmp_path, "libLLVM-17.so.1", "libLLVM.so.19.1")
    monkeypatch.setenv(VARIABLE, str(folder / "libLLVM-17.so.1"))
    library = ensure_llvm()
    assert library is not None
    assert library.version == (17,)
    assert os.environ[VARIABLE] == str(folder / "libLLVM-17.so.1")


def test_ensure_tells_drjit_through_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = folder_with(tmp_path, "libLLVM-15.so.1", "libLLVM.so.19.1")
    monkeypatch.setattr(llvm, "_usual_folders", lambda: [folder])
    ensure_llvm()
    assert os.environ[VARIABLE] == str(folder / "libLLVM.so.19.1")


def test_cuda_needs_no_llvm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "/nowhere/libLLVM-15.so.1")
    assert ensure_llvm("cuda_ad_mono") is None


@pytest.mark.parametrize(("held", "bad"), [((15, 0, 7), True), ((19, 1, 7), False), (None, False)])
def test_a_bad_library_that_drjit_already_holds_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held: tuple[int, ...] | None, bad: bool
) -> None:
    drjit = SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: held))
    monkeypatch.setitem(sys.modules, "drjit", drjit)
    monkeypatch.setenv(VARIABLE, str(folder_with(tmp_path, "libLLVM.so.19.1") / "libLLVM.so.19.1"))
    if bad:
        with pytest.raises(EnvironmentProblem, match="has loaded LLVM 15"):
            ensure_llvm()
    else:
        assert ensure_llvm() is not None


def test_the_search_is_quick_and_imports_no_renderer() -> None:
    code = "import sys, rangesim.environment.llvm as l; l.find_llvm(); sys.exit('drjit' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
    durations = []
    for _ in range(3):
        start = time.perf_counter()
        find_llvm()
        durations.append(time.perf_counter() - start)
    assert min(durations) < 0.05


def test_drjit_runs_a_kernel_with_the_library_found() -> None:
    library = find_llvm()
    code = (
        "import drjit as dr; from drjit.llvm import Float; "
        "print(dr.detail.llvm_version()[0], dr.sum(dr.minimum(dr.arange(Float, 4), 1))[0])"
    )
    environment = {**os.environ, VARIABLE: str(library.path)}
    answer = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert answer.stdout.split() == [str(library.version[0]), "3.0"], answer.stderr
