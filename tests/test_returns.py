# SPDX-License-Identifier: Apache-2.0
"""Several returns of a pixel, pulses of any shape, and the zero that a reference SPAD tells, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from delta_scenes import matte, rig_of, scene_of, wall
from scipy.stats import norm
from synthetic import signals_of_depth

from rangesim import (
    Beam,
    Capture,
    DirectToF,
    Intrinsics,
    RayTable,
    Rig,
    SpadDetector,
    Status,
    decode,
    expose,
    look_at,
    transport,
)
from rangesim.decoding.returns import FoundReturns, PulseShape, ReturnRules, Returns, find_returns
from rangesim.errors import FileFormatError
from rangesim.response import SPEED_OF_LIGHT, Pulse
from rangesim.results.range_images import load_range_image, save_range_image
from rangesim.sensors import DirectToFDecoder
from rangesim.signals import StillSignals

TAILED = Pulse((1.0, 8.0, 100.0, 90.0, 40.0, 18.0, 11.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.0), 100e-12)
"""A pulse with a steep front and a tail, as of a SPAD."""
RULES = ReturnRules(most=4, sigmas=5.0, counts=5.0, tolerance=0.1)
BINS = 200


def brought(shape: PulseShape, place: np.ndarray, photons: np.ndarray | float, bins: int = BINS) -> np.ndarray:
    """(bins, n) mean counts of a pulse at each of n places."""
    return np.asarray(photons * np.diff(shape.arrived_at(np.arange(bins + 1)[:, None] - place), axis=0))


def strongest(found: FoundReturns) -> list[np.ndarray]:
    """Place, strength and sigma of the strongest return of each histogram."""
    best = found.strength.argmax(axis=0)[None]
    return [np.take_along_axis(x, best, axis=0)[0] for x in found]


SHAPES = {
    "narrow": PulseShape.gaussian(0.7),
    "wide": PulseShape.gaussian(4.0),
    "measured": PulseShape.measured(TAILED, 100e-12),
    "fine": PulseShape.measured(replace(TAILED, sample_s=30e-12), 100e-12),
}


# ---- Fitted pulses ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("background", [0.0, 3.0])
@pytest.mark.parametrize("name", SHAPES)
def test_a_fitted_place_has_no_bias_and_the_noise_of_the_cramer_rao_bound(name: str, background: float) -> None:
    """sigma^-2 = sum over bins of (photons d part / d place)^2 / mean, with the strength unknown too."""
    shape, rng, photons = SHAPES[name], np.random.default_rng(3), 2000.0
    place = 80 + rng.random(3000)
    mean = background + brought(shape, place, photons)
    at, strength, sigma = strongest(find_returns(rng.poisson(mean), shape, RULES))
    normalised = (at - place) / sigma
    assert abs(normalised.mean()) < 0.1
    assert normalised.std() == pytest.approx(1, abs=0.06)
    assert strength.mean() == pytest.approx(photons, rel=0.01)
    step = 1e-3
    slope = (brought(shape, place + step, photons) - brought(shape, place - step, photons)) / (2 * step)
    part, mean = brought(shape, place, 1.0), np.maximum(mean, 1e-6 * photons)
    nn, cross, pp = (part**2 / mean).sum(0), (part * slope / mean).sum(0), (slope**2 / mean).sum(0)
    bound = np.sqrt(nn / (nn * pp - cross**2))
    assert np.median(sigma / bound) == pytest.approx(1, abs=0.05)


def test_without_background_a_gaussian_pulse_is_placed_to_its_width_over_the_root_of_the_photons() -> None:
    shape, photons = PulseShape.gaussian(4.0), 10_000.0
    _, _, sigma = strongest(find_returns(brought(shape, np.array([90.3]), photons), shape, RULES))
    assert sigma[0] == pytest.approx(np.sqrt(4.0**2 + 1 / 12) / np.sqrt(photons), rel=0.03)


@pytest.mark.parametrize("name", SHAPES)
def test_without_noise_two_returns_have_their_places_and_strengths(name: str) -> None:
    shape = SHAPES[name]
    near, far = 60 + np.linspace(0, 1, 20), 60 + np.linspace(0, 1, 20) + 5 * max(shape.sigma, 1.0)
    counts = 2.0 + brought(shape, near, 800.0) + brought(shape, far, 2000.0)
    found = find_returns(counts, shape, RULES)
    assert (np.isfinite(found.place).sum(axis=0) == 2).all()
    np.testing.assert_allclose(found.place[:2], [near, far], atol=0.01)
    np.testing.assert_allclose(found.strength[:2], [np.full(20, 800.0), np.full(20, 2000.0)], rtol=0.01)


@pytest.mark.parametrize(("sigmas", "number"), [(1.5, 1), (3.0, 2), (5.0, 2)])
def test_returns_merge_at_sparrow_s_limit(sigmas: float, number: int) -> None:
    rng, shape = np.random.default_rng(0), PulseShape.gaussian(4.0)
    place = 90 + rng.random(500)
    counts = rng.poisson(1 + brought(shape, place, 600) + brought(shape, place + sigmas * 4.0, 400))
    found = find_returns(counts, shape, RULES)
    assert np.mean(np.isfinite(found.place).sum(axis=0) == number) > 0.98
    if number == 2:
        error = (found.place[:2] - [place, place + sigmas * 4.0]) / found.sigma[:2]
        assert np.abs(np.nanmean(error, axis=1)).max() < 0.2
        assert np.nanstd(error) < 1.25  # sigma holds for known places of the others


@pytest.mark.parametrize("background", [0.05, 1.0, 20.0])
@pytest.mark.parametrize("sigma_bins", [0.4, 3.0])
def test_even_light_has_no_returns(background: float, sigma_bins: float) -> None:
    """Also where so little is counted that five standard deviations are a few photons."""
    counts = np.random.default_rng(1).poisson(np.full((BINS, 10_000), background))
    assert np.isfinite(find_returns(counts, PulseShape.gaussian(sigma_bins), RULES).place).any(axis=0).mean() < 3e-4


def test_one_strong_pulse_has_one_return() -> None:
    rng, shape = np.random.default_rng(1), PulseShape.gaussian(3.0)
    one = find_returns(rng.poisson(brought(shape, 50 + 100 * rng.random(4000), 1e5)), shape, RULES)
    assert (np.isfinite(one.place).sum(axis=0) == 1).all()


def test_around_the_end_of_a_cyclic_histogram_goes_one_pulse() -> None:
    shape = SHAPES["measured"]
    counts = brought(shape, np.array([BINS - 1.2]), 1000.0, bins=BINS + 40)
    counts[:40] += counts[BINS:]
    found = find_returns(counts[:BINS], shape, RULES, is_cyclic=True)
    assert found.place[0, 0] == pytest.approx(BINS - 1.2, abs=0.01)
    assert np.isfinite(found.place).sum() == 1


def test_a_weak_return_in_the_tail_of_a_strong_one_counts_only_if_the_shape_is_trusted() -> None:
    """The pulse falls off a little slower than the decoder thinks: with the tolerance this is no second return."""
    true = Pulse(tuple(np.exp(-np.arange(40) / 8.0)), 100e-12)
    shape = PulseShape.measured(Pulse(tuple(np.exp(-np.arange(40) / 7.5)), 100e-12), 100e-12)
    counts = 1.0 + brought(PulseShape.measured(true, 100e-12), np.array([50.0]), 1e6)
    trusting, careful = (find_returns(counts, shape, RULES._replace(tolerance=t)) for t in (0.0, 0.5))
    assert np.isfinite(trusting.place).sum() > 1
    assert np.isfinite(careful.place).sum() == 1


# ---- A pixel that sees two walls -------------------------------------------------------------------------------------


def coaxial_rig(range_m: np.ndarray) -> Rig:
    """Camera and lamp in one place; the camera has one row."""
    return Rig(Intrinsics.from_fov(len(range_m), 1, 1e-3), Intrinsics.from_fov(1280, 800, 60))


def walls_at(range_m: np.ndarray, sensor: DirectToF) -> StillSignals:
    return signals_of_depth(coaxial_rig(range_m), range_m[None], [sensor])


def two_walls(near: np.ndarray, far: np.ndarray, covered: float, sensor: DirectToF) -> StillSignals:
    """Pixels of which a fraction sees a near wall and the rest a far one."""
    first, second = walls_at(near, sensor), walls_at(far, sensor)
    channels = {
        r: np.float32(covered) * x + np.float32(1 - covered) * second.channels[r] for r, x in first.channels.items()
    }
    return replace(first, channels=channels)


def with_photons(signals: StillSignals, sensor: DirectToF, photons: float, exposure_s: float) -> StillSignals:
    """The signals with so much light that the first pixel gets that many photons in the exposure."""
    detector = SpadDetector(dark_counts_hz=0.0)
    mean = detector.mean_electrons(signals.frames(sensor), sensor.gate, signals.rig, exposure_s)[:, 0, 0].sum()
    return replace(signals, channels={r: x * np.float32(photons / mean) for r, x in signals.channels.items()})


DUAL = DirectToFDecoder(max_returns=2)


@pytest.mark.parametrize("covered", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("pulse", [None, TAILED])
def test_a_pixel_over_an_edge_has_two_returns_with_strengths_by_solid_angle(
    covered: float, pulse: Pulse | None
) -> None:
    """Lambert's radiance falls with the squared distance from the lamp; each wall's part is its solid angle."""
    near, sensor = np.linspace(1.0, 1.1, 50), DirectToF(pulse_fwhm_s=500e-12, pulse=pulse)
    signals = two_walls(near, near + 0.5, covered, sensor)
    radiance = 0.5 / np.pi * signals.rig.projector_irradiance
    image = decode(expose(signals, sensor), DUAL)
    assert image.returns is not None
    assert (image.returns.number == 2).all()
    np.testing.assert_allclose(image.returns.range_m[:, 0], [near, near + 0.5], atol=1e-3)
    np.testing.assert_allclose(image.returns.strength[0, 0], covered * radiance / near**2, rtol=5e-3)
    np.testing.assert_allclose(image.returns.strength[1, 0], (1 - covered) * radiance / (near + 0.5) ** 2, rtol=5e-3)


def test_the_reading_is_the_return_that_the_decoder_is_set_to() -> None:
    near, sensor = np.linspace(1.0, 1.1, 50), DirectToF(pulse_fwhm_s=500e-12)
    capture = expose(two_walls(near, near + 0.5, 0.2, sensor), sensor)
    expected = {"first": near, "last": near + 0.5, "strongest": near + 0.5}
    for reading, range_m in expected.items():
        image = decode(capture, DirectToFDecoder(reading=reading, max_returns=3))  # type: ignore[arg-type]
        assert image.valid.all()
        np.testing.assert_allclose(image.range_m[0], range_m, atol=1e-3)
        np.testing.assert_allclose(image.z, image.range_m, rtol=1e-6)


@pytest.mark.parametrize("pile_up", [False, True])
def test_photons_scatter_both_returns_as_they_say(pile_up: bool) -> None:
    near, sensor = np.full(3000, 1.0), DirectToF(pulse_fwhm_s=500e-12)
    signals = with_photons(two_walls(near, near + 0.6, 0.3, sensor), sensor, 8000.0, exposure_s=1e-3)
    detector = SpadDetector(bits=16, pile_up=pile_up)
    image = decode(expose(signals, sensor, detector, exposure_s=1e-3, seed=4), DUAL)
    assert image.returns is not None
    assert np.mean(image.returns.number == 2) > 0.999
    ok = (image.returns.number == 2)[0]
    normalised = ((image.returns.range_m[:, 0] - [near, near + 0.6]) / image.returns.sigma_m[:, 0])[:, ok]
    assert np.abs(normalised.mean(axis=1)).max() < 0.2
    np.testing.assert_allclose(normalised.std(axis=1), 1, atol=0.1)


def test_what_is_rendered_at_an_edge_has_both_returns() -> None:
    """A card covers 3/10 of each pixel of the middle column; camera and lamp are in one place, so nothing is shaded."""
    camera, sensor = Intrinsics.from_fov(5, 3, 3.0), DirectToF(pulse_fwhm_s=500e-12)
    edge = (camera.width / 2 - 0.5 + 0.3 - camera.cx) / camera.fx  # on the plane z = 1
    scene = scene_of(wall=wall(1.6, matte()), card=wall(1.0, matte(), half_size=0.5, x=edge - 0.5))
    rig = rig_of(camera, Intrinsics.from_fov(100, 100, 20.0))
    signals = transport(scene, rig, [sensor], spp=4000, max_depth=2)
    image = decode(expose(signals, sensor), DUAL)
    returns, radiance = image.returns, 0.5 / np.pi * rig.projector_irradiance
    assert returns is not None
    assert (returns.number[:, 2] == 2).all()
    assert (returns.number[:, [0, 1, 3, 4]] == 1).all()
    np.testing.assert_allclose(returns.range_m[:, :, 2], [[1.0] * 3, [1.6] * 3], rtol=1e-3)
    np.testing.assert_allclose(returns.strength[0, :, 2], 0.3 * radiance, rtol=0.05)
    np.testing.assert_allclose(returns.strength[1, :, 2], 0.7 * radiance / 1.6**2, rtol=0.05)


@pytest.mark.parametrize("profile", ["box", "gaussian"])
def test_a_beam_that_an_edge_splits_has_two_returns(profile: Any) -> None:
    """Parts of a beam by its profile, each returned with P / d^2: a scan over an edge, in fractions of the beam."""
    field, places = 8e-3, np.array([-0.3, 0.0, 0.2])  # of the edge in the beam, in full widths
    x = -places * field  # directions of the rays, whose middle is so far beside the edge at x = 0
    directions = np.stack([x, np.zeros(3), np.ones(3)], axis=-1)[None]
    camera = RayTable(directions, field_rad=(2 * field, 2 * field), acceptance="box")
    rig = Rig(camera, Beam((field, field), profile), look_at((0, 0, 0), (0, 0, 1), (0, -1, 0)))
    scene = scene_of(wall=wall(2.0, matte()), card=wall(1.0, matte(), half_size=0.5, x=-0.5))
    sensor = DirectToF(pulse_fwhm_s=500e-12)
    returns = decode(expose(transport(scene, rig, [sensor], spp=20_000, max_depth=2), sensor), DUAL).returns
    assert returns is not None
    assert (returns.number == 2).all()
    np.testing.assert_allclose(returns.range_m[:, 0], [[1.0] * 3, [2.0] * 3], rtol=1e-3)
    part = places + 0.5 if profile == "box" else norm.cdf(places * 4)  # widths at 1/e^2 are four standard deviations
    expected = part / ((1 - part) / 2.0**2)
    np.testing.assert_allclose(returns.strength[0, 0] / returns.strength[1, 0], expected, rtol=0.05)


def test_returns_are_saved_with_their_image(tmp_path: Path) -> None:
    near, sensor = np.linspace(1.0, 1.1, 20), DirectToF(pulse_fwhm_s=500e-12)
    image = decode(expose(two_walls(near, near + 0.5, 0.5, sensor), sensor, SpadDetector(), seed=1), DUAL)
    save_range_image(image, tmp_path / "range.npz")
    loaded = load_range_image(tmp_path / "range.npz")
    assert image.returns is not None
    assert loaded.returns is not None
    assert loaded.decoder == DUAL
    for name in ("range_m", "strength", "sigma_m", "status"):
        np.testing.assert_array_equal(getattr(loaded.returns, name), getattr(image.returns, name))
    arrays = dict(np.load(tmp_path / "range.npz"))
    del arrays["returns_status"]
    np.savez(tmp_path / "less.npz", **arrays)
    with pytest.raises(FileFormatError, match="expected all arrays returns_range_m"):
        load_range_image(tmp_path / "less.npz")


def test_a_cloud_of_all_returns_has_both_walls() -> None:
    near, sensor = np.linspace(1.0, 1.1, 20), DirectToF(pulse_fwhm_s=500e-12)
    capture = expose(two_walls(near, near + 0.5, 0.5, sensor), sensor)
    image = decode(capture, DUAL)
    cloud = image.to_point_cloud(returns="all")
    assert cloud.points.shape == (40, 3)
    assert cloud.return_number is not None
    np.testing.assert_array_equal(cloud.return_number, np.repeat(np.array([1, 2], np.uint8), 20))
    np.testing.assert_allclose(np.linalg.norm(cloud.points, axis=1), np.concatenate([near, near + 0.5]), atol=1e-3)
    assert image.to_point_cloud().points.shape == (1, 20, 3)
    with pytest.raises(ValueError, match="expected returns to be one of reading, all"):
        image.to_point_cloud(returns="both")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected a range image with all returns"):
        decode(capture).to_point_cloud(returns="all")


def test_one_return_is_what_a_decoder_looks_for_unless_told_otherwise() -> None:
    sensor = DirectToF()
    assert decode(expose(walls_at(np.array([1.0, 2.0]), sensor), sensor)).returns is None
    with pytest.raises(ValueError, match="max_returns of at least 2 for the first return"):
        DirectToFDecoder(reading="first")
    with pytest.raises(ValueError, match="expected four arrays of one shape"):
        Returns(*(np.zeros((2, 3, n)) for n in (4, 4, 4, 5)))


# ---- Measured pulses -------------------------------------------------------------------------------------------------


def test_a_measured_pulse_keeps_the_light_of_its_samples() -> None:
    edges = (np.arange(len(TAILED.samples) + 1) - 2.5) * TAILED.sample_s  # the largest sample is around time zero
    np.testing.assert_allclose(
        np.diff(TAILED.arrived(edges)), np.array(TAILED.samples) / sum(TAILED.samples), atol=1e-12
    )
    assert (np.diff(TAILED.arrived(np.linspace(-1e-9, 2e-9, 5000))) >= 0).all()


@pytest.mark.parametrize("changes", [{}, {"laser": "single-shot"}, {"start_s": 2e-9}, {"start_s": -2e-9}])
@pytest.mark.parametrize("sample_s", [20e-12, 100e-12, 300e-12])
def test_a_histogram_has_the_measured_pulse(changes: dict[str, Any], sample_s: float) -> None:
    """Exact at the middles of bins of the pass, and within an interpolation's error of a curved flank elsewhere."""
    sensor = DirectToF(bins=100, pulse=replace(TAILED, sample_s=sample_s), **changes)
    at_middles = 40.125 + np.arange(8) / 4
    for place, error in ((at_middles, 1e-5), (at_middles + 0.06, 0.04)):
        range_m = (sensor.start_s + place * sensor.bin_s) * SPEED_OF_LIGHT / 2
        frames = walls_at(range_m, sensor).frames(sensor)[:, 0]
        expected = brought(sensor.shape, place, frames.sum(axis=0), bins=100)
        assert np.abs(frames - expected).max() < error * frames.max()
        assert (frames >= 0).all()


