# SPDX-License-Identifier: Apache-2.0
"""Kernels are compiled once, ahead of their use."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys

import pytest

from pcgraph import warmup

CODE = """
import sys
import numpy as np
from pcgraph.scan import segment
from pcgraph.warmup import compile_kernels

def compiled():
    modules = [m for name, m in sys.modules.items() if name.startswith("pcgraph")]
    kernels = {id(k): k for m in modules for k in vars(m).values() if hasattr(k, "nopython_signatures")}
    return {(k.py_func.__qualname__, str(s)) for k in kernels.values() for s in k.nopython_signatures}

compile_kernels()
before = compiled()
y, x = np.meshgrid(np.linspace(-0.3, 0.3, 60), np.linspace(-0.4, 0.4, 80), indexing="ij")
image = np.stack((x, y, 1.0 + 0.1 * (x > 0.1)), axis=-1)
image[::7, ::5] = np.nan
normals = np.zeros_like(image)
normals[..., 2] = -1.0
segment(image, np.full(image.shape, 0.5, np.float32), normals, (0.0, 0.0, 0.0))
segment(image.reshape(-1, 3))
print(len(before) > 5, compiled() - before)
"""


def test_the_warm_up_leaves_nothing_to_compile():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout == "True set()\n"


FIRST = """
from pcgraph.tree import region_linkage
from pcgraph.warmup import compile_in_two_processes, must_compile

print(must_compile())
compile_in_two_processes()
print(must_compile(), len(region_linkage._merge.nopython_signatures))
"""


@pytest.mark.slow
def test_on_an_empty_cache_a_second_process_compiles_the_tree(tmp_path):
    """This one compiles voxels meanwhile; a process that starts later finds all in the cache."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_NUM_THREADS": "2"}
    environment.pop("PYTEST_XDIST_WORKER", None)  # workers of the tests start no second process
    done = subprocess.run(
        [sys.executable, "-c", FIRST], capture_output=True, text=True, check=True, timeout=300, env=environment
    )
    assert done.stdout == "True\nFalse 0\n"
    done = subprocess.run([sys.executable, "-c", LATER], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "False 0\n"


LATER = """
import sys
import numpy as np
from pcgraph.scan import segment
from pcgraph.warmup import must_compile

needed = must_compile()
y, x = np.meshgrid(np.linspace(-0.3, 0.3, 60), np.linspace(-0.4, 0.4, 80), indexing="ij")
image = np.stack((x, y, 1.0 + 0.1 * (x > 0.1)), axis=-1)
segment(image, np.full(image.shape, 0.5))
modules = [m for name, m in sys.modules.items() if name.startswith("pcgraph")]
kernels = {id(k): k for m in modules for k in vars(m).values() if hasattr(k, "nopython_signatures")}
print(needed, sum(sum(k.stats.cache_misses.values()) for k in kernels.values()))
"""


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


def test_everything_runs_uncompiled_too():
    """As in a debugger; NUMBA_DISABLE_JIT=1."""
    code = (
        "import numpy as np, pcgraph\n"
        "y, x = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9))\n"
        "points = np.stack((x, y, 1 + 0.2 * (x > 0.5)), axis=-1)\n"
        "for kind in (pcgraph.ConvexityLinkage(), pcgraph.WardLinkage()):\n"
        "    print(pcgraph.segment(points, linkage=kind, voxel_size=0.15).graph.n_nodes > 1)"
    )
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "True\nTrue\n"
