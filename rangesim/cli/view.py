# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim view`, which shows the clouds of a result in an interactive page."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from rangesim.cli.own_sensors import OwnSensors, load_own_sensors
from rangesim.errors import RangesimError, one_line


def view_command(
    result: Annotated[
        Path, typer.Argument(help="A directory that `rangesim run` or `rangesim scan` wrote.", show_default=False)
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The page's file. (default: NAME.html in the current directory)"),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a page that exists.")] = False,
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    sensor: OwnSensors = None,
) -> None:
    """Write one HTML page with the clouds of a result or of a scan, which opens without a network.

    Points are coloured by error, cause, status, material or any level of their segmentation.

    Example:

      rangesim view out/tabletop --open
    """
    from pcgraph.plumbing.plain_files import write_file
    from rangesim.report.clouds_page import render_clouds_page, render_scan_clouds_page
    from rangesim.results.experiment_results import load_result, read_settings
    from rangesim.results.scan_results import SCAN, load_scan

    load_own_sensors(sensor)
    target = Path(f"{result.absolute().name}.html") if out is None else out
    if target.exists() and not (overwrite and target.is_file()):
        raise RangesimError(f"{target} exists: add --overwrite, or choose another --out.")
    if (result / SCAN.sidecar).is_file():
        page = render_scan_clouds_page(load_scan(result), one_line(result.absolute().name))
    else:
        read_settings(result)  # a clear error if the directory holds no result
        page = render_clouds_page(load_result(result))
    write_file(target, page.encode(), RangesimError)
    typer.echo(one_line(target))
    if open_page:
        webbrowser.open(target.resolve().as_uri())
