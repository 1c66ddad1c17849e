# SPDX-License-Identifier: Apache-2.0
"""Input and output of the commands: clouds and segmentations in files, folders and pipes."""

from __future__ import annotations

import os
import sys
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pcgraph.errors import CloudReadError, CloudWriteError, PcgraphError, one_line, without_long_words
from pcgraph.plumbing.plain_files import said

if TYPE_CHECKING:
    from pcgraph.cloud import Cloud
    from pcgraph.segmentation import Segmentation

PIPE = "-"
"""Argument that stands for stdin or stdout."""
SAVED = ".segmentation.npz"
"""Suffix of the files of saved segmentations."""

FormatOption = Annotated[
    str | None, typer.Option("--from", help="Format of the input, such as ply. Default: by its name.")
]
ColumnsOption = Annotated[
    str | None, typer.Option(help="Names of the columns of a text without a header: x,y,z,intensity.")
]
LevelsOption = Annotated[
    str | None, typer.Option(help="Numbers of segments, such as 10,50,200: a column level_10 and so on for each.")
]
ColorizeOption = Annotated[
    bool, typer.Option("--colorize", help="Colour the points by object; their own colours go to original_red etc.")
]


def read_input(name: str, file_format: str | None = None, columns: str | None = None) -> Cloud:
    """Cloud of a file, or of stdin if the name is ``-``.

    Parameters
    ----------
    name : str
    file_format : str, optional
        Name of the format. Stdin needs one.
    columns : str, optional
        Names of the columns of a text file without a header, separated by commas.
    """
    from pcgraph.io import decode_cloud, read_cloud

    named = None if columns is None else [column.strip() for column in columns.split(",")]
    if name != PIPE:
        return read_cloud(name, file_format, named)
    if file_format is None:
        raise CloudReadError("expected the format of the cloud on stdin, got none: give it, for example --from ply")
    return decode_cloud(sys.stdin.buffer.read(), f"stdin.{file_format}", named)


def is_saved(path: Path) -> bool:
    """Whether a file is an archive with the tree of a segmentation."""
    return _is_in_archive("tree/parents.npy", path)


def has_cloud(path: Path) -> bool:
    """Whether a saved segmentation holds its cloud, too."""
    return _is_in_archive("cloud/points.npy", path)


def _is_in_archive(name: str, path: Path) -> bool:
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return name in archive.namelist()


def read_saved(path: Path) -> tuple[Cloud, Segmentation]:
    """The cloud and the segmentation in the file of a saved segmentation."""
    from pcgraph.io import read_cloud
    from pcgraph.saved_segmentation import load_segmentation

    result = load_segmentation(path)
    if not has_cloud(path):
        raise CloudReadError(
            f"{path} holds no points, as it was saved without its cloud: save it with save(path, cloud)"
        )
    return read_cloud(path), result


def segmented(name: str, cloud: Cloud, **settings: Any) -> Segmentation:
    """Segmentation of a cloud; warnings go to stderr, one line each, and errors name the cloud."""
    from pcgraph import scan
    from pcgraph.plausibility import CloudWarning

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = scan.segment(cloud, **settings)
        except ValueError as error:
            raise CloudReadError(f"cannot segment {name}: {error}") from None
    for warning in caught:
        if issubclass(warning.category, CloudWarning):
            typer.echo(f"pcgraph: warning: {one_line(warning.message)}.", err=True)
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    return result


def output_paths(name: str, out: Path | None, suffix: str | None) -> list[Path]:
    """Files that a command writes for one input: the labelled cloud and the saved segmentation.

    Parameters
    ----------
    name : str
        Name of the input.
    out : Path, optional
        A file is the only output. A folder gets both files. Default: the current folder.
    suffix : str, optional
        Suffix of the labelled cloud. Default: that of the input if its format holds columns, else ``.ply``.
    """
    from pcgraph.io import check_writable, holds_columns, without_suffix

    if out is not None and out.suffix and not out.is_dir():
        if not out.parent.is_dir():
            raise CloudWriteError(f"cannot write {out}: there is no folder {out.parent}; create it first")
        check_writable(out.name)
        return [out]
    if suffix is None:
        own = Path(name).suffix
        suffix = own if holds_columns(own) and own.lower() != ".npz" else ".ply"
    check_writable(f"cloud{suffix}")
    stem = "stdin" if name == PIPE else without_suffix(Path(name).name)
    folder = Path() if out is None else out
    return [folder / f"{stem}.segments{suffix}", folder / f"{stem}{SAVED}"]


