# SPDX-License-Identifier: Apache-2.0
"""Noise of the renderer beside that of the detector: estimated from two halves of the samples, and driven down."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiers import to_validate

from rangesim import (
    AmcwToF,
    Capture,
    DirectToF,
    IdealToF,
    Scene,
    StructuredLight,
    compare,
    decode,
    expose,
    load_scene,
    transport,
)
from rangesim.causes import explain
from rangesim.errors import RangesimWarning, SamplingWarning, warn
from rangesim.evaluation.range_noise import Repeats, range_noise, robust_sigma, warn_of_sampling
from rangesim.experiment import Experiment
from rangesim.instrument.adaptive_sampling import (
    ENOUGH_PIXELS,
    FIRST_SPP,
    AdaptiveSampling,
    few_of_each,
    group_sigma,
    groups,
)
from rangesim.instrument.instrument import Instrument
from rangesim.light_transport.loop import SampleAllocation
from rangesim.light_transport.sampling_error import Halves
from rangesim.pipeline.experiment_run import measure
from rangesim.signals import StillSignals

SMALL_IMAGE: dict[str, Any] = {"width": 96, "height": 72}


@pytest.fixture(scope="module")
def matte() -> Scene:
    return load_scene("matte")


# ---- Halves ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", [0, 16])
def test_two_halves_have_every_sample_once_and_whole_pairs(first: int) -> None:
    for n in range(3, 70):
        count = np.array([n], np.uint32)
        taken = []
        halves = SampleAllocation(np.arange(1), count, count + first, 1.0, first, part=3).in_halves()
        assert list(halves.part) == [6, 7]
        for of_half, samples in zip(halves.first, halves.samples, strict=True):
            k = np.arange(samples)
            taken.append(of_half + (k >> 1) * halves.stride + (k & 1))  # as `Lanes.number`
        assert np.array_equal(np.sort(np.concatenate(taken)), first + np.arange(n))
        assert abs(len(taken[0]) - len(taken[1])) <= 2
        for numbers in taken:
            whole = numbers[numbers // 2 * 2 + 1 < first + n]
            assert all((number ^ 1) in numbers for number in whole)


def test_the_drawn_error_of_halves_of_unequal_size_has_the_variance_of_the_mean() -> None:
    rng, p, q = np.random.default_rng(3), 5, 16
    a, b = (rng.normal(2 * n, np.sqrt(n), (1, 200, 300)).astype(np.float32) for n in (p, q))
    mean, error = np.zeros_like(a), np.zeros_like(a)
    Halves([np.full((200, 300), n, np.uint32) for n in (p, q)]).mean_and_error((a, b), (mean, error))
    assert mean.mean() == pytest.approx(2, rel=0.01)
    assert mean.std() == pytest.approx(1 / np.sqrt(p + q), rel=0.02)
    assert error.std() == pytest.approx(1 / np.sqrt(p + q), rel=0.02)
    assert abs(error.mean()) < 0.01


def test_what_is_decoded_again_for_comparison_does_not_warn_again(matte: Scene, monkeypatch: Any) -> None:
    """A decoder that warns of every capture does so once, for the reading itself; the masks are as without."""
    sensor, rig = AmcwToF(), matte.rig(0.03, **SMALL_IMAGE)
    signals = transport(matte, rig, [sensor], spp=4)
    capture = expose(signals, sensor)
    image = decode(capture)
    noise, causes = range_noise(image, capture, signals), explain(image, capture, signals)
    assert causes.failed.any()
    decoder, quiet = type(sensor.default_decoder), type(sensor.default_decoder).decode
    monkeypatch.setattr(decoder, "pixel_reader", lambda self, sensor: None)  # such a reader checks and warns of nothing

    def loud(self: Any, capture: Any) -> Any:
        warn("frames and code contradict each other.")
        return quiet(self, capture)

    monkeypatch.setattr(decoder, "decode", loud)
    with pytest.warns(RangesimWarning, match="contradict"):
        image = decode(capture)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again, anew = range_noise(image, capture, signals), explain(image, capture, signals)
    np.testing.assert_array_equal(again.sampling, noise.sampling)
    np.testing.assert_array_equal(anew.cause, causes.cause)


@pytest.mark.parametrize(("ambient", "decodings"), [(0.0, 9), (0.05, 10)])
def test_an_instrument_decodes_and_exposes_the_same_light_once(
    matte: Scene, monkeypatch: Any, ambient: float, decodings: int
) -> None:
    """Its own capture, both halves, all samples without noise, three with other noise, and parts of the light: the
    projector's alone (only where there is other light), the straight path to some failed pixels, and paths over the
    area of some."""
    sensor, rig = DirectToF(bins=64, bin_s=400e-12), matte.rig(0.03, width=48, height=36)
    signals = transport(matte, rig, [sensor], spp=4)
    energy = replace(signals.energy, ambient=np.full_like(signals.energy.ambient, ambient))
    signals = replace(signals, energy=energy)
    read: list[bytes] = []
    lit: list[tuple[float, float]] = []
    decoder, undisturbed = type(sensor.default_decoder), type(sensor.default_decoder).coordinates
    frames_of = StillSignals.frames

    def noted(self: Any, capture: Any) -> Any:
        read.append(capture.frames.tobytes())
        return undisturbed(self, capture)

    def frames(self: Any, sensor: Any, ambient_transmission: float = 1.0, sampling_errors: float = 0.0) -> Any:
        lit.append((ambient_transmission, sampling_errors))
        return frames_of(self, sensor, ambient_transmission, sampling_errors)

    monkeypatch.setattr(decoder, "coordinates", noted)
    monkeypatch.setattr(StillSignals, "frames", frames)
    one = Instrument("direct", sensor)
    measured = measure(Experiment("-", instruments=(one,), seed=1), one, signals, None)
    assert measured.causes.failed.any()
    assert len(read) == len(set(read)) == decodings
    filtered = lit[0]
    assert lit.count(filtered) == 2  # the capture, which also says how many photons there are, and with other noise


@pytest.mark.validation
@pytest.mark.parametrize("indirect", ["raw", "filtered"])
def test_the_estimated_noise_of_a_reading_is_that_between_seeds(matte: Scene, indirect: Any) -> None:
    """Both halves are stratified, and the whole is better still: the estimate errs on the safe side."""
    for sensor, rig in ((StructuredLight(), matte.rig(**SMALL_IMAGE)), (AmcwToF(), matte.rig(0.03, **SMALL_IMAGE))):
        z, estimated = [], []
        for seed in range(8):
            signals = transport(matte, rig, [sensor], spp=16, seed=seed, indirect=indirect)
            capture = expose(signals, sensor)
            image = decode(capture)
            noise = range_noise(image, capture, signals)
            assert not np.isfinite(noise.detector).any()  # there is none
            z.append(image.z)
            estimated.append(robust_sigma(noise.sampling))
        always = np.isfinite(z).all(axis=0)
        of_pixel = np.array(z)[:, always]
        spread = robust_sigma((of_pixel - np.median(of_pixel, axis=0)) * np.sqrt(8 / 7))
        assert 0.8 < np.mean(estimated) / spread < 1.4


@pytest.mark.validation
def test_light_through_glass_knows_the_noise_of_its_photons() -> None:
    """All pixels of a pass share its photons, but no photon serves both halves."""
    scene = load_scene("glassware")
    rig, sensor = scene.rig(0.03, **SMALL_IMAGE), AmcwToF()
    signals = [transport(scene, rig, [sensor], spp=8, seed=seed, glint=False) for seed in range(8)]
    caustic = np.array([s.energy.caustic for s in signals])
    lit = caustic.mean(axis=0) > 0.1 * signals[0].energy.direct.mean()
    assert lit.sum() > 100
    drawn = np.array([s.sampling.projector for s in signals if s.sampling])
    between = np.array([s.energy.projector for s in signals]).std(axis=0, ddof=1)
    ratio = np.median(np.sqrt((drawn**2).mean(axis=0))[lit]) / np.median(between[lit])
    assert 0.75 < ratio < 1.5


def test_two_samples_know_nothing_of_their_error(matte: Scene) -> None:
    sensor = AmcwToF()
    signals = transport(matte, matte.rig(0.03, width=32, height=24), [sensor], spp=2)
    assert not signals.knows_sampling_error
    capture = expose(signals, sensor)
    with pytest.raises(ValueError, match="at least 3 samples"):
        range_noise(decode(capture), capture, signals)


@pytest.mark.parametrize(
    ("name", "sensor", "spp", "seed"),
    [
        ("tabletop", StructuredLight(), 16, 3),
        *to_validate(("glassware", StructuredLight(), 16, 4)),
        ("tabletop", AmcwToF(), 16, 5),
        ("tabletop", AmcwToF(), "auto", 6),
    ],
)
def test_the_detectors_sigma_is_that_between_captures_of_one_render(
    name: str, sensor: Any, spp: Any, seed: int
) -> None:
    """Against the mean of the two halves it was up to twice as large, where these are far from linear: on glass.

    The ratio varies from seed to seed: on the glass of the tabletop from 0.92 to 1.18 over 12 seeds, sigma 0.08.
    """
    scene, one = load_scene(name), Instrument("one", sensor)
    signals = transport(scene, one.rig(scene, **SMALL_IMAGE), [sensor], spp=spp, seed=seed)
    captures = [expose(signals, sensor, one.detector, seed=n) for n in range(16)]
    images = [decode(capture) for capture in captures]
    z = np.array([image.z for image in images], np.float64)
    some = [range_noise(i, c, signals).detector for i, c in zip(images[:4], captures[:4], strict=True)]
    always = np.isfinite(z).all(axis=0) & np.isfinite(some).all(axis=0)
    spread = (z - z.mean(axis=0)) * np.sqrt(16 / 15)
    checked = []
    for material, of_class in signals.truth.classes().items():
        if (mask := of_class & always).sum() >= 150:
            estimated, true = (robust_sigma(np.array(x)[:, mask]) for x in (some, spread))
            assert estimated == pytest.approx(true, rel=0.2), material
            checked.append(material)
    assert {"matte", "transparent"} <= set(checked)


# ---- Readings that sampling takes away -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "sensor", "seed", "width", "least"),
    [
        *to_validate(
            ("tabletop", StructuredLight(), 0, 96, 0.03),
            ("tabletop", StructuredLight(), 1, 96, 0.02),
            ("glassware", StructuredLight(), 1, 64, 0.03),
            ("tabletop", AmcwToF(), 1, 96, 0.006),
        ),
    ],
)
def test_the_error_bar_of_completeness_covers_what_many_samples_read(
    name: str, sensor: Any, seed: int, width: int, least: float
) -> None:
    """With the default samples losses are off by several points on gloss, glass and mirrors.

    More samples do not take the noise of photons away, which so small an image has few of by default.
    """
    scene, one = load_scene(name), Instrument("one", sensor)
    rig = one.rig(scene, width=width, height=width * 3 // 4)

    def completeness(spp: Any) -> tuple[dict[str, float], dict[str, float]]:
        signals = transport(scene, rig, [sensor], spp=spp, seed=seed)
        capture = expose(signals, sensor, one.detector, seed=seed)
        image = decode(capture)
        table, noise = compare(image, signals).table, range_noise(image, capture, signals).by_surface(signals.truth)
        rows = [(row, of_row["completeness_error"]) for row, of_row in zip(table, noise, strict=True) if row.lit >= 200]
        materials = [(row, bar) for row, bar in rows if row.kind == "material"]
        return {row.name: row.completeness for row, _ in materials}, {row.name: bar for row, bar in materials}

    few, bars = completeness("auto")
    many, small_bars = completeness(1024)
    changes = {material: abs(few[material] - many[material]) for material in few}
    for material, change in changes.items():
        assert change <= bars[material] <= 4 * change + 0.15, material
        assert small_bars[material] <= 0.6 * bars[material] + 0.01
    assert max(changes.values()) > least


def test_the_error_bar_counts_pixels_of_either_half_beyond_those_of_the_detector() -> None:
    whole, again, a, b = np.zeros((4, 20, 20), bool)
    whole[:5] = again[:5] = a[:5] = b[:5] = True  # 100 of 400 lack a reading
    everywhere = np.ones((20, 20), bool)
    assert Repeats(whole, again, (a, b)).completeness_error(everywhere) == 0.0
    assert Repeats(whole, again, (a, b)).completeness_error(~everywhere) is None
    a[10], b[10:12], b[0] = True, True, False  # both lose one row, one half another one; one half gains a row
    again[15, :5] = True
    expected = (60 - 10 + np.sqrt(60 + 10)) / 400
    assert Repeats(whole, again, (a, b)).completeness_error(everywhere) == pytest.approx(expected)
    half = np.arange(20)[:, None] < 8 + np.zeros((20, 20))
    assert Repeats(whole, again, (a, b)).completeness_error(half) == pytest.approx((20 + np.sqrt(20)) / 160)


@pytest.mark.parametrize("sensor", [StructuredLight(), AmcwToF()])
def test_readings_that_the_detector_takes_away_are_not_laid_to_sampling(matte: Scene, sensor: Any) -> None:
    """In the dark a second capture of the same light has readings elsewhere than the first one."""
    signals = transport(matte, matte.rig(0.03, **SMALL_IMAGE), [sensor], spp=16)
    assert signals.sampling is not None
    for errors in [*signals.sampling.channels.values(), signals.sampling.projector]:
        errors[:] = 0
    one = Instrument("one", sensor)
    bright = expose(signals, sensor, one.detector)
    capture = expose(signals, sensor, one.detector, exposure_s=0.03 * bright.exposure_s)
    image, other = decode(capture), decode(expose(signals, sensor, one.detector, capture.exposure_s, seed=1))
    assert np.mean(image.valid != other.valid) > 0.03  # up to a seventh
    row = range_noise(image, capture, signals).by_surface(signals.truth)[-1]
    assert row["completeness_error"] < 0.03
    unknown = Capture(capture.frames, sensor, capture.rig)
    assert range_noise(decode(unknown), unknown, signals).by_surface(signals.truth)[-1]["completeness_error"] is None


# ---- Adaptive sampling -----------------------------------------------------------------------------------------------


def test_groups_are_the_pixels_of_an_instance_in_a_square_and_their_sigma_is_that_of_numpy() -> None:
    rng = np.random.default_rng(1)
    instance = rng.integers(-1, 3, (40, 50))
    group = groups(instance)
    errors = rng.normal(size=(40, 50))
    errors[rng.random((40, 50)) < 0.3] = np.nan
    errors[:16, :16] = np.nan
    sigma = group_sigma(errors, group)
    y, x = np.mgrid[:40, :50]
    for number in range(group.max() + 1):
        pixels = group == number
        assert len(set(zip(y[pixels] // 16, x[pixels] // 16, instance[pixels], strict=True))) == 1
        finite = np.sort(np.abs(errors[pixels & np.isfinite(errors)]))
        assert sigma[number] == (pytest.approx(1.4826 * finite[len(finite) // 2]) if finite.size else 0)
    assert not group_sigma(np.full((40, 50), np.nan), group).any()
    assert (group_sigma(np.full((40, 50), np.inf), group) == np.inf).all()


def test_few_pixels_tell_the_noise_of_each_group() -> None:
    """Of large groups a quarter is read, of small ones all, and no group is left out."""
    instance = np.random.default_rng(1).choice([0, 1, 2], (64, 80), p=[0.9, 0.09, 0.01])
    instance[:16, :16] = 0
    group = groups(instance)
    few, all_pixels = np.bincount(group[few_of_each(group)]), np.bincount(group.ravel())
    assert few[group[0, 0]] == 64
    assert ((few >= ENOUGH_PIXELS) | (few == all_pixels)).all()


@pytest.mark.validation
def test_more_samples_go_where_sampling_is_not_small_and_nowhere_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plane has no sampling noise at all; on glass there is plenty."""
    given: list[np.ndarray] = []
    samples = AdaptiveSampling.samples

    def spy(self: AdaptiveSampling, truth: Any, signals_of: Any) -> np.ndarray:
        given.append(samples(self, truth, signals_of))
        return given[-1]

    monkeypatch.setattr(AdaptiveSampling, "samples", spy)
    plane, glass, sensor = load_scene("plane"), load_scene("glassware"), StructuredLight()
    transport(plane, plane.rig(**SMALL_IMAGE), [sensor])
    assert (given[-1] == FIRST_SPP).all()
    signals = transport(glass, glass.rig(**SMALL_IMAGE), [sensor])
    mean = {name: given[-1][mask].mean() for name, mask in signals.truth.classes().items()}
    assert mean["transparent"] > 50
    assert mean["matte"] < 40
    assert given[-1].min() >= FIRST_SPP
    assert given[-1].max() == 64
    assert len(given) == 2


