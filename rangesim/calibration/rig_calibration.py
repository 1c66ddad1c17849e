# SPDX-License-Identifier: Apache-2.0
"""Calibration of a camera and a projector together, from coded light on a board.

The calibration treats the projector as a camera. Around a corner of the board in the camera's image, the decoded
projector coordinates are a homography of the camera's pixels, and that homography maps the corner into the projector's
image (Moreno, Taubin: "Simple, accurate, and robust projector-camera calibration", 3DIMPVT 2012). No single decoded
pixel would do, because corners of a checkerboard lie where black meets white.

Any sensor can take part if its decoder returns `ProjectorCoordinates` of both axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rangesim.calibration.boards import Board, BoardView
from rangesim.calibration.bundle import Bundle, Observation
from rangesim.calibration.suspects import Suspect, suspects_told
from rangesim.calibration.zhang import adjust_as_seen, check_views, first_camera, judged
from rangesim.capture import Capture
from rangesim.decoding.coordinates import Coordinates
from rangesim.decoding.triangulation import ProjectorCoordinates
from rangesim.geometry.correspondences import Array
from rangesim.geometry.homography import homography_dlt
from rangesim.geometry.projective_plane import map_points
from rangesim.geometry.reprojection import LENS, POSE
from rangesim.rig import Rig
from rangesim.robust_scale import sigma_from_median
from rangesim.sensor import Decoder

MIN_AROUND = 24
"""Least number of decoded pixels around a corner for a homography. A homography has 8 parameters, and each pixel gives
two coordinates, so this is six times the number that it needs."""

MAX_AROUND = 600
"""Largest number of decoded pixels around a corner that its homography takes, evenly spread. More would take longer and
gain little, because the error of a homography falls only with the root of their number."""

REACH = 0.9
"""Distance around a corner up to which decoded pixels are taken, as a fraction of the distance between neighbouring
corners in the image. A larger distance takes more pixels, over which the lenses' distortion is less like a homography;
a smaller one takes fewer pixels, so that less of their noise averages out."""

MAX_GAP_RAD = 2.8
"""Largest gap between the directions of the decoded pixels around a corner, radians; half a turn is 3.14. Two white
squares that meet at a corner leave gaps of a quarter of a turn, squares on one side of it a gap of half a turn."""

RAYLEIGH_MEDIAN = 1.1774
"""Median of the length of a vector over the standard deviation of each of its two normal coordinates: sqrt(2 ln 2)."""

OUTLIER = 4.0
"""Distance in robust standard deviations beyond which a decoded pixel is left out. Normal errors reach it once in 3000
pixels (a Rayleigh distribution), so nearly all pixels that are left out have wrong codes."""


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A rig, its standard deviations, and the places of the boards.

    Parameters
    ----------
    rig : Rig, at the world's origin; its lenses have five coefficients of distortion.
    camera_deviations, projector_deviations : (9,) float64, standard deviations of fx, fy, cx, cy in pixels and of k1,
        k2, p1, p2, k3; 0 for coefficients that are not free.
    baseline_m, baseline_deviation_m : float, distance of the two centres and its standard deviation, metres.
    T_camera_board : (k, 4, 4) float64, maps coordinates of the board in each pose to the camera's, metres.
    camera_residuals, projector_residuals : k arrays (m, 2) float64, pixels, projected minus seen.
    camera_rms_px, projector_rms_px : float, pixels, root mean square of the reprojection errors over all points.
    camera_views, projector_views : k BoardView, the points that were seen.
    suspects : points whose error is beyond all noise when each view is weighed by its own scatter, the worst first.
        They still took part in the calibration.
    """

    rig: Rig
    camera_deviations: Array
    projector_deviations: Array
    baseline_m: float
    baseline_deviation_m: float
    T_camera_board: Array
    camera_residuals: tuple[Array, ...]
    projector_residuals: tuple[Array, ...]
    camera_rms_px: float
    projector_rms_px: float
    camera_views: tuple[BoardView, ...]
    projector_views: tuple[BoardView, ...]
    suspects: tuple[Suspect, ...] = ()


