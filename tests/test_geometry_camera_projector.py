# SPDX-License-Identifier: Apache-2.0
"""Camera and projector: depth of a known ray from a noisy projector coordinate, with one coded axis and with both."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_scenes import rigid

from rangesim.geometry import project, projection_matrix, triangulate_coordinates, triangulate_optimal
from rangesim.rig import Intrinsics, Rig

TRIALS = 20000


def rig(tilt_deg: float) -> Rig:
    """A rig whose projector stands 0.2 m from the camera in a direction tilted against its columns, turned inwards."""
    tilt = np.radians(tilt_deg)
    T = rigid((0.0, -0.15, 0.0), (0.2 * np.cos(tilt), 0.2 * np.sin(tilt), 0.03))
    return Rig(
        Intrinsics(640, 480, 700, 700, 320, 240), Intrinsics(1024, 768, 1000, 1010, 512, 400), T_camera_projector=T
    )


def readings(device: Rig, z: float, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """n times the same ray (n, 3), noisy projector coordinates (n, 2), and the exact coordinates (2,)."""
    ray = device.camera.directions(np.array([250.0, 300.0]))
    T = np.linalg.inv(device.T_camera_projector)
    exact = device.projector.project(T[:3, :3] @ (ray * z) + T[:3, 3])
    random = np.random.default_rng(0)
    return np.repeat(ray[None], TRIALS, 0), exact + random.normal(0, noise, (TRIALS, 2)), exact


def bound(device: Rig, z: float, noise: float, axes: list[int]) -> float:
    """Least standard deviation of z that these axes allow, by numerical derivatives."""
    h = 1e-6
    ray = device.camera.directions(np.array([250.0, 300.0]))
    T = np.linalg.inv(device.T_camera_projector)
    up, down = (device.projector.project(T[:3, :3] @ (ray * (z + s * h)) + T[:3, 3])[axes] for s in (1, -1))
    return noise / float(np.linalg.norm((up - down) / (2 * h)))


@pytest.mark.parametrize("tilt_deg", [0, 30, 60, 85])
def test_both_axes_reach_the_bound_and_gain_with_the_tilt_of_the_baseline(tilt_deg: float) -> None:
    """The gain over columns alone is 1 / cos of the angle of the epipolar line, or 1 with devices side by side."""
    device, noise = rig(tilt_deg), 0.3
    rays, uv, _ = readings(device, 0.9, noise)
    both = triangulate_coordinates(rays, device, uv[:, 0], uv[:, 1]).z
    columns = triangulate_coordinates(rays, device, uv[:, 0], None).z
    assert np.sqrt(np.mean((both - 0.9) ** 2)) == pytest.approx(bound(device, 0.9, noise, [0, 1]), rel=0.03)
    assert np.std(columns) == pytest.approx(bound(device, 0.9, noise, [0]), rel=0.06)
    gain = np.std(columns) / np.std(both)
    expected = bound(device, 0.9, noise, [0]) / bound(device, 0.9, noise, [0, 1])
    assert gain == pytest.approx(expected, rel=0.06)
    assert gain > 1 / np.cos(np.radians(tilt_deg)) * 0.6 if tilt_deg else gain < 1.02


def linear(rays: np.ndarray, device: Rig, uv: np.ndarray) -> np.ndarray:
    """(n,) z by linear least squares of the two plane equations w (b_x - x b_z) = x a_z - a_x."""
    R, t = device.T_camera_projector[:3, :3], device.T_camera_projector[:3, 3]
    a, b = rays @ R, -t @ R
    xy = device.projector.normalise(uv)
    focal = np.array([device.projector.fx, device.projector.fy])
    slope = focal * (b[:2] - xy * b[2])
    return np.asarray((slope**2).sum(-1) / (slope * focal * (xy * a[:, 2:] - a[:, :2])).sum(-1))


@pytest.mark.parametrize("noise", [0.1, 1.0, 4.0])
def test_the_coordinate_moves_to_the_nearest_place_on_the_epipolar_line(noise: float) -> None:
    device = rig(40)
    rays, uv, _ = readings(device, 0.9, noise)
    found = triangulate_coordinates(rays, device, uv[:, 0], uv[:, 1])
    T = np.linalg.inv(device.T_camera_projector)

    def off(z: np.ndarray) -> np.ndarray:
        return np.linalg.norm(device.projector.project((rays * z[:, None]) @ T[:3, :3].T + T[:3, 3]) - uv, axis=-1)

    np.testing.assert_allclose(off(found.z), found.epipolar_px, atol=1e-9)
    for other in (linear(rays, device, uv), found.z * (1 + 1e-3), found.z * (1 - 1e-3)):
        assert (found.epipolar_px <= off(other) + 1e-9).all()
    # the linear solution differs to second order only: by less than 1 % of the noise of depth
    apart = linear(rays, device, uv) - found.z
    assert 0 < np.abs(apart).max() < 1e-2 * np.std(found.z)


def test_triangulation_of_two_cameras_gives_the_depth_of_another_ray() -> None:
    """It also corrects the camera pixel, which has no error, and is no better along the known ray."""
    device, noise = rig(40), 1.0
    rays, uv, _ = readings(device, 0.9, noise)
    P = projection_matrix(device.camera), projection_matrix(device.projector, np.linalg.inv(device.T_camera_projector))
    pixels = np.repeat([[250.0, 300.0]], TRIALS, axis=0)
    theirs = triangulate_optimal(*P, pixels, uv).points
    moved = np.linalg.norm(project(P[0], theirs) - pixels, axis=-1)
    assert np.median(moved) > 0.1  # pixels beside the ray
    ours = rays * triangulate_coordinates(rays, device, uv[:, 0], uv[:, 1]).z[:, None]
    errors = [np.sqrt(((X - rays * 0.9) ** 2).sum(-1).mean()) for X in (ours, theirs)]
    assert errors[0] < errors[1]


def test_pixels_that_look_along_the_baseline_measure_nothing() -> None:
    device = Rig(
        Intrinsics(64, 48, 70, 70, 32, 24),
        Intrinsics(64, 48, 70, 70, 32, 24),
        T_camera_projector=rigid((0, 0, 0), (0, 0, 0.2)),
    )
    ray = np.array([[0.0, 0.0, 1.0]])
    found = triangulate_coordinates(ray, device, np.array([32.0]), np.array([24.0]))
    assert np.isnan(found.z).all()
    with pytest.raises(ValueError, match="columns, rows or both"):
        triangulate_coordinates(ray, device, None, None)