def test_noise_falls_below_the_share_that_was_asked_for(matte: Scene) -> None:
    one = Instrument("amcw", AmcwToF())
    rig = one.rig(matte, **SMALL_IMAGE)
    ratios = []
    for fraction in (0.5, 0.1):
        adaptive = AdaptiveSampling((one,), max_spp=1024, fraction=fraction)
        signals = transport(matte, rig, [one.sensor], spp=adaptive)
        capture = expose(signals, one.sensor, one.detector)
        noise = range_noise(decode(capture), capture, signals)
        row = noise.by_surface(signals.truth)[-1]
        ratios.append(row["sampling_sigma_m"] / row["detector_sigma_m"])
        assert ratios[-1] < 1.25 * fraction  # few samples say it roughly
    assert ratios[1] < 0.5 * ratios[0]


def test_rounds_have_the_same_bytes_whatever_the_memory_budget(matte: Scene) -> None:
    sensor = AmcwToF()
    rig = matte.rig(0.03, width=48, height=36)
    adaptive = AdaptiveSampling((Instrument("one", sensor),), fraction=0.1)
    one, two = (transport(matte, rig, [sensor], spp=adaptive, memory_bytes=n) for n in (1 << 30, 1 << 20))
    assert [a.tobytes() for a in one.channels.values()] == [b.tobytes() for b in two.channels.values()]
    assert one.energy.multipath.tobytes() == two.energy.multipath.tobytes()


