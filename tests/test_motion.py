# SPDX-License-Identifier: Apache-2.0
"""Captures of a world that moves, against closed forms: phases that drift, scans that shear, what stands still."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import all_bytes
from tiers import to_validate

import rangesim
from rangesim import AmcwToF, DirectToF, IdealToF, Intrinsics, Rig, Scene, Sensor, Signals, StructuredLight, transport
from rangesim.causes import Cause
from rangesim.codes import GrayPhase
from rangesim.decoding.phase_shift import phase_of, tap_phase
from rangesim.experiment import experiment_from_dict, experiment_to_dict
from rangesim.motion import ConstantTwist, Motion, MovingSignals, PoseTrack, Timing, transport_moving
from rangesim.motion.passes import plan
from rangesim.pipeline.experiment_run import run
from rangesim.response import SPEED_OF_LIGHT
from rangesim.results.experiment_results import load_result
from rangesim.rig import translation

SCENES = Path(__file__).resolve().parent.parent / "scenes"
CARD = """<scene version="3.0.0">
    <sensor type="perspective">
        <float name="fov" value="50"/>
        <transform name="to_world"><lookat origin="0, 0, 0" target="0, 1, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="48"/></film>
    </sensor>
    <shape type="rectangle" id="wall">
        <transform name="to_world"><scale value="2"/><rotate x="1" angle="90"/><translate y="1.2"/></transform>
    </shape>
    <shape type="rectangle" id="card">
        <transform name="to_world">
            <scale x="0.3" y="1"/><rotate x="1" angle="90"/><translate x="-0.4" y="0.8"/>
        </transform>
    </shape>
</scene>"""


@pytest.fixture(scope="module")
def plane() -> Scene:
    return rangesim.load_scene(SCENES / "plane.xml")


@pytest.fixture(scope="module")
def matte() -> Scene:
    return rangesim.load_scene(SCENES / "matte.xml")


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A card 0.8 m away before a wall at 1.2 m; its right edge is at x = -0.1 m."""
    path = tmp_path_factory.mktemp("scenes") / "card.xml"
    path.write_text(CARD)
    return rangesim.load_scene(path)


def straight_rig(scene: Scene, baseline_m: float, projector: Intrinsics) -> Rig:
    """Camera of 64 x 48 pixels and a projector beside it that looks the same way."""
    return Rig(scene.camera.resized(64, 48), projector, scene.T_world_camera, translation(baseline_m, 0, 0))


# ---- Tracks and timings -----------------------------------------------------------------------------


def test_a_pose_track_is_linear_in_translation_and_in_angle_and_constant_beyond_its_ends() -> None:
    quarter = ConstantTwist((1.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2))
    track = PoseTrack(np.array([1.0, 2.0]), np.stack([np.eye(4), quarter.at(1.0)]))
    np.testing.assert_allclose(track.at(1.5), quarter.at(0.5), atol=1e-12)
    np.testing.assert_array_equal(track.at(-7.0), np.eye(4))
    np.testing.assert_allclose(track.at(9.0), quarter.at(1.0), atol=1e-12)


def test_a_steady_track_turns_about_its_centre_which_moves_on() -> None:
    track = ConstantTwist((0.5, 0.0, 0.0), (0.0, 0.0, 2.0), (1.0, 2.0, 3.0))
    np.testing.assert_allclose(track.at(0.3) @ [1, 2, 3, 1], [1.15, 2, 3, 1], atol=1e-12)
    np.testing.assert_allclose(track.at(0.1)[:2, 0], [np.cos(0.2), np.sin(0.2)], atol=1e-12)


