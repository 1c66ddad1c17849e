# SPDX-License-Identifier: Apache-2.0
"""Kernels are compiled once, ahead of their use."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
from ast import literal_eval
from pathlib import Path
from types import SimpleNamespace

import pytest
from tiers import to_validate

import pcgraph
from pcgraph import warmup
from pcgraph.all_kernels import compile_kernels
from pcgraph.graph import contacts
from pcgraph.kernel_cache import is_sound
from pcgraph.supervoxels import clustering

KERNELS = """
import sys
import numpy as np
from pcgraph import warmup
from pcgraph.scan import segment

def kernels():
    modules = [m for name, m in sys.modules.items() if name.startswith("pcgraph")]
    return {id(k): k for m in modules for k in vars(m).values() if hasattr(k, "nopython_signatures")}.values()

def compiled():
    return {(k.py_func.__qualname__, str(s)) for k in kernels() for s in k.nopython_signatures}

y, x = np.meshgrid(np.linspace(-0.3, 0.3, 60), np.linspace(-0.4, 0.4, 80), indexing="ij")
image = np.stack((x, y, 1.0 + 0.1 * (x > 0.1)), axis=-1)
"""
FIRST = """
from pcgraph.graph import contacts
from pcgraph.supervoxels import clustering
from pcgraph.tree import region_linkage

missing = clustering._expand, contacts._relate
print(warmup.must_compile(), [warmup._is_cached(kernel) for kernel in missing])
warmup.compile_in_two_processes()
print([warmup._is_cached(kernel) for kernel in missing], len(region_linkage._merge.nopython_signatures))
print({k.py_func.__name__ for k in kernels() if k.stats.cache_misses})
warmup.compile_the_rest()
before = compiled()
segment(image, np.full(image.shape, 0.5))
print(compiled() - before)
print(before)
"""
LATER = """
from pcgraph.all_kernels import compile_kernels

print(warmup.must_compile())
compile_kernels()
before = compiled()
image[::7, ::5] = np.nan
normals = np.zeros_like(image)
normals[..., 2] = -1.0
segment(image, np.full(image.shape, 0.5, np.float32), normals, (0.0, 0.0, 0.0))
segment(image.reshape(-1, 3))
print(compiled() - before)
print([(k.py_func.__qualname__, str(s)) for k in kernels() for s in k.stats.cache_misses])
"""


def run(code: str, folder: Path, **environment: str) -> str:
    """What a process prints that is no worker of the tests: workers start no second process.

    It imports the pcgraph in `folder`.
    """
    variables = {name: value for name, value in os.environ.items() if name != "PYTEST_XDIST_WORKER"} | environment
    line = [sys.executable, "-P", "-c", code]
    variables["PYTHONPATH"] = str(folder)
    return subprocess.run(line, capture_output=True, text=True, check=True, timeout=300, env=variables).stdout


def test_where_kernels_are_missing_a_second_process_compiles_those_of_the_tree(tmp_path):
    """This one compiles those of voxels meanwhile. A process that starts later finds all in the cache, and after
    `compile_kernels` nothing is left to compile whatever the form of the cloud.

    The package is a copy with the cache of the tests, less the two kernels that tell whether a cache is filled. That
    the halves forget no other shows in the first process, which then compares what both compile with what a call needs.
    """
    compile_kernels()  # where no test has run yet
    source, package = Path(pcgraph.__file__).parent, tmp_path / "pcgraph"
    shutil.copytree(source, package, ignore=shutil.ignore_patterns("__pycache__"))  # with times, which caches know
    modules = [module for name, module in sys.modules.items() if name.startswith("pcgraph.")]
    for kernel in (k for module in modules for k in vars(module).values() if hasattr(k, "nopython_signatures")):
        file = Path(kernel.py_func.__code__.co_filename)
        cache = package / file.parent.relative_to(source) / "__pycache__"
        cache.mkdir(exist_ok=True)
        left_out = kernel in (clustering._expand, contacts._relate)
        kept = f"{file.stem}.{kernel.py_func.__name__}-*.nb?"
        for kernel_file in () if left_out else Path(kernel.stats.cache_path).glob(kept):
            shutil.copy2(kernel_file, cache)
    environment = {"NUMBA_NUM_THREADS": "2", "NUMBA_CACHE_DIR": "", "PYTHONDONTWRITEBYTECODE": ""}
    *said, needed = run(KERNELS + FIRST, tmp_path, **environment).splitlines()
    assert said == ["True [False, False]", "[True, True] 0", "{'_expand'}", "set()"]
    *said, compiled_later = run(KERNELS + LATER, tmp_path, **environment).splitlines()
    assert said == ["False", "set()"]
    assert len(literal_eval(needed)) > 5
    assert literal_eval(needed).isdisjoint(literal_eval(compiled_later))


@pytest.fixture
def alone(monkeypatch):
    """As in a process that is no worker of the tests, with an empty cache and two threads."""
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    monkeypatch.setattr(warmup.config, "NUMBA_NUM_THREADS", 2)
    monkeypatch.setattr(warmup, "must_compile", lambda: True)
    monkeypatch.setattr(warmup, "_done", False)
    calls = []
    monkeypatch.setattr(warmup, "compile_voxels", lambda: calls.append("voxels"))
    return calls


@pytest.mark.parametrize("executable", ["", "/usr/bin/blender", "/nowhere/python3"])
def test_without_an_interpreter_to_start_kernels_are_compiled_as_they_are_used(monkeypatch, alone, executable):
    monkeypatch.setattr(warmup.sys, "executable", executable)
    warmup.compile_in_two_processes()
    assert alone == []


def test_a_second_process_that_takes_too_long_is_given_up(monkeypatch, alone):
    monkeypatch.setattr(warmup, "_PATIENCE_S", 0.01)
    processes = []
    start = warmup._second_process
    monkeypatch.setattr(warmup, "_second_process", lambda: processes.append(start()) or processes[-1])
    warmup.compile_in_two_processes()
    assert alone == ["voxels"]
    assert processes[0].returncode is not None


def test_workers_of_a_pool_start_no_processes_of_their_own(monkeypatch, alone):
    monkeypatch.setenv("PYTEST_XDIST_WORKER", "gw0")
    assert warmup._second_process() is None


def test_an_index_of_another_version_of_numba_is_none(tmp_path):
    index = tmp_path / "a.nbi"
    index.write_bytes(pickle.dumps("0.1") + b"more")
    assert warmup._version_of(index) == "0.1"


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


DAMAGES = ["one bit", "other machine code", "numba's own", "a pickle that ends the process"]
DAMAGES += to_validate("cut short", "blocks of zeros", "empty")  # unsound as one bit is: see the test below


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


def test_an_index_that_is_damaged_counts_as_missing(tmp_path):
    """So `pcgraph segment` says beforehand that it compiles."""
    compile_kernels()
    kernel = clustering._expand
    code = kernel.py_func.__code__
    (index,) = Path(kernel.stats.cache_path).glob(f"*.{code.co_name}-{code.co_firstlineno}.*.nbi")
    copy = Path(shutil.copy2(index, tmp_path))
    here = SimpleNamespace(py_func=kernel.py_func, stats=SimpleNamespace(cache_path=tmp_path))
    assert warmup._is_cached(here)
    content = index.read_bytes()
    for damaged in (content[:-1] + bytes([content[-1] ^ 1]), content[:9], bytes(len(content)), b""):
        copy.write_bytes(damaged)
        assert not warmup._is_cached(here)
