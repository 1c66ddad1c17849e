# SPDX-License-Identifier: Apache-2.0
"""A line that sweeps over the projector tells places to a fraction of a pixel; a second peak is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat_captures import all_columns, as_bytes, noisy
from hypothesis import given, settings
from hypothesis import strategies as st

from rangesim import decode
from rangesim.capture import Capture
from rangesim.codes import LineSweep
from rangesim.decoding.status import Status
from rangesim.errors import RangesimWarning
from rangesim.sensors import StructuredLight, StructuredLightDecoder


def lines_at(sensor: StructuredLight, x: np.ndarray, rows: int = 1, line_px: float | None = None) -> Capture:
    """Capture of the true Gaussians at places x (n,), of lines that defocus has widened to `line_px`."""
    code = sensor.code
    assert isinstance(code, LineSweep)
    width = code.line_px if line_px is None else line_px
    frames = np.exp(-0.5 * ((x - code.places(sensor.projector_width)[:, None]) / width) ** 2) * code.line_px / width
    frames = np.concatenate([frames, np.ones((1, len(x))), np.zeros((1, len(x)))])
    return Capture(np.repeat(frames[:, None], rows, axis=1).astype(np.float32), sensor)


@settings(max_examples=15, deadline=None)
@given(st.integers(20, 300), st.floats(2, 12), st.floats(0.5, 1.9))
def test_it_decodes_all_places(size: int, line_px: float, ratio: float) -> None:
    sensor = StructuredLight(size, 4, LineSweep(line_px, line_px * ratio))
    for x in (np.arange(size) + 0.5, np.linspace(0, size, 777)):
        image = decode(lines_at(sensor, x))
        assert (image.status == Status.OK).all()
        assert np.abs(image.projector_column - x).max() < 0.02


@pytest.mark.parametrize("line_px", [7.0, 9.0, 12.0])
def test_a_line_out_of_focus_is_found_as_well(line_px: float) -> None:
    sensor, x = StructuredLight(300, 4, LineSweep()), np.linspace(1, 299, 777)
    image = decode(lines_at(sensor, x, line_px=line_px))
    assert np.abs(image.projector_column - x).max() < 0.02


def test_errors_are_as_large_as_the_closed_form_says() -> None:
    """At a line's centre sigma is L^2 / (sqrt(2) s) sigma_I / (A exp(-s^2 / 2 L^2)), of the two frames beside it."""
    code = LineSweep(6.0, 8.0)
    sensor = StructuredLight(320, 4, code)
    x = np.arange(40.0, 280.0, 1.0)
    capture = noisy(lines_at(sensor, x, rows=60))
    seen = StructuredLightDecoder().coordinates(capture)
    assert seen.column is not None
    assert seen.column_sigma_px is not None
    assert np.isfinite(seen.column).mean() > 0.99
    assert np.nanstd((seen.column - x) / seen.column_sigma_px) == pytest.approx(1.0, abs=0.05)
    beside = np.exp(-(code.step_px**2) / (2 * code.line_px**2))
    black = float(capture.frames[-1].mean())
    noise = capture.noise(np.full((1, 1), black + 3000 * beside, dtype=np.float32))
    assert noise is not None
    expected = code.line_px**2 / (np.sqrt(2) * code.step_px) * noise.item() / (3000 * beside)
    assert np.nanmean(seen.column_sigma_px[:, x % 8 == 0]) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("second", [0.3, 0.7, 1.0])
def test_a_second_peak_that_is_as_bright_is_refused(second: float) -> None:
    sensor, x = StructuredLight(300, 4, LineSweep()), np.linspace(10, 290, 300)
    frames = lines_at(sensor, x).frames.copy()
    frames[:-2] += second * lines_at(sensor, (x + 120) % 300).frames[:-2]
    image = decode(Capture(frames, sensor))
    if second < 0.5:
        assert np.nanmax(np.abs(image.projector_column - x)) < 0.02
        assert image.valid.mean() > 0.95
    else:
        assert (image.status == Status.CODE_ERROR).mean() > 0.95


@pytest.mark.parametrize("white_dn", [5.0, 20.0, 60.0])
def test_what_noise_hides_is_refused(white_dn: float) -> None:
    capture, x = all_columns(StructuredLight(320, 4, LineSweep()), rows=40)
    seen = StructuredLightDecoder().coordinates(noisy(capture, white_dn))
    assert seen.column is not None
    assert (np.abs(seen.column - x) > 8).mean() < 1e-3


def test_exchanged_frames_are_named_and_refused() -> None:
    capture, x = all_columns(StructuredLight(320, 4, LineSweep()))
    frames = capture.frames.copy()
    frames[[10, 30]] = frames[[30, 10]]
    with pytest.warns(RangesimWarning, match="frames columns_line10 and columns_line30 seem to be exchanged"):
        image = decode(as_bytes(replace(capture, frames=frames)))
    assert (np.abs(image.projector_column - x) > 8).mean() < 0.03


def test_steps_wider_than_the_line_are_refused() -> None:
    with pytest.raises(ValueError, match="step_px to be at most twice line_px, got 20 and 6"):
        LineSweep(step_px=20.0)
