# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph``."""

from __future__ import annotations

import os
import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError, CloudWriteError, PcgraphError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pcgraph.segmentation import Segmentation

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


class Method(StrEnum):
    """Methods of supervoxels by name."""

    SURFACE = "surface"
    VCCS = "vccs"


@app.callback()
def _pcgraph() -> None:
    """Point clouds as supervoxels, an adjacency graph and a segmentation tree."""


@app.command()
def segment(
    cloud: Annotated[Path, typer.Argument(help="Point cloud, .pcd or .ply, coordinates in metres.")],
    out: Annotated[
        Path | None,
        typer.Option(help="A .ply or .npz file, or a folder for both. Default: the current folder."),
    ] = None,
    voxel_size: Annotated[
        float | None,
        typer.Option(help="Voxel edge in metres. Default: 3.5 x the median spacing of the points."),
    ] = None,
    seed_size: Annotated[
        float | None, typer.Option(help="Distance of supervoxels in metres. Default: 6 x the voxel edge.")
    ] = None,
    objects: Annotated[
        int | None, typer.Option(help="Exact number of segments. Default: as many as concavity calls for.")
    ] = None,
    method: Annotated[
        Method, typer.Option(help="How supervoxels form: 'surface' keeps to edges within a point, 'vccs' is PCL's.")
    ] = Method.SURFACE,
    range_growth: Annotated[
        float,
        typer.Option(help="Power of the range with which voxels grow, 0 to 1; 0.5 suits scanners. Default: 0."),
    ] = 0.0,
    color: Annotated[bool, typer.Option("--color/--no-color", help="Let colour shape the supervoxels.")] = True,
    viewpoint: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Sensor position x y z in metres. Default: the file's, else a guess from the cloud."),
    ] = None,
) -> None:
    """Segment a point cloud into objects, and write labels, supervoxels, graph and tree.

    Writes NAME.segments.ply (points coloured by object, with labels and supervoxels) and NAME.segments.npz
    (labels in the input's shape, graph and tree).

    Example: pcgraph segment scan.pcd --out results/ --voxel-size 0.005 --seed-size 0.03
    """
    start = time.perf_counter()
    try:
        targets = _targets(cloud, out)
        sizes = {"voxel_size": voxel_size, "seed_size": seed_size, "range_growth": range_growth}
        read, result = _segmentation(cloud, method, color, viewpoint, sizes)
        labels = result.labels if objects is None else result.cut(n=objects)
        _write(targets, read, result, labels)
    except (PcgraphError, ValueError, MemoryError) as error:
        message = " ".join(str(error).split()) or "the cloud does not fit into memory: choose a larger voxel size"
        typer.echo(f"pcgraph: {message.rstrip('.')}.", err=True)
        raise typer.Exit(1) from None
    _print_summary(result, labels, targets, time.perf_counter() - start)


def main() -> None:
    """Run the command line."""
    app(prog_name="pcgraph")


def _targets(cloud: Path, out: Path | None) -> list[Path]:
    if out is not None and out.suffix and not out.is_dir():
        if out.suffix.lower() not in (".ply", ".npz"):
            raise CloudWriteError(f"expected --out as a .ply or .npz file or a folder, got {out.name!r}")
        if not out.parent.is_dir():
            raise CloudWriteError(f"cannot write {out}: there is no folder {out.parent}; create it first")
        if out.resolve() == cloud.resolve():
            raise CloudWriteError(f"--out is the input itself, {out}: choose another name")
        targets = [out]
    else:
        folder = Path() if out is None else out
        targets = [folder / f"{cloud.stem}.segments{suffix}" for suffix in (".ply", ".npz")]
    _check_targets(targets)
    return targets


def _check_targets(targets: list[Path]) -> None:
    """Refuse to write where a file of the user's is, or where nothing can be written; this writes nothing."""
    from pcgraph.io.write import is_segmentation

    for target in targets:
        if target.is_symlink() and not target.exists():
            raise CloudWriteError(f"{target} is a link to a file that does not exist; choose another --out")
        if target.exists() and not (target.is_file() and is_segmentation(target)):
            raise CloudWriteError(
                f"{target} exists and was not written by pcgraph, or changed since; move it or choose another --out"
            )
    above = next(folder for folder in (targets[0].parent, *targets[0].absolute().parents) if folder.exists())
    if not above.is_dir():
        raise CloudWriteError(f"cannot create the folder {targets[0].parent}: {above} is a file; choose another --out")
    if not os.access(above, os.W_OK | os.X_OK):
        raise CloudWriteError(f"cannot write to {above}: permission denied; choose another --out")


def _segmentation(
    path: Path, method: Method, color: bool, viewpoint: tuple[float, ...] | None, sizes: dict[str, float | None]
) -> tuple[Cloud, Segmentation]:
    from pcgraph.io import read_cloud
    from pcgraph.scan import segment as segment_points
    from pcgraph.supervoxels.surface_growth import SurfaceGrowth
    from pcgraph.supervoxels.vccs import Vccs
    from pcgraph.warmup import must_compile

    cloud = read_cloud(path)
    stored = cloud.viewpoint
    if stored is not None and not stored.any():
        stored = None  # PCD writers put zeros where they know nothing
    position = stored if viewpoint is None else viewpoint
    colors = cloud.colors if color else None
    chosen = SurfaceGrowth() if method is Method.SURFACE else Vccs()
    if must_compile():
        typer.echo("pcgraph: compiling its kernels, which takes ten seconds or so; done once.", err=True)
    try:
        result = segment_points(
            cloud.points,
            colors,
            cloud.normals,
            position,
            method=chosen,
            **sizes,  # type: ignore[arg-type]
        )
    except ValueError as error:
        raise CloudReadError(f"cannot segment {path}: {error}") from None
    return cloud, result


def _write(targets: list[Path], cloud: Cloud, result: Segmentation, labels: NDArray[np.int32]) -> None:
    from pcgraph.io.write import encode_segmentation
    from pcgraph.plain_files import write_files

    contents = {target: encode_segmentation(target.name, cloud, result, labels) for target in targets}
    _check_targets(targets)  # the segmentation took its time
    write_files(contents, CloudWriteError, make_parents=True)


def _print_summary(result: Segmentation, labels: NDArray[np.int32], targets: list[Path], seconds: float) -> None:
    finite = int((result.supervoxels >= 0).sum())
    for name, value in (
        ("points", f"{finite} of {result.labels.size} finite"),
        ("voxel size", f"{result.voxel_size:.3g} m" + (" at the median depth" if result.camera else "")),
        ("seed size", f"{result.seed_size:.3g} m"),
        ("supervoxels", str(result.graph.n_nodes)),
        ("edges", str(len(result.graph.edges))),
        ("objects", str(int(labels.max()) + 1)),
        ("seconds", f"{seconds:.2f}"),
        *(("written", str(target)) for target in targets),
    ):
        typer.echo(f"{name:<12} {value}")