@pytest.mark.parametrize("most", [1, 2, 3, 4, 15, 16, 17, 18, 19, 20, 63, 65, 66])
def test_any_largest_number_of_samples_will_do_and_none_exceeds_it(most: int) -> None:
    scene, sensor = load_scene("glassware"), AmcwToF()
    adaptive = AdaptiveSampling((Instrument("one", sensor),), most, fraction=1e-3)
    signals = transport(
        scene, scene.rig(0.03, width=32, height=24), [sensor], spp=adaptive, caustics=False, glint=False
    )
    assert signals.energy.projector.any()
    assert signals.knows_sampling_error == (most > 2)


def test_settings_of_adaptive_sampling_out_of_range_are_refused(matte: Scene) -> None:
    one = Instrument("one", AmcwToF())
    changes: list[dict[str, Any]] = [{"max_spp": n} for n in (0, -3, 2.5, "64", None)]
    for change in [*changes, {"fraction": 0.0}, {"fraction": np.nan}, {"fraction": np.inf}]:
        with pytest.raises(ValueError, match=next(iter(change))):
            AdaptiveSampling((one,), **change)
    with pytest.raises(ValueError, match="for instrument 'one'"):
        transport(matte, matte.rig(), [IdealToF()], spp=AdaptiveSampling((one,)))


