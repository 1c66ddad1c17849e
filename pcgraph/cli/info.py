# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph info``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcgraph.cli.clouds import read_input, sentence
from pcgraph.errors import PcgraphError, one_line

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pcgraph.cloud import Cloud


def info_command(
    files: Annotated[
        list[str], typer.Argument(metavar="FILE...", help="Point clouds or saved segmentations; - is stdin.")
    ],
    from_format: Annotated[
        str | None, typer.Option("--from", help="Format of the input, such as ply. Default: by its name.")
    ] = None,
    columns: Annotated[
        str | None, typer.Option(help="Names of the columns of a text without a header: x,y,z,intensity.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one line of JSON for each file.")] = False,
) -> None:
    """Print the content of files: points, extent, spacing, and columns with their types and ranges.

    Example: pcgraph info scan.laz
    """
    failed = False
    for name in files:
        try:
            record = {"file": name, **_record(read_input(name, from_format, columns))}
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


def _record(cloud: Cloud) -> dict[str, Any]:
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
        "spacing": median_spacing(finite) if len(finite) > 1 else None,
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
    shape = " x ".join(map(str, record["shape"]))
    rows = [
        ("file", one_line(record["file"])),
        ("points", f"{shape}, {record['finite']} finite, {record['coordinates']}"),
    ]
    if record["low"] is not None:
        for axis, low, high in zip("xyz", record["low"], record["high"], strict=True):
            rows.append((axis, f"{low:.10g} to {high:.10g}"))
    if record["spacing"] is not None:
        rows.append(("spacing", f"{record['spacing']:.3g}, median"))
    if record["viewpoint"] is not None:
        rows.append(("viewpoint", " ".join(f"{value:.6g}" for value in record["viewpoint"])))
    for name, column in record["columns"].items():
        ends = "no number" if column["low"] is None else f"{column['low']:.6g} to {column['high']:.6g}"
        rows.append((one_line(name), f"{column['type']}, {ends}"))
    for name, text in rows:
        typer.echo(f"{name:<12} {text}")
