# SPDX-License-Identifier: Apache-2.0
"""Scenes rebuilt from depth images: planes and front surfaces, of images whose truth is known and of real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cleargrasp import LEFT_M, NOISE_Q, aligned, read_scene
from rebuilt_scene import Rebuilt, front_surface, rebuild, reflectances, scene_dictionary
from tiers import to_validate

from rangesim import Intrinsics, load_scene, transport

CAMERA = Intrinsics(320, 180, fx=230.0, fy=230.0, cx=160.0, cy=90.0)
SIGMA_Q = 0.08 / (230 * 0.05)
"""Noise of 1 / z, per metre: 0.08 pixel of disparity at a baseline of 50 mm."""
NORMAL, DISTANCE_M = np.array([0.0, -0.8, -0.6]), 0.45
"""A table that is seen at 53 degrees: points X on it have NORMAL . X = -DISTANCE_M."""
CENTRE, RADIUS_M = np.array([0.02, 0.03, 0.60]), 0.06
"""A ball before it."""
Images = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def images() -> Images:
    """Depth of table and ball, (h, w) metres, without noise; depth of the table alone; mask of the ball."""
    rays = CAMERA.directions(CAMERA.pixel_centres())
    table = -DISTANCE_M / (rays @ NORMAL)
    table[~((table > 0) & (table < 1.2))] = np.nan
    a, b, c = (rays * rays).sum(-1), rays @ CENTRE, CENTRE @ CENTRE - RADIUS_M**2
    root = b * b - a * c
    mask = root > 0.05 * b * b * RADIUS_M**2 / (CENTRE @ CENTRE)  # without the outermost rays, along the surface
    ball = (b - np.sqrt(np.where(root > 0, root, np.nan))) / a
    return np.where(mask, ball, table), table, mask


@pytest.fixture(scope="module")
def rebuilt(images: Images) -> Rebuilt:
    """Rebuilt from depth with noise, with a hole of 12 x 12 pixels in the ball, and with flying pixels on it."""
    z, _, mask = images
    random = np.random.default_rng(0)
    noisy = 1 / (1 / z + SIGMA_Q * random.normal(size=z.shape))
    rows, columns = (int(np.median(index)) for index in np.nonzero(mask))
    noisy[rows - 6 : rows + 6, columns - 6 : columns + 6] = np.nan
    noisy[mask & (random.random(mask.shape) < 0.02)] = 0.9
    return rebuild(CAMERA, noisy, mask, SIGMA_Q)


def test_the_table_is_found_and_goes_on_behind_the_object(images: Images, rebuilt: Rebuilt) -> None:
    _, table, mask = images
    assert len(rebuilt.planes) == 1
    np.testing.assert_allclose(rebuilt.behind[mask], table[mask], atol=1e-3)
    assert not np.isfinite(rebuilt.things).any()


def test_the_front_surface_is_the_objects_also_in_a_hole(images: Images, rebuilt: Rebuilt) -> None:
    """The noise of a pixel is 2 mm; the surface is better than a millimetre, except where it turns away."""
    z, _, mask = images
    error = np.abs(rebuilt.front - z)[mask]
    assert np.array_equal(np.isfinite(rebuilt.front), mask)
    assert np.median(error) < 0.5e-3
    assert np.quantile(error, 0.8) < 1e-3


def test_a_surface_reaches_the_border_of_the_image() -> None:
    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(61) + 0.5)
    q = 1.8 + 0.002 * x - 0.001 * y
    mask = (x > 51) & (y > 33)
    front = front_surface(np.where(mask, q, np.nan), mask, SIGMA_Q)
    assert front is not None
    np.testing.assert_allclose(front[mask], 1 / q[mask], atol=1e-5)


def test_a_surface_goes_on_straight_where_depth_is_missing_at_its_boundary() -> None:
    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    q = 1.8 + 0.002 * x - 0.001 * y
    mask = (x > 10) & (x < 60) & (y > 10) & (y < 50)
    front = front_surface(np.where(mask & (x < 48), q, np.nan), mask, SIGMA_Q)
    assert front is not None
    np.testing.assert_allclose(front[mask], 1 / q[mask], atol=1e-5)


@pytest.mark.parametrize("glass", [*to_validate("wall", "thin"), "two walls", *to_validate("solid")])
@pytest.mark.validation
def test_the_renderer_sees_the_front_surface_and_the_table(
    images: Images, rebuilt: Rebuilt, glass: str, tmp_path: Path
) -> None:
    z, table, mask = images
    reflectance = reflectances(np.full(mask.shape, 128.0), mask)
    scene = load_scene(scene_dictionary(rebuilt, reflectance, tmp_path, glass=glass))  # type: ignore[arg-type]
    truth = transport(scene, scene.rig(width=320), [], spp=1, caustics=False).truth
    is_glass = truth.material == truth.material_names.index("transparent")
    assert (is_glass != mask).mean() < 0.02
    np.testing.assert_allclose(np.median(np.abs(truth.z - z)[is_glass & mask]), 0, atol=1e-3)
    np.testing.assert_allclose(np.nanquantile(np.abs(truth.z - table)[~is_glass], 0.95), 0, atol=1e-3)


def test_depth_is_aligned_with_the_colour_camera() -> None:
    """A bar before a wall: the nearer one hides the wall on its right, and leaves a shadow on its left."""
    infrared = Intrinsics(120, 60, fx=60.0, fy=60.0, cx=60.0, cy=30.0)
    colour = Intrinsics(128, 72, fx=92.0, fy=92.0, cx=64.0, cy=36.0)
    z = np.full((60, 120), 0.8)
    z[:, 60:70] = 0.4
    found = aligned(z, infrared, colour)

    def column(infrared_column: int, depth: float) -> float:
        return float(colour.project([(infrared_column - 60) / 60 * depth + LEFT_M, 0.0, depth])[0])

    x = np.arange(128)
    np.testing.assert_allclose(found[:, (x > column(60, 0.4)) & (x + 1 < column(70, 0.4))], 0.4)
    np.testing.assert_allclose(found[:, (x > 16) & (x + 1 < column(60, 0.8))], 0.8)
    np.testing.assert_allclose(found[:, x > column(70, 0.4)], 0.8)
    assert np.isnan(found[:, (x > column(60, 0.8)) & (x + 1 < column(60, 0.4))]).all()


@pytest.mark.validation
def test_a_real_scene(real_data: Path) -> None:
    """Of scene 080: the table and the wall, and four bottles whose surfaces agree with the measured depth to 1 mm."""
    if not (folder := real_data / "cleargrasp_d435").is_dir():
        pytest.skip("the ClearGrasp data are not here")
    real = read_scene(folder, 80)
    found = rebuild(real.camera, real.opaque, real.mask, NOISE_Q)
    assert (len(found.planes), len(found.fronts)) == (2, 4)
    assert np.nanmedian(np.abs(found.front - real.opaque)[real.mask]) < 1e-3
    assert np.nanmedian(np.abs(found.behind - real.opaque)[~real.mask]) < 2e-3
