# SPDX-License-Identifier: Apache-2.0
"""`rangesim decode`: captures, simulated or real, to maps and clouds."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rangesim.cli.progress import say_where

if TYPE_CHECKING:
    from rangesim.capture import Capture
    from rangesim.decoding.range_image import RangeImage
    from rangesim.sensors import Sensor, StructuredLight

OF_PATTERNS = ("code", "projector", "axes", "period", "steps")
OF_BARE_IMAGES = (*OF_PATTERNS, "bits")
TOF_SUFFIX = ".npz"
"""Of what `rangesim calibrate` writes of time-of-flight cameras."""


def decode_command(
    context: typer.Context,
    capture: Annotated[
        Path, typer.Argument(help="A capture that rangesim wrote, or a folder of images.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the maps and the cloud.")] = ...,  # type: ignore[assignment]
    sensor: Annotated[
        str | None,
        typer.Option(help="A sensor of your own that took it, as FILE.py:NAME; the file is run.", show_default=False),
    ] = None,
    code: Annotated[str, typer.Option(help="Of bare images: gray or gray-phase.")] = "gray",
    projector: Annotated[
        str | None, typer.Option(help="Of bare images: projector pixels, for example 1024x768.")
    ] = None,
    axes: Annotated[str, typer.Option(help="Of bare images: columns, rows, or both as columns,rows.")] = "columns,rows",
    period: Annotated[float, typer.Option(help="Of gray-phase images: fringe period, projector pixels.")] = 16.0,
    steps: Annotated[int, typer.Option(help="Of gray-phase images: phase steps per axis.")] = 4,
    code_step: Annotated[int, typer.Option(help="Projector pixels per Gray cell when an .xml was calibrated.")] = 1,
    unit: Annotated[
        float | None,
        typer.Option(
            help="Metres per unit of length of a calibration, .xml or .yml. Default: 1 for OpenCV's with "
            "camera_matrix, 0.001 for procam-calibration's."
        ),
    ] = None,
    bits: Annotated[
        int | None, typer.Option(help="Of bare images: depth, if less than the file's, such as 12.")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Calibration: what rangesim calibrate wrote (.json, .yml, .xml; time of flight: .npz), or .xml of "
            "procam-calibration."
        ),
    ] = None,
) -> None:
    """Decode a capture. Needs no scene and no renderer.

    Bare images are taken in the order of their names: per axis the Gray bits from the most significant, each followed
    by its inverse (and with gray-phase the fringes); then white, black. That is OpenCV's order.

    Writes range.npz and pictures of the maps; with a calibration also cloud.ply, in metres.

    Examples:

      rangesim decode out/tabletop/gray-phase/capture --out out/decoded

      rangesim decode out/gated/gated-camera/capture --sensor examples/own_sensor.py:GatedCamera --out out/decoded

      rangesim decode images --projector 1024x768 --calibration board.xml --code-step 2 --out out/board
    """
    from rangesim.cli.decode_summary import likely_cause, status_fractions, summary
    from rangesim.decoding import decode
    from rangesim.files.result_directories import check_directory
    from rangesim.report.figures import map_pictures
    from rangesim.results.decoded_files import DECODED, Decoded, save_decoded

    _refuse_what_would_be_ignored(context, capture, calibration)
    say_where(out, check_directory(out, DECODED, inputs=[capture]))
    taken_with = _own_sensor(sensor) if sensor else None
    if taken_with is None and projector is not None:
        taken_with = structured_light(code, projector, axes, period, steps)
    loaded = load_frames(capture, taken_with, bits)
    if taken_with is not None and type(loaded.sensor) is not type(taken_with):
        raise ValueError(f"expected --sensor to name the sensor of {capture}, {loaded.sensor.type_name}.")
    if calibration and calibration.suffix.lower() == TOF_SUFFIX:
        image = _calibrated_tof(loaded, calibration)
    else:
        loaded = _calibrated(loaded, calibration, code_step, unit) if calibration else loaded
        image = decode(loaded)
    decoded = Decoded(image, loaded.sensor, loaded.rig, status_fractions(image), likely_cause(image, loaded))
    save_decoded(decoded, out, map_pictures(image))
    typer.echo(summary(decoded, out))


def _refuse_what_would_be_ignored(context: typer.Context, capture: Path, calibration: Path | None) -> None:
    """ValueError if an option was given that has no effect on this input."""
    from rangesim.calibration.opencv_files import SUFFIXES
    from rangesim.results.capture_files import SIDECAR

    given = {name for name in context.params if _from_command_line(context, name)}
    if (capture / SIDECAR).is_file() and (surplus := _options(OF_BARE_IMAGES, given)):
        raise ValueError(f"{capture} is a capture whose {SIDECAR} says how it was taken: leave out {surplus}.")
    if "sensor" in given and (surplus := _options(OF_PATTERNS, given)):
        raise ValueError(f"expected either --sensor or {surplus}.")
    suffix = "" if calibration is None else calibration.suffix.lower()
    if "code_step" in given and (calibration is None or suffix != ".xml" or _is_opencv(calibration)):
        raise ValueError("expected --code-step with --calibration FILE.xml of procam-calibration alone.")
    if "unit" in given and suffix not in SUFFIXES:
        raise ValueError("expected --calibration FILE.xml or FILE.yml with --unit; others are in metres.")


def _from_command_line(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _options(names: tuple[str, ...], given: set[str]) -> str:
    """Those of the names that were given, as they are written on the command line."""
    return ", ".join(f"--{name.replace('_', '-')}" for name in names if name in given)


def load_frames(folder: Path, sensor: Sensor | None, bits: int | None) -> Capture:
    """The capture of a directory with a sidecar, or of bare images."""
    from rangesim.errors import FileFormatError
    from rangesim.results.capture_files import SIDECAR, import_capture, load_capture

    if not folder.is_dir():
        raise FileFormatError(f"{folder} is no directory; expected a capture or a folder of images.")
    if (folder / SIDECAR).is_file():
        return load_capture(folder)
    if sensor is None:
        raise ValueError(
            f"{folder} has no {SIDECAR}, so it holds bare images: expected --projector WIDTHxHEIGHT as well, or "
            "--sensor FILE.py:NAME."
        )
    loaded = import_capture(folder, sensor)
    return loaded if bits is None else _full_scale(loaded, bits)


def _full_scale(capture: Capture, bits: int) -> Capture:
    """The capture with digital numbers of `bits` stretched to all bits of its type, so that white is white."""
    import numpy as np

    dtype = capture.frames.dtype
    if not capture.is_digital or not 1 <= bits <= 8 * dtype.itemsize:
        raise ValueError(f"expected --bits of 1 to {8 * dtype.itemsize} for {dtype} images, got {bits}.")
    if int(capture.frames.max()) >= 2**bits:
        raise ValueError(f"expected digital numbers below {2**bits} for --bits {bits}, got {capture.frames.max()}.")
    stretch = np.iinfo(dtype).max / (2**bits - 1)
    return replace(capture, frames=np.rint(capture.frames * stretch).astype(dtype))


def _calibrated(capture: Capture, calibration: Path, code_step: int, unit_m: float | None) -> Capture:
    """The capture with the rig of a calibration file."""
    from rangesim.rig.calibration_files import load_calibration

    if _is_opencv(calibration):
        from rangesim.calibration.opencv_files import load_opencv

        return replace(capture, rig=load_opencv(calibration, 1.0 if unit_m is None else unit_m))
    size = capture.sensor.emitter.size
    return replace(capture, rig=load_calibration(calibration, size, code_step, 1e-3 if unit_m is None else unit_m))


def _is_opencv(calibration: Path) -> bool:
    """Whether a file is one that `rangesim calibrate` writes for OpenCV; another .xml is procam-calibration's."""
    from pcgraph.plumbing.plain_files import read_file
    from rangesim.errors import FileFormatError

    if calibration.suffix.lower() in (".yml", ".yaml"):
        return True
    return calibration.suffix.lower() == ".xml" and b"camera_matrix" in read_file(calibration, FileFormatError)


