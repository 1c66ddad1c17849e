# SPDX-License-Identifier: Apache-2.0
"""Where fringes start and which way they move, measured against the Gray code that they refine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from rangesim.capture import Capture
from rangesim.codes import Code, FringeConvention
from rangesim.codes.fringe_direction import phase_direction
from rangesim.codes.fringes import STARTS
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.pixel_samples import MIN_PIXELS
from rangesim.decoding.status import Status
from rangesim.sensors import StructuredLight, StructuredLightDecoder

ORIGINS_PX = (0.0, 0.5)
"""Places of phase 0 that are in use, in projector pixels: the edge of the first pixel, and its centre."""

MIN_CONCENTRATION = 0.8
"""Least length of the mean vector of phase minus place, as a fraction of that of an even distribution over a Gray cell,
at which fringes count as following the code. For fringes in the other direction it is near 0."""

MAX_CELL_TURNS = 0.75
"""Largest Gray cell, in periods of the fringes, that tells where they start. The mean vector of phase minus place over
a cell has the length sinc(cell / period): 0.3 here, and 0 if the cell is a period, because all phases occur alike."""

MAX_SIDE = 480
"""Largest side in pixels of the part of the image in which contradictions are looked for, so that the time is bounded.
They compare neighbours, so the part has all its pixels."""

MIN_AGREEMENT = 0.5
"""Least agreement of the directions of phases and cells, from -1 to 1, at which fringes count as running that way. It
is near 1 or -1 if noise is small against the step of the phase from pixel to pixel."""

MAX_REST_PX = 0.2
"""Largest distance of the measured start from one of the usual ones, in projector pixels, at which it counts as that
one. Usual ones are half a pixel apart; sound captures measure theirs to 0.1 pixels."""

MAX_OUTSIDE_RATIO = 0.5
"""Largest number of phases outside their Gray cell in another convention, as a fraction of that in the given one, at
which the convention is changed. Phases that are where they should be lie outside by noise alone in both."""

EDGE_TURNS = 0.005
"""Least distance of a phase from its Gray cell, in turns, at which it counts as outside; it allows for rounding."""


class _Offsets(NamedTuple):
    """Phases of some pixels, and their Gray cells.

    phase, cell : (n,) turns. agreement : 1 if the phases grow from pixel to pixel as their cells do, -1 if the other
    way, 0 if neighbours do not tell. half_turns : half a cell, in turns. period_px : projector pixels.
    """

    phase: np.ndarray
    cell: np.ndarray
    agreement: float
    half_turns: float
    period_px: float

    def off(self, convention: FringeConvention) -> np.ndarray:
        """(n,) turns, -0.5 to 0.5, the place that the phase tells minus the centre of the Gray cell."""
        turns = convention.place_turns(self.phase, self.period_px) - self.cell
        return np.asarray(turns - np.rint(turns))

    def outside(self, convention: FringeConvention) -> float:
        """Fraction of the phases outside their Gray cell."""
        return float((np.abs(self.off(convention)) > self.half_turns + EDGE_TURNS).mean())


def measured_fringes(frames: np.ndarray, sample: np.ndarray, sensor: StructuredLight) -> tuple[Code, tuple[str, ...]]:
    """The sensor's code with the convention that its fringes follow, and sentences on what differs from its own.

    A code without fringes over a Gray code is returned as it is, and so is one whose fringes start nowhere usual: its
    decoder tells by how much they are off.

    Parameters
    ----------
    frames : (k, h, w), all frames of the sensor in its order. sample : (k, i, j), some of their pixels.
    """
    code = sensor.code
    given = getattr(code, "convention", None) if "convention" in {f.name for f in fields(code)} else None  # type: ignore[arg-type]
    period_px = getattr(code, "period_px", None)
    if not isinstance(given, FringeConvention) or not isinstance(period_px, float):
        return code, ()
    found = {_measured(offsets, given) for offsets in _all_offsets(sample, sensor, period_px)}
    if len(found) != 1 or None in found or found == {given}:
        return code, ()
    convention = found.pop()
    assert convention is not None
    other: Code = replace(code, convention=convention)  # type: ignore[type-var]
    still = contradictions(frames, replace(sensor, code=other))
    if still and len(still) >= len(contradictions(frames, sensor)):
        return code, ()  # something else is wrong
    return other, tuple(_differences(convention, given))


def middle_of(frames: np.ndarray) -> np.ndarray:
    """(k, i, j) float32, all pixels in the middle of frames (k, h, w)."""
    y, x = (slice(max(0, (size - MAX_SIDE) // 2), (size + MAX_SIDE) // 2) for size in frames.shape[1:])
    return frames[:, y, x].astype(np.float32)


def contradictions(frames: np.ndarray, sensor: StructuredLight) -> list[str]:
    """Sentences on what contradicts the sensor's code as a whole, in the middle of frames (k, h, w)."""
    decoder = StructuredLightDecoder()
    axes = decoder.axis_frames(Capture(middle_of(frames), sensor))
    found = (sensor.code.contradiction(seen, sensor.code.decode(seen, decoder.thresholds)) for seen in axes)
    return [text for text in found if text]


