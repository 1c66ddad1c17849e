# SPDX-License-Identifier: Apache-2.0
"""Start and direction of fringes, measured against the Gray code that they refine.

Fringes of several periods without a Gray code tell where they start: at a wrong start, their phases lie beside the
places on which they agree. They do not tell which way they move.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.codes import AxisFrames, Code, FringeConvention
from rangesim.codes.fringe_code import FringeCode
from rangesim.codes.fringe_direction import phase_direction
from rangesim.codes.fringes import usual_starts
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.pixel_samples import MIN_PIXELS
from rangesim.decoding.status import Status
from rangesim.sensors import StructuredLight, StructuredLightDecoder

ORIGINS_PX = {0.0: "at the edge of the first pixel", 0.5: "at the centre of the first pixel",
              -0.5: "half a pixel before the first one, whose number is 1"}  # fmt: skip
"""Places of phase 0 that are in use, in projector pixels. Programs that count pixels from 1 (MATLAB) take the last."""

MIN_CONCENTRATION = 0.8
"""Least length of the mean vector of phase minus place, as a fraction of that of an even distribution over a Gray cell,
at which fringes count as following the code. For fringes in the other direction it is near 0."""

MAX_CELL_TURNS = 0.75
"""Largest Gray cell, in periods of the fringes, whose inside tells where they start. The mean vector of phase minus
place over a cell has the length sinc(cell / period): 0.3 here, and 0 if the cell is a period, because all phases occur
alike. Of larger cells, the edges tell."""

MAX_SIDE = 480
"""Largest side in pixels of the part of the image in which contradictions are looked for, so that the time is bounded.
They compare neighbours, so the part has all its pixels."""

MIN_AGREEMENT = 0.5
"""Least agreement of the directions of phases and cells, from -1 to 1, at which fringes count as running that way. It
is near 1 or -1 if noise is small against the step of the phase from pixel to pixel."""

MAX_REST_PX = 0.2
"""Largest distance of the measured start from one of the usual ones, in projector pixels, at which it counts as that
one. Usual ones are half a pixel apart; sound captures measure theirs to 0.1 pixels."""

MAX_EDGE_TURNS = 0.01
"""Distance of the start that the edges of cells tell from a usual one, in turns, at which it may still be that one: the
edges of a real capture lie up to 0.03 turns off, their mean 0.006. Of long periods they do not tell half a pixel; then
the origin stays as given."""

MIN_SIGMAS = 5.0
"""Least distance of a measured start from the given one, in standard errors of the mean of that many pixels, at which
the start is changed. Neighbours are not independent, so it is more than the usual three."""

MIN_SWING = 0.1
"""Least swing of the pixels whose phases are compared, as a fraction of that of the bright pixels. Others may lie in
shadow, where phases are noise."""

MAX_BIAS_TURNS = 0.005
"""Largest bias of the phases of several periods, in turns (`FringeStack.bias_turns`), at which fringes count as
starting where they should. Sound fringes have 0.001 (measured); heterodyne fringes that start a quarter of a period
elsewhere have 0.25 times the relative difference of their periods, 0.02 for 70 and 64 fringes."""

MAX_BIAS_RATIO = 0.3
"""Largest bias at another start, as a fraction of that at the given one, at which the start is changed."""


class _Offsets(NamedTuple):
    """Phases of some pixels, and their Gray cells.

    phase, cell : (n,) turns, `cell` of the centre of the cell or of its edge. agreement : 1 if the phases grow from
    pixel to pixel as their cells do, -1 if the other way, 0 if neighbours do not tell. half_turns : half the width of
    the places that one `cell` stands for, in turns. period_px : projector pixels. largest_rest_px : distance from a
    usual start, in projector pixels, up to which the fringes count as starting there. steps : number of the fringes.
    """

    phase: np.ndarray
    cell: np.ndarray
    agreement: float
    half_turns: float
    period_px: float
    steps: int
    largest_rest_px: float = MAX_REST_PX

    def off(self, convention: FringeConvention) -> np.ndarray:
        """(n,) turns, -0.5 to 0.5, the place that the phase tells minus the centre of the Gray cell."""
        turns = convention.place_turns(self.phase, self.period_px) - self.cell
        return np.asarray(turns - np.rint(turns))


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
    if not isinstance(given, FringeConvention):
        return code, ()
    if isinstance(code, FringeCode):
        started = with_own_start(sample, sensor).code
        return started, tuple(_differences(started.convention, given))  # type: ignore[attr-defined]
    period_px = getattr(code, "period_px", None)
    if not isinstance(period_px, float):
        return code, ()
    found = {_measured(offsets, given) for offsets in _all_offsets(middle_of(frames), sensor, period_px)}
    if len(found) != 1 or None in found or found == {given}:
        return code, ()
    convention = found.pop()
    assert convention is not None
    other: Code = replace(code, convention=convention)  # type: ignore[type-var]
    said, still = contradictions(frames, sensor), contradictions(frames, replace(sensor, code=other))
    if len(still) >= len(said) and (still or convention.direction != given.direction):
        return code, ()  # something else is wrong; and fringes that move the other way are always contradicted
    return other, tuple(_differences(convention, given))


def with_own_start(frames: np.ndarray, sensor: StructuredLight) -> StructuredLight:
    """The sensor with the usual start at which its fringes of several periods agree; `sensor` if they do so as given.

    Parameters
    ----------
    frames : (k, h, w), some of the pixels of all frames.
    """
    code = sensor.code
    given = getattr(code, "convention", None)
    if not isinstance(code, FringeCode) or not isinstance(given, FringeConvention):
        return sensor
    decoder = StructuredLightDecoder()
    seen = decoder.axis_frames(Capture(frames, sensor))
    stacks = [code.stack(one.size) for one in seen]
    used = [_is_bright(one) for one in seen]
    if min(len(stack.steps) for stack in stacks) < 2 or min(map(np.count_nonzero, used)) < MIN_PIXELS:
        return sensor
    phases = [
        [phase_of(stack.of_period(one.frames, i)[:, lit]).normalised for i in range(len(stack.steps))]
        for one, stack, lit in zip(seen, stacks, used, strict=True)
    ]
    biases: dict[FringeConvention, float] = {}
    steps = math.lcm(*(n for stack in stacks for n in stack.steps))
    for start in (given.start, *usual_starts(steps)):
        here = replace(given, start=start)  # type: ignore[arg-type]
        biases[here] = max(
            stack.bias_turns([here.place_turns(t, p) for t, p in zip(turns, stack.periods_px, strict=True)], one.size)
            for one, stack, turns in zip(seen, stacks, phases, strict=True)
        )
    best = min(biases, key=lambda convention: biases[convention])
    rivals = [c for c, bias in biases.items() if c != best and bias < biases[best] / MAX_BIAS_RATIO]
    if rivals or not biases[best] < min(MAX_BIAS_TURNS, MAX_BIAS_RATIO * biases[given]):
        return sensor
    return replace(sensor, code=replace(code, convention=best))  # type: ignore[type-var]


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
    """Phases and Gray cells along each axis, where both are clear; of wide cells, phases at their edges."""
    decoder = StructuredLightDecoder()
    for seen in decoder.axis_frames(Capture(frames, sensor)):
        code = sensor.code.decode(seen, decoder.thresholds)
        gray, fringes = code.coarse, seen.starting_with("phase" if "phase0" in seen.names else "period0_")
        steps = len(fringes.frames)
        if gray is None or not steps:
            continue
        is_strong = (code.status == Status.OK) | (code.status == Status.CODE_ERROR)
        clear = is_strong & (gray.status == Status.OK) & _is_bright(seen)
        used = clear & ((gray.coordinate / gray.cell_px) % 1 == 0.5)
        phase, steps = phase_of(fringes.frames).normalised, len(fringes.frames)
        agreement = phase_direction(fringes.frames, gray, used, period_px)
        if gray.cell_px > MAX_CELL_TURNS * period_px:
            phase, place_px = _at_edges(phase, np.where(clear, gray.coordinate, np.float32(np.nan)), gray.cell_px)
            turns, rest_px = place_px / np.float32(period_px), max(MAX_REST_PX, MAX_EDGE_TURNS * period_px)
            yield _Offsets(phase, turns, agreement, 0.25, period_px, steps, rest_px)  # within a quarter of a period
            continue
        turns = gray.coordinate[used] / np.float32(period_px)
        yield _Offsets(phase[used], turns, agreement, gray.cell_px / (2 * period_px), period_px, steps)


def _is_bright(seen: AxisFrames) -> np.ndarray:
    """(h, w) bool, where the difference of white and black is not that of a shadow."""
    return np.asarray(seen.contrast.values > MIN_SWING * bright_level(seen.contrast.values))


def _at_edges(phase: np.ndarray, place_px: np.ndarray, cell_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Phases (n,) of pixels on the edges of cells and on both sides of them, and the places (n,) of these edges.

    Parameters
    ----------
    phase : (h, w) turns. place_px : (h, w) centres and edges of cells in projector pixels, NaN where not known.
    """
    on_edge = (place_px / cell_px) % 1 == 0
    phases, edges = [phase[on_edge]], [place_px[on_edge]]
    for axis in (0, 1):
        near, far = np.moveaxis(place_px, axis, 0)[:-1], np.moveaxis(place_px, axis, 0)[1:]
        between = (np.abs(far - near) == cell_px) & ((near / cell_px) % 1 == 0.5)  # False for NaN
        along = np.moveaxis(phase, axis, 0)
        phases += [along[:-1][between], along[1:][between]]
        edges += [(near + far)[between] / 2] * 2
    return np.concatenate(phases), np.concatenate(edges)


