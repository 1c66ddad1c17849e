# SPDX-License-Identifier: Apache-2.0
"""Choice of the LLVM shared library that Dr.Jit compiles kernels with.

Dr.Jit loads libLLVM when it is imported. If that library is too old, the process ends at the first kernel without an
exception. Therefore this module reads the version from file names, without loading anything into this process, and
never uses a version that is known to fail.

Results with Dr.Jit 1.5.0 and Mitsuba 3.9.1 on x86-64 (a kernel with sin, min and max, then a Cornell box):

    LLVM 14               refused by Dr.Jit ("could not be found" is all it says)
    LLVM 15, 16           abort: "Cannot select: fminimum"
    LLVM 17, 18, 19, 22   work, with the same image

x86 has no instruction for the IEEE minimum and maximum. Since version 17, LLVM uses other instructions instead (LLVM
issue 53353). This agrees with the table. LLVM 20 and 21 were not tried; they lie between versions that work. A version
newer than `NEWEST_TESTED` is used only if no tested one is installed, because LLVM changes its C API.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from rangesim.errors import EnvironmentProblem

__all__ = ["MINIMUM", "NEWEST_TESTED", "VARIABLE", "LlvmLibrary", "ensure_llvm", "find_llvm"]

MINIMUM = 17
"""Oldest major version of LLVM that works; see the table in the docstring of this module."""
NEWEST_TESTED = 22
"""Newest major version of LLVM that was tried; see the table in the docstring of this module."""
VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Environment variable that names the library; Dr.Jit reads it when it is imported."""

# Names such as libLLVM-15.so.1, libLLVM-18.so.18.1, libLLVM.so.19.1, libLLVM.so, libLLVM.dylib or LLVM-C.dll. A private
# build such as libLLVM.so.19.1-rust-1.80 is not meant for others and does not match.
_NAME = re.compile(r"libLLVM(?:-(?P<before>\d+(?:\.\d+)*))?\.(?:so(?:\.(?P<after>\d+(?:\.\d+)*))?|dylib)|LLVM-C\.dll")
_ASK = """
import ctypes, sys
numbers = [ctypes.c_uint() for _ in range(3)]
ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*map(ctypes.byref, numbers))
print(*[number.value for number in numbers], sep=".")
"""


@dataclass(frozen=True)
class LlvmLibrary:
    """A libLLVM file and its version, which is () if it is unknown."""

    path: Path
    version: tuple[int, ...]

    @property
    def suitable(self) -> bool:
        """Whether Dr.Jit can compile kernels with the library."""
        return self.version >= (MINIMUM,)

    @property
    def rank(self) -> tuple[bool, tuple[int, ...]]:
        """Sort key. The best library has the largest: the newest tested version first, then untested newer ones."""
        return self.version < (NEWEST_TESTED + 1,), self.version

    def __str__(self) -> str:
        return f"LLVM {'.'.join(map(str, self.version)) or 'of unknown version'} ({self.path})"


def ensure_llvm(variant: str = "llvm_ad_mono") -> LlvmLibrary | None:
    """Choose a suitable LLVM library for Dr.Jit, and return it; None if the variant does not need LLVM.

    The choice is stored in the environment variable `DRJIT_LIBLLVM_PATH`. Call this before the first `import mitsuba`
    or `import drjit`.

    Raises
    ------
    EnvironmentProblem
        There is no suitable library, `DRJIT_LIBLLVM_PATH` names an unsuitable one, or Dr.Jit was imported earlier and
        has loaded an unsuitable one.
    """
    if not variant.startswith("llvm"):
        return None
    library = find_llvm()
    loaded = _version_held_by_drjit()
    if loaded is not None and loaded < (MINIMUM,):
        raise EnvironmentProblem(
            f"Dr.Jit was imported earlier and has loaded LLVM {loaded[0]}, but needs {MINIMUM} or newer: "
            f"start Python with {VARIABLE}={library.path}, or call ensure_llvm() before the import."
        )
    os.environ[VARIABLE] = str(library.path)
    return library