def check_outputs(paths: list[Path], inputs: list[str], overwrite: bool) -> None:
    """Raise CloudWriteError if an output is an input, exists already or cannot be written; nothing is written."""
    given = {os.path.realpath(name) for name in inputs if name != PIPE}
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise CloudWriteError(f"two inputs would be written to {twice}: run the command for each, with its own --out")
    for path in paths:
        if os.path.realpath(path) in given:
            raise CloudWriteError(f"{path} is an input: choose another --out")
        if path.is_symlink() and not path.exists():
            raise CloudWriteError(f"{path} is a link to a file that does not exist; choose another --out")
        if path.exists() and not (overwrite and path.is_file()):
            raise CloudWriteError(f"{path} exists: add --overwrite, or choose another --out")
        above = next(folder for folder in (path.parent, *path.absolute().parents) if folder.exists())
        if not above.is_dir():
            raise CloudWriteError(f"cannot create the folder {path.parent}: {above} is a file; choose another --out")
        if not os.access(above, os.W_OK | os.X_OK):
            raise CloudWriteError(f"cannot write to {above}: permission denied; choose another --out")


def write_results(
    paths: list[Path],
    cloud: Cloud,
    result: Segmentation,
    levels: tuple[int, ...] = (),
    colorize: bool = False,
    overwrite: bool = False,
) -> None:
    """Write all files of a result, or none: saved segmentations (``.npz``) and labelled clouds (other suffixes)."""
    from pcgraph.io import encode_cloud
    from pcgraph.labelling import labelled_cloud
    from pcgraph.plumbing.plain_files import write_files

    contents = {}
    for path in paths:
        is_saved = path.suffix.lower() == ".npz"
        contents[path] = (
            result.to_bytes(cloud)
            if is_saved
            else encode_cloud(labelled_cloud(cloud, result, levels, colorize), path.name)
        )
    write_files(contents, CloudWriteError, make_parents=True, overwrite=overwrite)


def numbers(text: str | None, option: str) -> tuple[int, ...]:
    """Whole numbers of at least 1 from a text in which commas separate them; ValueError for any other text."""
    words = [] if text is None else [word.strip() for word in text.split(",")]
    if not all(word.isascii() and word.isdigit() and int(word) for word in words):
        raise ValueError(f"expected {option} as whole numbers with commas, such as 10,50,200, got {text!r}")
    return tuple(int(word) for word in words)


@contextmanager
def refusals() -> Iterator[None]:
    """Context in which an error of a file or an argument becomes one sentence on stderr and the exit status 1."""
    try:
        yield
    except (PcgraphError, ValueError, MemoryError, OSError) as error:
        typer.echo(f"pcgraph: {sentence(error)}", err=True)
        raise typer.Exit(1) from None


@contextmanager
def warning_lines() -> Iterator[None]:
    """Warnings about files as one line on stderr each, without the place in the code."""
    usual = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if category is UserWarning:
            typer.echo(f"pcgraph: warning: {one_line(message)}.", err=True)
        else:
            usual(message, category, *where, **more)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


def sentence(error: Exception) -> str:
    """Message of an error as one sentence on one line."""
    message = said(error) if isinstance(error, OSError) else str(error)
    message = without_long_words(message) or "the cloud does not fit into memory: choose a larger voxel size"
    return f"{one_line(message).rstrip('.')}."


def print_result(record: dict[str, Any], n_points: int) -> None:
    """Print the rows of a `Segmentation.summary`."""
    print_row("points", f"{record['segmented']} of {n_points} segmented, {record['outliers']} outliers")
    print_row("acquisition", record["acquisition"])
    print_row("voxel size", f"{record['voxel_size']:.3g} m")
    print_row("seed size", f"{record['seed_size']:.3g} m")
    for name in ("supervoxels", "edges", "objects"):
        print_row(name, record[name])


def print_row(name: str, value: object) -> None:
    """Print a row of a table of names and values."""
    typer.echo(f"{name:<12} {value}")


def object_records(cloud: Cloud, result: Segmentation) -> list[dict[str, Any]]:
    """Number, count of points and box of each object as plain values for JSON, with the largest object first."""
    import numpy as np

    from pcgraph.detection.boxes import boxes_of_labels

    counts = np.bincount(result.labels[result.labels >= 0].ravel())
    boxes = boxes_of_labels(cloud.points, result.labels)
    order = sorted(boxes, key=lambda label: (-counts[label], label))
    return [{"object": k, "points": int(counts[k]), "box": boxes[k].to_dict()} for k in order]