def test_a_gaussian_of_samples_is_a_gaussian() -> None:
    gaussian = DirectToF()
    width = gaussian.sigma_bins * gaussian.bin_s
    samples = np.diff(norm(0, width).cdf((np.arange(-60, 62) - 0.5) * 50e-12))
    measured = replace(gaussian, pulse=Pulse(samples, 50e-12))  # type: ignore[arg-type]
    range_m = np.linspace(0.5, 3.0, 300)
    assert measured.sigma_bins == pytest.approx(gaussian.sigma_bins, rel=5e-3)
    frames = [walls_at(range_m, s).frames(s) for s in (gaussian, measured)]
    assert np.abs(frames[0] - frames[1]).max() < 0.01 * frames[0].max()


@pytest.mark.parametrize("changes", [{}, {"start_s": -3e-9}, {"start_s": 3e-9, "laser": "single-shot"}])
def test_with_a_measured_pulse_a_wall_is_where_it_is(changes: dict[str, Any]) -> None:
    sensor, range_m = DirectToF(pulse=TAILED, **changes), np.linspace(0.7, 3.0, 1000)
    signals = walls_at(range_m, sensor)
    still = decode(expose(signals, sensor))
    assert still.valid.all()
    np.testing.assert_allclose(still.range_m[0], range_m, atol=4e-4)
    bright = with_photons(signals, sensor, 20_000.0, exposure_s=1e-2)
    lengths = DirectToFDecoder().coordinates(expose(bright, sensor, SpadDetector(bits=16), exposure_s=1e-2, seed=2))
    assert lengths.sigma_m is not None
    normalised = ((lengths.length_m / 2 - still.range_m) / (lengths.sigma_m / 2))[0]
    assert normalised.std() == pytest.approx(1, abs=0.1)
    assert abs(normalised.mean()) < 0.2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Pulse((), 1e-10), "with light in at least one"),
        (lambda: Pulse((0.0, 0.0), 1e-10), "with light in at least one"),
        (lambda: Pulse((1.0, -1.0), 1e-10), "0 or positive"),
        (lambda: Pulse((1.0,), 0.0), "sample_s"),
        (lambda: DirectToF(bins=8, pulse=TAILED), "expected a pulse of at most"),
        (lambda: DirectToF(bins=8, start_s=-1e-9, pulse_fwhm_s=0.0), "expected start_s of at least"),
    ],
)
def test_bad_pulses_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


