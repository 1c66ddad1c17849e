# SPDX-License-Identifier: Apache-2.0
"""The convention of a stack of frames: the settings of its sensor with which the frames agree best.

Many orders of the same frames are in use. Cheap tests leave a few of them: which frames are brightest and darkest
everywhere, which add up to the same sum, and along which side of the image and how finely each changes. Those that are
left are decoded on some of the pixels; in the right order, neighbouring pixels see neighbouring places.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rangesim.capture import Capture, bright_level
from rangesim.codes import AXES, AxisCode
from rangesim.codes.code import MAX_BEYOND_PROJECTOR, MAX_LEFT_OUTSIDE
from rangesim.conventions.fringe_conventions import measured_fringes, middle_of, with_own_start
from rangesim.conventions.layouts import (
    ENDS,
    INVERSE,
    INVERSES,
    Layout,
    kinds,
    layouts,
    refined_kinds,
    variations,
    with_layout,
)
from rangesim.decoding.orientation import is_mirrored
from rangesim.decoding.pixel_samples import MIN_PIXELS
from rangesim.decoding.status import Status
from rangesim.sensors import StructuredLight, StructuredLightDecoder
from rangesim.sensors.structured_light import BLACK, WHITE

MAX_SAMPLE = 20_000
"""Largest number of pixels on which orders are tried: about a fifteenth of an image of 640 x 480. A few hundred pixels
tell orders from each other."""

TILE = 16
"""Side of a tile of the sample in pixels. Pixels within a tile are true neighbours, whose fringes are not a period
apart; one pair in sixteen lies across the edge of a tile, which loses as much in every order."""

MIN_SWING = 0.1
"""Least swing of a pixel in all frames that is looked at, as a fraction of that of the bright pixels. Pixels that swing
less may be in shadow."""

MAX_END_ERROR = 0.2
"""Largest distance of a white or black frame from a pixel's brightest or darkest value, as a fraction of its swing. It
allows for noise; a pattern differs by the whole swing where it is dark."""

MIN_END_FRACTION = 0.9
"""Least fraction of the pixels at which a white or black frame is the brightest or darkest. A pattern is at half of
them, and at more only if few of its stripes are in view."""

MAX_PAIR_ERROR = 0.25
"""Largest mean difference between the sum of a pattern and its inverse and that of the brightest and the darkest value,
as a fraction of the swing. It is 0 for a pair that is in focus and 0.5 for two frames that are no pair."""

MAX_PAIR_PIXELS = 1000
"""Largest number of pixels on which all pairs of frames are compared, so that the time is bounded; they tell the mean
difference to 2 %."""

MAX_LIKENESS_LOSS = 0.15
"""Largest loss against the best order, in the cosine between the fineness of the frames and that of the patterns, at
which an order is still tried. An exchange of two axes, or of coarse and fine, loses 0.5 and more."""

MAX_TRIED = 12
"""Largest number of orders that are decoded, so that the time is bounded. After the cheap tests, two to eight are left
in all captures that were tried."""

MIN_GAIN_BITS = 0.4
"""Least gain of another order over the given one, in bits (see `_agreement_bits`), at which the order is changed. Two
orders that are equally right differ by less than 0.1 bits, a wrong one and the right one by about 1."""

MIN_BITS = 0.7
"""Least agreement of neighbours in bits at which frames count as decoded in an order. In a wrong order it is near 0, in
the right one above 1 if more than four cells are in view."""

DECODED_BITS = 1.0
"""Agreement of neighbours in bits above which frames count as decoded in the given order, where a pattern is all bright
or all dark in view. Then less than half of the projector is seen, and orders that miss this pattern are as smooth: with
10 % of wrong words in views of an eighth, 12 of 18 sound captures were reordered."""

MIN_STEP = 0.5
"""Least distance of two pixels that see different cells, in cells: a pixel on the edge of two cells is half a cell off
both."""

MIN_SUBPIXEL_FRACTION = 0.5
"""Least fraction of the places that are neither the centre nor the edge of a cell, at which a code counts as sub-pixel:
of bits none is, of fringes nearly all are."""

MAX_LOSS_BITS = 0.2
"""Largest loss against the best order, in bits, at which a more usual order is taken. Two orders that are equally right
differ by less than 0.1 bits."""

MAX_ENTRIES = 6
"""Largest number of entries of an order that a finding repeats, so that it stays readable."""


@dataclass(frozen=True)
class Convention:
    """Convention in which frames were taken, as they show it.

    sensor : StructuredLight with the settings that the frames agree with.
    findings : sentences, one for each setting that differs from those given; none if nothing does.
    """

    sensor: StructuredLight
    findings: tuple[str, ...] = ()


class _Sample(NamedTuple):
    """Some of the pixels of a stack of frames.

    frames : (k, h, w) float32, pixels of tiles that are spread over the image; tiles stand side by side.
    is_lit : (h, w) bool, where they swing.
    high, low : (h, w) float32, the brightest and the darkest value of each pixel.
    across, down : (k,) mean change of each frame from a pixel to the next, along and down the image at full resolution.
    """

    frames: np.ndarray
    is_lit: np.ndarray
    high: np.ndarray
    low: np.ndarray
    across: np.ndarray
    down: np.ndarray


def detect_convention(frames: np.ndarray, sensor: StructuredLight) -> Convention:
    """The settings of a sensor with which frames agree best; its code is not changed but for where its fringes start.

    Parameters
    ----------
    frames : (k, h, w) of any number type, in the order in which they were taken; k may differ from the number of frames
        that the sensor expects, where frames are missing that the code does not need.
    sensor : StructuredLight as the user described it.

    Raises
    ------
    ValueError
        No convention of the sensor's code has as many frames, or none with as many decodes these.

    Examples
    --------
    >>> sensor = StructuredLight(64, 48, code="gray")
    >>> shown = sensor.patterns()  # as a camera sees them that looks straight at the screen
    >>> detect_convention(np.concatenate([shown[-2:], shown[:-2]]), sensor).findings
    ('white and black come first.', 'this is the order white, black, *.')
    """
    is_given = len(frames) == sensor.n_frames
    orders = list(layouts(sensor, len(frames)))
    sample = _sampled(frames)
    if not is_given and not orders:
        raise ValueError(_wrong_number(len(frames), sensor, sample) + _square(len(frames), sensor))
    found = sensor
    layout: Layout | None = None
    if np.count_nonzero(sample.is_lit) >= MIN_PIXELS:
        layout = _best_layout(sample, sensor, orders, is_given)
        if layout is not None:
            found = with_layout(sensor, layout)
        found = _upright(frames, sample, found)
    elif not is_given:
        raise ValueError(
            f"{_wrong_number(len(frames), sensor, sample)[:-1]}; and they are too dark to tell which are missing."
        )
    findings = _order_findings(layout, sensor, found)
    if layout is None and found.axes != sensor.axes:
        findings.insert(0, f"{found.axes[0]} were shown before {found.axes[1]}.")
    found, said_of_places = _within_projector(sample, found)
    code, said = measured_fringes(frames, sample.frames, found)
    found = replace(found, code=code)
    return Convention(found, (*findings, *said_of_places, *said))


def detect_order(frames: np.ndarray, sensor: StructuredLight) -> Convention:
    """The sensor with another order of its frames, if the frames agree clearly better with that one; else unchanged.

    Parameters
    ----------
    frames : (k, h, w) of any number type, as many as the sensor has frames.
    sensor : StructuredLight with the order and the code in which its patterns were shown.

    Examples
    --------
    >>> sensor = StructuredLight(64, 48, code="gray")
    >>> detect_order(sensor.patterns()[::-1], sensor).findings[0]
    'black and white come first, black before white.'
    """
    sample = _sampled(frames)
    if np.count_nonzero(sample.is_lit) < MIN_PIXELS:
        return Convention(sensor)
    layout = _best_layout(sample, sensor, list(layouts(sensor, len(frames))), is_given=True)
    if layout is None:
        return Convention(sensor)
    found = _upright(frames, sample, with_layout(sensor, layout))
    return Convention(found, tuple(_order_findings(layout, sensor, found)))


def _order_findings(layout: Layout | None, sensor: StructuredLight, found: StructuredLight) -> list[str]:
    """Sentences on what of an order differs from that of the sensor; none without a layout."""
    findings = [] if layout is None else list(_differences(layout, sensor, found))
    if found.order != sensor.order and 0 < len(found.order) <= MAX_ENTRIES:
        findings.append(f"this is the order {', '.join(found.order)}.")
    if layout is not None and not findings:
        names = found.frame_names()
        findings.append(f"this is the order {', '.join(names[:MAX_ENTRIES])}, ... {names[-1]}.")
    return findings


def _wrong_number(n: int, sensor: StructuredLight, sample: _Sample) -> str:
    """The sentence that says that no order of the code has that many frames, and of which pair one is missing."""
    names = sensor.frame_names()
    lost = _lost_of_pair(sample, sensor)
    return (
        f"expected {len(names)} images for {sensor.code.details} ({names[0]} ... {names[-1]}), got {n}"
        f"{f'; the image of {lost} or of its inverse seems to be missing' if lost else ''}."
    )


def _square(n: int, sensor: StructuredLight) -> str:
    """A sentence if a projector that is as high as wide has that many frames; "" if not."""
    side = max(sensor.projector_width, sensor.projector_height)
    square = replace(sensor, projector_width=side, projector_height=side, order=())
    if len(sensor.axes) < 2 or next(layouts(square, n), None) is None:
        return ""
    return f" A projector of {side}x{side} has as many: some programs show as many bits along rows as along columns."


def _sampled(frames: np.ndarray) -> _Sample:
    """Pixels on a grid over the image, and how much each frame changes from pixel to pixel."""
    stride = max(1, int(np.ceil(np.sqrt(frames[0].size / MAX_SAMPLE))))
    y, x = (np.flatnonzero(np.arange(n) // TILE % stride == 0) for n in frames.shape[1:])
    few = frames[:, y][:, :, x].astype(np.float32)  # not digital, so that thresholds are relative
    high, low = few.max(axis=0), few.min(axis=0)
    swing = high - low
    is_lit = swing > MIN_SWING * bright_level(swing)
    skip = stride * stride
    across, down = frames[:, ::skip], frames[:, :, ::skip]
    return _Sample(
        few,
        is_lit,
        high,
        low,
        np.array([np.abs(np.diff(frame.astype(np.float32), axis=1)).mean() for frame in across]),
        np.array([np.abs(np.diff(frame.astype(np.float32), axis=0)).mean() for frame in down]),
    )


# ---- Order of the frames ---------------------------------------------------------------------------------------------


def _best_layout(sample: _Sample, sensor: StructuredLight, orders: Sequence[Layout], is_given: bool) -> Layout | None:
    """The layout in which the frames decode best; None if it is the given one.

    Raises
    ------
    ValueError
        The given order has another number of frames, and no other order decodes them.
    """
    given = sensor.frame_names() if is_given else None
    fineness, ends = _fineness(sensor), {ends: _ends_fit(sample, _at_ends(*ends)) for ends in ENDS}
    possible = []
    for layout in orders:
        if not ends[layout.ends]:
            continue
        names = layout.names(sensor)
        likeness = _likeness(sample, fineness, names)  # negative: the camera would be turned by 90 degrees
        if names != given and (likeness > 0 or layout.axes == sensor.axes) and _pairs_fit(sample, names):
            possible.append((abs(likeness), layout))
    best = max((likeness for likeness, _ in possible), default=0.0)
    scores: list[tuple[float, Layout]] = []
    for likeness, layout in possible:
        if likeness >= best - MAX_LIKENESS_LOSS and len(scores) < MAX_TRIED:
            try:
                scores.append((_agreement_bits(sample, with_layout(sensor, layout)), layout))
            except ValueError:  # the code needs frames that are missing in this layout
                continue
    highest = max((score for score, _ in scores), default=0.0)
    score, layout = next((found for found in scores if found[0] >= highest - MAX_LOSS_BITS), (0.0, Layout(sensor.axes)))
    if given is not None:
        # White and black that are exchanged cost fringes nothing, because their phases tell the place without them.
        fits = _ends_fit(sample, [(i, name) for i, name in enumerate(given) if name in (WHITE, BLACK)])
        bits = _agreement_bits(sample, sensor)
        if fits and bits > DECODED_BITS and _has_even_pattern(sample, given):
            return None
        least = bits + (MIN_GAIN_BITS if fits else -MAX_LOSS_BITS)
        return layout if score > max(MIN_BITS, least) else None
    if score < MIN_BITS:
        raise ValueError(
            f"{_wrong_number(len(sample.frames), sensor, sample)[:-1]}; and in no order that misses some of them do "
            "neighbouring pixels see neighbouring places."
        )
    return layout


def _lost_of_pair(sample: _Sample, sensor: StructuredLight) -> str | None:
    """Name of the pattern of which an image, or that of its inverse, is missing; None if that cannot be told.

    All other pairs of pattern and inverse add up to the same sum only if the gap is in its right place.
    """
    if np.count_nonzero(sample.is_lit) < MIN_PIXELS:
        return None
    fineness, error = _fineness(sensor), _pair_errors(sample)
    ends = {ends: _ends_fit(sample, _at_ends(*ends)) for ends in ENDS}
    found: dict[str, float] = {}
    for layout in layouts(sensor, len(sample.frames) + 1):
        names = layout.names(sensor)
        for name in names if ends[layout.ends] else ():
            rest = [other for other in names if other != name]
            places = {other: i for i, other in enumerate(rest)}
            pairs = [(i, places[other + INVERSE]) for other, i in places.items() if other + INVERSE in places]
            worst = max((error[i, j] for i, j in pairs), default=1.0)
            is_of_pair = name.endswith(INVERSE) or name + INVERSE in names
            if is_of_pair and worst < MAX_PAIR_ERROR:
                pattern = name.removesuffix(INVERSE)
                found[pattern] = max(found.get(pattern, -1.0), _likeness(sample, fineness, rest) - worst)
    return max(found, key=found.__getitem__, default=None)


def _pair_errors(sample: _Sample) -> np.ndarray:
    """(k, k) mean difference between the sum of any two frames and that of the brightest and the darkest value, as a
    fraction of the swing, at a few of the pixels."""
    lit = sample.is_lit
    few = slice(None, None, 1 + np.count_nonzero(lit) // MAX_PAIR_PIXELS)
    frames, high, low = sample.frames[:, lit][:, few], sample.high[lit][few], sample.low[lit][few]
    total, swing = high + low, float((high - low).mean())
    return np.array([np.abs(frames + frame - total).mean(axis=1) / swing for frame in frames])


def _at_ends(first: Sequence[str], last: Sequence[str]) -> list[tuple[int, str]]:
    """Places of the first and of the last frames, each with the frame's name."""
    return [*enumerate(first), *((i - len(last), name) for i, name in enumerate(last))]


