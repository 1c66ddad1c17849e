# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph segment``."""

from __future__ import annotations

import os
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcgraph.errors import CloudReadError, CloudWriteError, PcgraphError, one_line, without_long_words
from pcgraph.families import member
from pcgraph.plumbing.plain_files import said

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pcgraph.cloud import Cloud
    from pcgraph.segmentation import Segmentation
    from pcgraph.tree.linkage import Linkage


def segment_command(
    cloud: Annotated[Path, typer.Argument(help="Point cloud in any format that is read, coordinates in metres.")],
    out: Annotated[
        Path | None,
        typer.Option(help="A file of any format that is written, or a folder. Default: the current folder."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an output that exists.")] = False,
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
    """Segment a point cloud into objects, and write it with its objects, parts and supervoxels.

    Writes NAME.segments.ply: the cloud with all its columns, and the columns object, part and supervoxel.

    Example: pcgraph segment scan.pcd --out results/ --voxel-size 0.005 --seed-size 0.03
    """
    from pcgraph.io import encode_cloud, read_cloud
    from pcgraph.labelling import labelled_cloud
    from pcgraph.plumbing.plain_files import write_file

    start = time.perf_counter()
    try:
        target = _target(cloud, out, overwrite)
        if objects is not None and altitude is not None:
            raise ValueError("expected --objects or --altitude, got both: choose one")
        if seed_size is not None and supervoxels is not None:
            raise ValueError("expected --seed-size or --supervoxels, got both: choose one")
        read = read_cloud(cloud)
        result = _segmented(
            cloud,
            read if color else replace(read, colors=None),
            viewpoint=viewpoint,
            features=features or None,
            voxel_size=voxel_size,
            seed_size=seed_size,
            n_supervoxels=supervoxels,
            camera=camera,
            range_growth=range_growth,
            method=member("SupervoxelMethod", method),
            linkage=_linkage(linkage),
            object_altitude=altitude,
        )
        level = result.object_altitude if objects is None else None
        labels = result.labels if level is not None and min_size == 1 else result.cut(objects, level, min_size)
        _check_target(target, overwrite)  # again, as a file may have appeared during the segmentation
        content = encode_cloud(labelled_cloud(read, replace(result, labels=labels)), target.name)
        write_file(target, content, CloudWriteError, make_parents=True)
    except (PcgraphError, ValueError, MemoryError, OSError) as error:
        message = said(error) if isinstance(error, OSError) else str(error)
        message = without_long_words(message) or "the cloud does not fit into memory: choose a larger voxel size"
        typer.echo(f"pcgraph: {one_line(message).rstrip('.')}.", err=True)
        raise typer.Exit(1) from None
    _print_summary(result, labels, target, time.perf_counter() - start)


def _target(cloud: Path, out: Path | None, overwrite: bool) -> Path:
    from pcgraph.io import check_writable

    if out is not None and str(out) == "-":
        raise CloudWriteError("nothing is written to a pipe, got --out -: give a file or a folder")
    if out is not None and out.suffix and not out.is_dir():
        check_writable(out.name)
        if not out.parent.is_dir():
            raise CloudWriteError(f"cannot write {out}: there is no folder {out.parent}; create it first")
        target = out
    else:
        target = (Path() if out is None else out) / f"{cloud.stem}.segments.ply"
    if os.path.realpath(target) == os.path.realpath(cloud):
        raise CloudWriteError(f"--out is the input itself, {target}: choose another name")
    _check_target(target, overwrite)
    return target


def _check_target(target: Path, overwrite: bool) -> None:
    """Raise CloudWriteError if a file is in the target's place, or if it cannot be written; this writes nothing."""
    if target.is_symlink() and not target.exists():
        raise CloudWriteError(f"{target} is a link to a file that does not exist; choose another --out")
    if target.exists() and not (overwrite and target.is_file()):
        raise CloudWriteError(f"{target} exists; choose another --out, or replace it with --overwrite")
    above = next(folder for folder in (target.parent, *target.absolute().parents) if folder.exists())
    if not above.is_dir():
        raise CloudWriteError(f"cannot create the folder {target.parent}: {above} is a file; choose another --out")
    if not os.access(above, os.W_OK | os.X_OK):
        raise CloudWriteError(f"cannot write to {above}: permission denied; choose another --out")


def _linkage(name: str) -> Linkage:
    if not name.lower().endswith(".json"):
        return member("Linkage", name)
    from pcgraph.tree.learned import LearnedLinkage

    return LearnedLinkage.load(name)


def _segmented(path: Path, cloud: Cloud, **settings: Any) -> Segmentation:
    from pcgraph import scan
    from pcgraph.plausibility import CloudWarning

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = scan.segment(cloud, **settings)
        except ValueError as error:
            raise CloudReadError(f"cannot segment {path}: {error}") from None
    for warning in caught:
        if issubclass(warning.category, CloudWarning):
            typer.echo(f"pcgraph: warning: {one_line(warning.message)}.", err=True)
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    return result


def _print_summary(result: Segmentation, labels: NDArray[np.int32], target: Path, seconds: float) -> None:
    segmented, outliers = int((result.supervoxels >= 0).sum()), int(result.outliers.sum())
    for name, value in (
        ("points", f"{segmented} of {result.labels.size} segmented, {outliers} outliers"),
        ("acquisition", result.acquisition.in_words),
        ("voxel size", f"{result.voxel_size:.3g} m" + (" at the median depth" if result.camera else "")),
        ("seed size", f"{result.seed_size:.3g} m"),
        ("supervoxels", str(result.graph.n_nodes)),
        ("edges", str(len(result.graph.edges))),
        ("objects", str(int(labels.max()) + 1)),
        ("seconds", f"{seconds:.2f}"),
        ("written", one_line(target)),
    ):
        typer.echo(f"{name:<12} {value}")