@pytest.mark.parametrize(
    ("times", "poses", "message"),
    [
        ([0.0, 0.0], [np.eye(4)] * 2, "times that increase"),
        ([1.0, 0.0], [np.eye(4)] * 2, "times that increase"),
        ([0.0], [np.eye(4)] * 2, "as many poses"),
        ([0.0], [2 * np.eye(4)], "pose 0 of the track to be rigid"),
    ],
)
def test_a_track_that_is_none_is_refused(times: list[float], poses: list[np.ndarray], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PoseTrack(np.array(times), np.array(poses))


@pytest.mark.parametrize("change", [{"bands": 0}, {"line_period_s": -1.0}, {"lines": "row"}, {"exposure_samples": 1.5}])
def test_a_timing_that_is_none_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=f"expected {next(iter(change))}"):
        Timing(**change)  # type: ignore[arg-type]


def test_which_frames_share_an_exposure() -> None:
    assert Timing().exposure_of_frames(AmcwToF((20e6, 50e6))).tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert Timing(single_tap=True).exposure_of_frames(AmcwToF((20e6,))).tolist() == [0, 1, 2, 3]
    assert not Timing(single_tap=True).exposure_of_frames(DirectToF()).any()
    sensor = StructuredLight()
    assert Timing().exposure_of_frames(sensor).tolist() == list(range(sensor.n_frames))


def test_the_lines_of_a_scan_are_covered_once_each_at_its_time() -> None:
    camera, timing = Intrinsics.from_fov(64, 48, 50), Timing(line_period_s=0.1, bands=7)
    instants = timing.instants(2.0, camera)
    assert [i.window.top for i in instants][1:] == [i.window.bottom for i in instants][:-1]
    assert (instants[0].window.top, instants[-1].window.bottom) == (0, 48)
    for time_s, window, fraction in instants:
        lines = np.arange(window.top, window.bottom)
        assert time_s == pytest.approx(np.mean(2.0 + 0.1 * lines))
        assert fraction == 1
    assert timing.reference_s(DirectToF(), camera) == pytest.approx(0.1 * 47 / 2)


def test_equal_places_share_a_pass_whatever_the_sensor(matte: Scene) -> None:
    rig = matte.rig(width=64, height=48)
    light, tof = StructuredLight(), AmcwToF((20e6, 50e6))
    timings: dict[Sensor, Timing] = {light: Timing(0.01), tof: Timing(0.01), DirectToF(): Timing(line_period_s=0.001)}
    assert len(plan(rig, timings, Motion({"can": ConstantTwist()}))) == 1
    ball = Motion({"large_ball": ConstantTwist((1.0, 0.0, 0.0))})
    bands = [p for p in plan(rig, timings, ball) if p.window.bottom - p.window.top < 48]
    times = {*Timing(0.01).exposure_times_s(light), *(t.reference_s(s, rig.camera) for s, t in timings.items())}
    assert len(bands) == 16
    assert len(plan(rig, timings, ball)) == len(times) + len(bands)


# ---- What stands still ------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::rangesim.errors.TruncationWarning")  # cornell at the default depth
def test_without_motion_the_bytes_are_those_of_a_static_pass() -> None:
    scene = rangesim.load_scene(SCENES / "cornell.xml")  # with a lamp
    rig = scene.rig(width=32, height=24)
    timings: dict[Sensor, Timing] = {
        StructuredLight(): Timing(exposure_s=0.01, exposure_samples=3),
        AmcwToF(): Timing(single_tap=True),
        DirectToF(bins=32, bin_s=1e-9): Timing(line_period_s=0.01),
    }
    still = PoseTrack(np.array([0.0, 1.0]), np.stack([np.eye(4)] * 2))
    moving = transport_moving(scene, rig, timings, Motion({"floor": still}, rig=still), spp=4, seed=3)
    static = transport(scene, rig, list(timings), spp=4, seed=3)
    assert list(moving) == list(timings)
    for sensor, signals in moving.items():
        np.testing.assert_array_equal(signals.frames(sensor, 0.3), static.frames(sensor, 0.3))
        np.testing.assert_array_equal(signals.truth.z, static.truth.z)
        assert signals.motion_m is None
        assert signals.rig == rig


