# SPDX-License-Identifier: Apache-2.0
"""Calibration of a modulated time-of-flight camera by targets at known range: wiggling, and an offset for each pixel.

The correlation of source and reference is a periodic function of the phase phi = 2 pi f l / c with the harmonics
a_1, a_2, ... A camera has N taps, 2 pi / N apart. They cannot distinguish harmonic n N + 1 from the first one, nor
harmonic n N - 1 from the first one with the opposite sign of its phase. They measure

    arg( sum over k = 1 mod N of a_k e^(i k phi) + sum over k = -1 mod N of a_k e^(-i k phi) ),

which differs from phi by a function of period 2 pi / N, the wiggling (Godbaz, Cree, Dorrington: "Understanding and
ameliorating non-linear phase and amplitude responses in AMCW lidar", Remote Sensing 2012). `wiggling` is that closed
form for known harmonics. `calibrate_tof` finds the correction from targets, as a series of sines over the path length
that is read, together with the delay of each pixel (Lindner, Kolb: "Lateral and depth calibration of PMD-distance
sensors", ISVC 2006; those authors took splines, which do not use the period).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.calibration.boards import Board
from rangesim.capture import Capture
from rangesim.decoding.path_length import range_from_path_length
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.errors import FileFormatError
from rangesim.files.array_files import write_arrays
from rangesim.files.schema import MAX_METRES, SETTINGS, ArraySpec, read_checked_arrays, settings_array, settings_of
from rangesim.geometry.camera_pose import fit_camera_pose
from rangesim.geometry.correspondences import Array, checked_array
from rangesim.response import SPEED_OF_LIGHT
from rangesim.rig import Intrinsics, Rig, pose
from rangesim.rig.calibration_files import SEAL
from rangesim.robust_scale import sigma_from_median
from rangesim.sensor import Decoder, of_type
from rangesim.sensors.amcw import TAPS_DEG, AmcwToF
from rangesim.sensors.registry import sensor_from_dict
from rangesim.settings.config import check_keys, from_dict, shown, to_dict

N_ORDERS = 4
"""Number of orders of the wiggling in the series, each a multiple of the number of taps. Four leave 1.9 % of the
wiggling of square waves; more need more targets."""

ROUNDS = 5
"""Number of rounds of the fit. Each round weighs the targets by the noise that the round before found, and leaves
outliers out. After fewer rounds, outliers may still distort the fit; each round takes the time of one fit."""

OUTLIER = 5.0
"""Distance, in robust standard deviations of its image, beyond which a reading is left out: it is a flying pixel, or
its light also came on other ways. Normal noise reaches it once in two million readings."""

SERIES_REST = 0.02
"""Largest fraction of the wiggling that may be left, because the series has no higher orders: 1.9 % for square waves,
see `N_ORDERS`. It counts as noise of the targets, so that they do not count as outliers."""

MAX_DEVIATION = 1.0
"""Largest standard deviation of the correction, as a multiple of the noise of a reading. With a larger one, the targets
do not determine the correction: it would add more error than a reading has."""

BETWEEN = 1000
"""Number of path lengths, from the nearest target to the farthest, at which the standard deviation of the correction is
computed. Over 10 m, a period of order 16 at 100 MHz has 19 of them."""

ROUNDING = 1e-14
"""Least eigenvalue of the normal equations, as a fraction of the largest, that differs from 0: fifty times the
rounding of float64. Smaller ones are raised to it."""

MAX_ORDER = 1000
"""Largest order of the wiggling in a file or a call. It is far more than any camera shows, so a larger one is a
mistake."""

FORMAT = "rangesim.tof-calibration"
"""Format of the files, in their settings."""

_ARRAYS = {
    "cosines_m": ArraySpec("float64", ("f", "k"), low=-1e3, high=1e3),
    "sines_m": ArraySpec("float64", ("f", "k"), low=-1e3, high=1e3),
    "offset_m": ArraySpec("float64", low=-MAX_METRES, high=MAX_METRES, nan=True),
    "settings": SETTINGS,
}
"""Arrays of a file with their types, shapes and bounds; coefficients beyond 1 km are no calibration."""


def triangle_harmonics(n: int) -> Array:
    """(n,) float64, harmonics a_1 .. a_n of the correlation of a square source with a square reference.

    They are 1 / k^2 for odd k, and 0 for even k, so that a_1 = 1.

    Examples
    --------
    >>> triangle_harmonics(5).round(3)
    array([1.   , 0.   , 0.111, 0.   , 0.04 ])
    """
    k = np.arange(1, n + 1)
    return np.where(k % 2 == 1, 1.0 / k**2, 0.0)


def wiggling(phase: ArrayLike, harmonics: ArrayLike, taps: int = len(TAPS_DEG)) -> Array:
    """(...) float64, phase measured by evenly spaced taps, minus the true phase, in periods.

    The equation is in the docstring of this module. It is exact for the given harmonics. To first order in them, the
    error is the sum over n of (a_(nN+1) - a_(nN-1)) sin(n N phi) / (2 pi a_1).

    Parameters
    ----------
    phase : (...) float, true phase in periods, l f / c.
    harmonics : (k,) float, a_1 .. a_k of an even correlation, a_1 positive.
    taps : int, N, 3 or more; two taps cannot tell the sign of a phase.

    Examples
    --------
    >>> wiggling([0.0, 0.0625, 0.125], triangle_harmonics(99)).round(4)  # four taps, square waves
    array([ 0.    , -0.0113, -0.    ])
    """
    a = checked_array("harmonics", harmonics, None)
    if a.ndim != 1 or not len(a) or not a[0] > 0:
        raise ValueError(f"expected harmonics a_1 .. a_k with a positive a_1, got {shown(a.tolist())}.")
    if not taps >= 3:
        raise ValueError(f"expected at least 3 taps, got {taps!r}.")
    phi = 2 * np.pi * np.asarray(phase, dtype=np.float64)
    measured = np.zeros(phi.shape, dtype=np.complex128)
    for k, amplitude in enumerate(a, start=1):
        if k % taps == 1:
            measured += amplitude * np.exp(1j * (k - 1) * phi)
        elif k % taps == taps - 1:
            measured += amplitude * np.exp(-1j * (k + 1) * phi)
    return np.asarray(np.angle(measured) / (2 * np.pi))


def plane_range(camera: Intrinsics, T_camera_plane: ArrayLike) -> Array:
    """(h, w) float64, metres along each pixel's ray from the camera centre to the plane z = 0 of a frame.

    NaN where the ray does not meet the plane.

    Parameters
    ----------
    T_camera_plane : (4, 4) float, maps coordinates of the frame to the camera's, metres; for example, the frame of a
        wall on a stage.

    Examples
    --------
    >>> from rangesim.rig import translation
    >>> plane_range(Intrinsics(3, 1, 1.0, 1.0, 1.5, 0.5), translation(0, 0, 2.0)).round(3)
    array([[2.828, 2.   , 2.828]])
    """
    T = pose(T_camera_plane, "T_camera_plane")
    rays = camera.directions(camera.pixel_centres())
    normal = T[:3, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (normal @ T[:3, 3]) / (rays @ normal)
    return np.asarray(np.where(z > 0, z, np.nan) * np.linalg.norm(rays, axis=-1))


def board_range(board: Board, camera: Intrinsics, T_camera_board: ArrayLike) -> Array:
    """(h, w) float64, metres along each pixel's ray from the camera centre to a board; NaN beside the board.

    Parameters
    ----------
    T_camera_board : (4, 4) float, maps coordinates of the board to the camera's, metres, as
        `rangesim.geometry.fit_camera_pose` finds it from the corners in the same image.

    Examples
    --------
    >>> from rangesim.calibration import Checkerboard
    >>> from rangesim.rig import translation
    >>> board, camera = Checkerboard(3, 2, 0.1), Intrinsics(4, 1, 2.0, 2.0, 1.0, 0.5)
    >>> board_range(board, camera, translation(0, 0, 0.5)).round(3)
    array([[0.515, 0.515, 0.625,   nan]])

    Raises
    ------
    ValueError
        The camera is no pinhole, or the pose is not rigid.
    """
    if not isinstance(camera, Intrinsics):
        raise ValueError(f"expected a pinhole camera (Intrinsics) to see the board, got {shown(camera)}.")
    T = pose(T_camera_board, "T_camera_board")
    distance = plane_range(camera, T)
    rays = camera.directions(camera.pixel_centres())
    X = rays * (distance / np.linalg.norm(rays, axis=-1))[..., None]
    on_board = (X - T[:3, 3]) @ T[:3, :2]
    start = -board.margin * board.spacing_m
    with np.errstate(invalid="ignore"):
        inside = ((on_board >= start) & (on_board <= np.add(board.size_m, start))).all(axis=-1)
    return np.asarray(np.where(inside, distance, np.nan))


def find_board_ranges(board: Board, captures: Sequence[Capture], names: Sequence[str] | None = None) -> list[Array]:
    """Range of the board in each capture by a calibrated camera: arrays (h, w) float64, metres, NaN beside the board.

    The function finds the board in the white image of the capture, and the board's pose from its corners and the camera
    of the rig. So you need no stage that moves the board by known steps.

    Parameters
    ----------
    names : names of the captures, for messages; None: their numbers.

    Raises
    ------
    ValueError
        A capture has no rig, or no board is found in it; the message names the capture.
    """
    ranges = []
    for name, capture in zip(_named(names, len(captures)), captures, strict=True):
        if capture.rig is None:
            raise ValueError(f"{name}: expected a rig with the calibrated camera, got none.")
        try:
            view = board.find(capture.sensor.white_image(capture.frames))
            found = fit_camera_pose(board.points[view.indices], view.pixels, capture.rig.pinhole)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        ranges.append(board_range(board, capture.rig.pinhole, found.T_camera_object))
    return ranges


@dataclass(frozen=True, eq=False)
class ToFCalibration:
    """Systematic errors of a time-of-flight camera, as functions of the path length that it reads.

    A path length m (there and back) that a pixel reads is too long by the pixel's offset, and by the sum over
    frequencies f and orders k of cosines cos(2 pi k f m / c) + sines sin(2 pi k f m / c).

    Parameters
    ----------
    rig : Rig of the camera and its emitter, at the world's origin.
    sensor : AmcwToF that took the readings. decoder : Decoder that made them.
    orders : k integers, orders of the wiggling.
    cosines_m, sines_m : (f, k) float64, metres of path length, by frequency and order.
    offset_m : (h, w) float64, metres of path length; NaN at pixels that saw no target.
    shortest_m, longest_m : float, metres, path lengths of the nearest and the farthest target; outside them the errors
        are not known.
    noise_m : float, metres, standard deviation of a path length about the correction, typical of the targets.
    """

    rig: Rig
    sensor: AmcwToF
    decoder: Decoder
    orders: tuple[int, ...]
    cosines_m: Array
    sines_m: Array
    offset_m: Array
    shortest_m: float
    longest_m: float
    noise_m: float

    def __post_init__(self) -> None:
        camera, shape = self.rig.camera, (len(self.sensor.modulation_hz), len(self.orders))
        if self.cosines_m.shape != shape or self.sines_m.shape != shape:
            raise ValueError(
                f"expected cosines_m and sines_m of shape {shape}, got {self.cosines_m.shape} and {self.sines_m.shape}."
            )
        if self.offset_m.shape != (camera.height, camera.width):
            raise ValueError(
                f"expected offset_m of shape {(camera.height, camera.width)} as the rig's camera, got "
                f"{self.offset_m.shape}."
            )

    def wiggling_m(self, length_m: ArrayLike) -> Array:
        """(...) float64, metres by which path lengths that were read are too long, without the pixels' offsets."""
        coefficients = np.concatenate([self.cosines_m.ravel(), self.sines_m.ravel()])
        return np.asarray(_series(_waves(self.sensor, self.orders), np.asarray(length_m, np.float64)) @ coefficients)

    def correct(self, image: RangeImage) -> RangeImage:
        """Range image with z and range corrected for wiggling and offsets. Apply it only once to each image of this
        rig.

        Pixels that saw no target, and readings beyond the path lengths of the targets, are refused with
        `Status.OUT_OF_RANGE`, because nothing is known of their error.

        Raises
        ------
        ValueError
            The image is of another camera, or of a decoder with other settings.
        """
        if image.camera != self.rig.camera:
            raise ValueError(
                "expected a range image of the camera that was calibrated, got one of another; decode it with the "
                "calibration's rig."
            )
        if image.decoder is not None and image.decoder != self.decoder:
            raise ValueError(
                f"expected a range image by the calibrated decoder {self.decoder}, got one by {image.decoder}."
            )
        rays = self.rig.pinhole.directions(self.rig.pinhole.pixel_centres())
        read = path_length(np.where(image.valid, image.range_m, np.nan), rays, self.rig)
        with np.errstate(invalid="ignore"):
            known = (read >= self.shortest_m) & (read <= self.longest_m)
        true = np.where(known, read - self.wiggling_m(np.nan_to_num(read)) - self.offset_m, np.nan)
        range_m = range_from_path_length(true, rays, self.rig)
        with np.errstate(invalid="ignore"):
            ok = image.valid & (range_m > 0)
        status = np.where(image.valid & ~ok, np.uint8(Status.OUT_OF_RANGE), image.status)
        range_m = np.where(ok, range_m, np.nan)
        sigma = image.sampling_sigma_m
        return replace(
            image,
            z=(range_m / np.linalg.norm(rays, axis=-1)).astype(np.float32),
            range_m=range_m.astype(np.float32),
            status=status,
            sampling_sigma_m=None if sigma is None else np.where(ok, sigma, np.float32(np.nan)),
        )

    def save(self, path: str | Path) -> None:
        """Write the calibration, with rig, sensor and decoder, to a .npz file that `load_tof_calibration` reads."""
        settings = {
            "format": FORMAT,
            "rig": to_dict(self.rig),
            "sensor": to_dict(self.sensor),
            "decoder": to_dict(self.decoder),
            **{name: to_dict(getattr(self, name)) for name in ("orders", "shortest_m", "longest_m", "noise_m")},
        }
        arrays = {name: getattr(self, name) for name in ("cosines_m", "sines_m", "offset_m")}
        write_arrays(path, {**arrays, "settings": settings_array(settings)}, SEAL)


