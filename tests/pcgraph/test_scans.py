# SPDX-License-Identifier: Apache-2.0
"""Several viewpoints, growing voxels, and one scan after another."""

from __future__ import annotations

import numpy as np
import pytest
from checks import assert_covered_and_connected, overlaps, same_partition
from scenes.images import FRAMES, QVGA, VGA, at_depths, boards_with_mixed_edges, hall, stairs
from scenes.rays import camera, pinhole, to_plane, turning
from scenes.streets import lot, rings_of_ground
from scenes.surfaces import patch
from scenes.tables import two_boxes_on_a_plane
from scipy.spatial.transform import Rotation
from tiers import draws

import pcgraph
from pcgraph.acquisition.depth_image import DepthImage, image_view
from pcgraph.acquisition.pixels import with_pixels
from pcgraph.features.moments import moments_of_groups
from pcgraph.inputs import clean_cloud
from pcgraph.metrics import weighted_overlap
from pcgraph.voxels.spacing import median_spacing
from pcgraph.voxels.warp import CameraWarp, RangeWarp, warped_normal


def plate():
    """A thin upright plate seen from both sides, with where each point was seen from."""
    front, back = patch((0, 0, 0), (0.5, 0, 0), (0, 0, 0.5)), patch((0, 0.2, 0), (0.5, 0, 0), (0, 0, 0.5))
    seen_from = np.vstack([np.tile((0.2, -2.0, 0.2), (len(front), 1)), np.tile((0.2, 2.0, 0.2), (len(back), 1))])
    return np.vstack([front, back]), seen_from


