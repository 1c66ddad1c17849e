# SPDX-License-Identifier: Apache-2.0
"""Calibrations of OpenCV by any usual names, in XML, YAML and JSON: one rig; and what is no calibration is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import stereo_rig
from typer.testing import CliRunner

from rangesim import Intrinsics, Rig, StructuredLight
from rangesim.cli import app
from rangesim.errors import FileFormatError
from rangesim.files.storage_files import read_storage
from rangesim.rig.calibration_files import (
    load_calibration,
    principal_point_doubts,
    read_calibration,
    save_calibration,
)

CAMERA, PROJECTOR = (64, 48), (128, 80)
RIG = stereo_rig(
    camera=Intrinsics(*CAMERA, 70.0, 71.0, 31.5, 24.25, (-0.1, 0.02, 1e-3, -2e-3, 0.01)),
    projector=Intrinsics(*PROJECTOR, 140.0, 141.0, 60.5, 70.0, (0.05, 0.0, 0.0, 0.0, 0.0)),
)
T_PROJECTOR_CAMERA = np.linalg.inv(RIG.T_camera_projector)
R, T = T_PROJECTOR_CAMERA[:3, :3], T_PROJECTOR_CAMERA[:3, 3]


def matrix(device: Intrinsics) -> list[list[float]]:
    """K in OpenCV's convention."""
    return [[device.fx, 0, device.cx - 0.5], [0, device.fy, device.cy - 0.5], [0, 0, 1]]


K1, K2 = matrix(RIG.pinhole), matrix(RIG.image_projector)
D1, D2 = list(RIG.pinhole.distortion), list(RIG.image_projector.distortion)


def as_json(path: Path, entries: dict[str, Any]) -> Path:
    path = path.with_suffix(".json")
    path.write_text(json.dumps(entries, default=lambda array: array.tolist()))
    return path


def as_opencv(suffix: str) -> Callable[[Path, dict[str, Any]], Path]:
    def write(path: Path, entries: dict[str, Any]) -> Path:
        import cv2

        path = path.with_suffix(suffix)
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, value in entries.items():
            storage.write(name, value if isinstance(value, (int, str)) else np.array(value, dtype=np.float64))
        storage.release()
        return path

    return write


def as_plain_yaml(path: Path, entries: dict[str, Any]) -> Path:
    """As PyYAML writes nested lists."""
    lines = []
    for name, value in entries.items():
        rows = np.asarray(value, dtype=float).tolist()
        lines.append(f"{name}:" if isinstance(rows, list) else f"{name}: {rows:g}")
        for row in rows if isinstance(rows, list) else ():
            cells = row if isinstance(row, list) else [row]
            lines += [f"{'- - ' if i == 0 and isinstance(row, list) else '  - '}{v!r}" for i, v in enumerate(cells)]
            if not isinstance(row, list):
                lines[-1] = f"- {row!r}"
    path = path.with_suffix(".yaml")
    path.write_text("\n".join(lines))
    return path


NAMES = [
    ("K1", "D1", "K2", "D2", "R", "T"),
    ("M1", "D1", "M2", "D2", "R", "T"),
    ("Kc", "kc", "Kp", "kp", "Rp", "Tp"),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "R", "T"),
    ("cameraMatrix", "distCoeffs", "projectorMatrix", "projectorDistCoeffs", "R", "T"),
    ("camera_matrix", "camera_distortion", "projector_matrix", "projector_distortion", "R", "T"),
    ("cam_int", "cam_dist", "proj_int", "proj_dist", "rotation", "translation"),
    ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T"),
    ("cam_K", "cam_D", "proj_K", "proj_D", "R", "t"),
    ("camK", "camDist", "projK", "projDist", "rvec", "tvec"),
    ("K_cam", "dist_cam", "K_proj", "dist_proj", "R", "T"),
    ("mtx1", "dist1", "mtx2", "dist2", "R", "T"),
]


@pytest.mark.parametrize("names", NAMES, ids=lambda names: names[0])
@pytest.mark.parametrize("write", [as_json, as_opencv(".xml"), as_opencv(".yml"), as_plain_yaml])
def test_one_rig_by_any_usual_name(tmp_path: Path, names: tuple[str, ...], write: Any) -> None:
    entries = dict(zip(names, (K1, D1, K2, D2, R, T), strict=True))
    path = write(tmp_path / "rig", entries)
    rig = load_calibration(path, PROJECTOR, camera_size=CAMERA)
    check_same(rig)
    assert "taken as metres, so the baseline is 0.2 m" in read_calibration(path).findings[0]


def check_same(rig: Rig) -> None:
    assert (rig.camera.width, rig.camera.height, rig.projector.width, rig.projector.height) == (*CAMERA, *PROJECTOR)
    for found, true in ((rig.pinhole, RIG.pinhole), (rig.image_projector, RIG.image_projector)):
        np.testing.assert_allclose([found.fx, found.fy, found.cx, found.cy], [true.fx, true.fy, true.cx, true.cy])
        np.testing.assert_allclose(found.coefficients, true.coefficients)
    np.testing.assert_allclose(rig.T_camera_projector, RIG.T_camera_projector, atol=1e-9)


