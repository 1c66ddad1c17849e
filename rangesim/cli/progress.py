# SPDX-License-Identifier: Apache-2.0
"""Lines that a command prints on stderr before and during its work: cost, place of the output, progress, warnings."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from rangesim.errors import TruncationWarning, one_line

if TYPE_CHECKING:
    from rangesim.pipeline.cost import Cost


LINE_EACH = 0.1
"""Fraction of the work after which a campaign prints its next line: ten lines for each campaign, however long."""
LINE_EACH_S = 10.0
"""Least seconds between two such lines, so that short campaigns print none."""
HOW_TO_RETRY = "rangesim: the same command with --retry computes again what failed"
"""Line at the end of a command some of whose items failed."""


@contextmanager
def progress_bar(is_campaign: bool = False) -> Iterator[Callable[[str, float], None] | None]:
    """Show a progress bar while the block runs, if stderr is a terminal.

    Yields a callable that takes the name of the stage and the fraction done, 0..1. If stderr is no terminal, it yields
    `progress_lines` for a campaign, and else None.

    is_campaign : whether the work may take hours.
    """
    if not sys.stderr.isatty():
        yield progress_lines() if is_campaign else None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("Starting", total=1.0)
        yield lambda stage, fraction: bar.update(task, description=escape(one_line(stage)), completed=fraction)


def progress_lines() -> Callable[[str, float], None]:
    """A function of the stage and the fraction done, 0..1, that prints a line on stderr now and then."""
    told, told_s = 0.0, time.monotonic()

    def tell(stage: str, fraction: float) -> None:
        nonlocal told, told_s
        told, now_s = min(told, fraction), time.monotonic()  # the next stage begins at 0
        if fraction - told >= LINE_EACH and now_s - told_s >= LINE_EACH_S:
            typer.echo(f"rangesim: {100 * fraction:.0f} %, {one_line(stage)}", err=True)
            told, told_s = fraction, now_s

    return tell


def announce_cost(cost: Cost) -> None:
    """Print a line with the estimated cost, if the work takes long or needs much memory."""
    if cost.is_large:
        typer.echo(f"rangesim: this takes {cost}.", err=True)


def announce_linked_output(out: Path, target: Path) -> None:
    """Print a line if `out` is a link to another directory, `target`, where the results go."""
    if out.is_symlink():
        typer.echo(f"rangesim: {one_line(out)} is a link; the results go to {one_line(target)}.", err=True)


@contextmanager
def one_truncation_warning() -> Iterator[None]:
    """Print one truncation warning after the block: that of the pass that left out the most light."""
    left_out: list[TruncationWarning] = []
    show_others: Callable[..., None] = warnings.showwarning

    def keep(message: Warning | str, category: type[Warning], *place: Any) -> None:
        if isinstance(message, TruncationWarning):
            left_out.append(message)
        else:
            show_others(message, category, *place)

    with warnings.catch_warnings():
        warnings.simplefilter("always", TruncationWarning)
        warnings.showwarning = keep  # type: ignore[assignment]
        yield
    if left_out:
        typer.echo(f"rangesim: {one_line(max(left_out, key=lambda warning: warning.fraction))}", err=True)
