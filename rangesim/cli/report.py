# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim report`, which writes the page of a result again from its files, or prints it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from rangesim.cli.own_sensors import OwnSensors, load_own_sensors
from rangesim.environment.doctor import find_browser
from rangesim.errors import EnvironmentProblem, RangesimError, one_line


class Paper(StrEnum):
    """Sizes of paper, as CSS names them."""

    A4 = "A4"
    LETTER = "letter"


def report_command(
    result: Annotated[
        Path, typer.Argument(help="A directory that `rangesim run` or `rangesim scan` wrote.", show_default=False)
    ],
    pdf: Annotated[
        Path | None,
        typer.Option("--pdf", help="Also print the page to this file: two pages.", show_default=False),
    ] = None,
    paper: Annotated[Paper, typer.Option(case_sensitive=False, help="Size of the paper.")] = Paper.A4,
    browser: Annotated[
        str | None,
        typer.Option(
            help="Chromium, Chrome or Edge, by path or name, that prints. (default: the first one found)",
            show_default=False,
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a PDF that exists.")] = False,
    sensor: OwnSensors = None,
) -> None:
    """Write report.html again from the files of a result or of a scan, and print it if asked.

    Examples:

      rangesim report out/tabletop

      rangesim report out/tabletop --pdf tabletop.pdf
    """
    from pcgraph.plumbing.plain_files import write_file
    from rangesim.files.atomic_directories import replace_listed_file
    from rangesim.report import render_report
    from rangesim.report.printing import pdf_of
    from rangesim.report.scan_page import render_scan_page
    from rangesim.results.experiment_results import RESULT, load_result, read_settings
    from rangesim.results.scan_results import SCAN, load_scan

    load_own_sensors(sensor)
    if pdf is not None and pdf.exists() and not (overwrite and pdf.is_file()):
        raise RangesimError(f"{pdf} exists: add --overwrite, or choose another --pdf.")
    if (result / SCAN.sidecar).is_file():
        kind, render = SCAN, lambda paper: render_scan_page(load_scan(result), paper)
    else:
        read_settings(result)  # a clear error if the directory holds no result
        kind, render = RESULT, lambda paper: render_report(load_result(result), paper)
    page = result / "report.html"
    replace_listed_file(result, page.name, lambda: render("").encode(), kind)
    typer.echo(one_line(page))
    if pdf is not None:
        printer = browser or find_browser()
        by_hand = f"print {one_line(page)} from any browser: it has the same two pages"
        if printer is None:
            raise EnvironmentProblem(
                f"found no Chromium, Chrome or Edge that prints: name one by --browser, or {by_hand}."
            )
        try:
            printed = pdf_of(render(paper.value), printer)
        except EnvironmentProblem as problem:
            raise EnvironmentProblem(f"{problem}; name another one by --browser, or {by_hand}.") from problem
        write_file(pdf, printed, RangesimError)
        typer.echo(one_line(pdf))
