# SPDX-License-Identifier: Apache-2.0
"""The cause of a failed pixel against what is known of the scene, and the laws it rests on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cause_scenes
import numpy as np
import pytest
from synthetic import plane_signals, stereo_rig
from tiers import to_validate

import rangesim
from rangesim import (
    AmcwToF,
    Capture,
    Detector,
    DirectToF,
    IdealToF,
    Lens,
    Sensor,
    Signals,
    SpadDetector,
    StructuredLight,
    decode,
    expose,
)
from rangesim.causes import Cause, CauseMap, explain
from rangesim.causes.cause import DEFINITIONS, TITLES
from rangesim.causes.light_budget import light_budget, white_radiance
from rangesim.causes.reference_frames import single_path_frames
from rangesim.decoding.status import Status
from rangesim.report import failures_markdown
from rangesim.report.tables import parts
from rangesim.response import (
    CAUSTIC,
    DIRECT,
    KINDS,
    MULTIPATH,
    SPECULAR,
    LengthSplit,
    LightPath,
    NumpyMath,
    TransientHistogram,
)
from rangesim.signals import GroundTruth

ROOT = Path(__file__).resolve().parent.parent
SENSORS: dict[str, tuple[Sensor, Any]] = {
    "lines": (StructuredLight(), Detector()),
    "gray": (StructuredLight(code="gray"), Detector()),
    "amcw": (AmcwToF(), Detector.time_of_flight()),
    "histogram": (DirectToF(bins=128, bin_s=200e-12, pulse_fwhm_s=400e-12), SpadDetector()),
    "ideal": (IdealToF(), None),
}
AGREEMENT = 0.99
BINS, SPLIT = TransientHistogram(0.0, 0.5, 80), LengthSplit(0.0, 0.5, 80)


# ---- The scenes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "cause",
    [*(c for c in Cause if c and c is not Cause.MOTION), *to_validate(Cause.MOTION)],
    ids=lambda c: c.name.lower(),
)
def test_a_scene_made_for_it_produces_each_cause(cause: Cause) -> None:
    """Rules and an independent decision name the same cause in 99 % of the failed pixels, and each has one."""
    case = getattr(cause_scenes, cause.name.lower())()
    found = explain(case.image, case.capture, case.signals)
    failed = case.failed
    assert (found.failed == failed).all()
    agree = (found.cause == case.decided)[failed]
    fraction, of_it = float(agree.mean()), int((found.cause == cause).sum())
    print(f"{cause.name.lower()}: {failed.sum()} failed, {of_it} of them by it, agreement {100 * fraction:.2f} %")  # noqa: T201
    assert fraction >= AGREEMENT
    assert of_it >= 20
    assert (case.decided[failed] == cause).sum() >= 20


@pytest.fixture(scope="module")
def signals() -> Signals:
    """Of one pass of the tabletop for all sensors, and for light over path length."""
    scene = rangesim.load_scene(ROOT / "scenes" / "tabletop.xml")
    sensors = [sensor for sensor, _ in SENSORS.values()]
    return rangesim.transport(scene, scene.rig(width=64, height=48), [*sensors, BINS, SPLIT], spp=4)


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("noise", [True, False], ids=["noise", "noise-free"])
def test_no_failed_pixel_is_without_a_cause(signals: Signals, name: str, noise: bool) -> None:
    sensor, detector = SENSORS[name]
    capture = expose(signals, sensor, detector if noise else None)
    image = decode(capture)
    found = explain(image, capture, signals)
    with np.errstate(invalid="ignore"):
        failed = np.isfinite(signals.truth.z) & ~(np.abs(image.z - signals.truth.z) <= found.tolerance_m)
    assert (found.failed == failed).all()
    assert failed.any()


@pytest.mark.validation
def test_what_other_light_spoils_on_the_tabletop_is_better_without_it() -> None:
    """AMCW on many surfaces: pixels named multipath or caustic lose most of their error with direct light alone; those
    of mirrors and glass do not get right by it."""
    sensor, detector = SENSORS["amcw"]
    scene = rangesim.load_scene(ROOT / "scenes" / "tabletop.xml")
    rig = scene.rig(0.03, width=96, height=72)
    signals = rangesim.transport(scene, rig, [sensor], spp=64)
    plain = rangesim.transport(scene, rig, [sensor], spp=64, max_depth=2, caustics=False, glint=False)
    capture = expose(signals, sensor, detector)
    image = decode(capture)
    cause = explain(image, capture, signals).cause
    error, left = (np.abs(i.z - signals.truth.z) for i in (image, decode(expose(plain, sensor))))
    other = np.isin(cause, [Cause.MULTIPATH, Cause.CAUSTIC])
    names = signals.truth.material_names
    optics = np.isin(cause, [Cause.SEEN_THROUGH, Cause.MIRRORED_GHOST, Cause.SPECULAR_AWAY])
    optics &= np.isin(signals.truth.material, [names.index("mirror"), names.index("transparent")])
    assert other.sum() > 500
    assert np.mean((left < 0.01) | (left < error / 2), where=other) > 0.97
    assert optics.sum() > 300
    assert np.mean(left < 0.01, where=optics) < 0.02


def test_causes_do_not_depend_on_the_seed_of_the_noise_where_optics_fails() -> None:
    """Mirrors and glass fail alike, whatever the noise."""
    sensor, detector = SENSORS["amcw"]
    scene = rangesim.load_scene(ROOT / "scenes" / "tabletop.xml")
    signals = rangesim.transport(scene, scene.rig(0.03, width=64, height=48), [sensor], spp=16)
    names = signals.truth.material_names
    delta = np.isin(signals.truth.material, [names.index("mirror"), names.index("transparent")])
    maps = []
    for seed in (1, 2):
        capture = expose(signals, sensor, detector, seed=seed)
        maps.append(explain(decode(capture), capture, signals).cause[delta])
    assert np.mean(maps[0] == maps[1]) > 0.95


@pytest.mark.parametrize(("name", "turn_deg"), [("amcw", 82), ("amcw", 85), ("direct", 85)])
def test_a_steep_wall_is_no_depth_edge_where_other_light_spoils_the_reading(name: str, turn_deg: float) -> None:
    """The depths of neighbours differ by more than 2 % all over it, so all of it was called a depth edge, though direct
    light alone is read right. Beside the wall behind it, where direct light alone is misread, there is an edge."""
    fine_bins = DirectToF(), SpadDetector()
    (sensor, detector), board = SENSORS["amcw"] if name == "amcw" else fine_bins, cause_scenes.board
    scene = cause_scenes.room(wall=board(0, 0, 1.2, 1.0), side=board(-0.25, 0, 0.9, 0.35, turn_deg=turn_deg))
    rig = scene.rig(0.01, width=40, height=30)
    signals, direct = (
        rangesim.transport(scene, rig, [sensor], spp=256, max_depth=max_depth, caustics=False) for max_depth in (6, 2)
    )
    capture = expose(signals, sensor, detector)
    found = explain(decode(capture), capture, signals)
    failed = cause_scenes.is_instance(signals, "side") & found.failed
    healed = failed & cause_scenes.right(decode(expose(direct, sensor)), signals)
    assert healed.sum() >= 15
    assert np.mean(found.cause[healed] == Cause.MULTIPATH) > 0.9
    assert (found.cause[failed & ~healed] == Cause.DEPTH_EDGE).all()


@pytest.mark.parametrize(("width", "turn_deg"), [(24, 0), (40, 15), (64, 0)])
def test_stripes_finer_than_a_pixel_are_too_coarse_and_not_multipath(width: int, turn_deg: float) -> None:
    """A pixel of many stripes is misread in direct light alone. Most of the wall was called multipath, as there is some
    of it and the path to the pixel's centre would be read right."""
    (sensor, detector), board = SENSORS["gray"], cause_scenes.board
    scene = cause_scenes.room(
        wall=board(0, 0, 1.5, 2.0, turn_deg=turn_deg), side=board(-0.45, 0, 1.2, 0.3, turn_deg=70)
    )
    rig = scene.rig(0.2, width=width, height=3 * width // 4)
    signals, direct = (
        rangesim.transport(scene, rig, [sensor], spp=512, max_depth=max_depth, caustics=False) for max_depth in (6, 2)
    )
    capture = expose(signals, sensor, detector)
    found = explain(decode(capture), capture, signals)
    healed = cause_scenes.right(decode(expose(direct, sensor)), signals)
    wall = cause_scenes.is_instance(signals, "wall") & signals.truth.projector_visible & found.failed & ~healed
    assert wall.sum() > 300
    assert np.mean(found.cause[wall] == Cause.RESOLUTION) > 0.97
    assert not (found.cause[wall] == Cause.MULTIPATH).any()


# ---- The laws ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("ambient", [0.0, 1.0], ids=["dark", "sunlit"])
@pytest.mark.parametrize("name", ["lines", "gray", "amcw", "histogram"])
def test_the_least_signal_is_where_decoders_begin_to_refuse(name: str, ambient: float) -> None:
    """At the signal that the budget calls needed, noise decides; at half and twice of it, it hardly does."""
    sensor, detector = SENSORS[name]
    rig = stereo_rig() if name in ("lines", "gray") else stereo_rig(baseline_m=0.03)
    exposure_s = 2e-3
    refused = {}
    power = _power_at_threshold(rig, sensor, detector, exposure_s, ambient)
    for factor in (0.5, 1.0, 2.0):
        dim = plane_signals(replace(rig, projector_power_w=factor * power), sensor, ambient=ambient)
        status = decode(expose(dim, sensor, detector, exposure_s, seed=3)).status
        lit = dim.truth.projector_visible
        refused[factor] = np.mean(status[lit] == Status.LOW_SIGNAL)
    assert refused[0.5] > 0.9
    assert 0.3 < refused[1.0] < 0.9  # some sensors have several thresholds
    assert refused[2.0] < 0.1


def _power_at_threshold(rig: Any, sensor: Sensor, detector: Any, exposure_s: float, ambient: float) -> float:
    """Watts at which the median pixel's signal is what it needs: the need does not depend on the power."""
    signals = plane_signals(replace(rig, projector_power_w=1.0), sensor, ambient=ambient)
    budget = light_budget(signals, expose(signals, sensor, detector, exposure_s), sensor.default_decoder)
    return float(np.median((budget.needed / budget.signal)[signals.truth.projector_visible]))


@pytest.mark.parametrize("noise", [True, False], ids=["noisy", "noise-free"])
def test_a_lens_that_darkens_the_corners_asks_for_more_light_there(noise: bool) -> None:
    """The detector needs what it needs, so before the lens 1 / cos^n as much; ambient light is darkened alike."""
    sensor, detector = SENSORS["gray"]
    rig = replace(stereo_rig(), camera_lens=Lens(0.75e-3, vignetting=4.0))
    even, darkened = (
        light_budget(signals, expose(signals, sensor, *((detector, 2e-3) if noise else ())), sensor.default_decoder)
        for signals in (
            plane_signals(replace(rig, camera_lens=Lens(0.75e-3, vignetting=n)), sensor, ambient=0.0)
            for n in (0.0, 4.0)
        )
    )
    np.testing.assert_array_equal(darkened.signal, even.signal)
    needed = darkened.needed * rig.camera_illumination
    np.testing.assert_allclose(needed, even.needed if noise else needed[0, 0], rtol=1e-6)


def test_a_white_surface_returns_what_lambert_s_law_says() -> None:
    """The plane of albedo 1/2 is half as bright, wherever it faces the projector squarely."""
    rig = stereo_rig(baseline_m=0.0)
    points = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0]])
    white = white_radiance(rig, points, np.array([[0.0, 0.0, -1.0]] * 2))
    np.testing.assert_allclose(white, rig.projector_irradiance / np.pi / 4)
    darkened = white_radiance(
        replace(rig, projector_lens=Lens(2e-3, vignetting=4.0)), points, np.array([[0.0, 0.0, -1.0]] * 2)
    )
    np.testing.assert_allclose(darkened / white, [1.0, (2 / np.sqrt(5)) ** 4])


