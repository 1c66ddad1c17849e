# SPDX-License-Identifier: Apache-2.0
"""Time of flight: the closed form of wiggling, and cameras whose waveforms and pixels are off calibrated on targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import signals_of_depth

import rangesim
from rangesim import AmcwToF, Intrinsics, Rig, save_capture
from rangesim.calibration import (
    Checkerboard,
    board_range,
    calibrate_tof,
    find_board_ranges,
    load_tof_calibration,
    plane_range,
    triangle_harmonics,
    wiggling,
)
from rangesim.decoding.phase_shift import tap_phase
from rangesim.decoding.status import Status
from rangesim.errors import FileFormatError
from rangesim.rig import Spinning

PHASE = np.linspace(0, 1, 1001)
CAMERA = Intrinsics.from_fov(64, 48, 60.0)
SQUARE = AmcwToF((20e6, 80e6, 100e6), waveform="square")
SINE = AmcwToF((20e6, 80e6, 100e6))
DISTANCES = np.linspace(0.5, 3.2, 20)
DELAY = 0.1 + np.random.default_rng(0).normal(0, 0.02, (48, 64))


def rig(camera=CAMERA):
    lamp = np.eye(4)
    lamp[:3, 3] = (0.03, 0.0, 0.0)
    return Rig(camera, Intrinsics.from_fov(64, 48, 80.0), T_camera_projector=lamp)


def walls(sensor, distances=DISTANCES, delay=DELAY, seed=0, camera=CAMERA, detector=True):
    captures, true = [], []
    for k, z in enumerate(distances):
        signals = signals_of_depth(rig(camera), np.full((48, 64), z), [sensor], delay_m=delay)
        captures.append(rangesim.expose(signals, sensor, sensor.default_detector if detector else None, seed=seed + k))
        true.append(signals.truth.range_m.astype(np.float64))
    return captures, true


@pytest.fixture(scope="module")
def calibration():
    return calibrate_tof(*walls(SQUARE))


# ------------------------------------------------------------------------------------------- the law


def triangle(phase):
    return 4 * np.abs(phase - np.floor(phase) - 0.5) - 1


def test_the_closed_form_is_what_four_taps_of_square_waves_measure():
    taps = np.stack([triangle(PHASE - k / 4) for k in range(4)])[:, None]
    measured = tap_phase(taps).normalised[0]
    error = (measured - PHASE + 0.5) % 1 - 0.5
    assert np.abs(wiggling(PHASE, triangle_harmonics(401)) - error).max() < 1e-6
    assert 0.0110 < np.abs(error).max() < 0.0114


@pytest.mark.parametrize("taps", [3, 4, 5, 8])
def test_the_closed_form_is_what_any_number_of_taps_measures(taps):
    """Of an arbitrary even waveform, against the discrete Fourier transform of the taps."""
    a = np.array([1.0, 0.2, -0.15, 0.1, 0.08, -0.05, 0.04, 0.03, 0.02])
    theta = 2 * np.pi * np.arange(taps) / taps
    phi = 2 * np.pi * PHASE
    frames = sum(a[k - 1] * np.cos(k * (phi[None] - theta[:, None])) for k in range(1, 10))
    measured = np.angle((frames * np.exp(1j * theta[:, None])).sum(axis=0))
    expected = np.angle(np.exp(1j * (measured - phi))) / (2 * np.pi)
    assert np.allclose(wiggling(PHASE, a, taps), expected, atol=1e-12)


def test_wiggling_has_as_many_periods_as_there_are_taps_and_none_for_sines():
    w = wiggling(PHASE, triangle_harmonics(51), 4)
    assert np.allclose(w, wiggling(PHASE + 0.25, triangle_harmonics(51), 4), atol=1e-12)
    assert (wiggling(PHASE, [1.0]) == 0).all()
    small = wiggling(PHASE, [1.0, 0, 1e-3, 0, 4e-4])
    assert np.allclose(small, (4e-4 - 1e-3) * np.sin(8 * np.pi * PHASE) / (2 * np.pi), atol=1e-6)


@pytest.mark.parametrize("arguments", [([],), ([0.0, 1.0],), ([1.0, np.nan],), ([1.0], 2)])
def test_waveforms_that_have_no_phase(arguments):
    with pytest.raises(ValueError, match=r"a_1|finite|3 taps"):
        wiggling(PHASE, *arguments)


# ------------------------------------------------------------------------------------------- calibration


def test_what_is_left_is_the_noise_as_the_exact_inverse_leaves_it(calibration):
    """On walls that were not among the targets. The decoder that knows the waveform, and the true delays, do no
    better but for the noise of 20 targets in each pixel's offset."""
    captures, true = walls(SQUARE, np.linspace(0.6, 3.1, 6), seed=100)
    slant = np.linalg.norm(CAMERA.directions(CAMERA.pixel_centres()), axis=-1)
    raw, left, exact = [], [], []
    for capture, truth in zip(captures, true, strict=True):
        image = calibration.decoder.decode(capture)
        corrected = calibration.correct(image)
        assert corrected.valid.all()
        assert np.allclose(corrected.z, corrected.range_m / slant)
        raw.append(image.range_m - truth)
        left.append(corrected.range_m - truth)
        exact.append(rangesim.decode(capture).range_m - truth - DELAY / 2)
    assert np.std(raw) > 10 * np.std(left)
    assert abs(np.mean(raw)) > 0.04
    assert np.std(left) < 1.1 * np.std(exact)
    assert np.std(calibration.offset_m - DELAY) < 1.3 * calibration.noise_m / np.sqrt(len(DISTANCES))


