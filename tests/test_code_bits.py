# SPDX-License-Identifier: Apache-2.0
"""Codes of bits decode what they encode, with or without inverses, white and black; a wrong code is named."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rangesim.capture import Capture
from rangesim.codes import BinaryCode, BitCode, EnsembleCode, GrayCode, GrayPhase, MaxMinStripeCode, XorCode
from rangesim.decoding import decode
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.electronics.detector import Detector
from rangesim.errors import RangesimWarning
from rangesim.sensors import StructuredLight

CODES: list[BitCode] = [GrayCode(), BinaryCode(), XorCode(0), XorCode(1), MaxMinStripeCode()]
ONE_BIT: list[BitCode] = [code for code in CODES if code.words(64).change_one_bit]
PLAIN, INVERSES = "*_bit*[0-9]", "*_inverse"


def seen_flat(sensor: StructuredLight, height: int | None = None, px: float = 1.0) -> Capture:
    """What a noise-free 8-bit camera sees of the patterns, at `px` projector pixels per pixel of the camera."""
    frames = np.rint(10 + 200 * sensor.patterns()).astype(np.uint8)
    if px != 1:
        at = np.arange(0, sensor.projector_width, px).astype(int)
        frames = frames[:, :, at]
    return Capture(frames if height is None else frames[:, :height], sensor)


def centres(width: int, cell_px: int) -> np.ndarray:
    """(width,) centres of what the projector has of the cells of all columns."""
    start = np.arange(width) // cell_px * cell_px
    return (start + np.minimum(start + cell_px, width)) / 2


def column(image: RangeImage) -> np.ndarray:
    assert image.projector_column is not None
    return image.projector_column


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(CODES),
    st.integers(4, 300),
    st.integers(1, 5),
    st.sampled_from([(), ("white", "black", "*"), ("black", "*_bit*", "white"), ("white", "black", PLAIN),
                     (PLAIN, "white", "black"), ("black", "reversed(*_inverse)", "white"), ("*_bit*",),
                     ("white", "*_bit*"), ("black", "*_bit*")]),
)  # fmt: skip
def test_every_column_comes_back(code: BitCode, width: int, cell_px: int, order: tuple[str, ...]) -> None:
    code = replace(code, cell_px=cell_px)  # type: ignore[call-arg]
    if code.bits(width) < 2:
        return
    sensor = StructuredLight(width, 2, code, order=order)
    image = decode(seen_flat(sensor))
    assert (image.status == Status.OK).all()
    np.testing.assert_array_equal(column(image), np.tile(centres(width, cell_px), (2, 1)))


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(ONE_BIT),
    st.integers(4, 300),
    st.integers(1, 5),
    st.sampled_from([(PLAIN,), (INVERSES,), ("white", PLAIN), (PLAIN, "black"), ("white", INVERSES)]),
)
def test_without_white_or_black_only_cells_next_to_a_constant_word_are_refused(
    code: BitCode, width: int, cell_px: int, order: tuple[str, ...]
) -> None:
    """A cell that is dark in all frames, or lit in all, has no contrast; blur of its neighbours is no bit."""
    code = replace(code, cell_px=cell_px)  # type: ignore[call-arg]
    if code.bits(width) < 3:
        return
    sensor = StructuredLight(width, 2, code, order=order)
    image = decode(seen_flat(sensor))
    read = image.status[0] == Status.OK
    np.testing.assert_array_equal(column(image)[0, read], centres(width, cell_px)[read])
    words = code.words(width)
    constant = words.cell_of[[0, -1]]
    near = np.abs(np.arange(width)[:, None] // cell_px - constant).min(axis=1) <= 1
    assert read[~near].all()
    assert (image.status[0][~read] == Status.LOW_SIGNAL).all()


@pytest.mark.parametrize("order", [(PLAIN,), (INVERSES,), ("white", "black", PLAIN), ("white", "black", INVERSES)])
@pytest.mark.parametrize("code", CODES, ids=lambda code: code.noun)
def test_blur_never_reads_a_cell_that_is_not_there(code: BitCode, order: tuple[str, ...]) -> None:
    """Blurred over less than a cell, what is read lies within one cell of the truth, also beside dark cells."""
    from scipy.ndimage import gaussian_filter1d

    cell = 8
    if code not in ONE_BIT and "white" not in order:
        with pytest.raises(ValueError, match="with white and black, or with all inverses"):
            StructuredLight(64 * cell, 2, code, order=order)
        return
    sensor = StructuredLight(64 * cell, 2, replace(code, cell_px=cell), order=order)  # type: ignore[call-arg]
    for sigma in (1.0, 2.5, 4.0):
        frames = gaussian_filter1d(sensor.patterns().astype(np.float64), sigma, axis=2, mode="nearest")
        image = decode(Capture(np.rint(10 + 200 * frames).astype(np.uint8), sensor))
        read = image.status == Status.OK
        error = np.abs(column(image) - (np.arange(64 * cell) + 0.5))[read]
        assert read.mean() > (0.5 if isinstance(code, GrayCode) else 0.3)
        assert error.max() <= cell


def test_both_axes_tell_each_other_what_full_light_is() -> None:
    """Without white and black, a column that is dark in all frames of its axis is lit in those of the rows."""
    sensor = StructuredLight(64, 48, "gray", ("columns", "rows"), order=(PLAIN,))
    image = decode(seen_flat(sensor))
    refused = image.status != Status.OK
    assert refused.sum() <= 25
    assert refused[0, 0]
    np.testing.assert_array_equal(column(image)[~refused], np.tile(np.arange(64) + 0.5, (48, 1))[~refused])


@pytest.mark.parametrize("order", [("white", "black", "columns_bit2", "columns_bit1_inverse", "columns_bit0*")])
def test_each_bit_needs_its_pattern_or_its_inverse(order: tuple[str, ...]) -> None:
    sensor = StructuredLight(8, 4, "gray", order=order)
    assert sensor.n_frames == 6
    np.testing.assert_array_equal(column(decode(seen_flat(sensor)))[0], np.arange(8) + 0.5)
    with pytest.raises(ValueError, match=r"each bit of gray code or its inverse: bit1 is missing"):
        StructuredLight(8, 4, "gray", order=("white", "black", "*bit2*", "*bit0*"))
    with pytest.raises(ValueError, match=r"bit10 is missing \('\*_bit\*\[0-9\]' stands for all bits"):
        StructuredLight(1280, 4, "gray", order=("white", "black", "*_bit?"))
    assert StructuredLight(1280, 4, "gray", order=("white", "black", PLAIN)).n_frames == 13


def test_the_gray_part_of_fringes_needs_no_inverses() -> None:
    sensor = StructuredLight(256, 4, GrayPhase(), order=("white", "black", PLAIN, "*phase*"))
    image = decode(seen_flat(sensor))
    np.testing.assert_allclose(column(image)[0], np.arange(256) + 0.5, atol=0.05)
    with pytest.raises(ValueError, match="bit2 is missing"):
        StructuredLight(256, 4, GrayPhase(), order=("white", "black", "*bit[0134]", "*phase*"))
    with pytest.raises(ValueError, match="phase1 is missing"):
        StructuredLight(256, 4, GrayPhase(), order=("white", "black", "*bit*", "*phase[023]"))


def test_a_clipped_white_makes_lit_bits_uncertain_unless_they_clip_too() -> None:
    """A bit above the middle of black and a clipped white may be dark: 45 % of the true white reads 180 of 255."""
    sensor = StructuredLight(64, 4, "gray", order=("white", "black", PLAIN))
    truth = 400 * sensor.patterns()
    truth[2:, :, 20] = np.where(truth[2:, :, 20] > 0, 400, 180)  # light from elsewhere
    image = decode(Capture(np.minimum(truth, 255).astype(np.uint8), sensor))
    assert (image.status[:, 20] == Status.SATURATED).all()
    others = np.delete(np.arange(64), 20)
    np.testing.assert_array_equal(column(image)[0, others], others + 0.5)


@pytest.mark.parametrize("order", [(), ("white", "black", PLAIN), ("white", "black", INVERSES), (PLAIN,)])
def test_noise_reads_no_wrong_cell(order: tuple[str, ...]) -> None:
    """Bits are certain at three standard deviations of their difference; a wrong bit then is a matter of 1e-3."""
    detector = Detector()
    sensor = StructuredLight(512, 64, "gray", order=order)
    rng = np.random.default_rng(2)
    for level in (15.0, 40.0, 120.0, 1000.0):
        dn = detector.black_level_dn + 5 + level * sensor.patterns()
        frames = np.clip(np.rint(dn + detector.noise_dn(dn) * rng.standard_normal(dn.shape)), 0, detector.max_dn)
        image = decode(Capture(frames.astype(np.uint16), sensor, detector=detector))
        read = image.status == Status.OK
        wrong = np.abs(column(image) - (np.arange(512) + 0.5))[read] > 1
        assert wrong.mean() < 2e-3 if read.any() else True
        assert level < 1000 or read.mean() > 0.98


# ---- Words -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", range(1, 17))
@pytest.mark.parametrize("code", CODES, ids=lambda code: code.noun)
def test_each_cell_has_a_word_of_its_own(code: BitCode, bits: int) -> None:
    words = code.words_of_cells(bits)
    np.testing.assert_array_equal(np.sort(words), np.arange(1 << bits))


def stripe_widths(pattern: np.ndarray) -> np.ndarray:
    """Widths in cells of the stripes of a pattern, without the two at the ends."""
    return np.diff(np.flatnonzero(np.diff(pattern)))


@pytest.mark.parametrize(
    ("bits", "narrowest"), [(2, 2), (3, 2), (5, 4), (6, 4), (7, 5), (8, 6), (9, 6), (10, 8), (11, 8), (13, 9), (15, 11)]
)
def test_stripes_of_the_max_min_stripe_code_are_wide_and_change_one_by_one(bits: int, narrowest: int) -> None:
    """8 cells with 10 bits, as in Gupta 2011; also across the end of the cycle, so that any part of it is as good."""
    words = MaxMinStripeCode().words_of_cells(bits)
    cyclic = np.concatenate([words, words, words[:1]])
    changed = cyclic[1:] ^ cyclic[:-1]
    assert not (changed & (changed - 1)).any()
    assert min(stripe_widths((cyclic >> k) & 1).min() for k in range(bits)) == narrowest


@pytest.mark.parametrize("base_bit", [0, 1])
def test_stripes_of_xor_codes_are_no_wider_than_their_base(base_bit: int) -> None:
    """The last Gray pattern as base (XOR-02) leaves stripes of two cells at most, the one before (XOR-04) of four."""
    patterns = XorCode(base_bit).patterns(1024)[::2]
    assert max(stripe_widths(pattern).max() for pattern in patterns) == 2 << base_bit
    base = GrayCode().patterns(1024)[::2][9 - base_bit]
    np.testing.assert_array_equal(patterns[9 - base_bit], base)
    others = np.delete(np.arange(10), 9 - base_bit)
    np.testing.assert_array_equal(np.abs(patterns[others] - base), GrayCode().patterns(1024)[::2][others])


# ---- The ensemble ----------------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(st.integers(4, 300), st.integers(1, 4), st.sampled_from([(), ("white", "black", PLAIN)]))
def test_an_ensemble_reads_every_column(width: int, cell_px: int, order: tuple[str, ...]) -> None:
    if width <= 2 * cell_px:
        return
    sensor = StructuredLight(width, 2, EnsembleCode(cell_px), order=order)
    image = decode(seen_flat(sensor))
    assert (image.status == Status.OK).all()
    np.testing.assert_array_equal(column(image)[0], centres(width, cell_px))


def test_an_ensemble_takes_what_two_codes_say_and_refuses_two_opinions() -> None:
    """Columns 20 and up: one code elsewhere, two codes elsewhere but apart, and two codes elsewhere together."""
    sensor = StructuredLight(256, 2, EnsembleCode())
    capture = seen_flat(sensor)
    frames = capture.frames.copy()
    code = sensor.code
    assert isinstance(code, EnsembleCode)
    at = {}
    for prefix in code.members:
        places = [i for i, name in enumerate(sensor.frame_names()) if name.startswith(f"columns_{prefix}")]
        at[prefix] = slice(places[0], places[-1] + 1)
    for x, moves in (
        (20, {"gray_": 150}),
        (40, {"gray_": 150, "stripe_": 90}),
        (60, {"gray_": 150, "stripe_": 150}),
        (80, {"gray_": 150, "stripe_": 90, "xor02_": 200}),
    ):
        for prefix, there in moves.items():
            frames[at[prefix], :, x] = capture.frames[at[prefix], :, there]
    image = decode(replace(capture, frames=frames))
    np.testing.assert_array_equal(column(image)[0, [20, 40]], [20.5, 40.5])
    assert (image.status[:, [60, 80]] == Status.CODE_ERROR).all()
    assert (np.delete(image.status, [60, 80], axis=1) == Status.OK).all()


def test_an_ensemble_names_the_frames_of_its_members() -> None:
    sensor = StructuredLight(512, 32, EnsembleCode())
    capture = seen_flat(sensor, px=0.7)
    names, frames = sensor.frame_names(), capture.frames.copy()
    a, b = (names.index(f"columns_gray_bit{k}") for k in (6, 3))
    frames[[a, a + 1, b, b + 1]] = frames[[b, b + 1, a, a + 1]]
    with pytest.warns(RangesimWarning, match="columns_gray_bit6 and columns_gray_bit3, each with its inverse"):
        decode(replace(capture, frames=frames))


# ---- Contradictions --------------------------------------------------------------------------------------------------


def read_as(capture: Capture, code: BitCode) -> str:
    """The sentence on the code of a capture that is read as another one."""
    sensor = replace(capture.sensor, code=code)  # type: ignore[type-var]
    with pytest.warns(RangesimWarning) as caught:
        decode(replace(capture, sensor=sensor))
    assert len(caught) == 1
    return str(caught[0].message)


@pytest.mark.parametrize("order", [(), ("white", "black", PLAIN), (PLAIN,)])
@pytest.mark.parametrize("px", [0.3, 1.3, 3.3])
@pytest.mark.parametrize("shown", CODES, ids=lambda code: code.noun)
def test_another_code_is_named(shown: BitCode, px: float, order: tuple[str, ...]) -> None:
    codes = ONE_BIT if order == (PLAIN,) else CODES
    if shown not in codes:
        return
    capture = seen_flat(StructuredLight(640, 16, shown, order=order), px=px)
    decode(capture)
    for code in codes:
        if code != shown:
            text = read_as(capture, code)
            assert f"contradict {code.noun}" in text
            assert f"as {shown.noun}: check which code was shown" in text


@pytest.mark.parametrize("order", [("white", "black", PLAIN), (PLAIN, "white"), (PLAIN,), ("white", "black", INVERSES)])
@pytest.mark.parametrize("code", [GrayCode(), XorCode()], ids=lambda code: code.noun)
def test_bits_in_another_order_inverted_or_repeated_are_named(code: BitCode, order: tuple[str, ...]) -> None:
    if code not in ONE_BIT and not {"white", "black"} <= set(order):
        return
    sensor = StructuredLight(640, 64, code, order=order)
    capture = seen_flat(sensor, px=0.7)
    suffix = "_inverse" if INVERSES in order else ""
    at = {name: i for i, name in enumerate(sensor.frame_names())}

    def message(frames: np.ndarray) -> str:
        with pytest.warns(RangesimWarning) as caught:
            decode(replace(capture, frames=frames))
        assert len(caught) == 1
        return str(caught[0].message)

    bits = [at[f"columns_bit{k}{suffix}"] for k in range(10)]
    frames = capture.frames.copy()
    frames[[bits[5], bits[3]]] = frames[[bits[3], bits[5]]]
    assert f"frames columns_bit5{suffix} and columns_bit3{suffix} seem to be exchanged" in message(frames)

    frames = capture.frames.copy()
    frames[bits] = frames[bits[::-1]]
    assert "least significant bit seems to come first" in message(frames)

    frames = capture.frames.copy()
    frames[bits[4]] = 220 - frames[bits[4]]
    assert f"frame columns_bit4{suffix} seems to be inverted" in message(frames)

    if isinstance(code, XorCode):
        return  # all bits inverted: each cell is read as its neighbour, which no neighbourhood tells
    frames = capture.frames.copy()
    frames[bits] = 220 - frames[bits]
    assert "frames without their inverse seem to be inverted" in message(frames)

    frames = capture.frames.copy()
    frames[bits[4]] = frames[bits[5]]
    assert "columns_bit5 and columns_bit4 seem to be one pattern shown twice" in message(frames)


def test_a_bit_that_is_taken_for_white_or_black_is_named() -> None:
    sensor = StructuredLight(640, 64, "gray", order=(PLAIN, "white", "black"))
    other = replace(sensor, order=("white", PLAIN, "black"))
    with pytest.warns(RangesimWarning, match="contradict white: one of them is brighter than white at"):
        decode(replace(seen_flat(sensor), sensor=other))
    other = replace(sensor, order=("black", PLAIN, "white"))
    with pytest.warns(RangesimWarning, match="contradict (white|black): one of them is"):
        decode(replace(seen_flat(sensor), sensor=other))


# ---- Interreflection -------------------------------------------------------------------------------------------------


def corner(patterns: np.ndarray, indirect: float, width_px: float) -> np.ndarray:
    """(k, 2, width) what a camera sees of a groove of two walls, one for each half of the projector's columns.

    A point sees its own column, and the facing wall at the mirrored column, blurred: the opposite wall's light arrives
    from a wide area. `indirect` is the ratio of that light to the direct light, under full power.
    """
    from scipy.ndimage import gaussian_filter1d

    facing = gaussian_filter1d(patterns[:, 0, ::-1].astype(np.float64), width_px, axis=1, mode="nearest")
    seen = patterns[:, 0] + indirect * facing
    return np.repeat(seen[:, None], 2, axis=1)


@pytest.mark.parametrize("order", [(), ("white", "black", PLAIN)])
@pytest.mark.parametrize("indirect", [1.5, 3.0])
def test_xor_codes_read_a_corner_that_gray_code_reads_wrongly(indirect: float, order: tuple[str, ...]) -> None:
    """Light from the facing wall is stronger than direct light, so that a coarse pattern looks like its inverse.

    Gupta 2011: fine patterns do not, because the facing wall is half lit in each of them.
    """
    right, wrong = {}, {}
    for code in (GrayCode(), XorCode(0), XorCode(1)):
        sensor = StructuredLight(512, 2, code, order=order)
        frames = corner(sensor.patterns(), indirect, 24.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RangesimWarning)
            image = decode(Capture(frames.astype(np.float32), sensor))
        off = np.abs(column(image)[0] - (np.arange(512) + 0.5))
        right[code.noun], wrong[code.noun] = (off <= 1).mean(), (off > 1).mean()
    assert wrong["Gray code"] > 0.8
    for noun in ("XOR-02 code", "XOR-04 code"):
        assert right[noun] > 0.9
        assert wrong[noun] < 0.02


# ---- Defocus ---------------------------------------------------------------------------------------------------------


def errors_out_of_focus(code: XorCode, sigma_px: float) -> np.ndarray:
    """(n,) projector pixels, NaN where refused: errors of a camera with eight pixels for each of the projector."""
    from scipy.ndimage import gaussian_filter1d

    sensor, finer = StructuredLight(512, 2, code), 8
    patterns = np.repeat(sensor.patterns()[:, :1].astype(np.float32), finer, axis=2)
    frames = gaussian_filter1d(patterns, sigma_px * finer, axis=2, mode="nearest")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RangesimWarning)
        image = decode(Capture(frames, sensor))
    return np.asarray(np.abs(column(image)[0] - (np.arange(512 * finer) + 0.5) / finer))


@pytest.mark.parametrize("sigma_px", [0.7, 0.85, 1.0, 1.2])
def test_xor_02_out_of_focus_reads_the_middle_of_a_stripe(sigma_px: float) -> None:
    """Blur reverses the bit that changes within a stripe of the base, so a third of the readings were a cell off."""
    off = errors_out_of_focus(XorCode(0), sigma_px)
    assert (off <= 1).mean() > 0.5
    assert (off > 1).mean() < 0.01


@pytest.mark.parametrize("sigma_px", [1.2, 1.5, 2.0])
def test_xor_04_out_of_focus_is_refused(sigma_px: float) -> None:
    """Blur reverses two bits and more that change within a stripe of the base; a third of the pixels were wrong."""
    assert (errors_out_of_focus(XorCode(1), sigma_px) > 1).mean() < 0.02
