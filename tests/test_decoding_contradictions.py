# SPDX-License-Identifier: Apache-2.0
"""Captures read as what they are not say so, with the likely cause; sound ones, clean or noisy, are silent."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from code_frames import run_of
from synthetic import plane_signals, signals_of_depth, stereo_rig

from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.cli.decode_summary import summary
from rangesim.codes import GrayPhase
from rangesim.decoding import decode
from rangesim.decoding.status import Status
from rangesim.electronics.detector import Detector
from rangesim.errors import DoubtWarning, RangesimWarning
from rangesim.report.palette import STATUS_NAMES
from rangesim.results.decoded_captures import Decoded, load_decoded, save_decoded
from rangesim.results.range_images import load_range_image, save_range_image
from rangesim.rig import translation
from rangesim.sensors import StructuredLight

SENSORS = [
    StructuredLight(),
    StructuredLight(code=GrayPhase(steps=3)),
    StructuredLight(code=GrayPhase(20.0), axes=("columns", "rows")),
    StructuredLight(code=GrayPhase(37.0, 6)),
]


def fringes(sensor: StructuredLight) -> list[slice]:
    """Where the frames of the fringes stand, per axis."""
    return [run_of(sensor, f"{axis}_phase") for axis in sensor.axes]


def capture_of(sensor: StructuredLight, detector: Detector | None = None, exposure_s: float = 1e-3) -> Capture:
    signals = plane_signals(stereo_rig(), sensor, ambient=0.01)
    return expose(signals, sensor, detector, exposure_s=exposure_s) if detector else expose(signals, sensor)


def with_fringes(capture: Capture, change: str, amount: float = 0.0) -> Capture:
    """The capture with other fringes: `reversed`, or the whole signal `later` by projector pixels."""
    sensor = capture.sensor
    assert isinstance(sensor, StructuredLight)
    frames = capture.frames.copy()
    steps = 2 * np.pi * np.arange(sensor.code.steps) / sensor.code.steps
    for run in fringes(sensor):
        shown = frames[run].astype(np.float64)
        mean = shown.mean(axis=0)
        vector = 2 / sensor.code.steps * np.tensordot(np.exp(1j * steps), shown, axes=1)
        if change == "reversed":
            vector = vector.conj()
        vector = vector * np.exp(-2j * np.pi * amount / sensor.code.period_px)
        frames[run] = [mean + (vector * np.exp(-1j * s)).real for s in steps]
    return replace(capture, frames=frames)


@pytest.mark.parametrize("sensor", SENSORS, ids=str)
@pytest.mark.parametrize("exposure_s", [None, 1e-3, 4e-4, 1e-4, 3e-5])
def test_sound_captures_are_silent(sensor: StructuredLight, exposure_s: float | None) -> None:
    """Warnings are errors in these tests."""
    capture = capture_of(sensor) if exposure_s is None else capture_of(sensor, Detector(), exposure_s)
    decode(capture)


@pytest.mark.parametrize("sensor", SENSORS, ids=str)
def test_fringes_in_the_other_direction_are_named(sensor: StructuredLight) -> None:
    with pytest.warns(RangesimWarning, match="along columns contradict the Gray code.*opposite direction"):
        decode(with_fringes(capture_of(replace(sensor, axes=("columns",))), "reversed"))


@pytest.mark.parametrize("sensor", SENSORS, ids=str)
@pytest.mark.parametrize("quarters", [-1, 1])
def test_a_start_at_sine_is_named_with_its_pixels(sensor: StructuredLight, quarters: int) -> None:
    sensor = replace(sensor, axes=("columns",))
    later = quarters * sensor.code.period_px / 4
    with pytest.warns(RangesimWarning, match="contradict the Gray code") as caught:
        decode(with_fringes(capture_of(sensor), "later", later))
    found = re.search(
        r"start ([0-9.]+) projector pixels too (early|late), .* whether something moved", str(caught[0].message)
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(abs(later), abs=0.25)
    assert found[2] == ("late" if later > 0 else "early")


@pytest.mark.parametrize("later", [-0.5, 0.5])
@pytest.mark.parametrize("steps", [3, 4, 5])
@pytest.mark.parametrize("exposure_s", [None, 4e-4])
def test_a_start_half_a_pixel_off_is_named(later: float, steps: int, exposure_s: float | None) -> None:
    sensor = StructuredLight(code=GrayPhase(steps=steps))
    capture = capture_of(sensor) if exposure_s is None else capture_of(sensor, Detector(), exposure_s)
    with pytest.warns(
        RangesimWarning, match=rf"start 0\.[456] projector pixels too {'late' if later > 0 else 'early'}"
    ):
        decode(with_fringes(capture, "later", later))


@pytest.mark.parametrize("frame", [0, 2])
@pytest.mark.parametrize("steps", [3, 4, 6])
@pytest.mark.parametrize("exposure_s", [None, 4e-4, 1e-4])
def test_a_black_frame_and_a_repeated_one_are_named(frame: int, steps: int, exposure_s: float | None) -> None:
    sensor = StructuredLight(code=GrayPhase(steps=steps))
    capture = capture_of(sensor) if exposure_s is None else capture_of(sensor, Detector(), exposure_s)
    run, (black, repeated) = fringes(sensor)[0], capture.frames[None].repeat(2, axis=0)
    black[run.start + frame] = black[-1]
    repeated[run.start + frame] = repeated[run.start + 1]
    with pytest.warns(RangesimWarning, match=f"frame columns_phase{frame} is black everywhere"):
        decode(replace(capture, frames=black))
    first, second = sorted((frame, 1))
    with pytest.warns(RangesimWarning, match=f"frame columns_phase{second} repeats columns_phase{first}"):
        decode(replace(capture, frames=repeated))


@pytest.mark.parametrize("gamma", [1.5, 2.2])
@pytest.mark.parametrize("steps", [3, 4, 7])
@pytest.mark.parametrize("exposure_s", [None, 4e-4])
def test_a_gamma_is_corrected_without_a_doubt(gamma: float, steps: int, exposure_s: float | None) -> None:
    sensor = StructuredLight(code=GrayPhase(steps=steps))
    capture = capture_of(sensor) if exposure_s is None else capture_of(sensor, Detector(), exposure_s)
    frames, run = capture.frames.copy(), fringes(sensor)[0]
    black = frames[-1].astype(np.float64)
    contrast = frames[-2] - black
    share = np.clip((frames[run] - black) / np.where(contrast > 0, contrast, np.inf), 0, 1)
    frames[run] = (black + contrast * share**gamma).astype(frames.dtype)
    linear, corrected = decode(capture), decode(replace(capture, frames=frames))
    assert linear.projector_column is not None
    assert corrected.projector_column is not None
    both = linear.valid & corrected.valid
    assert both.mean() > 0.98 * linear.valid.mean()
    off = (corrected.projector_column - linear.projector_column)[both]
    noise = 0.0 if exposure_s is None else 0.12  # the gamma changes it
    assert float(np.sqrt(np.mean(off**2))) < 0.05 + noise


def as_plain_binary(capture: Capture) -> Capture:
    """The capture with its Gray bits replaced by plain binary: each bit the exclusive or of those above."""
    sensor = capture.sensor
    assert isinstance(sensor, StructuredLight)
    frames = capture.frames.copy()
    for axis in sensor.axes:
        run = run_of(sensor, f"{axis}_bit")
        pairs = frames[run].reshape(-1, 2, *frames.shape[1:])
        shown = np.logical_xor.accumulate(pairs[:, 0] > pairs[:, 1], axis=0)
        pairs[:, 0], pairs[:, 1] = (np.where(s, pairs.max(axis=1), pairs.min(axis=1)) for s in (shown, ~shown))
        frames[run] = pairs.reshape(-1, *frames.shape[1:])
    return replace(capture, frames=frames)


@pytest.mark.parametrize("exposure_s", [None, 4e-4, 1e-4])
@pytest.mark.parametrize("axes", [("columns",), ("rows",)])
@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_plain_binary_is_named(code: str, axes: tuple[str, ...], exposure_s: float | None) -> None:
    sensor = StructuredLight(code=code, axes=axes)  # type: ignore[arg-type]
    capture = capture_of(sensor) if exposure_s is None else capture_of(sensor, Detector(), exposure_s)
    decode(capture)
    with pytest.warns(RangesimWarning) as caught:
        decode(as_plain_binary(capture))
    assert len(caught) == 1
    found = re.search(
        rf"bits along {axes[0]} .* lie ([0-9.]+) cells apart as Gray code, and ([0-9.]+) as plain binary numbers",
        str(caught[0].message),
    )
    assert found is not None
    cells_per_pixel = 1280 * 45 / 60 / 160 / (1 if code == "gray" else 8)
    as_gray, as_binary = float(found[1]), float(found[2])
    assert as_binary == pytest.approx(max(1, cells_per_pixel), rel=0.5)
    assert as_gray > 1.25 * as_binary


@pytest.mark.parametrize("axes", [("columns",), ("rows",), ("columns", "rows")])
def test_gray_code_of_any_fineness_is_silent(axes: tuple[str, ...]) -> None:
    for width in (16, 100, 320):
        for distance_m in (0.5, 1.0, 2.5):
            sensor = StructuredLight(code="gray", axes=axes)  # type: ignore[arg-type]
            decode(expose(plane_signals(stereo_rig(width, width), sensor, distance_m=distance_m), sensor))


def doubt(capture: Capture) -> str:
    """The only sentence with which `decode` warns; the range image keeps it."""
    with pytest.warns(RangesimWarning) as caught:
        image = decode(capture)
    assert [str(w.message) for w in caught] == list(image.doubts)
    assert len(image.doubts) == 1
    return image.doubts[0]


@pytest.mark.parametrize("distance_m", [0.6, 1.0, 3.0])
@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_mirrored_and_turned_images_are_told_by_one_axis_and_the_calibration(code: str, distance_m: float) -> None:
    for axis in ("columns", "rows"):
        sensor = StructuredLight(code=code, axes=(axis,))  # type: ignore[arg-type]
        # A square image of a camera with its own optical centre, so that it may be turned.
        capture = expose(plane_signals(stereo_rig(120, 120), sensor, distance_m=distance_m), sensor)
        decode(capture)
        flips = {"columns": np.s_[:, :, ::-1], "rows": np.s_[:, ::-1]}
        mirrored = doubt(replace(capture, frames=capture.frames[flips[axis]].copy()))
        assert f"{axis} grow in another direction of the image than the calibration predicts" in mirrored
        assert "no image is mirrored or turned by 180 degrees" in mirrored
        assert "turned by 180" in doubt(replace(capture, frames=capture.frames[:, ::-1, ::-1].copy()))
        turned = doubt(replace(capture, frames=np.rot90(capture.frames, axes=(1, 2)).copy()))
        assert f"no image is turned by 90 degrees, and that {axis} were shown" in turned


@pytest.mark.parametrize("calibrated", [False, True])
@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_a_mirrored_camera_is_told_by_both_axes_alone(code: str, calibrated: bool) -> None:
    sensor = StructuredLight(code=code, axes=("columns", "rows"))  # type: ignore[arg-type]
    capture = expose(plane_signals(stereo_rig(), sensor), sensor)
    capture = capture if calibrated else replace(capture, rig=None)
    decode(capture)
    for flip in (np.s_[:, :, ::-1], np.s_[:, ::-1]):
        assert "images seem to be mirrored" in doubt(replace(capture, frames=capture.frames[flip].copy()))


def test_turned_images_are_told_by_both_axes_and_the_calibration() -> None:
    sensor = StructuredLight(axes=("columns", "rows"))
    capture = expose(plane_signals(stereo_rig(120, 120), sensor), sensor)
    turned = replace(capture, frames=np.rot90(capture.frames, axes=(1, 2)).copy())
    assert "turned by 90 degrees" in doubt(turned)
    assert not decode(replace(turned, rig=None)).doubts  # without a calibration, a turned camera is as good as another


@pytest.mark.parametrize(("axes", "turned_in"), [("columns", False), ("columns,rows", False), ("columns,rows", True)])
def test_an_inverted_calibration_is_named(axes: str, turned_in: bool) -> None:
    """Columns alone of devices that are turned to each other cannot tell: they give another depth everywhere."""
    rig = stereo_rig() if turned_in else stereo_rig(T_camera_projector=translation(0.2, 0, 0))
    sensor = StructuredLight(axes=tuple(axes.split(",")))  # type: ignore[arg-type]
    capture = expose(plane_signals(rig, sensor, distance_m=1.5), sensor)
    inverted = replace(rig, T_camera_projector=np.linalg.inv(rig.T_camera_projector))
    text = doubt(replace(capture, rig=inverted))
    assert "its inverse: the calibration's pose seems to be inverted" in text


def test_noise_on_what_is_far_away_is_silent() -> None:
    """At 500 m rays are parallel within 0.5 pixels, and half of them meet behind."""
    rig, sensor = stereo_rig(T_camera_projector=translation(0.2, 0, 0)), StructuredLight(code="gray")
    image = decode(expose(signals_of_depth(rig, np.full((120, 160), 500.0), [sensor]), sensor))
    assert not image.valid.any()


@pytest.mark.parametrize(("period_px", "block"), [(16.0, 19), (16.0, 21), (24.0, 29)])
@pytest.mark.parametrize("steps", [3, 4])
def test_fringes_finer_than_the_pixels_of_the_camera_are_named_with_what_is_left(
    period_px: float, block: int, steps: int
) -> None:
    """A pixel as wide as `block` projector pixels leaves |sin x / x|, x = pi block / period, of the fringes."""
    sensor = StructuredLight(block * 60, 400, GrayPhase(period_px, steps))
    seen = sensor.patterns().reshape(sensor.n_frames, 400, 60, block).mean(axis=-1)
    noise = np.random.default_rng(1).normal(size=seen.shape)
    with pytest.warns(RangesimWarning, match="too fine for the camera, or out of focus") as caught:
        decode(Capture(np.rint(20 + 200 * seen + noise).astype(np.uint8), sensor))
    found = re.search(r"reach (\d+) % of white - black: a period of (\d+)", str(caught[0].message))
    assert found is not None
    assert int(found[1]) == pytest.approx(100 * abs(np.sinc(block / period_px)), abs=2)
    assert int(found[2]) == period_px


@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_codes_beyond_the_projector_are_told(code: str) -> None:
    shown = StructuredLight(640, 48, code=code)  # type: ignore[arg-type]
    frames = np.rint(20 + 200 * shown.patterns()).astype(np.uint8)
    text = doubt(Capture(frames, replace(shown, projector_width=600)))
    assert re.search(r"[67] % of the codes along columns lie beyond the projector's 600 pixels", text)


def test_doubts_are_kept_in_files(tmp_path: Path) -> None:
    capture = expose(plane_signals(stereo_rig(), sensor := StructuredLight(axes=("columns", "rows"))), sensor)
    mirrored = replace(capture, frames=capture.frames[:, :, ::-1].copy(), rig=None)
    with pytest.warns(DoubtWarning):
        image = decode(mirrored)
    save_range_image(image, tmp_path / "range.npz")
    assert load_range_image(tmp_path / "range.npz").doubts == image.doubts
    save_decoded(Decoded(image, sensor, None, {}, None), tmp_path / "out", {})
    assert load_decoded(tmp_path / "out").image.doubts == image.doubts
    record = json.loads((tmp_path / "out" / "decoded.json").read_text(encoding="utf-8"))
    assert record["doubts"] == list(image.doubts)


def test_notes_are_kept_in_files(tmp_path: Path) -> None:
    sensor = StructuredLight(projector_gamma=2.2)
    image = decode(expose(plane_signals(stereo_rig(), sensor), sensor))
    assert image.notes == (
        "the fringes along columns were corrected for a gamma of 2.2 of projector and camera together.",
    )
    save_range_image(image, tmp_path / "range.npz")
    assert load_range_image(tmp_path / "range.npz").notes == image.notes
    decoded = Decoded(image, sensor, None, {STATUS_NAMES[Status.OK]: 1.0}, None)
    save_decoded(decoded, tmp_path / "out", {})
    assert load_decoded(tmp_path / "out").image.notes == image.notes
    assert json.loads((tmp_path / "out" / "decoded.json").read_text(encoding="utf-8"))["notes"] == list(image.notes)
    assert summary(decoded, tmp_path).count(image.notes[0].removesuffix(".")) == 1


def test_fringes_that_mirror_every_place_within_its_cell_are_named() -> None:
    """Cells of half a period: with the first and the third fringe exchanged, each place still lies in its cell."""
    sensor = StructuredLight()
    capture = capture_of(sensor, Detector(), 2e-4)
    frames, (run,) = capture.frames.copy(), fringes(sensor)
    frames[[run.start, run.start + 2]] = frames[[run.start + 2, run.start]]
    with pytest.warns(RangesimWarning, match="every place is mirrored within its cell"):
        decode(replace(capture, frames=frames))
