# SPDX-License-Identifier: Apache-2.0
"""Conventions are found from the frames, and nothing changes where a capture agrees with the given one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig
from tiers import draws

from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.codes import FringeConvention, GrayCode, GrayPhase, Heterodyne, MultiFrequency
from rangesim.conventions import detect_convention
from rangesim.decoding import decode
from rangesim.electronics.detector import Detector
from rangesim.errors import RangesimWarning
from rangesim.results.captures import import_capture
from rangesim.rig import Intrinsics
from rangesim.sensors import StructuredLight, StructuredLightDecoder, sensor_of

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"

SIZE = (500, 410)
BOTH = ("columns", "rows")
Order = Callable[[np.ndarray], np.ndarray]


@cache
def captured(code: str | GrayPhase, axes: tuple[str, ...] = BOTH, exposure_s: float = 4e-4) -> Capture:
    sensor = StructuredLight(*SIZE, code=code, axes=axes)  # type: ignore[arg-type]
    rig = stereo_rig(120, 120, projector=Intrinsics.from_fov(*SIZE, 60))
    return expose(plane_signals(rig, sensor, ambient=0.01), sensor, Detector(), exposure_s=exposure_s)


def places(sensor: StructuredLight, axis: str) -> list[int]:
    return [i for i, name in enumerate(sensor.frame_names()) if name.startswith(axis)]


ENDS: dict[str, tuple[Order, str]] = {
    "first": (lambda f: np.concatenate([f[-2:], f[:-2]]), "white and black come first."),
    "exchanged": (lambda f: np.concatenate([f[:-2], f[:-3:-1]]), "black and white come last, black before white."),
    "around": (lambda f: np.concatenate([f[-2:-1], f[:-2], f[-1:]]), "white comes first and black last."),
    "absent": (lambda f: f[:-2], "there are no white and black images."),
}


@pytest.mark.parametrize("code", ["gray", "gray-phase"])
@pytest.mark.parametrize("axes", [("columns",), BOTH, ("rows", "columns")])
@pytest.mark.parametrize("exposure_s", [4e-4, 1e-4])
def test_a_capture_in_the_given_convention_changes_nothing(code: str, axes: tuple[str, ...], exposure_s: float) -> None:
    capture = captured(code, axes, exposure_s)
    found = detect_convention(capture.frames, capture.sensor)  # type: ignore[arg-type]
    assert found.sensor == capture.sensor
    assert found.findings == ()


@pytest.mark.parametrize("amplitude", [60, 200])
def test_a_close_view_of_an_own_subpixel_code_keeps_its_order(amplitude: int) -> None:
    """A camera that is finer than the projector: neighbours are a fraction of a pixel apart, and periods far wider."""
    sensor = sensor_of(f"{EXAMPLES / 'own_code.py'}:TriangleWaves").for_projector(400, 300, BOTH)
    assert isinstance(sensor, StructuredLight)
    seen = np.repeat(np.repeat(sensor.patterns()[:, 100:250, 100:300], 2, axis=1), 2, axis=2)
    noise = np.random.default_rng(0).normal(0, 2, seen.shape)
    assert detect_convention(np.rint(20 + amplitude * seen + noise).astype(np.uint8), sensor).findings == ()


@pytest.mark.parametrize("code", ["gray", "gray-phase"])
@pytest.mark.parametrize("name", ENDS)
def test_places_of_white_and_black(code: str, name: str) -> None:
    capture = captured(code)
    order, sentence = ENDS[name]
    frames = order(capture.frames)
    found = detect_convention(frames, capture.sensor)  # type: ignore[arg-type]
    assert found.findings[0] == sentence
    right, mended = decode(replace(capture, rig=None)), decode(Capture(frames, found.sensor, detector=capture.detector))
    both = right.valid & mended.valid
    assert both.sum() > 0.95 * right.valid.sum()
    assert right.projector_column is not None
    assert mended.projector_column is not None
    np.testing.assert_array_equal(mended.projector_column[both], right.projector_column[both])


@pytest.mark.parametrize("first_px", [240, 720])
def test_a_view_of_a_tenth_of_the_projector_with_wrong_words_keeps_its_order(first_px: int) -> None:
    """Its coarsest bits are the same everywhere; orders that take them for white and black are smooth, too."""
    sensor, rng = StructuredLight(800, 600, "gray"), np.random.default_rng(1)
    column = np.broadcast_to(first_px + np.arange(160) // 2, (120, 160))
    seen = np.where(rng.random(column.shape) < 0.1, rng.integers(0, 800, column.shape), column)
    frames = np.rint(20 + 180 * sensor.patterns()[:, 0, seen] + 2 * rng.standard_normal((sensor.n_frames, 120, 160)))
    assert detect_convention(frames.astype(np.uint8), sensor).findings == ()


def test_order_of_bits_and_of_inverses() -> None:
    capture = captured("gray")
    pairs, ends = capture.frames[:-2].reshape(2, -1, 2, 120, 120), capture.frames[-2:]
    orders = {
        "each inverse stands before its pattern.": pairs[:, :, ::-1],
        "the finest bits come first.": pairs[:, ::-1],
        "all patterns of an axis come before all inverses.": pairs.transpose(0, 2, 1, 3, 4),
        "columns and rows take turns.": pairs.transpose(1, 0, 2, 3, 4),
    }
    for sentence, shown in orders.items():
        frames = np.concatenate([shown.reshape(-1, 120, 120), ends])
        found = detect_convention(frames, capture.sensor)  # type: ignore[arg-type]
        assert found.findings[0] == sentence
        decode(Capture(frames, found.sensor))  # warnings are errors here


@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_axes_that_are_exchanged_or_missing(code: str) -> None:
    capture = captured(code)
    sensor = capture.sensor
    assert isinstance(sensor, StructuredLight)
    columns, rows, ends = places(sensor, "columns"), places(sensor, "rows"), [-2, -1]
    exchanged = detect_convention(capture.frames[[*rows, *columns, *ends]], sensor)
    assert exchanged.findings == ("rows were shown before columns.",)
    assert exchanged.sensor.axes == ("rows", "columns")
    for axis, kept in (("columns", columns), ("rows", rows)):
        found = detect_convention(capture.frames[[*kept, *ends]], sensor)
        assert found.findings == (f"only {axis} were shown.",)
        assert found.sensor.axes == (axis,)


@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_a_turned_camera_is_no_exchange_of_axes(code: str) -> None:
    capture = captured(code)
    turned = np.rot90(capture.frames, axes=(1, 2))
    assert detect_convention(turned, capture.sensor).findings == ()  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", draws(30, quick=4))
def test_conventions_of_fringes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shown = FringeConvention(
        str(rng.choice(["cos", "sin", "-cos", "-sin"])),  # type: ignore[arg-type]
        str(rng.choice(["forward", "backward"])),  # type: ignore[arg-type]
        float(rng.choice([0.0, 0.5, -0.5])),
    )
    period_px, steps = float(rng.choice([12.0, 16.0, 20.0, 37.0])), int(rng.integers(3, 7))
    cell_px = None if rng.uniform() < 0.5 else int(period_px)  # of a whole period: only the edges of cells tell
    capture = captured(GrayPhase(period_px, steps, shown, cell_px), ("columns",))
    sensor = capture.sensor
    assert isinstance(sensor, StructuredLight)
    given = replace(sensor, code=GrayPhase(period_px, steps, cell_px=cell_px))
    found = detect_convention(capture.frames, given).sensor.code
    assert isinstance(found, GrayPhase)
    off = found.convention.shift_turns(1, steps, period_px) - shown.shift_turns(1, steps, period_px)
    assert abs(off - round(off)) < 1e-9
    assert found.convention.direction == shown.direction


@pytest.mark.parametrize("start", ["sin", "-cos", "-sin"])
def test_fringes_of_several_periods_tell_where_they_start(start: str) -> None:
    """Read as a cosine, heterodyne fringes that are a sine would be a quarter of a period off, without a word."""
    shown = FringeConvention(start, "backward", 0.5)  # type: ignore[arg-type]
    for code in (Heterodyne((12.5, 500 / 39, 500 / 35)), MultiFrequency((500.0, 125.0, 25.0))):
        sensor = StructuredLight(*SIZE, code=replace(code, convention=shown), axes=("columns",))
        given = replace(sensor, code=replace(code, convention=replace(shown, start="cos")))
        frames = 0.1 + sensor.patterns()
        for some, ends in ((frames, ()), (frames[:-2], ("there are no white and black images.",))):
            found = detect_convention(some, given)
            assert found.sensor.code == sensor.code
            assert set(found.findings) >= {f"the fringes start as {start} (convention.start = {start}).", *ends}


def test_fringes_of_two_periods_before_bits_of_both_axes() -> None:
    """The order of kamino410/phase-shifting."""
    code = GrayPhase(400 / 12, 3, FringeConvention("cos-120", "backward", 0.5), 50, (50.0,))
    capture = captured(code)
    names = capture.sensor.frame_names()
    order = sorted(range(len(names)), key=lambda i: (names[i] in ("white", "black"), "phase" not in names[i], i))
    given = replace(capture.sensor, code=replace(code, convention=FringeConvention()))  # type: ignore[type-var]
    found = detect_convention(capture.frames[order], given)  # type: ignore[arg-type]
    assert found.sensor.code == code
    assert found.findings[0] == "phase images come before bit images."


def test_fringes_before_bits() -> None:
    capture = captured("gray-phase", ("columns",))
    names = capture.sensor.frame_names()
    order = sorted(range(len(names)), key=lambda i: (names[i] in ("white", "black"), "phase" not in names[i], i))
    found = detect_convention(capture.frames[order], capture.sensor)  # type: ignore[arg-type]
    assert found.findings == ("phase images come before bit images.",)


@pytest.mark.parametrize("cell_px", [1, 3])
def test_gray_codes_of_the_middle_words_are_found(cell_px: int) -> None:
    """Programs of Lanman, Taubin and Moreno show them; read as the first words, all places would be shifted."""
    middle = StructuredLight(*SIZE, code=GrayCode(cell_px, "middle"), axes=BOTH)
    shown = middle.patterns()
    given = replace(middle, code=GrayCode(cell_px))
    with pytest.warns(RangesimWarning, match="as if the code showed its middle words instead of the first ones"):
        StructuredLightDecoder().coordinates(Capture(shown, given))
    found = detect_convention(shown, given)
    assert found.sensor == middle
    assert found.findings == ("the Gray code shows the middle words (words_shown = middle).",)
    seen = StructuredLightDecoder().coordinates(Capture(shown, middle))
    cells = np.arange(SIZE[0]) // cell_px * cell_px + cell_px / 2
    np.testing.assert_allclose(seen.column[0], np.minimum(cells, (SIZE[0] - SIZE[0] % cell_px + SIZE[0]) / 2))
    assert detect_convention(given.patterns(), middle).sensor == given


def test_other_numbers_of_frames_are_refused_or_doubted() -> None:
    capture = captured("gray", ("columns",))
    with pytest.raises(ValueError, match=r"expected 20 images .* got 13\."):
        detect_convention(capture.frames[:13], capture.sensor)  # type: ignore[arg-type]
    lost = "the image of columns_bit6 or of its inverse seems to be missing"
    with pytest.raises(ValueError, match=f"expected 20 images .* got 19; {lost}; and in no order"):
        detect_convention(np.delete(capture.frames, 5, axis=0), capture.sensor)  # type: ignore[arg-type]
    both = StructuredLight(600, SIZE[1], code="gray", axes=BOTH)
    with pytest.raises(ValueError, match=r"expected 40 images .* got 42\. A projector of 600x600 has as many"):
        detect_convention(np.zeros((42, 120, 120), np.uint8), both)
    with pytest.raises(ValueError, match="too dark"):
        detect_convention(np.zeros((18, 120, 120), np.uint8), capture.sensor)  # type: ignore[arg-type]


@pytest.mark.validation
def test_a_real_capture_in_other_orders(real_data: Path) -> None:
    sensor = StructuredLight(1024, 768, code="gray", axes=("columns", "rows"))
    frames = import_capture(real_data / "graycode_board" / "capture_0", sensor).frames
    assert detect_convention(frames, sensor).findings == ()
    pairs = frames[:40].reshape(2, 10, 2, *frames.shape[1:])
    for shown, sentence in (
        (pairs[::-1], "rows were shown before columns."),
        (pairs[:, ::-1], "the finest bits come first."),
        (pairs[:, :, ::-1], "each inverse stands before its pattern."),
        (pairs.transpose(0, 2, 1, 3, 4), "all patterns of an axis come before all inverses."),
    ):
        other = np.concatenate([shown.reshape(40, *frames.shape[1:]), frames[-2:]])
        assert detect_convention(other, sensor).findings[0] == sentence
        assert detect_convention(np.concatenate([other[-2:], other[:-2]]), sensor).findings[:2] == (
            ("white and black come first.", sentence)
            if "rows were" not in sentence
            else (sentence, "white and black come first.")
        )
    assert detect_convention(frames[:40], sensor).findings[0] == "there are no white and black images."