def _calibrated_tof(capture: Capture, calibration: Path) -> RangeImage:
    """The range image of a capture, wiggling and offsets taken off."""
    from rangesim.calibration import load_tof_calibration

    found = load_tof_calibration(calibration)
    if capture.sensor != found.sensor:
        raise ValueError(f"expected a capture of the sensor that {calibration} is of, {found.sensor}.")
    rig = found.rig if capture.rig is None else replace(found.rig, T_world_camera=capture.rig.T_world_camera)
    return found.correct(found.decoder.decode(replace(capture, rig=rig)))


def _own_sensor(name: str) -> Sensor:
    """The sensor of FILE.py:NAME."""
    from rangesim.sensors import is_file_name, sensor_of
    from rangesim.settings.config import shown

    if not is_file_name(name):
        raise ValueError(f"expected --sensor as FILE.py:NAME, got {shown(name)}; a capture says itself what took it.")
    return sensor_of(name)


def structured_light(code: str, projector: str, axes: str, period: float, steps: int) -> StructuredLight:
    from rangesim.sensors import StructuredLight
    from rangesim.settings.config import nearest, shown

    codes = StructuredLight.presets()
    if code not in codes:
        raise ValueError(f"expected a code out of {', '.join(codes)}, got {code!r}{nearest(code, codes)}.")
    size = re.fullmatch(r"(\d+)[x×](\d+)", projector)
    if not size:
        raise ValueError(f"expected --projector as WIDTHxHEIGHT in pixels, such as 1024x768, got {shown(projector)}.")
    return StructuredLight(
        projector_width=int(size[1]),
        projector_height=int(size[2]),
        code=code,  # type: ignore[arg-type]
        axes=tuple(a.strip() for a in axes.split(",")),  # type: ignore[misc]
        period_px=period,
        steps=steps,
    )