def projector_view(view: BoardView, decoded: Coordinates, spacing_px: float) -> BoardView:
    """The board as the projector would see it: the places of the camera's corners in its image.

    Corners with fewer than `MIN_AROUND` decoded pixels around them are left out.

    Parameters
    ----------
    view : BoardView of the camera.
    decoded : `ProjectorCoordinates` of the same capture, with columns and rows.
    spacing_px : float, camera pixels between neighbouring corners, about. Decoded pixels are taken up to `REACH` of it
        around each corner, where the lenses' distortion must be nearly a homography.

    Raises
    ------
    ValueError
        The decoder returned no projector coordinates, or those of one axis alone.
    """
    if not isinstance(decoded, ProjectorCoordinates):
        raise ValueError("expected a sensor that decodes projector coordinates, got path lengths.")
    column, row = decoded.column, decoded.row
    if column is None or row is None:
        raise ValueError("expected columns and rows of the projector to be decoded, got one axis; show both.")
    height, width = column.shape
    reach = REACH * spacing_px
    indices, pixels = [], []
    for index, corner in zip(view.indices, view.pixels, strict=True):
        left, top = (max(int(c - reach), 0) for c in corner)
        right, bottom = (min(int(c + reach) + 1, n) for c, n in zip(corner, (width, height), strict=True))
        y, x = np.mgrid[top:bottom, left:right] + 0.5
        here = np.stack([x, y], axis=-1)
        there = np.stack([column[top:bottom, left:right], row[top:bottom, left:right]], axis=-1).astype(np.float64)
        usable = np.isfinite(there).all(axis=-1) & (np.linalg.norm(here - corner, axis=-1) <= reach)
        every = max(1, int(usable.sum()) // MAX_AROUND)
        seen = _seen_through(here[usable][::every], there[usable][::every], corner)
        if seen is not None:
            indices.append(index)
            pixels.append(seen)
    return BoardView(np.array(indices, np.int64), np.array(pixels, np.float64).reshape(-1, 2))


def _seen_through(here: Array, there: Array, corner: Array) -> Array | None:
    """(2,) float64, projector pixels, the place to which a homography of decoded pixels maps a corner.

    None if the pixels are too few or on one side of the corner.

    Parameters
    ----------
    here : (n, 2) float64, camera pixels. there : (n, 2) float64, the projector coordinates that they see.
    corner : (2,) float64, camera pixels.
    """
    kept = np.ones(len(here), bool)
    for _ in range(3):
        if kept.sum() < MIN_AROUND or not _surrounds(here[kept] - corner):
            return None
        H = homography_dlt(here[kept], there[kept])
        errors = np.linalg.norm(map_points(H, here) - there, axis=-1)
        spread = sigma_from_median(errors[kept]) / RAYLEIGH_MEDIAN
        within = errors <= OUTLIER * max(spread, 1e-6)
        if (within == kept).all():
            break
        kept = within
    return np.asarray(map_points(H, corner[None])[0])


def _surrounds(offsets: Array) -> bool:
    """Whether points (n, 2) lie around 0: no gap between their directions is as wide as `MAX_GAP_RAD`.

    The pixels of the two white squares that meet at a corner lie around it, even if the black squares send too little
    light back.
    """
    angles = np.sort(np.arctan2(offsets[:, 1], offsets[:, 0]))
    return float(np.diff(angles, append=angles[0] + 2 * np.pi).max()) < MAX_GAP_RAD


def calibrate_rig(
    board: Board,
    captures: Sequence[Capture],
    *,
    coefficients: int = 5,
    names: Sequence[str] | None = None,
    decoder: Decoder | None = None,
) -> RigCalibration:
    """Calibration of a camera and a projector from coded light on a board, each capture with the board in another pose.

    The corners are found in the white images of the captures, and the projector's coordinates are decoded. The rig of a
    capture is not used. Then each device is calibrated by itself. Finally `bundle.adjust` calibrates everything
    together, with the errors of each device weighed by its noise.

    A `RangesimWarning` tells of points that do not fit (`RigCalibration.suspects`), and of a lens that is unknown in a
    corner of its image, or folds there.

    Parameters
    ----------
    captures : two or more Captures of one sensor that codes columns and rows of a projector.
    coefficients : int, number of free coefficients of distortion, of k1, k2, p1, p2, k3 in this order; 0 for pinholes.
    names : names of the captures, for messages; None: their numbers.
    decoder : Decoder of the captures; None: that of their sensor.

    Raises
    ------
    ValueError
        A capture is of another sensor or size; a board is not found (the message says which); there are fewer than two
        captures, or two of the same pose; or the views do not determine the rig.
    """
    names = [f"capture {k}" for k in range(len(captures))] if names is None else [str(name) for name in names]
    if len(names) != len(captures):
        raise ValueError(f"expected a name for each of the {len(captures)} captures, got {len(names)}.")
    views, projector_views = [], []
    for name, capture in zip(names, captures, strict=True):
        try:
            view, seen = _views(board, capture, decoder or capture.sensor.default_decoder)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        if capture.frames.shape != captures[0].frames.shape or capture.sensor != captures[0].sensor:
            raise ValueError(
                f"{name}: expected the sensor and the size of {names[0]}, {_kind(captures[0])}, got {_kind(capture)}."
            )
        views.append(view)
        projector_views.append(seen)
    check_views(board, views, coefficients, names)
    size = captures[0].sensor.default_emitter.size
    assert size is not None
    height, width = captures[0].frames.shape[1:]
    camera, T_camera_board, camera_noise = first_camera(board, views, width, height, coefficients, names)
    projector, T_projector_board, projector_noise = first_camera(board, projector_views, *size, coefficients, names)
    observations = [
        Observation(device, k, board.points[view.indices], view.pixels, noise)
        for device, noise, some in ((0, camera_noise, views), (1, projector_noise, projector_views))
        for k, view in enumerate(some)
    ]
    between = T_projector_board @ np.linalg.inv(T_camera_board)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_matrix(between[:, :3, :3]).mean().as_matrix()
    T[:3, 3] = np.median(between[:, :3, 3], axis=0)
    start = Bundle((camera, projector), T, T_camera_board)
    every = [*views, *projector_views]
    found, observations = adjust_as_seen(board, start, observations, every, coefficients)
    _, deviations = judged(found, observations)
    bundle, lens = found.state, 4 + coefficients
    camera_found, projector_found = bundle.devices
    covariance = found.covariance(found.noise(found.jacobian.shape[1]))
    moved = slice(2 * lens + 3, 2 * lens + POSE)
    translation = bundle.T_second_first[:3, 3]
    baseline = float(np.linalg.norm(translation))
    along = translation / baseline
    residuals = [bundle.project(seen) - seen.pixels for seen in observations]
    of_camera, of_projector = tuple(residuals[: len(views)]), tuple(residuals[len(views) :])
    by_device = np.zeros((2, LENS))
    by_device[:, :lens] = deviations[: 2 * lens].reshape(2, lens)
    suspects = suspects_told(found, observations, every, coefficients, names)
    return RigCalibration(
        Rig(camera_found, projector_found, T_camera_projector=np.linalg.inv(bundle.T_second_first)),
        by_device[0],
        by_device[1],
        baseline,
        float(np.sqrt(along @ covariance[moved, moved] @ along)),
        bundle.T_first_board,
        of_camera,
        of_projector,
        _rms(of_camera),
        _rms(of_projector),
        tuple(views),
        tuple(projector_views),
        suspects,
    )


def _kind(capture: Capture) -> str:
    """Sensor and size of a capture, for messages."""
    return f"{capture.sensor.details} of {capture.frames.shape[2]} x {capture.frames.shape[1]} pixels"


def _rms(residuals: tuple[Array, ...]) -> float:
    """Root mean square over all points."""
    return float(np.sqrt(np.square(np.concatenate(residuals)).sum(axis=1).mean()))


def _views(board: Board, capture: Capture, decoder: Decoder) -> tuple[BoardView, BoardView]:
    """The board as the camera sees it, and as the projector would see it."""
    if capture.sensor.default_emitter.size is None:
        raise ValueError(f"expected a capture of a sensor with a projector, got one of {capture.sensor.type_name}.")
    view = board.find(capture.sensor.white_image(capture.frames))
    decoded = decoder.coordinates(capture)
    grid = np.full((board.rows, board.columns, 2), np.nan)
    grid[view.indices // board.columns, view.indices % board.columns] = view.pixels
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    seen = projector_view(view, decoded, float(np.nanmedian(np.concatenate(steps))))
    if len(seen.indices) < 6:
        raise ValueError(
            f"expected the projector to light the board, got {len(seen.indices)} of {len(view.indices)} corners with "
            "decoded pixels around them; move the board into its light."
        )
    return view, seen