def _ends_fit(sample: _Sample, places: Sequence[tuple[int, str]]) -> bool:
    """Whether the frames that would be white and black are the brightest and the darkest nearly everywhere.

    Parameters
    ----------
    places : places of white and black among the frames, each with its name.
    """
    lit, limits = sample.is_lit, {WHITE: sample.high, BLACK: sample.low}
    largest = MAX_END_ERROR * (sample.high - sample.low)[lit]
    return all(
        (np.abs(sample.frames[i] - limits[name])[lit] <= largest).mean() >= MIN_END_FRACTION for i, name in places
    )


def _has_even_pattern(sample: _Sample, names: Sequence[str]) -> bool:
    """Whether a pattern, neither white nor black, is the brightest or the darkest frame nearly everywhere."""
    coded = [i for i, name in enumerate(names) if name not in (WHITE, BLACK)]
    return any(_ends_fit(sample, [(i, end)]) for i in coded for end in (WHITE, BLACK))


def _pairs_fit(sample: _Sample, names: Sequence[str]) -> bool:
    """Whether the frames that would be a pattern and its inverse add up to the same sum."""
    places = {name: i for i, name in enumerate(names)}
    lit = sample.is_lit
    total, swing = (sample.high + sample.low)[lit], float((sample.high - sample.low)[lit].mean())
    errors = [
        float(np.abs(sample.frames[i][lit] + sample.frames[j][lit] - total).mean()) / swing
        for name, i in places.items()
        if (j := places.get(name + INVERSE)) is not None
    ]
    return not errors or float(np.median(errors)) < MAX_PAIR_ERROR


