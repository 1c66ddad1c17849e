# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph``, with one module for each subcommand.

Slow imports are inside the functions of the commands, so that `--help` is quick.
"""

from __future__ import annotations

from typing import Annotated

import typer

from pcgraph import __version__
from pcgraph.cli.clouds import warning_lines
from pcgraph.cli.compile import compile_command
from pcgraph.cli.cut import cut_command
from pcgraph.cli.info import info_command
from pcgraph.cli.segment import segment_command
from pcgraph.cli.serve import serve_command
from pcgraph.cli.view import view_command
from pcgraph.errors import one_line
from pcgraph.plumbing.plain_files import said

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)
app.command("segment")(segment_command)
app.command("cut")(cut_command)
app.command("info")(info_command)
app.command("view")(view_command)
app.command("compile")(compile_command)
app.command("serve")(serve_command)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pcgraph {__version__}")
        raise typer.Exit


@app.callback()
def _pcgraph(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Point clouds as supervoxels, an adjacency graph and a segmentation tree."""
    context.with_resource(warning_lines())


def main() -> None:
    """Run the command line."""
    try:
        app(prog_name="pcgraph")
    except OSError as error:  # the commands catch errors of files themselves
        typer.echo(f"pcgraph: cannot print: {one_line(said(error))}.", err=True)
        raise SystemExit(1) from None
