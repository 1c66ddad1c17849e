# SPDX-License-Identifier: Apache-2.0
"""Clouds of moving scanners: walls that a raw cloud bends are straight again, and what stands still stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rangesim.motion import ConstantTwist, PoseTrack, Track, deskewed
from rangesim.point_cloud import PointCloud
from rangesim.rig import look_at
from rangesim.rig.scan_patterns import spinning

ROOM_M = np.array([9.0, 7.0, 5.0])
"""Half the size of a room around the origin of the world."""
DRIVE = ConstantTwist(velocity_m_s=(15.0, 0.0, 0.0), rotation_rad_s=(0.0, 0.0, 0.8))
"""15 m/s and a tight bend: within a turn of 0.1 s, 1.5 m and 4.6 degrees."""


def scanned_room(track: Track, T_world_camera: np.ndarray) -> PointCloud:
    """What a turning head in the room reports, in its own coordinates, which move along a track."""
    rays = spinning(np.radians(np.linspace(20, -20, 8)), 256, 0.1, origin_offset_m=(0, 0, 0.03))
    assert rays.origins is not None
    poses = np.array([track.at(t) @ T_world_camera for t in rays.times_s[0]])
    directions = np.einsum("cij,rcj->rci", poses[:, :3, :3], rays.directions)
    origins = np.einsum("cij,rcj->rci", poses[:, :3, :3], rays.origins) + poses[:, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray that is parallel to a wall
        ranges = np.nanmin((np.sign(directions) * ROOM_M - origins) / directions, axis=-1)
    return PointCloud(rays.origins + ranges[..., None] * rays.directions, time_s=rays.times_s)


def off_walls(points: np.ndarray) -> np.ndarray:
    """Distance of each point (world) to the nearest wall."""
    return np.asarray(np.abs(np.abs(points) - ROOM_M).min(axis=-1))


def test_walls_are_straight_again() -> None:
    rig = look_at((1.0, -2.0, 0.5), (4.0, 0.0, 0.0))
    raw = scanned_room(DRIVE, rig)
    assert off_walls(raw.points @ rig[:3, :3].T + rig[:3, 3]).max() > 0.5
    for moment_s in (0.0, 0.07):
        cloud = deskewed(raw, DRIVE, rig, moment_s)
        there = DRIVE.at(moment_s) @ rig
        assert off_walls(cloud.points @ there[:3, :3].T + there[:3, 3]).max() < 1e-12


def test_clouds_in_the_world_come_out_the_same() -> None:
    rig = look_at((1.0, -2.0, 0.5), (4.0, 0.0, 0.0))
    raw = scanned_room(DRIVE, rig)
    world = PointCloud(raw.points @ rig[:3, :3].T + rig[:3, 3], "world", time_s=raw.time_s)
    assert off_walls(deskewed(world, DRIVE).points).max() < 1e-12


def test_recorded_poses_do_without_the_rig() -> None:
    rig = look_at((1.0, -2.0, 0.5), (4.0, 0.0, 0.0))
    times = np.linspace(0, 0.1, 65)
    recorded = PoseTrack(times, [DRIVE.at(t) @ rig for t in times])
    raw = scanned_room(DRIVE, rig)
    by_twist, by_poses = deskewed(raw, DRIVE, rig).points, deskewed(raw, recorded).points
    np.testing.assert_allclose(by_twist, by_poses, atol=1e-5)


def test_scans_may_start_later_than_their_track() -> None:
    rig = look_at((1.0, -2.0, 0.5), (4.0, 0.0, 0.0))
    raw = scanned_room(DRIVE, rig)
    shifted = PoseTrack([5.0, 5.1], [DRIVE.at(0.0), DRIVE.at(0.1)])
    early, late = deskewed(raw, DRIVE, rig), deskewed(raw, shifted, rig, start_s=5.0)
    np.testing.assert_allclose(early.points, late.points, atol=1e-3)  # a chord of the bend


def test_at_rest_nothing_changes_and_normals_turn_with_their_points() -> None:
    raw = scanned_room(ConstantTwist(), np.eye(4))
    normals = np.zeros_like(raw.points)
    normals[..., 0] = 1
    still = deskewed(PointCloud(raw.points, normals=normals, time_s=raw.time_s), ConstantTwist())
    np.testing.assert_array_equal(still.points, raw.points)
    turn = ConstantTwist(rotation_rad_s=(0.0, 1.0, 0.0))
    turned = deskewed(PointCloud(raw.points, normals=normals, time_s=raw.time_s), turn)
    assert turned.normals is not None
    for column in (0, 100, 255):
        expected = Rotation.from_rotvec([0, 0.1 * column / 256, 0]).apply([1, 0, 0])
        np.testing.assert_allclose(turned.normals[:, column], np.broadcast_to(expected, (8, 3)), atol=1e-12)


def test_missing_points_may_lack_a_time_and_others_not() -> None:
    points = np.array([[0, 0, 1.0], [np.nan, np.nan, np.nan]])
    cloud = deskewed(PointCloud(points, time_s=np.array([0.1, np.nan])), DRIVE)
    np.testing.assert_array_equal(cloud.valid, [True, False])
    with pytest.raises(ValueError, match="whose time_s is not finite"):
        deskewed(PointCloud(points, time_s=np.array([np.nan, 0.1])), DRIVE)
    with pytest.raises(ValueError, match="without time_s"):
        deskewed(PointCloud(points), DRIVE)
    with pytest.raises(ValueError, match="T_world_camera"):
        deskewed(PointCloud(points, time_s=np.array([0.1, 0.1])), DRIVE, 2 * np.eye(4))


@pytest.mark.parametrize(
    "track",
    [
        DRIVE,
        ConstantTwist((1, 2, 3), (0, 0, 0), (4, 5, 6)),
        PoseTrack([0.0, 0.3, 1.0], [np.eye(4), DRIVE.at(1.0), DRIVE.at(-2.0)]),
        PoseTrack([0.0], [DRIVE.at(1.0)]),
    ],
)
def test_poses_at_many_times_are_those_at_each(track: Track) -> None:
    times = np.linspace(-0.5, 1.5, 23)
    poses = track.poses_at(times)
    np.testing.assert_array_equal(poses, [track.at(time) for time in times])
    np.testing.assert_array_equal(poses, Track.poses_at(track, times))
    assert track.poses_at([]).shape == (0, 4, 4)
