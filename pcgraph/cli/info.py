# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph info``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcgraph.cli.clouds import (
    PIPE,
    ColumnsOption,
    FormatOption,
    has_cloud,
    is_saved,
    print_result,
    print_row,
    read_input,
    sentence,
)
from pcgraph.errors import PcgraphError, one_line

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pcgraph.cloud import Cloud


def info_command(
    files: Annotated[
        list[str], typer.Argument(metavar="FILE...", help="Point clouds or saved segmentations; - is stdin.")
    ],
    from_format: FormatOption = None,
    columns: ColumnsOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one line of JSON for each file.")] = False,
) -> None:
    """Print the content of files: points, extent, spacing, and columns with their types and ranges.

    Example: pcgraph info scan.laz
    """
    failed = False
    for name in files:
        try:
            record = {"file": name, **_record(name, from_format, columns)}
        except (PcgraphError, ValueError, MemoryError, OSError) as error:
            typer.echo(f"pcgraph: {sentence(error)}", err=True)
            failed = True
            continue
        if as_json:
            typer.echo(json.dumps(record, allow_nan=False))
        else:
            _print(record)
    if failed:
        raise typer.Exit(1)


def _record(name: str, file_format: str | None, columns: str | None) -> dict[str, Any]:
    """Content of a file as plain values for JSON: of a cloud, of a saved segmentation, or of both."""
    if name == PIPE or not is_saved(Path(name)):
        return _cloud_record(read_input(name, file_format, columns))
    from pcgraph.saved_segmentation import load_segmentation

    result = load_segmentation(name)
    saved = {"segmentation": {"points": result.labels.size, **result.summary()}}
    return saved if not has_cloud(Path(name)) else {**_cloud_record(read_input(name)), **saved}


def _cloud_record(cloud: Cloud) -> dict[str, Any]:
    """Content of a cloud as plain values for JSON."""
    import numpy as np

    from pcgraph.voxels.spacing import median_spacing

    points = np.asarray(cloud.points, np.float64).reshape(-1, 3)
    finite = points[np.isfinite(points).all(axis=1)]
    held = {"colors": cloud.colors, "normals": cloud.normals, "labels": cloud.labels, **cloud.columns}
    return {
        "shape": list(cloud.points.shape[:-1]),
        "finite": len(finite),
        "low": finite.min(axis=0).tolist() if len(finite) else None,
        "high": finite.max(axis=0).tolist() if len(finite) else None,
        "spacing": median_spacing(finite) if len(finite) and np.ptp(finite, axis=0).any() else None,
        "coordinates": str(cloud.points.dtype),
        "viewpoint": None if cloud.viewpoint is None or cloud.viewpoint.ndim > 1 else cloud.viewpoint.tolist(),
        "columns": {name: _column(values) for name, values in held.items() if values is not None},
    }


def _column(values: NDArray[np.generic]) -> dict[str, Any]:
    import numpy as np

    known = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    ends = [None, None] if not known.size else [known.min().item(), known.max().item()]
    return {"type": str(values.dtype), "low": ends[0], "high": ends[1]}


def _print(record: dict[str, Any]) -> None:
    print_row("file", one_line(record["file"]))
    if "shape" in record:
        _print_cloud(record)
    if "segmentation" in record:
        print_row("holds", "a segmentation:")
        print_result(record["segmentation"], record["segmentation"]["points"])


def _print_cloud(record: dict[str, Any]) -> None:
    shape = " x ".join(map(str, record["shape"]))
    print_row("points", f"{shape}, {record['finite']} finite, {record['coordinates']}")
    if record["low"] is not None:
        for axis, low, high in zip("xyz", record["low"], record["high"], strict=True):
            print_row(axis, f"{low:.10g} to {high:.10g}")
    if record["spacing"] is not None:
        print_row("spacing", f"{record['spacing']:.3g}, median")
    if record["viewpoint"] is not None:
        print_row("viewpoint", " ".join(f"{value:.6g}" for value in record["viewpoint"]))
    for name, column in record["columns"].items():
        ends = "no number" if column["low"] is None else _range(column["low"], column["high"])
        print_row(one_line(name), f"{column['type']}, {ends}")


def _range(low: float, high: float) -> str:
    """Both ends, with six digits or as many as it takes to tell them apart: GPS times differ in the tenth."""
    if isinstance(low, int):
        return f"{low} to {high}"
    span = high - low
    digits = 6 if not 0.0 < span < math.inf else 3 + math.ceil(math.log10(max(abs(low), abs(high)) / span))
    return f"{low:.{min(max(digits, 6), 17)}g} to {high:.{min(max(digits, 6), 17)}g}"
