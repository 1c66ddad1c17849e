# SPDX-License-Identifier: Apache-2.0
"""Compiling every kernel of `pcgraph.segment` ahead, for benchmarks of time.

On its first call `pcgraph.segment` compiles only the kernels that its defaults need, with `pcgraph.warmup`.
"""

from __future__ import annotations

import numpy as np

from pcgraph.scan import segment
from pcgraph.warmup import compile_levels, compile_the_rest, compile_voxels, image_of_a_step


def compile_kernels() -> None:
    """Compile the kernels that `pcgraph.segment` would otherwise compile in its first calls.

    It segments two small clouds, one as a list and one as a camera's image, and calls the kernels that these two do not
    reach. Only measurements of time need it: results are the same without it.
    """
    image, normals = image_of_a_step()
    segment(image, np.full(image.shape, 0.5), normals, (0.0, 0.0, 0.0))
    segment(image.reshape(-1, 3))
    compile_voxels()
    compile_the_rest()
    compile_levels()
