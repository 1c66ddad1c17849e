# SPDX-License-Identifier: Apache-2.0
"""Cameras of any rays: a table of a pinhole's rays equals the pinhole, and each lens has the law of its name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rangesim import (
    AmcwToF,
    DirectToF,
    IdealToF,
    Scene,
    StructuredLight,
    compare,
    decode,
    expose,
    load_scene,
    transport,
)
from rangesim.motion import ConstantTwist, Motion, Timing, moving_scanner, transport_moving
from rangesim.rig import (
    Beam,
    Camera,
    Fisheye,
    Intrinsics,
    Lens,
    MovingCamera,
    Orthographic,
    RayTable,
    Rig,
    Spinning,
    look_at,
)
from rangesim.settings.config import from_dict, to_dict

CAMERAS = [
    Intrinsics.from_fov(8, 6, 60.0),
    Fisheye(8, 6, 3.0, 3.0, 4.0, 3.0, (0.02, -0.003)),
    Orthographic(8, 6, 0.01),
    RayTable(np.random.default_rng(1).normal(size=(3, 5, 3)), field_rad=(2e-3, 1e-3), acceptance="gaussian"),
    Spinning((10.0, 0.0, -5.0), 12, 0.1, origin_m=(0.0, 0.0, 0.016), firing_times_s=(0.0, 1e-5, 2e-5)),
]


@pytest.fixture(scope="module")
def corner() -> Scene:
    return load_scene("corner")


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: type(c).__name__)
def test_a_camera_is_read_back_as_it_was_written(camera: Camera) -> None:
    assert from_dict(Camera, to_dict(camera)) == camera
    rig = Rig(camera, Intrinsics.from_fov(4, 4, 40.0))
    assert Rig.from_dict(to_dict(rig)) == rig


def hollow_ball() -> Scene:
    """A matte ball of 2 m radius around the origin, seen from inside."""
    matte = {"type": "twosided", "b": {"type": "diffuse"}}
    ball = {"type": "sphere", "radius": 2.0, "flip_normals": True, "b": matte}
    return load_scene({"type": "scene", "ball": ball, "sensor": {"type": "perspective", "fov": 40.0}})


def test_files_of_pinholes_have_no_type() -> None:
    assert "type" not in to_dict(CAMERAS[0])


def test_rays_of_a_pinhole_are_those_of_its_directions() -> None:
    camera = Intrinsics(8, 6, 7.0, 8.0, 4.2, 2.9, (-0.2, 0.05, 1e-3, -2e-3))
    rays, directions = camera.pixel_rays(), camera.directions(camera.pixel_centres())
    np.testing.assert_allclose(rays.directions, directions / np.linalg.norm(directions, axis=-1, keepdims=True))
    # The solid angle of an undistorted pixel is cos^3 / (fx fy)
    plain = Intrinsics(8, 6, 70.0, 80.0, 4.0, 3.0)
    cosine = plain.pixel_rays().directions[..., 2]
    np.testing.assert_allclose(Camera.solid_angle_sr(plain), cosine**3 / (70 * 80), rtol=1e-3)


@pytest.mark.parametrize("distortion", [(), (0.02, -0.003, 1e-3, -1e-4)])
def test_fisheye_has_the_law_of_opencv(distortion: tuple[float, ...]) -> None:
    cv2 = pytest.importorskip("cv2")
    camera = Fisheye(200, 160, 60.0, 62.0, 101.0, 79.0, distortion)
    points = np.random.default_rng(0).uniform([-2, -2, 0.3], [2, 2, 2], (50, 3))
    matrix = np.array([[60.0, 0, 101.0 - 0.5], [0, 62.0, 79.0 - 0.5], [0, 0, 1]])  # OpenCV's centres are at integers
    coefficients = np.array((*distortion, 0, 0, 0, 0)[:4], dtype=np.float64)
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)
    np.testing.assert_allclose(camera.project(points), expected[:, 0] + 0.5, atol=1e-9)
    rays = camera.pixel_rays()
    seen = np.isfinite(rays.directions).all(axis=-1)
    np.testing.assert_allclose(camera.project(rays.directions[seen]), camera.pixel_centres()[seen], atol=1e-9)
    assert not seen.all()  # the corners lie beyond 90 degrees


def test_fisheye_sees_beside_and_behind_itself() -> None:
    camera = Fisheye(33, 33, 16.5 / np.pi, 16.5 / np.pi, 16.5, 16.5, max_angle_rad=np.pi)
    room = hollow_ball()
    signals = transport(room, Rig(camera, Intrinsics.from_fov(8, 8, 60.0)), [IdealToF()], spp=4, glint=False)
    rays = camera.pixel_rays().directions
    seen = np.isfinite(rays).all(axis=-1)
    np.testing.assert_allclose(signals.truth.range_m[seen], 2.0, atol=1e-5)
    np.testing.assert_allclose(signals.truth.z[seen], 2.0 * rays[..., 2][seen], atol=1e-5)
    assert not np.isfinite(signals.truth.range_m[~seen]).any()


def test_orthographic_reads_depths_of_parallel_rays() -> None:
    camera = Orthographic(9, 7, 0.02)
    ball_scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 40.0},
            "ball": {"type": "sphere", "center": [0.0, 0.0, 1.0], "radius": 0.3, "b": {"type": "diffuse"}},
        }
    )
    truth = transport(ball_scene, Rig(camera, Intrinsics.from_fov(8, 8, 60.0)), [], spp=1, glint=False).truth
    x, y = np.moveaxis(camera.pixel_rays().origins[..., :2], -1, 0)
    inside = x**2 + y**2 < 0.3**2
    np.testing.assert_allclose(truth.z[inside], (1 - np.sqrt(0.09 - x**2 - y**2))[inside], atol=1e-5)
    np.testing.assert_array_equal(truth.z[inside], truth.range_m[inside])


def test_a_table_of_a_pinhole_equals_the_pinhole(corner: Scene) -> None:
    rig = corner.rig(baseline_m=0.02, width=40, height=30)
    sensor = AmcwToF()
    table = replace(rig, camera=RayTable.of(rig.camera))
    one, other = (
        transport(corner, r, [sensor], spp=64, glint=False, indirect="raw", max_depth=5) for r in (rig, table)
    )
    np.testing.assert_allclose(other.truth.range_m, one.truth.range_m, atol=1e-6)
    np.testing.assert_allclose(other.truth.z, one.truth.z, atol=1e-6)
    np.testing.assert_allclose(other.energy.direct, one.energy.direct, rtol=1e-3)
    assert other.energy.multipath.sum() == pytest.approx(one.energy.multipath.sum(), rel=5e-3)
    images = [decode(expose(s, sensor, None)) for s in (one, other)]
    assert np.nanmedian(np.abs(images[1].range_m - images[0].range_m)) < 1e-3
    points = [image.to_point_cloud("world") for image in images]
    assert np.nanmedian(np.abs(points[1].points - points[0].points)) < 1e-3
    assert np.nanmedian((points[1].normals * points[0].normals).sum(axis=-1)) > 0.99


def test_all_pixels_of_a_detector_get_light_by_their_solid_angle(corner: Scene) -> None:
    """The pixels of a fisheye lens see different solid angles, so an even wall gives them different counts."""
    from rangesim import Detector

    fisheye = Fisheye(21, 21, 14.0, 14.0, 10.5, 10.5)
    rig = Rig(fisheye, Intrinsics.from_fov(8, 8, 90.0))
    illumination, solid_angle = rig.camera_illumination, np.asarray(fisheye.solid_angle_sr())
    np.testing.assert_allclose(illumination, np.nan_to_num(solid_angle / np.nanmax(solid_angle)), rtol=1e-6)
    rate = Detector().electron_rate_per_radiance(rig)
    pinhole = replace(rig, camera=Intrinsics(21, 21, 14.0, 14.0, 10.5, 10.5))
    assert rate == pytest.approx(Detector().electron_rate_per_radiance(pinhole), rel=1e-2)  # alike on the axis


def test_moving_table_equals_still_passes(corner: Scene) -> None:
    """A head that moves while it turns measures what a still head measures at the place of each column."""
    head = Spinning((5.0, -5.0, -15.0), 24, 0.1, arc_deg=120.0, first_azimuth_deg=-60.0, field_rad=(1e-3, 1e-3))
    poses = np.tile(np.eye(4), (24, 1, 1))
    poses[:, :3, 3] = np.unique(head.times_s)[:, None] * [1.0, 0.5, 2.0]
    start = corner.rig().T_world_camera
    sensor = DirectToF(bins=128, bin_s=200e-12, pulse_fwhm_s=400e-12)
    rig = Rig(MovingCamera(head, poses), Beam((1e-3, 1e-3)), start)
    moving = transport(corner, rig, [sensor], spp=16, max_depth=3, glint=False)
    for column in (0, 11, 23):
        still = replace(rig, camera=head, T_world_camera=start @ poses[column])
        signals = transport(corner, still, [sensor], spp=16, max_depth=3, glint=False)
        for name in ("direct", "multipath"):
            np.testing.assert_allclose(
                getattr(moving.energy, name)[:, column], getattr(signals.energy, name)[:, column], rtol=2e-3, atol=1e-9
            )
        np.testing.assert_allclose(moving.truth.range_m[:, column], signals.truth.range_m[:, column], atol=1e-5)
    image = decode(expose(moving, sensor, None))
    points = image.to_point_cloud("world").points
    true = replace(image, range_m=moving.truth.range_m, z=moving.truth.z).to_point_cloud("world").points
    assert np.nanmax(np.linalg.norm(points - true, axis=-1)) < 0.005


def test_readings_of_a_head_that_turns_are_ranges() -> None:
    head = Spinning((5.0, -5.0), 36, 0.1)
    rig, room = Rig(head, Beam()), hollow_ball()
    sensor = IdealToF()
    signals = transport(room, rig, [sensor], spp=4, glint=False)
    image = decode(expose(signals, sensor, None))
    assert (image.z[image.valid] < 0).any()  # behind the head
    comparison = compare(image, signals)
    assert comparison.row("all").median_abs_m < 1e-4
    np.testing.assert_allclose(comparison.error_m, image.range_m - signals.truth.range_m)


def test_what_contradicts_a_camera_is_refused(corner: Scene) -> None:
    head, projector = Spinning((0.0,), 8, 0.1), Intrinsics.from_fov(8, 8, 60.0)
    with pytest.raises(ValueError, match="expected a camera_lens without focus_m"):
        Rig(head, Beam(), camera_lens=Lens(1e-3, focus_m=1.0))
    with pytest.raises(ValueError, match="expected T_camera_projector to be the identity for a beam"):
        Rig(head, Beam(), T_camera_projector=look_at((0.1, 0, 0), (0, 0, 1), (0, -1, 0)))
    with pytest.raises(ValueError, match="expected a beam direction for each of 1 x 8 pixels"):
        Rig(head, Beam(directions=np.ones((1, 7, 3))))
    with pytest.raises(ValueError, match="expected camera to be a Camera"):
        Rig(Beam(), projector)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"directions that are not \(0, 0, 0\)"):
        RayTable(np.zeros((1, 1, 3)))
    with pytest.raises(ValueError, match="expected a pose for each of the camera's 8 times, got 2"):
        MovingCamera(head, np.tile(np.eye(4), (2, 1, 1)))
    sensor = StructuredLight(8, 8)
    rig = Rig(RayTable.of(Intrinsics.from_fov(8, 6, 50.0)), projector, corner.rig().T_world_camera)
    capture = expose(transport(corner, rig, [sensor], spp=1, glint=False), sensor, None)
    with pytest.raises(ValueError, match="expected a pinhole camera"):
        decode(capture)


def sweep() -> Spinning:
    return Spinning((0.0, -3.0, 3.0), 60, 0.1, arc_deg=60.0, first_azimuth_deg=-30.0, field_rad=(1e-3, 1e-3))


def test_a_scanner_reads_a_moving_ball_where_it_is_at_each_ray() -> None:
    """A ball moves sideways while the head turns: each column sees it at the column's own time."""
    scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 40.0},
            "ball": {"type": "sphere", "center": [0.0, 0.0, 4.0], "radius": 0.8, "b": {"type": "diffuse"}},
        }
    )
    head, sensor, speed = sweep(), IdealToF(), 8.0
    rig = Rig(head, Beam((1e-3, 1e-3)))
    motion = Motion({"ball": ConstantTwist(velocity_m_s=(speed, 0.0, 0.0))})
    timing = Timing(bands=60)
    signals = transport_moving(scene, rig, {sensor: timing}, motion, spp=4, glint=False)[sensor]
    rays, times = head.pixel_rays().directions, head.times_s
    centre = np.stack([speed * times, 0 * times, 4 + 0 * times], axis=-1)
    along = (rays * centre).sum(axis=-1)
    inside = 0.8**2 - (centre**2).sum(axis=-1) + along**2
    expected = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.nan)
    clear = np.abs(inside) > 0.02  # away from the rim
    image = decode(expose(signals, sensor, None))
    sure = clear & (inside > 0)
    np.testing.assert_allclose(image.range_m[sure], expected[sure], atol=2e-3)


