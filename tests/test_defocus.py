# SPDX-License-Identifier: Apache-2.0
"""Patterns out of focus against brute-force convolution; lens models against OpenCV; the rig's new fields on file."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from synthetic import plane_signals, stereo_rig

from rangesim import save_capture
from rangesim.capture.exposure import expose
from rangesim.response import Fringes, GrayBits, Images, LightPath, NumpyMath, Stripes
from rangesim.response.defocus import MIN_HARMONIC_SIGMA, blurred_stripes
from rangesim.results.captures import load_capture
from rangesim.rig import Intrinsics, Lens, Rig
from rangesim.sensors import IdealToF
from rangesim.settings.config import to_dict

MATH = NumpyMath()
STRONG = (-0.3, 0.12, 2e-3, -1e-3, 0.01)


def path(u: np.ndarray, v: np.ndarray, blur_px: float | None) -> LightPath:
    blur = None if blur_px is None else np.full(u.shape, blur_px)
    return LightPath(u, v, np.zeros(u.shape), np.ones(u.shape, bool), blur_px=blur)


# ---- Patterns -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bit", [0, 2, 5])
@pytest.mark.parametrize(
    "periods", [1e-3, 0.01, 0.05, 0.99 * MIN_HARMONIC_SIGMA, 1.01 * MIN_HARMONIC_SIGMA, 0.1, 0.3, 1.0]
)
def test_gray_stripes_out_of_focus_are_the_convolved_stripes(bit: int, periods: float) -> None:
    """Brute force: the stripes' spectrum times that of the Gaussian, 65536 samples per period."""
    period = 4 * 2**bit
    x = (np.arange(65536) + 0.5) / 65536 * period
    sharp = GrayBits(0, 1, 1 << bit).weights(path(x, 0 * x, None), MATH)[0]
    f = np.fft.rfftfreq(len(x), period / len(x))
    sigma = periods * period
    expected = np.fft.irfft(np.fft.rfft(sharp) * np.exp(-2 * (np.pi * sigma * f) ** 2), len(x))
    blurred = GrayBits(0, 1, 1 << bit).weights(path(x + 3 * period, 0 * x, sigma), MATH)[0]
    np.testing.assert_allclose(blurred, expected, atol=5e-4)


def test_stripes_in_focus_are_sharp_even_on_an_edge() -> None:
    x = np.array([0.0, 0.5, 1.0, 1.5, 2.999, 3.0, 3.5])
    np.testing.assert_allclose(blurred_stripes(x, 4.0, 0.0, MATH), [0, 0, 0.5, 1, 1, 0.5, 0], atol=1e-9)


@pytest.mark.parametrize("sigma", [0.0, 0.7, 4.0])
def test_fringes_lose_contrast_to_blur_and_to_pixels(sigma: float) -> None:
    """Brute force: pixels that hold cos at their centre, blurred; the amplitude at the fringes' frequency."""
    period, n = 16.0, 64
    x = (np.arange(16 * n) + 0.5) / n
    held = np.cos(2 * np.pi * (np.floor(x) + 0.5) / period)
    blurred = gaussian_filter(held, sigma * n, mode="wrap", truncate=8)
    amplitude = 2 * np.abs(np.mean(blurred * np.exp(-2j * np.pi * x / period)))
    c, s = Fringes(0, period).weights(path(x, 0 * x, sigma), MATH)
    np.testing.assert_allclose(np.hypot(c, s), amplitude, rtol=1e-3)
    assert np.abs(c - blurred).max() < (0.2 if sigma == 0 else 5e-3)  # the neglected harmonics


@pytest.mark.parametrize(("sigma", "most"), [(0.1, 0.01), (0.3, 0.01), (0.6, 0.04), (1.4, 0.01), (3, 0.01), (7, 0.01)])
def test_images_out_of_focus_are_the_blurred_image(sigma: float, most: float) -> None:
    """Brute force on 32 x 32 samples per pixel, of binary noise (the harshest pattern), dark outside."""
    n, pattern = 32, (np.random.default_rng(0).random((14, 18)) > 0.7).astype(np.float32)
    fine = np.kron(pattern, np.ones((n, n)))
    expected = gaussian_filter(fine, sigma * n, mode="constant", truncate=6)
    v, u = (np.indices(fine.shape) + 0.5) / n
    blurred = Images(pattern[None]).weights(path(u, v, sigma), MATH)[0]
    assert np.abs(blurred - expected).max() < most


def test_images_in_focus_are_read_as_they_are() -> None:
    pattern = np.random.default_rng(1).random((3, 12, 16)).astype(np.float32)
    v, u = np.indices((12, 16)) + 0.5
    for sharp, focused in zip(*(Images(pattern).weights(path(u, v, b), MATH) for b in (None, 0.0)), strict=True):
        np.testing.assert_allclose(focused, sharp, atol=1e-6)


