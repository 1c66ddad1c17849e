# SPDX-License-Identifier: Apache-2.0
"""The summary of `rangesim decode` and decoded.json: shares of all statuses, and why little was measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from code_frames import run_of
from synthetic import plane_signals, stereo_rig
from typer.testing import CliRunner

import rangesim
from rangesim import save_capture
from rangesim.calibration.opencv_files import save_opencv
from rangesim.capture import Capture
from rangesim.capture.exposure import expose
from rangesim.cli import app
from rangesim.decoding import decode
from rangesim.decoding.status import Status
from rangesim.electronics.detector import Detector
from rangesim.rig.calibration_files import save_calibration
from rangesim.sensors import StructuredLight

BOTH = ("columns", "rows")


def bare_capture(sensor: StructuredLight, bits: int = 12, exposure_s: float = 4e-4) -> Capture:
    """A plane in front of a small camera, as 16-bit images of `bits`; the detector is forgotten."""
    detector = Detector(bits=bits)
    capture = expose(plane_signals(stereo_rig(), sensor), sensor, detector, exposure_s=exposure_s)
    return replace(capture, frames=capture.frames.astype(np.uint16), detector=None, rig=None)


def decoded(capture: Capture, directory: Path, *options: str) -> tuple[str, dict[str, object]]:
    """The line of `rangesim decode` for the images of a capture, and decoded.json."""
    sensor = capture.sensor
    assert isinstance(sensor, StructuredLight)
    save_capture(capture, directory / "images")
    (directory / "images" / "capture.json").unlink()
    own = ["--projector", f"{sensor.projector_width}x{sensor.projector_height}", "--code", sensor.code.type_name]
    own += ["--axes", ",".join(sensor.axes), "--out", str(directory / "out")]
    answer = CliRunner().invoke(app, ["decode", str(directory / "images"), *own, *options])
    assert answer.exit_code == 0, answer.output
    return answer.output, json.loads((directory / "out" / "decoded.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("calibrated", [False, True])
def test_shares_of_all_statuses_are_those_of_the_map(calibrated: bool, tmp_path: Path) -> None:
    save_calibration(stereo_rig(), tmp_path / "rig.json")
    options = ["--bits", "12", *(["--calibration", str(tmp_path / "rig.json")] if calibrated else [])]
    capture = bare_capture(StructuredLight(axes=BOTH))
    frames = capture.frames.copy()
    frames[:, :30] = 0
    frames[:, 30:40] = 4095
    text, info = decoded(replace(capture, frames=frames), tmp_path, *options)
    with np.load(tmp_path / "out" / "range.npz") as maps:
        counts = np.bincount(maps["status"].ravel(), minlength=len(Status)) / maps["status"].size
    status = info["status"]
    assert isinstance(status, dict)
    assert list(status.values()) == pytest.approx(counts)
    assert status["too little light"] == pytest.approx(30 / 120, abs=0.05)
    assert status["saturated"] >= 10 / 120
    assert f"{100 * counts[0]:.1f} % of the pixels {'measured' if calibrated else 'decoded'}" in text
    assert f"{100 * counts[1]:.1f} % too little light, {100 * counts[2]:.1f} % saturated" in text
    assert info["likely_cause"] is None


@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_black_before_white_is_found(code: str, tmp_path: Path) -> None:
    capture = bare_capture(StructuredLight(code=code))  # type: ignore[arg-type]
    frames = capture.frames.copy()
    frames[[-2, -1]] = frames[[-1, -2]]
    _, right = decoded(capture, tmp_path / "right", "--bits", "12")
    text, info = decoded(replace(capture, frames=frames), tmp_path, "--bits", "12")
    assert "black" in str(info["findings"])
    assert str(info["findings"][0]) in " ".join(text.split())  # type: ignore[index]
    assert info["status"] == right["status"]


@pytest.mark.parametrize("bits", [10, 12])
def test_numbers_that_fill_few_bits_are_the_cause(bits: int, tmp_path: Path) -> None:
    capture = bare_capture(StructuredLight(code="gray"), bits)
    text, info = decoded(capture, tmp_path)
    brightest = int(capture.frames.max())
    assert f"the brightest value is {brightest} of 65535: give --bits {brightest.bit_length()}" in " ".join(
        text.split()
    )
    text, info = decoded(capture, tmp_path / "again", "--bits", str(bits))
    assert info["likely_cause"] is None
    assert info["status"]["measured"] > 0.9  # type: ignore[index]


def test_few_bits_are_named_even_where_fringes_can_be_read(tmp_path: Path) -> None:
    capture = bare_capture(StructuredLight(code="micro-phase-shifting"), 12)
    _, info = decoded(capture, tmp_path)
    assert info["status"]["measured"] > 0.5  # type: ignore[index]
    assert "give --bits 12" in str(info["likely_cause"])


@pytest.mark.parametrize("size", [(1024, 768), (1280, 800)])
def test_rows_shown_first_are_found(size: tuple[int, int], tmp_path: Path) -> None:
    rig = stereo_rig()
    rig = replace(rig, projector=rangesim.Intrinsics.from_fov(*size, 60))
    sensor = StructuredLight(*size, code="gray", axes=BOTH)
    capture = expose(plane_signals(rig, sensor), sensor, Detector(), exposure_s=4e-4)
    capture = replace(capture, detector=None, rig=None)
    _, info = decoded(capture, tmp_path / "right", "--bits", "12")
    assert info["likely_cause"] is None
    columns, rows = run_of(sensor, "columns"), run_of(sensor, "rows")
    frames = np.concatenate([capture.frames[rows], capture.frames[columns], capture.frames[-2:]])
    text, info = decoded(replace(capture, frames=frames), tmp_path / "wrong", "--bits", "12")
    assert "rows" in str(info["findings"])
    assert str(info["findings"][0]) in " ".join(text.split())  # type: ignore[index]
    assert info["doubts"] == []


@pytest.mark.parametrize("suffix", [".yml", ".xml"])
@pytest.mark.parametrize("distance_m", [0.8, 1.5])
def test_millimetres_in_a_file_of_opencvs(suffix: str, distance_m: float, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    rig, sensor = stereo_rig(), StructuredLight()
    pose = rig.T_camera_projector.copy()
    pose[:3, 3] *= 1000
    path = tmp_path / f"millimetres{suffix}"
    save_opencv(replace(rig, T_camera_projector=pose), path)
    signals = plane_signals(rig, sensor, distance_m=distance_m)
    capture = expose(signals, sensor, Detector(), exposure_s=4e-4)
    capture = replace(capture, detector=None, rig=None)
    options = ("--bits", "12", "--calibration", str(path))
    text, info = decoded(capture, tmp_path / "wrong", *options)
    assert "camera and emitter are 200 m apart" in text
    _, info = decoded(capture, tmp_path / "right", *options, "--unit", "0.001")
    assert info["likely_cause"] is None
    with np.load(tmp_path / "right" / "out" / "range.npz") as maps:
        assert np.nanmedian(np.abs(maps["z"] / signals.truth.z - 1)) < 1e-3
        assert np.isfinite(maps["z"]).mean() > 0.5


@pytest.mark.parametrize(
    ("dtype", "level"), [(np.uint8, 235), (np.uint8, 200), (np.uint16, 30_000), (np.uint16, 60000)]
)
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("clipped_share", [0.05, 0.2, 0.5])
def test_levels_that_clip_below_full_scale_are_saturated(
    dtype: type[np.unsignedinteger], level: int, seed: int, clipped_share: float
) -> None:
    """Fringes of an unknown camera; those clipped are refused, those not clipped measured."""
    sensor = StructuredLight()
    capture = expose(plane_signals(stereo_rig(), sensor), sensor, Detector(), exposure_s=3e-4, seed=seed)
    shade = np.linspace(0.3, 1, 160)
    white = np.quantile(capture.frames[-2] * shade, 1 - clipped_share)
    frames = np.rint(np.minimum(capture.frames * shade * level / white, level)).astype(dtype)
    clipped = Capture(frames, sensor)
    is_clipped = (frames[-6:-2] == level).any(axis=0)
    assert is_clipped.mean() > 0.02
    status = decode(clipped).status
    assert (status[is_clipped] == Status.SATURATED).mean() > 0.99
    assert (status[~is_clipped] == Status.OK).mean() > 0.9
    not_clipped = np.rint(capture.frames * shade * level / (capture.frames * shade).max()).astype(dtype)
    assert not (decode(Capture(not_clipped, sensor)).status == Status.SATURATED).any()


@pytest.mark.parametrize("level", [210, 235])
@pytest.mark.parametrize("code", ["gray", "gray-phase"])
def test_patterns_of_one_brightness_are_not_clipped(code: str, level: int) -> None:
    sensor = StructuredLight(320, 200, code=code)  # type: ignore[arg-type]
    image = decode(Capture(np.rint(10 + (level - 10) * sensor.patterns()).astype(np.uint8), sensor))
    assert (image.status == Status.OK).all()


@pytest.mark.parametrize(
    ("axis", "other", "baseline"), [("rows", "columns", [0.2, 0.002, 0]), ("columns", "rows", [0.0, 0.2, 0.003])]
)
def test_an_axis_along_the_baseline_is_named(axis: str, other: str, baseline: list[float], tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = baseline
    rig = stereo_rig(T_camera_projector=pose)
    save_calibration(rig, tmp_path / "rig.json")
    for coded, is_named in ((axis, True), (other, False)):
        sensor = StructuredLight(code="gray", axes=(coded,))  # type: ignore[arg-type]
        capture = expose(plane_signals(rig, sensor), sensor, Detector(bits=8), exposure_s=4e-4)
        bare = replace(capture, frames=capture.frames.astype(np.uint8), detector=None, rig=None)
        text, info = decoded(bare, tmp_path / coded, "--calibration", str(tmp_path / "rig.json"))
        said = f"{axis} tell no depth here, because camera and projector stand apart along them: code {other}"
        assert (said in text) == is_named
        assert info["likely_cause"] == (said if is_named else None)