def test_where_nothing_can_be_read_no_samples_are_wasted() -> None:
    scene = load_scene("glassware")
    sensor = AmcwToF()
    signals = transport(scene, scene.rig(0.03, **SMALL_IMAGE), [sensor], spp=16, caustics=False, glint=False)
    signals_of = {tuple(sensor.responses()): signals}.__getitem__
    for exposure_s in (1e-12, 10.0):
        one = Instrument("one", sensor, exposure_s=exposure_s)
        assert (AdaptiveSampling((one,)).samples(signals.truth, signals_of) == FIRST_SPP).all()


def test_a_reading_that_sampling_takes_away_counts_as_infinitely_noisy(matte: Scene) -> None:
    sensor = AmcwToF()
    signals = transport(matte, matte.rig(0.03, width=32, height=24), [sensor], spp=16)
    assert signals.sampling is not None
    for errors in signals.sampling.channels.values():
        errors[:, :6] = -signals.channels[sensor.responses()[0]][:, :6]  # so much that one draw is dark
    capture = expose(signals, sensor)
    noise = range_noise(decode(capture), capture, signals)
    assert (noise.sampling[:6] == np.inf).all()
    assert np.isfinite(noise.sampling[6:]).all()


def test_the_sampling_error_may_be_left_out(matte: Scene) -> None:
    """It costs memory and time; the signals differ by the order of their sums alone."""
    sensor, rig = AmcwToF(), matte.rig(0.03, width=32, height=24)
    options: dict[str, Any] = {"spp": 16, "indirect": "raw", "seed": 1}
    without = transport(matte, rig, [sensor], sampling_error=False, max_depth=2, **options)
    known = transport(matte, rig, [sensor], max_depth=2, **options)
    assert not without.knows_sampling_error
    assert known.knows_sampling_error
    np.testing.assert_allclose(without.frames(sensor), known.frames(sensor), rtol=1e-4, atol=1e-7)
    with pytest.raises(ValueError, match="sampling_error=True"):
        transport(matte, rig, [sensor], spp=AdaptiveSampling.of([sensor]), sampling_error=False)