def load_tof_calibration(path: str | Path) -> ToFCalibration:
    """The calibration that `ToFCalibration.save` wrote.

    Raises
    ------
    FileFormatError
        The file is missing or broken, holds something else, or its decoder is of a class that is not loaded.
    """
    path = Path(path)
    arrays: dict[str, Any] = read_checked_arrays(path, _ARRAYS, {})
    settings = settings_of(arrays.pop("settings"), path)
    if settings.pop("format", None) != FORMAT:
        raise FileFormatError(f"{path}: expected a calibration that ToFCalibration.save wrote, got other settings.")
    numbers = ("shortest_m", "longest_m", "noise_m")
    names = ("rig", "sensor", "decoder", "orders", *numbers)
    try:
        check_keys(settings, names, "settings")
        if missing := [name for name in names if name not in settings]:
            raise ValueError(f"settings: missing {', '.join(missing)}.")
        orders = settings["orders"]
        if not isinstance(orders, list) or not orders or not all(map(_is_order, orders)):
            raise ValueError(f"expected orders as whole numbers from 1 to {MAX_ORDER}, got {shown(orders)}.")
        for name in numbers:
            if not isinstance(settings[name], float) or not 0 <= settings[name] <= MAX_METRES:
                raise ValueError(f"expected {name} in metres, got {shown(settings[name])}.")
        return ToFCalibration(
            rig=Rig.from_dict(settings["rig"]),
            sensor=of_type(sensor_from_dict(settings["sensor"], "sensor"), AmcwToF),
            decoder=from_dict(Decoder, settings["decoder"], "decoder"),  # type: ignore[type-abstract]
            orders=tuple(orders),
            **{name: settings[name] for name in numbers},
            **arrays,
        )
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{path}: {error}") from error


