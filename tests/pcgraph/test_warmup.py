# SPDX-License-Identifier: Apache-2.0
"""Nothing is left to compile after the warm-up."""

from __future__ import annotations

import subprocess
import sys

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
