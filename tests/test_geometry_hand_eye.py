# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration of simulated robots: exact without noise, as precise as stated with noise, parallel axes."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_scenes import rigid
from scipy.spatial.transform import Rotation

from rangesim.geometry import eye_in_hand, eye_to_hand

MOUNT, OTHER = rigid((0.1, 0.2, -0.3), (0.05, 0.02, 0.1)), rigid((1.0, 0.2, 0.5), (0.6, 0.1, 0.0))


def robot(random: np.random.Generator, n: int) -> np.ndarray:
    """Random poses T_base_gripper (n, 4, 4)."""
    return np.stack([rigid(random.normal(0, 0.5, 3), random.normal(0, 0.3, 3)) for _ in range(n)])


def sightings(chain: np.ndarray, random: np.random.Generator, turn: float = 0.0, move: float = 0.0) -> np.ndarray:
    """T_camera_target (n, 4, 4) with chain T_mount_camera T_camera_target = T_other_target, with noise."""
    exact = np.linalg.inv(chain @ MOUNT) @ OTHER
    return np.stack([T @ rigid(random.normal(0, 1, 3) * turn, random.normal(0, 1, 3) * move) for T in exact])


@pytest.mark.parametrize("n", [3, 12])
def test_both_arrangements_are_exact_without_noise(n: int) -> None:
    random = np.random.default_rng(0)
    hand = robot(random, n)
    for solve, chain in ((eye_in_hand, hand), (eye_to_hand, np.linalg.inv(hand))):
        found = solve(hand, sightings(chain, random))
        np.testing.assert_allclose(found.T_mount_camera, MOUNT, atol=1e-7)
        np.testing.assert_allclose(found.T_other_target, OTHER, atol=1e-7)
        assert found.rotation_rms_rad < 1e-8


@pytest.mark.validation
def test_errors_are_what_the_covariance_says() -> None:
    random, turn, move = np.random.default_rng(1), 2e-3, 1e-3
    whitened, rms = [], []
    for _ in range(60):
        hand = robot(random, 12)
        found = eye_in_hand(hand, sightings(hand, random, turn, move))
        T = found.T_mount_camera
        error = np.concatenate([Rotation.from_matrix(T[:3, :3] @ MOUNT[:3, :3].T).as_rotvec(), T[:3, 3] - MOUNT[:3, 3]])
        whitened.append(error @ np.linalg.solve(found.covariance[:6, :6], error) / 6)
        rms.append((found.rotation_rms_rad, found.translation_rms_m))
    # the noise is found along with the poses: Student's t instead of a normal distribution
    assert 0.8 < np.mean(whitened) < 1.4
    np.testing.assert_allclose(np.mean(rms, axis=0), np.sqrt(30 / 36) * np.array([turn, move]), rtol=0.1)


def test_more_poses_give_a_smaller_covariance() -> None:
    random = np.random.default_rng(2)
    few, many = (robot(random, n) for n in (5, 80))
    deviations = [
        np.sqrt(np.trace(eye_in_hand(h, sightings(h, random, 1e-3, 1e-3)).covariance[:6, :6])) for h in (few, many)
    ]
    assert deviations[1] < 0.5 * deviations[0]


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_turns_about_one_axis_are_refused(noise: float) -> None:
    random = np.random.default_rng(3)
    axis = np.array([0.3, 0.5, 0.8])
    hand = np.stack([rigid(a * axis, random.normal(0, 0.3, 3)) for a in np.linspace(0, 2, 10)])
    said = np.stack([T @ rigid(random.normal(0, 1, 3) * noise, (0, 0, 0)) for T in hand])  # robots err, too
    for solve, chain in ((eye_in_hand, hand), (eye_to_hand, np.linalg.inv(hand))):
        with pytest.raises(ValueError, match="two different axes"):
            solve(said, sightings(chain, random, noise, noise))


HAND = robot(np.random.default_rng(4), 5)
SEEN = sightings(HAND, np.random.default_rng(5))


@pytest.mark.parametrize(
    ("hand", "seen", "message"),
    [
        (HAND[:2], SEEN[:2], "at least three poses"),
        (HAND, SEEN[:4], "as many poses"),
        (HAND[:, :3], SEEN, r"\(n, 4, 4\)"),
        (np.stack([np.eye(4)] * 5), SEEN, "no turns at all"),
        (HAND * 2, SEEN, r"T_base_gripper\[0\] to be rigid"),
        (HAND, SEEN * np.nan, "finite"),
    ],
)
def test_invalid_input_is_refused(hand: np.ndarray, seen: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        eye_in_hand(hand, seen)
