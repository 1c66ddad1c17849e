# SPDX-License-Identifier: Apache-2.0
"""A ramp decodes to the place whose brightness it is; its noise follows the closed form; a gamma is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat_captures import all_columns, as_bytes, capture_at, noisy

from rangesim import decode
from rangesim.codes import RampCode
from rangesim.decoding.status import Status
from rangesim.errors import RangesimWarning
from rangesim.sensors import StructuredLight, StructuredLightDecoder


@pytest.mark.parametrize("size", [2, 37, 640, 1281])
@pytest.mark.parametrize("order", [(), ("white", "black", "*_ramp"), ("*_reverse", "white", "black")], ids=str)
def test_it_decodes_all_columns(size: int, order: tuple[str, ...]) -> None:
    sensor = StructuredLight(size, 4, RampCode(), order=order)
    capture, x = all_columns(sensor)
    image = decode(capture)
    assert (image.status == Status.OK).all()
    np.testing.assert_allclose(image.projector_column, np.tile(x, (4, 1)), atol=1e-3)


@pytest.mark.parametrize("order", [(), ("*_ramp", "white", "black"), ("*_reverse", "white", "black")], ids=str)
@pytest.mark.parametrize("white_dn", [300.0, 3000.0])
def test_errors_are_as_large_as_the_closed_form_says(order: tuple[str, ...], white_dn: float) -> None:
    """With equal noise, sigma is size / sqrt(2) sigma_I / contrast in the middle, and sqrt(2) times as much at the
    ends; without one of the ramps, it is larger."""
    sensor = StructuredLight(640, 4, RampCode(), order=order)
    capture, x = all_columns(sensor, rows=300)
    noisy_one = noisy(capture, white_dn)
    seen = StructuredLightDecoder().coordinates(noisy_one)
    assert seen.column is not None
    assert seen.column_sigma_px is not None
    inside = np.isfinite(seen.column) & (x > 60) & (x < 580)
    assert inside[:, 60:580].mean() > 0.95
    assert np.std(((seen.column - x) / seen.column_sigma_px)[inside]) == pytest.approx(1.0, abs=0.03)
    if not order:
        level = noisy_one.noise(noisy_one.frames[0].astype(np.float32))
        assert level is not None
        expected = 640 / np.sqrt(2) * level[:, 310:330].mean() / white_dn
        assert np.nanmean(seen.column_sigma_px[:, 310:330]) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("gamma", [0.5, 1.8, 2.2])
def test_a_gamma_is_named_with_its_value(gamma: float) -> None:
    sensor = StructuredLight(640, 4, RampCode())
    for capture in (capture_at(sensor, np.arange(640) + 0.5, 4, gamma), all_columns(sensor)[0]):
        for change in (lambda c: c, as_bytes, noisy):
            if capture.frames[0].mean() == pytest.approx(0.5, abs=0.01):
                decode(change(capture))  # silent
            else:
                with pytest.warns(RangesimWarning, match=f"a gamma of about {gamma:.1f} explains it"):
                    decode(change(capture))


def test_frames_in_another_order_are_named() -> None:
    capture, _ = all_columns(StructuredLight(640, 4, RampCode()))
    with pytest.warns(RangesimWarning, match="the ramps along columns contradict white and black: .* check the order"):
        decode(replace(capture, frames=capture.frames[[2, 0, 1, 3]]))


def test_pixels_whose_ramps_do_not_add_up_are_refused() -> None:
    capture, _ = all_columns(StructuredLight(640, 4, RampCode()), rows=40)
    frames = capture.frames.copy()
    frames[0, :4] += 0.3  # something moved in front of the camera
    image = decode(replace(capture, frames=frames))
    assert (image.status[:4] == Status.CODE_ERROR).all()
    assert (image.status[4:] == Status.OK).all()


def test_ramps_without_white_or_black_are_refused() -> None:
    with pytest.raises(ValueError, match="expected white and black among the frames"):
        StructuredLight(640, 4, RampCode(), order=("columns_*",))
    with pytest.raises(ValueError, match="expected an order with ramp or ramp_reverse, got white, black"):
        StructuredLight(640, 4, RampCode(), order=("white", "black"))
