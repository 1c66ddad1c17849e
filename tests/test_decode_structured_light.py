# SPDX-License-Identifier: Apache-2.0
"""Encoding and decoding structured light are inverse; noise propagates as theory says."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from synthetic import plane_depth, plane_signals, signals_of_depth, stereo_rig

from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.codes import GrayPhase
from rangesim.decoding import decode
from rangesim.decoding.phase_shift import phase_of
from rangesim.decoding.status import Status
from rangesim.decoding.triangulation import TriangulationLimits
from rangesim.electronics.detector import Detector
from rangesim.errors import RangesimWarning
from rangesim.geometry.camera_projector import triangulate_coordinates
from rangesim.rig import Intrinsics, Rig, translation
from rangesim.sensors import IdealToF, StructuredLight, StructuredLightDecoder

BOTH = ("columns", "rows")


def capture_of_patterns(sensor: StructuredLight, scale: float = 200.0, floor: float = 10.0) -> Capture:
    """What a camera with the projector's own pixels would see: the patterns themselves, as 8 bits."""
    return Capture(np.rint(floor + scale * sensor.patterns()).astype(np.uint8), sensor)


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 300), st.integers(2, 40), st.sampled_from([("columns",), ("rows",), BOTH]))
def test_gray_patterns_decode_to_their_own_coordinates(width: int, height: int, axes: tuple[str, ...]) -> None:
    sensor = StructuredLight(width, height, "gray", axes)  # type: ignore[arg-type]
    image = decode(capture_of_patterns(sensor))
    assert (image.status == Status.OK).all()
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for axis, decoded, truth in (("columns", image.projector_column, x), ("rows", image.projector_row, y)):
        assert (decoded is not None) == (axis in axes)
        if decoded is not None:
            np.testing.assert_array_equal(decoded, truth)


@settings(max_examples=25, deadline=None)
@given(st.integers(20, 300), st.floats(4, 40), st.integers(3, 7))
def test_phase_patterns_decode_to_their_own_coordinates(width: int, period: float, steps: int) -> None:
    sensor = StructuredLight(width, 4, GrayPhase(period, steps), BOTH)
    image = decode(Capture(sensor.patterns(), sensor))
    assert (image.status == Status.OK).all()
    assert image.projector_column is not None
    np.testing.assert_allclose(image.projector_column, np.tile(np.arange(width) + 0.5, (4, 1)), atol=2e-4)


@pytest.mark.parametrize("axes", [("columns",), BOTH])
def test_phase_shift_on_a_plane_is_exact_without_noise(axes: tuple[str, ...]) -> None:
    rig, sensor = stereo_rig(), StructuredLight(axes=axes)  # type: ignore[arg-type]
    signals = plane_signals(rig, sensor, ambient=0.01)
    image = decode(expose(signals, sensor))
    lit = signals.truth.projector_visible
    assert lit.mean() > 0.9
    assert (image.valid == lit).mean() > 0.995
    assert np.nanmedian(np.abs(image.z - signals.truth.z)) < 2e-5
    assert np.nanmax(np.abs(image.z - signals.truth.z)) < 2e-4
    np.testing.assert_allclose(image.range_m[image.valid], signals.truth.range_m[image.valid], atol=2e-4)


def test_gray_code_alone_is_exact_to_half_a_projector_pixel() -> None:
    rig, sensor = stereo_rig(), StructuredLight(code="gray")
    signals = plane_signals(rig, sensor)
    image = decode(expose(signals, sensor))
    assert image.projector_column is not None
    error = image.projector_column - signals.truth.projector_uv[..., 0]
    assert np.nanmax(np.abs(error)) <= 0.5 + 1e-3
    assert abs(np.nanstd(error) - 1 / np.sqrt(12)) < 0.01


def test_a_pixel_across_a_stripe_edge_gets_the_edge() -> None:
    sensor = StructuredLight(64, 2, "gray")
    frames = np.rint(10 + 200 * sensor.patterns()).astype(np.float64)
    blended = np.rint(0.5 * (frames[:, :, :-1] + frames[:, :, 1:])).astype(np.uint8)
    image = decode(Capture(blended, sensor))
    assert image.valid.all()
    np.testing.assert_array_equal(image.projector_column, np.tile(np.arange(1.0, 64.0), (2, 1)))


def test_two_uncertain_bits_are_refused() -> None:
    capture = capture_of_patterns(StructuredLight(64, 2, "gray"))
    frames = capture.frames.copy()
    frames[0:4, 0, 0] = 100
    image = decode(dataclasses.replace(capture, frames=frames))
    assert image.status[0, 0] == Status.LOW_SIGNAL
    assert image.projector_column is not None
    assert np.isnan(image.projector_column[0, 0])
    assert image.valid.sum() == image.valid.size - 1


