# SPDX-License-Identifier: Apache-2.0
"""Stereo with dots: the pattern, planes of known depth, sets of captures, and the way from the scene to the report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import all_bytes, dots_on_plane
from tiers import to_validate

import rangesim
from rangesim import (
    ActiveStereo,
    Capture,
    CaptureSet,
    Detector,
    Intrinsics,
    Rig,
    Status,
    StructuredLight,
    compare,
    decode,
    explain,
    expose,
    load_capture,
    look_at,
    save_capture,
    transport,
)
from rangesim.causes import Cause
from rangesim.evaluation.range_noise import range_noise
from rangesim.experiment import Experiment
from rangesim.geometry import DenseMatching
from rangesim.instrument.instrument import Instrument
from rangesim.light_transport.transport_settings import TransportSettings
from rangesim.motion import ConstantTwist, Motion, Timing, transport_moving
from rangesim.pipeline.experiment_run import run
from rangesim.response import Dots, Images, LightPath, NumpyMath
from rangesim.results.experiment_results import load_result
from rangesim.rig import translation
from rangesim.sensors import StereoDecoder, sensor_from_dict
from rangesim.settings.config import from_dict, to_dict
from rangesim.signals import SignalSet, StillSignals

SCENES = Path(__file__).resolve().parent.parent / "scenes"


# ---- The pattern ---------------------------------------------------------------------------------------------------


def test_dots_are_gaussians_and_their_mean_is_that_of_white_light() -> None:
    dots = Dots(60, 40, spacing_px=5.0, dot_px=0.7, seed=3)
    x, y = np.meshgrid(np.arange(0.125, 60, 0.25), np.arange(0.125, 40, 0.25))
    (weights,) = dots.weights(LightPath(x, y, 0 * x, True), NumpyMath())
    assert weights.mean() == pytest.approx(1, abs=0.04)  # the dots at the border lose a part
    u, v = dots._places
    expected = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * 0.7**2)) for a, b in zip(u, v, strict=True))
    np.testing.assert_allclose(weights, expected * 25 / (2 * np.pi * 0.7**2), atol=0.02)
    assert dots.number == len(u) == 96
    assert not np.array_equal(Dots(60, 40, seed=4).image(), Dots(60, 40, seed=3).image())


def test_dots_out_of_focus_are_wider_and_keep_their_light() -> None:
    dots = Dots(60, 40, spacing_px=5.0, dot_px=0.7)
    x, y = np.meshgrid(np.arange(10, 50, 0.25), np.arange(10, 30, 0.25))
    sharp, soft = (dots.weights(LightPath(x, y, 0 * x, True, blur_px=b), NumpyMath())[0] for b in (None, 1.0))
    assert soft.max() < 0.5 * sharp.max()
    assert soft.mean() == pytest.approx(sharp.mean(), rel=0.05)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dot_px": 3.0}, "dot_px to be at most a third of spacing_px, got 3 and 6"),
        ({"spacing_px": 0.0}, "spacing_px"),
        ({"seed": -1}, "seed"),
    ],
)
def test_dots_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Dots(**({"width": 64, "height": 48} | change))


def test_a_sensor_is_read_back_from_plain_data() -> None:
    for sensor in (ActiveStereo(baseline_m=0.07), ActiveStereo(pattern=None)):
        assert sensor_from_dict(to_dict(sensor), "sensor") == sensor
    decoder = StereoDecoder(DenseMatching("zncc"), step_px=0.125)
    assert from_dict(StereoDecoder, to_dict(decoder)) == decoder
    with pytest.raises(ValueError, match="expected the pattern as Dots, as Images of one image"):
        ActiveStereo(pattern=Images(np.zeros((2, 4, 4), np.float32)))
    with pytest.raises(ValueError, match="a projector of 640 x 400 pixels, as the pattern of dots, got 8 x 8"):
        ActiveStereo().check(8, 8)


# ---- Planes of known depth -----------------------------------------------------------------------------------------


def stereo(width: int = 240, height: int = 160, **changes: Any) -> tuple[ActiveStereo, tuple[Rig, ...]]:
    """A sensor and its rigs: cameras 50 mm apart and a projector between them."""
    sensor = ActiveStereo()
    rig = Rig(
        Intrinsics.from_fov(width, height, 40.0), Intrinsics.from_fov(640, 400, 48.0),
        T_camera_projector=translation(0.025, 0, 0),
    )  # fmt: skip
    return sensor, sensor.rigs(replace(rig, **changes))


def set_of_plane(
    sensor: ActiveStereo, rigs: tuple[Rig, ...], normal: tuple[float, ...], distance_m: float
) -> tuple[CaptureSet, np.ndarray]:
    taken = [dots_on_plane(rig, sensor, normal, distance_m) for rig in rigs]
    return CaptureSet(tuple(capture for capture, _ in taken)), taken[0][1]


MIDDLE = slice(8, -8), slice(60, -8)
"""Pixels whose windows both cameras see."""


@pytest.mark.parametrize("distance_m", [*to_validate(0.6), 0.83, *to_validate(1.1)])
@pytest.mark.parametrize("matching", [DenseMatching(), DenseMatching("zncc", "local"), DenseMatching("opencv")])
def test_a_fronto_parallel_plane_is_read_to_a_twentieth_of_a_pixel(distance_m: float, matching: DenseMatching) -> None:
    sensor, rigs = stereo()
    taken, _ = set_of_plane(sensor, rigs, (0, 0, 1), distance_m)
    found = StereoDecoder(matching, disparities=64).coordinates(taken)
    error = (found.disparity_px - rigs[0].camera.fx * 0.05 / distance_m)[MIDDLE]
    known = np.isfinite(error)
    assert known.mean() > 0.97
    assert np.sqrt(np.mean(error[known] ** 2)) < 0.05
    assert abs(np.median(error[known])) < 0.02


def test_an_inclined_plane_is_read_by_turned_cameras_with_distortion() -> None:
    camera = Intrinsics(240, 160, 330.0, 332.0, 118.0, 83.0, (-0.15, 0.05, 0.001, -0.002))
    sensor, (rig, _) = stereo(camera=camera)
    other = rig.with_camera(look_at((0.05, 0.004, -0.003), (0, 0, 1.0), up=(0.02, -1, 0)))
    taken, z = set_of_plane(sensor, (rig, other), (0.3, 0.1, 1.0), 0.8)
    image = decode(taken, StereoDecoder(disparities=64))
    inside = np.abs(image.z - z)[12:-12, 60:-12]
    assert np.isfinite(inside).mean() > 0.95
    assert np.nanmedian(inside) < 0.05 * 0.8**2 / (330 * 0.05)  # a twentieth of a pixel
    assert image.camera == camera


def test_the_camera_on_the_right_may_be_the_reference() -> None:
    sensor, (left, right) = stereo()
    taken, z = set_of_plane(sensor, (right, left), (0.1, 0, 1.0), 0.8)
    image = decode(taken, StereoDecoder(disparities=64))
    error = np.abs(image.z - z)[8:-8, 8:-60]
    assert np.isfinite(error).mean() > 0.95
    assert np.nanmedian(error) < 2e-3


def test_disparities_in_steps_are_rounded() -> None:
    sensor, rigs = stereo()
    taken, _ = set_of_plane(sensor, rigs, (0.3, 0, 1), 0.8)
    fine, coarse = (StereoDecoder(disparities=64, step_px=s).coordinates(taken) for s in (0.0, 0.125))
    known = fine.valid
    np.testing.assert_array_equal(8 * coarse.disparity_px[known] % 1, 0)
    assert np.abs(coarse.disparity_px - fine.disparity_px)[known].max() <= 0.0626
    assert (coarse.sigma_px[known] > fine.sigma_px[known]).all()


def test_a_surface_nearer_than_the_range_is_not_read() -> None:
    sensor, rigs = stereo()
    taken, _ = set_of_plane(sensor, rigs, (0, 0, 1), 0.6)  # 27 pixels
    image = decode(taken, StereoDecoder(disparities=16))
    assert not image.valid.any()
    assert (image.status == Status.OUT_OF_RANGE).sum() + (image.status == Status.AMBIGUOUS).sum() > 0.5 * image.z.size


def test_a_pair_without_rigs_has_disparities_and_no_depths() -> None:
    sensor, rigs = stereo()
    taken, _ = set_of_plane(sensor, rigs, (0, 0, 1), 0.8)
    bare = CaptureSet(tuple(replace(c, rig=None) for c in taken.captures))
    found = StereoDecoder(disparities=64).coordinates(bare)
    assert np.nanmedian(found.disparity_px) == pytest.approx(rigs[0].camera.fx * 0.05 / 0.8, abs=0.02)
    assert np.isnan(decode(bare).z).all()


def test_the_depth_s_standard_deviation_is_that_of_parallel_cameras() -> None:
    sensor, rigs = stereo()
    taken, _ = set_of_plane(sensor, rigs, (0, 0, 1), 0.8)
    found = StereoDecoder(disparities=64).coordinates(taken)
    image = found.range_image(rigs[0])
    sigma = found.depth_error_m(image)[found.valid]
    np.testing.assert_allclose(
        sigma, (image.z**2 / (rigs[0].camera.fx * 0.05) * found.sigma_px)[found.valid], rtol=1e-5
    )


# ---- Sets of captures ----------------------------------------------------------------------------------------------


def blank(sensor: Any = None, rig: Rig | None = None, size: tuple[int, int] = (48, 64)) -> Capture:
    sensor = sensor or ActiveStereo()
    return Capture(np.zeros((sensor.n_frames, *size), np.uint8), sensor, rig)


@pytest.mark.parametrize("value", [0, 17, 65535])
def test_frames_without_texture_are_not_read(value: int) -> None:
    _, rigs = stereo(64, 48)
    frames = np.full((1, 48, 64), value, dtype=np.uint16)
    image = decode(CaptureSet(tuple(Capture(frames, ActiveStereo(), rig) for rig in rigs)))
    assert not image.valid.any()
    assert (image.status == (Status.SATURATED if value == 65535 else Status.LOW_SIGNAL)).all()


def test_masked_pixels_are_not_read() -> None:
    sensor, rigs = stereo()
    taken, _ = set_of_plane(sensor, rigs, (0, 0, 1), 0.8)
    masked = []
    for capture in taken.captures:
        frames = capture.frames.copy()
        frames[:, 40:60, 100:130] = np.nan
        masked.append(replace(capture, frames=frames))
    image = decode(CaptureSet(tuple(masked)), StereoDecoder(disparities=64))
    assert not image.valid[40:60, 100:130].any()
    assert np.nanmax(np.abs(image.z[MIDDLE] - 0.8)) < 0.05


def test_what_makes_no_set_is_refused() -> None:
    _, (left, right) = stereo(64, 48)
    for captures, message in (
        ((blank(),), "expected two captures or more"),
        ((blank(), 3), "expected two captures or more"),
        ((blank(), blank(ActiveStereo(baseline_m=0.1))), "expected captures of one sensor"),
        ((blank(rig=left), blank()), "expected a rig of every capture, or of none"),
        ((blank(rig=left), blank(rig=replace(right, projector_power_w=2.0))), "rig 1 has another projector_power_w"),
    ):
        with pytest.raises(ValueError, match=message):
            CaptureSet(captures)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected captures of 2 cameras for active-stereo, got 1; expose the signals"):
        decode(blank())
    gray = StructuredLight(8, 8)
    with pytest.raises(ValueError, match="expected captures of 1 camera for structured-light, got 2; decode each"):
        decode(CaptureSet((blank(gray), blank(gray))))
    with pytest.raises(ValueError, match="expected a CaptureSet of two cameras"):
        StereoDecoder().coordinates(CaptureSet((blank(), blank(), blank())))
    with pytest.raises(ValueError, match="expected rigs, or rectified images of one size"):
        StereoDecoder().coordinates(CaptureSet((blank(), blank(size=(48, 60)))))


def test_a_set_is_read_back_as_it_was_saved(tmp_path: Path) -> None:
    sensor, rigs = stereo(64, 48)
    random = np.random.default_rng(0)
    frames = random.integers(0, 4000, (2, 1, 48, 64), dtype=np.uint16)
    pair = CaptureSet(tuple(Capture(f, sensor, r, Detector(), 1e-3) for f, r in zip(frames, rigs, strict=True)))
    save_capture(pair, tmp_path / "pair")
    again = load_capture(tmp_path / "pair")
    assert isinstance(again, CaptureSet)
    for one, other in zip(pair.captures, again.captures, strict=True):
        np.testing.assert_array_equal(one.frames, other.frames)
        assert (one.rig, one.detector, one.exposure_s) == (other.rig, other.detector, other.exposure_s)
    sidecar = tmp_path / "pair" / "capture.json"
    sidecar.write_text(sidecar.read_text().replace("camera_2", "../camera_2"))
    with pytest.raises(rangesim.errors.FileFormatError, match="expected names such as camera_2"):
        load_capture(tmp_path / "pair")


# ---- From the scene to the report ----------------------------------------------------------------------------------

SMALL = Dots(160, 120, spacing_px=5.0, dot_px=0.8)
SENSOR = ActiveStereo(SMALL, baseline_m=0.06)


@pytest.fixture(scope="module")
def both() -> SignalSet:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    rigs = Instrument("stereo", SENSOR).rigs(scene, 96, 72)
    return transport(scene, rigs, [SENSOR, ActiveStereo(None, 0.06)], spp=32, max_depth=2, caustics=False)


def test_signals_of_several_cameras_are_a_set(both: SignalSet) -> None:
    assert len(both) == 2
    left, right = both
    assert left.truth is both.truth
    assert right.rig.T_world_camera[0, 3] != left.rig.T_world_camera[0, 3]
    assert [one.rig for one in both[:2]] == [left.rig, right.rig]
    with pytest.raises(ValueError, match="expected signals of one camera or more"):
        SignalSet.of([])
    with pytest.raises(ValueError, match="camera 1 has another projector_power_w"):
        SignalSet.of([left, replace(right, rig=replace(right.rig, projector_power_w=3.0))])


def test_signals_are_saved_camera_by_camera(both: SignalSet, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected StillSignals, got SignalSet; save the signals of each camera"):
        rangesim.save_signals(both, tmp_path / "both.npz")  # type: ignore[arg-type]
    for number, signals in enumerate(both):
        assert isinstance(signals, StillSignals)
        rangesim.save_signals(signals, tmp_path / f"{number}.npz")
    again = SignalSet.of([rangesim.load_signals(tmp_path / f"{number}.npz") for number in range(2)])
    np.testing.assert_array_equal(decode(expose(again, SENSOR)).z, decode(expose(both, SENSOR)).z)


def test_the_first_camera_of_two_keeps_its_bytes(both: SignalSet) -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    sensors = [SENSOR, ActiveStereo(None, 0.06)]
    alone = transport(scene, both.rig, sensors, spp=32, max_depth=2, caustics=False)
    assert all_bytes(alone) == all_bytes(both[0])
    detector = SENSOR.default_detector
    pair, single = expose(both, SENSOR, detector, seed=5), expose(alone, SENSOR, detector, seed=5)
    assert isinstance(pair, CaptureSet)
    assert pair.reference.frames.tobytes() == single.frames.tobytes()
    first, second = pair.captures
    assert first.exposure_s == second.exposure_s
    noise = [c.frames - expose(both, SENSOR, detector, seed=6).captures[i].frames for i, c in enumerate(pair.captures)]
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.05  # noise of their own


@pytest.mark.parametrize("detector", [None, SENSOR.default_detector])
def test_a_plane_is_measured_compared_and_explained(both: SignalSet, detector: Detector | None) -> None:
    capture = expose(both, SENSOR, detector)
    image = decode(capture)
    row = compare(image, both).row("all")
    assert row.completeness > 0.8
    assert row.median_abs_m < 0.01
    noise = range_noise(image, capture, both).by_surface(both.truth)[-1]
    assert 0 < noise["sampling_sigma_m"] < 0.01
    causes = explain(image, capture, both)
    occluded = causes.cause == Cause.OCCLUDED
    assert occluded[:, :6].all()  # the second camera does not see the left border, 6.2 pixels of it
    assert not occluded[:, 40:].any()


def test_passive_stereo_finds_no_texture_on_a_white_wall(both: SignalSet) -> None:
    sensor = ActiveStereo(None, 0.06)
    even = [replace(s, energy=replace(s.energy, ambient=np.full_like(s.energy.ambient, 0.1))) for s in both]
    lit = SignalSet.of(even)
    capture = expose(lit, sensor, sensor.default_detector)
    image = decode(capture)
    assert (image.status == Status.LOW_SIGNAL).all()
    causes = explain(image, capture, lit)
    assert (causes.cause[:, 20:] == Cause.NO_TEXTURE).all()
    assert sensor.responses() == ()
    assert not sensor.reads_emitter


def test_too_little_light_of_the_emitter_is_the_cause(both: SignalSet) -> None:
    capture = expose(both, SENSOR, SENSOR.default_detector, exposure_s=2e-8)
    image = decode(capture)
    causes = explain(image, capture, both)
    assert image.valid.mean() < 0.05
    assert (causes.cause == Cause.LOW_SIGNAL)[:, 20:].mean() > 0.9


def test_an_experiment_with_two_cameras_is_written_and_read_back(tmp_path: Path) -> None:
    instruments = (
        Instrument("stereo", SENSOR),
        Instrument("again", SENSOR, decoder=StereoDecoder(DenseMatching("zncc"))),
        Instrument("ideal", rangesim.IdealToF(), baseline_m=0.03, projector=Intrinsics.from_fov(160, 120, 60)),
    )
    experiment = Experiment(str(SCENES / "plane.xml"), width=64, height=48, spp=8, max_depth=2, instruments=instruments)
    result = run(experiment, tmp_path / "out")
    assert len(result.passes) == 2  # both stereo instruments share one
    again = load_result(tmp_path / "out")
    for one, other in zip(result.measurements, again.measurements, strict=True):
        assert len(one.capture.captures) == len(other.capture.captures)
        np.testing.assert_array_equal(one.image.z, other.image.z)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "infrared, camera 2" in page
    image = decode(load_capture(tmp_path / "out" / "stereo" / "capture"))
    np.testing.assert_array_equal(image.z, result.measurements[0].image.z)


def test_the_number_of_samples_may_follow_the_noise_of_the_frames() -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    rigs = Instrument("stereo", SENSOR).rigs(scene, 32, 24)
    signals = transport(scene, rigs, [SENSOR], max_depth=2, caustics=False)
    assert signals.knows_sampling_error


def test_a_scan_takes_both_cameras_along() -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    rig = Instrument("stereo", SENSOR).rig(scene, 48, 36)
    settings = TransportSettings(spp=8, max_depth=2, caustics=False)
    views = rangesim.scan(scene, rig, SENSOR, np.stack([rig.T_world_camera] * 2), settings)
    assert all(image.valid.mean() > 0.3 for image in views.images)


def test_both_cameras_see_an_object_at_one_moment() -> None:
    scene = rangesim.load_scene(SCENES / "plane.xml")
    name = scene.instances[0].name
    rig = Instrument("stereo", SENSOR).rig(scene, 48, 36)
    still = {SENSOR: Timing(), StructuredLight(160, 120): Timing(frame_period_s=0.01)}
    found = transport_moving(
        scene, rig, still, Motion({name: ConstantTwist(velocity_m_s=(0, 0.2, 0))}), spp=4, max_depth=2, caustics=False
    )
    signals = found[SENSOR]
    assert isinstance(signals, SignalSet)
    assert len(signals) == 2
    assert decode(expose(signals, SENSOR)).valid.mean() > 0.3
    assert not isinstance(found[StructuredLight(160, 120)], SignalSet)