def _is_order(value: Any) -> bool:
    """Whether a value is an order of the wiggling: a whole number from 1 to `MAX_ORDER`."""
    return type(value) is int and 0 < value <= MAX_ORDER


def path_length(range_m: Array, rays: Array, rig: Rig) -> Array:
    """(...) float64, metres from the emitter to the point at a range along camera rays, and back to the camera.

    Parameters
    ----------
    range_m : (...) float, metres from the camera centre. rays : (..., 3) float, of any length, camera coordinates.

    Examples
    --------
    >>> from rangesim.rig import translation
    >>> device = Intrinsics(640, 480, 800, 800, 320, 240)
    >>> rig = Rig(device, device, np.eye(4), translation(0.6, 0, 0))  # the emitter stands 0.6 m to the right
    >>> path_length(np.array([0.8]), np.array([[0.0, 0.0, 1.0]]), rig)
    array([1.8])
    """
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    r = np.asarray(range_m, np.float64)
    return np.asarray(r + np.linalg.norm(r[..., None] * unit - rig.T_camera_projector[:3, 3], axis=-1))


def calibrate_tof(
    captures: Sequence[Capture],
    true_range_m: Sequence[NDArray[np.floating[Any]]],
    *,
    decoder: Decoder | None = None,
    orders: tuple[int, ...] | None = None,
    names: Sequence[str] | None = None,
) -> ToFCalibration:
    """Calibration of wiggling and offsets of a camera, from captures of targets whose range is known.

    It is a least-squares fit of the series of `ToFCalibration` and of one offset for each pixel. Each target is weighed
    by the scatter of its readings about the fit, and readings beyond `OUTLIER` are left out.

    Parameters
    ----------
    captures : two or more Captures of one `AmcwToF`, all with one rig (it may stand in different places), of matte
        targets that the light reaches only on the straight way: walls or boards at many distances. Distances that lie
        evenly over a period of the wiggling (c / 8 f of range for four taps) or more determine it best.
    true_range_m : (h, w) float each, metres from the camera centre; NaN beside the target. See `board_range`.
    decoder : Decoder of the readings; None: the sensor's own, with `correct_wiggling` off, so that it assumes no
        waveform.
    orders : different integers, orders of the wiggling; None: the first `N_ORDERS` multiples of the number of taps.
        Other orders appear where pixels are not linear.
    names : names of the captures, for messages; None: their numbers.

    Raises
    ------
    ValueError
        A capture is of another sensor, without a rig, or with another rig; a range has another shape; or the targets do
        not determine the correction: they are too few, or all at nearly one distance.

    Examples
    --------
    >>> calibration = calibrate_tof(captures, find_board_ranges(board, captures))  # doctest: +SKIP
    """
    names = _named(names, len(captures))
    sensor, rig = _checked(captures, true_range_m, names)
    if decoder is None:
        decoder = replace(sensor.default_decoder, correct_wiggling=False)
    if orders is None:
        orders = tuple(len(TAPS_DEG) * n for n in range(1, N_ORDERS + 1))
    if not orders or len(set(orders)) < len(orders) or not all(map(_is_order, orders)):
        raise ValueError(f"expected orders as different whole numbers from 1 to {MAX_ORDER}, got {shown(orders)}.")
    rays = rig.pinhole.directions(rig.pinhole.pixel_centres())
    readings = []
    for k, (capture, truth) in enumerate(zip(captures, true_range_m, strict=True)):
        image = decoder.decode(capture)
        seen = image.valid & np.isfinite(truth)
        if not seen.any():
            raise ValueError(f"{names[k]}: expected readings on the target, got none; is it lit, and in range?")
        read = path_length(image.range_m[seen], rays[seen], rig)
        true = path_length(np.asarray(truth)[seen], rays[seen], rig)
        if np.median(np.abs(read - true)) > sensor.searched_m / 2:
            raise ValueError(
                f"{names[k]}: expected readings near the true range, got "
                f"{np.median(image.range_m[seen]):.3g} m at {np.median(np.asarray(truth)[seen]):.3g} m; leave out "
                f"targets beyond the {sensor.unambiguous_range_m:.3g} m up to which the camera is unambiguous, and "
                "check that its rig is the one that took them."
            )
        readings.append(_Readings(np.flatnonzero(seen), read, read - true))
    waves = _waves(sensor, orders)
    fit = _fit(readings, waves, rig.camera.width * rig.camera.height)
    open_by = fit.deviation / fit.noise
    if not open_by <= MAX_DEVIATION:
        raise ValueError(
            f"expected targets that determine the correction, got {len(captures)} that leave it open: its standard "
            f"deviation is {open_by:.2g} times the noise of a reading; add distances, over a period of the wiggling."
        )
    cosines, sines = fit.coefficients.reshape(2, len(sensor.modulation_hz), len(orders))
    return ToFCalibration(
        rig=rig,
        sensor=sensor,
        decoder=decoder,
        orders=orders,
        cosines_m=cosines,
        sines_m=sines,
        offset_m=fit.offset.reshape(rig.camera.height, rig.camera.width),
        shortest_m=fit.shortest,
        longest_m=fit.longest,
        noise_m=fit.noise,
    )


