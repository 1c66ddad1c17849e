# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim report`, which writes the page of a result again from its files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rangesim.cli.own_sensors import OwnSensors, load_own_sensors
from rangesim.errors import one_line


def report_command(
    result: Annotated[
        Path, typer.Argument(help="A directory that `rangesim run` or `rangesim scan` wrote.", show_default=False)
    ],
    sensor: OwnSensors = None,
) -> None:
    """Write report.html again from the files of a result or of a scan.

    Example:

      rangesim report out/tabletop
    """
    from rangesim.files.atomic_directories import replace_listed_file
    from rangesim.report import render_report
    from rangesim.report.scan_page import render_scan_page
    from rangesim.results.experiment_results import RESULT, load_result, read_settings
    from rangesim.results.scan_results import SCAN, load_scan

    load_own_sensors(sensor)
    if (result / SCAN.sidecar).is_file():
        kind, render = SCAN, lambda: render_scan_page(load_scan(result))
    else:
        read_settings(result)  # a clear error if the directory holds no result
        kind, render = RESULT, lambda: render_report(load_result(result))
    replace_listed_file(result, "report.html", lambda: render().encode(), kind)
    typer.echo(one_line(result / "report.html"))
