# SPDX-License-Identifier: Apache-2.0
"""`rangesim decode`: captures, simulated or real, to maps and clouds."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rangesim.cli.images import (
    AxesOption,
    BitsOption,
    CodeOption,
    ProjectorOption,
    SensorOption,
    SetOption,
    load_frames,
    sensor_of_images,
)
from rangesim.cli.progress import announce_linked_output

if TYPE_CHECKING:
    from rangesim.capture import Capture
    from rangesim.decoding.range_image import RangeImage

ONLY_BARE_IMAGES = ("code", "projector", "axes", "set_", "bits")
"""Options that bare images need. A capture with a sidecar refuses them, because the sidecar says the same."""

TOF_SUFFIX = ".npz"
"""Suffix of the calibrations that `rangesim calibrate` writes for time-of-flight cameras."""


def decode_command(
    context: typer.Context,
    capture: Annotated[
        Path, typer.Argument(help="A capture that rangesim wrote, or a folder of images.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the maps and the cloud.")] = ...,  # type: ignore[assignment]
    sensor: SensorOption = None,
    code: CodeOption = None,
    projector: ProjectorOption = None,
    axes: AxesOption = None,
    set_: SetOption = None,
    code_step: Annotated[int, typer.Option(help="Projector pixels per Gray cell when an .xml was calibrated.")] = 1,
    unit: Annotated[
        float | None,
        typer.Option(
            help="Metres per unit of length of a calibration, .xml or .yml. Default: 1 for OpenCV's files with "
            "camera_matrix, 0.001 for those of procam-calibration."
        ),
    ] = None,
    bits: BitsOption = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Calibration: what rangesim calibrate wrote (.json, .yml, .xml; time of flight: .npz), or .xml of "
            "procam-calibration."
        ),
    ] = None,
) -> None:
    """Decode a capture to maps, and with a calibration to a point cloud, without scene and renderer.

    The command reads bare images in the order of their names, which must be the order of the sensor's frames. The
    default is OpenCV's order: for each axis the patterns from the coarsest to the finest, each followed by its
    inverse; then white and black.

    The command writes range.npz and pictures of the maps, and with a calibration also cloud.ply, in metres.

    Examples:

      rangesim decode out/tabletop/gray-phase/capture --out out/decoded

      rangesim decode out/gated/gated-camera/capture --sensor examples/own_sensor.py:GatedCamera --out out/decoded

      rangesim decode images --projector 1024x768 --calibration board.xml --code-step 2 --out out/board
    """
    from rangesim.cli.decode_summary import likely_cause, status_fractions, summary
    from rangesim.decoding import decode
    from rangesim.errors import DoubtWarning
    from rangesim.files.atomic_directories import check_directory
    from rangesim.report.figures import map_pictures
    from rangesim.results.decoded_captures import DECODED, Decoded, save_decoded

    _refuse_what_would_be_ignored(context, capture, calibration)
    announce_linked_output(out, check_directory(out, DECODED, inputs=[capture]))
    taken_with = sensor_of_images(sensor, code, projector, axes, set_)
    loaded = load_frames(capture, taken_with, bits)
    if taken_with is not None and type(loaded.sensor) is not type(taken_with):
        raise ValueError(f"expected --sensor to name the sensor of {capture}, {loaded.sensor.type_name}.")
    first = loaded.reference
    if calibration and len(loaded.captures) > 1:
        raise ValueError(f"expected no --calibration: {capture} holds the rigs of its {len(loaded.captures)} cameras.")
    if calibration and calibration.suffix.lower() == TOF_SUFFIX:
        image = _calibrated_tof(first, calibration)
    else:
        first = _calibrated(first, calibration, code_step, unit) if calibration else first
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DoubtWarning)  # the summary tells the doubts
            image = decode(first if calibration else loaded)
    decoded = Decoded(image, first.sensor, first.rig, status_fractions(image), likely_cause(image, first))
    save_decoded(decoded, out, map_pictures(image))
    typer.echo(summary(decoded, out, is_given=calibration is not None))


def _refuse_what_would_be_ignored(context: typer.Context, capture: Path, calibration: Path | None) -> None:
    """Raise ValueError if an option was given that would have no effect on this input."""
    from rangesim.calibration.opencv_files import SUFFIXES
    from rangesim.results.captures import SIDECAR

    given = {name for name in context.params if _from_command_line(context, name)}
    if (capture / SIDECAR).is_file() and (surplus := _options(ONLY_BARE_IMAGES, given)):
        raise ValueError(f"{capture} is a capture whose {SIDECAR} says how it was taken: leave out {surplus}.")
    if {"sensor", "code"} <= given:
        raise ValueError("expected either --sensor or --code, got both.")
    suffix = "" if calibration is None else calibration.suffix.lower()
    if "code_step" in given and (calibration is None or suffix != ".xml" or _is_opencv(calibration)):
        raise ValueError("expected --code-step only with --calibration FILE.xml of procam-calibration.")
    if "unit" in given and suffix not in SUFFIXES:
        raise ValueError("expected --calibration FILE.xml or FILE.yml with --unit; other files are in metres.")


def _from_command_line(context: typer.Context, name: str) -> bool:
    """Whether the user gave an option, so that its value is not the default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _options(names: tuple[str, ...], given: set[str]) -> str:
    """The names that are among `given`, written as on the command line."""
    return ", ".join(f"--{name.rstrip('_').replace('_', '-')}" for name in names if name in given)


def _calibrated(capture: Capture, calibration: Path, code_step: int, unit_m: float | None) -> Capture:
    """The capture with the rig of a calibration file."""
    from rangesim.rig.calibration_files import load_calibration

    if _is_opencv(calibration):
        from rangesim.calibration.opencv_files import load_opencv

        return replace(capture, rig=load_opencv(calibration, 1.0 if unit_m is None else unit_m))
    size = capture.sensor.default_emitter.size
    return replace(capture, rig=load_calibration(calibration, size, code_step, 1e-3 if unit_m is None else unit_m))


def _is_opencv(calibration: Path) -> bool:
    """Whether a file is one that `rangesim calibrate` writes for OpenCV; another .xml is procam-calibration's."""
    from pcgraph.plumbing.plain_files import read_file
    from rangesim.errors import FileFormatError

    if calibration.suffix.lower() in (".yml", ".yaml"):
        return True
    return calibration.suffix.lower() == ".xml" and b"camera_matrix" in read_file(calibration, FileFormatError)


def _calibrated_tof(capture: Capture, calibration: Path) -> RangeImage:
    """The range image of a capture, corrected for the wiggling and the offsets of its time-of-flight camera."""
    from rangesim.calibration import load_tof_calibration

    found = load_tof_calibration(calibration)
    if capture.sensor != found.sensor:
        raise ValueError(f"expected a capture of the sensor that was calibrated in {calibration}, {found.sensor}.")
    rig = found.rig if capture.rig is None else replace(found.rig, T_world_camera=capture.rig.T_world_camera)
    return found.correct(found.decoder.decode(replace(capture, rig=rig)))
