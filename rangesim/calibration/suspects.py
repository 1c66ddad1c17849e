# SPDX-License-Identifier: Apache-2.0
"""Points whose errors in a calibration are larger than noise explains, and distortion that a calibration leaves out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangesim.calibration.boards import BoardView
from rangesim.calibration.bundle import Bundle, Observation, adjust, reweighted
from rangesim.errors import warn
from rangesim.geometry.consensus import simpler_model_suffices
from rangesim.geometry.correspondences import Array
from rangesim.geometry.least_squares import Minimum
from rangesim.rig import Intrinsics
from rangesim.robust_scale import sigma_from_median

MAX_SIGMAS = 6.0
"""Largest error of a point, as a multiple of the robust standard deviation of a coordinate. Gaussian noise exceeds it
once in 10^8 points."""
MIN_ERROR_PX = 0.1
"""Error in pixels below which no point is suspect, even if there is less noise, because so small an error hardly moves
a calibration."""
MAX_NOISE_RATIO = 1.5
"""Largest ratio of the noise of a bundle of two devices to the noise of each device alone. Above it, some views of the
two devices contradict each other, even if no single point is suspect. A smaller ratio would cost good calibrations the
time of further adjustments; a larger one would miss some of such views."""
DEVICES = ("camera", "projector")
"""Names of the devices of a rig, by their number in `Observation.device`."""

MAX_COEFFICIENTS = 5
"""Largest number of coefficients of distortion of a lens, a count: k1, k2, p1, p2, k3, as in `Intrinsics`."""
MAX_SHIFT_SIGMAS = 2.0
"""Largest shift of a focal length or a principal point by distortion that is left out, in stated standard deviations.
Beyond two, the stated deviations do not describe the errors."""
ROUNDING_PX = 1e-6
"""Residual, in pixels, below which a point fits exactly, because only rounding is left. It is not 0, so that exact
points are not tested against a noise of 0."""


class Suspect(NamedTuple):
    """A point that does not fit the calibration.

    device : "camera" or "projector". view : number of the view. point : row of `Board.points`. error_px : reprojection
    error, pixels.

    Examples
    --------
    >>> Suspect("camera", view=3, point=17, error_px=12.5)
    Suspect(device='camera', view=3, point=17, error_px=12.5)
    """

    device: str
    view: int
    point: int
    error_px: float


def find_suspects(
    bundle: Bundle, observations: Sequence[Observation], views: Sequence[BoardView], noise: float, coefficients: int
) -> tuple[Suspect, ...]:
    """The points whose error is larger than noise explains, the worst first.

    Such a point may be a corner that was mistaken for another one, or that an edge beside it drew away. Or the board
    moved while it was captured, or an image has another size. One bad view spreads its errors over other views. So if
    any point is suspect, the function judges all points by the errors of `reweighted`, which stay with the bad view.

    Parameters
    ----------
    bundle : the result of least squares.
    observations, views : what the devices see, and the view of each observation.
    noise : ratio of the noise of a coordinate, from the residuals, to the stated noise.
    coefficients : number of free coefficients of distortion.
    """
    residuals = [bundle.project(seen) - seen.pixels for seen in observations]
    if not (_beyond(observations, views, residuals) or noise > MAX_NOISE_RATIO):
        return ()
    settled = reweighted(bundle, observations, coefficients)
    return _beyond(observations, views, [settled.project(seen) - seen.pixels for seen in observations])


def _beyond(
    observations: Sequence[Observation], views: Sequence[BoardView], residuals: Sequence[Array]
) -> tuple[Suspect, ...]:
    """The points of observations whose residuals (m, 2) are beyond `MAX_SIGMAS` and `MIN_ERROR_PX`, the worst first."""
    found = []
    for device in {seen.device for seen in observations}:
        of_device = [k for k, seen in enumerate(observations) if seen.device == device]
        robust = sigma_from_median(np.concatenate([residuals[k] for k in of_device]))
        limit = max(MAX_SIGMAS * robust, MIN_ERROR_PX)
        for k in of_device:
            errors = np.linalg.norm(residuals[k], axis=-1)
            found += [
                Suspect(DEVICES[device], observations[k].view, int(views[k].indices[i]), float(errors[i]))
                for i in np.flatnonzero(~(errors <= limit))
            ]
    return tuple(sorted(found, key=lambda suspect: -suspect.error_px))


def suspects_told(
    found: Minimum[Bundle],
    observations: Sequence[Observation],
    views: Sequence[BoardView],
    coefficients: int,
    names: Sequence[str],
) -> tuple[Suspect, ...]:
    """The points of `find_suspects`, with a warning that names the view of the worst one.

    If all points fit a lens with all coefficients of distortion, no point is suspect, and the warning asks for more
    free coefficients.

    Parameters
    ----------
    found : the result of `adjust` with this number of free `coefficients`.
    observations, views : what the devices see, and the view of each observation.
    names : names of the views, for the warning.
    """

    def suspects_of(minimum: Minimum[Bundle], free: int) -> tuple[Suspect, ...]:
        is_rig = len(minimum.state.devices) > 1
        noise = minimum.noise(minimum.jacobian.shape[1]) if is_rig else 1.0
        return find_suspects(minimum.state, observations, views, noise, free)

    if coefficients < MAX_COEFFICIENTS:
        full = adjust(found.state, observations, MAX_COEFFICIENTS)
        says = _missing_distortion(found, full, coefficients)
        if says is not None and not suspects_of(full, MAX_COEFFICIENTS):
            warn(says)
            return ()
    suspects = suspects_of(found, coefficients)
    _warn_of_suspects(suspects, names)
    return suspects


def _missing_distortion(found: Minimum[Bundle], full: Minimum[Bundle], coefficients: int) -> str | None:
    """The text of a warning if `found` leaves out distortion that changes its cameras; else None.

    It leaves such distortion out if all coefficients (`full`) explain the residuals significantly better, and move a
    focal length or a principal point by more than `MAX_SHIFT_SIGMAS`.
    """
    n = len(found.residuals)
    (simple, k), (fuller, more) = ((minimum.cost, minimum.jacobian.shape[1]) for minimum in (found, full))
    if n <= more or simpler_model_suffices((simple, n - k), (fuller, n - more), None, ROUNDING_PX):
        return None
    deviations = np.sqrt(np.diag(found.covariance(max(found.noise(k), ROUNDING_PX))))
    shifts = []
    for device, (was, now) in enumerate(zip(found.state.devices, full.state.devices, strict=True)):
        moved = _pinhole(now) - _pinhole(was)
        first = device * (4 + coefficients)
        relative = np.abs(moved) / deviations[first : first + 4]
        worst = int(np.argmax(relative))
        shifts.append((float(relative[worst]), float(moved[worst]), ("fx", "fy", "cx", "cy")[worst], DEVICES[device]))
    relative_shift, shift, parameter, name = max(shifts)
    if not relative_shift > MAX_SHIFT_SIGMAS:
        return None
    return (
        f"the residuals show distortion that {coefficients} free coefficients leave out: all {MAX_COEFFICIENTS} lower "
        f"the squared errors by {100 * (1 - fuller / simple):.0f} % and move {parameter} of the {name} by {shift:+.1f} "
        f"px, {relative_shift:.0f} times the standard deviation stated; free more coefficients."
    )


def _pinhole(device: Intrinsics) -> Array:
    """(4,) float64, fx, fy, cx, cy of a device, pixels."""
    return np.array([device.fx, device.fy, device.cx, device.cy])


def _warn_of_suspects(suspects: Sequence[Suspect], names: Sequence[str]) -> None:
    """Warn if there are suspect points, and name the view of the worst one."""
    if suspects:
        worst = suspects[0]
        views = sorted({suspect.view for suspect in suspects})
        more = f" ({len(suspects)} points of {len(views)} views in all)" if len(suspects) > 1 else ""
        warn(
            f"point {worst.point} of {names[worst.view]} is off by {worst.error_px:.1f} px in the {worst.device}, more "
            f"than noise can explain{more}; leave that view out."
        )
