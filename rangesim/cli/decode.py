# SPDX-License-Identifier: Apache-2.0
"""`rangesim decode`: captures, simulated or real, to maps and clouds."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rangesim.cli.images import (
    ALL_AXES,
    AxesOption,
    BitsOption,
    ChannelOption,
    CodeOption,
    ImageOptions,
    ImagesOption,
    MirrorOption,
    OrderOption,
    PatternsOption,
    ProjectorOption,
    RotateOption,
    SensorOption,
    SetOption,
    load_frames,
)
from rangesim.cli.progress import announce_linked_output
from rangesim.errors import one_line

if TYPE_CHECKING:
    from rangesim.capture import Capture
    from rangesim.decoding.range_image import RangeImage
    from rangesim.rig.calibration_files import StoredCalibration

TOF_SUFFIX = ".npz"
"""Suffix of the calibrations that `rangesim calibrate` writes for time-of-flight cameras."""


def decode_command(
    capture: Annotated[
        Path,
        typer.Argument(
            help="A capture that rangesim wrote, a folder of images, or a file with all frames (.npy, .npz, .json).",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Directory for the maps and the cloud.")] = ...,  # type: ignore[assignment]
    sensor: SensorOption = None,
    code: CodeOption = None,
    patterns: PatternsOption = None,
    projector: ProjectorOption = None,
    axes: AxesOption = None,
    images: ImagesOption = None,
    order: OrderOption = None,
    set_: SetOption = None,
    rotate: RotateOption = 0,
    mirror: MirrorOption = False,
    channel: ChannelOption = None,
    bits: BitsOption = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Calibration: OpenCV's K, D, R and T of camera and projector by any usual names (.xml, .yml, .json), "
            "or what rangesim calibrate wrote (time of flight: .npz)."
        ),
    ] = None,
    unit: Annotated[
        float | None,
        typer.Option(
            help="Metres per unit of length of T in the calibration, 0.001 for millimetres.",
            show_default="the file's, or a guess that is printed",
        ),
    ] = None,
    code_step: Annotated[
        int, typer.Option(help="Projector pixels per Gray cell in a calibration by procam-calibration.")
    ] = 1,
) -> None:
    """Decode a capture to maps, and with a calibration to a point cloud, without scene and renderer.

    The command reads bare images in the order of their names, or as --images says. They show the frames of the code in
    its own order, or as --order says. A patterns.json in the folder says all that at once. The default is OpenCV's
    order: for each axis the patterns from the coarsest to the finest, each followed by its inverse; then white and
    black.

    The command writes range.npz and pictures of the maps, and with a calibration also cloud.ply, in metres.

    Examples:

      rangesim decode out/tabletop/gray-phase/capture --out out/decoded

      rangesim decode photographs --patterns patterns/patterns.json --calibration stereo.yml --out out/scan

      rangesim decode images --projector 1024x768 --calibration board.xml --code-step 2 --out out/board

      rangesim decode scan --code gray --projector 1280x800 --order 'white,black,columns_bit?' --out out/scan

      rangesim decode taps.npy --sensor amcw --set 'modulation_hz=[60e6]' --out out/taps
    """
    from rangesim.cli.decode_summary import likely_cause, status_fractions, summary
    from rangesim.decoding import decode
    from rangesim.errors import DoubtWarning
    from rangesim.files.atomic_directories import check_directory
    from rangesim.report.figures import map_pictures
    from rangesim.results.decoded_captures import DECODED, Decoded, save_decoded
    from rangesim.sensors import is_file_name

    options = ImageOptions(sensor, code, projector, axes, order, set_, images, rotate, mirror, channel, bits, patterns)
    stored = _stored(calibration, code_step, unit)
    announce_linked_output(out, check_directory(out, DECODED, inputs=[capture]))
    camera_size = None if stored is None else stored.camera_size
    of_file = sensor is not None and is_file_name(sensor)  # which states its axes
    loaded = load_frames(
        capture, options, None if of_file else ALL_AXES, camera_size, None if stored is None else stored.projector_size
    )
    first, findings = loaded.captured.reference, loaded.findings
    if calibration and len(loaded.captured.captures) > 1:
        raise ValueError(
            f"expected no --calibration: {capture} holds the rigs of its {len(loaded.captured.captures)} cameras."
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtWarning)  # the summary tells the doubts
        if calibration is None:
            image = decode(loaded.captured, loaded.decoder)
        elif stored is None:
            if loaded.decoder is not None:
                raise ValueError(f"expected no --set of the decoder with {calibration}, which holds its settings.")
            image = _calibrated_tof(first, calibration)
        else:
            first = _calibrated(first, stored, calibration)
            findings = (*findings, *stored.findings, *_calibration_doubts(first, calibration))
            image = decode(first, loaded.decoder)
    cause = likely_cause(image, first)
    decoded = Decoded(image, first.sensor, first.rig, status_fractions(image), cause, findings)
    save_decoded(decoded, out, map_pictures(image))
    for finding in findings:
        typer.echo(one_line(finding))
    typer.echo(summary(decoded, out, is_given=calibration is not None))


def _stored(calibration: Path | None, code_step: int, unit_m: float | None) -> StoredCalibration | None:
    """Contents of a calibration file; None without a file, and for one of a time-of-flight camera."""
    from rangesim.rig.calibration_files import read_calibration

    if calibration is None or calibration.suffix.lower() == TOF_SUFFIX:
        if code_step != 1:
            raise ValueError("expected --code-step only with --calibration FILE.xml of procam-calibration.")
        if unit_m is not None:
            raise ValueError("expected --calibration FILE.xml, FILE.yml or FILE.json with --unit.")
        return None
    return read_calibration(calibration, code_step, unit_m)


def _calibrated(capture: Capture, stored: StoredCalibration, calibration: Path) -> Capture:
    """The capture with the rig of a calibration file."""
    from rangesim.errors import FileFormatError

    size = capture.sensor.default_emitter.size
    height, width = capture.frames.shape[1:]
    if stored.camera_size not in (None, (width, height)):
        raise FileFormatError(
            f"{calibration}: expected the calibration of a camera of {width} x {height} pixels, as the images, got "
            f"{' x '.join(map(str, stored.camera_size or ()))}: calibrate at the size of the images, and check that "
            "camera and projector are not exchanged in the file."
        )
    try:
        if size is None and not capture.sensor.triangulates:
            return replace(capture, rig=stored.rig_of_camera((width, height)))
        return replace(capture, rig=stored.rig((width, height), size))
    except ValueError as error:
        raise FileFormatError(f"{calibration}: {error}") from error


def _calibration_doubts(capture: Capture, calibration: Path) -> tuple[str, ...]:
    """Sentences on what is implausible in the calibration of a capture."""
    from rangesim.rig import Intrinsics
    from rangesim.rig.calibration_files import principal_point_doubts

    if capture.rig is None or not isinstance(capture.rig.camera, Intrinsics):
        return ()
    return tuple(f"{calibration}: {text}" for text in principal_point_doubts(capture.rig))


def _calibrated_tof(capture: Capture, calibration: Path) -> RangeImage:
    """The range image of a capture, corrected for the wiggling and the offsets of its time-of-flight camera."""
    from rangesim.calibration import load_tof_calibration

    found = load_tof_calibration(calibration)
    if capture.sensor != found.sensor:
        raise ValueError(f"expected a capture of the sensor that was calibrated in {calibration}, {found.sensor}.")
    rig = found.rig if capture.rig is None else replace(found.rig, T_world_camera=capture.rig.T_world_camera)
    return found.correct(found.decoder.decode(replace(capture, rig=rig)))
