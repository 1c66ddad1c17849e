# SPDX-License-Identifier: Apache-2.0
"""Correlation decodes any stack of patterns: of all codes, of files; it refuses what is ambiguous and names faults."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flat_captures import all_columns, as_bytes, capture_at, noisy
from synthetic import plane_signals, stereo_rig

from rangesim import decode, expose, load_capture, save_capture
from rangesim.capture import Capture
from rangesim.codes import Code, DeBruijnStripes, GrayCode, GrayPhase, ImageStack, RampCode
from rangesim.decoding.status import Status
from rangesim.electronics.detector import Detector
from rangesim.errors import RangesimWarning
from rangesim.experiment import Experiment, experiment_from_dict, experiment_to_dict
from rangesim.files.image_files import write_grey
from rangesim.sensor import Decoder
from rangesim.sensors import Sensor, StructuredLight, ZnccDecoder
from rangesim.settings.config import from_dict, to_dict

ZNCC = ZnccDecoder()


def tells_all_places(sensor: StructuredLight) -> bool:
    """Whether no two columns look alike, as they do in codes that need the neighbours of a pixel."""
    try:
        ZNCC.check(sensor)
    except ValueError:
        return False
    return True


@pytest.mark.parametrize("width", [100, 333])
@pytest.mark.parametrize("kind", Code.known.values(), ids=Code.known)
def test_it_decodes_the_patterns_of_every_code(kind: type[Code], width: int) -> None:
    sensor = StructuredLight(width, 4, kind())
    if not tells_all_places(sensor):
        pytest.skip("its columns repeat: it needs the neighbours of a pixel, or a shorter projector")
    capture, x = all_columns(sensor)
    image = decode(capture, ZNCC)
    assert (image.status == Status.OK).all()
    assert image.projector_column is not None
    assert np.abs(image.projector_column - x).max() <= 0.5


def test_stripes_that_need_their_neighbours_are_refused() -> None:
    with pytest.raises(ValueError, match=r"pixels \d+ and \d+ that look alike"):
        decode(all_columns(StructuredLight(333, 4, DeBruijnStripes()))[0], ZNCC)


@pytest.mark.parametrize("code", [GrayPhase(), GrayPhase(8.0, 3), ImageStack(), RampCode()], ids=str)
@pytest.mark.parametrize("order", [(), ("columns_*",)], ids=["with white", "without"])
def test_smooth_codes_are_found_between_pixels(code: Code, order: tuple[str, ...]) -> None:
    sensor = StructuredLight(640, 4, code, order=() if isinstance(code, RampCode) else order)
    x = np.arange(1.0, 639.0, 0.137)
    image = decode(capture_at(sensor, x), ZNCC)
    assert image.projector_column is not None
    assert (image.status == Status.OK).mean() > 0.9  # of Gray bits without white, a mixed bit refuses some
    assert np.nanmax(np.abs(image.projector_column - x)) < 0.02


def test_sinusoids_that_are_no_polygons_are_found_to_a_fiftieth_of_a_pixel() -> None:
    """Fringes at their true values between the pixels, which linear interpolation cuts short."""
    sensor = StructuredLight(640, 4, GrayPhase(8.0))
    x = np.arange(20.0, 620.0, 0.137)
    frames = capture_at(sensor, x).frames.copy()
    code = sensor.code
    assert isinstance(code, GrayPhase)
    run = [i for i, name in enumerate(sensor.frame_names()) if "phase" in name]
    frames[run, 0] = [code.convention.pattern(x, 8.0, step, 4) for step in range(4)]
    image = decode(Capture(frames, sensor), ZNCC)
    assert image.projector_column is not None
    assert image.valid.mean() > 0.9
    assert np.nanmax(np.abs(image.projector_column - x)) < 0.02


@pytest.mark.parametrize("code", [GrayPhase(), ImageStack()], ids=str)
def test_errors_are_as_large_as_stated(code: Code) -> None:
    sensor = StructuredLight(320, 4, code)
    x = np.arange(10.25, 310.0, 0.5)
    seen = ZNCC.coordinates(noisy(capture_at(sensor, x, rows=40), 600.0))
    assert seen.column is not None
    assert seen.column_sigma_px is not None
    found = np.isfinite(seen.column)
    assert found.mean() > 0.5
    normalised = ((seen.column - x) / seen.column_sigma_px)[found]
    assert np.std(normalised) == pytest.approx(1.0, abs=0.15)
    assert np.mean(np.abs(normalised) > 6) < 1e-3  # a wrong lobe


@pytest.mark.parametrize("code", [GrayCode(), GrayPhase(), ImageStack()], ids=str)
@pytest.mark.parametrize("white_dn", [20.0, 60.0, 200.0])
def test_what_noise_hides_is_refused(code: Code, white_dn: float) -> None:
    sensor = StructuredLight(320, 4, code)
    capture, x = all_columns(sensor, rows=40)
    seen = ZNCC.coordinates(noisy(capture, white_dn))
    assert seen.column is not None
    wrong = np.abs(seen.column - x) > 4
    assert wrong.mean() < 2e-3


@pytest.mark.parametrize("code", [GrayCode(), GrayPhase(), ImageStack()], ids=str)
def test_pixels_of_two_places_are_refused_unless_one_is_brighter(code: Code) -> None:
    sensor = StructuredLight(320, 4, code)
    capture, x = all_columns(sensor)
    far = np.roll(np.arange(320), 111)
    for fraction in (0.5, 0.9):
        frames = fraction * capture.frames + (1 - fraction) * capture.frames[:, :, far]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RangesimWarning)  # with two halves, nothing fits
            seen = ZNCC.coordinates(replace(capture, frames=frames))
        assert seen.column is not None
        if fraction == 0.9:
            assert (np.abs(seen.column - x) < 3).mean() > 0.9
        else:
            assert np.mean(np.isfinite(seen.column)) < 0.1


def test_noise_without_patterns_is_refused() -> None:
    sensor = StructuredLight(320, 4)
    frames = np.random.default_rng(0).integers(0, 200, (sensor.n_frames, 40, 40)).astype(np.uint8)
    with pytest.warns(RangesimWarning, match="check that these are the patterns that were shown"):
        seen = ZNCC.coordinates(Capture(frames, sensor))
    assert (seen.status == Status.OK).mean() < 0.05


@pytest.mark.parametrize("code", [GrayPhase(), ImageStack()], ids=str)
def test_exchanged_frames_and_a_gamma_are_named(code: Code) -> None:
    sensor = StructuredLight(320, 4, code)
    capture, x = all_columns(sensor)
    frames, names = capture.frames.copy(), sensor.frame_names()
    first, second = names[-4], names[-5]
    i, j = names.index(first), names.index(second)
    frames[[i, j]] = frames[[j, i]]
    with pytest.warns(RangesimWarning, match=f"frames {second} and {first} seem to be exchanged"):
        decode(replace(capture, frames=frames), ZNCC)
    with pytest.warns(RangesimWarning, match=r"a gamma of about 2\.[024]"):
        decode(capture_at(sensor, x, rows=4, gamma=2.2), ZNCC)
    with pytest.warns(RangesimWarning, match=r"a gamma of about 2\.[024]"):
        decode(as_bytes(capture_at(sensor, x, rows=4, gamma=2.2)), ZNCC)


def test_a_gamma_that_the_sensor_states_is_undone() -> None:
    rig, sensor = stereo_rig(), StructuredLight(projector_gamma=2.2)
    signals = plane_signals(rig, sensor)
    image = decode(expose(signals, sensor), ZNCC)
    error = image.projector_column - signals.truth.projector_uv[..., 0]
    assert image.valid.mean() > 0.9
    assert np.nanmax(np.abs(error)) <= 0.5 + 1e-3  # pixels of the projector are uniform


@pytest.mark.parametrize("detector", [None, Detector()], ids=["clean", "noisy"])
def test_sound_captures_of_a_plane_are_silent(detector: Detector | None) -> None:
    sensor = StructuredLight(code=ImageStack())
    signals = plane_signals(stereo_rig(), sensor, ambient=0.01)
    image = decode(expose(signals, sensor, detector))
    error = image.projector_column - signals.truth.projector_uv[..., 0]
    assert image.valid.mean() > 0.9
    assert np.nanmax(np.abs(error)) < (0.51 if detector is None else 3)


def test_an_experiment_may_name_it() -> None:
    table = {"scene": "a.xml", "instrument": [{"name": "a", "sensor": "gray", "decoder": {"type": "zncc"}}]}
    experiment = experiment_from_dict(table)
    assert isinstance(experiment, Experiment)
    assert experiment_from_dict(experiment_to_dict(experiment)) == experiment
    assert experiment.instruments[0].decoder == ZNCC
    assert from_dict(Decoder, to_dict(ZNCC)) == ZNCC  # type: ignore[type-abstract]


# ---- Stacks from files ---------------------------------------------------------------------------------------------


def some_patterns(size: int) -> np.ndarray:
    return ImageStack().patterns(size)[:8]


def test_a_stack_is_read_from_an_array_and_from_images(tmp_path: Path) -> None:
    patterns = np.rint(255 * some_patterns(64)).astype(np.uint8)
    np.save(tmp_path / "a.npy", patterns / np.float32(255))
    (tmp_path / "across").mkdir()
    (tmp_path / "down").mkdir()
    for i, pattern in enumerate(patterns):
        write_grey(tmp_path / f"across/p{i + 3}.png", np.broadcast_to(pattern, (48, 64)))  # p3 ... p10
        write_grey(tmp_path / f"down/p{i + 3}.png", np.broadcast_to(pattern[:, None], (64, 48)))
    for name in ("a.npy", "across", "down"):
        code = ImageStack(str(tmp_path / name))
        np.testing.assert_allclose(code.patterns(64), patterns / 255, atol=1e-6)
        sensor = StructuredLight(64, 48, code)
        capture, x = all_columns(sensor)
        image = decode(capture)
        np.testing.assert_allclose(image.projector_column, np.tile(x, (4, 1)), atol=1e-3)
        assert from_dict(Sensor, to_dict(sensor)) == sensor  # type: ignore[type-abstract]
        assert hash(from_dict(Sensor, to_dict(sensor))) == hash(sensor)  # type: ignore[type-abstract]
        save_capture(as_bytes(capture), tmp_path / f"capture-{name}")
        assert load_capture(tmp_path / f"capture-{name}").sensor == sensor


def test_another_file_in_its_place_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", some_patterns(64))
    code = ImageStack(str(tmp_path / "a.npy"))
    np.save(tmp_path / "a.npy", some_patterns(64)[::-1])
    with pytest.raises(ValueError, match="expected the patterns with the digest"):
        from_dict(Code, to_dict(code))  # type: ignore[type-abstract]


def test_files_that_hold_no_stack_are_refused(tmp_path: Path) -> None:
    def refusal(values: np.ndarray) -> str:
        np.save(tmp_path / "a.npy", values, allow_pickle=True)
        with pytest.raises(ValueError, match=r"a\.npy") as error:
            ImageStack(str(tmp_path / "a.npy"))
        return str(error.value)

    assert "array (n, size)" in refusal(np.zeros(3))
    assert "from 0 to 1" in refusal(np.full((2, 4), 2.0))
    assert "from 0 to 1" in refusal(np.full((2, 4), np.nan))
    assert refusal(np.array([object()]))
    with pytest.raises(ValueError, match="No such file"):
        ImageStack(str(tmp_path / "none"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"expected images \(.*\) in the folder, got 0"):
        ImageStack(str(tmp_path / "empty"))
    write_grey(tmp_path / "empty/a.png", np.arange(12, dtype=np.uint8).reshape(3, 4) * 20)
    with pytest.raises(ValueError, match=r"a\.png, which varies along both"):
        ImageStack(str(tmp_path / "empty"))
    np.save(tmp_path / "b.npy", some_patterns(64))
    with pytest.raises(ValueError, match="expected patterns of 100 pixels, got 64"):
        StructuredLight(100, 48, ImageStack(str(tmp_path / "b.npy")))
    np.save(tmp_path / "c.npy", np.tile(some_patterns(32), (1, 2)))
    with pytest.raises(ValueError, match="pixels 3 and 35 that look alike"):
        StructuredLight(64, 48, ImageStack(str(tmp_path / "c.npy")))


def test_a_stack_is_decoded_with_the_frames_that_were_shown() -> None:
    sensor = StructuredLight(320, 4, ImageStack(), order=("black", "reversed(columns_pattern?)", "white"))
    capture, x = all_columns(sensor)
    image = decode(as_bytes(capture))
    assert image.projector_column is not None
    assert np.nanmax(np.abs(image.projector_column - x)) < 0.05
    assert image.valid.mean() > 0.99
