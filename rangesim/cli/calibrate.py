# SPDX-License-Identifier: Apache-2.0
"""The command `rangesim calibrate`, which makes a rig from captures of a board."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rangesim.cli.decode import TOF_SUFFIX
from rangesim.cli.images import (
    ALL_AXES,
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
from rangesim.errors import one_line

if TYPE_CHECKING:
    import numpy as np

    from rangesim.calibration import Board, RigCalibration
    from rangesim.capture import Capture
    from rangesim.rig import Intrinsics

MAX_BOARD_M = 20.0
"""Largest size of a board, metres. A larger one means that the user gave its spacing in millimetres: 10 corners 25 mm
apart would then make a board of 250 m, and no board for a room is larger than 20 m."""

KINDS = ("checkerboard", "charuco", "circles")
"""Names of the kinds of boards on the command line."""


def calibrate_command(
    captures: Annotated[
        list[Path],
        typer.Argument(
            help="Two or more captures that rangesim wrote, or folders of images; for a camera alone, images.",
            show_default=False,
        ),
    ],
    points: Annotated[str, typer.Option(help="Inner corners (discs) of the board, such as 9x6.")] = ...,  # type: ignore[assignment]
    spacing: Annotated[float, typer.Option(help="Metres between neighbouring corners (discs).")] = ...,  # type: ignore[assignment]
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The rig: .json, or .yml, .yaml, .xml for OpenCV; time of flight: .npz.")
    ] = ...,  # type: ignore[assignment]
    report: Annotated[
        Path | None, typer.Option(help="A page with plots of the errors, .html.", show_default=False)
    ] = None,
    board: Annotated[str, typer.Option(help="checkerboard, charuco or circles.")] = "checkerboard",
    marker: Annotated[
        float | None, typer.Option(help="Metres: a charuco marker's side, or a disc's diameter.", show_default=False)
    ] = None,
    dictionary: Annotated[str, typer.Option(help="Dictionary of charuco markers, by OpenCV's name.")] = "DICT_5X5_250",
    coefficients: Annotated[
        int, typer.Option(help="Number of free coefficients of distortion, of k1, k2, p1, p2, k3 in this order.")
    ] = 5,
    sensor: SensorOption = None,
    code: CodeOption = None,
    patterns: PatternsOption = None,
    projector: ProjectorOption = None,
    images: ImagesOption = None,
    order: OrderOption = None,
    set_: SetOption = None,
    rotate: RotateOption = 0,
    mirror: MirrorOption = False,
    channel: ChannelOption = None,
    bits: BitsOption = None,
) -> None:
    """Calibrate camera and projector from coded light, along columns and rows, on a board in two or more poses.

    Ten to twenty poses all over the image, tilted by 20 to 40 degrees in different directions, make a good calibration.

    With captures of a modulated time-of-flight camera whose lens is known, the command calibrates the errors of its
    ranges and writes a .npz file. The board should stand at twenty distances or more, large in the image.

    Examples:

      rangesim calibrate pose_*/ --points 9x6 --spacing 0.025 --projector 1280x800 --out rig.json --report rig.html

      rangesim decode scan --projector 1280x800 --calibration rig.json --out out/scan

      rangesim calibrate photos/*.jpg --points 9x6 --spacing 0.025 --out camera.yml

      rangesim calibrate pose_*/ --points 9x6 --spacing 0.025 --sensor FILE.py:NAME --projector 1280x800 --out rig.json

      rangesim calibrate board_*/ --points 6x5 --spacing 0.12 --out tof.npz
    """
    from pcgraph.plumbing.plain_files import write_file
    from rangesim.calibration import calibrate_rig
    from rangesim.calibration.opencv_files import SUFFIXES, save_opencv
    from rangesim.errors import FileFormatError
    from rangesim.report.calibration_page import render_calibration
    from rangesim.rig.calibration_files import save_calibration

    if out.suffix.lower() not in (".json", TOF_SUFFIX, *SUFFIXES):
        raise ValueError(
            f"expected --out to end in .json, {', '.join(SUFFIXES)}, or {TOF_SUFFIX} for time of flight, got "
            f"{out.name!r}."
        )
    if report is not None and report.suffix.lower() != ".html":
        raise ValueError(f"expected --report to end in .html, got {report.name!r}.")
    check_places(out, report)
    target = _board(board, points, spacing, marker, dictionary)
    if any(path.is_file() for path in captures):
        _camera_alone(target, captures, out, coefficients, projector, report)
        return
    options = ImageOptions(sensor, code, projector, None, order, set_, images, rotate, mirror, channel, bits, patterns)
    axes = ALL_AXES if sensor is None or projector is not None else None
    loaded = [load_frames(path, options, axes) for path in captures]
    if several := [path for path, one in zip(captures, loaded, strict=True) if len(one.captured.captures) > 1]:
        raise ValueError(f"expected captures of one camera, got those of several in {several[0]}.")
    taken, decoder = [one.captured.reference for one in loaded], loaded[0].decoder
    of_tof = any(capture.sensor.default_emitter.size is None for capture in taken)  # its light shows no pattern
    if of_tof != (out.suffix.lower() == TOF_SUFFIX):
        raise ValueError(
            f"expected --out to end in {TOF_SUFFIX} for captures by time of flight, and for no others, got "
            f"{out.name!r}."
        )
    if of_tof:
        if report is not None:
            raise ValueError("expected --report only for a camera and a projector; time of flight has no page yet.")
        if decoder is not None:
            raise ValueError("expected --set with settings of the sensor alone to calibrate time of flight.")
        _time_of_flight(target, taken, [str(path) for path in captures], out)
        return
    names = [str(path) for path in captures]
    found = calibrate_rig(target, taken, coefficients=coefficients, names=names, decoder=decoder)
    check_places(out, report)  # again, because the calibration may take minutes
    (save_calibration if out.suffix.lower() == ".json" else save_opencv)(found.rig, out)
    for finding in dict.fromkeys(finding for one in loaded for finding in one.findings):
        typer.echo(one_line(finding))
    typer.echo(_table(found, captures))
    if report is not None:
        page = render_calibration(found, names, [c.sensor.white_image(c.frames) for c in taken])
        write_file(report, page.encode(), FileFormatError, make_parents=True)
        typer.echo(f"{one_line(report)}: written.")
    typer.echo(f"{one_line(out)}: written.")


def check_places(out: Path, report: Path | None) -> None:
    """Refuse places where no file can be written or where an older file would be lost, before anything is computed.

    Parameters
    ----------
    out, report : files to write; report None: none.

    Raises
    ------
    FileFormatError
        A place is a directory, or holds a file that this command did not write, or that somebody has changed since.

    Examples
    --------
    >>> check_places(Path("no_such_folder/rig.json"), None)
    """
    from pcgraph.plumbing.plain_files import is_sealed
    from rangesim.errors import FileFormatError
    from rangesim.rig.calibration_files import SEAL

    for path in (out, *((report,) if report else ())):
        if not path.exists():
            continue
        if not path.is_file():
            raise FileFormatError(f"cannot write {path}: it exists and is no plain file; choose another path.")
        if path.stat().st_size and not is_sealed(path, SEAL, at_end=True):
            raise FileFormatError(
                f"cannot write {path}: it was not written by rangesim calibrate, or changed since, and would be lost; "
                "choose another path or move it."
            )


def _camera_alone(
    board: Board, images: list[Path], out: Path, coefficients: int, projector: str | None, report: Path | None
) -> None:
    """Calibrate a camera from images of the board, one for each pose, and write the file."""
    from rangesim.calibration import calibrate_camera
    from rangesim.calibration.opencv_files import SUFFIXES, save_opencv_camera
    from rangesim.files.image_files import read_grey

    if projector is not None or report is not None:
        raise ValueError(
            "expected folders of images with --projector or --report; single images calibrate only a camera."
        )
    if out.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"expected --out to end in {', '.join(SUFFIXES)} for a camera alone, got {out.name!r}; for camera and "
            "projector give a folder of images for each pose."
        )
    views, sizes = [], []
    for path in images:
        image = read_grey(path)
        sizes.append(image.shape)
        if image.shape != sizes[0]:
            raise ValueError(
                f"{path}: expected the size of {images[0]}, {sizes[0][1]} x {sizes[0][0]}, got {image.shape[1]} x "
                f"{image.shape[0]}."
            )
        try:
            views.append(board.find(image))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    height, width = sizes[0]
    found = calibrate_camera(
        board, views, width, height, coefficients=coefficients, names=[str(path) for path in images]
    )
    check_places(out, None)
    save_opencv_camera(found.camera, out)
    lines = [_device_line("camera", found.camera, found.deviations), "reprojection, pixels, root mean square:"]
    for path, residual in zip(images, found.residuals, strict=True):
        lines.append(f"  {one_line(path)}  {(residual**2).sum(axis=1).mean() ** 0.5:.3f}")
    typer.echo("\n".join([*lines, f"  all  {found.rms_px:.3f}", f"{one_line(out)}: written."]))


def _time_of_flight(board: Board, captures: list[Capture], names: list[str], out: Path) -> None:
    """Calibrate a time-of-flight camera and write the file."""
    import numpy as np

    from rangesim.calibration import calibrate_tof, find_board_ranges

    found = calibrate_tof(captures, find_board_ranges(board, captures, names), names=names)
    check_places(out, None)
    found.save(out)
    lengths = np.linspace(found.shortest_m, found.longest_m, 1000)
    unseen = 100 * float(np.isnan(found.offset_m).mean())
    typer.echo(
        f"wiggling {500 * np.ptp(found.wiggling_m(lengths)):.2f} mm of range from least to largest; offsets of pixels "
        f"{500 * np.nanstd(found.offset_m):.2f} mm (standard deviation), {unseen:.1f} % of the pixels saw no board; "
        f"noise of a reading {500 * found.noise_m:.2f} mm; ranges from {found.shortest_m / 2:.2f} to "
        f"{found.longest_m / 2:.2f} m."
    )
    typer.echo(f"{one_line(out)}: written.")


def _board(kind: str, points: str, spacing: float, marker: float | None, dictionary: str) -> Board:
    """The board that the options describe; ValueError if they contradict each other."""
    from rangesim.calibration import CharucoBoard, Checkerboard, CircleGrid
    from rangesim.settings.config import nearest, shown

    size = re.fullmatch(r"(\d+)[x×](\d+)", points)
    if not size:
        raise ValueError(f"expected --points as COLUMNSxROWS, such as 9x6, got {shown(points)}.")
    if kind not in KINDS:
        raise ValueError(f"expected --board to be one of {', '.join(KINDS)}, got {kind!r}{nearest(kind, KINDS)}.")
    columns, rows = int(size[1]), int(size[2])
    if spacing * max(columns, rows) > MAX_BOARD_M:
        raise ValueError(
            f"expected --spacing in metres, got {spacing:g}, which makes the board {spacing * max(columns, rows):g} m "
            "large; 25 mm are 0.025."
        )
    if kind == "checkerboard":
        if marker is not None:
            raise ValueError("expected --marker only with --board charuco or circles; a checkerboard has none.")
        return Checkerboard(columns, rows, spacing)
    if marker is None:
        raise ValueError(f"expected --marker METRES with --board {kind}.")
    if kind == "charuco":
        return CharucoBoard(columns, rows, spacing, marker, dictionary)
    return CircleGrid(columns, rows, spacing, marker)


def _table(found: RigCalibration, captures: list[Path]) -> str:
    """Table of the calibrated values with their standard deviations, and of the errors of each capture."""
    import numpy as np

    lines = []
    for name, device, deviations in (
        ("camera", found.rig.pinhole, found.camera_deviations),
        ("projector", found.rig.image_projector, found.projector_deviations),
    ):
        lines.append(_device_line(name, device, deviations))
    lines.append(f"{'baseline':10s}{1e3 * found.baseline_m:.4f} ± {1e3 * found.baseline_deviation_m:.2g} mm")
    lines.append("reprojection, pixels, root mean square in camera and projector:")
    for path, *both in zip(captures, found.camera_residuals, found.projector_residuals, strict=True):
        lines.append(f"  {one_line(path)}  " + "  ".join(f"{np.sqrt((r**2).sum(axis=1).mean()):.3f}" for r in both))
    lines.append(f"  all  {found.camera_rms_px:.3f}  {found.projector_rms_px:.3f}")
    return "\n".join(lines)


def _device_line(name: str, device: Intrinsics, deviations: np.ndarray) -> str:
    """Line with the intrinsics of a device and their standard deviations (9,)."""
    values = (device.fx, device.fy, device.cx, device.cy, *device.coefficients)
    labels = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    shown = (f"{a} {v:.6g} ± {d:.2g}" for a, v, d in zip(labels, values, deviations, strict=True))
    return f"{name:10s}{', '.join(shown)}"
