# SPDX-License-Identifier: Apache-2.0
"""Check the system libraries, and install what is missing where that is possible.

    python3 scripts/system_libraries.py [--test]

It needs nothing but the standard library, so it runs before anything is installed. Where all is there it does
nothing. As root on a Debian-like system it installs what is missing; otherwise it prints the one command to
run and exits with 1. With --test it also wants a browser for the test that looks at the report, but gets by
without: that test is then skipped.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shutil
import subprocess
import sys
import types
from pathlib import Path

LIBRARIES = {  # soname -> (Debian package, who needs it); measured in a minimal Debian 12 and 13
    "libstdc++.so.6": ("libstdc++6", "every compiled package"),
    "libatomic.so.1": ("libatomic1", "Dr.Jit"),
    "libusb-1.0.so.0": ("libusb-1.0-0", "Open3D"),
    "libgomp.so.1": ("libgomp1", "Open3D"),
    "libGL.so.1": ("libgl1", "Open3D"),
    "libEGL.so.1": ("libegl1", "Open3D"),
    "libX11.so.6": ("libx11-6", "Open3D"),
    "libidn2.so.0": ("libidn2-0", "Open3D"),
    "libudev.so.1": ("libudev1", "Open3D"),
}
LLVM_PACKAGES = ("libllvm22", "libllvm21", "libllvm20", "libllvm19", "libllvm18", "libllvm17t64", "libllvm17")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
BROWSER_PACKAGES = ["chromium", "fonts-dejavu-core"]


def main() -> int:
    """0 if all that is required is there in the end, otherwise 1."""
    missing = missing_parts()
    browser = BROWSER_PACKAGES if "--test" in sys.argv[1:] and not any(map(shutil.which, BROWSERS)) else []
    if not (missing or browser):
        return 0
    if not (shutil.which("apt-get") and os.name == "posix" and os.geteuid() == 0):
        return explain(missing)
    print(f"Installing system libraries ({', '.join([*missing, *browser])}) ...", flush=True)
    apt("update", "-q")
    packages = [llvm_package() if package == "libllvm" else package for package in missing]
    if packages and apt("install", *packages) != 0:
        print(f"error: could not install {' '.join(packages)}; see apt-get's message above.", file=sys.stderr)
        return 1
    if browser and apt("install", *browser) != 0:
        print("note: no Chromium here; the test that looks at the report in a browser will be skipped.")
    return explain(missing_parts())


def missing_parts() -> dict[str, str]:
    """Debian package -> what for, of everything required and not there; `libllvm` stands for any good one."""
    missing = {}
    if not (importlib.util.find_spec("ensurepip") and importlib.util.find_spec("venv")):
        missing[f"python3.{sys.version_info.minor}-venv"] = "the virtual environment"
    if sys.platform == "linux":
        missing |= {package: user for name, (package, user) in LIBRARIES.items() if not loads(name)}
    problem = llvm_problem()
    if problem:
        missing["libllvm"] = problem
    return missing


def loads(soname: str) -> bool:
    """Whether the dynamic linker finds and loads the library."""
    try:
        ctypes.CDLL(soname)
    except OSError:
        return False
    return True


def llvm_problem() -> str | None:
    """What rangesim itself says of this machine's LLVM; None if it is content."""
    for name in ("pcgraph", "rangesim"):  # stand for the packages, whose dependencies are not there yet
        package = types.ModuleType(name)
        package.__path__ = [str(Path(__file__).resolve().parents[1] / name)]
        sys.modules[name] = package
    from rangesim.environment.llvm import find_llvm
    from rangesim.errors import EnvironmentProblem

    try:
        find_llvm()
    except EnvironmentProblem as problem:
        return str(problem)
    return None


def llvm_package() -> str:
    """The newest suitable LLVM that apt offers."""
    for package in LLVM_PACKAGES:
        policy = subprocess.run(["apt-cache", "policy", package], capture_output=True, text=True).stdout
        if "Candidate:" in policy and "Candidate: (none)" not in policy:
            return package
    return LLVM_PACKAGES[3]


def apt(action: str, *arguments: str) -> int:
    """apt-get's exit status; it never asks."""
    quiet = ["-y", "-q", "-o", "Dpkg::Use-Pty=0", "--no-install-recommends"]
    options = [action, *quiet] if action == "install" else [action]
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    command = ["apt-get", *options, *arguments]
    return subprocess.run(command, env=environment, stdout=subprocess.DEVNULL).returncode


def explain(missing: dict[str, str]) -> int:
    """Print what is missing and the one command that helps; 1 if anything is."""
    for package, reason in missing.items():
        print(f"missing: {package} ({reason})", file=sys.stderr)
    if not missing:
        return 0
    if shutil.which("apt-get"):
        packages = " ".join(llvm_package() if package == "libllvm" else package for package in missing)
        sudo = "" if os.geteuid() == 0 else "sudo "
        print(
            f"error: run this once, then try again:\n\n    {sudo}apt-get update && "
            f"{sudo}apt-get install -y --no-install-recommends {packages}\n",
            file=sys.stderr,
        )
    else:
        print("error: install the libraries named above with your system's package manager.", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