def _measured(offsets: _Offsets, given: FringeConvention) -> FringeConvention | None:
    """The usual convention that the phases of an axis follow, `given` if that is it; None if they follow none."""
    if len(offsets.phase) < MIN_PIXELS:
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
        rest_px = {c: abs(_rest_px(c, here, off_px, offsets.period_px)) for c in _usual(here, offsets.steps)}
        best = min(rest_px, key=lambda c: rest_px[c])
        if offsets.largest_rest_px > MAX_REST_PX:  # half a pixel may not be told
            best = min(rest_px, key=lambda c: (rest_px[c] > offsets.largest_rest_px, c.origin_px != given.origin_px))
        if rest_px[best] > offsets.largest_rest_px:
            return None
        spread_px = float(np.sqrt(-2 * np.log(abs(vector)))) / (2 * np.pi) * offsets.period_px
        is_clear = abs(off_px) > MIN_SIGMAS * spread_px / np.sqrt(len(offsets.phase))
        return best if is_clear or direction != given.direction else given
    return None


def _usual(given: FringeConvention, steps: int) -> Iterator[FringeConvention]:
    """The given convention first, then all usual ones in its direction of fringes of so many steps."""
    yield given
    for start in usual_starts(steps):
        for origin_px in ORIGINS_PX:
            yield FringeConvention(start, given.direction, origin_px)  # type: ignore[arg-type]


def _rest_px(other: FringeConvention, given: FringeConvention, off_px: float, period_px: float) -> float:
    """The rest of the offset `off_px`, seen with the convention `given`, if the fringes follow `other`."""
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
        place = ORIGINS_PX[found.origin_px]
        yield f"phase 0 of the fringes lies {place} (convention.origin_px = {found.origin_px:g})."
