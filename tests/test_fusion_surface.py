# SPDX-License-Identifier: Apache-2.0
"""Signed distances, their average and the mesh of it: against the formula, closed forms and a plain reference."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fusion_scenes import CAMERA, ball, block, mesh_depth, part, range_image, sphere_depth

from rangesim.decoding.range_image import RangeImage
from rangesim.errors import AlignmentWarning
from rangesim.fusion import (
    Scan,
    VoxelGrid,
    average_signed_distances,
    fuse,
    reading_weights,
    signed_distance,
    surface_error,
)
from rangesim.fusion.mesh_error import distances_to
from rangesim.fusion.sdf import depth_at, relative_weights
from rangesim.rig import Intrinsics, look_at, translation
from rangesim.triangle_mesh import TriangleMesh

RADIUS = 0.05


def plane(slant: float = 0.0, d: float = 0.5) -> RangeImage:
    """A plane z = d + slant x, as depths per pixel."""
    rays = CAMERA.directions(CAMERA.pixel_centres())
    return range_image(d / (1 - slant * rays[..., 0]))


def around(n: int, distance: float = 0.3) -> list[np.ndarray]:
    """Poses on a circle that look at the origin from 35 degrees above, every other one from below."""
    angles = 2 * np.pi * np.arange(n) / n
    eyes = [
        distance * np.array([np.cos(a), np.sin(a), 0.7 * (-1) ** k]) / np.hypot(1, 0.7) for k, a in enumerate(angles)
    ]
    return [look_at(eye, (0, 0, 0)) for eye in eyes]


def views(n: int = 12, noise_m: float = 0.0, seed: int = 0) -> list[RangeImage]:
    random = np.random.default_rng(seed)
    depths = [(sphere_depth(CAMERA, T, (0, 0, 0), RADIUS), T) for T in around(n)]
    return [range_image(z + random.normal(0, noise_m, z.shape), T) for z, T in depths]


# ---- sdf(X) = (P X)_3 - d([P X]) ---------------------------------------------------------------------------------


def test_the_signed_distance_is_negative_in_front_and_positive_behind() -> None:
    X = np.array([[0, 0, 0.4], [0, 0, 0.5], [0, 0, 0.62], [0.03, -0.02, 0.45]])
    assert signed_distance(X, plane()) == pytest.approx([-0.1, 0.0, 0.12, -0.05], abs=1e-7)


def test_the_signed_distance_reads_the_pixel_that_the_point_falls_in() -> None:
    z = np.arange(72 * 96, dtype=float).reshape(72, 96) / 1e5 + 0.5
    T = look_at((0.3, -0.2, 0.1), (0, 0, 0))
    local = CAMERA.directions(np.array([[10.99, 20.01], [11.0, 20.01]])) * 0.45
    found = signed_distance(local @ T[:3, :3].T + T[:3, 3], range_image(z, T))
    assert found == pytest.approx([0.45 - z[20, 10], 0.45 - z[20, 11]], abs=1e-6)


def test_there_is_no_signed_distance_where_a_view_has_no_reading() -> None:
    z = np.full((72, 96), 0.5)
    z[36, 48] = np.nan
    X = [[0.001, 0.001, 0.5], [0, 0, -0.5], [1, 0, 0.5], [0, 0, 0]]  # failed pixel, behind, outside, the centre itself
    assert np.isnan(signed_distance(X, range_image(z))).all()


def test_lens_distortion_moves_the_pixel_that_is_read() -> None:
    camera = replace(CAMERA, distortion=(-0.2, 0.05, 1e-3, -2e-3))
    image = range_image(sphere_depth(camera, np.eye(4), (0.02, 0.01, 0.3), RADIUS), camera=camera)
    points = image.to_point_cloud().points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    assert np.abs(signed_distance(points, image)).max() < 1e-6


def test_bilinear_depth_is_exact_on_planes() -> None:
    image, pixels = plane(0.7), np.random.default_rng(0).uniform([1, 1], [95, 71], (500, 2))
    exact = 0.5 / (1 - 0.7 * CAMERA.directions(pixels)[:, 0])
    assert depth_at(pixels, image.z, "bilinear") == pytest.approx(exact, rel=2e-7)
    assert np.abs(depth_at(pixels, image.z) - exact).max() > 1e-3


def test_bilinear_depth_does_not_mix_two_surfaces() -> None:
    z = np.where(np.arange(96) < 48, 0.5, 0.6) * np.ones((72, 1))
    assert set(depth_at(np.array([[47.8, 30.0], [48.2, 30.0]]), z, "bilinear")) == {0.5, 0.6}


# ---- The average -------------------------------------------------------------------------------------------------


def test_the_average_follows_the_formula_on_two_hand_made_views() -> None:
    """Planes at 0.50 and 0.52 m, the first of a third of the confidence: D = (w1 s1 + w2 s2) / (w1 + w2)."""
    first, second = plane(), plane(d=0.52)
    first = replace(first, confidence=second.confidence / 3 * np.float32(0.5**2 / 0.52**2))
    w1, w2 = (w[36, 48] for w in relative_weights([first, second], "confidence"))
    assert w2 == 1  # at most
    assert w1 == pytest.approx(0.5, rel=0.1)  # 1/3 and 1, over the median of about 2/3
    grid = VoxelGrid((1, 1, 5), 0.01, (-0.005, -0.005, 0.475))  # centres at 0.48, 0.49, ... 0.52
    D, w = average_signed_distances([first, second], grid, 0.03)
    z = np.array([0.48, 0.49, 0.50, 0.51, 0.52])
    first_weight = np.minimum(1, (0.03 - (z - 0.5)) / 0.02)  # 1, 1, 1, 1, 0.5: the last is two voxels behind
    first_weight *= w1
    expected = (first_weight * np.maximum(-0.03, z - 0.5) + np.maximum(-0.03, z - 0.52)) / (first_weight + 1)
    assert D[0, 0] == pytest.approx(expected, abs=1e-6)
    assert w[0, 0] == pytest.approx(first_weight + 1)


def test_what_lies_behind_a_view_by_more_than_the_truncation_is_hidden_to_it() -> None:
    grid = VoxelGrid((1, 1, 2), 0.01, (-0.005, -0.005, 0.525))  # 0.53 and 0.54
    D, w = average_signed_distances([plane()], grid, 0.035)
    assert D[0, 0, 0] == pytest.approx(0.03, abs=1e-6)
    assert w[0, 0, 1] == 0
    assert np.isnan(D[0, 0, 1])


def test_a_view_that_looks_through_a_ghost_outvotes_it() -> None:
    ghost, through = plane(d=0.4), plane(d=0.6)
    grid = VoxelGrid((1, 1, 1), 0.01, (-0.005, -0.005, 0.4))
    alone, _ = average_signed_distances([ghost], grid, 0.02, weights="uniform")
    both, _ = average_signed_distances([ghost, through, through], grid, 0.02, weights="uniform")
    assert alone[0, 0, 0] > 0 > both[0, 0, 0]


def test_weights_grow_with_confidence_and_fall_with_slant_and_distance() -> None:
    straight, middle = plane(), (36, 48)
    weight = reading_weights(straight)[middle]
    bright = replace(straight, confidence=2 * straight.confidence)
    assert reading_weights(bright)[middle] == pytest.approx(2 * weight)
    assert reading_weights(plane(d=1.0))[middle] == pytest.approx(weight / 4, rel=1e-5)
    slanted = np.tan(np.radians(60))
    assert reading_weights(plane(slanted))[middle] == pytest.approx(weight / 2, rel=0.02)


def test_single_readings_weigh_nothing() -> None:
    z = np.full((72, 96), np.nan)
    z[10, 10] = 0.5
    z[40:50, 40:50] = 0.5
    weight = reading_weights(range_image(z))
    assert weight[10, 10] == 0
    assert (weight[40:50, 40:50] > 0).all()
    assert reading_weights(range_image(z), "uniform")[10, 10] == 1


# ---- fuse --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", ["confidence", "uniform"])
@pytest.mark.parametrize("lookup", ["nearest", "bilinear"])
def test_sparse_blocks_hold_what_the_plain_reference_says(weights: Any, lookup: Any) -> None:
    """The mesh lies where the reference average is zero."""
    T = np.linalg.inv(look_at((0.31, 0.02, 0.2), (0.003, 0.001, 0)))  # so that no voxel projects between two pixels
    images = [replace(image, T_world_camera=T @ image.T_world_camera) for image in views(6, 2e-4)]
    fused = fuse(images, 4e-3, weights=weights, lookup=lookup, min_weight=0.5)
    grid = VoxelGrid.around(fused.mesh.vertices, 4e-3, 0.012)
    corner = np.round(np.array(grid.corner_m) / 4e-3) * 4e-3 - 2e-3  # centres at whole voxels, as those of the blocks
    grid = replace(grid, corner_m=tuple(map(float, corner)))
    reference, _ = average_signed_distances(images, grid, 0.012, weights=weights, lookup=lookup)
    # A vertex lies on the edge between two voxels, whose averages are linear along it
    place = (fused.mesh.vertices - corner) / 4e-3 - 0.5
    axis, rows = np.abs(place - np.rint(place)).argmax(axis=1), np.arange(len(place))
    low, s = np.rint(place).astype(int), place[rows, axis] - np.floor(place[rows, axis])
    low[rows, axis] = np.floor(place[rows, axis])
    high = low + np.eye(3, dtype=int)[axis]
    at_vertex = (1 - s) * reference[tuple(low.T)] + s * reference[tuple(high.T)]
    assert len(place) > 2000
    assert np.percentile(np.abs(at_vertex), 99) < 1e-6
    assert np.abs(at_vertex).max() < 1e-3  # rounding puts a few projections in another pixel


@pytest.mark.parametrize("truncation_voxels", [1, 3, 5])
@pytest.mark.parametrize("slant", [0.0, 0.4])
@pytest.mark.parametrize("weights", ["confidence", "uniform"])
def test_without_a_least_weight_one_plane_is_one_sheet(weights: Any, slant: float, truncation_voxels: int) -> None:
    """Voxels that nobody saw are not surface: there was a second sheet at the truncation distance behind it."""
    view, truncation_m = plane(slant, 0.501), 4e-3 * truncation_voxels
    fused = fuse([view], 4e-3, weights=weights, min_weight=0, truncation_m=truncation_m)
    x, _, z = fused.mesh.vertices.T
    off_m = (z - 0.501 - slant * x) / np.hypot(1, slant)
    assert len(z) > 2000
    assert np.abs(off_m).max() < 1e-3
    strict = fuse([view], 4e-3, weights=weights, min_weight=1e-6, truncation_m=truncation_m)
    assert fused.mesh.face_areas_m2.sum() == pytest.approx(strict.mesh.face_areas_m2.sum(), rel=0.01)
    assert fused.vertex_weights.min() > 0


def test_without_a_least_weight_a_sphere_is_one_sheet() -> None:
    off = np.linalg.norm(fuse(views(6), 2e-3, min_weight=0).mesh.vertices, axis=1) - RADIUS
    assert np.abs(off).max() < 6e-3  # no view says anything deeper
    assert np.percentile(np.abs(off), 95) < 1e-3


def test_a_sphere_is_fused_to_a_sphere() -> None:
    fused = fuse(views(12), 2e-3)
    off = np.linalg.norm(fused.mesh.vertices, axis=1) - RADIUS
    assert np.abs(off).max() < 7e-4
    assert np.abs(off.mean()) < 2e-5
    assert fused.mesh.area_m2 == pytest.approx(4 * np.pi * RADIUS**2, rel=0.01)
    assert fused.mesh.volume_m3 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)  # normals point outward
    assert fused.vertex_weights.shape == (len(fused.mesh.vertices),)
    assert (fused.vertex_weights > 0).all()


def test_averaging_takes_noise_away() -> None:
    """Of n views of a place the noise is a root of n less; here about four see each, and pixels are averaged too."""
    noisy = views(12, 1e-3)
    points = noisy[0].to_point_cloud("world").finite().points.astype(np.float64)
    readings = np.abs(np.linalg.norm(points, axis=1) - RADIUS)
    assert surface_error(fuse(noisy, 2e-3).mesh, ball(), 1e-3).accuracy_m < 0.35 * readings.mean()


def test_the_mesh_is_the_same_again_and_wherever_the_world_has_its_origin() -> None:
    images = views(6, 3e-4)
    first, again = fuse(images, 2e-3), fuse(images, 2e-3)
    assert np.array_equal(first.mesh.vertices, again.mesh.vertices)
    assert np.array_equal(first.mesh.faces, again.mesh.faces)
    far = np.array([4096.0, -2048.0, 512.0]) * 2e-3 * 8  # whole blocks, so that the lattice is the same
    moved = fuse([replace(i, T_world_camera=translation(*far) @ i.T_world_camera) for i in images], 2e-3)
    off = distances_to(moved.mesh.vertices - far, first.mesh)
    assert np.percentile(off, 99) < 1e-6  # rounding puts a few projections in another pixel
    assert off.max() < 1e-4


def test_the_grid_of_open3d_counts_the_other_way_round() -> None:
    """Its own integration of the same depths, with its sign, gives the same surface."""
    import open3d as o3d

    camera, core = Intrinsics(96, 72, 130, 130, 48, 36), o3d.core
    T = look_at((0.3, 0.1, 0.2), (0, 0, 0))
    image = range_image(sphere_depth(camera, T, (0, 0, 0), RADIUS), T, camera)
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1,), (1,)), voxel_size=2e-3, block_resolution=8
    )
    depth = o3d.t.geometry.Image(core.Tensor(np.nan_to_num(image.z)))
    K = core.Tensor(np.array([[130, 0, 48], [0, 130, 36], [0, 0, 1.0]]))
    E = core.Tensor(np.linalg.inv(T))
    blocks = grid.compute_unique_block_coordinates(depth, K, E, 1.0, 3.0, 4.0)
    grid.integrate(blocks, depth, K, E, 1.0, 3.0, 4.0)
    coordinates, rows = grid.voxel_coordinates_and_flattened_indices()
    tsdf = grid.attribute("tsdf").reshape((-1,)).numpy()[rows.numpy()]
    weight = grid.attribute("weight").reshape((-1,)).numpy()[rows.numpy()]
    near = (weight > 0) & (np.abs(tsdf) < 0.9)
    ours = signed_distance(coordinates.numpy()[near].astype(np.float64), image)
    assert near.sum() > 1000
    off = np.abs(ours + 8e-3 * tsdf[near])
    assert np.isfinite(off).mean() > 0.99
    assert np.nanpercentile(off, 99) < 1e-6


def test_a_view_far_from_all_others_is_warned_of() -> None:
    """Such as one whose pose is in millimetres."""
    images = views(4)
    T = np.array(images[2].T_world_camera)
    T[:3, 3] *= 1000
    with pytest.warns(AlignmentWarning, match=r"the readings of view 2 lie .* from those of any other"):
        fuse([*images[:2], replace(images[2], T_world_camera=T), images[3]], 4e-3)
    fuse([images[0], range_image(np.full((72, 96), np.nan))], 4e-3)  # a blind view is none of these; no warning


def test_a_wide_truncation_holds_every_voxel_within_it() -> None:
    """Blocks laid around few points reach as far as those around all of them; and they are laid in no time."""
    image = views(1)[0]
    fused = fuse([image], 4e-3, truncation_m=0.1)
    assert fused.voxels * fused.voxel_m**3 > 4 / 3 * np.pi * 0.1**3
    narrow = fuse([image], 4e-3, truncation_m=8 * 4e-3)
    assert surface_error(fused.mesh, narrow.mesh, 4e-3, samples=2000).completeness_m < 5e-4


def test_refuses_what_cannot_be_fused() -> None:
    image = views(1)[0]
    nothing = range_image(np.full((72, 96), np.nan))
    for images, options, message in (
        ([], {}, "one view or more"),
        ([nothing], {}, "no pixel measured anything"),
        ([image], {"voxel_m": 0.0}, "voxel_m to be positive"),
        ([image], {"voxel_m": np.nan}, "voxel_m to be positive"),
        ([image], {"voxel_m": "2mm"}, "voxel_m to be positive"),
        ([image], {"voxel_m": 1.0}, "half of the extent of the readings"),
        ([image], {"voxel_m": 1e-6}, "a tenth of the distance"),
        ([image], {"truncation_m": 1e-3}, "at least a voxel"),
        ([image], {"truncation_m": np.inf}, "truncation_m to be positive and finite"),
        ([image], {"truncation_m": 5.0}, "voxels of 0.002 m within 5 m of a reading"),
        ([image], {"weights": "confidnce"}, "did you mean 'confidence'"),
        ([image], {"lookup": "cubic"}, "bilinear, nearest"),
        ([image], {"min_weight": -1.0}, "min_weight"),
        ([image], {"min_weight": 1e6}, "found none in 1 views"),
        ([replace(image, camera=None)], {}, "calibrated"),
        ([image, replace(image, T_world_camera=np.full((4, 4), np.nan))], {}, "pose of view 1 to hold finite"),
        ([image, replace(image, T_world_camera=np.diag([1, 1, -1, 1.0]))], {}, "pose of view 1 to be rigid"),
        ([image, replace(image, T_world_camera=np.diag([1e3, 1e3, 1e3, 1.0]))], {}, "pose of view 1 to be rigid"),
        ([replace(image, camera=image.camera.resized(48, 36))], {}, "its camera's .36, 48. pixels"),  # type: ignore[union-attr]
        ([np.ones((3, 3))], {}, "range images"),
        (Scan((image,)), {}, "`images` of a Scan"),
    ):
        with pytest.raises(ValueError, match=message):
            fuse(images, **{"voxel_m": 2e-3, **options})  # type: ignore[arg-type]


# ---- Meshes ------------------------------------------------------------------------------------------------------


def test_errors_of_a_shifted_square() -> None:
    square = TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    found = surface_error(
        TriangleMesh(square.vertices + np.array([0, 0, 0.01]), square.faces), square, 0.02, samples=2000
    )
    for value in (found.accuracy_m, found.accuracy_rms_m, found.completeness_m, found.chamfer_m):
        assert value == pytest.approx(0.01)
    assert found.f_score == 1
    half = TriangleMesh(square.vertices * [0.5, 1, 1], square.faces)
    found = surface_error(half, square, 0.01, samples=20_000)
    assert found.accuracy_m == pytest.approx(0, abs=1e-12)
    assert found.precision == 1
    assert found.recall == pytest.approx(0.51, abs=0.005)  # half, and a strip of the threshold
    assert found.completeness_m == pytest.approx(0.125, abs=0.002)  # mean of max(0, x - 0.5)
    assert found.f_score == pytest.approx(2 * found.recall / (1 + found.recall))


def test_distances_to_triangles_are_those_of_trimesh() -> None:
    import trimesh

    mesh, random = part(), np.random.default_rng(0)
    points = random.uniform(-0.1, 0.1, (200, 3))
    large = trimesh.Trimesh(1e4 * mesh.vertices, mesh.faces, process=False)  # its tolerances are absolute
    _, expected, _ = trimesh.proximity.closest_point_naive(large, 1e4 * points)
    assert 1e4 * distances_to(points, mesh) == pytest.approx(expected, abs=1e-6)


def test_samples_are_even_over_the_area() -> None:
    mesh = block((1.0, 2.0, 0.5))
    points, face = mesh.sample(40_000)
    top = np.isclose(points[:, 2], 0.25)
    assert top.mean() == pytest.approx(2 / mesh.area_m2, abs=1e-3)
    assert np.abs(((points - mesh.corners[face][:, 0]) * mesh.face_normals[face]).sum(-1)).max() < 1e-12


def test_a_saved_mesh_reads_back(tmp_path) -> None:  # type: ignore[no-untyped-def]
    import trimesh

    mesh = part()
    mesh.save(tmp_path / "part.ply")
    back = trimesh.load_mesh(tmp_path / "part.ply", process=False)
    assert np.array_equal(back.vertices, mesh.vertices)
    assert np.array_equal(back.faces, mesh.faces)
    with pytest.raises(ValueError, match=r"\.ply"):
        mesh.save(tmp_path / "part.obj")


def test_refuses_broken_meshes() -> None:
    with pytest.raises(ValueError, match="finite"):
        TriangleMesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))
    with pytest.raises(ValueError, match="indices"):
        TriangleMesh(np.eye(3), np.array([[0, 1, 3]]))
    with pytest.raises(ValueError, match="area"):
        surface_error(TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]])), block((1, 1, 1)), 0.1)


def test_the_mesh_of_a_part_is_right_where_views_saw_it() -> None:
    mesh, camera = part(), Intrinsics.from_fov(160, 120, 40)
    images = [range_image(mesh_depth(mesh, camera, T), T, camera) for T in around(12, 0.25)]
    found = surface_error(fuse(images, 2e-3).mesh, mesh, 2e-3)
    assert found.accuracy_m < 4e-4
    assert found.precision > 0.98
