# SPDX-License-Identifier: Apache-2.0
"""`rangesim patterns`: the images that a projector shows for a code, and the file that says what they are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rangesim.cli.images import ImageOptions, OrderOption, ProjectorOption, SetOption, sensor_to_show
from rangesim.cli.progress import announce_linked_output
from rangesim.errors import one_line


def patterns_command(
    code: Annotated[
        str,
        typer.Argument(
            help="Name of the code, such as gray-phase, or of a sensor with dots; or FILE.py:NAME for a code of your "
            "own; the file is run.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the images.")] = ...,  # type: ignore[assignment]
    projector: ProjectorOption = None,
    axes: Annotated[
        str | None,
        typer.Option(help="Coded axes: columns, rows, or both as columns,rows.", show_default="those of the code"),
    ] = None,
    order: OrderOption = None,
    set_: SetOption = None,
    gamma: Annotated[
        float,
        typer.Option(
            help="Gamma of the projector, about 2.2 for video projectors: the images hold p ^ (1 / gamma), so that it "
            "shows p."
        ),
    ] = 1.0,
    bits: Annotated[int, typer.Option(help="Bits of a pixel of the projector; above 8, PNG of 16 bits.")] = 8,
) -> None:
    """Write the images that a projector shows, and patterns.json, which says what they are.

    Photograph the images in the order of their names. With a copy of patterns.json among the photographs, or with
    --patterns patterns.json, rangesim decode and rangesim calibrate need no further words about the code.

    Examples:

      rangesim patterns gray-phase --projector 1920x1080 --gamma 2.2 --out patterns

      rangesim decode photographs --patterns patterns/patterns.json --out out/scan

      rangesim patterns gray --projector 1280x800 --axes columns --order 'white,black,columns_*' --out patterns
    """
    from rangesim.files.atomic_directories import check_directory
    from rangesim.results.pattern_sets import PATTERNS, PatternSet, save_patterns

    sensor = sensor_to_show(ImageOptions(sensor=code, projector=projector, axes=axes, order=order, set_=set_))
    shown = PatternSet(sensor, gamma, bits)
    announce_linked_output(out, check_directory(out, PATTERNS))
    n_images = save_patterns(shown, out)
    typer.echo(f"{one_line(out)}: {n_images} images for {sensor.title}, {sensor.details}.")