def test_the_scene_is_as_it_was_afterwards_even_if_something_went_wrong(matte: Scene) -> None:
    rig = matte.rig(width=32, height=24)
    before = all_bytes(transport(matte, rig, [IdealToF()], spp=4))
    everything = Motion({i.name: ConstantTwist((0.3, 0.2, 0.1), (0.5, 0.0, 1.0)) for i in matte.instances})
    transport_moving(matte, rig, {AmcwToF((20e6,)): Timing(0.1, single_tap=True)}, everything, spp=4)
    assert all_bytes(transport(matte, rig, [IdealToF()], spp=4)) == before

    def stop(fraction: float) -> None:
        if fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        transport_moving(matte, rig, {StructuredLight(): Timing(0.1)}, everything, spp=1, progress=stop)
    assert all_bytes(transport(matte, rig, [IdealToF()], spp=4)) == before


@pytest.mark.validation
def test_a_static_scene_scanned_in_bands_is_the_same_within_its_noise(matte: Scene) -> None:
    rig, sensor = matte.rig(width=64, height=48), DirectToF(bins=64, bin_s=100e-12)
    hardly = Motion({"wall": ConstantTwist((1e-12, 0.0, 0.0))})  # every band is a pass of its own
    for lines in ("rows", "columns"):
        timing = Timing(line_period_s=0.01, lines=lines, bands=5)  # type: ignore[arg-type]
        options: dict[str, Any] = {"spp": 16, "indirect": "raw"}  # a pixel at a border has fewer to share with
        scanned = transport_moving(matte, rig, {sensor: timing}, hardly, seed=1, **options)[sensor].frames(sensor)
        whole, other = (transport(matte, rig, [sensor], seed=s, **options).frames(sensor) for s in (2, 3))
        noise = np.sqrt(np.mean((whole - other) ** 2))
        assert np.sqrt(np.mean((whole - scanned) ** 2)) == pytest.approx(noise, rel=0.1)
        assert scanned.sum() == pytest.approx(whole.sum(), rel=2e-3)


def test_moving_the_rig_is_moving_everything_else_the_other_way(matte: Scene) -> None:
    """Spheres, cubes (meshes), rectangles, a cylinder and a disk."""
    rig, sensor = matte.rig(width=64, height=48), AmcwToF((20e6,))
    centre, timing = (0.0, 0.1, 0.1), {sensor: Timing(0.02, single_tap=True)}
    forth, back = (ConstantTwist(rotation_rad_s=(s * 0.3, 0.0, s * 1.0), centre_m=centre) for s in (1, -1))
    (one,) = transport_moving(matte, rig, timing, Motion(rig=forth), spp=8).values()
    (other,) = transport_moving(matte, rig, timing, Motion({i.name: back for i in matte.instances}), spp=8).values()
    np.testing.assert_array_equal(one.truth.instance, other.truth.instance)
    np.testing.assert_allclose(one.truth.z, other.truth.z, rtol=2e-5)
    assert one.motion_m is not None
    np.testing.assert_allclose(one.motion_m, other.motion_m, atol=1e-6)
    assert one.motion_m.max() > 0.01
    difference = np.abs(one.frames(sensor) - other.frames(sensor)) / one.frames(sensor).mean()
    assert np.quantile(difference, 0.95) < 1e-4  # but for paths that rounding sends to the other side of an edge
    np.testing.assert_allclose(one.rig.T_world_camera, forth.at(0.03) @ rig.T_world_camera)


