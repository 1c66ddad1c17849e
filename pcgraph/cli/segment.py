# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph segment``."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcgraph.cli.clouds import (
    PIPE,
    ColorizeOption,
    ColumnsOption,
    FormatOption,
    LevelsOption,
    check_outputs,
    numbers,
    object_records,
    output_paths,
    print_result,
    print_row,
    read_input,
    refusals,
    segmented,
    sentence,
    write_results,
)
from pcgraph.errors import PcgraphError, one_line
from pcgraph.families import member

if TYPE_CHECKING:
    from pcgraph.cloud import Cloud
    from pcgraph.segmentation import Segmentation
    from pcgraph.tree.linkage import Linkage


def segment_command(
    clouds: Annotated[
        list[str], typer.Argument(metavar="CLOUD...", help="Point clouds, coordinates in metres; - is stdin.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="One file, a folder, or - for stdout. Default: two files in the current folder."),
    ] = None,
    from_format: FormatOption = None,
    to_format: Annotated[
        str | None,
        typer.Option("--to", help="Suffix of the labelled cloud, such as laz. Default: as the input, or ply."),
    ] = None,
    columns: ColumnsOption = None,
    levels: LevelsOption = None,
    colorize: ColorizeOption = False,
    boxes: Annotated[
        bool, typer.Option("--boxes", help="Also print each object with its oriented box, as JSON.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one line of JSON for each cloud in place of the table.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace outputs that exist.")] = False,
    voxel_size: Annotated[
        float | None,
        typer.Option(help="Voxel edge in metres. Default: 3.5 x the median spacing of the points."),
    ] = None,
    seed_size: Annotated[
        float | None,
        typer.Option(
            help="Spacing of supervoxels in metres. Default: 5 x the voxel edge, down to 3 x where that leaves few."
        ),
    ] = None,
    supervoxels: Annotated[
        int | None, typer.Option(help="About how many supervoxels there are, in place of --seed-size.")
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="How supervoxels form: surface-growth keeps to edges within a point, vccs is PCL's, or FILE.py:CLASS."
        ),
    ] = "surface-growth",
    linkage: Annotated[
        str,
        typer.Option(
            help="How the graph becomes a tree: region, convexity, felzenszwalb, lccp, mumford-shah, quasi-flat, ward, "
            "the .json file of a learned one, or FILE.py:CLASS for one of your own (the file is run)."
        ),
    ] = "region",
    objects: Annotated[
        int | None, typer.Option(help="Exact number of segments. Default: as many as --altitude leaves.")
    ] = None,
    altitude: Annotated[
        float | None,
        typer.Option(help="Altitude of the cut, in the linkage's unit (default: radians). Default: the linkage's."),
    ] = None,
    min_size: Annotated[int, typer.Option(help="Points that every segment has at least.")] = 1,
    range_growth: Annotated[
        float | None,
        typer.Option(
            help="Power of the range with which voxels grow, from 0 to below 1. Default: 0.5 for what looks like one "
            "scan, else 0."
        ),
    ] = None,
    camera: Annotated[
        bool | None,
        typer.Option(
            "--camera/--no-camera",
            help="Whether voxels grow in proportion to depth. Default: where a camera took the cloud.",
        ),
    ] = None,
    color: Annotated[bool, typer.Option("--color/--no-color", help="Let colour shape the supervoxels.")] = True,
    features: Annotated[
        list[str] | None,
        typer.Option(help="A further column of the file that shapes the supervoxels, such as intensity; any number."),
    ] = None,
    viewpoint: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Sensor position x y z in metres. Default: the file's, else found from the cloud."),
    ] = None,
) -> None:
    """Segment point clouds into objects, and write labels, supervoxels, graph and tree.

    For scan.laz it writes two files. scan.segments.laz is the cloud with all its columns and the columns object, part
    and supervoxel. scan.segmentation.npz is for `pcgraph view`, `pcgraph cut` and load_segmentation.
    With --out FILE it writes that file only: the segmentation if it ends in .npz, else the labelled cloud.
    If one of several clouds cannot be read or segmented, the others are still done, and the exit status is 1.

    Examples:

      pcgraph segment scan.laz --levels 10,50,200

      pcgraph segment *.ply --out results/ --json --boxes

      cat scan.pcd | pcgraph segment - --from pcd --out - --to ply > segments.ply
    """
    with refusals():
        from pcgraph.io import encode_cloud
        from pcgraph.labelling import labelled_cloud

        piped = out is not None and str(out) == PIPE
        if piped and (len(clouds) > 1 or to_format is None or as_json or boxes):
            raise ValueError(
                "expected one cloud, --to and neither --json nor --boxes with --out -, as stdout takes one file"
            )
        if out is not None and not piped and out.suffix and not out.is_dir() and len(clouds) > 1:
            raise ValueError(f"expected --out as a folder for {len(clouds)} clouds, got {str(out)!r}")
        if objects is not None and altitude is not None:
            raise ValueError("expected --objects or --altitude, got both: choose one")
        if seed_size is not None and supervoxels is not None:
            raise ValueError("expected --seed-size or --supervoxels, got both: choose one")
        cuts = numbers(levels, "--levels")
        suffix = None if to_format is None else f".{to_format.lstrip('.')}"
        targets = {name: [] if piped else output_paths(name, out, suffix) for name in clouds}
        check_outputs([path for paths in targets.values() for path in paths], clouds, overwrite)
        settings = {
            "viewpoint": viewpoint,
            "features": features or None,
            "voxel_size": voxel_size,
            "seed_size": seed_size,
            "n_supervoxels": supervoxels,
            "camera": camera,
            "range_growth": range_growth,
            "method": member("SupervoxelMethod", method),
            "linkage": _linkage(linkage),
            "object_altitude": altitude,
        }
    failed = False
    for number, name in enumerate(clouds, start=1):
        if len(clouds) > 1:
            typer.echo(f"pcgraph: {number} of {len(clouds)}: {one_line(name)}", err=True)
        start = time.perf_counter()
        try:
            cloud = read_input(name, from_format, columns)
            result = segmented(name, cloud if color else replace(cloud, colors=None), **settings)
            if objects is not None or min_size != 1:
                level = None if objects is not None else result.object_altitude
                result = result.with_objects(objects, level, min_size)
            check_outputs(targets[name], clouds, overwrite)  # again, as files may have appeared
            write_results(targets[name], cloud, result, cuts, colorize, overwrite)
            content = encode_cloud(labelled_cloud(cloud, result, cuts, colorize), f"stdout{suffix}") if piped else None
            record = _summary(name, cloud, result, targets[name], time.perf_counter() - start)
            if boxes:
                record["boxes"] = object_records(cloud, result)
        except (PcgraphError, ValueError, MemoryError, OSError) as error:
            typer.echo(f"pcgraph: {sentence(error)}", err=True)
            failed = True
            continue
        if content is None:
            _print(record, as_json)
        else:
            sys.stdout.buffer.write(content)
    if failed:
        raise typer.Exit(1)


def _linkage(name: str) -> Linkage:
    if not name.lower().endswith(".json"):
        return member("Linkage", name)
    from pcgraph.tree.learned import LearnedLinkage

    return LearnedLinkage.load(name)


def _summary(name: str, cloud: Cloud, result: Segmentation, written: list[Path], seconds: float) -> dict[str, Any]:
    """Summary of the segmentation of one cloud, as plain values for JSON."""
    return {
        "cloud": name,
        "points": math.prod(cloud.points.shape[:-1]),
        **result.summary(),
        "seconds": round(seconds, 3),
        "written": [str(path) for path in written],
    }


def _print(record: dict[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(record, allow_nan=False))
        return
    print_result(record, record["points"])
    print_row("seconds", f"{record['seconds']:.2f}")
    for path in record["written"]:
        print_row("written", one_line(path))
    for box in record.get("boxes", []):
        print_row("box", json.dumps(box, allow_nan=False))
