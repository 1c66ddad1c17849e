# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph cut``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from pcgraph.cli.clouds import (
    SAVED,
    ColorizeOption,
    LevelsOption,
    check_outputs,
    numbers,
    object_records,
    read_saved,
    refusals,
    write_results,
)
from pcgraph.errors import one_line


def cut_command(
    segmentation: Annotated[Path, typer.Argument(help="A segmentation that was saved, such as scan.segmentation.npz.")],
    out: Annotated[
        Path | None, typer.Option(help="The labelled cloud, or an .npz with the new cut. Default: NAME.cut.ply.")
    ] = None,
    objects: Annotated[int | None, typer.Option(help="Exact number of segments.")] = None,
    altitude: Annotated[
        float | None, typer.Option(help="Altitude of the cut, in the linkage's unit. Default: as it was saved.")
    ] = None,
    min_size: Annotated[int, typer.Option(help="Points that every segment has at least.")] = 1,
    levels: LevelsOption = None,
    colorize: ColorizeOption = False,
    boxes: Annotated[bool, typer.Option("--boxes", help="Print each object with its box as a line of JSON.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an output that exists.")] = False,
) -> None:
    """Cut the tree of a saved segmentation at another level; nothing is segmented again.

    Example: pcgraph cut scan.segmentation.npz --objects 200 --out finer.laz
    """
    with refusals():
        cuts = numbers(levels, "--levels")
        name = segmentation.name.removesuffix(SAVED).removesuffix(".npz")
        target = segmentation.with_name(f"{name}.cut.ply") if out is None else out
        check_outputs([target], [str(segmentation)], overwrite)
        cloud, result = read_saved(segmentation)
        if objects is not None or altitude is not None or min_size != 1:
            level = result.object_altitude if objects is None and altitude is None else altitude
            result = result.with_objects(objects, level, min_size)
        write_results([target], cloud, result, cuts, colorize, overwrite)
        if boxes:
            for record in object_records(cloud, result):
                typer.echo(json.dumps(record, allow_nan=False))
        else:
            typer.echo(f"{'objects':<12} {int(result.labels.max()) + 1}")
            typer.echo(f"{'written':<12} {one_line(target)}")
