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


def scalar_columns(columns: dict[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    """The same table with one column per number: vectors split into x, y, z, colours into r, g, b, matrices too.

    Symmetric matrices keep their upper triangle. Columns of NaN, which the cloud knows nothing of, are left out.
    """
    split: dict[str, NDArray[np.generic]] = {}
    for name, column in columns.items():
        axes = "rgb" if name.startswith("color") else "xyz"
        if column.ndim == 1:
            split[name] = column
        elif column.ndim == 2:
            split |= {f"{name}_{axes[i]}": column[:, i] for i in range(3)}
        else:
            split |= {f"{name}_{axes[i]}{axes[j]}": column[:, i, j] for i in range(3) for j in range(i, 3)}
    return {name: column for name, column in split.items() if not len(column) or not _unknown(column)}


def _unknown(column: NDArray[np.generic]) -> bool:
    return column.dtype.kind == "f" and bool(np.isnan(column.astype(np.float64)).all())