@pytest.mark.parametrize("name", SENSORS)
def test_a_single_path_is_read_right(name: str) -> None:
    sensor, _ = SENSORS[name]
    signals = plane_signals(stereo_rig(), sensor)
    lit = signals.truth.projector_visible
    frames = single_path_frames(sensor, signals.rig, signals.truth)
    error = np.abs(decode(Capture(frames, sensor, signals.rig)).z - signals.truth.z)[lit]
    assert np.nanmax(error) < (0.02 if name == "histogram" else 0.005)  # bins of 30 mm in range
    assert np.isfinite(error).mean() > 0.99


def test_what_lies_beyond_the_range_is_wrapped_and_not_low_signal() -> None:
    sensor = DirectToF(bins=16, bin_s=200e-12)  # sees as far as 0.48 m
    signals = plane_signals(stereo_rig(baseline_m=0.0), sensor)
    capture = expose(signals, sensor)
    found = explain(decode(capture), capture, signals)
    assert (found.cause[signals.truth.projector_visible] == Cause.RANGE_AMBIGUITY).all()


def test_glint_is_named_where_it_is_most_of_the_light() -> None:
    sensor = AmcwToF()
    signals = plane_signals(stereo_rig(baseline_m=0.0), sensor)
    capture = expose(signals, sensor)
    image = decode(capture)
    image = replace(image, z=image.z + 0.05)
    energy = replace(signals.energy, glint=3 * signals.energy.direct)
    found = explain(image, capture, replace(signals, energy=energy))
    assert (found.cause[signals.truth.projector_visible] == Cause.GLINT).all()