def _fineness(sensor: StructuredLight) -> dict[str, float]:
    """Logarithm of how often each pattern changes, positive for columns and negative for rows, by the frame's name."""
    result: dict[str, float] = {}
    for axis, sign in zip(AXES, (1, -1), strict=True):
        size = sensor.size(axis)
        changes = np.log1p(variations(sensor.code.patterns(size)))
        result |= {f"{axis}_{name}": sign * x for name, x in zip(sensor.code.names(size), changes, strict=True)}
    return result


def _likeness(sample: _Sample, fineness: dict[str, float], names: Sequence[str]) -> float:
    """Cosine between how finely the frames change, and how finely the patterns do; negative if along the other side.

    Both count as positive for what changes across the image, and negative for what changes down the image.
    """
    seen = np.log(np.maximum(sample.across, 1e-6) / np.maximum(sample.down, 1e-6))
    expected = np.array([fineness.get(name, 0.0) for name in names])  # 0 for white and black
    length = float(np.linalg.norm(seen) * np.linalg.norm(expected))
    return float(seen @ expected) / length if length else 0.0


def _agreement_bits(sample: _Sample, candidate: StructuredLight) -> float:
    """Ratio of the distance of any two pixels to that of neighbours, on the projector, in powers of two.

    It is the mean over all pairs of neighbours that see different cells, times the fraction of the pairs that are
    decoded; of two axes, that of the worse one.
    """
    candidate = with_own_start(sample.frames, candidate)
    return min(
        max(_nearness(sample, c) for c in (code, code.coarse) if c is not None)
        for code in _decoded(sample.frames, candidate).values()
    )


