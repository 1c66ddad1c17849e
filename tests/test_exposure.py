# SPDX-License-Identifier: Apache-2.0
"""Exposure obeys EMVA 1288: photon transfer, saturation, dark signal; and repeats with its seed."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest
from synthetic import plane_signals, signals_of_depth, stereo_rig

from rangesim.capture import BRIGHT_PERCENTILE
from rangesim.capture.exposure import TARGET_FRACTION, expose, exposed
from rangesim.electronics.detector import Detector, PhotoDetector
from rangesim.electronics.spad import SpadDetector
from rangesim.errors import RangesimWarning
from rangesim.experiment import Experiment
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.experiment_run import measure
from rangesim.response import SPEED_OF_LIGHT
from rangesim.rig import Intrinsics
from rangesim.sensors import AmcwToF, DirectToF, IdealToF, Sensor, StructuredLight
from rangesim.settings.config import from_dict, to_dict

SENSOR = StructuredLight(code="gray")


def uniform_frames(radiance: np.ndarray, detector: Detector, exposure_s: float, seed: int = 0) -> np.ndarray:
    """Frames (k, 200, 200) of uniform radiance each."""
    rig = stereo_rig(200, 200)
    frames = np.broadcast_to(np.asarray(radiance, dtype=np.float32)[:, None, None], (len(radiance), 200, 200))
    return detector.read_out(frames, SENSOR.gate, rig, exposure_s, seed).astype(np.float64)


def test_photons_follow_from_the_etendue() -> None:
    """E = L pi (a/f)^2 on a pixel of 5 um, by hand."""
    detector = Detector(quantum_efficiency=0.5)
    rig = dataclasses.replace(stereo_rig(), camera=Intrinsics(100, 100, 800, 800, 50, 50))
    irradiance = 2.0 * np.pi * (rig.camera_lens.aperture_radius_m / (800 * 5e-6)) ** 2
    photons = irradiance * (5e-6) ** 2 * 1e-3 * detector.wavelength_m / (6.62607015e-34 * 299792458)
    assert np.isclose(detector.electron_rate_per_radiance(rig) * 2.0 * 1e-3, 0.5 * photons)


def test_photon_transfer_curve_has_the_gain_for_slope_and_the_read_noise_at_zero() -> None:
    """EMVA 1288: sigma_y^2 = K^2 sigma_d^2 + 1/12 + K (mu_y - mu_y.dark)."""
    detector = Detector(read_noise_e=8.0, dark_current_e_s=0.0, offset_dn=40.0)
    rig = stereo_rig(200, 200)
    level = 0.7 * detector.full_well_e / (detector.electron_rate_per_radiance(rig) * 1e-3)
    frames = uniform_frames(np.linspace(0, level, 12), detector, 1e-3)
    mean, variance = frames.mean(axis=(1, 2)), frames.var(axis=(1, 2))
    slope, start = np.polyfit(mean - detector.offset_dn, variance, 1)
    k = detector.gain_dn_e
    assert abs(slope / k - 1) < 0.02
    assert abs(variance[0] / (k**2 * 64 + 1 / 12) - 1) < 0.03
    np.testing.assert_allclose(np.sqrt(variance), detector.noise_dn(mean), rtol=0.02)
    expected = detector.offset_dn + k * 0.7 * detector.full_well_e
    assert abs(mean[-1] / expected - 1) < 1e-3
    assert start > 0


def test_dark_current_grows_with_time() -> None:
    detector = Detector(dark_current_e_s=1000.0)
    for seconds in (0.1, 1.0):
        dark = uniform_frames(np.zeros(1), detector, seconds).mean()
        assert abs(dark - detector.offset_dn - detector.gain_dn_e * 1000 * seconds) < 0.1


@pytest.mark.parametrize("bits", [8, 10, 16])
def test_saturated_pixels_read_the_largest_number(bits: int) -> None:
    detector = Detector(bits=bits, offset_dn=4.0)
    rig = stereo_rig(200, 200)
    radiance = np.array([2.0, 1e6]) * detector.full_well_e / detector.electron_rate_per_radiance(rig)
    frames = detector.read_out(
        np.broadcast_to(radiance[:, None, None], (2, 200, 200)), SENSOR.gate, rig, exposure_s=1.0, seed=0
    )
    assert frames.dtype == (np.uint8 if bits <= 8 else np.uint16)
    assert (frames == 2**bits - 1).all()


def test_auto_exposure_puts_the_bright_pixels_at_its_target() -> None:
    rig, detector = stereo_rig(), Detector()
    for ambient in (0.0, 5.0):
        capture = expose(plane_signals(rig, SENSOR, ambient=ambient), SENSOR, detector)
        assert capture.exposure_is_automatic
        brightest = (capture.frames.max(axis=0) - detector.offset_dn) / (detector.max_dn - detector.offset_dn)
        assert abs(np.percentile(brightest, BRIGHT_PERCENTILE) - TARGET_FRACTION) < 0.03
        assert not capture.saturated(capture.frames).any()
    limited = dataclasses.replace(detector, min_exposure_s=0.05)
    assert expose(plane_signals(rig, SENSOR), SENSOR, limited).exposure_s == 0.05
    nothing = signals_of_depth(rig, np.full((120, 160), np.nan), [SENSOR])
    assert expose(nothing, SENSOR, detector).exposure_s == detector.max_exposure_s


@pytest.mark.parametrize(
    ("sensor", "detector"), [(SENSOR, Detector()), (AmcwToF(), Detector.time_of_flight())], ids=["lines", "amcw"]
)
@pytest.mark.parametrize("distance_m", [0.1, 1.0])
def test_light_too_strong_for_the_shortest_exposure_is_said_with_its_share(
    sensor: Sensor, detector: Detector, distance_m: float
) -> None:
    """A part of 60 mm before the default lamp lost 78 % of its matte table to saturation, and nothing said why."""
    rig, detector = stereo_rig(baseline_m=0.01), dataclasses.replace(detector, max_exposure_s=1.0)
    z = np.where(np.arange(rig.camera.width) < 60, np.nan, distance_m) * np.ones((rig.camera.height, 1))
    strong, weak = (
        signals_of_depth(dataclasses.replace(rig, projector_power_w=power_w), z, [sensor]) for power_w in (1.0, 0.3)
    )
    faint = np.full_like(strong.energy.ambient, 1e-3 * strong.energy.direct.max())  # also where nothing reflects
    signals = dataclasses.replace(strong, energy=dataclasses.replace(strong.energy, ambient=faint))
    fitting_s = expose(signals, sensor, dataclasses.replace(detector, min_exposure_s=1e-12)).exposure_s
    lit = signals.energy.projector > 0
    assert lit.mean() < 0.7
    # The bright pixels fill 70 % of the well in `fitting_s`, so all of it in 1.43 of that
    short, long = (dataclasses.replace(detector, min_exposure_s=factor * fitting_s) for factor in (1.3, 3.0))
    near = Instrument("near", sensor, long)
    with pytest.warns(
        RangesimWarning, match=r"near: the detector's shortest .* take less light .its power_w is 1."
    ) as said:
        capture = measure(Experiment("-", instruments=(near,)), near, signals, None).capture
    saturated = np.mean(capture.saturated(capture.frames)[lit])
    told = float(str(said[0].message).split("saturates ")[1].split(" %")[0])
    assert saturated > 0.5
    assert abs(told / 100 - saturated) <= 0.005
    for instrument, light in (
        (dataclasses.replace(near, detector=short), signals),
        (dataclasses.replace(near, exposure_s=long.min_exposure_s), signals),  # who says how long knows
        (near, weak),
    ):
        with warnings.catch_warnings(record=True) as said_else:
            warnings.simplefilter("always")
            measure(Experiment("-", instruments=(instrument,)), instrument, light, None)
        assert not [w for w in said_else if "shortest exposure" in str(w.message)]


@pytest.mark.parametrize(
    ("sensor", "detector"),
    [(SENSOR, Detector()), (AmcwToF(), Detector.time_of_flight()), (DirectToF(bins=80), SpadDetector())],
)
def test_same_seed_same_bytes_and_every_frame_its_own_noise(sensor: Sensor, detector: PhotoDetector) -> None:
    signals = plane_signals(stereo_rig(80, 60), sensor, ambient=0.05)
    one, two, other = (expose(signals, sensor, detector, seed=s).frames for s in (7, 7, 8))
    assert one.tobytes() == two.tobytes()
    assert one.tobytes() != other.tobytes()
    level = 0.5 * Detector().full_well_e / Detector().electron_rate_per_radiance(signals.rig) / 1e-3
    flat = np.full((2, 60, 80), level)
    a, b = Detector().read_out(flat, SENSOR.gate, signals.rig, 1e-3, seed=1).astype(float)
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.05


def test_the_filter_holds_back_ambient_light() -> None:
    rig, ambient = stereo_rig(), 0.5
    signals = plane_signals(rig, SENSOR, ambient=ambient)
    detector = Detector(ambient_transmission=0.1, dark_current_e_s=0.0)
    capture = expose(signals, SENSOR, detector, exposure_s=2e-4)
    black = capture.frames[-1].mean() - detector.offset_dn
    expected = 0.1 * ambient * detector.electron_rate_per_radiance(rig) * 2e-4 * detector.gain_dn_e
    assert abs(black / expected - 1) < 0.02


def test_photon_counts_are_poisson() -> None:
    rig, sensor = stereo_rig(200, 200), DirectToF(bins=4, pulse_fwhm_s=0.0)
    detector = SpadDetector(dark_counts_hz=0.0, bits=16, pile_up=False)
    radiance = 50 / detector.electron_rate_per_radiance(rig) / 1e-3
    counts = detector.read_out(np.full((4, 200, 200), radiance), sensor.gate, rig, 1e-3, seed=0)
    assert abs(counts.mean() / 50 - 1) < 0.01
    assert abs(counts.var() / 50 - 1) < 0.02


@pytest.mark.parametrize("start_s", [0.0, 6e-9, 24e-9])
def test_the_laser_fires_again_only_when_the_histogram_is_full(start_s: float) -> None:
    """Per second: signal at the mean power of the laser, ambient and dark counts while the histogram is open."""
    rig, sensor = stereo_rig(), DirectToF(bins=80, bin_s=100e-12, start_s=start_s)
    signals = signals_of_depth(rig, np.full((120, 160), (start_s + 5e-9) * SPEED_OF_LIGHT / 2), [sensor], ambient=2.0)
    detector = SpadDetector(bits=16, dark_counts_hz=2e5, ambient_transmission=0.5, pile_up=False)
    exposure = 1e-3
    assert detector.pulses(sensor.gate, exposure) == round(exposure / (start_s + 8e-9))
    open_s = exposure * 8e-9 / (start_s + 8e-9)
    counts = expose(signals, sensor, detector, exposure).frames.sum(axis=0).mean()
    per_second = detector.electron_rate_per_radiance(rig)
    signal = signals.channels[sensor.responses()[0]].sum(axis=0).mean() * per_second * exposure
    expected = signal + (0.5 * 2.0 * per_second + 2e5) * open_s
    assert abs(counts / expected - 1) < 0.01


@pytest.mark.parametrize(
    ("width", "wall_m", "power_w", "albedo", "laser"),
    [
        (32, 2.0, 10.0, 0.5, "periodic"),
        (64, 2.0, 10.0, 0.5, "periodic"),
        (32, 0.2, 1.0, 0.9, "single-shot"),
        (160, 3.0, 0.1, 0.1, "periodic"),
    ],
)
@pytest.mark.parametrize("pile_up", [True, False])
def test_photons_per_pulse_of_a_plain_wall_are_those_by_hand(
    width: int, wall_m: float, power_w: float, albedo: float, laser: str, pile_up: bool
) -> None:
    """A pulse's energy over the wall that the projector lights, and what the lens catches of a pixel's patch."""
    rig = stereo_rig(width, width * 3 // 4, baseline_m=0.0, projector_power_w=power_w)
    sensor = DirectToF(laser=laser)
    detector = SpadDetector(pile_up=pile_up, dark_counts_hz=1e5, ambient_transmission=0.5)
    depth = np.full((rig.camera.height, rig.camera.width), wall_m)
    signals = signals_of_depth(rig, depth, [sensor], albedo=albedo, ambient=0.3)
    period_s = sensor.bins * sensor.bin_s
    per_joule = detector.quantum_efficiency * detector.wavelength_m / (6.62607015e-34 * 299792458)
    camera, projector = rig.camera, rig.projector
    lit_m2 = (projector.width / projector.fx) * (projector.height / projector.fy) * wall_m**2
    patch_m2 = wall_m**2 / (camera.fx * camera.fy)
    caught = albedo * (rig.camera_lens.aperture_radius_m / wall_m) ** 2  # pi a^2 / z^2 of albedo / pi
    laser_photons = power_w * period_s * patch_m2 / lit_m2 * caught * per_joule
    lens_m2 = np.pi * rig.camera_lens.aperture_radius_m**2
    ambient_photons = 0.5 * 0.3 * lens_m2 / (camera.fx * camera.fy) * period_s * per_joule
    found = exposed(signals, sensor, detector, 1e-4).photons_per_pulse()
    assert found is not None
    assert found.shape == depth.shape
    np.testing.assert_allclose(found, laser_photons + ambient_photons + 1e5 * period_s, rtol=1e-3)


def test_photons_per_pulse_are_what_the_counts_say() -> None:
    """A histogram of first photons has a count of 1 - exp(-photons) of the pulses, one of all photons their mean."""
    rig, sensor = stereo_rig(60, 40, baseline_m=0.0, projector_power_w=0.5), DirectToF()
    signals = plane_signals(rig, sensor, distance_m=1.5, ambient=0.2)
    for detector in (SpadDetector(bits=16), SpadDetector(bits=16, pile_up=False)):
        exposure = exposed(signals, sensor, detector, 1e-3)
        capture, photons = exposure.capture, exposure.photons_per_pulse()
        pulses = detector.pulses(sensor.gate, 1e-3)
        assert photons is not None
        assert 0.1 < np.median(photons) < 3
        counted = -np.expm1(-photons) if detector.pile_up else photons
        assert abs(capture.frames.sum(axis=0).mean() / pulses / counted.mean() - 1) < 1e-3


def test_detectors_that_integrate_know_no_photons_per_pulse() -> None:
    rig, counting = stereo_rig(), DirectToF()
    signals = plane_signals(rig, SENSOR, counting)
    assert exposed(signals, SENSOR, Detector()).photons_per_pulse() is None
    assert exposed(signals, counting).photons_per_pulse() is None  # noise-free


def test_without_a_detector_frames_are_the_radiance() -> None:
    signals = plane_signals(stereo_rig(), SENSOR, IdealToF(), ambient=0.1)
    capture = expose(signals, SENSOR)
    np.testing.assert_array_equal(capture.frames, signals.frames(SENSOR))
    assert capture.frames.dtype == np.float32
    assert capture.detector is None
    assert np.isnan(capture.exposure_s)
    assert expose(signals, IdealToF(), Detector()).detector is None
    assert not capture.exposure_is_automatic
    assert not expose(signals, SENSOR, Detector(), exposure_s=1e-3).exposure_is_automatic


def test_detectors_are_settings() -> None:
    for detector in (Detector.ideal(), Detector.time_of_flight(), SpadDetector(pile_up=True)):
        assert from_dict(PhotoDetector, to_dict(detector)) == detector  # type: ignore[type-abstract]


@pytest.mark.parametrize(
    ("cls", "wrong"),
    [
        (Detector, {"bits": 0}),
        (Detector, {"bits": 17}),
        (Detector, {"quantum_efficiency": 1.5}),
        (Detector, {"full_well_e": 0.0}),
        (Detector, {"offset_dn": 5000.0}),
        (Detector, {"read_noise_e": -1.0}),
        (Detector, {"ambient_transmission": 2.0}),
        (Detector, {"min_exposure_s": 1.0, "max_exposure_s": 0.1}),
        (SpadDetector, {"dark_counts_hz": -1.0}),
    ],
)
def test_impossible_detectors_are_refused(cls: type[PhotoDetector], wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        cls(**wrong)


def test_impossible_exposures_are_refused() -> None:
    signals = plane_signals(stereo_rig(), SENSOR, DirectToF(bins=4, pulse_fwhm_s=0.0))
    for exposure in (0.0, -1.0, float("inf")):
        with pytest.raises(ValueError, match="exposure_s to be positive and finite"):
            expose(signals, SENSOR, Detector(), exposure)
    with pytest.raises(ValueError, match="expected a sensor that counts photons"):
        expose(signals, SENSOR, SpadDetector(), 1e-3)
    with pytest.raises(ValueError, match="SpadDetector"):
        expose(signals, DirectToF(bins=4, pulse_fwhm_s=0.0), Detector(), 1e-3)
    with pytest.raises(ValueError, match="run transport with this sensor"):
        expose(signals, AmcwToF(), Detector(), 1e-3)


def test_an_exposure_without_a_detector_is_refused() -> None:
    signals = plane_signals(stereo_rig(8, 6), SENSOR)
    with pytest.raises(ValueError, match="expected a detector with exposure_s"):
        expose(signals, SENSOR, exposure_s=1e-3)