# ---- Lens models --------------------------------------------------------------------------------------


def opencv_pixels(lens: Intrinsics, points: np.ndarray) -> np.ndarray:
    """(n, 2) of `cv2.projectPoints`, whose pixel centres are whole numbers."""
    cv2 = pytest.importorskip("cv2")
    matrix = np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(lens.coefficients))[0][:, 0] + 0.5


@pytest.mark.parametrize("distortion", [(0.1,), (-0.2, 0.05), (0, 0, 5e-3, -8e-3), STRONG, (0, 0, 0, 0, 0.3)])
def test_distortion_is_opencv_s(distortion: tuple[float, ...]) -> None:
    lens = Intrinsics(640, 480, 500, 510, 310, 250, distortion)
    points = np.random.default_rng(0).uniform([-0.6, -0.45, 1], [0.6, 0.45, 1], (200, 3))
    np.testing.assert_allclose(lens.project(points), opencv_pixels(lens, points), atol=1e-9)
    np.testing.assert_allclose(lens.normalise(lens.project(points)), points[:, :2], atol=1e-9)


def test_what_lies_beyond_the_fold_has_no_image() -> None:
    """r (1 - 0.45 r^2) turns round at r = 0.861."""
    lens = Intrinsics(640, 480, 500, 500, 320, 240, (-0.45,))
    assert lens.fold_radius2 == pytest.approx(1 / (3 * 0.45))
    radius = np.array([0.5, 0.85, 0.87, 1.2, 3.0])
    pixels = lens.project(np.stack([radius, 0 * radius, 1 + 0 * radius], axis=-1))
    assert (np.isnan(pixels[:, 0]) == (radius > 0.861)).all()
    assert dataclasses.replace(lens, distortion=(0.2,)).fold_radius2 == np.inf


# ---- The rig on file ----------------------------------------------------------------------------------


def test_a_rig_s_optics_read_back_and_may_be_missing() -> None:
    lens = Intrinsics.from_fov(64, 48, 50)
    rig = Rig(lens, lens, camera_lens=Lens(0.75e-3, 0.8, 4.0), projector_lens=Lens(2e-3, 1.2, 2.0))
    data = to_dict(rig)
    assert Rig.from_dict(data) == rig
    data["projector_lens"] = {"focus_m": 1.2}  # on top of the default
    assert Rig.from_dict(data) == dataclasses.replace(rig, projector_lens=Lens(2e-3, 1.2))
    del data["camera_lens"], data["projector_lens"]
    assert Rig.from_dict(data) == Rig(lens, lens)


def test_captures_keep_the_optics_and_older_ones_load_without(tmp_path: Path) -> None:
    sensor, plain = IdealToF(), stereo_rig(8, 6)
    rig = dataclasses.replace(plain, camera_lens=Lens(0.75e-3, focus_m=0.8), projector_lens=Lens(1e-3, vignetting=2.0))
    save_capture(expose(plane_signals(rig, sensor), sensor), tmp_path / "new")
    assert load_capture(tmp_path / "new").rig == rig
    save_capture(expose(plane_signals(plain, sensor), sensor), tmp_path / "old")
    sidecar = tmp_path / "old" / "capture.json"
    data = json.loads(sidecar.read_text())
    del data["rig"]["camera_lens"], data["rig"]["projector_lens"]
    sidecar.write_text(json.dumps(data))
    assert load_capture(tmp_path / "old").rig == plain
    data["rig"] |= {"camera_focus_m": 0.8, "camera_vignetting": 0.0}  # as before lenses were structures
    data["rig"] |= {"projector_aperture_radius_m": 1e-3, "projector_focus_m": None, "projector_vignetting": 2.0}
    sidecar.write_text(json.dumps(data))
    assert load_capture(tmp_path / "old").rig == rig


@pytest.mark.parametrize(
    "wrong", [{"focus_m": 0.0}, {"focus_m": np.inf}, {"vignetting": -1.0}, {"aperture_radius_m": 0.0}]
)
def test_optics_out_of_range_are_refused_by_name(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"expected {next(iter(wrong))} to be"):
        Lens(**{"aperture_radius_m": 1e-3} | wrong)


def test_a_stripe_and_its_inverse_add_up_to_white_at_the_projector_s_ends() -> None:
    """White has no blur there. Inverses, white - pattern, were too bright, and each bit of the last cells read dark."""
    pattern = np.array([[0.0, 1.0, 1.0, 0.0, 1.0]])
    seen = path(np.array([0.1, 2.5, 4.9]), np.zeros(3), 1.3)
    both = [Stripes(0, shown).weights(seen, MATH)[0] for shown in (pattern, 1 - pattern)]
    np.testing.assert_allclose(both[0] + both[1], 1, atol=1e-5)
