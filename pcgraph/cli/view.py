# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph view``."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pcgraph.cli.clouds import PIPE, SAVED, check_outputs, is_saved, read_saved, refusals, segmented
from pcgraph.errors import CloudReadError, CloudWriteError, one_line

if TYPE_CHECKING:
    from pcgraph.viewer.cloud_data import Shown


def view_command(
    source: Annotated[
        Path, typer.Argument(help="A point cloud, a segmentation saved with its cloud (.npz), or a folder of these.")
    ],
    out: Annotated[Path | None, typer.Option(help="The page's file. Default: NAME.html in the current folder.")] = None,
    segment: Annotated[bool, typer.Option("--segment", help="Segment clouds that have no segmentation first.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a page that exists.")] = False,
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Write one HTML page that shows a cloud in a browser, also without a network.

    For a folder it writes one page with a menu of the folder's files.

    Example: pcgraph view scan.segmentation.npz --open
    """
    from pcgraph.plumbing.plain_files import write_file
    from pcgraph.viewer.page import views_page

    with refusals():
        name = Path(source.absolute().name.removesuffix(SAVED)).stem
        target = Path(f"{name}.html") if out is None else out
        if str(target) == PIPE:
            raise ValueError("expected --out as the name of a file, got '-'")
        check_outputs([target], [str(source)], overwrite)
        shown = [_shown(path, segment) for path in _files(source)]
        page = views_page(shown, source.absolute().name).encode("utf-8")
        write_file(target, page, CloudWriteError, overwrite=overwrite)
    typer.echo(f"{'clouds':<12} {len(shown)}")
    typer.echo(f"{'written':<12} {one_line(target)}, {target.stat().st_size / 1e6:.1f} MB")
    if open_page:
        webbrowser.open(target.resolve().as_uri())


def _files(source: Path) -> list[Path]:
    """The file itself, or the clouds of a folder in the order of their names."""
    from pcgraph.io import FORMATS

    if not source.is_dir():
        return [source]
    ends = tuple(suffix for one in FORMATS for suffix in one.suffixes)
    found = sorted(path for path in source.iterdir() if path.is_file() and path.name.lower().endswith(ends))
    if not found:
        raise CloudReadError(f"the folder {source} has no point cloud: expected files ending in {', '.join(ends)}")
    return found


def _shown(path: Path, segment: bool) -> Shown:
    from pcgraph.io import read_cloud
    from pcgraph.viewer.cloud_data import Shown

    if is_saved(path):
        return Shown.of(path.name, *read_saved(path))
    cloud = read_cloud(path)
    return Shown.of(path.name, cloud, segmented(str(path), cloud) if segment else None)
