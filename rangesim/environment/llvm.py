# SPDX-License-Identifier: Apache-2.0
"""The LLVM shared library that Dr.Jit compiles kernels with, chosen and checked before the first kernel.

Dr.Jit loads a libLLVM when it is imported, and a too old one ends the process at the first kernel, with no
exception to catch. So the version is read from file names, without loading anything, and a known bad
version is never used.

Measured with Dr.Jit 1.5.0 and Mitsuba 3.9.1 on x86-64 (a sin/min/max kernel, then a Cornell box):

    LLVM 14               refused by Dr.Jit ("could not be found" is all it says)
    LLVM 15, 16           abort: "Cannot select: fminimum"
    LLVM 17, 18, 19, 22   work, with the same image

x86 has no instruction for IEEE minimum/maximum, and LLVM learnt to expand it in version 17 (LLVM issue
53353), which agrees with the table. LLVM 20 and 21 are not measured; they lie between versions that work.
A version newer than `NEWEST_TESTED` is used only if no tested one is there, since LLVM changes its C API.
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
NEWEST_TESTED = 22
VARIABLE = "DRJIT_LIBLLVM_PATH"

# libLLVM-15.so.1, libLLVM-18.so.18.1, libLLVM.so.19.1, libLLVM.so, libLLVM.dylib, LLVM-C.dll; a private
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
    """A libLLVM file and its version; the version is () where it could not be told."""

    path: Path
    version: tuple[int, ...]

    @property
    def suitable(self) -> bool:
        """Whether Dr.Jit can compile with it."""
        return self.version >= (MINIMUM,)

    @property
    def rank(self) -> tuple[bool, tuple[int, ...]]:
        """Sort key: the newest of the tested versions comes last, an untested newer one before them."""
        return self.version < (NEWEST_TESTED + 1,), self.version

    def __str__(self) -> str:
        return f"LLVM {'.'.join(map(str, self.version)) or 'of unknown version'} ({self.path})"


def ensure_llvm(variant: str = "llvm_ad_mono") -> LlvmLibrary | None:
    """The library Dr.Jit will use, named in `DRJIT_LIBLLVM_PATH`; None if the variant does without LLVM.

    Call it before the first `import mitsuba` or `import drjit`.

    Raises:
        EnvironmentProblem: there is no suitable library, `DRJIT_LIBLLVM_PATH` names a bad one, or Dr.Jit
            was imported earlier and holds a bad one.
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
    """The library named by `DRJIT_LIBLLVM_PATH`, otherwise the newest suitable one of this machine.

    Args:
        folders: where to look instead of the standard library folders of this platform.

    Raises:
        EnvironmentProblem: the named library, or every library found, is missing or unsuitable.
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
    """Folders that hold libLLVM on Linux, macOS and Windows; the ones asked for by the user first."""
    for variable in ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH") + (("PATH",) if os.name == "nt" else ()):
        yield from (Path(entry) for entry in os.environ.get(variable, "").split(os.pathsep) if entry)
    multiarch = sysconfig.get_config_var("MULTIARCH") or f"{platform.machine()}-linux-gnu"
    system = (f"/usr/lib/{multiarch}", "/usr/lib64", "/usr/lib", "/usr/local/lib", "/usr/local/lib64")
    others = ("/opt/homebrew/lib", f"{sys.prefix}/lib", r"C:\Program Files\LLVM\bin")
    yield from map(Path, system + others)
    for pattern in ("usr/lib*/llvm*/lib*", "usr/local/*/llvm*/lib", "opt/homebrew/opt/llvm*/lib"):
        yield from Path("/").glob(pattern)


def _libraries_in(folders: Iterable[Path]) -> list[LlvmLibrary]:
    """Every libLLVM file in the folders, each file once however many links lead to it."""
    found: dict[Path, LlvmLibrary] = {}
    for folder in filter(Path.is_dir, folders):
        for path in sorted((*folder.glob("libLLVM[-.]*"), *folder.glob("LLVM-C.dll"))):
            file = path.resolve()
            usable = _NAME.fullmatch(path.name) and file.is_file() and _is_for_this_machine(file)
            if usable and file not in found:
                found[file] = LlvmLibrary(file, _version_of(path))
    return list(found.values())


def _libraries_of_linker() -> list[LlvmLibrary]:
    """What the dynamic linker's cache knows; asked only if the standard folders hold nothing suitable."""
    try:
        listing = subprocess.run(["/sbin/ldconfig", "-p"], capture_output=True, text=True, timeout=10).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    paths = (Path(line.rpartition(" => ")[2]) for line in listing.splitlines() if "libLLVM" in line)
    return _libraries_in(dict.fromkeys(path.parent for path in paths))


def _version_of(path: Path) -> tuple[int, ...]:
    """The version in the name of the file a link leads to, else in the link's, else as the library says."""
    file = path.resolve()
    matches = filter(None, (_NAME.fullmatch(name) for name in (file.name, path.name)))
    named = (match["before"] or match["after"] for match in matches)
    text = next(filter(None, named), None) or _ask(file)
    return tuple(int(part) for part in text.split(".") if part)


def _ask(path: Path) -> str:
    """The version the library itself reports, or ""; in another process, where loading can do no harm."""
    try:
        command = [sys.executable, "-c", _ASK, str(path)]
        answer = subprocess.run(command, capture_output=True, text=True, timeout=30)
    except subprocess.TimeoutExpired:
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""


def _is_for_this_machine(path: Path) -> bool:
    """False for an ELF library of another word size or processor than the running Python's."""
    with path.open("rb") as file, Path(sys.executable).open("rb") as interpreter:
        library, python = file.read(20), interpreter.read(20)
    both_elf = library.startswith(b"\x7fELF") and python.startswith(b"\x7fELF")
    return not both_elf or (library[4], library[18:20]) == (python[4], python[18:20])


def _version_held_by_drjit() -> tuple[int, ...] | None:
    """The version of the LLVM that an already imported Dr.Jit has loaded; None if it has loaded none."""
    drjit = sys.modules.get("drjit")
    version = drjit.detail.llvm_version() if drjit is not None else None
    return tuple(version) if version else None