def _decoded(frames: np.ndarray, sensor: StructuredLight) -> dict[str, AxisCode]:
    """The codes of all axes."""
    decoder = StructuredLightDecoder()
    axes = decoder.axis_frames(Capture(frames, sensor))
    return {seen.axis: sensor.code.decode(seen, decoder.thresholds) for seen in axes}


def _nearness(sample: _Sample, code: AxisCode) -> float:
    """Mean of log2 of the distance of any two pixels minus that of neighbours; see `_agreement_bits`.

    Distances are in cells. Neighbours that see the same cell of a code of bits would agree in every order, so they do
    not count. A sub-pixel code that refines no such cells tells all places from each other; its cells are pixels.
    """
    ok = code.status == Status.OK
    here, there, n = [], [], 0
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        n += int(np.count_nonzero(sample.is_lit[a] & sample.is_lit[b]))
        both = ok[a] & ok[b] & sample.is_lit[a] & sample.is_lit[b]
        here.append(code.coordinate[a][both])
        there.append(code.coordinate[b][both])
    first, second = np.concatenate(here) / code.cell_px, np.concatenate(there) / code.cell_px
    is_subpixel = code.coarse is None and np.count_nonzero(first % MIN_STEP) > MIN_SUBPIXEL_FRACTION * len(first)
    if is_subpixel:
        first, second = first * code.cell_px, second * code.cell_px
    distance = np.abs(first - second)
    differ = (distance >= MIN_STEP) | is_subpixel
    if np.count_nonzero(differ) < MIN_PIXELS:
        return 0.0
    any_other = np.random.default_rng(0).permutation(second)
    octaves = np.log2(np.maximum(np.abs(first - any_other), MIN_STEP)).mean()
    return float((octaves - np.log2(np.maximum(distance, MIN_STEP)[differ]).mean()) * len(first) / n)


