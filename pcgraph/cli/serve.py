# SPDX-License-Identifier: Apache-2.0
"""The command ``pcgraph serve``."""

from __future__ import annotations

import logging
import signal
from pathlib import Path
from typing import Annotated

import typer

from pcgraph.errors import PcgraphError, one_line


def serve_command(
    host: Annotated[
        str, typer.Option(help="Address to listen at. One that other computers reach needs a token.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen at; 0 for any that is free.")] = 8000,
    token: Annotated[
        str | None,
        typer.Option(
            envvar="PCGRAPH_TOKEN",
            show_envvar=True,
            help="Secret that clients have to send. Others see it in the list of processes: prefer the variable.",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes that segment clouds. Default: one per two cores, at least 2.")
    ] = None,
    max_upload_mb: Annotated[float, typer.Option(help="Size of an upload, megabytes.")] = 512.0,
    max_points: Annotated[int, typer.Option(help="Points of a cloud.")] = 20_000_000,
    max_seconds: Annotated[float, typer.Option(help="Time for a segmentation; then its worker is ended.")] = 60.0,
    max_memory_gb: Annotated[float, typer.Option(help="Memory of a worker process, gigabytes.")] = 4.0,
    max_queued: Annotated[int, typer.Option(help="Segmentations that wait for a worker.")] = 64,
    max_uploads: Annotated[int, typer.Option(help="Uploads that are received at a time.")] = 64,
    max_upload_seconds: Annotated[float, typer.Option(help="Time in which an upload must have arrived.")] = 120.0,
    max_stored_gb: Annotated[float, typer.Option(help="Disk space for finished segmentations, gigabytes.")] = 4.0,
    max_age_minutes: Annotated[float, typer.Option(help="Time without use after which one is removed.")] = 60.0,
    folder: Annotated[
        Path | None, typer.Option(help="Where the private folder is made. Default: the one for temporary files.")
    ] = None,
) -> None:
    """Segment clouds over HTTP; clients get labels at any level, objects, trees and viewer pages.

    docs/service.md describes the operations, and /openapi.json does so for programs. Ctrl-C ends the service.

    Example: pcgraph serve --port 8000
    """
    given = {name: value for name, value in locals().items() if value is not None}
    from pcgraph.service import create_app
    from pcgraph.service.settings import ServiceSettings

    try:
        settings = ServiceSettings(**given)
        app = create_app(settings)
        from pcgraph.service.server import run
    except (PcgraphError, ValueError, OSError) as error:
        typer.echo(f"pcgraph: {one_line(error).rstrip('.')}.", err=True)
        raise typer.Exit(1) from None
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s")
    signal.set_wakeup_fd(-1)  # the server ends by signals itself, and with it its workers
    raise typer.Exit(run(app, settings, lambda address: typer.echo(f"serving at {address}")))