WHOLE = {"K1": K1, "D1": D1, "K2": K2, "D2": D2, "R": R, "T": T}


@pytest.mark.parametrize(
    "changed",
    [
        {"camera": {"K": K1, "dist": D1}, "projector": {"K": K2, "dist": D2}},
        {"projector": {"matrix": K2, "distortion": D2}, "camera": {"matrix": K1, "distortion": D1}},
        {"stereo": {"K1": K1, "D1": D1, "K2": K2, "D2": D2}},
        {"K1": {"rows": 3, "cols": 3, "dt": "d", "data": np.ravel(K1)}, "K2": {"data": np.ravel(K2)}},
        {"K1": np.ravel(K1), "D1": [[d] for d in D1], "T": T[:, None]},
        {"D1": [*D1, 0, 0, 0], "D2": [*D2[:4]], "T": T[None]},
        {"D2": [*D2, *[0] * 9], "R": [[0.0], [0.15], [0.0]]},
        {"R": [0.0, 0.15, 0.0], "image_size": CAMERA, "projector_size": PROJECTOR},
        {"img_shape": CAMERA[::-1], "projector_width": PROJECTOR[0], "projector_height": PROJECTOR[1]},
        {"T": 1000 * T},
        {"T": 1000 * T, "unit": "mm"},
        {"T": 100 * T, "units": "cm"},
    ],
    ids=str,
)
def test_one_rig_in_any_shape(tmp_path: Path, changed: dict[str, Any]) -> None:
    nested = {"camera", "stereo"} & set(changed)
    kept = {name: WHOLE[name] for name in ("R", "T")} if nested else WHOLE
    path = as_json(tmp_path / "rig", kept | changed)
    check_same(load_calibration(path, PROJECTOR, camera_size=CAMERA))


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"R": 1.01 * R}, "expected 'R' to hold a rotation matrix"),
        ({"R": R * [1, 1, -1]}, "a reflection"),
        ({"R": [0, 50, 0]}, "rotation vector in radians"),
        ({"R": None}, "does not hold numbers"),
        ({"K1": np.transpose(K1)}, "'K1' with the last row 0 0 1.* seems to be transposed"),
        ({"K1": [[70, 3, 31], [0, 70, 23], [0, 0, 1]]}, "'K1' without skew, got 3"),
        ({"K1": [[70, 0, 31], [1, 70, 23], [0, 0, 1]]}, "'K1' as an upper triangle"),
        ({"K2": [[-70, 0, 31], [0, 70, 23], [0, 0, 1]]}, "fx to be positive"),
        ({"K2": [[70, 0, 31], [0, 70, float("nan")], [0, 0, 1]]}, "expected numbers below 1e.09 in 'K2'"),
        ({"K2": [[70, 0], [0, 70]]}, "expected 'K2' to hold 3 x 3 numbers, got 4"),
        ({"D1": [0.1] * 8}, "k1, k2, p1, p2, k3 alone"),
        ({"D1": [0.1] * 3}, "coefficients of OpenCV in 'D1', got 3"),
        ({"T": [1, 2]}, "expected 'T' to hold 3 numbers, got 2"),
        ({"T": [1, 2, "three"]}, "'T' does not hold numbers, but 'three'"),
        ({"unit": "furlongs"}, "expected 'unit' to be one of m,"),
        ({"image_size": [64.5, 48]}, "whole numbers"),
    ],
)
def test_what_is_no_calibration_is_one_sentence(tmp_path: Path, changed: dict[str, Any], sentence: str) -> None:
    path = as_json(tmp_path / "rig", WHOLE | changed)
    with pytest.raises(FileFormatError, match=sentence) as caught:
        load_calibration(path, PROJECTOR, camera_size=CAMERA)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("missing", ["K1", "K2", "R", "T"])
def test_a_missing_part_is_named(tmp_path: Path, missing: str) -> None:
    path = as_json(tmp_path / "rig", {name: value for name, value in WHOLE.items() if name != missing})
    word = {"K1": "camera's matrix", "K2": "projector's matrix"}.get(missing, f"matrix '{missing}'")
    with pytest.raises(FileFormatError, match=word):
        load_calibration(path, PROJECTOR, camera_size=CAMERA)


def test_sizes_are_asked_for_where_the_file_has_none(tmp_path: Path) -> None:
    path = as_json(tmp_path / "rig", WHOLE)
    with pytest.raises(ValueError, match="camera_size"):
        load_calibration(path, PROJECTOR)
    with pytest.raises(ValueError, match="projector_size"):
        load_calibration(path, camera_size=CAMERA)
    assert read_calibration(as_json(path, {"K1": K1, "R": R, "T": T, "K2": K2})).findings[0].endswith("as a pinhole.")


def test_a_real_calibration_of_slstudio_is_read(real_data: Path) -> None:
    found = read_calibration(real_data / "captures" / "slstudio_skull_gray" / "calibration.xml")
    assert (found.camera_size, found.projector_size) == ((1688, 1352), (1824, 1140))
    assert found.rig().baseline_m == pytest.approx(0.1645, abs=1e-4)
    assert "taken as millimetres" in found.findings[0]


