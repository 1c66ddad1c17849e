# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim doctor`: checks of this machine, one line each, with advice on how to fix a failure.

A check that could end the process (an old LLVM at the first kernel, a missing library) runs in a process of its own.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import typer

from rangesim.environment.llvm import VARIABLE, find_llvm
from rangesim.errors import EnvironmentProblem

__all__ = ["Check", "doctor_command", "find_browser", "run_checks"]

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome",
            "microsoft-edge", "microsoft-edge-stable", "msedge")  # fmt: skip
"""Names under which Chromium and its relatives are installed."""
TIMEOUT_S = 120
"""Seconds that a check may take. An import of Mitsuba or Open3D from a cold disk can take tens of seconds; a check that
takes longer than this has most likely stopped."""
_VERSIONS = "import drjit, mitsuba; print(f'Mitsuba {mitsuba.__version__}, Dr.Jit {drjit.__version__}')"
_MITSUBA_FIX = "apt-get install libatomic1 (Debian, Ubuntu), or pip install mitsuba if it is not installed"
_VARIANT = """
import mitsuba as mi
if "{0}" not in mi.variants():
    raise SystemExit("this build of Mitsuba has no variant {0}")
mi.set_variant("{0}")
import drjit as dr
values = dr.minimum(dr.sin(dr.arange(mi.Float, 64)), 0.5)
print("a kernel runs" if abs(values[1] - 0.5) < 1e-6 else "a kernel gives wrong numbers")
"""
_OPEN3D = "import open3d; print('Open3D', open3d.__version__)"
_OPEN3D_FIX = "apt-get install libusb-1.0-0 libgomp1 libgl1 libegl1 libx11-6 libidn2-0 libudev1 (Debian, Ubuntu)"
_FONT = """
from matplotlib import font_manager as fonts
wanted = fonts.FontProperties(family=["sans-serif"])
print(fonts.get_font(fonts.findfont(wanted, fallback_to_default=False)).family_name)
"""
_FONT_FIX = "pip install --force-reinstall matplotlib, which brings DejaVu Sans"


@dataclass(frozen=True)
class Check:
    """A check of the machine, printed as one line.

    name : short name. ok : whether it succeeded. detail : the finding. fix : advice if it failed. required : whether
    rangesim cannot work without it; if not required, a failure means that only some ability is missing.

    Examples
    --------
    >>> print(Check("CUDA", False, "no GPU", required=False))
    none  CUDA      no GPU
    """

    name: str
    ok: bool
    detail: str
    fix: str = ""
    required: bool = True

    def __str__(self) -> str:
        mark = "ok  " if self.ok else ("FAIL" if self.required else "none")
        fix = f"; fix: {self.fix}" if self.fix and not self.ok else ""
        return f"{mark}  {self.name:<8}  {self.detail}{fix}"


def run_checks() -> list[Check]:
    """All checks of this machine, ordered so that a failure explains those after it."""
    checks: list[Callable[[], Check]] = [
        _check_python,
        _check_llvm,
        partial(_check_import, "Mitsuba", _VERSIONS, _MITSUBA_FIX),
        _check_kernel,
        _check_cuda,
        partial(_check_import, "Open3D", _OPEN3D, _OPEN3D_FIX),
        partial(_check_import, "fonts", _FONT, _FONT_FIX),
        _check_browser,
    ]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(lambda check: check(), checks))


def doctor_command() -> None:
    """Check this machine: Python, LLVM, Mitsuba, CUDA, Open3D, fonts. Prints one line for each, with the fix.

    The exit status is 1 if something that rangesim needs is missing.
    """
    checks = run_checks()
    for check in checks:
        typer.echo(str(check))
    if not all(check.ok for check in checks if check.required):
        raise typer.Exit(1)


def find_browser() -> str | None:
    """Path of Chromium or of a browser built on it, which can print a report; None if there is none."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


def _check_python() -> Check:
    detail = f"{platform.python_version()} at {sys.executable}"
    return Check("Python", sys.version_info >= (3, 11), detail, "install Python 3.11 or newer")


def _check_llvm() -> Check:
    try:
        return Check("LLVM", True, str(find_llvm()))
    except EnvironmentProblem as problem:
        return Check("LLVM", False, str(problem))


def _check_kernel() -> Check:
    try:
        library = find_llvm()
    except EnvironmentProblem:
        return Check("kernel", False, "not tried without a suitable LLVM", "as for LLVM")
    environment = {**os.environ, VARIABLE: str(library.path)}
    ok, said = _try_in_process(_VARIANT.format("llvm_ad_mono"), environment)
    fix = f"set {VARIABLE} to another LLVM, or apt-get install --reinstall libllvm19 (Debian, Ubuntu)"
    return Check("kernel", ok and said == "a kernel runs", f"llvm_ad_mono: {said}", fix)


def _check_cuda() -> Check:
    ok, said = _try_in_process(_VARIANT.format("cuda_ad_mono"))
    detail = f"cuda_ad_mono: {said}" if ok else "no GPU that Dr.Jit can use; rangesim runs on the CPU"
    return Check("CUDA", ok, detail, required=False)


def _check_import(name: str, code: str, fix: str) -> Check:
    ok, said = _try_in_process(code)
    return Check(name, ok, said, fix)


def _check_browser() -> Check:
    path = find_browser()
    detail = path or "no Chromium; only `rangesim report --pdf` and tests of the pages need it"
    return Check("browser", path is not None, detail, "apt-get install chromium (Debian)", required=False)


def _try_in_process(code: str, environment: Mapping[str, str] | None = None) -> tuple[bool, str]:
    """Whether code runs to its end in a new Python process, and its output; if it fails, its error on one line."""
    command = [sys.executable, "-c", code]
    try:
        run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return False, f"no answer within {TIMEOUT_S} s"
    if run.returncode < 0:
        return False, f"the process was ended by signal {-run.returncode}"
    if run.returncode == 0:
        return True, run.stdout.strip()
    error = re.search(r"^\w*(?:Error|Exception)\b.*", run.stderr, re.MULTILINE)
    return False, error[0].strip() if error else run.stderr.strip() or f"exit status {run.returncode}"