def test_samples_that_are_no_number_are_refused(matte: Scene) -> None:
    for spp in (2.5, 0, "many", None):
        with pytest.raises(ValueError, match="spp"):
            transport(matte, matte.rig(), [AmcwToF()], spp=spp)  # type: ignore[arg-type]


# ---- What is said of it ----------------------------------------------------------------------------------------------


def test_a_run_keeps_the_noise_of_its_readings_and_warns_of_it(tmp_path: Path) -> None:
    from rangesim.experiment import Experiment
    from rangesim.pipeline.experiment_run import run
    from rangesim.results.experiment_results import load_result

    instruments = (Instrument("amcw", AmcwToF()), Instrument("ideal", IdealToF()))
    experiment = Experiment("glassware", width=96, height=72, spp=4, instruments=instruments)
    with pytest.warns(SamplingWarning, match="amcw: .* on transparent"):
        run(experiment, tmp_path / "out")
    amcw, ideal = load_result(tmp_path / "out").measurements
    sigma = amcw.image.sampling_sigma_m
    assert sigma is not None
    rows = {row["name"]: row for row in amcw.rows if row["kind"] == "material"}
    of_glass = sigma[amcw.truth.classes()["transparent"]]
    assert robust_sigma(of_glass) == pytest.approx(rows["transparent"]["sampling_sigma_m"], rel=1e-6)
    assert rows["transparent"]["sampling_sigma_m"] > 0.5 * rows["transparent"]["detector_sigma_m"] > 0
    assert all(row["detector_sigma_m"] is None for row in ideal.rows)
    assert rows["transparent"]["completeness_error"] > 0
    assert all(row["completeness_error"] is not None for row in ideal.rows)
    glass = rows["transparent"]
    value, error = f"{100 * glass['completeness']:.1f}", f"± {100 * glass['completeness_error']:.1f}"
    report = (tmp_path / "out" / "report.html").read_text()
    assert f"{value} {error}" in (tmp_path / "out" / "comparison.md").read_text()
    assert f'{value}</span><span class="error">{error}</span>' in report
    assert "sampling noise" in report
    assert "detector noise" in report