@dataclass(frozen=True, eq=False)
class _Readings:
    """Readings of one target.

    pixel : (m,) flat indices. length, off : (m,) float64, metres, path lengths that were read, and their errors.
    """

    pixel: NDArray[np.int64]
    length: Array
    off: Array


def _named(names: Sequence[str] | None, n: int) -> list[str]:
    """One name for each of n captures; their numbers if none are given."""
    result = [f"capture {k}" for k in range(n)] if names is None else [str(name) for name in names]
    if len(result) != n:
        raise ValueError(f"expected a name for each of the {n} captures, got {len(result)}.")
    return result


def _checked(captures: Sequence[Capture], true_range_m: Sequence[Any], names: Sequence[str]) -> tuple[AmcwToF, Rig]:
    """The sensor and the rig, moved to the world's origin, that all captures share; ValueError if they share none."""
    if len(captures) < 2 or len(captures) != len(true_range_m):
        raise ValueError(
            f"expected captures of two or more targets and the range of each, got {len(captures)} and "
            f"{len(true_range_m)}."
        )
    sensor, rig = captures[0].sensor, captures[0].rig
    for k, (capture, truth) in enumerate(zip(captures, true_range_m, strict=True)):
        try:
            of_type(capture.sensor, AmcwToF)
        except ValueError as error:
            raise ValueError(f"{names[k]}: {error}") from error
        if capture.rig is None:
            raise ValueError(f"{names[k]}: expected a rig, which holds the camera and the place of the emitter.")
        if capture.sensor != sensor or _at_origin(capture.rig) != _at_origin(rig):
            raise ValueError(f"{names[k]}: expected the sensor and the rig of {names[0]}, got another.")
        if np.shape(truth) != capture.frames.shape[1:]:
            raise ValueError(f"{names[k]}: expected true ranges {capture.frames.shape[1:]}, got {np.shape(truth)}.")
        if not (np.isnan(truth) | (np.asarray(truth) > 0)).all():
            raise ValueError(f"{names[k]}: expected true ranges in positive metres, or NaN beside the target.")
    return of_type(sensor, AmcwToF), _at_origin(rig)


