# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim`, with one module for each subcommand or group of them.

Modules that take long to import are imported inside the functions of the commands, so that `--help` is quick.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any

import typer

from pcgraph.plumbing.plain_files import said
from rangesim import __version__
from rangesim.cli.calibrate import calibrate_command
from rangesim.cli.compare import compare_command
from rangesim.cli.dataset import app as dataset_app
from rangesim.cli.decode import decode_command
from rangesim.cli.patterns import patterns_command
from rangesim.cli.presets import presets_command
from rangesim.cli.report import report_command
from rangesim.cli.run import run_command
from rangesim.cli.scan import scan_command
from rangesim.cli.sweep import sweep_command
from rangesim.cli.verify import verify_command
from rangesim.cli.view import view_command
from rangesim.environment.doctor import doctor_command
from rangesim.errors import RangesimError, RangesimWarning, one_line, sentence

app = typer.Typer(
    name="rangesim", no_args_is_help=True, add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False
)
app.command("run")(run_command)
app.command("scan")(scan_command)
app.command("sweep")(sweep_command)
app.command("decode")(decode_command)
app.command("calibrate")(calibrate_command)
app.command("patterns")(patterns_command)
app.command("compare")(compare_command)
app.command("report")(report_command)
app.command("view")(view_command)
app.command("verify")(verify_command)
app.command("presets")(presets_command)
app.command("doctor")(doctor_command)
app.add_typer(dataset_app, name="dataset")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rangesim {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Simulate, decode and compare range sensors: structured light and time of flight.

    Lengths are metres, times seconds, power watts. Start with:

      rangesim run scenes/tabletop.xml --out out/tabletop
    """


def main() -> None:
    """Run the command line.

    An error prints one sentence to stderr and ends the process with status 1. A warning prints one line.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", RangesimWarning)
            warnings.showwarning = _show_warning(warnings.showwarning)
            app()
    except (RangesimError, ValueError, OSError) as error:
        if "--debug" in sys.argv:
            raise
        typer.echo(f"rangesim: {sentence(said(error) if isinstance(error, OSError) else str(error))}", err=True)
        sys.exit(1)


def _show_warning(show_other: Callable[..., None]) -> Callable[..., None]:
    """A replacement for `warnings.showwarning` that prints a RangesimWarning as one line on stderr.

    show_other : called for all other warnings.
    """

    def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
        if issubclass(category, RangesimWarning):
            typer.echo(f"rangesim: {one_line(message)}", err=True)
        else:
            show_other(message, category, *place)

    return show
