# SPDX-License-Identifier: Apache-2.0
"""Gray patterns in another order, inverted or shown twice are named; sound captures at any fineness are silent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from code_frames import run_of
from synthetic import plane_signals, stereo_rig

from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.decoding import decode
from rangesim.electronics.detector import Detector
from rangesim.errors import RangesimWarning
from rangesim.rig import Intrinsics
from rangesim.sensors import StructuredLight

SIZES = [(1280, 800), (257, 193), (500, 400)]


def captured(projector: tuple[int, int], code: str = "gray", noisy: bool = True, width: int = 160) -> Capture:
    sensor = StructuredLight(*projector, code=code, axes=("columns", "rows"))  # type: ignore[arg-type]
    rig = stereo_rig(width, width * 3 // 4, projector=Intrinsics.from_fov(*projector, 60))
    signals = plane_signals(rig, sensor, ambient=0.01)
    return expose(signals, sensor, Detector(), exposure_s=2e-4) if noisy else expose(signals, sensor)


def reordered(capture: Capture, order: Callable[[np.ndarray], np.ndarray], axis: str = "columns") -> Capture:
    """The capture with the frames of an axis as `order` returns them, of (bits, 2, h, w), most significant first."""
    sensor, frames = capture.sensor, capture.frames.copy()
    assert isinstance(sensor, StructuredLight)
    run = run_of(sensor, f"{axis}_bit")
    pairs = frames[run].reshape(-1, 2, *frames.shape[1:])
    frames[run] = order(pairs).reshape(-1, *frames.shape[1:])
    return replace(capture, frames=frames)


def message(capture: Capture) -> str:
    with pytest.warns(RangesimWarning) as caught:
        decode(capture)
    assert len(caught) == 1
    return str(caught[0].message)


@pytest.mark.parametrize("projector", SIZES)
@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_bits_that_are_exchanged_or_inverted_are_named(projector: tuple[int, int], noisy: bool, axis: str) -> None:
    capture = captured(projector, noisy=noisy)
    n = int(np.ceil(np.log2(projector[0 if axis == "columns" else 1])))
    for i, j in ((1, 2), (2, 4), (1, 4)):  # from the top

        def exchanged(pairs: np.ndarray, i: int = i, j: int = j) -> np.ndarray:
            rows = np.arange(len(pairs))
            rows[[i, j]] = rows[[j, i]]
            return pairs[rows]

        expected = (
            f"frames {axis}_bit{n - 1 - i} and {axis}_bit{n - 1 - j}, each with its inverse, seem to be exchanged"
        )
        assert expected in message(reordered(capture, exchanged, axis))
    for i in (2, 3, 4):  # above, no edge between two blocks of cells that it turns round may be in view

        def inverted(pairs: np.ndarray, i: int = i) -> np.ndarray:
            result = pairs.copy()
            result[i] = pairs[i, ::-1]
            return result

        assert f"frame {axis}_bit{n - 1 - i} and its inverse seem" in message(reordered(capture, inverted, axis))


@pytest.mark.parametrize("projector", SIZES)
@pytest.mark.parametrize("noisy", [False, True])
def test_another_order_of_all_frames_is_named(projector: tuple[int, int], noisy: bool) -> None:
    capture = captured(projector, noisy=noisy)
    assert "every inverse seems to stand before its pattern" in message(reordered(capture, lambda p: p[:, ::-1]))
    apart = message(reordered(capture, lambda p: p.transpose(1, 0, 2, 3)))  # all patterns, then all inverses
    assert "pairs of pattern and inverse along columns contradict white and black" in apart
    if projector != (1280, 800):  # there the camera is too coarse for the finest bits
        assert "the least significant bit seems to come first" in message(reordered(capture, lambda p: p[::-1]))


@pytest.mark.parametrize(
    ("projector", "upper"), [(size, k) for size in SIZES for k in (0, 1, 2) if (size, k) != ((257, 193), 0)]
)
def test_a_pattern_shown_twice_is_named(projector: tuple[int, int], upper: int) -> None:
    def repeated(pairs: np.ndarray) -> np.ndarray:
        result = pairs.copy()
        result[upper + 1] = pairs[upper]
        return result

    n = int(np.ceil(np.log2(projector[0])))
    expected = f"frames columns_bit{n - 1 - upper} and columns_bit{n - 2 - upper} seem to be one pattern shown twice"
    assert expected in message(reordered(captured(projector, width=240), repeated))


@pytest.mark.parametrize("projector", [(1280, 800), (1024, 768)])
@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_a_coarse_pattern_shown_twice_is_named_in_large_images(projector: tuple[int, int], axis: str) -> None:
    """The coarsest bits change at one line of the image: a few hundred of a million pairs of neighbours."""
    capture = captured(projector, width=720)

    def repeated(pairs: np.ndarray) -> np.ndarray:
        result = pairs.copy()
        result[1] = pairs[0]
        return result

    n = int(np.ceil(np.log2(projector[0 if axis == "columns" else 1])))
    expected = f"frames {axis}_bit{n - 1} and {axis}_bit{n - 2} seem to be one pattern shown twice"
    assert expected in message(reordered(capture, repeated, axis))


@pytest.mark.parametrize(
    ("projector", "left", "width"),
    [((8, 8), 15, 100), ((8, 8), 30, 70), ((8, 8), 75, 70), ((16, 12), 30, 40), ((16, 12), 60, 40)],
)
def test_inverses_before_their_patterns_are_no_plain_binary(projector: tuple[int, int], left: int, width: int) -> None:
    """Of few cells in view, some lie nearer to each other if read as plain binary; but nearest in the right order."""
    whole = reordered(captured(projector), lambda pairs: pairs[:, ::-1])
    part = replace(whole, frames=np.ascontiguousarray(whole.frames[:, :, left : left + width]), rig=None)
    text = message(part)
    assert "along columns contradict Gray code, where neighbouring pixels see neighbouring cells" in text
    assert "inverse" in text


@pytest.mark.parametrize("bit", [0, 3])
def test_an_inverse_that_is_the_pattern_again_is_named(bit: int) -> None:
    def doubled(pairs: np.ndarray) -> np.ndarray:
        result = pairs.copy()
        result[bit, 1] = pairs[bit, 0]
        return result

    text = message(reordered(captured((257, 193)), doubled))
    name = f"columns_bit{8 - bit}"
    assert f"1 of 9 pairs of pattern and inverse along columns contradict white and black: frames {name} and" in text


@pytest.mark.parametrize("projector", [(40, 30), (128, 96), (500, 400), (1000, 700), (1920, 1080)])
@pytest.mark.parametrize("width", [64, 160, 320])
@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_sound_captures_of_any_fineness_are_silent(projector: tuple[int, int], width: int, code: str) -> None:
    """Warnings are errors in these tests. Fringes finer than the camera's pixels are another matter."""
    if code == "gray-phase" and projector[0] > 10 * width:
        return
    for noisy in (False, True):
        decode(captured(projector, code, noisy, width))
