# SPDX-License-Identifier: Apache-2.0
"""Kernels are compiled once, and kept on the disk."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tiers import to_validate

import pcgraph
from pcgraph.all_kernels import compile_kernels
from pcgraph.kernel_cache import is_sound
from pcgraph.supervoxels import clustering

KERNELS = """
import sys
import numpy as np
from pcgraph.scan import segment

def started(event, _):
    assert event not in ("subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.exec"), event

sys.addaudithook(started)

def kernels():
    modules = [m for name, m in sys.modules.items() if name.startswith("pcgraph")]
    return {id(k): k for m in modules for k in vars(m).values() if hasattr(k, "nopython_signatures")}.values()

def compiled():
    return {(k.py_func.__qualname__, str(s)) for k in kernels() for s in k.nopython_signatures}

y, x = np.meshgrid(np.linspace(-0.3, 0.3, 60), np.linspace(-0.4, 0.4, 80), indexing="ij")
image = np.stack((x, y, 1.0 + 0.1 * (x > 0.1)), axis=-1)
"""
FIRST = """
segment(image, np.full(image.shape, 0.5))
segment(image, np.full(image.shape, 0.5))
print(sorted({k.py_func.__name__ for k in kernels() if k.stats.cache_misses}))
"""
LATER = """
from pcgraph.all_kernels import compile_kernels

compile_kernels()
before = compiled()
image[::7, ::5] = np.nan
normals = np.zeros_like(image)
normals[..., 2] = -1.0
segment(image, np.full(image.shape, 0.5, np.float32), normals, (0.0, 0.0, 0.0))
segment(image.reshape(-1, 3))
print(compiled() - before)
several = [k for k in kernels() if len(k.nopython_signatures) > 1]
print({k.py_func.__name__ for k in several if "no_cpython_wrapper" not in k.targetoptions})
"""


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A process that imports the pcgraph in `folder`, with the cache beside it."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": "", "PYTHONDONTWRITEBYTECODE": "", "PYTHONPATH": str(folder)}
    line = [sys.executable, "-P", "-c", code]
    return subprocess.run(line, capture_output=True, text=True, check=True, timeout=300, env=environment)


def test_segment_compiles_what_is_missing_and_says_so_once(tmp_path):
    """It starts no process for that, and a later process finds all in the cache.

    The package is a copy with the cache of the tests, less one kernel.
    """
    compile_kernels()  # where no test has run yet
    source, package = Path(pcgraph.__file__).parent, tmp_path / "pcgraph"
    shutil.copytree(source, package, ignore=shutil.ignore_patterns("__pycache__"))  # with times, which caches know
    modules = [module for name, module in sys.modules.items() if name.startswith("pcgraph.")]
    for kernel in (k for module in modules for k in vars(module).values() if hasattr(k, "nopython_signatures")):
        file = Path(kernel.py_func.__code__.co_filename)
        cache = package / file.parent.relative_to(source) / "__pycache__"
        cache.mkdir(exist_ok=True)
        kept = f"{file.stem}.{kernel.py_func.__name__}-*.nb?"
        for kernel_file in () if kernel is clustering._expand else Path(kernel.stats.cache_path).glob(kept):
            shutil.copy2(kernel_file, cache)
    first, later = run(KERNELS + FIRST, tmp_path), run(KERNELS + FIRST, tmp_path)
    assert first.stdout == "['_expand']\n"
    assert first.stderr.startswith("pcgraph: compiling kernels")
    assert first.stderr.count("\n") == 1
    assert (later.stdout, later.stderr) == ("[]\n", "")


def test_after_compiling_ahead_nothing_is_left_to_compile_whatever_the_form_of_the_cloud():
    """Each kernel has one signature, but for one that takes voxels of one size or of several."""
    done = run(KERNELS + LATER, Path(pcgraph.__file__).parents[1])
    assert done.stdout == "set()\n{'_find_ends'}\n"


def test_what_was_compiled_for_a_class_that_is_no_more_is_compiled_anew(tmp_path):
    """After an update of the package: numba keeps kernels by function and line, with the classes of their arguments."""
    source = """
from typing import NamedTuple
from pcgraph.parallel import kernel

class {name}(NamedTuple):
    value: int

@kernel
def twice(of):
    return 2 * of.value

print(twice({name}(21)), sum(twice.stats.cache_hits.values()))
"""
    environment = {**os.environ, "PYTHONPATH": str(Path(pcgraph.__file__).parents[1])}
    environment.pop("NUMBA_CACHE_DIR", None)
    said = []
    for name in ("Slant", "Slant", "NormalTransform", "NormalTransform"):
        (tmp_path / "kernels.py").write_text(source.format(name=name))
        run = subprocess.run(
            [sys.executable, "-c", "import kernels"], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert run.returncode == 0, run.stderr
        said.append(run.stdout.split())
    assert [value for value, _ in said] == ["42"] * 4
    assert [hits for _, hits in said[2:]] == ["0", "1"]


CACHED = """
import sys
import numpy as np
from pcgraph.kernel_cache import cached_njit
from pcgraph.parallel import kernel

@kernel
def total(values):
    sum = 0.0
    for value in values:
        sum += value
    return sum

@cached_njit()
def larger(n):
    return n + 1

print(total(np.arange(10.0)), total(np.arange(5)), larger(41))
print(*(sum(function.stats.cache_hits.values()) for function in (total, larger)))
"""


def damage_of(kind, content):
    """What became of a file."""
    middle = len(content) // 2
    if kind == "one bit":
        return content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]
    if kind == "cut short":
        return content[:middle]
    if kind == "blocks of zeros":
        return bytes(len(content))
    if kind == "other machine code":
        return content.replace(b"\x7fELF", b"\x7fELK")
    if kind == "numba's own":
        return content[: content.rindex(b"pcgraph kernel ")]
    return {"empty": b"", "a pickle that ends the process": b"cos\n_exit\n(I7\ntR."}[kind]


DAMAGES = ["one bit", "other machine code", "a pickle that ends the process"]
DAMAGES += to_validate(
    "numba's own", "cut short", "blocks of zeros", "empty"
)  # unsound as one bit is: see the test below


@pytest.fixture(scope="module")
def cached(tmp_path_factory):
    """A folder with a module whose kernels are in numba's cache there."""
    folder = tmp_path_factory.mktemp("cached")
    (folder / "kernels.py").write_text(CACHED)
    assert hits_of(folder) == "0 0"
    assert hits_of(folder) == "2 1"
    return folder


def hits_of(folder):
    """How many signatures of either kernel a new process finds in the cache."""
    environment = {**os.environ, "PYTHONPATH": str(Path(pcgraph.__file__).parents[1])}
    environment.pop("NUMBA_CACHE_DIR", None)
    line = [sys.executable, "-c", "import kernels"]
    run = subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)
    assert (run.returncode, run.stderr) == (0, "")
    values, hits = run.stdout.splitlines()
    assert values == "45.0 10.0 42"
    return hits


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_cache_heals(cached, kind):
    """Index and machine code alike: it is removed, compiled anew, and found sound by the process after that."""
    before = sorted((cached / "__pycache__").iterdir())
    for suffix in ("nbc",) if kind == "other machine code" else ("nbi", "nbc"):
        for path in (path for path in before if path.name.endswith(suffix)):
            assert is_sound(path)
            path.write_bytes(damage_of(kind, path.read_bytes()))
            assert not is_sound(path)
        assert hits_of(cached) == "0 0"
    assert hits_of(cached) == "2 1"
    assert sorted((cached / "__pycache__").iterdir()) == before
