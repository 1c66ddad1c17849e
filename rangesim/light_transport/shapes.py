# SPDX-License-Identifier: Apache-2.0
"""Tables of what is known of each shape: looked up by number in a kernel.

Asking the shapes themselves is a virtual call, for which Dr.Jit traces the code of each and every shape of the process,
about 0.1 ms for each: nothing among ten shapes, but a second among ten thousand.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


def number_of(shape: Any) -> Any:
    """(lanes,) UInt32, the place in a table of each shape of a mitsuba.ShapePtr; 0 for none."""
    return dr.reinterpret_array(mi.UInt32, shape)


def table_of(scene: Any, values: Any) -> np.ndarray:
    """`values` (n, ...), one for each of the scene's shapes in their order, at the places that `number_of` gives."""
    numbers, values = number_of(scene.shapes_dr()).numpy(), np.asarray(values)
    table = np.zeros((int(numbers.max()) + 1, *values.shape[1:]), values.dtype)
    table[numbers] = values
    return table