def test_nothing_is_said_where_sampling_is_small_or_pixels_are_few() -> None:
    row = {
        "kind": "material",
        "name": "matte",
        "pixels": 5000,
        "lit": 4000,
        "sampling_sigma_m": 1e-4,
        "detector_sigma_m": 3e-4,
    }
    row |= {"completeness": 0.9, "completeness_error": 0.02}
    unsure = row | {"name": "glossy", "completeness": 0.68, "completeness_error": 0.12}
    of_all = {"kind": "all", "name": "all"}
    quiet = [row, row | {"sampling_sigma_m": None}, row | {"pixels": 20, "sampling_sigma_m": 1.0}]
    quiet += [row | {"completeness": None, "completeness_error": None}, unsure | {"lit": 20}]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_sampling({"amcw": [*quiet, row | of_all | {"sampling_sigma_m": 1.0}, unsure | of_all]}, 64)
    with pytest.warns(SamplingWarning, match="gray: 2.0 on glossy"):
        warn_of_sampling({"amcw": quiet, "gray": [row | {"name": "glossy", "sampling_sigma_m": 6e-4}]}, 64)
    with pytest.warns(SamplingWarning, match=r"are gray: 32 ± 12 % on glossy; about spp=1024 would leave 3 points"):
        warn_of_sampling({"amcw": quiet, "gray": [unsure]}, 64)


def test_a_scan_of_something_that_moves_knows_its_sampling_error(matte: Scene) -> None:
    from rangesim.motion import ConstantTwist, Motion, Timing, transport_moving

    sensor, rig = AmcwToF(), matte.rig(0.03, width=48, height=36)
    options: dict[str, Any] = {"spp": 16, "indirect": "raw"}
    still = transport(matte, rig, [sensor], seed=1, **options)
    hardly = Motion({"wall": ConstantTwist((1e-12, 0.0, 0.0))})
    timing = Timing(frame_period_s=0.1, single_tap=True)
    moving = transport_moving(matte, rig, {sensor: timing}, hardly, seed=1, **options)[sensor]
    for errors in (1.0, -1.0):
        np.testing.assert_allclose(
            moving.frames(sensor, 0.0, errors), still.frames(sensor, 0.0, errors), rtol=1e-4, atol=1e-7
        )
    with pytest.raises(ValueError, match="AdaptiveSampling"):
        transport_moving(matte, rig, {sensor: timing}, hardly, spp=AdaptiveSampling.of([sensor]))