def test_the_normals_of_a_mesh_file_turn_with_it(tmp_path: Path) -> None:
    """Normals of the file that are not those of its triangles, on a ball that half a turn brings onto itself."""
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    bent = trimesh.Trimesh(
        ball.vertices, ball.faces, vertex_normals=np.add(ball.vertex_normals, [0.0, 0.0, 0.5]), process=False
    )
    bent.export(tmp_path / "ball.ply", vertex_normal=True)
    shape = '<shape type="ply" id="ball"><string name="filename" value="ball.ply"/></shape>'
    (tmp_path / "ball.xml").write_text(
        re.sub(r"<shape.*</shape>", shape, CARD, flags=re.DOTALL).replace("0, 0, 0", "0, -1, 0")
    )
    scene = rangesim.load_scene(tmp_path / "ball.xml")
    rig, sensor = scene.rig(width=48, height=36), AmcwToF((20e6,))
    half_turn = Motion({"ball": ConstantTwist(rotation_rad_s=(0.0, 0.0, np.pi))})  # in 1 s
    (moved,) = transport_moving(scene, rig, {sensor: Timing(start_s=1.0)}, half_turn, spp=4).values()
    static = transport(scene, rig, [sensor], spp=4).frames(sensor)
    difference = np.abs(moved.frames(sensor) - static)
    assert np.quantile(difference, 0.95) < 1e-4 * static.mean()


# ---- Closed forms -----------------------------------------------------------------------------------


def phase_error(phase: np.ndarray, drift: np.ndarray, loss: float, contrast: float) -> np.ndarray:
    """Error of the phase of four frames at 0, 90, 180, 270 degrees, against the phase in the middle of the four.

    To first order in what changes from one frame to the next: the phase, by `drift` radians, and the light, by the
    fraction -`loss`. With frames (1 + contrast cos(phi_j - theta_j)) B_j / 2, cosine = frame 0 - frame 2 and sine =
    frame 1 - frame 3 are taken half a frame before and after the middle, which gives three terms: the phases differ,
    the offset does not cancel, and sine is fainter than cosine.
    """
    offset = loss / contrast * (np.cos(phase) - np.sin(phase))
    return 0.5 * drift * np.cos(2 * phase) + offset - 0.5 * loss * np.sin(2 * phase)


