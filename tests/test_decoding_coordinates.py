# SPDX-License-Identifier: Apache-2.0
"""The first step of decoders: coordinates without any geometry, with the standard deviations that noise gives them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig

from rangesim.capture.exposure import expose
from rangesim.codes import GrayPhase
from rangesim.decoding import decode
from rangesim.decoding.path_length import PathLengths
from rangesim.decoding.triangulation import ProjectorCoordinates
from rangesim.electronics.detector import Detector, PhotoDetector
from rangesim.electronics.spad import SpadDetector
from rangesim.sensor import Sensor
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, StructuredLight

BOTH = StructuredLight(axes=("columns", "rows"))
ALL = [BOTH, StructuredLight(code="gray"), AmcwToF(), DirectToF(), IdealToF()]


@pytest.mark.parametrize("sensor", ALL, ids=lambda sensor: sensor.details)
def test_coordinates_and_then_the_rig_are_the_range_image(sensor: Sensor) -> None:
    capture = expose(plane_signals(stereo_rig(), sensor, ambient=0.05), sensor, sensor.default_detector, seed=1)
    seen = sensor.default_decoder.coordinates(capture)
    image = decode(capture)
    again = seen.range_image(capture.rig)
    for name in ("z", "range_m", "status", "confidence", "intensity"):
        np.testing.assert_array_equal(getattr(again, name), getattr(image, name))
    assert image.valid.mean() > 0.5
    without = sensor.default_decoder.coordinates(replace(capture, rig=None))
    np.testing.assert_array_equal(without.status, seen.status)


@pytest.mark.parametrize(
    ("sensor", "detector", "exposure_s", "ambient"),
    [
        (BOTH, Detector(), 1e-4, 0.02),
        (StructuredLight(code=GrayPhase(20.0, 3)), Detector(), 2e-4, 0.0),
        (AmcwToF(), Detector.time_of_flight(), 1e-3, 0.02),
        (AmcwToF((30e6,)), Detector.time_of_flight(), 4e-4, 0.1),
        (AmcwToF(waveform="square"), Detector.time_of_flight(), 1e-3, 0.02),
        (DirectToF(), SpadDetector(pile_up=False), 2e-5, 0.0),
        (DirectToF(), SpadDetector(pile_up=False), 2e-4, 0.3),
        (DirectToF(), SpadDetector(), 2e-4, 0.05),
    ],
)
def test_standard_deviations_are_those_of_the_scatter(
    sensor: Sensor, detector: PhotoDetector, exposure_s: float, ambient: float
) -> None:
    """The errors of many pixels over their standard deviations scatter by about 1."""
    baseline_m = 0.2 if isinstance(sensor, StructuredLight) else 0.03
    signals = plane_signals(stereo_rig(baseline_m=baseline_m), sensor, ambient=ambient)
    decoder = sensor.default_decoder
    exact = decoder.coordinates(expose(signals, sensor))
    noisy = decoder.coordinates(expose(signals, sensor, detector, exposure_s, seed=2))
    if isinstance(exact, ProjectorCoordinates) and isinstance(noisy, ProjectorCoordinates):
        pairs = [(exact.column, noisy.column, noisy.column_sigma_px), (exact.row, noisy.row, noisy.row_sigma_px)]
    else:
        assert isinstance(exact, PathLengths)
        assert isinstance(noisy, PathLengths)
        pairs = [(exact.length_m, noisy.length_m, noisy.sigma_m)]
    for true, read, sigma in pairs:
        if true is None or read is None or sigma is None:
            assert len(pairs) == 2
            continue
        off = (read - true)[exact.valid & noisy.valid] / sigma[exact.valid & noisy.valid]
        assert len(off) > 5000
        assert np.std(off - np.median(off)) == pytest.approx(1.0, abs=0.05 if pairs[1:] else 0.2)
        assert np.isnan(sigma[~noisy.valid]).all()


def test_standard_deviations_that_nobody_knows_are_none() -> None:
    signals = plane_signals(stereo_rig(), BOTH, AmcwToF(), IdealToF())
    fringes = BOTH.default_decoder.coordinates(expose(signals, BOTH))
    assert fringes.column_sigma_px is None
    assert fringes.row_sigma_px is None
    for sensor in (AmcwToF(), IdealToF()):
        assert sensor.default_decoder.coordinates(expose(signals, sensor)).sigma_m is None  # type: ignore[attr-defined]


def test_a_gray_code_is_known_to_a_cell() -> None:
    sensor = StructuredLight(code="gray")
    signals = plane_signals(stereo_rig(), sensor)
    seen = sensor.default_decoder.coordinates(expose(signals, sensor))
    assert seen.column is not None
    assert seen.column_sigma_px is not None
    off = (seen.column - signals.truth.projector_uv[..., 0])[seen.valid]
    assert np.abs(off).max() <= 0.5 + 1e-4
    assert np.nanmax(seen.column_sigma_px) == pytest.approx(12**-0.5)
    assert np.sqrt((off**2).mean()) == pytest.approx(12**-0.5, rel=0.05)


@pytest.mark.parametrize("sensor", ALL, ids=lambda sensor: sensor.details)
def test_a_white_image_shows_the_scene(sensor: Sensor) -> None:
    signals = plane_signals(stereo_rig(), sensor)
    image = sensor.white_image(expose(signals, sensor).frames)
    lit = signals.truth.projector_visible
    assert image.shape == lit.shape
    if not sensor.is_ideal:
        assert image[lit].min() > 2 * image[~lit].max(initial=0.0)
