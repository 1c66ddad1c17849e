# SPDX-License-Identifier: Apache-2.0
"""The real Gray code capture of a board: agreement with OpenCV's decoder, and a board that comes out flat."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rangesim.capture import Capture
from rangesim.decoding import decode
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import without_warnings
from rangesim.results.captures import import_capture
from rangesim.rig import Rig
from rangesim.rig.calibration_files import load_calibration
from rangesim.sensors import StructuredLight

SENSOR = StructuredLight(1024, 768, code="gray", axes=("columns", "rows"))
BOARD = (slice(200, 780), slice(220, 1080))
"""Rows and columns of the camera that the chessboard fills."""
CODE_STEP = 2
"""Projector pixels per Gray cell at calibration; with any other value the epipolar error is tens of pixels."""


@pytest.fixture(scope="module")
def capture(real_data: Path) -> Capture:
    return import_capture(real_data / "graycode_board" / "capture_0", SENSOR)


@pytest.fixture(scope="module")
def decoded(capture: Capture) -> RangeImage:
    return decode(capture)


@pytest.mark.validation
def test_it_agrees_with_opencv(capture: Capture, decoded: RangeImage) -> None:
    """All pixels of a grid that OpenCV decodes with its thresholds (40 and 5) come out the same, and no others.

    OpenCV refuses stripe edges (one uncertain bit); we decode them where the two codes are neighbours.
    """
    cv2 = pytest.importorskip("cv2")
    if not hasattr(cv2, "structured_light"):
        pytest.skip("this OpenCV comes without its contributed modules")
    reference = cv2.structured_light.GrayCodePattern.create(1024, 768)
    reference.setWhiteThreshold(5)
    frames = list(capture.frames[:-2])
    contrast = capture.frames[-2].astype(int) - capture.frames[-1]
    assert decoded.projector_column is not None
    assert decoded.projector_row is not None
    valid = decoded.valid
    ours, theirs, same, edges = 0, 0, 0, 0
    for y in range(0, 1024, 4):
        for x in range(0, 1280, 4):
            failed, (column, row) = reference.getProjPixel(frames, x, y)
            they = not failed and contrast[y, x] > 40
            we = bool(valid[y, x])
            ours, theirs = ours + we, theirs + they
            found = (decoded.projector_column[y, x], decoded.projector_row[y, x])
            same += we and they and found == (column + 0.5, row + 0.5)
            edges += we and not they and (found[0] % 1 == 0 or found[1] % 1 == 0)
    assert theirs > 40_000
    assert same == theirs
    assert ours == theirs + edges


@pytest.mark.validation
def test_the_board_is_a_plane(real_data: Path, capture: Capture) -> None:
    """Median distance to the plane: 3.5 mm at 3.66 m, 0.10 %; a smooth bowl, so the calibration's (RMS 0.86 px).

    OpenCV's own undistortion and triangulation leave the same residual on the same correspondences.
    """
    rig = load_calibration(real_data / "graycode_board" / "calibration_result.xml", (1024, 768), code_step=CODE_STEP)
    assert 0.6 < rig.baseline_m < 0.7
    image = decode(Capture(capture.frames, SENSOR, rig))
    rays = rig.camera.directions(rig.camera.pixel_centres())[BOARD]
    points = (rays * image.z[BOARD][..., None])[image.valid[BOARD]]
    assert len(points) > 300_000
    distance = np.median(np.linalg.norm(points, axis=-1))
    assert 3.6 < distance < 3.7
    residual = np.median(np.abs(plane_residual(points)))
    assert residual < 0.004
    assert residual / distance < 1.1e-3
    cv2 = pytest.importorskip("cv2")
    reference = opencv_points(cv2, rig, image, step=7)
    assert residual < 1.05 * np.median(np.abs(plane_residual(reference)))


def opencv_points(cv2: Any, rig: Rig, image: RangeImage, step: int) -> np.ndarray:
    """(n, 3) points in metres of every `step`-th pixel of the board, all by OpenCV; its pixels start at -0.5."""
    assert image.projector_column is not None
    assert image.projector_row is not None
    valid = image.valid[BOARD]
    camera = rig.camera.pixel_centres()[BOARD][valid]
    projector = np.stack([image.projector_column[BOARD][valid], image.projector_row[BOARD][valid]], axis=-1)
    rays = []
    for device, pixels in ((rig.camera, camera), (rig.projector, projector)):
        matrix = np.array([[device.fx, 0, device.cx - 0.5], [0, device.fy, device.cy - 0.5], [0, 0, 1]])
        shifted = (pixels[::step].astype(np.float64) - 0.5)[:, None]
        rays.append(cv2.undistortPoints(shifted, matrix, np.array(device.distortion))[:, 0].T)
    homogeneous = cv2.triangulatePoints(np.eye(4)[:3], np.linalg.inv(rig.T_camera_projector)[:3], *rays)
    return np.asarray((homogeneous[:3] / homogeneous[3]).T)


def test_wrong_code_step_shows_in_the_epipolar_error(real_data: Path, capture: Capture) -> None:
    path = real_data / "graycode_board" / "calibration_result.xml"
    fraction = {}
    for step in (1, CODE_STEP):
        rig = load_calibration(path, (1024, 768), code_step=step)
        small = Capture(capture.frames, SENSOR, rig)
        with without_warnings() if step == 1 else nullcontext():  # of the missed epipolar line
            image = decode(small)
        fraction[step] = image.valid.mean()
        assert bool(image.doubts) == (step == 1)
    assert fraction[CODE_STEP] > 0.6
    assert fraction[1] < 0.01


def plane_residual(points: np.ndarray) -> np.ndarray:
    """(n,) signed distance in metres to the plane fitted to the inner points, refitted ten times."""
    inner = np.ones(len(points), dtype=bool)
    for _ in range(10):
        centre = points[inner].mean(axis=0)
        normal = np.linalg.eigh(np.cov((points[inner] - centre).T))[1][:, 0]
        residual = (points - centre) @ normal
        inner = np.abs(residual) < 3 * 1.4826 * np.median(np.abs(residual))
    return np.asarray(residual)