def _at_origin(rig: Rig | None) -> Rig:
    """The rig moved to the world's origin, because the camera may move between captures too, not only the target."""
    assert rig is not None
    return replace(rig, T_world_camera=np.eye(4))


def _waves(sensor: AmcwToF, orders: tuple[int, ...]) -> Array:
    """(f k,) float64, angular wave numbers in radians per metre of path length, by frequency and order."""
    return np.outer(sensor.modulation_hz, orders).ravel() * (2 * np.pi / SPEED_OF_LIGHT)


def _series(waves: Array, length_m: Array) -> Array:
    """(..., 2 f k) float64, cosines, then sines, of the phases of path lengths (...) at all wave numbers (f k,)."""
    phase = length_m[..., None] * waves
    return np.concatenate([np.cos(phase), np.sin(phase)], axis=-1)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Result of the fit, all in metres of path length.

    coefficients : (c,), coefficients of the series. offset : (n_pixels,); NaN at pixels without readings.
    shortest, longest : path lengths of the readings that count. noise : standard deviation of a reading.
    deviation : largest standard deviation of the correction between shortest and longest.
    """

    coefficients: Array
    offset: Array
    shortest: float
    longest: float
    noise: float
    deviation: float


def _fit(readings: list[_Readings], waves: Array, n_pixels: int) -> _Fit:
    """The series and the offsets with the least squared error.

    It eliminates the offsets: it subtracts the means over the targets from each pixel's errors and series. So the
    normal equations hold only the few coefficients.

    Parameters
    ----------
    waves : (f k,) radians per metre. n_pixels : int, number of pixels of the camera.
    """
    c = 2 * len(waves)
    spread = np.ones(len(readings))
    kept = [np.ones(len(r.pixel), bool) for r in readings]
    seen = np.zeros(n_pixels, bool)
    for r in readings:
        seen[r.pixel] = True
    for _ in range(ROUNDS):
        total = np.zeros(n_pixels)
        sums = np.zeros((n_pixels, c + 1))
        normal = np.zeros((c + 1, c + 1))
        for r, sigma, keep in zip(readings, spread, kept, strict=True):
            rows = np.column_stack([_series(waves, r.length[keep]), r.off[keep]]) / sigma
            total[r.pixel[keep]] += 1.0 / sigma**2
            sums[r.pixel[keep]] += rows / sigma
            normal += rows.T @ rows
        some = total > 0
        means = np.full((n_pixels, c + 1), np.nan)
        means[some] = sums[some] / total[some, None]
        normal -= sums[some].T @ means[some]
        size = np.sqrt(np.maximum(np.diag(normal)[:c], 1e-300))
        values, axes = np.linalg.eigh(normal[:c, :c] / np.outer(size, size))
        inverse = (axes / np.maximum(values, ROUNDING * values[-1])) @ axes.T / np.outer(size, size)
        coefficients = inverse @ normal[:c, c]
        offset = means[:, c] - means[:, :c] @ coefficients
        over = np.full((len(readings), n_pixels), np.nan)
        for row, r in zip(over, readings, strict=True):
            row[r.pixel] = r.off - _series(waves, r.length) @ coefficients
        middle = np.full(n_pixels, np.nan)  # an outlier hardly moves the median
        middle[seen] = np.nanmedian(over[:, seen], axis=0)
        for k, r in enumerate(readings):
            residual = over[k, r.pixel] - middle[r.pixel]
            spread[k] = sigma_from_median(residual, np.median(residual))
        # The orders beyond those of the series leave errors that are neither noise nor outliers.
        wiggled = [float(np.mean(r.off - row[r.pixel])) for row, r in zip(over, readings, strict=True)]
        rest = SERIES_REST * float(np.std(wiggled))
        spread = np.maximum(np.hypot(spread, rest), 1e-9)
        for k, r in enumerate(readings):
            kept[k] = np.abs(over[k, r.pixel] - middle[r.pixel]) <= OUTLIER * spread[k]
    count = sum(int(keep.sum()) for keep in kept)
    freedom = count - int(some.sum()) - c
    squares = [
        np.square((row - offset)[r.pixel][keep] / sigma).sum()
        for row, r, keep, sigma in zip(over, readings, kept, spread, strict=True)
    ]
    scale = float(np.sqrt(np.sum(squares) / freedom)) if freedom > 0 else np.inf
    # An offset absorbs a constant, so that the correction counts by its difference from its mean over the targets.
    lengths = [r.length[keep] for r, keep in zip(readings, kept, strict=True) if keep.any()]
    shortest, longest = float(min(x.min() for x in lengths)), float(max(x.max() for x in lengths))
    off = _series(waves, np.linspace(shortest, longest, BETWEEN)) - np.nanmean(means[:, :c], axis=0)
    deviation = float(np.sqrt(np.einsum("ni,ij,nj->n", off, inverse, off).max())) * scale
    return _Fit(coefficients, offset, shortest, longest, float(np.median(spread)) * scale, deviation)
