# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim presets`, which lists the devices that `--sensor` knows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rangesim.presets import Preset

HEADER = ("device", "kind", "pixels", "view, deg", "range, m", "noise", "assumed")
"""Titles of the columns of the list."""


def presets_command(
    name: Annotated[
        str | None, typer.Argument(help="A device, or a file FILE.toml of your own; its file is printed and checked.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Write a picture of the fields of view, as a PNG file.")
    ] = None,
) -> None:
    """List the devices that --sensor knows, with what their data sheets state.

    The column "noise" has the published standard deviation of a reading and its distance; "<=" marks an upper bound.
    "assumed" counts the settings that no document states. A device's file says where each of its numbers comes from.

    Examples:

      rangesim presets

      rangesim presets kinect-v2 > mine.toml

      rangesim run tabletop --sensor mine.toml --out out/mine
    """
    from rangesim import presets

    if picture is not None and picture.suffix.lower() != ".png":
        raise typer.BadParameter(f"expected a name that ends with .png, got {picture}.", param_hint="--picture")
    found = [presets.describe(each) for each in ([name] if name is not None else presets.names())]
    if picture is not None:
        from pcgraph.plumbing.plain_files import write_file
        from rangesim.errors import FileFormatError
        from rangesim.presets.field_of_view_picture import fields_of_view_png

        write_file(picture, fields_of_view_png(found), FileFormatError)
    typer.echo(found[0].text.rstrip("\n") if name is not None else table(found))


def table(found: list[Preset]) -> str:
    """Text table of devices, a line for each, in columns that are as wide as their widest entry."""
    rows = [HEADER, *map(_row, found)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def _row(preset: Preset) -> tuple[str, ...]:
    sheet = preset.sheet
    noise = "none published"
    if sheet.noise is not None:
        bound = "<= " if sheet.noise.is_bound else ""
        noise = f"{bound}{1e3 * sheet.noise.sigma_m[-1]:.3g} mm at {sheet.noise.range_m[-1]:g} m"
    return (
        preset.name,
        preset.kind,
        "{} x {}".format(*sheet.resolution_px),
        "{:g} x {:g}".format(*sheet.field_of_view_deg),
        "{:g} to {:g}".format(*sheet.range_m),
        noise,
        f"{len(preset.assumed)} of {len(preset.sources)}",
    )