# ---- The zero that a reference SPAD tells ----------------------------------------------------------------------------


@pytest.mark.parametrize("drift_s", [0.0, 37e-12, -220e-12])
def test_a_reference_spad_takes_out_what_the_electronics_delay(drift_s: float) -> None:
    sensor = DirectToF(bins=128, bin_s=91e-12, start_s=-1.3e-9, pulse=TAILED)
    drifted, range_m = replace(sensor, start_s=sensor.start_s - drift_s), np.linspace(0.1, 0.8, 200)
    capture = expose(walls_at(range_m, drifted), drifted)
    rng, path_m = np.random.default_rng(0), 0.004
    place = (path_m / SPEED_OF_LIGHT - drifted.start_s) / sensor.bin_s
    reference = rng.poisson(brought(sensor.shape, np.array([place]), 1e6, bins=128))[:, 0]
    zeroed = sensor.zeroed(reference, path_m)
    assert zeroed.start_s == pytest.approx(drifted.start_s, abs=1e-12)
    image = decode(Capture(capture.frames, zeroed, capture.rig))
    np.testing.assert_allclose(image.range_m[0], range_m, atol=3e-4)
    for wrong in (reference[:-1], np.zeros(128)):
        with pytest.raises(ValueError, match="reference"):
            sensor.zeroed(wrong)


