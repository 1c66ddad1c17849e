# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim sweep`, which measures a grid of settings and writes tables and a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rangesim.cli.progress import HOW_TO_RETRY, progress_bar
from rangesim.errors import one_line


def sweep_command(
    file: Annotated[Path, typer.Argument(help="The sweep (.toml): a scene, sensors, and values of settings.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Directory for tables, page and finished passes. (required)"),
    ] = None,
    estimate: Annotated[
        bool, typer.Option("--estimate", help="Print passes, time and memory, and end. Nothing is written.")
    ] = False,
    workers: Annotated[
        int | None, typer.Option(help="Worker processes on this machine. (default: one for each core)")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler whose workers do the work, tcp://HOST:PORT.")
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Compute passes again that failed in an earlier run.")] = False,
) -> None:
    """Measure sensors at all combinations of settings, and write rows.csv, rows.parquet, summary.csv and sweep.html.

    The same command goes on where an interrupted one ended. A changed file computes only the passes that are new.
    Passes that fail are named at the end; the exit status is then 1. The same command with --retry computes them again.

    Examples:

      rangesim sweep examples/sweep_distance.toml --out out/distance

      rangesim sweep examples/sweep_shiny.toml --estimate
    """
    if out is None and not estimate:
        raise typer.BadParameter("expected --out DIRECTORY, unless --estimate is given.", param_hint="--out")
    from rangesim.campaign import Workers
    from rangesim.sweep import carry_out, load_sweep, plan, write_sweep

    chosen = Workers(workers, scheduler)
    planned = plan(load_sweep(file))
    typer.echo(f"{'' if estimate else 'rangesim: '}{planned}", err=not estimate)
    if estimate or out is None:
        return
    with progress_bar(is_campaign=True) as progress:
        result = carry_out(planned, out, chosen, progress, retry)
    for text in result.warnings:
        typer.echo(f"rangesim: {one_line(text)}", err=True)
    page = write_sweep(result, out)
    typer.echo(one_line(page))
    if result.failed:
        for number, error in result.failed.items():
            typer.echo(f"rangesim: pass {number + 1} failed: {one_line(error)}", err=True)
        typer.echo(HOW_TO_RETRY, err=True)
        raise typer.Exit(1)
