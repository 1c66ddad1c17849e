# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim`. Heavy modules are imported inside the commands, so that `--help` is quick."""

from __future__ import annotations

import signal
import sys
from typing import Annotated

import typer

import rangesim
from rangesim.cli.decode import decode_command
from rangesim.cli.results import compare_command, report_command
from rangesim.cli.run import run_command
from rangesim.doctor import doctor_command
from rangesim.errors import RangesimError

INTERRUPTED = 130
"""Exit status that Typer gives to Ctrl-C."""

app = typer.Typer(
    name="rangesim", no_args_is_help=True, add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False
)
app.command("run")(run_command)
app.command("decode")(decode_command)
app.command("compare")(compare_command)
app.command("report")(report_command)
app.command("doctor")(doctor_command)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rangesim {rangesim.__version__}")
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
    """Entry point: errors become one sentence on stderr and exit status 1."""
    usual = signal.signal(signal.SIGTERM, _end)
    try:
        app()
    except SystemExit as end:
        if end.code == INTERRUPTED:
            writes = {"run", "decode"} & set(sys.argv[1:3])  # their directories appear when they are complete
            typer.echo(f"rangesim: interrupted{'; nothing was written' if writes else ''}.", err=True)
        raise
    except (RangesimError, ValueError, OSError) as error:
        if "--debug" in sys.argv:
            raise
        typer.echo(f"rangesim: {' '.join(str(error).split())}", err=True)
        sys.exit(1)
    finally:
        signal.signal(signal.SIGTERM, usual)


def _end(number: int, _: object) -> None:
    """Leave by an exception, so that half-written directories are removed."""
    sys.exit(128 + number)
