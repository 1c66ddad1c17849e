# SPDX-License-Identifier: Apache-2.0
"""Range images become clouds that Open3D reads back, with normals that keep edges sharp."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter
from synthetic import plane_depth, plane_signals, signals_of_depth, stereo_rig

import pcgraph
from rangesim.capture.exposure import expose
from rangesim.decoding import decode
from rangesim.decoding.range_image import RangeImage
from rangesim.electronics.detector import Detector
from rangesim.point_cloud import PointCloud, organised_cloud
from rangesim.rig import Rig, Spinning, look_at
from rangesim.sensors import IdealToF, StructuredLight


def range_image(rig: Rig, z: np.ndarray) -> RangeImage:
    return decode(expose(signals_of_depth(rig, z, [IdealToF()]), IdealToF()))


def test_points_of_a_plane_lie_on_it_and_have_its_normal() -> None:
    rig = stereo_rig()
    cloud = range_image(rig, plane_depth(rig)).to_point_cloud()
    normal = np.array([0.2, 0.1, -1.0]) / np.linalg.norm([0.2, 0.1, -1.0])
    assert cloud.normals is not None
    inside = cloud.valid
    assert inside.mean() > 0.9
    np.testing.assert_allclose(cloud.points[inside] @ normal, normal[2] * 1.0, atol=1e-5)
    np.testing.assert_allclose(cloud.normals[inside] @ normal, 1, atol=1e-5)


def test_world_frame_is_the_camera_frame_moved() -> None:
    rig = dataclasses.replace(stereo_rig(), T_world_camera=look_at((1.0, 2.0, 3.0), (0.0, 0.0, 0.0)))
    image = range_image(rig, plane_depth(rig))
    camera, world = image.to_point_cloud("camera"), image.to_point_cloud("world")
    rotation, origin = rig.T_world_camera[:3, :3], rig.T_world_camera[:3, 3]
    np.testing.assert_allclose(world.points, camera.points @ rotation.T + origin, atol=1e-5)
    assert world.normals is not None
    towards = np.einsum("...i,...i", world.normals, origin - world.points)[world.valid]
    assert (towards > 0).all()
    assert world.coordinates == "world"


def test_normals_do_not_round_off_a_depth_edge() -> None:
    rig = stereo_rig()
    near = plane_depth(rig, 0.8, (0.2, 0.1, -1.0))
    far = plane_depth(rig, 1.0, (-0.3, 0.1, -1.0))
    left = np.arange(near.shape[1])[None, :] < 80
    cloud = range_image(rig, np.where(left, near, far)).to_point_cloud()
    assert cloud.normals is not None
    for mask, normal in ((left, (0.2, 0.1, -1.0)), (~left, (-0.3, 0.1, -1.0))):
        inside = cloud.valid & mask
        unit = np.asarray(normal) / np.linalg.norm(normal)
        assert (cloud.normals[inside] @ unit > 0.99999).all()


@pytest.mark.parametrize(
    "head",
    [
        Spinning(tuple(np.linspace(16, -16, 32).tolist()), 512, azimuth_offsets_deg=(3.2, 1.1, -1.1, -3.2) * 8),
        Spinning((-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15), 900),
    ],
    ids=["beams that lead", "odd firing order"],
)
def test_normals_of_scanners_follow_their_rays_not_their_rows(head: Spinning) -> None:
    """In a closed room, normals are those of its walls, but for the rays beside an edge of it."""
    half_m, directions = np.array([5.0, 2.0, 7.0]), head.pixel_rays().directions
    distances = half_m / np.maximum(np.abs(directions), 1e-12)
    ranges, wall = distances.min(axis=-1), distances.argmin(axis=-1)
    one = np.ones(ranges.shape, dtype=np.float32)
    normals = organised_cloud(ranges.astype(np.float32), head, np.eye(4), one, one).normals
    assert normals is not None
    expected = -np.sign(directions) * np.eye(3)[wall]
    off = np.degrees(np.arccos(np.clip(np.sum(normals * expected, axis=-1), -1, 1)))
    side = np.sign(np.take_along_axis(directions, wall[..., None], axis=-1)[..., 0]) * (1 + wall)
    laid_out = side.ravel()[head.lattice]
    inside = np.empty(side.shape, dtype=bool)  # whether all rays around see the same wall
    inside.ravel()[head.lattice] = minimum_filter(laid_out, 5) == maximum_filter(laid_out, 5)
    assert inside.mean() > 0.2
    assert np.isfinite(off[inside]).all()
    assert np.nanmax(off[inside]) < 0.2
    assert (off > 30).mean() < 0.08


def test_a_point_without_neighbours_has_no_normal_and_its_file_no_nan(tmp_path: Path) -> None:
    rig = stereo_rig()
    z = np.full((120, 160), np.nan)
    z[20:40, 20:40], z[80, 80] = 1.0, 1.0
    cloud = range_image(rig, z).to_point_cloud()
    assert cloud.normals is not None
    assert np.isnan(cloud.normals[80, 80]).all()
    cloud.save(tmp_path / "cloud.ply")
    normals = pcgraph.read_cloud(tmp_path / "cloud.ply").normals
    assert normals is not None
    assert np.isfinite(normals).all()
    assert (np.linalg.norm(normals, axis=1) < 0.5).sum() == 1


def test_noise_and_holes_leave_unit_normals_or_nan() -> None:
    rig, sensor = stereo_rig(), StructuredLight()
    image = decode(expose(plane_signals(rig, sensor), sensor, Detector()))
    cloud = image.to_point_cloud()
    assert cloud.normals is not None
    length = np.linalg.norm(cloud.normals, axis=-1)
    known = np.isfinite(length)
    np.testing.assert_allclose(length[known], 1, atol=1e-5)
    assert not known[~cloud.valid].any()
    assert known[cloud.valid].mean() > 0.99
    normal = np.array([0.2, 0.1, -1.0]) / np.linalg.norm([0.2, 0.1, -1.0])
    assert np.median(cloud.normals[known] @ normal) > np.cos(np.radians(6))


@pytest.fixture
def cloud() -> PointCloud:
    rig = stereo_rig(40, 30)
    z = plane_depth(rig)
    z[5:9, 10:20] = np.nan
    return range_image(rig, z).to_point_cloud("world")


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_pcgraph_reads_the_files(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    cloud.save(tmp_path / f"cloud{suffix}")
    loaded = pcgraph.read_cloud(tmp_path / f"cloud{suffix}")
    expected = cloud if suffix == ".pcd" else cloud.finite()
    np.testing.assert_array_equal(loaded.points, expected.points)
    np.testing.assert_array_equal(loaded.normals, expected.normals)
    np.testing.assert_array_equal(loaded.colors, expected.colors)
    assert [p.name for p in tmp_path.iterdir()] == [f"cloud{suffix}"]


def scanned(cloud: PointCloud) -> PointCloud:
    """The cloud with what a scanner tells of each point."""
    rows, columns = np.indices(cloud.points.shape[:-1])
    return dataclasses.replace(
        cloud,
        time_s=1e-6 * columns + 1 / 3,
        ring=(60_000 + rows).astype(np.uint16),
        return_number=(1 + columns % 2).astype(np.uint8),
    )


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_files_keep_time_ring_and_return(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    scan = scanned(cloud)
    scan.save(tmp_path / f"cloud{suffix}")
    loaded = pcgraph.read_cloud(tmp_path / f"cloud{suffix}")
    expected = scan if suffix == ".pcd" else scan.finite()
    np.testing.assert_array_equal(loaded.columns["time"], expected.time_s)
    np.testing.assert_array_equal(loaded.columns["ring"], expected.ring)
    np.testing.assert_array_equal(loaded.columns["return_number"], expected.return_number)
    np.testing.assert_array_equal(loaded.points, expected.points)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_open3d_reads_ring_and_time(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    o3d = pytest.importorskip("open3d")
    scan = scanned(cloud)
    scan.save(tmp_path / f"cloud{suffix}")
    read = {k: v.numpy() for k, v in o3d.t.io.read_point_cloud(str(tmp_path / f"cloud{suffix}")).point.items()}
    keep = np.isfinite(read["positions"]).all(axis=1)
    for name, expected in (("time", scan.time_s), ("ring", scan.ring), ("return_number", scan.return_number)):
        assert expected is not None
        np.testing.assert_array_equal(read[name][keep].ravel(), expected[scan.valid])


@pytest.mark.parametrize(("suffix", "digest"), [(".ply", "1f5431e32571e834"), (".pcd", "7ff7ee653a6226af")])
def test_files_of_clouds_that_no_scanner_made_keep_their_bytes(tmp_path: Path, suffix: str, digest: str) -> None:
    rows, columns = np.indices((3, 4))
    points = np.stack([columns, rows, 1 + 0 * rows], axis=-1).astype(np.float32)
    PointCloud(points, intensity=points[..., 0]).save(tmp_path / f"cloud{suffix}")
    assert hashlib.sha256((tmp_path / f"cloud{suffix}").read_bytes()).hexdigest()[:16] == digest


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_open3d_reads_the_files(tmp_path: Path, cloud: PointCloud, suffix: str) -> None:
    o3d = pytest.importorskip("open3d")
    path = str(tmp_path / f"cloud{suffix}")
    cloud.save(path)
    finite = cloud.finite()
    read = {name: value.numpy() for name, value in o3d.t.io.read_point_cloud(path).point.items()}
    keep = np.isfinite(read["positions"]).all(axis=1)
    assert len(keep) == (cloud.valid.size if suffix == ".pcd" else len(finite.points))
    np.testing.assert_array_equal(read["positions"][keep], finite.points)
    np.testing.assert_array_equal(read["normals"][keep], finite.normals)
    np.testing.assert_array_equal(read["colors"][keep], finite.colors)
    np.testing.assert_array_equal(read["intensity"][keep].ravel(), finite.intensity)
    np.testing.assert_array_equal(read["confidence"][keep].ravel(), finite.confidence)
    legacy = o3d.io.read_point_cloud(path, remove_nan_points=True)
    np.testing.assert_allclose(np.asarray(legacy.points), finite.points)
    np.testing.assert_allclose(np.asarray(legacy.colors), np.asarray(finite.colors) / 255, atol=1e-6)


def test_bad_clouds_are_refused(tmp_path: Path, cloud: PointCloud) -> None:
    nothing = PointCloud(np.full((4, 5, 3), np.nan, np.float32))
    for name in ("a.ply", "a.pcd"):
        with pytest.raises(ValueError, match="at least one finite point"):
            nothing.save(tmp_path / name)
    with pytest.raises(ValueError, match=r"\.ply or \.pcd"):
        cloud.save(tmp_path / "a.obj")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="shape"):
        PointCloud(np.zeros((4, 2), np.float32))
    with pytest.raises(ValueError, match="normals"):
        PointCloud(np.zeros((4, 3), np.float32), normals=np.zeros((5, 3), np.float32))
    with pytest.raises(ValueError, match="coordinates"):
        PointCloud(np.zeros((4, 3), np.float32), coordinates="table")
    with pytest.raises(ValueError, match=r"ring of shape .* and type uint16"):
        PointCloud(np.zeros((4, 3), np.float32), ring=np.zeros(4, np.int64))
    with pytest.raises(ValueError, match="time_s"):
        PointCloud(np.zeros((4, 3), np.float32), time_s=np.zeros((4, 3)))


def test_uncalibrated_images_have_no_points() -> None:
    rig = stereo_rig(40, 30)
    image = dataclasses.replace(range_image(rig, plane_depth(rig)), camera=None)
    with pytest.raises(ValueError, match="calibrated"):
        image.to_point_cloud()


def test_open3d_gets_the_finite_points(cloud: PointCloud) -> None:
    ours, theirs = cloud.finite(), cloud.to_open3d()
    np.testing.assert_allclose(np.asarray(theirs.points), ours.points)
    np.testing.assert_allclose(np.asarray(theirs.normals), ours.normals)
    np.testing.assert_allclose(np.asarray(theirs.colors), np.asarray(ours.colors) / 255)