def test_code_beyond_the_projector_and_contradiction_of_code_and_phase_are_code_errors() -> None:
    sensor = StructuredLight(48, 2, "gray")
    frames = capture_of_patterns(sensor).frames.copy()
    frames[:-2, 0, 0] = np.tile([0, 255], 6)
    frames[0:2, 0, 0] = [255, 0]  # 100000 in Gray code is 63
    assert decode(Capture(frames, sensor)).status[0, 0] == Status.CODE_ERROR

    sensor = StructuredLight(256, 2, GrayPhase(32.0))
    frames = capture_of_patterns(sensor).frames.copy()
    run = slice(len(frames) - 2 - sensor.code.steps, len(frames) - 2)
    frames[run, :, 100] = frames[run, :, 100 + 19]
    status = decode(Capture(frames, sensor)).status
    assert (status[:, 100] == Status.CODE_ERROR).all()
    assert (np.delete(status, 100, axis=1) == Status.OK).all()


def test_dark_and_saturated_pixels_say_so() -> None:
    rig, sensor = stereo_rig(), StructuredLight()
    detector = Detector()
    signals = plane_signals(rig, sensor)
    dark = decode(expose(signals, sensor, detector, exposure_s=1e-6))
    assert (dark.status == Status.LOW_SIGNAL).mean() > 0.99
    bright = decode(expose(signals, sensor, detector, exposure_s=1.0))
    assert (bright.status[signals.truth.projector_visible] == Status.SATURATED).mean() > 0.99
    for image in (dark, bright):
        assert np.isnan(image.z[~image.valid]).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_noise_of_phase_shift_is_that_of_theory(seed: int) -> None:
    """sigma_u = P / (2 pi) sqrt(2 / N) sigma_I / B, with sigma_I from EMVA 1288 at the mean of the fringes."""
    rig, sensor = stereo_rig(), StructuredLight(code=GrayPhase(32.0))
    signals = plane_signals(rig, sensor, ambient=0.02)
    capture = expose(signals, sensor, Detector(), seed=seed)
    image = decode(capture)
    phase = phase_of(capture.frames[-2 - sensor.code.steps : -2])
    noise = capture.noise(phase.mean)
    assert noise is not None
    assert image.projector_column is not None
    sigma = sensor.code.period_px / (2 * np.pi) * np.sqrt(2 / sensor.code.steps) * noise / phase.modulation
    inside = image.valid
    normalised = (image.projector_column - signals.truth.projector_uv[..., 0])[inside] / sigma[inside]
    assert abs(normalised.std() - 1) < 0.1
    assert abs(normalised.mean()) < 0.05


def test_most_pixels_survive_realistic_noise() -> None:
    rig, sensor = stereo_rig(), StructuredLight()
    signals = plane_signals(rig, sensor, ambient=0.1)
    image = decode(expose(signals, sensor, Detector()))
    lit = signals.truth.projector_visible
    assert image.valid[lit].mean() > 0.99
    error = np.abs(image.z - signals.truth.z)[image.valid]
    assert np.median(error) < 5e-4
    assert np.mean(error > 0.01) < 1e-3


@pytest.mark.parametrize("axes", [("columns",), ("rows",), BOTH])
def test_triangulation_undoes_projection_through_distorted_lenses(axes: tuple[str, ...]) -> None:
    rng = np.random.default_rng(3)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(np.eye(3) + 0.05 * rng.standard_normal((3, 3)))[0]
    pose[:3, :3] *= np.sign(np.diag(pose[:3, :3]))
    pose[:3, 3] = 0.2, 0.25, 0.03
    camera = Intrinsics(640, 480, 600, 610, 310, 250, (-0.2, 0.1, 1e-3, -2e-3, 0.01))
    projector = Intrinsics(1024, 768, 1300, 1290, 500, 700, (0.1, -0.05, 2e-3, 1e-3))
    rig = Rig(camera, projector, T_camera_projector=pose)
    rays = camera.directions(camera.pixel_centres()[::40, ::40].reshape(-1, 2))
    z = rng.uniform(0.8, 1.5, len(rays))
    points = rays * z[:, None]
    uv = projector.project((points - pose[:3, 3]) @ pose[:3, :3])
    result = triangulate_coordinates(
        rays, rig, uv[:, 0] if "columns" in axes else None, uv[:, 1] if "rows" in axes else None
    )
    np.testing.assert_allclose(result.z, z, atol=1e-6)
    np.testing.assert_allclose(result.epipolar_px, 0, atol=1e-5)


def decoder_within(**limits: float) -> StructuredLightDecoder:
    return StructuredLightDecoder(triangulation=TriangulationLimits(**limits))


