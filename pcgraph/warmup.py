# SPDX-License-Identifier: Apache-2.0
"""Compiling ahead of a measurement of time."""

from __future__ import annotations

import numpy as np

from pcgraph.scan import segment

_EDGE = 24  # points along the cloud's edges
_SPACING = 0.01  # metres between neighbouring points


def compile_kernels() -> None:
    """Compile what `pcgraph.segment` would otherwise compile in its first call.

    It segments two small clouds, one as a list and one as a camera's image. Needed only where times are measured:
    results are the same without it.
    """
    steps = _SPACING * np.arange(_EDGE)
    x, y = np.meshgrid(steps, steps)
    depth = np.where((x > steps[8]) & (y > steps[8]), 0.9, 1.0)  # metres; a step, so that there are edges
    image = np.stack((x, y, depth), axis=-1)
    colors = np.full(image.shape, 0.5)
    normals = np.broadcast_to(np.array([0.0, 0.0, -1.0]), image.shape)
    segment(image, colors, normals, (0.0, 0.0, 0.0))
    segment(image.reshape(-1, 3))