def _upright(frames: np.ndarray, sample: _Sample, found: StructuredLight) -> StructuredLight:
    """The sensor with its axes exchanged if rows come first: if the image is mirrored as given and upright exchanged.

    A camera that was turned by 90 degrees sees rows change across its image, too, but its image is not mirrored.
    """
    if len(found.axes) < 2 or _likeness(sample, _fineness(found), found.frame_names()) >= 0:
        return found
    codes = _decoded(middle_of(frames), found)  # slopes are measured over several pixels, which tiles cut off
    places = []
    for axis in AXES:
        code = codes[axis].coarse or codes[axis]
        places.append(np.where(code.status == Status.OK, code.coordinate, np.float32(np.nan)))
    if not is_mirrored(*places):
        return found
    axes = found.axes[::-1]
    other = {f"{a}_": f"{b}_" for a, b in zip(found.axes, axes, strict=True)}
    order = tuple(next((entry.replace(a, b) for a, b in other.items() if a in entry), entry) for entry in found.order)
    try:
        exchanged = replace(found, axes=axes, order=order)
    except ValueError:
        return found
    return exchanged if exchanged.n_frames == found.n_frames else found


def _within_projector(sample: _Sample, sensor: StructuredLight) -> tuple[StructuredLight, tuple[str, ...]]:
    """The sensor in a convention of its code in which nearly all places lie in the projector, and what differs."""
    outside = _outside(sample, sensor)
    if outside > MAX_BEYOND_PROJECTOR:
        for code, said in sensor.code.other_conventions():
            other = replace(sensor, code=code)
            if _outside(sample, other) < MAX_LEFT_OUTSIDE * outside:
                return other, (said,)
    return sensor, ()


