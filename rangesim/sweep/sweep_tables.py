# SPDX-License-Identifier: Apache-2.0
"""The tables of a sweep, as CSV and as Parquet."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from rangesim.errors import EnvironmentProblem
from rangesim.sweep.confidence_intervals import Interval
from rangesim.sweep.sweep_result import SweepResult


def rows_table(result: SweepResult) -> dict[str, list[Any]]:
    """Columns of a row for each point, sensor, seed and surface."""
    return _columns([_spread(row) for row in result.rows])


def summary_table(result: SweepResult) -> dict[str, list[Any]]:
    """Columns of a row for each point, sensor and surface: means, and the ends of their confidence intervals in
    columns that end with `_low` and `_high`. A column `cause_NAME` holds the fraction of the pixels that failed by that
    cause."""
    return _columns([_spread(row) for row in result.summary])


def csv_bytes(columns: Mapping[str, Sequence[Any]]) -> bytes:
    """A table as CSV: a header, a comma between values, nothing where a value is not known.

    Examples
    --------
    >>> csv_bytes({"sensor": ["amcw"], "error_m": [None]})
    b'sensor,error_m\\r\\namcw,\\r\\n'
    """
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue().encode()


def parquet_bytes(columns: Mapping[str, Sequence[Any]]) -> bytes:
    """A table as a Parquet file.

    Raises
    ------
    EnvironmentProblem
        pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise EnvironmentProblem(
            "tables in Parquet need pyarrow, which is not installed here: pip install 'rangesim[campaign]'."
        ) from None
    buffer = io.BytesIO()
    pq.write_table(pa.table({name: list(values) for name, values in columns.items()}), buffer)
    return buffer.getvalue()


def _spread(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row whose intervals and causes have a column for each of their numbers."""
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Interval):
            flat |= {name: value.mean, f"{name}_low": value.low, f"{name}_high": value.high}
        elif name == "causes":
            flat |= {f"cause_{cause}": fraction for cause, fraction in value.items()}
        else:
            flat[name] = value
    return {name: _plain(value) for name, value in flat.items()}


def _plain(value: Any) -> Any:
    """A value of a cell: lists and tables as JSON, None for NaN."""
    if isinstance(value, float) and math.isnan(value):
        return None
    return json.dumps(value) if isinstance(value, (list, tuple, Mapping)) else value


def _columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Columns of rows. A cause that a row does not name has the fraction 0; values of several types become text."""
    names = dict.fromkeys(name for row in rows for name in row)
    ordered = [*(n for n in names if not n.startswith("cause_")), *sorted(n for n in names if n.startswith("cause_"))]
    columns = {}
    for name in ordered:
        values = [row.get(name, 0.0 if name.startswith("cause_") else None) for row in rows]
        kinds = {float if isinstance(v, int) and not isinstance(v, bool) else type(v) for v in values if v is not None}
        is_mixed = len(kinds) > 1
        has_floats = any(isinstance(v, float) for v in values)
        columns[name] = [None if v is None else str(v) if is_mixed else float(v) if has_floats else v for v in values]
    return columns