def test_a_scanner_that_moves_takes_one_pass_and_knows_its_way(corner: Scene) -> None:
    head, sensor = sweep(), IdealToF()
    rig = Rig(head, Beam((1e-3, 1e-3)), corner.rig().T_world_camera)
    track = ConstantTwist(velocity_m_s=(0.0, 2.0, 0.0))
    signals = transport_moving(corner, rig, {sensor: Timing()}, Motion(rig=track), spp=4, glint=False)[sensor]
    whole = transport(corner, moving_scanner(rig, track), [sensor], spp=4, glint=False)
    np.testing.assert_array_equal(signals.energy.direct, whole.energy.direct)
    with pytest.raises(ValueError, match="expected a timing without line_period_s"):
        transport_moving(corner, rig, {sensor: Timing(line_period_s=1e-3)}, Motion(rig=track), spp=4)


def test_a_scanner_that_drives_into_fog_is_refused() -> None:
    fog = {"type": "homogeneous", "albedo": 0.9, "sigma_t": {"type": "spectrum", "value": 2.0}}
    scene = load_scene(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 40.0},
            "bank": {
                "type": "sphere",
                "center": [0.0, 0.0, 3.0],
                "radius": 1.0,
                "b": {"type": "null"},
                "interior": fog,
            },
        }
    )
    rig = Rig(sweep(), Beam((1e-3, 1e-3)))
    transport(scene, rig, [IdealToF()], spp=1)
    with pytest.raises(ValueError, match=r"expected the camera to stand in air, but it is inside the medium of .*bank"):
        transport(scene, moving_scanner(rig, ConstantTwist((0.0, 0.0, 30.0))), [IdealToF()], spp=1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"elevations_deg": (95.0, 1.0)}, "elevations_deg of -90 to 90 degrees, got 95"),
        (
            {"azimuth_offsets_deg": (1.0, 2.0, 3.0)},
            "azimuth_offsets_deg for each of the 2 elevations_deg, or none, got 3",
        ),
        ({"firing_times_s": (0.0,)}, "firing_times_s for each of the 2 elevations_deg, or none, got 1"),
    ],
)
def test_messages_on_a_turning_head_name_its_own_settings(settings: dict[str, tuple[float, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Spinning(**{"elevations_deg": (1.0, -1.0), "columns": 8, **settings})  # type: ignore[arg-type]
