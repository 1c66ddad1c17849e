# SPDX-License-Identifier: Apache-2.0
"""`rangesim decode`: captures, simulated or real, to maps and clouds."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rangesim.capture import Capture
    from rangesim.range_image import RangeImage
    from rangesim.rig import Rig

CODES = ("gray", "gray-phase")


def decode_command(
    capture: Annotated[
        Path, typer.Argument(help="A capture that rangesim wrote, or a folder of images.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the maps and the cloud.")] = ...,  # type: ignore[assignment]
    code: Annotated[str, typer.Option(help="Of bare images: gray or gray-phase.")] = "gray",
    projector: Annotated[
        str | None, typer.Option(help="Of bare images: projector pixels, for example 1024x768.")
    ] = None,
    axes: Annotated[str, typer.Option(help="Of bare images: columns, rows, or both as columns,rows.")] = "columns,rows",
    period: Annotated[float, typer.Option(help="Of gray-phase images: fringe period, projector pixels.")] = 16.0,
    steps: Annotated[int, typer.Option(help="Of gray-phase images: phase steps per axis.")] = 4,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration: .json of rangesim, or .xml of procam-calibration (millimetres).")
    ] = None,
) -> None:
    """Decode a capture. Needs no scene and no renderer.

    Bare images are taken in the order of their names: per axis the Gray bits from the most significant, each followed
    by its inverse (and with gray-phase the fringes); then white, black. That is OpenCV's order.

    Writes range.npz and pictures of the maps; with a calibration also cloud.ply, in metres.

    Examples:

      rangesim decode out/tabletop/gray-phase/capture --out out/decoded

      rangesim decode images --code gray --projector 1024x768 --calibration calibration.xml --out out/board
    """
    import rangesim
    from rangesim.cli.decoded_files import write_decoded

    loaded = _load(capture, code, projector, axes, period, steps, calibration)
    image = rangesim.decode(loaded)
    write_decoded(image, loaded, out)
    typer.echo(_summary(image, out))


def _load(
    folder: Path, code: str, projector: str | None, axes: str, period: float, steps: int, calibration: Path | None
) -> Capture:
    """The capture of a directory with a sidecar, or of bare images."""
    import rangesim
    from rangesim.capture_files import SIDECAR
    from rangesim.errors import FileFormatError

    if not folder.is_dir():
        raise FileFormatError(f"{folder} does not exist; expected a capture or a folder of images.")
    if (folder / SIDECAR).is_file():
        from dataclasses import replace

        loaded = rangesim.load_capture(folder)
        rig = _rig(calibration, None) if calibration else None
        return replace(loaded, rig=rig) if rig else loaded
    if projector is None:
        raise ValueError(
            f"{folder} has no {SIDECAR}, so it holds bare images: expected --projector WIDTHxHEIGHT as well."
        )
    sensor = _sensor(code, projector, axes, period, steps)
    rig = _rig(calibration, (sensor.projector_width, sensor.projector_height)) if calibration else None
    return rangesim.import_capture(folder, sensor, rig)


def _sensor(code: str, projector: str, axes: str, period: float, steps: int) -> Any:
    from rangesim.config import nearest
    from rangesim.sensors import StructuredLight

    if code not in CODES:
        raise ValueError(f"expected a code out of {', '.join(CODES)}, got {code!r}{nearest(code, CODES)}.")
    size = re.fullmatch(r"(\d+)[x×](\d+)", projector)
    if not size:
        raise ValueError(f"expected --projector as WIDTHxHEIGHT in pixels, such as 1024x768, got {projector!r}.")
    return StructuredLight(
        projector_width=int(size[1]),
        projector_height=int(size[2]),
        code=code,  # type: ignore[arg-type]
        axes=tuple(a.strip() for a in axes.split(",")),  # type: ignore[misc]
        period_px=period,
        steps=steps,
    )


def _rig(calibration: Path, projector_size: tuple[int, int] | None) -> Rig:
    from rangesim.calibration_files import load_calibration

    return load_calibration(calibration, projector_size)


def _summary(image: RangeImage, out: Path) -> str:
    """What came out, in a line."""
    share = 100 * float(image.valid.mean())
    if image.camera is None:
        return f"{out}: {share:.1f} % of the pixels decoded; without --calibration there is no depth."
    z = image.z[image.valid]
    depth = f", z from {z.min():.3f} to {z.max():.3f} m" if z.size else ""
    return f"{out}: {share:.1f} % of the pixels measured{depth}."
