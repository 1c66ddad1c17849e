# SPDX-License-Identifier: Apache-2.0
"""Scanners that move: one pass sees the scene straight, the scanner reports it skewed, de-skewing straightens it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rangesim import DirectToF, IdealToF, Sensor, StructuredLight, decode, expose, load_scene, transport
from rangesim.decoding.range_image import RangeImage
from rangesim.motion import (
    ConstantTwist,
    Motion,
    PoseTrack,
    Timing,
    as_reported,
    deskewed,
    moving_scanner,
    transport_moving,
)
from rangesim.motion.moving_scanner import on_its_way
from rangesim.motion.passes import plan
from rangesim.rig import Beam, Intrinsics, MovingCamera, Orthographic, Rig, Spinning, Zones, look_at

HEAD = Spinning(tuple(np.linspace(15, -15, 8)), 48, 0.1, origin_m=(0.0, 0.0, 0.03), first_azimuth_deg=-180.0)
DRIVE = ConstantTwist(velocity_m_s=(15.0, 0.0, 0.0), rotation_rad_s=(0.0, 0.0, 0.6))
ROOM_M = np.array([9.0, 7.0, 4.0])
"""Half the size of a room around the origin of the world."""


def room() -> dict[str, object]:
    import mitsuba as mi

    from rangesim.environment.backend import select_variant

    select_variant()
    walls = mi.ScalarTransform4f().scale(ROOM_M.tolist())
    matte = {"type": "twosided", "b": {"type": "diffuse"}}
    inside = {"type": "cube", "to_world": walls, "flip_normals": True, "b": matte}
    return {"type": "scene", "room": inside, "sensor": {"type": "perspective", "fov": 40.0}}


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig(HEAD, Beam(), look_at((-1.0, -2.0, 0.5), (4.0, 0.0, 0.5)))


@pytest.fixture(scope="module")
def image(rig: Rig) -> RangeImage:
    sensor = IdealToF()
    moving = moving_scanner(rig, DRIVE)
    return decode(expose(transport(load_scene(room()), moving, [sensor], spp=1, max_depth=2), sensor))


def off_walls(points: np.ndarray) -> float:
    """Largest distance of points (world) from the nearest wall, metres."""
    return float(np.nanmax(np.abs(np.abs(points) - ROOM_M).min(axis=-1)))


def test_one_pass_of_a_moving_scanner_sees_straight_walls(image: RangeImage) -> None:
    """To the beam's own width: on a slanted wall, an image without time gates reads the middle of the spot."""
    assert image.valid.all()
    assert off_walls(image.to_point_cloud("world").points) < 1e-3


def test_clouds_of_scanners_have_times_and_rings(image: RangeImage) -> None:
    cloud = image.to_point_cloud()
    assert cloud.time_s is not None
    assert cloud.ring is not None
    np.testing.assert_array_equal(cloud.time_s, HEAD.times_s)
    np.testing.assert_array_equal(cloud.ring, np.indices(cloud.ring.shape)[0])
    pinhole = Intrinsics.from_fov(48, 8, 60.0)
    assert pinhole.rings is None
    plain = replace(image, camera=pinhole).to_point_cloud()
    assert plain.time_s is None
    assert plain.ring is None


@pytest.mark.parametrize("coordinates", ["camera", "world"])
def test_what_the_scanner_reports_is_skewed_and_can_be_straightened(
    rig: Rig, image: RangeImage, coordinates: str
) -> None:
    raw = as_reported(image)
    assert raw.camera == HEAD
    np.testing.assert_array_equal(raw.range_m, image.range_m)
    assert off_walls(raw.to_point_cloud("world").points) > 0.5
    straight = deskewed(raw.to_point_cloud(coordinates), DRIVE, rig.T_world_camera)
    expected = image.to_point_cloud(coordinates)
    np.testing.assert_allclose(straight.points, expected.points, atol=3e-6)


