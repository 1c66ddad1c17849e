# SPDX-License-Identifier: Apache-2.0
"""The page of a calibration: what it says of corners and boards that do not fit; it holds nothing but itself."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSER, browser
from scipy.spatial.transform import Rotation
from scroll_hints import check_scroll_hints

from rangesim.calibration import BoardView, Checkerboard, RigCalibration, Suspect, default_rig
from rangesim.cli.calibrate import check_places
from rangesim.errors import FileFormatError
from rangesim.report.calibration_page import render_calibration

BOARD = Checkerboard(9, 6, 0.025)
NAMES = [f"pose_{k}" for k in range(6)]


def calibrated(noise=0.05, z_m=0.5):
    """Six boards, as if calibrated: the rig is the true one, the errors are noise."""
    rng = np.random.default_rng(0)
    rig = default_rig()
    T = np.stack([np.eye(4)] * 6)
    T[:, :3, :3] = Rotation.from_euler("xyz", rng.uniform(-30, 30, (6, 3)), degrees=True).as_matrix()
    T[:, :3, 3] = np.array([0, 0, z_m]) - (T[:, :3, :3] @ BOARD.points.mean(axis=0)[:, None])[..., 0]
    views, residuals = [], []
    for device, at in ((rig.camera, T), (rig.projector, np.linalg.inv(rig.T_camera_projector) @ T)):
        pixels = [device.project(BOARD.points @ P[:3, :3].T + P[:3, 3]) for P in at]
        off = [rng.normal(0, noise, p.shape) for p in pixels]
        views.append(tuple(BoardView(np.arange(54), p - e) for p, e in zip(pixels, off, strict=True)))
        residuals.append(tuple(off))
    rms = noise * np.sqrt(2)
    deviations = np.array([0.2, 0.2, 0.3, 0.3, 1e-3, 1e-3, 1e-4, 1e-4, 0.0])
    return RigCalibration(rig, deviations, deviations, 0.1001, 1e-5, T, *residuals, rms, rms, *views)


def with_error(found: RigCalibration, view: int, point: int, error) -> RigCalibration:
    changed = [r.copy() for r in found.camera_residuals]
    changed[view][point] = error
    suspect = Suspect("camera", view, point, float(np.linalg.norm(error)))
    return replace(found, camera_residuals=tuple(changed), suspects=(suspect,))


def said(page: str) -> str:
    """The sentences at the top."""
    (block,) = re.findall(r'<div class="verdict">(.*?)</div>', page, re.DOTALL)
    return re.sub(r"<[^>]*>", "", block)


def test_a_corner_that_does_not_fit_is_named():
    found = calibrated()
    assert "more than noise" not in said(render_calibration(found, NAMES))
    wrong = with_error(found, 3, 17, (1.2, -0.5))
    page = render_calibration(wrong, NAMES)
    assert "1 corner is off by more than noise can explain, up to 1.3 px in pose_3" in said(page)
    assert "pose_3 fits the camera worse than the other boards" in said(page)


def test_parts_without_corners_are_named():
    assert "has corners in" in said(render_calibration(calibrated(z_m=1.0), NAMES))
    assert "has corners in" not in said(render_calibration(calibrated(z_m=0.33), NAMES))


def test_the_figures_are_those_of_the_calibration():
    found = calibrated()
    page = render_calibration(found, NAMES)
    assert f"{found.rig.camera.fx:.3f}" in page
    assert "held" in page
    assert "100.1000 ± 0.01 mm" in page
    # an arrow starts where a corner was seen, and is as long as its error, enlarged
    device = found.rig.camera
    enlarged = int(re.findall(r"errors (\d+) times enlarged", page)[0])
    arrows = np.array(re.findall(r'<path d="M([\d.-]+) ([\d.-]+)L([\d.-]+) ([\d.-]+)" class="arrow"', page), float)
    seen, off = np.concatenate([v.pixels for v in found.camera_views]), np.concatenate(found.camera_residuals)
    assert np.abs(arrows[: len(seen), :2] - seen).max() < 0.06
    assert np.abs(arrows[: len(seen), 2:] - seen - enlarged * off).max() < 0.06
    assert 0.01 < enlarged * found.camera_rms_px / device.width < 0.04


def test_a_name_is_shown_and_not_run_and_the_page_asks_for_nothing(tmp_path: Path):
    hostile = "<img src=x onerror=window.attacked=1>"
    images = [np.random.default_rng(k).integers(0, 4000, (480, 640), dtype=np.uint16) for k in range(6)]
    (tmp_path / "page.html").write_text(render_calibration(calibrated(), [hostile, *NAMES[1:]], images))
    text = (tmp_path / "page.html").read_text()
    assert hostile not in text
    assert "&lt;img src=x" in text
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text)
    if BROWSER is None:
        pytest.skip("no Chromium found; apt-get install chromium")
    (tmp_path / "browser").mkdir()
    with browser(tmp_path / "browser") as page:
        page.call("Page.navigate", url=(tmp_path / "page.html").resolve().as_uri())
        page.wait_for("document.readyState === 'complete' && document.images !== undefined")
        assert page.said == []
        assert page.evaluate("window.violations") == []
        assert page.evaluate("window.attacked") is None
        assert page.evaluate("document.querySelectorAll('svg image').length") == 6
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.skipif(BROWSER is None, reason="no Chromium found; apt-get install chromium")
def test_tables_wider_than_the_page_say_that_they_scroll(tmp_path: Path):
    (tmp_path / "page.html").write_text(render_calibration(calibrated(), NAMES))
    with browser(tmp_path) as page:
        check_scroll_hints(page, tmp_path / "page.html")


def test_names_and_images_of_each_capture_are_needed():
    with pytest.raises(ValueError, match="each of the 6 captures"):
        render_calibration(calibrated(), NAMES[1:])
    with pytest.raises(ValueError, match="each of the 6 captures"):
        render_calibration(calibrated(), NAMES, [np.zeros((480, 640))])


@pytest.mark.parametrize("name", ["rig.json", "rig.yml", "rig.xml", "tof.npz", "page.html"])
def test_a_file_of_the_users_is_not_replaced(tmp_path: Path, name: str):
    place = tmp_path / name
    check_places(place, None)
    for mine in ("my notes of ten years", '{"camera": "mine"}', "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n"):
        place.write_text(mine)
        with pytest.raises(FileFormatError, match="would be lost"):
            check_places(place, None)
    place.unlink()
    place.mkdir()
    with pytest.raises(FileFormatError, match="no plain file"):
        check_places(place, None)


@pytest.mark.parametrize("name", ["a.json", "a.yml", "a.yaml", "a.xml", "camera.yml", "page.html", "tof.npz"])
def test_what_somebody_changed_since_is_theirs(tmp_path: Path, name: str):
    from rangesim.calibration.opencv_files import save_opencv, save_opencv_camera
    from rangesim.files.array_files import write_arrays
    from rangesim.rig.calibration_files import SEAL, load_calibration, save_calibration

    place, rig = tmp_path / name, default_rig()
    if name == "a.json":
        save_calibration(rig, place)
        assert load_calibration(place) == rig
    elif name == "camera.yml":
        save_opencv_camera(rig.camera, place)
    elif name == "page.html":
        place.write_text(render_calibration(calibrated(), NAMES))
    elif name == "tof.npz":
        write_arrays(place, {"cosines_m": np.zeros((1, 3)), "offset_m": np.zeros((48, 64), np.float32)}, SEAL)
        assert np.load(place)["offset_m"].shape == (48, 64)
    else:
        save_opencv(rig, place)
    content = place.read_bytes()
    check_places(place, None)
    for k in range(40, len(content), max(1, len(content) // 30)):
        place.write_bytes(content[:k] + bytes([content[k] ^ 1]) + content[k + 1 :])
        with pytest.raises(FileFormatError, match="changed since, and would be lost"):
            check_places(place, None)
    for theirs in (content + b"\n", content[:-1], content.replace(b"sha256", b"sha512"), content[40:]):
        place.write_bytes(theirs)
        with pytest.raises(FileFormatError, match="would be lost"):
            check_places(place, None)
    place.write_bytes(content)
    check_places(place, None)


def test_a_calibration_corrected_by_hand_is_read_and_kept(tmp_path: Path):
    from rangesim.calibration.opencv_files import save_opencv
    from rangesim.rig.calibration_files import load_calibration, save_calibration

    rig = default_rig()
    for name, save, load in (("a.json", save_calibration, load_calibration), ("a.yml", save_opencv, load_calibration)):
        save(rig, tmp_path / name)
        text = (tmp_path / name).read_text()
        width = str(rig.camera.width)
        (tmp_path / name).write_text(text.replace(width, "1234", 1))
        assert load(tmp_path / name).camera.width == 1234
        with pytest.raises(FileFormatError, match="would be lost"):
            check_places(tmp_path / name, None)


def test_what_the_command_wrote_is_replaced(tmp_path: Path):
    from rangesim.calibration.opencv_files import save_opencv
    from rangesim.rig.calibration_files import save_calibration

    page = tmp_path / "page.html"
    page.write_text(render_calibration(calibrated(), NAMES))
    for name in ("a.json", "a.yml", "a.yaml", "a.xml"):
        save = save_calibration if name == "a.json" else save_opencv
        save(default_rig(), tmp_path / name)
        check_places(tmp_path / name, page)