def find_llvm(folders: Iterable[Path] | None = None) -> LlvmLibrary:
    """The library that `DRJIT_LIBLLVM_PATH` names; without that, the best one on this machine.

    Parameters
    ----------
    folders : folders to search instead of the usual library folders of this platform.

    Raises
    ------
    EnvironmentProblem
        The named library is missing or unsuitable, or no suitable one was found.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return _check_named(Path(named))
    found = _libraries_in(_usual_folders() if folders is None else folders)
    if folders is None and not any(library.suitable for library in found):
        found += _libraries_of_linker()
    suitable = [library for library in found if library.suitable]
    if not suitable:
        listed = ", ".join(str(library) for library in found) or "none"
        raise EnvironmentProblem(f"Dr.Jit needs LLVM {MINIMUM} or newer, found {listed}: {_fix()}.")
    return max(suitable, key=lambda library: library.rank)


def _check_named(path: Path) -> LlvmLibrary:
    if not path.is_file():
        raise EnvironmentProblem(f"{VARIABLE} names {path}, which is not a file: {_fix()}.")
    library = LlvmLibrary(path, _version_of(path))
    if not library.suitable:
        needed = f"Dr.Jit needs LLVM {MINIMUM} or newer"
        raise EnvironmentProblem(f"{VARIABLE} names {library}, but {needed}: {_fix()}.")
    return library


def _fix() -> str:
    install = {
        "Darwin": "run `brew install llvm`",
        "Windows": "install LLVM from its Windows installer",
    }.get(platform.system(), "install it (Debian, Ubuntu: `apt-get install libllvm19`)")
    return f"{install}, or set {VARIABLE} to a suitable libLLVM"


def _usual_folders() -> Iterator[Path]:
    """Folders that may hold libLLVM on Linux, macOS and Windows; those in environment variables come first."""
    for variable in ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH") + (("PATH",) if os.name == "nt" else ()):
        yield from (Path(entry) for entry in os.environ.get(variable, "").split(os.pathsep) if entry)
    multiarch = sysconfig.get_config_var("MULTIARCH") or f"{platform.machine()}-linux-gnu"
    system = (f"/usr/lib/{multiarch}", "/usr/lib64", "/usr/lib", "/usr/local/lib", "/usr/local/lib64")
    others = ("/opt/homebrew/lib", f"{sys.prefix}/lib", r"C:\Program Files\LLVM\bin")
    yield from map(Path, system + others)
    for pattern in ("usr/lib*/llvm*/lib*", "usr/local/*/llvm*/lib", "opt/homebrew/opt/llvm*/lib"):
        yield from Path("/").glob(pattern)


def _libraries_in(folders: Iterable[Path]) -> list[LlvmLibrary]:
    """All libLLVM files in the folders; a file with several links to it appears once."""
    found: dict[Path, LlvmLibrary] = {}
    for folder in filter(Path.is_dir, folders):
        for path in sorted((*folder.glob("libLLVM[-.]*"), *folder.glob("LLVM-C.dll"))):
            file = path.resolve()
            usable = _NAME.fullmatch(path.name) and file.is_file() and _is_for_this_machine(file)
            if usable and file not in found:
                found[file] = LlvmLibrary(file, _version_of(path))
    return list(found.values())


def _libraries_of_linker() -> list[LlvmLibrary]:
    """The libLLVM files in the folders that the cache of the dynamic linker lists; empty without `ldconfig`."""
    try:
        listing = subprocess.run(["/sbin/ldconfig", "-p"], capture_output=True, text=True, timeout=10).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    paths = (Path(line.rpartition(" => ")[2]) for line in listing.splitlines() if "libLLVM" in line)
    return _libraries_in(dict.fromkeys(path.parent for path in paths))


def _version_of(path: Path) -> tuple[int, ...]:
    """Version of a library: from the name of the file, else from the name of the link to it, else from the library."""
    file = path.resolve()
    matches = filter(None, (_NAME.fullmatch(name) for name in (file.name, path.name)))
    named = (match["before"] or match["after"] for match in matches)
    text = next(filter(None, named), None) or _ask(file)
    return tuple(int(part) for part in text.split(".") if part)


def _ask(path: Path) -> str:
    """The version that the library itself reports; empty if it reports none.

    The library is loaded in another process, so that a crash does no harm here.
    """
    try:
        command = [sys.executable, "-c", _ASK, str(path)]
        answer = subprocess.run(command, capture_output=True, text=True, timeout=30)
    except subprocess.TimeoutExpired:
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""


def _is_for_this_machine(path: Path) -> bool:
    """Whether a library fits the running Python; False for an ELF file of another word size or processor."""
    with path.open("rb") as file, Path(sys.executable).open("rb") as interpreter:
        library, python = file.read(20), interpreter.read(20)
    both_elf = library.startswith(b"\x7fELF") and python.startswith(b"\x7fELF")
    return not both_elf or (library[4], library[18:20]) == (python[4], python[18:20])


def _version_held_by_drjit() -> tuple[int, ...] | None:
    """Version of the LLVM that Dr.Jit has loaded; None if Dr.Jit is not imported or has loaded none."""
    drjit = sys.modules.get("drjit")
    version = drjit.detail.llvm_version() if drjit is not None else None
    return tuple(version) if version else None