@pytest.mark.validation
def test_no_range_is_off_as_a_whole(calibration):
    """What orders beyond the series' leave is 0.1 mm, also without noise; the noise of one set of targets, 20 for 24
    coefficients, moves all pixels at a range by 0.07 mm, hence the mean of four calibrations."""
    captures, true = walls(SQUARE, np.linspace(0.6, 3.1, 6), seed=100)

    def off(found):
        images = [found.correct(found.decoder.decode(capture)) for capture in captures]
        return [np.mean(image.range_m - range_m) for image, range_m in zip(images, true, strict=True)]

    noisy = [off(calibration), *(off(calibrate_tof(*walls(SQUARE, seed=seed))) for seed in (200, 300, 400))]
    assert np.abs(off(calibrate_tof(*walls(SQUARE, detector=False)))).max() < 1.5e-4
    assert np.abs(np.mean(noisy, axis=0)).max() < 2e-4
    assert np.abs(noisy).max() < 4e-4


def test_a_camera_of_sines_is_left_as_it_is_but_for_its_delays():
    found = calibrate_tof(*walls(SINE))
    lengths = np.linspace(found.shortest_m, found.longest_m, 500)
    wiggle = found.wiggling_m(lengths)
    assert np.std(wiggle) < 0.1 * found.noise_m
    assert np.std(found.offset_m - DELAY) < 1.3 * found.noise_m / np.sqrt(len(DISTANCES))


def test_without_noise_the_series_is_the_closed_form():
    """Of one frequency, as a function of the phase that is read."""
    sensor = AmcwToF((20e6,), waveform="square")
    found = calibrate_tof(*walls(sensor, np.linspace(0.5, 4.5, 60), 0.0, detector=False))
    phase = np.linspace(0.1, 0.5, 50)
    error = wiggling(phase, triangle_harmonics(401))
    length = (phase + error) * rangesim.response.SPEED_OF_LIGHT / 20e6
    off = found.wiggling_m(length) + np.nanmean(found.offset_m) - error * rangesim.response.SPEED_OF_LIGHT / 20e6
    assert np.abs(off).max() < 0.04 * np.abs(error).max() * rangesim.response.SPEED_OF_LIGHT / 20e6


def test_outliers_do_not_count(calibration):
    captures, true = walls(SQUARE)
    true = [t.copy() for t in true]
    for k in range(0, 20, 3):
        true[k][:8, :8] += 0.3  # something else stood there
    found = calibrate_tof(captures, true)
    lengths = np.linspace(found.shortest_m, found.longest_m, 500)
    assert np.abs(np.diff(found.wiggling_m(lengths) - calibration.wiggling_m(lengths))).max() < 1e-4
    assert np.abs(found.offset_m - calibration.offset_m).max() < 10 * found.noise_m


