# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim dataset`: makes data sets of random scenes, checks, shows and exports them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from rangesim.cli.progress import HOW_TO_RETRY, progress_bar

StoreArgument = Annotated[Path, typer.Argument(help="Directory of the data set.", show_default=False)]


class _MakeByDefault(TyperGroup):
    """The group of subcommands; `rangesim dataset SPEC.toml` is short for `rangesim dataset make SPEC.toml`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return list(super().parse_args(ctx, ["make", *args] if args and args[0].lower().endswith(".toml") else args))


app = typer.Typer(
    cls=_MakeByDefault,
    no_args_is_help=True,
    help="Make data sets of random scenes that train a network; check, show and export them.",
)


@app.command("make")
def make_command(
    spec: Annotated[Path, typer.Argument(help="Specification of the scenes (.toml).", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Directory of the data set. A begun one goes on.", show_default=False)
    ],
    workers: Annotated[
        int | None, typer.Option(help="Worker processes on this machine. (default: one for each core)")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler whose workers do the work, tcp://HOST:8786.")
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Compute scenes again that failed in an earlier run.")] = False,
) -> None:
    """Draw and measure all scenes of a specification, and write them to a directory.

    Scenes that fail are listed in the index with their error; the exit status is then 1. The same command with --retry
    computes them again.

    Examples:

      rangesim dataset bins.toml --out out/bins

      rangesim dataset make bins.toml --out out/bins --scheduler tcp://10.0.0.1:8786
    """
    from rangesim.campaign import Workers
    from rangesim.dataset import load_spec, make_dataset

    with progress_bar(is_campaign=True) as progress:
        outcome = make_dataset(load_spec(spec), out, Workers(workers, scheduler), progress, retry)
    typer.echo(outcome)
    if outcome.quarantined:
        typer.echo(HOW_TO_RETRY, err=True)
    raise typer.Exit(outcome.exit_status)


@app.command("verify")
def verify_command(store: StoreArgument) -> None:
    """Check all files of a data set, the bounds of all arrays, and the masks against the poses.

    The exit status is 1 if something is broken.
    """
    from rangesim.dataset import verify_dataset

    with progress_bar() as progress:
        findings = verify_dataset(store, progress)
    typer.echo(findings)
    raise typer.Exit(1 if findings.problems else 0)


@app.command("show")
def show_command(
    store: StoreArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="HTML file.", show_default=False)],
    scenes: Annotated[int, typer.Option(help="Largest number of scenes to show.", min=1)] = 24,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a page that exists.")] = False,
) -> None:
    """Write a contact sheet: one HTML page with pictures, depth, masks and causes of scenes, and a filter by category.

    Examples:

      rangesim dataset show out/bins --out bins.html
    """
    from pcgraph.plumbing.plain_files import write_file
    from rangesim.dataset.contact_sheet import contact_sheet
    from rangesim.errors import FileFormatError, one_line

    if out.exists() and not overwrite:
        raise FileFormatError(f"{out} exists: add --overwrite, or choose another --out.")
    write_file(out, contact_sheet(store, scenes).encode(), FileFormatError)
    typer.echo(one_line(out))


@app.command("export")
def export_command(
    store: StoreArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="New directory.", show_default=False)],
    form: Annotated[str, typer.Option("--format", help="bop or coco.", show_default=False)],
    sensor: Annotated[
        list[str] | None, typer.Option("--sensor", "-s", help="Only this sensor; may be repeated. (default: all)")
    ] = None,
) -> None:
    """Write a data set in the format of BOP (poses, masks, depth) or of COCO (masks as run lengths).

    Examples:

      rangesim dataset export out/bins --format bop --out out/bop
    """
    from rangesim.dataset import export_bop, export_coco

    formats = {"bop": export_bop, "coco": export_coco}
    if form not in formats:
        raise typer.BadParameter(f"expected {' or '.join(formats)}, got {form!r}.", param_hint="--format")
    with progress_bar() as progress:
        images = formats[form](store, out, sensor, progress)
    typer.echo(f"{images} images written to {out}")