def _all_offsets(frames: np.ndarray, sensor: StructuredLight, period_px: float) -> Iterator[_Offsets]:
    """Phases and Gray cells along each axis, where both are clear."""
    decoder = StructuredLightDecoder()
    for seen in decoder.axis_frames(Capture(frames, sensor)):
        code = sensor.code.decode(seen, decoder.thresholds)
        gray, fringes = code.coarse, seen.starting_with("phase")
        if gray is None or not len(fringes.frames):
            continue
        inside = (gray.coordinate / gray.cell_px) % 1 == 0.5
        is_strong = (code.status == Status.OK) | (code.status == Status.CODE_ERROR)
        used = inside & is_strong & (gray.status == Status.OK)
        phase = phase_of(fringes.frames).normalised
        yield _Offsets(
            phase[used],
            gray.coordinate[used] / np.float32(period_px),
            phase_direction(fringes.frames, gray, used, period_px),
            gray.cell_px / (2 * period_px),
            period_px,
        )


def _measured(offsets: _Offsets, given: FringeConvention) -> FringeConvention | None:
    """The convention that the phases of an axis follow, `given` if they agree with it; None if they follow none."""
    if len(offsets.phase) < MIN_PIXELS or 2 * offsets.half_turns > MAX_CELL_TURNS:
        return None
    expected = float(np.sinc(2 * offsets.half_turns))
    for direction, sign in (("forward", 1), ("backward", -1)):
        if sign * offsets.agreement < MIN_AGREEMENT:
            continue
        here = replace(given, direction=direction)  # type: ignore[arg-type]
        vector = np.exp(2j * np.pi * offsets.off(here).astype(np.float64)).mean()
        if abs(vector) < MIN_CONCENTRATION * expected:
            continue
        off_px = float(np.angle(vector)) / (2 * np.pi) * offsets.period_px
        best = min(_usual(here), key=lambda c: abs(_rest_px(c, here, off_px, offsets.period_px)))
        if abs(_rest_px(best, here, off_px, offsets.period_px)) > MAX_REST_PX:
            return None
        is_turned = direction != given.direction  # its mirror image in each cell may leave no phase outside
        if not is_turned and (best == given or offsets.outside(best) > MAX_OUTSIDE_RATIO * offsets.outside(given)):
            return given
        return best
    return None


def _usual(given: FringeConvention) -> Iterator[FringeConvention]:
    """The given convention first, then all usual ones in its direction."""
    yield given
    for start in STARTS:
        for origin_px in ORIGINS_PX:
            yield FringeConvention(start, given.direction, origin_px)  # type: ignore[arg-type]


def _rest_px(other: FringeConvention, given: FringeConvention, off_px: float, period_px: float) -> float:
    """What is left of the offset `off_px`, seen with the convention `given`, if the fringes follow `other`."""
    change_px = (other.shift_turns(0, 1, period_px) - given.shift_turns(0, 1, period_px)) * period_px
    rest = off_px + change_px
    return rest - period_px * round(rest / period_px)


def _differences(found: FringeConvention, given: FringeConvention) -> Iterator[str]:
    """Sentences on what of a convention differs from the given one."""
    if found.start != given.start:
        yield f"the fringes start as {found.start} (convention.start = {found.start})."
    if found.direction != given.direction:
        way = "larger" if found.direction == "forward" else "smaller"
        yield f"the fringes move towards {way} pixels (convention.direction = {found.direction})."
    if found.origin_px != given.origin_px:
        place = {0.0: "at the edge", 0.5: "at the centre"}[found.origin_px]
        yield f"phase 0 of the fringes lies {place} of the first pixel (convention.origin_px = {found.origin_px:g})."