def wrapped(radians: np.ndarray) -> np.ndarray:
    return np.asarray((radians + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("modulation_hz", [50e6, *to_validate(15e6, 80e6)])
def test_four_taps_one_after_another_of_a_plane_that_comes_closer(plane: Scene, modulation_hz: float) -> None:
    rig = straight_rig(plane, 0.0, Intrinsics.from_fov(1280, 800, 70))
    sensor, speed, period = AmcwToF((modulation_hz,)), -0.2, 0.01
    motion = Motion({"wall": ConstantTwist((0.0, speed, 0.0))})

    def frames(timing: Timing) -> tuple[Signals, np.ndarray]:
        (signals,) = transport_moving(plane, rig, {sensor: timing}, motion, spp=16, max_depth=2).values()
        return signals, signals.frames(sensor)

    signals, one_by_one = frames(Timing(period, single_tap=True))
    _, at_once = frames(Timing(start_s=1.5 * period))  # has the errors of sampling a pixel, which the law leaves out
    np.testing.assert_allclose(signals.truth.z, 1 + speed * 1.5 * period, rtol=1e-5)
    assert signals.motion_m is not None
    np.testing.assert_allclose(signals.motion_m, abs(speed) * 1.5 * period, rtol=1e-3)

    turns_per_m = 2 * modulation_hz / SPEED_OF_LIGHT  # there and back
    phase = 2 * np.pi * turns_per_m * signals.truth.range_m
    cosine = signals.truth.z / signals.truth.range_m
    drift = 2 * np.pi * turns_per_m * speed * period / cosine
    measured = wrapped(2 * np.pi * (tap_phase(one_by_one).normalised - tap_phase(at_once).normalised))
    expected = phase_error(phase, drift, 2 * speed * period / signals.truth.z, sensor.contrast)
    assert np.abs(expected).max() > 1e-3
    assert np.abs(measured - expected).max() < 1e-4


def test_four_taps_at_once_have_no_error(plane: Scene) -> None:
    rig = straight_rig(plane, 0.0, Intrinsics.from_fov(1280, 800, 70))
    sensor, motion = AmcwToF((50e6,)), Motion({"wall": ConstantTwist((0.0, -5.0, 0.0))})
    timing = Timing(start_s=0.05)
    (signals,) = transport_moving(plane, rig, {sensor: timing}, motion, spp=64, max_depth=2).values()
    image = rangesim.decode(rangesim.expose(signals, sensor))
    np.testing.assert_allclose(signals.truth.z, 0.75, rtol=1e-5)
    assert np.abs(image.range_m - signals.truth.range_m).max() < 3e-4
    assert abs(np.mean(image.range_m - signals.truth.range_m)) < 2e-5


def test_fringes_one_after_another_of_a_plane_that_recedes(plane: Scene) -> None:
    """u = c + f (x - b) / z of a straight rig: the code drifts as the plane recedes."""
    baseline, speed, period, size = 0.2, 0.1, 0.01, (256, 160)
    projector = Intrinsics.from_fov(*size, 70)
    rig = straight_rig(plane, baseline, projector)
    sensor = StructuredLight(*size, GrayPhase(32.0))
    motion = Motion({"wall": ConstantTwist((0.0, speed, 0.0))})
    steps = [i for i, name in enumerate(sensor.frame_names()) if "phase" in name]

    def fringes(timing: Timing) -> np.ndarray:
        (signals,) = transport_moving(plane, rig, {sensor: timing}, motion, spp=16, max_depth=2).values()
        return signals.frames(sensor)[steps]

    one_by_one, at_once = fringes(Timing(period)), fringes(Timing(0, start_s=period * float(np.mean(steps))))
    z = 1 + speed * period * np.mean(steps)
    x = rig.camera.normalise(rig.camera.pixel_centres())[..., 0]
    u = projector.cx + projector.fx * (x - baseline / z)
    phase = 2 * np.pi / sensor.code.period_px * u
    drift = 2 * np.pi / sensor.code.period_px * projector.fx * baseline / z**2 * speed * period
    lit = (u > 1) & (u < size[0] - 1)
    measured = wrapped(2 * np.pi * (phase_of(one_by_one).normalised - phase_of(at_once).normalised))[lit]
    expected = phase_error(phase, np.full_like(phase, drift), 2 * speed * period / z, 1.0)[lit]
    assert np.abs(expected).max() > 4e-3
    assert np.corrcoef(measured, expected)[0, 1] > 0.99
    assert np.abs(measured - expected).max() < 1e-3


def edge(card: Scene, timing: Timing) -> np.ndarray:
    """(h,) column of the right edge of the card in each row of the range image."""
    rig, sensor = card.rig(width=64, height=48, baseline_m=0.001), IdealToF()
    motion = Motion({"card": ConstantTwist((1.0, 0.0, 0.0))})
    (signals,) = transport_moving(card, rig, {sensor: timing}, motion, spp=16, max_depth=2).values()
    near = rangesim.decode(rangesim.expose(signals, sensor)).z < 1.0
    columns = np.arange(64) + 1.0
    return np.asarray(np.where(near, columns, 0).max(axis=1))


def test_a_scan_shears_what_moves_sideways_and_a_flash_does_not(card: Scene) -> None:
    """A vertical edge leans by v * line period * f / z pixels per row."""
    line_period = 0.005
    columns = edge(card, Timing(line_period_s=line_period, bands=48))
    f = card.camera.resized(64, 48).fx
    slope, start = np.polyfit(np.arange(48), columns, 1)
    assert slope == pytest.approx(1.0 * line_period * f / 0.8, rel=0.02)
    assert start == pytest.approx(32 + f * -0.1 / 0.8, abs=0.6)
    assert np.abs(columns - start - slope * np.arange(48)).max() < 1.1
    assert np.ptp(edge(card, Timing(start_s=line_period * 24))) == 0


@pytest.mark.validation
def test_a_stack_of_patterns_smears_and_a_burst_of_taps_smears_less(matte: Scene) -> None:
    rig = matte.rig(width=96, height=72)
    motion = Motion({"large_ball": ConstantTwist((0.5, 0.0, 0.0))})

    def failed(sensor: Sensor, timing: Timing) -> float:
        """LegendEntry of the ball's pixels that are lost or off by more than 1 cm."""
        (signals,) = transport_moving(matte, rig, {sensor: timing}, motion, spp=8, max_depth=2).values()
        error = np.abs(rangesim.decode(rangesim.expose(signals, sensor)).z - signals.truth.z)
        return float(np.mean(~(error[signals.truth.instance == 2] < 0.01)))

    stack, one_by_one = failed(StructuredLight(), Timing(0.005)), failed(AmcwToF(), Timing(0.005, single_tap=True))
    burst, still = failed(AmcwToF(), Timing(0.005)), failed(AmcwToF(), Timing(0))
    assert stack > 2 * one_by_one
    assert one_by_one > 2 * burst
    assert burst < 2 * still


def test_an_exposure_in_two_halves_is_their_mean(card: Scene) -> None:
    rig, sensor = card.rig(width=32, height=24), AmcwToF((20e6,))
    motion = Motion({"card": ConstantTwist((2.0, 0.0, 0.0))})

    def frames(timing: Timing) -> np.ndarray:
        return transport_moving(card, rig, {sensor: timing}, motion, spp=4)[sensor].frames(sensor)

    blurred = frames(Timing(start_s=0.1, exposure_s=0.2, exposure_samples=2))
    early, late = frames(Timing(start_s=0.05)), frames(Timing(start_s=0.15))
    np.testing.assert_allclose(blurred, 0.5 * (early + late), rtol=1e-6)
    assert not np.allclose(early, late)


def test_motion_is_told_of_what_moves_and_of_what_it_passes(card: Scene) -> None:
    rig, sensor = card.rig(width=64, height=48), AmcwToF((20e6,))
    motion = Motion({"card": ConstantTwist((1.0, 0.0, 0.0))})
    (signals,) = transport_moving(card, rig, {sensor: Timing(0.04, single_tap=True)}, motion, spp=1).values()
    assert isinstance(signals, MovingSignals)
    assert signals.motion_m is not None
    on_card = signals.truth.instance == 1
    np.testing.assert_allclose(signals.motion_m[on_card], 0.06, rtol=1e-5)
    swept = (signals.motion_m > 0) & ~on_card  # the card is there in the last frame, 0.06 s later
    assert swept[24].sum() == pytest.approx(0.06 * rig.camera.fx / 0.8, abs=1)
    np.testing.assert_allclose(signals.motion_m[swept], 0.06, rtol=1e-5)
    assert (signals.motion_m == 0).sum() > 1000


@pytest.mark.filterwarnings("ignore::rangesim.errors.TruncationWarning")  # cornell at the default depth
def test_ambient_light_is_filtered_frame_by_frame() -> None:
    scene = rangesim.load_scene(SCENES / "cornell.xml")
    rig, sensor = scene.rig(width=32, height=24), AmcwToF((20e6,))
    hardly = Motion({"tall_box": ConstantTwist((1e-9, 0.0, 0.0))})  # at its place, but in four passes
    timing = {sensor: Timing(0.01, single_tap=True)}
    (signals,) = transport_moving(scene, rig, timing, hardly, spp=16).values()
    static = transport(scene, rig, [sensor], spp=16)
    assert isinstance(signals, MovingSignals)
    for transmission in (0.0, 0.4, 1.0):
        off = np.abs(signals.frames(sensor, transmission) - static.frames(sensor, transmission))
        assert np.quantile(off, 0.95) < 1e-5 * static.frames(sensor, transmission).mean()
    with pytest.raises(ValueError, match="the frames of this sensor alone"):
        signals.frames(AmcwToF((30e6,)))


# ---- What is refused --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("timings", "motion", "message"),
    [
        ({IdealToF(): Timing()}, Motion({"large_bal": ConstantTwist()}), "did you mean 'large_ball'"),
        ({}, Motion(), "expected sensors with their timings"),
        ({IdealToF(): 0.1}, Motion(), "expected a Timing for each sensor"),
        ({IdealToF(): Timing()}, {"can": ConstantTwist()}, "expected a Motion"),
    ],
)
def test_what_cannot_be_meant_is_refused(matte: Scene, timings: Mapping, motion: Motion, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        transport_moving(matte, matte.rig(width=8, height=6), timings, motion)


def test_a_motion_without_a_track_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a PoseTrack or a ConstantTwist for 'can'"):
        Motion({"can": np.eye(4)})  # type: ignore[dict-item]


def test_a_scene_that_cannot_be_loaded_again_is_refused(matte: Scene) -> None:
    once = replace(matte, reload=None)
    with pytest.raises(ValueError, match="it is loaded again"):
        transport_moving(
            once,
            matte.rig(width=8, height=6),
            {IdealToF(): Timing(start_s=1.0)},
            Motion({"can": ConstantTwist((1, 0, 0))}),
        )


# ---- Experiments ------------------------------------------------------------------------------------

EXPERIMENT = """
scene = "matte.xml"
width = 96
height = 72
spp = 8
max_depth = 2

[[instrument]]
sensor = "gray-phase"
noise = false
timing.frame_period_s = 0.01

[[instrument]]
sensor = "ideal-tof"
timing.line_period_s = 0.002

[motion.objects.large_ball]
type = "constant-twist"
velocity_m_s = [0.5, 0, 0]

[motion.rig]
type = "poses"
times_s = [0.0]
poses = [[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]
"""


def test_an_experiment_reads_back_equal_with_its_motion() -> None:
    experiment = experiment_from_dict(tomllib.loads(EXPERIMENT))
    assert experiment.motion is not None
    assert experiment.motion.objects["large_ball"] == ConstantTwist((0.5, 0.0, 0.0))
    assert [i.timing for i in experiment.instruments] == [Timing(0.01), Timing(line_period_s=0.002)]
    assert experiment_from_dict(json.loads(json.dumps(experiment_to_dict(experiment)))) == experiment


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        ({"object": {}}, "did you mean 'objects'"),
        ({"objects": {"can": {"velocity_m_s": [1, 0, 0]}}}, r"motion\.objects\.can: expected 'type' to be one of"),
        ({"rig": {"type": "constant-twist", "velocity": [1, 0, 0]}}, r"motion\.rig: unknown key 'velocity'"),
        ({"rig": {"type": "poses", "times_s": [0], "poses": [[[2, 0], [0, 1]]]}}, "as many poses"),
        ([1.0, 0.0], "expected a table"),
    ],
)
def test_a_motion_that_is_none_is_refused(motion: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        experiment_from_dict({"scene": "a.xml", "motion": motion})


def test_in_an_experiment_each_instrument_has_its_own_truth_and_motion_is_a_cause(tmp_path: Path) -> None:
    experiment = experiment_from_dict(tomllib.loads(EXPERIMENT))
    run(replace(experiment, scene=str(SCENES / "matte.xml")), tmp_path / "out")
    result = load_result(tmp_path / "out")
    light, tof = result.measurements
    ball = light.truth.instance_names.index("large_ball")
    middles = [np.nonzero(m.truth.instance == ball)[1].mean() for m in (light, tof)]
    times = [i.timing.reference_s(i.sensor, light.capture.rig.camera) for i in experiment.instruments]
    f_per_depth = light.capture.rig.camera.fx / np.median(light.truth.z[light.truth.instance == ball])
    assert middles[0] - middles[1] == pytest.approx(0.5 * (times[0] - times[1]) * f_per_depth, rel=0.1)
    shares = [(m.causes.cause == Cause.MOTION).mean() for m in result.measurements]
    assert shares[0] > 0.01
