# SPDX-License-Identifier: Apache-2.0
"""Tables of features: one array per column, and the same as one dict per row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def rows(columns: dict[str, NDArray[np.generic]] | dict[str, NDArray[np.float64]], n: int) -> list[dict[str, object]]:
    """One dict per row from one array per column; scalars become Python numbers, vectors stay arrays."""
    names = list(columns)
    lists = [column.tolist() if column.ndim == 1 else list(column) for column in columns.values()]
    return [dict(zip(names, (values[i] for values in lists), strict=True)) for i in range(n)]
