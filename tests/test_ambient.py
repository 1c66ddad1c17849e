# SPDX-License-Identifier: Apache-2.0
"""Ambient light: bands of its spectrum, its strength in lux, and the shot noise it brings."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from synthetic import plane_signals, signals_of_depth, stereo_rig

from rangesim import Ambient, AmcwToF, Capture, Detector, DirectToF, SpadDetector, StructuredLight, expose, save_capture
from rangesim import load_capture as load
from rangesim.electronics.ambient import LUMINOUS_EFFICACY, Sun, Tungsten, WhiteLed, photopic
from rangesim.electronics.detector import PhotoDetector
from rangesim.electronics.sunlight import EDGES_NM, SPECTRAL_W_M2_NM, TOTAL_W_M2
from rangesim.settings.config import from_dict, to_dict

SENSOR = StructuredLight(code="gray")


def planck(wavelength_m: np.ndarray, temperature_k: float) -> np.ndarray:
    """Exitance per wavelength, W/m3."""
    h, c, k = 6.62607015e-34, 299792458.0, 1.380649e-23
    return np.asarray(2 * np.pi * h * c**2 / wavelength_m**5 / np.expm1(h * c / (wavelength_m * k * temperature_k)))


@pytest.mark.parametrize("temperature_k", [2700.0, 2856.0, 5778.0])
def test_shares_of_a_black_body_are_integrals_of_planck_s_law(temperature_k: float) -> None:
    whole = 5.670374419e-8 * temperature_k**4  # Stefan and Boltzmann
    for low, high in [(825, 875), (925, 955), (380, 780), (1500, 3000)]:
        wavelength = np.linspace(low, high, 20_001) * 1e-9
        expected = np.trapezoid(planck(wavelength, temperature_k), wavelength) / whole
        assert Tungsten(temperature_k).fraction(low, high) == pytest.approx(expected, rel=1e-6)
    assert Tungsten(temperature_k).fraction(1, 1e5) == pytest.approx(1, abs=1e-4)


def test_the_eye_s_sensitivity() -> None:
    """CIE 1924: 1 at 555 nm, a half at 510 and 610 nm; the fit is good to 0.008."""
    np.testing.assert_allclose(photopic([555, 510, 610, 450, 650]), [1, 0.503, 0.503, 0.038, 0.107], atol=0.008)


def test_luminous_efficacies_are_those_of_the_handbooks() -> None:
    wavelength = np.linspace(380, 780, 4001)
    by_hand = np.trapezoid(photopic(wavelength) * planck(wavelength * 1e-9, 2856.0), wavelength * 1e-9)
    assert Tungsten(2856.0).efficacy_lm_w == pytest.approx(
        LUMINOUS_EFFICACY * by_hand / (5.670374419e-8 * 2856.0**4), rel=1e-3
    )
    assert Sun().efficacy_lm_w == pytest.approx(109.5, rel=0.01)  # full sun: 1000 W/m2 are about 110 klx
    assert WhiteLed().efficacy_lm_w == pytest.approx(316.9, rel=0.01)  # CIE LED-B3, from its table


def test_the_sun_s_table_is_that_of_the_standard() -> None:
    """ASTM G173 states 1000.4 W/m2 in all; the water band at 940 nm and the oxygen line at 760 nm are there."""
    assert pytest.approx(1000.4, abs=0.1) == TOTAL_W_M2
    assert len(SPECTRAL_W_M2_NM) == len(EDGES_NM) - 1
    at = dict(zip(EDGES_NM, SPECTRAL_W_M2_NM, strict=False))
    assert at[935.0] < 0.5 * at[980.0] < at[860.0]
    assert at[760.0] < 0.5 * at[750.0]
    assert Sun().fraction(925, 955) < 0.45 * Sun().fraction(835, 865)
    with pytest.raises(ValueError, match="300 to 1100 nm for sunlight, got 1525"):
        Sun().fraction(1525, 1575)


def test_the_sun_s_table_agrees_with_pvlib_s_copy() -> None:
    """Every bin against the fine table of another package, if it is installed."""
    spec = importlib.util.find_spec("pvlib")
    if spec is None or spec.origin is None:
        pytest.skip("pvlib is not installed")
    path = Path(spec.origin).parent / "data" / "ASTMG173.csv"
    wavelength, _, irradiance, _ = np.loadtxt(path, delimiter=",", skiprows=2, unpack=True)
    for low, high, mean in zip(EDGES_NM[:-1], EDGES_NM[1:], SPECTRAL_W_M2_NM, strict=True):
        fine = np.linspace(low, high, 201)
        expected = np.trapezoid(np.interp(fine, wavelength, irradiance), fine) / (high - low)
        assert mean == pytest.approx(expected, abs=2e-4)
    assert np.trapezoid(irradiance, wavelength) == pytest.approx(TOTAL_W_M2, abs=0.01)


def test_a_led_sends_next_to_nothing_at_850_nm() -> None:
    """Per lux, sunlight brings about 5000 times as much light into a band at 850 nm, and tungsten even more."""
    sun, tungsten, led = (
        Ambient(kind, illuminance_lux=1000.0).in_band(850e-9, 50e-9)  # type: ignore[arg-type]
        for kind in ("sun", "tungsten", "led")
    )
    assert led < 1e-3 * sun
    assert 3 * sun < tungsten < 5 * sun
    assert Ambient("sun").in_band(940e-9, 30e-9) < 0.45 * Ambient("sun").in_band(850e-9, 30e-9)


def test_strength_in_lux_and_in_watts_say_the_same() -> None:
    lux = Ambient("sun", illuminance_lux=50_000.0)
    watts = Ambient("sun", irradiance_w_m2=50_000.0 / Sun().efficacy_lm_w)
    assert lux.scale == pytest.approx(watts.scale)
    assert lux.scale == pytest.approx(456.6, rel=0.01)  # W/m2
    assert dataclasses.replace(lux, scene_irradiance_w_m2=2.0).scale == pytest.approx(lux.scale / 2)
    assert Ambient("led").scale == 1.0  # the scene's units at their word


def test_the_default_transmission_is_sunlight_in_the_default_band() -> None:
    for detector in (Detector(), Detector.time_of_flight(), SpadDetector()):
        fraction = Ambient("sun").in_band(detector.wavelength_m, detector.band_width_m)
        assert fraction == pytest.approx(detector.ambient_transmission, rel=0.1)
    assert Ambient("sun").in_band(850e-9, Detector.ideal().band_width_m) == 0


# ---- On captures -------------------------------------------------------------------------------------


def electrons(capture: Capture) -> np.ndarray:
    """(k, h, w) electrons of the frames of an EMVA detector."""
    assert isinstance(capture.detector, Detector)
    return np.asarray((capture.frames.astype(float) - capture.detector.offset_dn) / capture.detector.gain_dn_e)


def test_sunlight_on_a_capture_is_what_the_law_says() -> None:
    """In the black frame: electrons = ambient radiance times scale times fraction times etendue."""
    detector = Detector(dark_current_e_s=0.0, full_well_e=40_000.0)
    signals = plane_signals(stereo_rig(), SENSOR, ambient=0.5 / np.pi)  # half of a scene's 1 W/m2 comes back
    sun = Ambient("sun", illuminance_lux=20_000.0)
    capture = expose(signals, SENSOR, detector, exposure_s=2e-5, ambient=sun)
    expected = 0.5 / np.pi * 20_000 / Sun().efficacy_lm_w * Sun().fraction(825, 875)
    expected *= detector.electron_rate_per_radiance(signals.rig) * 2e-5
    assert electrons(capture)[-1].mean() == pytest.approx(expected, rel=0.01)
    np.testing.assert_allclose(
        expose(signals, SENSOR, ambient=sun).frames[-1], sun.scale * signals.energy.ambient, rtol=1e-5
    )


def test_without_a_stated_light_nothing_changes() -> None:
    signals = plane_signals(stereo_rig(), SENSOR, ambient=0.3)
    one = expose(signals, SENSOR, Detector(), seed=3)
    two = expose(signals, SENSOR, Detector(band_width_m=10e-9), seed=3)
    assert one.frames.tobytes() == two.frames.tobytes()


@pytest.mark.parametrize("width_m", [80e-9, 20e-9])
def test_ambient_light_brings_its_shot_noise(width_m: float) -> None:
    """Signal-to-noise of a pixel: S / sqrt(S + A + sigma_d^2), with A in proportion to the band."""
    detector = Detector(dark_current_e_s=0.0, full_well_e=60_000.0, bits=16, band_width_m=width_m)
    rig = stereo_rig(400, 300)
    flat = np.ones((300, 400), np.float32)
    exposure, per_radiance = 1e-4, detector.electron_rate_per_radiance(rig) * 1e-4
    signal_e, ambient = 2000.0, Ambient("sun", irradiance_w_m2=300.0)
    dark = signals_of_depth(rig, np.full((300, 400), 1.0), [SENSOR], albedo=0.0, ambient=1.0)
    ambient_e = ambient.in_band(850e-9, width_m) * per_radiance
    frames = np.stack([(signal_e / per_radiance + ambient.in_band(850e-9, width_m)) * flat])
    lit = detector.read_out(frames, SENSOR.gate, rig, exposure, seed=5)[0].astype(float) / detector.gain_dn_e
    noise = np.sqrt(signal_e + ambient_e + detector.read_noise_e**2)
    assert signal_e / lit.std() == pytest.approx(signal_e / noise, rel=0.01)
    black = electrons(expose(dark, SENSOR, detector, exposure, ambient=ambient))[-1]
    assert black.mean() == pytest.approx(ambient_e, rel=0.01)
    assert black.var() == pytest.approx(ambient_e + detector.read_noise_e**2, rel=0.02)


def test_a_quarter_of_the_band_lets_a_quarter_of_tungsten_through_and_halves_its_noise() -> None:
    dark = signals_of_depth(stereo_rig(400, 300), np.full((300, 400), 1.0), [SENSOR], albedo=0.0, ambient=1.0)
    detector = Detector(dark_current_e_s=0.0, read_noise_e=0.0, bits=16, full_well_e=60_000.0)
    light = Ambient("tungsten", irradiance_w_m2=400.0)
    wide, narrow = (
        electrons(expose(dark, SENSOR, dataclasses.replace(detector, band_width_m=w), 2e-4, ambient=light))[-1]
        for w in (80e-9, 20e-9)
    )
    assert narrow.mean() / wide.mean() == pytest.approx(0.25, rel=0.01)
    assert narrow.std() / wide.std() == pytest.approx(0.5, rel=0.02)


def test_sun_in_a_photon_counter_is_poisson_in_every_bin() -> None:
    sensor = DirectToF(bins=40, bin_s=200e-12)
    detector = SpadDetector(bits=16, dark_counts_hz=0.0, pile_up=False)
    dark = signals_of_depth(stereo_rig(), np.full((120, 160), 1.0), [sensor], albedo=0.0, ambient=1.0)
    light = Ambient("sun", irradiance_w_m2=500.0)
    counts = expose(dark, sensor, detector, 1e-3, ambient=light).frames.astype(float)
    expected = light.in_band(905e-9, detector.band_width_m) * detector.electron_rate_per_radiance(dark.rig) * 1e-3
    assert counts.sum(axis=0).mean() == pytest.approx(expected, rel=0.01)
    np.testing.assert_allclose(counts.mean(axis=(1, 2)), expected / 40, rtol=0.05)
    assert counts.var(axis=(1, 2)).mean() == pytest.approx(expected / 40, rel=0.02)


def test_an_amcw_sensor_drowns_in_the_sun_and_not_in_office_light() -> None:
    """The phasor of ambient light is zero, its noise is not."""
    sensor, detector = AmcwToF(), Detector.time_of_flight()
    signals = plane_signals(stereo_rig(), sensor, ambient=0.1)
    spread = {}
    for name, light in {"sun": Ambient("sun", 100_000.0), "led": Ambient("led", 500.0)}.items():
        taps = electrons(expose(signals, sensor, detector, 1e-4, ambient=light))
        spread[name] = (taps[0] - taps[2]).std()
    assert spread["sun"] > 1.5 * spread["led"]


def test_settings_round_trip(tmp_path: Path) -> None:
    for ambient in (
        Ambient("sun", illuminance_lux=1e4),
        Ambient("tungsten", irradiance_w_m2=3.0, temperature_k=3000.0),
    ):
        assert from_dict(Ambient, to_dict(ambient)) == ambient
    detector = Detector(band_width_m=12e-9)
    assert from_dict(PhotoDetector, to_dict(detector)) == detector  # type: ignore[type-abstract]
    for i, ambient in enumerate((None, Ambient("led", illuminance_lux=500.0))):
        capture = expose(plane_signals(stereo_rig(), SENSOR, ambient=0.1), SENSOR, detector, ambient=ambient)
        save_capture(capture, tmp_path / f"capture{i}")
        loaded = load(tmp_path / f"capture{i}")
        assert (loaded.detector, loaded.ambient) == (detector, ambient)


def test_a_scene_without_light_cannot_be_in_the_sun() -> None:
    signals = plane_signals(stereo_rig(), SENSOR)
    with pytest.raises(ValueError, match="a scene with emitters"):
        expose(signals, SENSOR, Detector(), ambient=Ambient("sun", illuminance_lux=1e4))


@pytest.mark.parametrize(
    "wrong",
    [
        {"illuminant": "moon"},
        {"illuminance_lux": 1.0, "irradiance_w_m2": 1.0},
        {"illuminance_lux": -1.0},
        {"scene_irradiance_w_m2": 0.0},
        {"temperature_k": -5.0},
    ],
)
def test_impossible_light_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Ambient(**{"illuminant": "sun", **wrong})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="band_width_m"):
        Detector(band_width_m=-1e-9)
