# SPDX-License-Identifier: Apache-2.0
"""Light off the window of a device: how much of it comes, where, and how a decoder tells it from a target."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import plane_signals, signals_of_depth, stereo_rig

from rangesim import (
    AmcwToF,
    DirectToF,
    IdealToF,
    SpadDetector,
    Status,
    StructuredLight,
    decode,
    expose,
    load_capture,
    save_capture,
)
from rangesim.causes import Cause, explain
from rangesim.electronics.detector import PLANCK_TIMES_C
from rangesim.instrument.instrument import Instrument, instrument_from_dict
from rangesim.response import SPEED_OF_LIGHT
from rangesim.rig import CoverGlass, Rig
from rangesim.sensors import DirectToFDecoder
from rangesim.settings.config import to_dict
from rangesim.signals import StillSignals

GLASS = CoverGlass(fraction=1e-12, path_m=0.006)
SENSOR = DirectToF(bins=128, bin_s=100e-12, start_s=-2e-9, pulse_fwhm_s=400e-12)
"""Its bins begin 20 bins before the pulse, so that the whole peak of the glass is in the histogram."""


def device(glass: CoverGlass | None = GLASS) -> Rig:
    return stereo_rig(16, 12, baseline_m=0.0, cover_glass=glass)


def wall_at(distance_m: float, glass: CoverGlass | None = GLASS) -> StillSignals:
    rig = device(glass)
    return signals_of_depth(rig, np.full((12, 16), distance_m), [SENSOR])


def test_a_glass_returns_its_fraction_of_the_power_to_each_pixel_at_its_path() -> None:
    """So many photons: fraction power time lambda / (h c), times the quantum efficiency."""
    extra = wall_at(1.0).frames(SENSOR) - wall_at(1.0, None).frames(SENSOR)
    place = (np.arange(128) + 0.5) @ extra.reshape(128, -1) / extra.reshape(128, -1).sum(axis=0)
    expected = (GLASS.path_m / SPEED_OF_LIGHT - SENSOR.start_s) / SENSOR.bin_s
    np.testing.assert_allclose(place, expected, atol=0.01)
    detector, rig, exposure_s = SpadDetector(dark_counts_hz=0.0), device(), 1e-3
    counts = detector.mean_electrons(extra, SENSOR.gate, rig, exposure_s).sum(axis=0)
    open_s = detector.pulses(SENSOR.gate, exposure_s) * SENSOR.period_s
    photons = GLASS.fraction * rig.projector_power_w * open_s * detector.wavelength_m / PLANCK_TIMES_C
    np.testing.assert_allclose(counts, detector.quantum_efficiency * photons, rtol=1e-4)


def test_an_amcw_camera_reads_the_sum_of_two_phasors() -> None:
    sensor, glass = AmcwToF((20e6,)), CoverGlass(1e-11, 0.006)
    rig = device(glass)
    signals = plane_signals(rig, sensor)
    image = decode(expose(signals, sensor))
    turns = 2 * np.pi * 20e6 / SPEED_OF_LIGHT
    wall = signals.energy.direct * np.exp(1j * turns * 2 * signals.truth.range_m.astype(np.float64))
    expected = np.angle(wall + rig.cover_glass_radiance * np.exp(1j * turns * glass.path_m)) / turns / 2
    np.testing.assert_allclose(image.range_m, expected, atol=1e-4)
    assert (image.range_m < signals.truth.range_m - 0.005).all()


def test_first_returns_do_not_see_the_glass_and_patterns_get_even_light_of_it() -> None:
    ideal, stripes, rig = IdealToF(), StructuredLight(64, 48), device()
    np.testing.assert_array_equal(
        plane_signals(rig, ideal).frames(ideal), plane_signals(device(None), ideal).frames(ideal)
    )
    extra = plane_signals(rig, stripes).frames(stripes) - plane_signals(device(None), stripes).frames(stripes)
    mean = stripes.patterns().reshape(stripes.n_frames, -1).mean(axis=1) / stripes.patterns().max()
    np.testing.assert_allclose(extra[:, 5, 5], rig.cover_glass_radiance * mean, rtol=2e-3, atol=1e-6)


# ---- Told from a target ----------------------------------------------------------------------------------------------

CAREFUL = DirectToFDecoder(min_range_m=0.05)
DIM = SpadDetector(bits=16, dark_counts_hz=0.0, quantum_efficiency=1e-4)
"""So that a wall close by does not pile up."""


def strong(signals: StillSignals, times: float) -> StillSignals:
    """The signals with a glass that returns so many times the light of a wall at 1 m."""
    radiance = 0.5 / np.pi * signals.rig.projector_irradiance
    fraction = times * radiance / signals.rig.cover_glass_radiance * GLASS.fraction
    return replace(signals, rig=replace(signals.rig, cover_glass=replace(GLASS, fraction=fraction)))


def test_the_strongest_return_may_be_the_glass_and_is_told_by_its_range() -> None:
    capture = expose(strong(wall_at(1.0), times=5.0), SENSOR)
    np.testing.assert_allclose(decode(capture).range_m, GLASS.path_m / 2, atol=2e-3)
    image = decode(capture, CAREFUL)
    wall = wall_at(1.0).truth.range_m
    assert image.valid.all()
    np.testing.assert_allclose(image.range_m, wall, atol=1e-4)
    assert image.returns is not None
    assert (image.returns.status[0] == Status.OUT_OF_RANGE).all()
    assert (image.returns.status[1] == Status.OK).all()
    np.testing.assert_allclose(image.returns.range_m[0], GLASS.path_m / 2, atol=1e-4)


@pytest.mark.parametrize("distance_m", [0.14, 0.2, 0.4])
def test_a_wall_close_behind_the_glass_is_not_pulled_towards_it(distance_m: float) -> None:
    signals = strong(wall_at(distance_m), times=20.0)
    image = decode(expose(signals, SENSOR, DIM, exposure_s=1e-3, seed=1), CAREFUL)
    assert image.valid.mean() > 0.98
    error = (image.range_m - signals.truth.range_m)[image.valid]
    assert image.returns is not None
    sigma = np.nanmedian(image.returns.sigma_m[1])
    assert abs(np.median(error)) < max(sigma, 1e-3)


def test_a_target_within_the_glass_s_peak_is_out_of_range_and_no_target_is_low_signal() -> None:
    exposure_s = 2e-2
    empty = strong(wall_at(np.nan), times=1.0)
    capture = expose(empty, SENSOR, DIM, exposure_s, seed=1)
    of_glass = decode(capture, CAREFUL)
    assert of_glass.returns is not None
    assert (of_glass.status == Status.OUT_OF_RANGE).all()  # without calibration it may be a target
    calibrated = replace(CAREFUL, cover_glass_counts=float(np.median(of_glass.returns.strength[0])))
    assert np.mean(decode(capture, calibrated).status == Status.LOW_SIGNAL) > 0.99
    touched = strong(wall_at(0.02), times=1.0)
    status = decode(expose(touched, SENSOR, DIM, exposure_s, seed=2), calibrated).status
    assert np.isin(status, [Status.OUT_OF_RANGE, Status.SATURATED]).all()


def test_what_the_glass_does_to_readings_is_explained() -> None:
    signals, near = strong(wall_at(1.0), times=5.0), strong(wall_at(0.03), times=0.001)
    for seen, decoder in ((signals, DirectToFDecoder()), (near, CAREFUL)):
        capture = expose(seen, SENSOR)
        assert (explain(decode(capture, decoder), capture, seen).cause == Cause.COVER_GLASS).all()
    assert not explain(decode(expose(signals, SENSOR), CAREFUL), expose(signals, SENSOR), signals).failed.any()


def test_no_glass_changes_no_byte_and_a_glass_is_kept_in_files(tmp_path: Path) -> None:
    assert Rig(device().camera, device().projector).cover_glass is None
    assert wall_at(1.0, None).frames(SENSOR).tobytes() == wall_at(1.0, CoverGlass(0.0)).frames(SENSOR).tobytes()
    save_capture(expose(wall_at(1.0), SENSOR, SpadDetector()), tmp_path / "capture")
    loaded = load_capture(tmp_path / "capture")
    assert loaded.rig is not None
    assert loaded.rig.cover_glass == GLASS
    instrument = Instrument("phone", SENSOR, cover_glass=GLASS)
    assert instrument_from_dict(to_dict(instrument), "one").cover_glass == GLASS
    for fraction in (-1e-9, 1.5):
        with pytest.raises(ValueError, match="fraction"):
            CoverGlass(fraction)
