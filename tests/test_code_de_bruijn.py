# SPDX-License-Identifier: Apache-2.0
"""De Bruijn stripes: windows are unique, edges give fractions of a stripe, and what fits no window is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat_captures import all_columns, as_bytes, noisy
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import plane_signals, stereo_rig

from rangesim import decode, expose
from rangesim.capture import Capture
from rangesim.codes import DeBruijnStripes
from rangesim.codes.de_bruijn import COLOURS, MAX_FALSE, stripe_sequence
from rangesim.decoding.status import Status
from rangesim.electronics.detector import Detector
from rangesim.errors import RangesimWarning
from rangesim.sensors import StructuredLight


@pytest.mark.parametrize("n", [8, 34, 128, 400])
def test_neighbours_differ_and_windows_are_unique(n: int) -> None:
    colours, window, table = stripe_sequence(n)
    assert len(colours) == n
    assert (np.diff(colours) != 0).all()
    rows = {tuple(colours[i : i + window]) for i in range(n - window + 1)}
    assert len(rows) == n - window + 1 == np.count_nonzero(table >= 0)
    assert n <= MAX_FALSE * 6 * 5 ** (window - 1)


@settings(max_examples=15, deadline=None)
@given(st.integers(60, 400), st.integers(3, 7), st.sampled_from(["columns", "rows"]))
def test_it_decodes_all_columns(size: int, stripe_px: int, axis: str) -> None:
    shape = (size, 4) if axis == "columns" else (4, size)
    sensor = StructuredLight(*shape, DeBruijnStripes(stripe_px), (axis,))  # type: ignore[arg-type]
    for frames in (sensor.patterns(), np.rint(10 + 200 * sensor.patterns()).astype(np.uint8)):
        image = decode(Capture(frames, sensor))
        assert (image.status == Status.OK).all()
        found = image.projector_column if axis == "columns" else image.projector_row
        assert found is not None
        x = np.arange(size) + 0.5
        assert np.abs(found - (x if axis == "columns" else x[:, None])).max() < 0.02


def seen_at(sensor: StructuredLight, edges: np.ndarray) -> Capture:
    """Capture of camera pixels, each the mean of the patterns between two edges (n + 1,), projector pixels."""
    table = sensor.patterns()[:, 0]
    total = np.concatenate([np.zeros((len(table), 1)), np.cumsum(table, axis=1)], axis=1)
    place = np.arange(table.shape[1] + 1)
    frames = np.array([np.diff(np.interp(edges, place, one)) / np.diff(edges) for one in total])
    return Capture(np.repeat(frames[:, None], 4, axis=1).astype(np.float32), sensor)


@pytest.mark.parametrize("pixel_px", [0.37, 1.3, 2.6])
def test_places_within_stripes_are_found_on_a_plane(pixel_px: float) -> None:
    sensor = StructuredLight(640, 4, DeBruijnStripes())
    edges = np.arange(20.3, 620.0, pixel_px)
    image = decode(seen_at(sensor, edges))
    x = 0.5 * (edges[1:] + edges[:-1])
    inside = (x > 40) & (x < 600)
    assert image.projector_column is not None
    assert image.valid[:, inside].mean() > 0.99
    assert np.nanmax(np.abs(image.projector_column - x)[:, inside]) < 0.02


@pytest.mark.parametrize("exposure_s", [None, 1e-3])
def test_a_plane_is_read_to_a_small_fraction_of_a_stripe(exposure_s: float | None) -> None:
    rig, sensor = stereo_rig(320, 24), StructuredLight(code=DeBruijnStripes(20))
    signals = plane_signals(rig, sensor, ambient=0.01)
    capture = expose(signals, sensor, Detector(), exposure_s=exposure_s) if exposure_s else expose(signals, sensor)
    image = decode(capture)
    error = image.projector_column - signals.truth.projector_uv[..., 0]
    lit = signals.truth.projector_visible
    assert image.valid[lit].mean() > 0.8
    # Rays at the centres of pixels see sharp edges, so an edge is known to half a pixel of the camera, which is as wide
    # as 3 to 4 pixels of the projector; beyond the last edge, it is twice as much.
    assert np.nanmax(np.abs(error)) < 4


def test_pieces_of_different_places_are_read_right_or_refused() -> None:
    """Surfaces of 3 to 20 stripes, side by side at random: a window across two of them hardly ever fits."""
    sensor, rng = StructuredLight(1280, 4, DeBruijnStripes()), np.random.default_rng(3)
    table = sensor.patterns()[:, 0]
    lines = []
    for _ in range(60):
        x = np.empty(0)
        while len(x) < 1280:
            first = rng.integers(0, 1100)
            x = np.concatenate([x, np.arange(first, first + 10 * rng.integers(3, 20))])
        lines.append(np.minimum(x[:1280], 1279).astype(int))
    place = np.array(lines)
    image = decode(Capture(np.ascontiguousarray(table[:, place]), sensor))
    wrong = np.abs(image.projector_column - (place + 0.5)) > 1
    assert image.valid.mean() > 0.5
    assert wrong.sum() / image.valid.sum() < 0.005


def test_a_stripe_across_two_surfaces_is_refused() -> None:
    """Its places were interpolated as on one surface, and up to 4 projector pixels wrong with status OK."""
    sensor = StructuredLight(640, 4, DeBruijnStripes())
    for hidden_px in (2.0, 4.0, 6.0):
        place = np.arange(100.3, 540.0, 1.25)
        place = np.where(place < 323.0, place, place + hidden_px)  # behind the edge, so many pixels are in shadow
        image = decode(seen_at(sensor, place))
        x = 0.5 * (place[1:] + place[:-1])
        inside = (x > 120) & (x < 530)
        assert np.nanmax(np.abs(image.projector_column - x)[:, inside]) < 0.7
        assert image.valid[:, inside].mean() > 0.95


def test_random_stripes_are_refused() -> None:
    sensor, rng = StructuredLight(1280, 4, DeBruijnStripes()), np.random.default_rng(0)
    steps = rng.integers(1, 6, (100, 128)).cumsum(axis=1) % 6
    lit = COLOURS[np.repeat(steps, 10, axis=1)].transpose(2, 0, 1).astype(np.float32)
    frames = np.concatenate([lit, np.ones_like(lit[:1]), np.zeros_like(lit[:1])])
    with pytest.warns(RangesimWarning, match="check the size of the projector, the order of the frames"):
        image = decode(Capture(frames, sensor))
    assert image.valid.mean() < 0.03


def test_mirrored_images_and_exchanged_channels_are_named() -> None:
    capture, _ = all_columns(StructuredLight(640, 4, DeBruijnStripes()))
    with pytest.warns(RangesimWarning, match="check that no image is mirrored"):
        image = decode(replace(capture, frames=np.ascontiguousarray(capture.frames[:, :, ::-1])))
    assert image.valid.mean() < 0.05
    for order, words in (((1, 0, 2), "green, red, blue"), ((1, 2, 0), "blue, red, green")):
        with pytest.warns(RangesimWarning, match=f"if the frames are taken as {words}: check their order"):
            image = decode(replace(capture, frames=capture.frames[[*order, 3, 4]]))
        assert image.valid.mean() < 0.1


@pytest.mark.parametrize("white_dn", [30.0, 100.0, 3000.0])
def test_noise_is_refused_or_harmless(white_dn: float) -> None:
    capture, x = all_columns(StructuredLight(640, 4, DeBruijnStripes()), rows=60)
    image = decode(noisy(capture, white_dn))
    assert np.count_nonzero(np.abs(image.projector_column - x) > 2) < 0.002 * image.status.size
    assert image.valid.mean() > (0.99 if white_dn == 3000 else 0)


def test_three_frames_are_enough() -> None:
    sensor = StructuredLight(640, 4, DeBruijnStripes(), order=("columns_*",))
    capture, x = all_columns(sensor)
    image = decode(as_bytes(capture))
    assert image.valid.all()
    assert np.abs(image.projector_column - x).max() < 0.02


def test_too_few_stripes_are_refused() -> None:
    with pytest.raises(ValueError, match="expected at least 5 stripes, got 4 of 10 px for 40 px"):
        StructuredLight(40, 4, DeBruijnStripes())
