# SPDX-License-Identifier: Apache-2.0
"""`rangesim compare` and `rangesim report`: results that are there already."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def compare_command(
    results: Annotated[list[Path], typer.Argument(help="Directories that `rangesim run` wrote.", show_default=False)],
    markdown: Annotated[bool, typer.Option("--markdown", help="Markdown instead of a drawn table.")] = False,
) -> None:
    """Print errors per surface material and sensor, and why pixels failed; lengths in mm, shares in %.

    Example:

      rangesim compare out/tabletop out/matte
    """
    from rangesim.report.tables import markdown as in_markdown
    from rangesim.result_files import read_rows, read_settings

    tables = []
    for folder in results:
        for entry in read_settings(folder)["instruments"]:
            name = entry["name"] if len(results) == 1 else f"{folder}: {entry['name']}"
            tables.append((name, read_rows(folder / entry["name"])))
    if markdown:
        typer.echo(in_markdown(tables), nl=False)
    else:
        for table in in_markdown(tables).split("\n\n"):
            _print(table)


def report_command(
    result: Annotated[Path, typer.Argument(help="A directory that `rangesim run` wrote.", show_default=False)],
) -> None:
    """Write report.html anew from the files of a result.

    Example:

      rangesim report out/tabletop
    """
    from pcgraph.output import replace_listed_file
    from rangesim.report import render_report
    from rangesim.result_files import RESULT, load_result

    page = render_report(load_result(result))
    replace_listed_file(result, "report.html", page.encode(), RESULT)
    typer.echo(f"{result / 'report.html'}")


def _print(markdown: str) -> None:
    """Draw a Markdown table."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from rangesim.report.tables import cells

    head, _, *lines = (cells(line) for line in markdown.splitlines())
    table = Table(box=box.SIMPLE_HEAD)
    for i, name in enumerate(head):
        words = i < 2 or name.startswith("because")
        table.add_column(name, justify="left" if words else "right", overflow="fold")
    for before, line in zip([head, *lines], lines, strict=False):
        table.add_row(*map(Text, ("" if line[0] == before[0] else line[0], *line[1:])))  # brackets are no markup
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)
    console.print(table)
