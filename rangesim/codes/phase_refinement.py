# SPDX-License-Identifier: Apache-2.0
"""Places of fringes: their phase refines a coarser code to fractions of a projector pixel."""

from __future__ import annotations

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.fringe_gamma import gamma_of
from rangesim.codes.fringes import FringeConvention
from rangesim.decoding.phase_shift import PhaseThresholds, modulation_is_weak, phase_of, phase_sigma
from rangesim.decoding.row_bands import in_bands
from rangesim.decoding.status import Status


def refine_by_phase(
    seen: AxisFrames,
    gray: AxisCode,
    period_px: float,
    convention: FringeConvention,
    least_swing: np.ndarray,
    thresholds: PhaseThresholds,
) -> AxisCode:
    """Sub-pixel coordinate: of all places with the phase of the fringes, the one nearest to the Gray coordinate.

    The right place lies at most half a cell off the centre of its cell. An eighth of a period more is allowed for noise
    and for camera pixels across the edge of a cell. If the place lies farther off, code and phase contradict each other
    (`CODE_ERROR`). If the cells are larger than half a period, so is a place that may belong to two cycles: one whose
    next cycle lies within that range, too. The phases are corrected for the gamma that the fringes show.

    Parameters
    ----------
    seen : frames (N, h, w), the fringes of the axis. gray : code of the same axis.
    period_px : float, projector pixels. convention : FringeConvention of the fringes.
    least_swing : (h, w) float, least difference between the brightest and the darkest fringe, in the capture's units.
    """
    capture, frames = seen.capture, seen.frames
    coordinate, status = np.empty_like(gray.coordinate), gray.status.copy()
    sigma_px = None if capture.noise(frames[0, :1]) is None else np.empty_like(gray.coordinate)
    saturated = capture.saturated(frames)
    gamma = gamma_of(frames, (status == Status.OK) & ~saturated, seen.contrast.values)
    reach = gray.cell_px / 2 + period_px / 8
    if gray.cell_px <= period_px:  # coarser cells are those of a place that fringes have refined before
        reach = min(reach, period_px - reach)  # a place that is farther off has a second cycle within the range

    def refine_rows(rows: slice) -> None:
        measured = phase_of(frames[:, rows])
        phase = gamma.corrected(measured, len(frames))
        whole, refused = gray.coordinate[rows], status[rows]
        sigma = phase_sigma(capture, phase, len(frames), gamma.slope(measured, len(frames)))
        place = convention.place_turns(phase.normalised, period_px)
        periods = np.rint(whole / np.float32(period_px) - place)
        coordinate[rows] = (periods + place) * np.float32(period_px)
        ok = refused == Status.OK
        contradiction = np.abs(coordinate[rows] - whole) > reach
        washed_out = 2 * phase.modulation < least_swing[rows]  # like fringes that are seen by interreflection alone
        refused[ok & contradiction] = Status.CODE_ERROR
        refused[ok & (modulation_is_weak(capture, phase, sigma, thresholds) | washed_out)] = Status.LOW_SIGNAL
        refused[ok & saturated[rows]] = Status.SATURATED
        if sigma_px is not None and sigma is not None:
            np.multiply(sigma, period_px / (2 * np.pi), out=sigma_px[rows], casting="same_kind")

    in_bands(refine_rows, len(status))
    return AxisCode(coordinate, status, gray.cell_px, sigma_px, gray, (gamma,))
