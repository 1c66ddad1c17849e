# SPDX-License-Identifier: Apache-2.0
"""Points of views that do not fit a calibration, by more than noise can explain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangesim.calibration.boards import BoardView
from rangesim.calibration.bundle import Bundle, Observation, reweighted
from rangesim.errors import warn
from rangesim.geometry.correspondences import Array

LIMIT = 6.0
"""Robust standard deviations of a coordinate: noise goes beyond once in 10^8 points."""
LEAST_PX = 0.1
"""Errors below harm nobody, however little noise there is."""
MAX_NOISE = 1.5
"""Noise of a bundle over that of its devices by themselves, above which views contradict each other."""
DEVICES = ("camera", "projector")


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
        robust = 1.4826 * float(np.median(np.abs(np.concatenate([residuals[k] for k in of_device]))))
        limit = max(LIMIT * robust, LEAST_PX)
        for k in of_device:
            errors = np.linalg.norm(residuals[k], axis=-1)
            found += [
                Suspect(DEVICES[device], observations[k].view, int(views[k].indices[i]), float(errors[i]))
                for i in np.flatnonzero(~(errors <= limit))
            ]
    return tuple(sorted(found, key=lambda suspect: -suspect.error_px))


def warn_of_suspects(suspects: Sequence[Suspect], names: Sequence[str]) -> None:
    """A warning that names the view of the worst of them, if there are any."""
    if suspects:
        worst = suspects[0]
        views = sorted({suspect.view for suspect in suspects})
        more = f" ({len(suspects)} points of {len(views)} views in all)" if len(suspects) > 1 else ""
        warn(
            f"point {worst.point} of {names[worst.view]} is off by {worst.error_px:.1f} px in the {worst.device}, more "
            f"than noise can explain{more}; leave that view out."
        )