def _outside(sample: _Sample, sensor: StructuredLight) -> float:
    """Fraction of the decoded pixels that see no place of the projector; of two axes, that of the worse one."""
    fractions = []
    for code in _decoded(sample.frames, sensor).values():
        outside = int(np.count_nonzero(code.status == Status.CODE_ERROR))
        fractions.append(outside / max(1, outside + int(np.count_nonzero(code.status == Status.OK))))
    return max(fractions)


def _differences(layout: Layout, sensor: StructuredLight, found: StructuredLight) -> Iterator[str]:
    """Sentences on what of an order differs from that of the sensor."""
    before = _described(sensor)
    if found.axes != sensor.axes:
        if len(found.axes) < len(sensor.axes):
            yield f"only {found.axes[0]} were shown."
        else:
            yield f"{found.axes[0]} were shown before {found.axes[1]}."
    if before is None or layout.ends != before.ends:
        yield f"{ENDS[layout.ends]}."
    if before is None or layout.inverses != before.inverses:
        yield f"{INVERSES[layout.inverses]}."
    if layout.is_reversed and not (before and before.is_reversed):
        yield f"the finest {refined_kinds(sensor)[0]}s come first."
    if layout.blocks != (before.blocks if before else tuple(range(len(layout.blocks)))):
        yield f"{kinds(sensor)[layout.blocks[0]]} images come before {kinds(sensor)[layout.blocks[1]]} images."
    if layout.is_by_block and not (before and before.is_by_block):
        yield f"all {kinds(sensor)[layout.blocks[0]]} images of both axes come before the others."
    if layout.is_interleaved and not (before and before.is_interleaved):
        yield "columns and rows take turns."


def _described(sensor: StructuredLight) -> Layout | None:
    """The layout of a sensor's own order; None if it is no usual one."""
    names = sensor.frame_names()
    blocks = tuple(range(len(kinds(sensor))))
    plain = Layout(sensor.axes, blocks=blocks)
    if plain.names(sensor) == names:
        return plain
    return next((layout for layout in layouts(sensor, len(names)) if layout.names(sensor) == names), None)