def test_a_scanner_that_starts_on_its_way_is_placed_there(rig: Rig) -> None:
    """Its track need not be the identity when the scan starts."""
    there = ConstantTwist(velocity_m_s=(0.0, 2.0, 0.0)).at(0.5)
    later = replace(rig, T_world_camera=there @ rig.T_world_camera)

    class Shifted(ConstantTwist):
        type_name = "shifted-for-a-test"

        def poses_at(self, times_s: object) -> np.ndarray:
            return super().poses_at(times_s) @ there  # type: ignore[arg-type]

    straight_on = ConstantTwist(velocity_m_s=(0.0, 15.0, 0.0))
    by_track = moving_scanner(rig, Shifted(velocity_m_s=(0.0, 15.0, 0.0)))
    by_pose = moving_scanner(later, straight_on)
    np.testing.assert_allclose(by_track.T_world_camera, by_pose.T_world_camera)
    for one, other in zip(by_track.camera.pixel_rays()[:2], by_pose.camera.pixel_rays()[:2], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


def test_a_scanner_at_rest_is_the_same_in_motion() -> None:
    """A track that does not move changes no range."""
    scene, sensor = load_scene("corner"), DirectToF(bins=64, bin_s=250e-12)
    still = Rig(HEAD, Beam(), scene.rig().T_world_camera)
    moving = moving_scanner(still, ConstantTwist())
    images = [decode(expose(transport(scene, one, [sensor], spp=4, max_depth=2), sensor)) for one in (still, moving)]
    np.testing.assert_allclose(images[0].range_m, images[1].range_m, atol=1e-6)


# ---- Motion of rig and objects in one call --------------------------------------------------------------------------


def test_motion_of_the_rig_takes_one_pass_with_the_same_bytes(rig: Rig, image: RangeImage) -> None:
    sensor, scene = IdealToF(), load_scene(room())
    timings, motion = {sensor: Timing(start_s=2.0)}, Motion(rig=PoseTrack([2.0, 2.1], [DRIVE.at(0.0), DRIVE.at(0.1)]))
    moving, left = on_its_way(rig, timings, motion)
    assert len(plan(moving, timings, left)) == 1
    signals = transport_moving(scene, rig, timings, motion, spp=1, max_depth=2)[sensor]
    assert signals.motion_m is None
    by_hand = transport(scene, moving_scanner(rig, motion.rig, 2.0), [sensor], spp=1, max_depth=2)  # type: ignore[arg-type]
    found, expected = (decode(expose(one, sensor)) for one in (signals, by_hand))
    np.testing.assert_array_equal(found.range_m, expected.range_m)
    assert off_walls(found.to_point_cloud("world").points) < 2e-3  # the track is a chord of the bend


def passing_ball(y: float) -> dict[str, object]:
    """A wall at x = 6 m, and before it a ball at some place across."""
    import mitsuba as mi

    from rangesim.environment.backend import select_variant

    select_variant()
    wall = mi.ScalarTransform4f().translate([6, 0, 0]).rotate([0, 1, 0], -90).scale(20)
    matte = {"type": "twosided", "b": {"type": "diffuse"}}
    return {
        "type": "scene",
        "wall": {"type": "rectangle", "to_world": wall, "b": matte},
        "ball": {"type": "sphere", "center": [4.0, y, 0.0], "radius": 0.7, "b": matte},
        "sensor": {"type": "perspective", "fov": 40.0, "to_world": mi.ScalarTransform4f().look_at(
            [0, 0, 0], [1, 0, 0], [0, 0, 1])},
    }  # fmt: skip


def test_moving_objects_are_seen_by_each_band_of_columns_at_its_own_time() -> None:
    """A scan of four bands equals the bands of four still scans, each with the ball where it is then."""
    head = Spinning((4.0, 0.0, -4.0), 64, 0.1, first_azimuth_deg=-30.0, arc_deg=60.0)
    rig = Rig(head, Beam((1e-3, 1e-3)), look_at((0, 0, 0), (1, 0, 0)))
    sensor, speed_m_s = IdealToF(), 20.0
    timings = {sensor: Timing(bands=4)}
    motion = Motion({"ball": ConstantTwist(velocity_m_s=(0.0, speed_m_s, 0.0))})
    signals = transport_moving(load_scene(passing_ball(-1.0)), rig, timings, motion, spp=1, max_depth=2)[sensor]
    found = decode(expose(signals, sensor)).range_m
    assert signals.motion_m is not None
    assert signals.motion_m.max() == pytest.approx(0.25)  # the bands of the ball are 12.5 ms from the middle
    for band in range(4):
        y = -1.0 + speed_m_s * 0.1 * (band * 16 + 7.5) / 64
        still = transport(load_scene(passing_ball(y)), rig, [sensor], spp=1, max_depth=2)
        columns = slice(16 * band, 16 * band + 16)
        expected = decode(expose(still, sensor)).range_m[:, columns]
        same = np.abs(found[:, columns] - expected) < 5e-3
        assert same.mean() > 0.95  # the ball's rim may fall either way within a beam
    assert (found < 5.0).any()


@pytest.mark.parametrize(
    ("sensor", "timing", "words"),
    [
        (StructuredLight(), Timing(), "takes all frames in one exposure"),
        (IdealToF(), Timing(line_period_s=1e-3), "rays have times of their own"),
        (IdealToF(), Timing(exposure_s=1e-3, exposure_samples=2), "rays have times of their own"),
    ],
)
def test_timings_that_scans_do_not_have_are_refused(rig: Rig, sensor: Sensor, timing: Timing, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        on_its_way(rig, {sensor: timing}, Motion(rig=DRIVE))
    both = {IdealToF(): Timing(), DirectToF(): Timing(start_s=1.0)}
    with pytest.raises(ValueError, match=r"one start_s .* got 0\.0, 1\.0"):
        on_its_way(rig, both, Motion(rig=DRIVE))


def test_a_part_of_a_scanner_has_its_rays() -> None:
    rays, times = HEAD.pixel_rays(), HEAD.times_s
    part = HEAD.cropped(2, 5, 10, 30)
    np.testing.assert_allclose(part.pixel_rays().directions, rays.directions[2:5, 10:30], atol=1e-15)
    np.testing.assert_array_equal(part.pixel_rays().origins, rays.origins[2:5, 10:30])
    np.testing.assert_allclose(part.pixel_rays().steps, rays.steps[2:5, 10:30], atol=1e-15)
    np.testing.assert_array_equal(part.times_s, times[2:5, 10:30])
    with pytest.raises(ValueError, match="can be cropped, got Orthographic"):
        Orthographic(8, 6, 0.01).cropped(0, 1, 0, 1)


def test_what_cannot_move_with_its_rays_is_refused(rig: Rig, image: RangeImage) -> None:
    flood = Intrinsics.from_fov(4, 4, 90.0)
    with pytest.raises(ValueError, match="got Intrinsics: only a beam"):
        moving_scanner(replace(rig, projector=flood), DRIVE)
    with pytest.raises(ValueError, match="whose rays have times, got Intrinsics"):
        moving_scanner(replace(rig, camera=flood), DRIVE)
    with pytest.raises(ValueError, match="make zones of the moving camera"):
        MovingCamera(Zones(HEAD, 24, 4), np.eye(4)[None])
    with pytest.raises(ValueError, match="of a MovingCamera, got one of Spinning"):
        as_reported(as_reported(image))
