# SPDX-License-Identifier: Apache-2.0
"""The commands `rangesim compare`, `report` and `verify`, which read results that are already on the disk."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rangesim.errors import one_line

if TYPE_CHECKING:
    from rangesim.report.markdown_table import Table


def compare_command(
    results: Annotated[list[Path], typer.Argument(help="Directories that `rangesim run` wrote.", show_default=False)],
    markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown instead of a drawn table.")] = False,
) -> None:
    """Print the errors per material and sensor, and why pixels failed. Lengths are in mm, fractions in %.

    Example:

      rangesim compare out/tabletop out/matte
    """
    from rangesim.report.tables import comparison_markdown, comparison_tables
    from rangesim.results.run_files import read_rows, read_settings

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


def report_command(
    result: Annotated[Path, typer.Argument(help="A directory that `rangesim run` wrote.", show_default=False)],
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            help="A sensor of your own that the result contains, as FILE.py:NAME. The file is run. Repeat the option "
            "for several sensors.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write report.html again from the files of a result.

    Example:

      rangesim report out/tabletop
    """
    from rangesim.files.result_directories import replace_listed_file
    from rangesim.report import render_report
    from rangesim.results.run_files import RESULT, load_result, read_settings
    from rangesim.sensors import sensor_of

    for name in sensor or ():
        sensor_of(name)  # from then on the sensor's class is known by its type_name
    read_settings(result)  # a clear error if the directory holds no result
    replace_listed_file(result, "report.html", lambda: render_report(load_result(result)).encode(), RESULT)
    typer.echo(one_line(result / "report.html"))


def verify_command(
    directory: Annotated[
        Path,
        typer.Argument(help="A directory that rangesim wrote: a result, a scan, a capture, or a decoded capture."),
    ],
) -> None:
    """Compare the size and SHA-256 of every file in a directory with its manifest.

    Ends with status 1 if a file is missing or was changed. Files that are not rangesim's are listed and change nothing.

    Example:

      rangesim verify out/tabletop
    """
    from rangesim.errors import FileFormatError
    from rangesim.files.result_directories import verify_directory
    from rangesim.results.capture_files import CAPTURE
    from rangesim.results.decoded_files import DECODED
    from rangesim.results.run_files import RESULT
    from rangesim.results.scan_files import SCAN

    kinds = (RESULT, SCAN, CAPTURE, DECODED)
    kind = next((k for k in kinds if (directory / k.sidecar).is_file()), None)
    if kind is None:
        raise FileFormatError(
            f"expected a directory that rangesim wrote, with {', '.join(k.sidecar for k in kinds[:-1])} or "
            f"{kinds[-1].sidecar}; {directory} has none of them."
        )
    found = verify_directory(directory, kind)
    for word, names in (("missing", found.missing), ("changed", found.changed), ("not rangesim's", found.foreign)):
        for name in names:
            typer.echo(f"{word}: {one_line(directory / name)}")
    if found.missing or found.changed:
        raise FileFormatError(
            f"{directory}: of {found.files} files {len(found.missing)} are missing and {len(found.changed)} were "
            "changed."
        )
    typer.echo(f"{one_line(directory)}: all {found.files} files are as they were written.")


def _print(table: Table) -> None:
    """Draw a table on the terminal. A cell of the first column stays empty if it repeats the cell above."""
    from rich import box, console
    from rich import table as drawn
    from rich.text import Text

    from rangesim.report.markdown_table import on_one_line

    drawing = drawn.Table(box=box.SIMPLE_HEAD)
    for i, head in enumerate(table.heads):
        is_text = i < 2 or head.startswith("because")
        drawing.add_column(head, justify="left" if is_text else "right", overflow="fold")
    for before, row in zip([table.heads, *table.rows], table.rows, strict=False):
        cells = ("" if row[0] == before[0] else row[0], *row[1:])
        drawing.add_row(*(Text(on_one_line(cell)) for cell in cells))  # Text, because brackets in names are no markup
    screen = console.Console()
    (screen if screen.is_terminal else console.Console(width=140)).print(drawing)