def test_a_detector_that_the_sun_fills_is_swamped_and_one_that_the_projector_fills_saturated() -> None:
    sensor, detector = SENSORS["lines"]
    for ambient, power_w, cause in ((50.0, 1.0, Cause.AMBIENT), (0.0, 1000.0, Cause.GLINT)):
        signals = plane_signals(replace(stereo_rig(), projector_power_w=power_w), sensor, ambient=ambient)
        capture = expose(signals, sensor, replace(detector, ambient_transmission=1.0), 0.1)
        assert capture.saturated(capture.frames).mean() > 0.9
        found = explain(decode(capture), capture, signals)
        seen = signals.truth.projector_visible & found.failed
        assert seen.sum() > 100
        assert (found.cause[seen] == cause).all()


@pytest.mark.parametrize("wall_m", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("photons", [5.0, 11.0, 100.0])
def test_too_many_photons_a_pulse_are_pile_up_and_a_tenth_of_them_is_read(wall_m: float, photons: float) -> None:
    sensor, detector = DirectToF(), SpadDetector(bits=16)
    rig = stereo_rig(32, 24, baseline_m=0.0)
    one = plane_signals(rig, sensor, distance_m=wall_m)
    radiance = one.frames(sensor).sum(axis=0)
    mean = detector.mean_electrons(radiance, sensor.gate, rig, 1e-5) / detector.pulses(sensor.gate, 1e-5)
    scale = photons / np.median(mean[one.truth.projector_visible])
    failed = []
    for factor in (scale, scale / 10):
        signals = plane_signals(replace(rig, projector_power_w=factor), sensor, distance_m=wall_m)
        capture = expose(signals, sensor, detector, 1e-5)
        found = explain(decode(capture), capture, signals)
        seen = signals.truth.projector_visible & found.failed
        failed.append(seen.sum() / signals.truth.projector_visible.sum())
        if factor == scale:
            assert (found.cause[seen] == Cause.PILE_UP).all()
    assert failed[0] > 0.5
    assert photons > 20 or failed[1] < 0.1


def test_the_lens_in_a_mirror_is_glint_where_the_law_of_reflection_puts_it() -> None:
    """A mirror square to the camera shows the lens, 5 cm wide for once, as far behind it as it is before."""
    scene = cause_scenes.room(mirror=cause_scenes.board(0, 0, 1.0, 0.5, cause_scenes.SILVER))
    rig = replace(scene.rig(0.2, **cause_scenes.SIZE), projector_lens=Lens(0.05))
    sensor, detector = AmcwToF(), Detector.time_of_flight()
    signals = rangesim.transport(scene, rig, [sensor], spp=16)
    capture = expose(signals, sensor, detector, 1e-3)
    found = explain(decode(capture), capture, signals)
    x, _, z = rig.T_camera_projector[:3, 3]
    image_of_lens = rig.camera.project(np.array([x, 0.0, 2.0 - z]))
    away = np.linalg.norm(rig.camera.pixel_centres() - image_of_lens, axis=-1)
    radius = 0.05 * rig.camera.fx / (2.0 - z)
    assert (found.cause[away < radius - 1] == Cause.GLINT).all()
    assert (found.cause[away > radius + 1] == Cause.SPECULAR_AWAY).all()
    assert (away < radius - 1).sum() >= 5


def test_right_readings_and_empty_pixels_have_no_cause() -> None:
    sensor = StructuredLight()
    signals = plane_signals(stereo_rig(), sensor)
    capture = expose(signals, sensor)
    image = decode(capture)
    found = explain(image, capture, signals)
    assert not found.cause[image.valid].any()
    truth = replace(signals.truth, z=np.full_like(signals.truth.z, np.nan))
    assert not explain(image, capture, replace(signals, truth=truth)).failed.any()


# ---- Shares and errors ------------------------------------------------------------------------------


def test_shares_are_of_the_pixels_of_a_material() -> None:
    cause = np.array([[0, 1, 7, 7], [7, 0, 0, 4]], dtype=np.uint8)
    truth = GroundTruth(
        z=np.array([[1, 1, 1, 1], [1, 1, np.nan, 1]], np.float32),
        range_m=np.ones((2, 4), np.float32),
        normal=np.zeros((2, 4, 3), np.float32),
        instance=np.zeros((2, 4), np.int32),
        material=np.array([[0, 0, 0, 0], [0, 0, -1, 1]], np.int32),
        projector_uv=np.zeros((2, 4, 2), np.float32),
        projector_visible=np.ones((2, 4), bool),
        material_names=("matte", "mirror"),
    )
    fractions = CauseMap(cause, 0.01).fractions(truth)
    matte, mirror, everything = fractions
    assert matte == {
        "kind": "material",
        "name": "matte",
        "right": 2 / 6,
        "causes": {"multipath": 3 / 6, "shadowed": 1 / 6},
    }
    assert mirror == {"kind": "material", "name": "mirror", "right": 0.0, "causes": {"specular_away": 1.0}}
    assert everything["right"] == 2 / 7
    assert list(everything["causes"]) == ["multipath", "shadowed", "specular_away"]
    assert failures_markdown(fractions).splitlines() == [
        "| surface | right (%) | because (% of the pixels) |",
        "| --- | --- | --- |",
        "| material matte | 33.3 | multipath 50.0, shadowed from emitter 16.7 |",
        "| material mirror | 0.0 | specular away 100.0 |",
        "| all | 28.6 | multipath 42.9, shadowed from emitter 14.3, specular away 14.3 |",
    ]
    assert json.loads(json.dumps(fractions)) == list(fractions)
    nowhere = replace(truth, z=np.full((2, 4), np.nan, np.float32))
    nothing = CauseMap(np.zeros((2, 4), np.uint8), 0.01).fractions(nowhere)
    assert failures_markdown(nothing).splitlines()[2:] == ["| all | – | – |"]


def test_every_cause_is_printed_in_the_words_of_the_page() -> None:
    """The names were those of the enumeration: seen_through for 'seen through transparent'."""
    cause = np.repeat(np.arange(len(Cause), dtype=np.uint8), 3)[None]
    shape = cause.shape
    truth = GroundTruth(
        z=np.ones(shape, np.float32),
        range_m=np.ones(shape, np.float32),
        normal=np.zeros((*shape, 3), np.float32),
        instance=np.zeros(shape, np.int32),
        material=np.zeros(shape, np.int32),
        projector_uv=np.zeros((*shape, 2), np.float32),
        projector_visible=np.ones(shape, bool),
        material_names=("wall",),
    )
    fractions = CauseMap(cause, 0.01).fractions(truth)
    for row in fractions:
        assert [part.name for part in parts(row)] == [TITLES[c] for c in Cause if c]
    listed = ", ".join(f"{TITLES[c]} 5.0" for c in Cause if c)
    assert len(Cause) == 20
    assert failures_markdown(fractions).splitlines()[2:] == [
        f"| material wall | 5.0 | {listed} |",
        f"| all | 5.0 | {listed} |",
    ]


def test_wrong_arguments_are_refused() -> None:
    sensor = StructuredLight()
    signals = plane_signals(stereo_rig(), sensor)
    small = plane_signals(stereo_rig(width=80, height=60), sensor)
    capture = expose(small, sensor)
    with pytest.raises(ValueError, match=r"expected image and capture of shape \(120, 160\)"):
        explain(decode(capture), capture, signals)
    with pytest.raises(ValueError, match="expected a positive tolerance_m"):
        explain(decode(capture), capture, small, tolerance_m=0)


def test_the_docs_define_every_cause() -> None:
    text = (ROOT / "docs" / "causes.md").read_text(encoding="utf-8")
    for cause in Cause:
        if cause:
            assert f"| {TITLES[cause]} | {DEFINITIONS[cause]} |" in text
    assert set(TITLES) == set(DEFINITIONS) == set(Cause)


# ---- The energy split over path length --------------------------------------------------------------


def test_the_split_over_path_length_adds_up_to_bins_and_to_the_energy_split(signals: Signals) -> None:
    parts = signals.channels[SPLIT].reshape(len(KINDS), 80, 48, 64)
    np.testing.assert_allclose(parts.sum(axis=0), signals.channels[BINS], rtol=1e-5, atol=1e-6)
    for kind, part in zip(KINDS, parts, strict=True):
        np.testing.assert_allclose(part.sum(axis=0), getattr(signals.energy, kind), rtol=1e-4, atol=1e-6)
    assert all(parts[k].any() for k in (DIRECT, MULTIPATH, SPECULAR, CAUSTIC))


def test_paths_out_of_the_bins_count_nowhere() -> None:
    split = LengthSplit(1.0, 0.5, 4)
    length = np.array([0.9, 1.0, 2.99, 3.0, 2.2])
    kind = np.array([0, 0, 1, 1, 4], dtype=np.uint32)
    found = split.bin(LightPath(0 * length, 0 * length, length, length > 0, kind), NumpyMath())
    assert found.tolist() == [split.channels, 0, 4 + 3, split.channels, 16 + 2]


EASY = [StructuredLight(256, 160), AmcwToF(), DirectToF(), IdealToF()]


@pytest.mark.parametrize("sensor", EASY, ids=lambda s: s.type_name)
def test_where_nothing_fails_nothing_is_explained(sensor: Sensor) -> None:
    scene = rangesim.load_scene(ROOT / "scenes" / "plane.xml")
    signals = rangesim.transport(scene, scene.rig(0.2, (256, 160), width=16, height=12), [sensor], spp=16)
    capture = rangesim.expose(signals, sensor)
    found = explain(rangesim.decode(capture), capture, signals, tolerance_m=0.2)
    assert not found.failed.any()
    assert found.fractions(signals.truth)[-1] == {"kind": "all", "name": "all", "right": 1.0, "causes": {}}
