# SPDX-License-Identifier: Apache-2.0
"""Kernels are compiled once, ahead of their use."""

from __future__ import annotations

import os
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
from pcgraph.tree import average_linkage
from pcgraph.warmup import compile_in_two_processes, must_compile

print(must_compile())
compile_in_two_processes()
print(must_compile(), len(average_linkage._merge.nopython_signatures))
"""


@pytest.mark.slow
def test_on_an_empty_cache_a_second_process_compiles_the_tree(tmp_path):
    """This one compiles voxels meanwhile; a process that starts later finds all in the cache."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", FIRST], capture_output=True, text=True, check=True, timeout=300, env=environment
    )
    assert done.stdout == "True\nFalse 0\n"
    again = "from pcgraph.warmup import must_compile; print(must_compile())"
    done = subprocess.run([sys.executable, "-c", again], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "False\n"


@pytest.mark.parametrize("executable", ["", "/usr/bin/blender", "/nowhere/python3"])
def test_without_an_interpreter_to_start_kernels_are_compiled_as_they_are_used(monkeypatch, executable):
    monkeypatch.setattr(warmup.sys, "executable", executable)
    assert warmup._second_process() is None