def test_the_command_takes_sizes_from_file_and_frames(tmp_path: Path) -> None:
    """The projector's size need not be said twice, and the unit is said where it was guessed."""
    sensor = StructuredLight(*PROJECTOR, "gray", ("columns", "rows"))
    (tmp_path / "scan").mkdir()
    np.save(tmp_path / "scan" / "frames.npy", (255 * sensor.patterns()[:, :48, :64]).astype(np.uint8))
    path = as_json(tmp_path / "rig", WHOLE | {"projector_size": PROJECTOR, "T": 1000 * T})
    options = ["decode", str(tmp_path / "scan"), "--calibration", str(path), "--out", str(tmp_path / "out")]
    answer = CliRunner().invoke(app, options)
    assert answer.exit_code == 0, answer.exception
    said = " ".join(answer.output.split())
    assert "T is taken as millimetres, so the baseline is 0.2 m; --unit states another unit." in said
    record = json.loads((tmp_path / "out" / "decoded.json").read_text())
    assert record["rig"]["projector"]["width"] == PROJECTOR[0]
    assert "taken as millimetres" in record["findings"][0]
    answer = CliRunner().invoke(app, [*options, "--unit", "0.002"])
    assert "taken as" not in answer.output
    answer = CliRunner().invoke(app, [*options, "--projector", "64x48"])
    assert "expected" in str(answer.exception)
    save_calibration(RIG, tmp_path / "own.json")
    answer = CliRunner().invoke(app, [*options[:2], "--calibration", str(tmp_path / "own.json"), *options[4:]])
    assert answer.exit_code == 0, answer.exception


@pytest.mark.parametrize(
    "text",
    [
        "a: 1\nb:\n  c: [1, 2.5,\n    -3e-2]\n  d: {x: 1, 'y': two}\n",
        "%YAML:1.0\n---\na: 1.\nb: !!opencv-matrix\n   rows: 1\n   data: [ 1., .5 ]\n",
        "a:\n- 1\n- - 2\n  - 3\n- [4]\nb: text # comment\n",
    ],
)
def test_yaml_is_read_as_it_is_meant(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    found = read_storage(tmp_path / "a.yaml")
    expected: list[dict[str, Any]] = [
        {"a": 1, "b": {"c": [1, 2.5, -0.03], "d": {"x": 1, "y": "two"}}},
        {"a": 1.0, "b": {"rows": 1, "data": [1.0, 0.5]}},
        {"a": [1, [2, 3], [4]], "b": "text"},
    ]
    assert found in expected


# ---- Calibrations of other devices and sizes -------------------------------------------------------------------------

CAMERA_K = Intrinsics(1688, 1352, 2195.0, 2195.0, 844.0, 676.0)
PROJECTOR_K = Intrinsics(1824, 1140, 2601.0, 2601.0, 867.0, 1109.0)
"""A camera, and a projector that shines upward from a table."""


def resized(device: Intrinsics, factor: float, width: int = 0, height: int = 0) -> Intrinsics:
    """The device with its K times a factor, or that K for an image of another size."""
    return Intrinsics(
        width or device.width,
        height or device.height,
        *(factor * x for x in (device.fx, device.fy, device.cx, device.cy)),
    )


@pytest.mark.parametrize(
    ("camera", "projector", "words"),
    [
        (CAMERA_K, PROJECTOR_K, []),
        (resized(CAMERA_K, 0.5), PROJECTOR_K, ["the camera's principal point, 422, 338, lies far"]),
        (resized(CAMERA_K, 2.0), PROJECTOR_K, ["images of another size"]),
        (CAMERA_K, resized(PROJECTOR_K, 0.5), ["the projector's principal point, 434, 554, lies far"]),
        (
            resized(PROJECTOR_K, 1.0, CAMERA_K.width, CAMERA_K.height),
            resized(CAMERA_K, 1.0, PROJECTOR_K.width, PROJECTOR_K.height),
            ["camera and projector seem to be exchanged"],
        ),
    ],
)
def test_principal_points_far_from_the_centre_are_named(
    camera: Intrinsics, projector: Intrinsics, words: list[str]
) -> None:
    said = principal_point_doubts(Rig(camera, projector, np.eye(4), RIG.T_camera_projector))
    assert len(said) == len(words)
    assert all(word in sentence for word, sentence in zip(words, said, strict=True))


@pytest.mark.parametrize(("length", "is_said"), [(0.2, False), (6.0, True), (16.0, True), (200.0, False)])
def test_a_length_that_may_be_centimetres_is_said(length: float, is_said: bool, tmp_path: Path) -> None:
    entries = {"K1": K1, "D1": D1, "K2": K2, "D2": D2, "R": R, "T": length * T / np.linalg.norm(T)}
    findings = read_calibration(as_json(tmp_path / "stereo", entries)).findings
    assert ("centimetres" in " ".join(findings)) == is_said