def test_targets_that_leave_it_open_are_refused():
    with pytest.raises(ValueError, match="leave it open"):
        calibrate_tof(*walls(SQUARE, [1.0, 1.5, 2.0]))
    with pytest.raises(ValueError, match="leave it open"):
        calibrate_tof(*walls(SQUARE, np.linspace(1.0, 1.005, 20)))


def test_what_was_not_seen_is_refused_and_not_guessed():
    captures, true = walls(SQUARE)
    true = [t.copy() for t in true]
    for t in true:
        t[:, :5] = np.nan
    found = calibrate_tof(captures, true)
    assert np.isnan(found.offset_m[:, :5]).all()
    image = found.correct(found.decoder.decode(captures[3]))
    assert (image.status[:, :5] == Status.OUT_OF_RANGE).all()
    assert np.isnan(image.range_m[:, :5]).all()
    assert image.valid[:, 5:].all()
    assert image.is_consistent
    far, _ = walls(SQUARE, [4.0])
    assert (found.correct(found.decoder.decode(far[0])).status == Status.OUT_OF_RANGE).all()


def test_images_of_another_camera_or_decoder_are_refused(calibration):
    captures, _ = walls(SQUARE, [1.0])
    with pytest.raises(ValueError, match="calibrated decoder"):
        calibration.correct(rangesim.decode(captures[0]))
    other = replace(CAMERA, fx=CAMERA.fx + 1)
    captures, _ = walls(SQUARE, [1.0], camera=other)
    with pytest.raises(ValueError, match="of another"):
        calibration.correct(calibration.decoder.decode(captures[0]))


def test_captures_that_do_not_do_are_named():
    captures, true = walls(SQUARE, [1.0, 1.5, 2.0])
    with pytest.raises(ValueError, match="two or more targets"):
        calibrate_tof(captures[:1], true[:1])
    with pytest.raises(ValueError, match="capture 2: expected a rig"):
        calibrate_tof([*captures[:2], replace(captures[2], rig=None)], true)
    with pytest.raises(ValueError, match="capture 1: expected the sensor and the rig"):
        calibrate_tof([captures[0], *walls(SINE, [1.5])[0], captures[2]], true)
    with pytest.raises(ValueError, match="capture 0: expected true ranges"):
        calibrate_tof(captures, [true[0][:-1], *true[1:]])
    with pytest.raises(ValueError, match="capture 1: expected true ranges in positive metres"):
        calibrate_tof(captures, [true[0], -true[1], true[2]])
    with pytest.raises(ValueError, match="capture 1: expected readings on the target"):
        calibrate_tof(captures, [true[0], true[1] * np.nan, true[2]])
    with pytest.raises(ValueError, match=r"capture 1: .* unambiguous"):
        calibrate_tof(captures, [true[0], true[1] + 5.0, true[2]])
    with pytest.raises(ValueError, match="orders"):
        calibrate_tof(captures, true, orders=(4, 4))


# ------------------------------------------------------------------------------------------- targets and files


def test_a_board_is_as_far_as_its_plane_and_has_an_end():
    board = Checkerboard(6, 5, 0.1)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", (20, -10, 5), degrees=True).as_matrix()
    T[:3, 3] = (-0.2, -0.2, 1.5)
    distance = board_range(board, CAMERA, T)
    seen = np.isfinite(distance)
    assert 0.1 < seen.mean() < 0.9
    assert np.allclose(distance[seen], plane_range(CAMERA, T)[seen])
    rays = CAMERA.directions(CAMERA.pixel_centres())
    X = (rays / np.linalg.norm(rays, axis=-1, keepdims=True) * distance[..., None])[seen]
    on_board = (X - T[:3, 3]) @ T[:3, :3]
    assert np.abs(on_board[:, 2]).max() < 1e-9
    assert (np.abs(on_board[:, :2] - [0.25, 0.2]) <= [0.45, 0.4]).all()
    T[2, 3] = -1.5
    assert np.isnan(plane_range(CAMERA, T)).all()
    with pytest.raises(ValueError, match="expected a pinhole camera"):
        board_range(board, Spinning((0.0,), columns=90), T)  # type: ignore[arg-type]