def test_one_viewpoint_per_point_turns_each_normal_to_its_own():
    points, seen_from = plate()
    result = pcgraph.segment(points, viewpoint=seen_from)
    front = result.surface.grid.centroids[:, 1] < 0.1
    assert result.surface.normals[front] == pytest.approx(np.tile((0, -1, 0), (front.sum(), 1)), abs=1e-9)
    assert result.surface.normals[~front] == pytest.approx(np.tile((0, 1, 0), ((~front).sum(), 1)), abs=1e-9)
    nodes = result.graph.node_features
    assert (np.sign(nodes.normal[:, 1]) == np.sign(nodes.centroid[:, 1] - 0.1)).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_leaf_seen_from_both_sides_is_one_object(seed):
    """Each voxel faces where it was seen from, so neighbours on one sheet face opposite ways."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.0, 1.0, (2, 20_000))
    leaf = np.stack((x, y, 0.15 * x**2 + rng.normal(0.0, 0.001, len(x))), axis=1)
    seen_from = np.where(rng.random((len(leaf), 1)) < 0.5, (0.5, 0.5, 2.0), (0.5, 0.5, -2.0))
    assert pcgraph.segment(leaf, viewpoint=seen_from).labels.max() == 0


def test_a_body_just_above_the_ground_is_not_the_ground():
    """Its underside and the ground face each other, two voxels apart, and touch in places."""
    rng = np.random.default_rng(0)
    ground = np.stack((*rng.uniform(0.0, 10.0, (2, 40_000)), rng.normal(0.0, 0.01, 40_000)), axis=1)
    faces, normals = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = rng.uniform((3.0, 4.0, 0.15), (7.2, 5.8, 1.35), (3000, 3))
            face[:, axis] = (7.2, 5.8, 1.35)[axis] if side > 0 else (3.0, 4.0, 0.15)[axis]
            faces.append(face + rng.normal(0.0, 0.01, (3000, 1)) * np.eye(3)[axis])
            normals.append(np.tile(side * np.eye(3)[axis], (3000, 1)))
    given = np.concatenate((np.tile((0.0, 0.0, 1.0), (len(ground), 1)), *normals))
    for voxel_size in (0.065, 0.07, 0.075):
        result = pcgraph.segment(np.concatenate((ground, *faces)), normals=given, voxel_size=voxel_size)
        largest = np.bincount(result.labels[len(ground) :]).argmax()
        assert (result.labels[len(ground) :] == largest).mean() > 0.95
        assert (result.labels[: len(ground)] == largest).mean() < 0.01


def test_rows_of_points_on_ground_do_not_face_their_tripod():
    """Far rings are rows, and what is seen edge-on has few points: the way to the tripod says least of its normal."""
    rng = np.random.default_rng(0)
    near = rng.uniform(-3.0, 3.0, (90_000, 2))
    rows = np.stack(np.meshgrid(np.arange(10.0, 30.0, 2.0), np.arange(-10.0, 10.0, 0.03)), axis=-1).reshape(-1, 2)
    ground = np.pad(np.concatenate((near, rows)), ((0, 0), (0, 1)))
    places = np.where(rng.random((len(ground), 1)) < 0.5, (0.0, 0.0, 1.5), (0.0, 5.0, 1.5))
    surface = pcgraph.segment(ground, viewpoint=places, voxel_size=0.05).surface
    far = surface.grid.centroids[:, 0] > 5.0
    assert far.sum() > 3000
    assert (surface.normals[far, 2] > 0.99).all()


def test_nodes_face_where_given_normals_point():
    points, _ = plate()
    inwards = np.zeros_like(points)
    inwards[:, 1] = np.where(points[:, 1] < 0.1, 1.0, -1.0)
    nodes = pcgraph.segment(points, normals=inwards).graph.node_features
    assert (np.sign(nodes.normal[:, 1]) == np.sign(0.1 - nodes.centroid[:, 1])).all()


def test_sides_are_known_where_all_scans_tell_them():
    points, seen_from = plate()
    normals = np.sign(seen_from - points) * (0.0, 1.0, 0.0)
    told, by_normals, bare = (
        pcgraph.segment(points, **given) for given in ({"viewpoint": seen_from}, {"normals": normals}, {})
    )
    assert [result.acquisition.sides_known for result in (told, by_normals, bare)] == [True, True, False]
    after = [
        pcgraph.update(first, points + 1.0, normals=normals).acquisition.sides_known
        for first in (told, by_normals, bare)
    ]
    assert after == [True, True, False]
    assert not pcgraph.update(told, points + 1.0).acquisition.sides_known


def test_an_image_takes_a_viewpoint_per_pixel():
    points, seen_from = (array[:5184].reshape(72, 72, 3) for array in plate())
    result = pcgraph.segment(points, viewpoint=seen_from)
    assert not result.camera
    assert result.viewpoint.shape == (5184, 3)
    alike = pcgraph.segment(points.reshape(-1, 3), viewpoint=seen_from.reshape(-1, 3))
    assert np.array_equal(result.supervoxels.reshape(-1), alike.supervoxels)
    for growing in ({"camera": True}, {"range_growth": 0.5}):
        with pytest.raises(ValueError, match="one viewpoint where voxels grow"):
            pcgraph.segment(points, viewpoint=seen_from, **growing)


def test_an_image_may_grow_with_range():
    points = at_depths((40, 50), 50.0, np.tile(1.0 + np.arange(50) / 25, (40, 1)))
    result = pcgraph.segment(points, range_growth=0.5)
    assert not result.camera
    assert np.ptp(result.surface.grid.edge_lengths) > 0.1 * result.voxel_size


@pytest.mark.parametrize(
    "moved", ["as it is", "mirrored", "on its side", "upside down", "half missing", "a row", "a column"]
)
def test_what_is_in_the_order_of_its_rays_is_an_image(moved):
    image = stairs()
    half = np.where(np.random.default_rng(0).random((*image.shape[:2], 1)) < 0.5, np.nan, image)
    clouds = {
        "as it is": image,
        "mirrored": image[:, ::-1],
        "on its side": image.swapaxes(0, 1),
        "upside down": image[::-1, ::-1],
        "half missing": half,
        "a row": image[20:21],
        "a column": image[:, 20:21],
    }
    assert pcgraph.segment(clouds[moved]).camera


def test_an_image_in_another_frame_was_seen_from_its_camera(rooms):
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # to a frame whose z points up
    for view, *_ in rooms:
        result = pcgraph.segment((view.points @ turn.T + [300.0, -20.0, 1.5]).astype(np.float32), view.colors)
        assert np.allclose(result.viewpoint, [300.0, -20.0, 1.5], atol=1e-3)
        towards = np.einsum("ij,ij->i", result.surface.normals, result.viewpoint - result.surface.grid.centroids)
        assert result.camera
        assert np.mean(towards < 0.0) < 0.001
        assert weighted_overlap(result.labels, view.things) > 0.95


def test_an_image_in_another_frame_that_is_said_to_be_a_cameras_is_the_one_that_is_found():
    """It was refused, as no point of another frame need lie before the origin."""
    image = stairs()
    turn = Rotation.random(random_state=1).as_matrix()
    moved, place = image @ turn.T + (1.0, 2.0, 3.0), np.array([1.0, 2.0, 3.0])
    found = pcgraph.segment(moved)
    for settings in ({"camera": True}, {"camera": True, "viewpoint": place}):
        told = pcgraph.segment(moved, **settings)
        assert told.camera
        assert np.array_equal(told.labels, found.labels)


def test_an_image_whose_viewpoint_is_given_is_the_one_that_is_found():
    points, walls = hall(5.0, 1.4e-3, 2.85e-3)
    world = points[..., [0, 2, 1]] * [1.0, 1.0, -1.0] + [3.0, 2.0, 1.2]
    found, given = pcgraph.segment(world), pcgraph.segment(world, viewpoint=[3.0, 2.0, 1.2])
    assert given.voxel_size == pytest.approx(found.voxel_size, rel=1e-6)
    assert weighted_overlap(given.labels, walls) > 0.9


def test_an_image_in_coordinates_of_a_map_was_not_seen_from_their_origin():
    points, _ = hall(4.0)
    on_map = points[..., [0, 2, 1]] * [1.0, 1.0, -1.0] + [5e5, 5e6, 100.0]  # the camera looks north
    assert np.allclose(image_view(clean_cloud(on_map, None, None)).place, [5e5, 5e6, 100.0], atol=1e-3)


@pytest.mark.parametrize("axis", [0, 1])
def test_edges_along_one_axis_of_an_image_tell_that_it_was_moved(axis):
    rays = camera(np.arange(-40, 40) / 70.0, np.arange(-30, 30) / 70.0)
    points = rays * (2.0 + 0.3 * (rays[..., axis] > 0.0) + 0.01 * np.sin(9.0 * rays[..., 1 - axis]))[..., None]
    assert (image_view(clean_cloud(points, None, None)).place == 0.0).all()
    moved = image_view(clean_cloud(points + np.array([1.0, 2.0, 3.0]), None, None))
    assert np.allclose(moved.place, [1.0, 2.0, 3.0], atol=1e-6)


def test_a_height_map_in_another_frame_was_seen_by_no_camera():
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 80), np.linspace(-1.0, 1.0, 80))
    z = 0.3 * np.exp(-8.0 * (x**2 + y**2)) + np.where(np.hypot(x - 0.5, y) < 0.2, 0.4, 0.0)
    assert image_view(clean_cloud(np.stack((x, y, z), axis=-1), None, None)) is None


def test_a_turning_scanner_in_its_own_frame_sees_from_the_origin():
    azimuth = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    rays = turning(np.linspace(-0.4, 0.1, 32), azimuth).reshape(32, 400, 3)
    ranges = np.where(np.abs(azimuth - 2.0) < 0.3, 3.0, np.minimum(8.0 + np.cos(3.0 * azimuth), 40.0))
    assert (pcgraph.segment(rays * ranges[..., None]).viewpoint == 0.0).all()


@pytest.mark.parametrize("noise", [0.5e-3, 1.4e-3])
def test_steps_of_depth_are_read_off_an_image(noise):
    points, _ = hall(4.0, noise, 2.85e-3)
    cloud = clean_cloud(points, None, None)
    warp = CameraWarp.about(cloud.points, np.zeros(3))
    far = np.quantile(cloud.points[:, 2], 0.8)
    needed = 2.85e-3 * far * warp.reference_depth / 0.75 / 3.5
    found = DepthImage.of(cloud.points, cloud.image, np.zeros(3), None).spacing(cloud.points, warp)
    assert found == pytest.approx(min(needed, 4.0 * median_spacing(cloud.points, warp)), rel=0.02)
    fine, _ = hall(4.0, 0.05 * noise)
    cloud = clean_cloud(fine, None, None)
    found = DepthImage.of(cloud.points, cloud.image, np.zeros(3), None).spacing(cloud.points, warp)
    assert found == pytest.approx(median_spacing(cloud.points, warp), rel=0.02)


@pytest.mark.parametrize("end", [3.0, 4.0, 5.0, 6.0])
def test_walls_far_from_a_camera_whose_depth_is_coarse_are_whole(end):
    points, walls = hall(end, 1.4e-3, 2.85e-3, VGA)
    result = pcgraph.segment(points)
    assert weighted_overlap(result.labels, walls) > 0.9
    assert result.objects.max() < 8


@pytest.mark.parametrize("seed", range(3))
def test_pixels_that_mix_two_depths_are_outliers(seed):
    points, truth, mixed = boards_with_mixed_edges(seed)
    result = pcgraph.segment(points)
    assert np.mean(result.outliers[mixed]) > 0.9
    assert np.mean(result.outliers[~mixed]) < 0.002
    assert result.objects.max() + 1 == 4
    assert weighted_overlap(result.labels, truth) > 0.99
    again = pcgraph.update(result, points)
    assert np.mean(again.outliers[mixed]) > 0.9


def measured(points):
    return np.isfinite(points).all(axis=-1)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("forwards", FRAMES)
def test_a_list_in_its_cameras_frame_is_its_image(forwards, seed):
    points, truth, mixed = boards_with_mixed_edges(seed)
    points = (points @ FRAMES[forwards].T).astype(np.float32)
    order = np.random.default_rng(seed).permutation(points[..., 0].size)
    image, as_list = pcgraph.segment(points), pcgraph.segment(points.reshape(-1, 3)[order])
    assert image.camera
    assert as_list.camera
    if forwards == "z":  # other axes are found by resection, from other pixels
        assert as_list.voxel_size == image.voxel_size
        assert np.array_equal(as_list.labels, image.labels.reshape(-1)[order])
    assert as_list.voxel_size == pytest.approx(image.voxel_size, rel=1e-6)
    assert np.array_equal(as_list.outliers, image.outliers.reshape(-1)[order])
    assert weighted_overlap(as_list.labels, image.labels.reshape(-1)[order]) > 0.999
    assert np.mean(as_list.outliers[mixed.reshape(-1)[order]]) > 0.9
    assert weighted_overlap(image.labels, truth) > 0.99


def test_what_a_list_that_is_an_image_tells_of_its_points_is_in_their_order():
    points, truth, _ = boards_with_mixed_edges(0)
    points, truth = points.reshape(-1, 3), truth.reshape(-1)
    order = np.random.default_rng(0).permutation(len(points))
    first, second = pcgraph.segment(points), pcgraph.segment(points[order])
    assert first.camera
    assert second.camera
    for name in ("labels", "supervoxels", "outliers", "parts"):
        assert np.array_equal(getattr(first, name)[order], getattr(second, name))
    assert np.allclose(first.saliency()[order], second.saliency(), atol=1e-5, equal_nan=True)
    grid, kept = second.surface.grid, ~second.outliers
    off = np.linalg.norm(grid.centroids[grid.voxel_of_point] - points[order][kept], axis=1)
    assert (off <= np.sqrt(3.0) * grid.edge_lengths[grid.voxel_of_point] * 1.5).all()
    places = np.where((points[:, :1] > 0.0), (0.5, 0.0, 0.0), (-0.5, 0.0, 0.0))
    seen = pcgraph.segment(points[order], viewpoint=places[order])
    assert np.array_equal(seen.viewpoint, places[order][~seen.outliers])


def test_a_slanted_plane_in_any_cameras_frame_is_its_image():
    rays = stairs()
    points = rays / rays[..., 2:] / (1.0 + 0.3 * (rays[..., :1] / rays[..., 2:]))
    sizes = []
    for turn in FRAMES.values():
        result = pcgraph.segment(points.reshape(-1, 3) @ turn.T)
        assert result.camera
        sizes.append(result.voxel_size)
    assert sizes == pytest.approx([sizes[0]] * 3, rel=1e-2)


@pytest.mark.parametrize("left", [0.3, 0.6])
def test_no_pixel_of_a_thinned_list_flies(left):
    points, truth, _ = boards_with_mixed_edges(0, fraction=0.0)
    kept = np.random.default_rng(0).random(truth.shape) < left
    result = pcgraph.segment(points[kept])
    assert result.camera
    assert np.mean(result.outliers) < 1e-4
    assert weighted_overlap(result.labels, truth[kept]) > 0.99


def test_a_list_of_what_a_camera_saw_of_a_room_has_the_objects_of_its_image(rooms):
    for view, *_ in rooms:
        seen = measured(view.points)
        image, as_list = (
            pcgraph.segment(p, c) for p, c in ((view.points, view.colors), (view.points[seen], view.colors[seen]))
        )
        assert as_list.camera
        assert np.array_equal(as_list.viewpoint, np.zeros(3))
        assert weighted_overlap(as_list.labels, image.labels[seen]) > 0.99
        again = pcgraph.update(as_list, view.points[seen], view.colors[seen])
        assert again.tree.n_leaves == as_list.tree.n_leaves


def test_a_part_of_an_image_with_features_and_viewpoints_keeps_what_each_point_has():
    points, truth, _ = boards_with_mixed_edges(0, fraction=0.0)
    part = (truth > 0) | (np.random.default_rng(0).random(truth.shape) < 0.7)
    as_list, of_list = points[part], truth[part]
    as_list[5] = np.nan
    shuffled = np.random.default_rng(1).permutation(len(as_list))
    given = {"features": of_list[shuffled], "viewpoint": np.zeros((len(as_list), 3))}
    result = pcgraph.segment(as_list[shuffled], np.repeat(of_list[shuffled, None], 3, axis=1) / 4.0, **given)
    assert result.labels[shuffled == 5] == -1
    assert weighted_overlap(result.labels, of_list[shuffled]) > 0.99
    pure = [len(np.unique(of_list[shuffled][result.supervoxels == s])) == 1 for s in range(result.tree.n_leaves)]
    assert np.mean(pure) > 0.99


@pytest.mark.parametrize("made", ["in millimetres", "twice", "with noise", "few"])
def test_lists_that_are_not_the_pixels_of_one_image_are_mere_lists(made):
    rng, (points, _, _) = np.random.default_rng(0), boards_with_mixed_edges(0)
    points = points.reshape(-1, 3)
    clouds = {
        "in millimetres": np.rint(1000.0 * points),
        "twice": np.concatenate((points, 1.01 * points)),
        "with noise": np.concatenate((points, rng.uniform(points.min(axis=0), points.max(axis=0), (50, 3)))),
        "few": points[rng.random(len(points)) < 0.1],
    }
    cloud = clean_cloud(clouds[made], None, None)
    assert with_pixels(cloud) is cloud


@pytest.mark.parametrize("height", [1.0, 2.0])
def test_grids_of_points_at_one_height_or_two_are_no_images(height):
    x, y = np.meshgrid(np.arange(-40, 60) / 64.0, np.arange(-30, 50) / 64.0)
    cloud = clean_cloud(np.stack((x, y, np.where(x > 0.3, height, 1.0)), axis=-1).reshape(-1, 3), None, None)
    assert with_pixels(cloud) is cloud


def test_no_pixel_of_a_tiny_image_flies():
    points, _, mixed = boards_with_mixed_edges(0)
    rows, columns = np.nonzero(mixed)
    near = points[rows[0] : rows[0] + 20, columns[0] - 20 : columns[0] + 20]
    assert not pcgraph.segment(near).outliers.any()


@pytest.mark.parametrize("height", [0.1, 0.3, 1.5])
def test_no_pixel_flies_on_a_floor_before_a_low_camera(height):
    rays = pinhole(QVGA, 300.0)
    depths = to_plane(rays, (0, 1, 0), height)
    image = rays * np.where(depths > 200.0 * height, np.nan, depths)[..., None]
    for noise in (0.0, 1e-3):
        noisy = image * (1.0 + noise * np.random.default_rng(0).normal(size=(240, 320, 1)))
        cloud = clean_cloud(noisy, None, None)
        assert not DepthImage.of(cloud.points, cloud.image, np.zeros(3), None).flying().any()


def test_zeros_in_an_image_are_holes(rooms):
    view, *_ = rooms[0]
    holes = np.isnan(view.points[..., 0]) | (np.random.default_rng(0).random(view.points.shape[:2]) < 0.1)
    with_nan = np.where(holes[..., None], np.nan, view.points)
    expected = pcgraph.segment(with_nan, view.colors)
    for kind in (np.float64, np.float32):
        result = pcgraph.segment(np.where(holes[..., None], 0.0, with_nan.astype(kind)), view.colors)
        assert result.camera
        assert (result.labels[holes] == -1).all()
    assert np.array_equal(
        pcgraph.segment(np.where(holes[..., None], 0.0, with_nan), view.colors).labels, expected.labels
    )
    with pytest.raises(ValueError, match="all 12 points are NaN or infinite, or \\(0, 0, 0\\)"):
        pcgraph.segment(np.zeros((3, 4, 3)))


def test_many_zeros_in_a_list_are_holes_and_few_are_points(rooms):
    view, *_ = rooms[0]
    points, seen = view.points.reshape(-1, 3), measured(view.points).reshape(-1)
    with_zeros = np.where(seen[:, None], points, 0.0)
    with_zeros[np.random.default_rng(0).random(len(points)) < 0.1] = 0.0
    holes = (with_zeros == 0.0).all(axis=1)
    result = pcgraph.segment(with_zeros)
    assert result.camera
    assert (result.labels[holes] == -1).all()
    assert np.array_equal(result.labels[~holes], pcgraph.segment(with_zeros[~holes]).labels)
    few = np.concatenate((points[seen], np.zeros((1000, 3))))
    assert (pcgraph.segment(few).labels[-1000:] != -1).all()
    assert (pcgraph.segment(np.zeros((2000, 3))).labels == 0).all()


def test_height_maps_and_turning_scanners_are_no_images():
    """They may lie at z > 0 all the same, where x/z means nothing."""
    x, y = np.meshgrid(np.arange(80) * 0.5, np.arange(60) * 0.5)
    heights = np.stack((x, y, 1.0 + 4.0 * (2.0 + np.sin(x / 5) + np.cos(y / 4))), axis=-1)
    rays = turning(np.linspace(0.3, -0.4, 32), np.linspace(0, 6.28, 400)).reshape(32, 400, 3)
    ranges = np.minimum(to_plane(rays, (0, 0, 1), -1.7), 30.0)
    sweep = rays * ranges[..., None] + (0.0, 0.0, 2.0)
    assert sweep[..., 2].min() > 0.0
    assert not pcgraph.segment(heights).camera
    assert not pcgraph.segment(sweep).camera
    assert pcgraph.segment(heights, camera=True).camera  # if told so


def test_a_list_told_to_be_a_cameras_has_the_voxels_of_its_image():
    image = stairs(120, 160)
    as_list = pcgraph.segment(image.reshape(-1, 3), camera=True)
    assert as_list.voxel_size == pcgraph.segment(image).voxel_size
    assert as_list.camera
    assert not pcgraph.segment(image, camera=False).camera


def test_viewpoints_of_another_shape_are_refused():
    points, seen_from = plate()
    with pytest.raises(ValueError, match="viewpoint of three finite coordinates in metres, or one per point"):
        pcgraph.segment(points, viewpoint=seen_from[:-1])
    seen_from[3, 1] = np.nan
    with pytest.raises(ValueError, match="finite at finite points"):
        pcgraph.segment(points, viewpoint=seen_from)
    points[3] = np.nan  # of a point that is not there, the viewpoint does not matter
    assert pcgraph.segment(points, viewpoint=seen_from).supervoxels[3] == -1


@pytest.mark.parametrize("growth", [0.3, 0.5, 0.9])
def test_range_warp_is_its_own_inverse_and_scales_as_it_says(growth):
    rng = np.random.default_rng(0)
    points = rng.normal(0, 20, (500, 3))
    warp = RangeWarp(np.array([1.0, 2.0, 0.5]), 10.0, growth)
    warped = warp.forward(points)
    assert warp.backward(warped) == pytest.approx(points, rel=1e-9)
    across = np.cross(points - warp.viewpoint, rng.normal(size=(500, 3)))
    across *= 1e-6 / np.linalg.norm(across, axis=1, keepdims=True)
    steps = np.linalg.norm(warp.forward(points + across) - warped, axis=1)
    assert 1e-6 / steps == pytest.approx(warp.scale(points), rel=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_a_cameras_warp_along_any_axis_is_that_along_z_turned(seed):
    turn = Rotation.random(random_state=seed).as_matrix()
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1.0, -1.0, 2.0), (1.0, 1.0, 4.0), (200, 3))
    place = np.array([5.0, -2.0, 1.0])
    ahead, turned = CameraWarp(np.zeros(3), 3.0), CameraWarp(place, 3.0, turn @ [0.0, 0.0, 1.0])
    there = points @ turn.T + place
    assert turned.forward(there) == pytest.approx(ahead.forward(points) @ turn.T, abs=1e-12)
    assert turned.backward(turned.forward(there)) == pytest.approx(there, abs=1e-12)
    assert turned.scale(there) == pytest.approx(ahead.scale(points))
    for x, n in zip(ahead.forward(points), rng.normal(size=(200, 3)), strict=True):
        expected = turn @ warped_normal.py_func(ahead.slant, *x, *n)
        assert warped_normal.py_func(turned.slant, *(turn @ x), *(turn @ n)) == pytest.approx(expected, abs=1e-12)
    with pytest.raises(ValueError, match="in front of the camera"):
        turned.check(2.0 * place - there)


def test_voxels_that_grow_with_range_keep_far_ground_in_one_piece():
    points = rings_of_ground()
    plain = pcgraph.segment(points, viewpoint=(0, 0, 2), range_growth=0.0)
    grown = pcgraph.segment(points, viewpoint=(0, 0, 2), range_growth=0.5)
    assert_covered_and_connected(points, grown, outliers=0.01)
    far = np.linalg.norm(points, axis=1) > 20
    assert len(np.unique(grown.supervoxels[far])) < 0.5 * len(np.unique(plain.supervoxels[far]))
    assert len(np.unique(grown.labels[far])) == 2  # one on either side
    middle = np.median(np.linalg.norm(points - np.array((0, 0, 2)), axis=1))
    ranges = np.linalg.norm(grown.surface.grid.centroids - np.array((0, 0, 2)), axis=1)
    assert grown.surface.grid.edge_lengths == pytest.approx(grown.voxel_size * np.sqrt(ranges / middle))


def test_range_growth_is_checked():
    with pytest.raises(ValueError, match="range_growth of at least 0 and below 1"):
        pcgraph.segment(rings_of_ground(5, 10), range_growth=1.0)
    with pytest.raises(ValueError, match="voxels grow in one way"):
        pcgraph.segment(rings_of_ground(5, 10) + 5.0, range_growth=0.5, camera=True)


@pytest.fixture(scope="module")
def halves():
    """Two boxes on a plane, scanned in two overlapping parts, and the whole."""
    points, _, viewpoint = two_boxes_on_a_plane()
    left, right = points[points[:, 0] < 0.9], points[points[:, 0] > 0.8]
    first = pcgraph.segment(left, viewpoint=viewpoint, voxel_size=0.035, seed_size=0.2)
    return left, right, viewpoint, first, pcgraph.update(first, right, viewpoint=viewpoint)


def test_an_update_keeps_supervoxels_and_adds_to_them(halves):
    left, right, _, first, second = halves
    assert second.supervoxels.shape == (len(right),)
    assert second.supervoxels.min() >= 0
    assert second.graph.n_nodes > first.graph.n_nodes
    n = first.graph.n_nodes
    everything = np.vstack([left, right])
    leaf = np.concatenate((first.supervoxels, second.supervoxels))
    direct = moments_of_groups(everything, None, leaf, second.graph.n_nodes)
    assert second.leaves.counts.tolist() == direct.counts.tolist()
    assert second.leaves.centroids == pytest.approx(direct.centroids, rel=1e-9)
    assert second.leaves.scatters == pytest.approx(direct.scatters, abs=1e-9)
    assert (second.leaves.counts[:n] >= first.leaves.counts).all()
    assert second.tree.moments.counts[-1] == len(everything)


def test_objects_of_an_update_are_those_of_the_whole(halves):
    left, right, viewpoint, first, second = halves
    objects = second.tree.cut(altitude=0.5)
    labels = np.concatenate((objects[first.supervoxels], objects[second.supervoxels]))
    whole = pcgraph.segment(np.vstack([left, right]), viewpoint=viewpoint, voxel_size=0.035, seed_size=0.2)
    assert np.array_equal(objects[second.supervoxels], second.labels)
    assert pcgraph.metrics.weighted_overlap(labels, whole.labels) > 0.97


def test_scanning_the_same_again_adds_no_supervoxel(halves):
    left, _, viewpoint, first, _ = halves
    again = pcgraph.update(first, left, viewpoint=viewpoint)
    assert again.graph.n_nodes == first.graph.n_nodes
    assert np.array_equal(again.surface.supervoxels, first.surface.supervoxels)
    assert again.leaves.counts.tolist() == (2 * first.leaves.counts).tolist()
    assert same_partition(again.tree.cut(altitude=0.5), first.tree.cut(altitude=0.5))


def test_updates_that_do_not_fit_are_refused(halves):
    left, _, viewpoint, first, _ = halves
    with pytest.raises(ValueError, match="colours with both scans or with neither"):
        pcgraph.update(first, left, np.full(left.shape, 0.5), viewpoint=viewpoint)
    image = (left[:3000] + 1.0).reshape(50, 60, 3)
    seen_by_camera = pcgraph.segment(image, camera=True)
    with pytest.raises(ValueError, match="camera=False"):
        pcgraph.update(seen_by_camera, left - 9.0, viewpoint=viewpoint)


def test_an_update_goes_on_with_the_settings(halves):
    left, right, viewpoint, _, _ = halves
    options = {"method": pcgraph.Vccs(), "linkage": pcgraph.QuasiFlatLinkage(), "object_altitude": 0.01}
    first = pcgraph.segment(left, viewpoint=viewpoint, voxel_size=0.035, seed_size=0.2, **options)
    second = pcgraph.update(first, right, viewpoint=viewpoint)
    assert (second.method, second.linkage, second.object_altitude) == tuple(options.values())
    assert np.array_equal(second.objects, second.tree.cut(altitude=0.01))
    other = pcgraph.update(first, right, viewpoint=viewpoint, linkage=pcgraph.ConvexityLinkage())
    assert other.object_altitude == pcgraph.ConvexityLinkage().default_object_altitude


def test_an_update_leaves_the_planes_as_they_are_fitted(halves):
    """With normals given for the new scan, and without, points on rims see the same planes."""
    _, right, viewpoint, first, second = halves
    given = np.zeros_like(right)  # zero means: none
    again = pcgraph.update(first, right, None, given, viewpoint)
    assert np.array_equal(again.supervoxels, second.supervoxels)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("beams", "lowest", "highest"), [(16, -15.0, 15.0), (32, -30.67, 10.67)])
def test_cars_in_a_sweep_of_few_beams_are_objects(beams, lowest, highest, seed):
    """Less than half of the voxels touched five others: they stayed, and cars fell apart, or grew to 0.8 m."""
    rng, cars = np.random.default_rng(seed), []
    for i in range(10):
        angle, away = 2.4 * i + rng.uniform(-0.3, 0.3), 6.0 + 2.0 * i
        cars.append((away * np.cos(angle), away * np.sin(angle), rng.uniform(0.0, 3.0)))
    points, car = lot(beams, lowest, highest, cars, rng)
    assert np.mean(overlaps(pcgraph.segment(points).labels, car)) > 0.65


@pytest.mark.parametrize("seed", draws(4, 1))
def test_cars_parked_side_by_side_are_objects(seed):
    """Over gaps of eight voxel edges two or three were one."""
    rng = np.random.default_rng(seed)
    cars = [(3.0 * i - 7.5, 8.0 + rng.normal(0.0, 0.15), np.pi / 2.0 + rng.normal(0.0, 0.03)) for i in range(6)]
    points, car = lot(128, -25.0, 15.0, cars, rng)
    assert min(overlaps(pcgraph.segment(points).labels, car)) > 0.85


def test_viewpoints_that_hardly_differ_are_one():
    """A micrometre of drift took the growth with range away, and there were three times as many objects."""
    rng = np.random.default_rng(0)
    cars = [(8.0 * np.cos(i), 8.0 * np.sin(i), i) for i in range(6)]
    points, _ = lot(64, -25.0, 15.0, cars, rng)
    drifting = rng.normal(0.0, 1e-6, points.shape)
    one, each = pcgraph.segment(points, viewpoint=np.zeros(3)), pcgraph.segment(points, viewpoint=drifting)
    assert each.viewpoint == pytest.approx(np.zeros(3), abs=1e-5)
    assert each.acquisition.is_one_scan
    assert each.labels.max() == pytest.approx(one.labels.max(), rel=0.1)
    apart = np.where(np.arange(len(points))[:, None] % 2 == 0, (3.0, 0.0, 0.0), (-3.0, 0.0, 0.0))
    assert pcgraph.segment(points, viewpoint=apart).viewpoint.ndim == 2


@pytest.mark.parametrize("seed", range(3))
def test_outliers_do_not_depend_on_whether_the_size_of_voxels_was_found_or_told(seed):
    """They were those of the voxels that were tried first, half as large: 2 % of a sweep of 16 beams."""
    points, _ = lot(16, -15.0, 15.0, [(8.0, 0.0, 0.0)], np.random.default_rng(seed))
    stray = np.random.default_rng(seed).uniform((-40.0, -40.0, 0.0), (40.0, 40.0, 12.0), (60, 3))
    found = pcgraph.segment(np.concatenate((points, stray)))
    told = pcgraph.segment(np.concatenate((points, stray)), voxel_size=found.voxel_size)
    assert np.array_equal(found.outliers, told.outliers)
