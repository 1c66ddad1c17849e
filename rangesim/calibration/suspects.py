# SPDX-License-Identifier: Apache-2.0
"""Points of views that do not fit a calibration, and distortion that it leaves out, by more than noise can explain."""

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

LIMIT = 6.0
"""Robust standard deviations of a coordinate: noise goes beyond once in 10^8 points."""
LEAST_PX = 0.1
"""Errors below harm nobody, however little noise there is."""
MAX_NOISE = 1.5
"""Noise of a bundle over that of its devices by themselves, above which views contradict each other."""
DEVICES = ("camera", "projector")

COEFFICIENTS = 5
"""Largest number of coefficients of distortion that a lens has."""
MAX_SHIFT = 2.0
"""Standard deviations by which the distortion that is left out may move a focal length or a principal point."""
ROUNDING_PX = 1e-6
"""Residuals, in pixels, below which points fit exactly but for rounding."""


class Suspect(NamedTuple):
    """A point that does not fit. device : "camera" or "projector". view : its number. point : of `Board.points`.
    error_px : of reprojection."""

    device: str
    view: int
    point: int
    error_px: float


def find_suspects(
    bundle: Bundle, observations: Sequence[Observation], views: Sequence[BoardView], noise: float, coefficients: int
) -> tuple[Suspect, ...]:
    """Points whose error is beyond all noise, the worst first: a corner taken for another, or drawn away by an edge
    beside it; a board that moved while it was taken; an image of another size.

    One bad view bends the solution until others have errors too. So where any point is suspect, the errors are those
    of `reweighted`, which leaves them with the views that they come from.

    Parameters
    ----------
    bundle : of least squares. views : the points of each observation. noise : of a coordinate over what it should be,
        from the residuals.
    """
    residuals = [bundle.project(seen) - seen.pixels for seen in observations]
    if not (_beyond(observations, views, residuals) or noise > MAX_NOISE):
        return ()
    settled = reweighted(bundle, observations, coefficients)
    return _beyond(observations, views, [settled.project(seen) - seen.pixels for seen in observations])


def _beyond(
    observations: Sequence[Observation], views: Sequence[BoardView], residuals: Sequence[Array]
) -> tuple[Suspect, ...]:
    found = []
    for device in {seen.device for seen in observations}:
        of_device = [k for k, seen in enumerate(observations) if seen.device == device]
        robust = sigma_from_median(np.concatenate([residuals[k] for k in of_device]))
        limit = max(LIMIT * robust, LEAST_PX)
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
    """`find_suspects`, with a warning that names the view of the worst one.

    Where all points fit a lens with all coefficients of distortion, there are none, and the warning is of these.

    Parameters
    ----------
    found : of `adjust` with so many `coefficients`. views : the points of each observation. names : of the views.
    """

    def suspects_of(minimum: Minimum[Bundle], free: int) -> tuple[Suspect, ...]:
        is_rig = len(minimum.state.devices) > 1
        noise = minimum.noise(minimum.jacobian.shape[1]) if is_rig else 1.0
        return find_suspects(minimum.state, observations, views, noise, free)

    if coefficients < COEFFICIENTS:
        full = adjust(found.state, observations, COEFFICIENTS)
        says = _missing_distortion(found, full, coefficients)
        if says is not None and not suspects_of(full, COEFFICIENTS):
            warn(says)
            return ()
    suspects = suspects_of(found, coefficients)
    _warn_of_suspects(suspects, names)
    return suspects


def _missing_distortion(found: Minimum[Bundle], full: Minimum[Bundle], coefficients: int) -> str | None:
    """A sentence if all coefficients of distortion explain residuals that `found` leaves, and move its cameras by more
    than it states, None if not."""
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
    if not relative_shift > MAX_SHIFT:
        return None
    return (
        f"the residuals show distortion that {coefficients} free coefficients leave out: all {COEFFICIENTS} lower the "
        f"squared errors by {100 * (1 - fuller / simple):.0f} % and move {parameter} of the {name} by {shift:+.1f} px, "
        f"{relative_shift:.0f} times the standard deviation stated; free more coefficients."
    )


def _pinhole(device: Intrinsics) -> Array:
    return np.array([device.fx, device.fy, device.cx, device.cy])


def _warn_of_suspects(suspects: Sequence[Suspect], names: Sequence[str]) -> None:
    """A warning that names the view of the worst of them, if there are any."""
    if suspects:
        worst = suspects[0]
        views = sorted({suspect.view for suspect in suspects})
        more = f" ({len(suspects)} points of {len(views)} views in all)" if len(suspects) > 1 else ""
        warn(
            f"point {worst.point} of {names[worst.view]} is off by {worst.error_px:.1f} px in the {worst.device}, more "
            f"than noise can explain{more}; leave that view out."
        )