def test_bins_before_the_pulse_show_nothing_of_a_single_shot() -> None:
    sensor = DirectToF(start_s=-2e-9, laser="single-shot")
    frames = walls_at(np.array([0.3, 1.0]), sensor).frames(sensor)
    assert frames[:20].max() < 1e-6 * frames.max()
    image = decode(expose(walls_at(np.array([0.3, 1.0]), sensor), sensor))
    np.testing.assert_allclose(image.range_m[0], [0.3, 1.0], atol=2e-3)
    assert (image.status == Status.OK).all()


@pytest.mark.parametrize("sigmas", [2.1, 2.5, 3.0, 5.0])
@pytest.mark.parametrize("photons", [(20_000.0, 14_000.0), (500_000.0, 300_000.0)])
def test_returns_that_overlap_scatter_as_they_say(sigmas: float, photons: tuple[float, float]) -> None:
    """Close to Sparrow's limit, the place of each return depends on that of the other, and sigma knows it."""
    shape, places = PulseShape.gaussian(4.0), np.array([60.3, 60.3 + 4.0 * sigmas])
    mean = 1 + sum(brought(shape, place, n) for place, n in zip(places[:, None], photons, strict=True))
    histograms = np.random.default_rng(3).poisson(np.repeat(mean, 600, axis=1)).astype(float)
    found = find_returns(histograms, shape, RULES._replace(most=2))
    both = np.isfinite(found.place).all(axis=0)
    assert both.mean() > 0.8
    z = (found.place[:, both] - places[:, None]) / found.sigma[:, both]
    assert ((z**2).mean(axis=1) > 0.8).all()
    assert ((z**2).mean(axis=1) < 1.25).all()


def test_returns_of_a_counter_that_is_full_are_saturated() -> None:
    """A counter of 8 bits clips the peak; what is left of it is off by metres, and is no return that is OK."""
    shape, sensor = PulseShape.gaussian(1.7), DirectToF(bins=128, bin_s=0.5e-9, pulse_fwhm_s=2e-9, laser="single-shot")
    near, far = brought(shape, np.array([40.3]), 3000.0, 128), brought(shape, np.array([90.6]), 400.0, 128)
    counts = np.minimum(np.round(near + far), 255).astype(np.uint8)
    clear = np.round(near / 10 + far).astype(np.uint8)
    capture = Capture(np.stack([counts, clear], axis=-1), sensor, detector=SpadDetector(bits=8, pile_up=False))
    image = decode(capture, DirectToFDecoder(max_returns=2))
    assert image.returns is not None
    assert image.status.tolist() == [[Status.SATURATED, Status.OK]]
    assert image.returns.number.tolist() == [[0, 2]]
    assert (image.returns.status[:, 0, 0] == Status.SATURATED).any()
