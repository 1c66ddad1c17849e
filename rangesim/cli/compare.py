# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim compare`, which prints tables of results that are already on the disk."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rangesim.cli.lengths import length

if TYPE_CHECKING:
    from rangesim.report.markdown_table import Table
    from rangesim.report.tables import Rows


def compare_command(
    results: Annotated[list[Path], typer.Argument(help="Directories that `rangesim run` wrote.", show_default=False)],
    markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown instead of a drawn table.")] = False,
    tolerance: Annotated[
        float | None,
        typer.Option(
            parser=length,
            metavar="LENGTH",
            help="Largest error of a right reading: metres, or with a unit, as 2mm. With another one than that of the "
            "run, no causes are printed. (default: that of the run)",
        ),
    ] = None,
) -> None:
    """Print what each sensor reads right, wrong and not at all, per object and material, why, and the exposures.

    Lengths are in mm, fractions in %.

    Examples:

      rangesim compare out/tabletop out/matte

      rangesim compare out/tabletop --tolerance 2mm
    """
    from rangesim.report.tables import (
        automatic_exposures,
        comparison_markdown,
        comparison_tables,
        invented_readings,
        tolerance_line,
    )
    from rangesim.results.experiment_results import read_acquisition, read_comparison, read_settings

    found = {
        (folder, entry.name): read_comparison(folder / entry.name)
        for folder in dict.fromkeys(results)
        for entry in read_settings(folder).instruments
    }
    stored = {record.tolerance_m: folder for (folder, _), record in found.items()}
    if tolerance is None and len(stored) > 1:
        of_each = " and ".join(f"{1e3 * each:g} mm ({folder})" for each, folder in stored.items())
        raise ValueError(f"expected results of one tolerance, got {of_each}; state one by --tolerance.")
    tolerance_m = tolerance if tolerance is not None else next(iter(stored))
    is_new = set(stored) != {tolerance_m}
    rows = _compared_again(results, tolerance_m) if is_new else {key: r.plain_rows() for key, r in found.items()}
    tables = [(name if len(results) == 1 else f"{folder}: {name}", rows[folder, name]) for folder, name in found]
    taken = [read_acquisition(folder / name) for folder, name in found]
    if markdown:
        typer.echo(comparison_markdown(tables, taken, tolerance_m), nl=False)
    else:
        typer.echo(tolerance_line(tolerance_m))
        for table in comparison_tables(tables, taken):
            _print(table)
    names = [name for name, _ in tables]
    if said := invented_readings(dict(tables)):
        typer.echo(f"rangesim: invented readings {said}", err=True)
    if said := automatic_exposures(dict(zip(names, taken, strict=True))):
        typer.echo(f"rangesim: the exposure {said}", err=True)


def _compared_again(results: list[Path], tolerance_m: float) -> dict[tuple[Path, str], Rows]:
    """Rows of each instrument of the results, by directory and name, for another tolerance; the causes are None."""
    from rangesim.evaluation.comparison import compare
    from rangesim.results.experiment_results import load_result

    found = {}
    for folder in results:
        for m in load_result(folder).measurements:
            again = compare(m.image, m.truth, tolerance_m).rows()
            found[folder, m.name] = [old | new | {"causes": None} for old, new in zip(m.rows, again, strict=True)]
    return found


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
