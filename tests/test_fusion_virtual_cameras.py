# SPDX-License-Identifier: Apache-2.0
"""Range images of scanners, fisheyes and rosettes as depth images: exact on planes, no surface across edges, and fused
and registered like those of pinhole cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from tiers import to_validate

from rangesim import IdealToF, RangeImage, Status
from rangesim.experiment import ScanSettings
from rangesim.experiment.camera_paths import PoseList
from rangesim.fusion import (
    Scan,
    VoxelGrid,
    align,
    fuse,
    occupancy,
    pinhole_views,
    pose_errors,
    refine_jointly,
    signed_distance,
    surface_error,
)
from rangesim.fusion.mesh_error import raycasting_scene
from rangesim.instrument.instrument import Instrument
from rangesim.pipeline.scan_run import run_scan
from rangesim.rig import Beam, Camera, Fisheye, Intrinsics, Lissajous, Orthographic, RayTable, Risley, Spinning, look_at
from rangesim.triangle_mesh import TriangleMesh

HALF_M = np.array([3.0, 1.5, 5.0])
"""Half of the edges of a room around the origin, metres."""
HEAD = Spinning(tuple(np.linspace(20.0, -20.0, 32)), columns=512, origin_m=(0.0, 0.0, 0.016))
FISHEYE = Fisheye(300, 300, 95.0, 95.0, 150.0, 150.0)
LISSAJOUS = Lissajous(100, 200, fast_hz=20_000.0, slow_hz=173.3, amplitudes_deg=(35.0, 27.0), duration_s=0.03)
ROSETTE = Risley(100, 200, deflections_deg=(9.0, 9.0), rates_hz=(121.6, -77.8), duration_s=0.1)


def seen(mesh: TriangleMesh, camera: Camera, T: np.ndarray | None = None) -> RangeImage:
    """What a camera without errors reads of a mesh, by ray casting."""
    import open3d as o3d

    T = np.eye(4) if T is None else T
    scene, middle = raycasting_scene(mesh)
    rays = camera.rays
    starts = rays.origins @ T[:3, :3].T + T[:3, 3] - middle
    both = np.nan_to_num(np.concatenate([starts, rays.directions @ T[:3, :3].T], axis=-1))
    range_m = scene.cast_rays(o3d.core.Tensor(both.astype(np.float32)))["t_hit"].numpy()
    reads = np.isfinite(range_m) & np.isfinite(rays.directions[..., 0])
    range_m = np.where(reads, range_m, np.float32(np.nan))
    z = camera.z_of(range_m).astype(np.float32)
    status = np.where(reads, Status.OK, Status.LOW_SIGNAL).astype(np.uint8)
    return RangeImage(z, range_m, 0.5 * np.ones_like(z), status, np.ones_like(z), camera, T)


def room() -> TriangleMesh:
    made = trimesh.creation.box(extents=2 * HALF_M)
    return TriangleMesh(made.vertices, made.faces)


def furnished() -> TriangleMesh:
    """A room with things of different shapes, so that no part of it looks like another."""
    boxes = [
        ((1.0, 1.2, 0.6), (-2.0, 0.9, 3.5)),
        ((0.5, 2.0, 1.5), (2.5, 0.5, 1.0)),
        ((1.5, 0.5, 0.8), (1.0, 1.25, -3)),
    ]
    made = [trimesh.creation.box(extents=s, transform=trimesh.transformations.translation_matrix(c)) for s, c in boxes]
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.6)
    ball.apply_translation((-1.8, 0.9, -2.0))
    return TriangleMesh.joined([room(), *(TriangleMesh(m.vertices, m.faces) for m in [*made, ball])])


def points_of(image: RangeImage) -> np.ndarray:
    cloud = image.to_point_cloud("world").points.reshape(-1, 3).astype(np.float64)
    return cloud[np.isfinite(cloud).all(axis=-1)]


@pytest.mark.parametrize("camera", [HEAD, FISHEYE, *to_validate(LISSAJOUS, ROSETTE)], ids=lambda c: type(c).__name__)
def test_planes_are_exact_and_the_whole_field_is_covered(camera: Camera) -> None:
    """The depth between readings is that of the plane through them, to the rounding of single precision."""
    views = pinhole_views(seen(room(), camera))
    points = np.concatenate([points_of(v) for v in views])
    off = np.abs(np.abs(points) - HALF_M)
    on_one_wall = np.sort(off, axis=-1)[:, 1] > 0.8  # away from the edges of the room, which triangles cut off
    error_m = np.abs(off.min(axis=-1)[on_one_wall])
    assert np.quantile(error_m, 0.999) < 2e-5
    assert error_m.max() < 1e-3  # in the narrowest triangles
    directions = points / np.linalg.norm(points, axis=-1)[:, None]
    rays = camera.rays.directions[np.isfinite(camera.rays.directions).all(axis=-1)]
    hit = trimesh.points.PointCloud(directions).kdtree.query(rays)[0]
    assert np.quantile(hit, 0.99) < np.radians(2.0)


def test_a_pinhole_is_itself() -> None:
    image = seen(room(), Intrinsics.from_fov(32, 24, 60.0))
    (view,) = pinhole_views(image)
    assert view.z is image.z
    assert view.camera is image.camera
    np.testing.assert_array_equal(view.T_world_camera, image.T_world_camera)


@pytest.mark.parametrize("sigma_m", [0.0, 0.03])
def test_no_surface_across_the_edge_of_an_object_but_on_the_ground(sigma_m: float) -> None:
    """A head 1.5 m above the ground, with rings 2 degrees apart, and a board 1 m before a wall.

    The noise of a real head is as large as the distance between readings of a ring.
    """
    head = Spinning(tuple(np.arange(-20.0, 21.0, 2.0)), columns=720)
    place = trimesh.transformations.translation_matrix((0, 0, 4))
    board = trimesh.creation.box(extents=(1.5, 1.5, 0.01), transform=place)
    image = seen(TriangleMesh.joined([room(), TriangleMesh(board.vertices, board.faces)]), head)
    range_m = image.range_m + np.random.default_rng(0).normal(0, sigma_m, image.range_m.shape).astype(np.float32)
    noisy = replace(image, range_m=range_m, z=head.z_of(range_m).astype(np.float32))
    views = pinhole_views(noisy)
    points = np.concatenate([points_of(v) for v in views])
    between = (np.abs(points[:, 0]) < 1.2) & (points[:, 2] > 4.2) & (points[:, 2] < 4.8) & (np.abs(points[:, 1]) < 1.3)
    assert not between.any()
    has_depth = [v.valid[far_ground(v)] for v in views]
    assert np.concatenate(has_depth).mean() > 0.8  # where rings are 0.6 m apart; the rest is beside the board and walls


def far_ground(view: RangeImage) -> np.ndarray:
    """Pixels that see the ground between 4.6 m and the walls, beside the shadow of the board."""
    T = np.asarray(view.T_world_camera)
    rays = view.pinhole.directions(view.pinhole.pixel_centres()) @ T[:3, :3].T
    x, z = (rays[..., k] * 1.5 / np.where(rays[..., 1] > 0, rays[..., 1], np.nan) for k in (0, 2))
    in_shadow = (np.abs(x) < 2) & (z > 3)
    return np.asarray((np.abs(x) < 2.8) & (np.abs(z) < 4.8) & (np.hypot(x, z) > 4.6) & ~in_shadow)


def test_failed_pixels_stay_holes() -> None:
    image = seen(room(), HEAD)
    hole = (slice(12, 20), slice(100, 120))
    for array, value in ((image.z, np.nan), (image.range_m, np.nan), (image.status, Status.SATURATED)):
        array[hole] = value
    points = np.concatenate([points_of(v) for v in pinhole_views(image)])
    lost = HEAD.rays.directions[13:19, 102:118].reshape(-1, 3)
    directions = points / np.linalg.norm(points, axis=-1)[:, None]
    assert (directions @ lost.T).max() < np.cos(np.radians(0.5))


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (Orthographic(40, 30, 0.02), "expected rays from one place, .* origins up to"),
        (Spinning((0.0,), columns=90), "expected rays that do not all lie in one plane"),
    ],
)
def test_cameras_without_one_centre_or_with_one_ring_are_refused(camera: Camera, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pinhole_views(seen(room(), camera))


def test_readings_that_are_no_neighbours_are_no_views() -> None:
    image = seen(room(), HEAD)
    lost = np.ones(image.z.shape, np.bool_)
    lost[::8, ::8] = False
    image.status[lost], image.z[lost], image.range_m[lost] = Status.LOW_SIGNAL, np.nan, np.nan
    assert pinhole_views(image) == ()


def test_no_readings_are_no_views_and_fuse_says_so() -> None:
    image = seen(room(), HEAD)
    image.status[:], image.z[:], image.range_m[:] = Status.LOW_SIGNAL, np.nan, np.nan
    assert pinhole_views(image) == ()
    with pytest.raises(ValueError, match="expected views with readings"):
        fuse([image], 0.05)
    with pytest.raises(ValueError, match="pinhole camera"):
        signed_distance([[0.0, 0.0, 1.0]], image)


@pytest.mark.parametrize("camera", [HEAD, *to_validate(FISHEYE)], ids=lambda c: type(c).__name__)
def test_fused_views_are_the_room(camera: Camera) -> None:
    poses = [look_at((x, 0.2 * x, z), (x + 0.3 * x, 0.2 * x, z + 1)) for x, z in ((-1.0, 0.5), (0.8, -1.0), (0.2, 1.5))]
    images = [seen(furnished(), camera, T) for T in poses]
    fused = fuse(images, voxel_m=0.05)
    error = surface_error(fused.mesh, furnished(), threshold_m=0.05)
    assert error.accuracy_m < 0.01
    assert error.precision > 0.95
    grid = VoxelGrid.around(furnished().vertices, 0.25)
    found = occupancy(images, {"room": furnished()}, grid)
    middle = np.array(found.states.shape) // 2
    assert found.states[tuple(middle)] == 1  # FREE


def test_poses_of_a_head_that_are_nearly_known_are_refined() -> None:
    """Two places, of which the second is off by a degree and 2 cm."""
    head = Spinning(tuple(np.linspace(35.0, -35.0, 32)), columns=256)
    poses = np.stack([look_at((x, 0.0, x), (x + 0.3, 0.1, x + 1)) for x in (0.0, 0.4)])
    first = poses.copy()
    first[1, :3, :3] = Rotation.from_euler("y", 1.0, degrees=True).as_matrix() @ first[1, :3, :3]
    first[1, 0, 3] += 0.02
    found = refine_jointly([seen(furnished(), head, T) for T in poses], first, reach_m=0.2)
    errors = pose_errors(found, poses)
    assert errors.angle_deg.max() < 0.1
    assert errors.centre_m.max() < 0.005


@pytest.mark.validation
def test_views_of_a_head_are_registered() -> None:
    """Four places in a furnished room, no pose known: the clouds fit to a tenth of a degree."""
    head = Spinning(tuple(np.linspace(35.0, -35.0, 64)), columns=512)
    poses = np.stack([look_at((x, 0.1 * x, z), (x + 0.2, 0.1 * x, z + 1)) for x, z in ((-1, 0.5), (0, 0), (0.7, -0.6))])
    scan = Scan(tuple(seen(furnished(), head, T) for T in poses))
    found = align(scan.with_poses(np.stack([poses[0]] * 3)))
    errors = pose_errors(found.poses, poses)
    assert errors.angle_deg.max() < 0.1
    assert errors.centre_m.max() < 0.01


def test_a_scanner_scans_a_scene_and_its_report_is_written(tmp_path) -> None:  # type: ignore[no-untyped-def]
    head = Spinning(tuple(np.linspace(20.0, -25.0, 24)), 96, arc_deg=90.0, first_azimuth_deg=-45.0)
    poses = PoseList(np.stack([look_at((x, 0.0, 2.0), (0.0, 0.0, 0.0), (0, 1, 0)) for x in (-0.3, 0.3)]))
    settings = ScanSettings(
        "corner", path=poses, instrument=Instrument("head", IdealToF(), camera=head, projector=Beam()), spp=4
    )
    result = run_scan(settings, tmp_path / "scan")
    assert len(result.fused.mesh.faces) > 100
    assert (tmp_path / "scan" / "report.html").stat().st_size > 10_000


def test_a_table_of_the_same_rays_gives_the_same_views() -> None:
    ours, tables = (pinhole_views(seen(room(), camera)) for camera in (HEAD, RayTable.of(HEAD)))
    np.testing.assert_array_equal(ours[0].z, tables[0].z)