def test_it_is_read_back_equal(calibration, tmp_path):
    calibration.save(tmp_path / "tof.npz")
    back = load_tof_calibration(tmp_path / "tof.npz")
    for name in ("rig", "sensor", "decoder", "orders", "shortest_m", "longest_m", "noise_m"):
        assert getattr(back, name) == getattr(calibration, name)
    for name in ("cosines_m", "sines_m", "offset_m"):
        assert np.array_equal(getattr(back, name), getattr(calibration, name))


def test_files_that_are_none_are_refused(calibration, tmp_path):
    with pytest.raises(FileFormatError, match="missing"):
        load_tof_calibration(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(FileFormatError, match="as well"):
        load_tof_calibration(tmp_path / "other.npz")
    calibration.save(tmp_path / "tof.npz")
    arrays = dict(np.load(tmp_path / "tof.npz"))
    np.savez(tmp_path / "cut.npz", **(arrays | {"offset_m": arrays["offset_m"][1:]}))
    with pytest.raises(FileFormatError, match="offset_m of shape"):
        load_tof_calibration(tmp_path / "cut.npz")
    text = arrays["settings"].tobytes().replace(b'"orders": [4', b'"orders": [0')
    np.savez(tmp_path / "orders.npz", **(arrays | {"settings": np.frombuffer(text, np.uint8)}))
    with pytest.raises(FileFormatError, match="orders"):
        load_tof_calibration(tmp_path / "orders.npz")


def test_the_commands_calibrate_on_rendered_boards_and_decode_with_it(tmp_path, capsys):
    from rangesim.cli import app
    from rangesim.results.range_images import load_range_image

    board, sensor = Checkerboard(5, 4, 0.16), AmcwToF((60e6,), waveform="square")
    camera = Intrinsics.from_fov(96, 72, 45.0)
    random = np.random.default_rng(1)
    true = []
    for k, z in enumerate(np.linspace(1.2, 1.95, 10)):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", random.uniform(-6, 6, 3), degrees=True).as_matrix()
        T[:3, 3] = [0, 0, z] - T[:3, :3] @ board.points.mean(axis=0)
        scene = rangesim.load_scene(board.scene(T, 96, 72))
        signals = rangesim.transport(scene, rig(camera), [sensor], spp=16, seed=k)
        save_capture(rangesim.expose(signals, sensor, sensor.default_detector, seed=k), tmp_path / f"board_{k}")
        true.append(signals.truth.range_m)
    folders = [str(tmp_path / f"board_{k}") for k in range(10)]
    found = find_board_ranges(board, [rangesim.load_capture(folder) for folder in folders])
    off = np.concatenate([(a - b)[np.isfinite(a)] for a, b in zip(found, true, strict=True)])
    assert np.sqrt(np.nanmean(off**2)) < 4e-3
    options = ["--points", "5x4", "--spacing", "0.16", "--out"]
    with pytest.raises(ValueError, match=r"end in .npz for captures by time of flight"):
        app(["calibrate", *folders, *options, str(tmp_path / "rig.json")], standalone_mode=False)
    app(["calibrate", *folders, *options, str(tmp_path / "tof.npz")], standalone_mode=False)
    assert "wiggling" in capsys.readouterr().out
    errors = []
    for name, more in (("raw", []), ("calibrated", ["--calibration", str(tmp_path / "tof.npz")])):
        app(["decode", folders[4], "--out", str(tmp_path / name), *more], standalone_mode=False)
        image = load_range_image(tmp_path / name / "range.npz")
        errors.append(np.nanmedian(np.abs(image.range_m - true[4])))
    assert errors[1] < 6e-3
    save_capture(walls(SINE, [1.0])[0][0], tmp_path / "sine")
    arguments = ["decode", str(tmp_path / "sine"), "--out", str(tmp_path / "no"), "--calibration"]
    with pytest.raises(ValueError, match="capture of the sensor that"):
        app([*arguments, str(tmp_path / "tof.npz")], standalone_mode=False)
    assert not (tmp_path / "no").exists()