def test_points_behind_and_off_the_epipolar_line_are_refused() -> None:
    rig, sensor = stereo_rig(), StructuredLight(code="gray", axes=BOTH)
    capture = expose(plane_signals(rig, sensor), sensor)
    rolled = dataclasses.replace(capture, frames=np.roll(capture.frames, 30, axis=1))
    lit = rolled.frames[-2] > 0
    with pytest.warns(RangesimWarning, match="of the decoded pixels miss their epipolar line by more than 5"):
        assert (decode(rolled).status[lit] == Status.CODE_ERROR).mean() > 0.9
    assert decode(rolled, decoder_within(epipolar_tolerance_px=1e6)).valid[lit].mean() > 0.9

    single = StructuredLight(code="gray")
    capture = expose(plane_signals(rig, single), single)
    mirrored = dataclasses.replace(capture, frames=capture.frames[:, :, ::-1].copy())
    with pytest.warns(RangesimWarning, match="no image is mirrored"):
        status = decode(mirrored).status
    assert (status == Status.OUT_OF_RANGE).any()


@pytest.mark.parametrize("axis", [0, 1])
def test_relative_error_is_the_derivative_of_depth(axis: int) -> None:
    rig = dataclasses.replace(stereo_rig(), T_camera_projector=stereo_rig().T_camera_projector @ translation(0, 0.1, 0))
    rays = rig.camera.directions(rig.camera.pixel_centres()[::30, ::30].reshape(-1, 2))
    z = np.linspace(0.8, 3, len(rays))
    pose = rig.T_camera_projector
    u = rig.projector.project((rays * z[:, None] - pose[:3, 3]) @ pose[:3, :3])[:, axis]
    at, beside = (triangulate_coordinates(rays, rig, *((c, None) if axis == 0 else (None, c))) for c in (u, u + 1e-4))
    np.testing.assert_allclose(at.relative_error, np.abs(beside.z / at.z - 1) / 1e-4, rtol=1e-3)


@pytest.mark.parametrize("distance_m", [1.0, 3.0])
def test_rows_along_the_baseline_measure_nothing_and_say_so(distance_m: float) -> None:
    rig, sensor = stereo_rig(), StructuredLight(code="gray", axes=("rows",))
    signals = plane_signals(rig, sensor, distance_m=distance_m)
    image = decode(expose(signals, sensor))
    assert image.valid.mean() < 0.02
    assert (image.status == Status.OUT_OF_RANGE).mean() > 0.98
    error = np.abs(image.z / signals.truth.z - 1)[image.valid]
    assert (error < 0.06).all()  # what is left keeps its promise


@pytest.mark.parametrize("axes", [("columns",), BOTH])
def test_depth_ends_where_half_a_projector_pixel_means_five_per_cent(axes: tuple[str, ...]) -> None:
    """Parallel axes: 0.5 z / (f b) = 0.05 at 22.2 m, for f = 1108.5 px and b = 0.2 m."""
    rig, sensor = stereo_rig(T_camera_projector=translation(0.2, 0, 0)), StructuredLight(axes=axes)  # type: ignore[arg-type]
    limit = 0.1 * rig.projector.fx * rig.baseline_m
    z = np.tile(np.concatenate([np.linspace(2, 0.98 * limit, 80), np.linspace(1.02 * limit, 150, 80)]), (120, 1))
    capture = expose(signals_of_depth(rig, z, [sensor]), sensor)
    np.testing.assert_array_equal(decode(capture).status, np.where(z < limit, Status.OK, Status.OUT_OF_RANGE))
    assert decode(capture, decoder_within(max_relative_error=1e9)).valid.all()


def test_wrong_sensor_and_wrong_projector_are_refused() -> None:
    rig, sensor = stereo_rig(), StructuredLight(640, 400)
    with pytest.raises(ValueError, match="projector has the 640 x 400 pixels that the sensor codes"):
        decode(Capture(np.ones((sensor.n_frames, 120, 160), np.float32), sensor, rig))
    with pytest.raises(ValueError, match="structured-light"):
        decode(Capture(np.ones((2, 4, 4), np.float32), IdealToF()), StructuredLightDecoder())


def test_nothing_in_view_is_low_signal_not_a_warning() -> None:
    rig, sensor = stereo_rig(), StructuredLight()
    z = plane_depth(rig)
    z[:60] = np.nan
    image = decode(expose(signals_of_depth(rig, z, [sensor]), sensor))
    assert (image.status[:60] == Status.LOW_SIGNAL).all()
    empty = decode(expose(signals_of_depth(rig, np.full_like(z, np.nan), [sensor]), sensor))
    assert (empty.status == Status.LOW_SIGNAL).all()


@pytest.mark.parametrize("detector", [None, Detector()])
@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_interreflection_alone_is_no_measurement(code: str, detector: Detector | None) -> None:
    """A pixel that sees the patterns blurred over a wide area has contrast, but no code."""
    rig, sensor = stereo_rig(), StructuredLight(code=code)  # type: ignore[arg-type]
    signals = plane_signals(rig, sensor)
    blurred = {r: np.stack([gaussian_filter(c, (0, 40)) for c in channels]) for r, channels in signals.channels.items()}
    image = decode(expose(dataclasses.replace(signals, channels=blurred), sensor, detector))
    assert image.valid.mean() < 0.02
