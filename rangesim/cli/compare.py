# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim compare`, which prints tables of results that are already on the disk."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rangesim.report.markdown_table import Table


def compare_command(
    results: Annotated[list[Path], typer.Argument(help="Directories that `rangesim run` wrote.", show_default=False)],
    markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown instead of a drawn table.")] = False,
) -> None:
    """Print what is right, wrong and missing per material and sensor, and why. Lengths are in mm, fractions in %.

    Example:

      rangesim compare out/tabletop out/matte
    """
    from rangesim.report.tables import comparison_markdown, comparison_tables
    from rangesim.results.experiment_results import read_rows, read_settings

    tables = []
    for folder in results:
        for entry in read_settings(folder).instruments:
            name = entry.name if len(results) == 1 else f"{folder}: {entry.name}"
            tables.append((name, read_rows(folder / entry.name)))
    if markdown:
        typer.echo(comparison_markdown(tables), nl=False)
    else:
        for table in comparison_tables(tables):
            _print(table)


def _print(table: Table) -> None:
    """Draw a table on the terminal. A cell of the first column stays empty if it repeats the cell above."""
    from rich import box, console
    from rich import table as drawn
    from rich.text import Text

    from rangesim.report.markdown_table import on_one_line

    drawing = drawn.Table(box=box.SIMPLE_HEAD)
    for i, head in enumerate(table.heads):
        is_text = i < 2 or "because" in head
        drawing.add_column(head, justify="left" if is_text else "right", overflow="fold")
    for before, row in zip([table.heads, *table.rows], table.rows, strict=False):
        cells = ("" if row[0] == before[0] else row[0], *row[1:])
        drawing.add_row(*(Text(on_one_line(cell)) for cell in cells))  # Text, because brackets in names are no markup
    screen = console.Console()
    (screen if screen.is_terminal else console.Console(width=140)).print(drawing)
