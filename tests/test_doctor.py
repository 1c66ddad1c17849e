# SPDX-License-Identifier: Apache-2.0
"""The doctor: one line per check with its fix, and an exit status that tells."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from rangesim.environment import doctor
from rangesim.environment.doctor import Check, doctor_command, run_checks
from rangesim.environment.llvm import VARIABLE

NAMES = ["Python", "LLVM", "Mitsuba", "kernel", "CUDA", "Open3D", "fonts", "browser"]


def command_line() -> typer.Typer:
    """The doctor on its own, as the command line mounts it."""
    app = typer.Typer()
    app.command("doctor")(doctor_command)
    return app


def test_this_machine_passes_every_required_check() -> None:
    checks = run_checks()
    assert [check.name for check in checks] == NAMES
    assert [str(check) for check in checks if check.required and not check.ok] == []


def test_a_line_shows_the_fix_only_where_it_helps() -> None:
    assert "fix" not in str(Check("Open3D", True, "Open3D 0.20", "install it"))
    assert str(Check("Open3D", False, "no libGL", "install it")).startswith("FAIL")
    assert str(Check("Open3D", False, "no libGL", "install it")).endswith("no libGL; fix: install it")
    assert str(Check("CUDA", False, "no GPU", required=False)).startswith("none")


@pytest.mark.parametrize(
    ("checks", "status"),
    [
        ([Check("LLVM", True, "19"), Check("CUDA", False, "no GPU", required=False)], 0),
        ([Check("LLVM", False, "15", "install libllvm19"), Check("CUDA", True, "a GPU")], 1),
    ],
)
def test_the_exit_status_counts_required_checks(
    monkeypatch: pytest.MonkeyPatch, checks: list[Check], status: int
) -> None:
    monkeypatch.setattr(doctor, "run_checks", lambda: checks)
    result = CliRunner().invoke(command_line())
    assert result.exit_code == status
    assert result.output.splitlines() == [str(check) for check in checks]


def test_a_bad_llvm_is_told_and_no_kernel_is_tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library = tmp_path / "libLLVM-15.so.1"
    library.touch()
    monkeypatch.setenv(VARIABLE, str(library))
    llvm, kernel = doctor._check_llvm(), doctor._check_kernel()
    assert not llvm.ok
    assert "LLVM 15" in llvm.detail
    assert "install" in llvm.detail
    assert not kernel.ok
    assert "not tried" in kernel.detail


def test_a_process_that_aborts_does_not_take_the_doctor_along() -> None:
    ok, said = doctor._try_in_process("import os; os.abort()")
    assert not ok
    if sys.platform != "win32":
        assert "signal 6" in said


def test_the_first_error_is_the_one_shown() -> None:
    code = "try:\n    raise ImportError('libX.so.1: not there')\nexcept ImportError:\n    unknown"
    assert doctor._try_in_process(code) == (False, "ImportError: libX.so.1: not there")
