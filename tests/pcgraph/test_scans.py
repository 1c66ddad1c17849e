# SPDX-License-Identifier: Apache-2.0
"""Several viewpoints, growing voxels, and one scan after another."""

from __future__ import annotations

import numpy as np
import pytest
from clouds import patch, same_partition, two_boxes_on_a_plane
from scanned_scenes import scan, sphere_of_rays
from scanned_streets import CAR, street
from scipy.spatial.transform import Rotation
from scores import mean_overlap
from test_guarantees import assert_covered_and_connected
from tiers import draws

import pcgraph
from pcgraph.depth_image import DepthImage, image_view
from pcgraph.features.moments import moments_of_groups
from pcgraph.inputs import clean_cloud
from pcgraph.metrics import weighted_overlap
from pcgraph.pixels import with_pixels
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
    rows, columns = np.mgrid[0:40, 0:50]
    points = np.stack(((columns - 25) / 50, (rows - 20) / 50, np.ones((40, 50))), axis=-1) * (
        1.0 + columns[..., None] / 25
    )
    result = pcgraph.segment(points, range_growth=0.5)
    assert not result.camera
    assert np.ptp(result.surface.grid.edge_lengths) > 0.1 * result.voxel_size


def image_of_steps(height=60, width=80):
    """A floor before a camera, with steps in depth, (height, width, 3)."""
    u, v = np.meshgrid((np.arange(width) - width / 2) / width, (np.arange(height) + 1) / height)
    return np.stack((u, v, np.ones_like(u)), axis=-1) * (1.0 / (v + 0.2) + (u > 0.1))[..., None]


@pytest.mark.parametrize(
    "moved", ["as it is", "mirrored", "on its side", "upside down", "half missing", "a row", "a column"]
)
def test_what_is_in_the_order_of_its_rays_is_an_image(moved):
    image = image_of_steps()
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
    image = image_of_steps()
    turn = Rotation.random(random_state=1).as_matrix()
    moved, place = image @ turn.T + (1.0, 2.0, 3.0), np.array([1.0, 2.0, 3.0])
    found = pcgraph.segment(moved)
    for settings in ({"camera": True}, {"camera": True, "viewpoint": place}):
        told = pcgraph.segment(moved, **settings)
        assert told.camera
        assert np.array_equal(told.labels, found.labels)


def test_an_image_whose_viewpoint_is_given_is_the_one_that_is_found():
    points, walls = image_of_a_hall(5.0, 1.4e-3, 2.85e-3)
    world = points[..., [0, 2, 1]] * [1.0, 1.0, -1.0] + [3.0, 2.0, 1.2]
    found, given = pcgraph.segment(world), pcgraph.segment(world, viewpoint=[3.0, 2.0, 1.2])
    assert given.voxel_size == pytest.approx(found.voxel_size, rel=1e-6)
    assert weighted_overlap(given.labels, walls) > 0.9


def test_an_image_in_coordinates_of_a_map_was_not_seen_from_their_origin():
    points, _ = image_of_a_hall(4.0)
    on_map = points[..., [0, 2, 1]] * [1.0, 1.0, -1.0] + [5e5, 5e6, 100.0]  # the camera looks north
    assert np.allclose(image_view(clean_cloud(on_map, None, None)).place, [5e5, 5e6, 100.0], atol=1e-3)


@pytest.mark.parametrize("axis", [0, 1])
def test_edges_along_one_axis_of_an_image_tell_that_it_was_moved(axis):
    rays = np.stack((*np.meshgrid(np.arange(-40, 40) / 70.0, np.arange(-30, 30) / 70.0), np.ones((60, 80))), axis=-1)
    points = rays * (2.0 + 0.3 * (rays[..., axis] > 0.0) + 0.01 * np.sin(9.0 * rays[..., 1 - axis]))[..., None]
    assert (image_view(clean_cloud(points, None, None)).place == 0.0).all()
    moved = image_view(clean_cloud(points + np.array([1.0, 2.0, 3.0]), None, None))
    assert np.allclose(moved.place, [1.0, 2.0, 3.0], atol=1e-6)


def test_a_height_map_in_another_frame_was_seen_by_no_camera():
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 80), np.linspace(-1.0, 1.0, 80))
    z = 0.3 * np.exp(-8.0 * (x**2 + y**2)) + np.where(np.hypot(x - 0.5, y) < 0.2, 0.4, 0.0)
    assert image_view(clean_cloud(np.stack((x, y, z), axis=-1), None, None)) is None


def test_a_turning_scanner_in_its_own_frame_sees_from_the_origin():
    azimuth, elevation = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False), np.linspace(-0.4, 0.1, 32))
    rays = np.stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), -1)
    ranges = np.where(np.abs(azimuth - 2.0) < 0.3, 3.0, np.minimum(8.0 + np.cos(3.0 * azimuth), 40.0))
    assert (pcgraph.segment(rays * ranges[..., None]).viewpoint == 0.0).all()


def image_of_a_hall(end, noise=0.0, step=0.0, shape=(240, 320)):
    """A depth image, (h, w, 3), of a floor, two walls and a wall at the end, and which of these; depths by noise and
    steps of inverse depth, 1/metres."""
    rng, (h, w) = np.random.default_rng(0), shape
    y, x = (np.mgrid[:h, :w] + 0.5 - np.array([h, w]).reshape(2, 1, 1) / 2.0) / (0.9 * w)
    walls = np.stack([np.full(shape, end), *(1.2 / np.maximum(way, 1e-9) for way in (y, x, -x))])
    inverse = 1.0 / walls.min(axis=0) + noise * rng.normal(size=shape)
    inverse = np.round(inverse / step) * step if step else inverse
    return np.stack((x, y, np.ones(shape)), axis=-1) / inverse[..., None], walls.argmin(axis=0)


@pytest.mark.parametrize("noise", [0.5e-3, 1.4e-3])
def test_steps_of_depth_are_read_off_an_image(noise):
    points, _ = image_of_a_hall(4.0, noise, 2.85e-3)
    cloud = clean_cloud(points, None, None)
    warp = CameraWarp.about(cloud.points, np.zeros(3))
    far = np.quantile(cloud.points[:, 2], 0.8)
    needed = 2.85e-3 * far * warp.reference_depth / 0.75 / 3.5
    assert DepthImage.of(cloud.points, cloud.image, np.zeros(3), None).spacing(
        median_spacing(cloud.points, warp), warp
    ) == pytest.approx(min(needed, 4.0 * median_spacing(cloud.points, warp)), rel=0.02)
    fine, _ = image_of_a_hall(4.0, 0.05 * noise)
    cloud = clean_cloud(fine, None, None)
    assert DepthImage.of(cloud.points, cloud.image, np.zeros(3), None).spacing(
        median_spacing(cloud.points, warp), warp
    ) == median_spacing(cloud.points, warp)


@pytest.mark.parametrize("end", [3.0, 4.0, 5.0, 6.0])
def test_walls_far_from_a_camera_whose_depth_is_coarse_are_whole(end):
    points, walls = image_of_a_hall(end, 1.4e-3, 2.85e-3, (480, 640))
    result = pcgraph.segment(points)
    assert weighted_overlap(result.labels, walls) > 0.9
    assert result.objects.max() < 8


def mixed_at_edges(seed, fraction=0.3):
    """A depth image, (h, w, 3), of three boards before a wall, which of these, and which pixels are mixed of two."""
    rng, (h, w) = np.random.default_rng(seed), (240, 320)
    y, x = np.mgrid[:h, :w]
    depths, truth = np.full((h, w), 2.0), np.zeros((h, w), int)
    for number, (top, left) in enumerate(((30, 30), (90, 130), (60, 240)), start=1):
        inside = (abs(y - top - 50) < 50) & (abs(x - left - 25) < 25)
        depths[inside], truth[inside] = 1.0 + 0.2 * number, number
    beside = np.zeros((h, w), bool)
    beside[:, 1:] = depths[:, 1:] > depths[:, :-1] + 0.1
    mixed = beside & (rng.random((h, w)) < fraction)
    depths[mixed] -= rng.uniform(0.2, 0.8, mixed.sum()) * (depths - np.roll(depths, 1, axis=1))[mixed]
    rays = np.stack(((x - w / 2) / 300.0, (y - h / 2) / 300.0, np.ones((h, w))), axis=-1)
    return rays * (depths + 0.001 * rng.normal(size=(h, w)))[..., None], truth, mixed


@pytest.mark.parametrize("seed", range(3))
def test_pixels_that_mix_two_depths_are_outliers(seed):
    points, truth, mixed = mixed_at_edges(seed)
    result = pcgraph.segment(points)
    assert np.mean(result.outliers[mixed]) > 0.9
    assert np.mean(result.outliers[~mixed]) < 0.002
    assert result.objects.max() + 1 == 4
    assert weighted_overlap(result.labels, truth) > 0.99
    again = pcgraph.update(result, points)
    assert np.mean(again.outliers[mixed]) > 0.9


_FRAMES = {  # of cameras: z forwards, as OpenGL's, and x forwards
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "x": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
}


def measured(points):
    return np.isfinite(points).all(axis=-1)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("forwards", _FRAMES)
def test_a_list_in_its_cameras_frame_is_its_image(forwards, seed):
    points, truth, mixed = mixed_at_edges(seed)
    points = (points @ _FRAMES[forwards].T).astype(np.float32)
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
    points, truth, _ = mixed_at_edges(0)
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
    rays = image_of_steps()
    points = rays / rays[..., 2:] / (1.0 + 0.3 * (rays[..., :1] / rays[..., 2:]))
    sizes = []
    for turn in _FRAMES.values():
        result = pcgraph.segment(points.reshape(-1, 3) @ turn.T)
        assert result.camera
        sizes.append(result.voxel_size)
    assert sizes == pytest.approx([sizes[0]] * 3, rel=1e-2)


@pytest.mark.parametrize("left", [0.3, 0.6])
def test_no_pixel_of_a_thinned_list_flies(left):
    points, truth, _ = mixed_at_edges(0, fraction=0.0)
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
    points, truth, _ = mixed_at_edges(0, fraction=0.0)
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
    rng, (points, _, _) = np.random.default_rng(0), mixed_at_edges(0)
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
    points, _, mixed = mixed_at_edges(0)
    rows, columns = np.nonzero(mixed)
    near = points[rows[0] : rows[0] + 20, columns[0] - 20 : columns[0] + 20]
    assert not pcgraph.segment(near).outliers.any()


@pytest.mark.parametrize("height", [0.1, 0.3, 1.5])
def test_no_pixel_flies_on_a_floor_before_a_low_camera(height):
    y, x = (np.mgrid[:240, :320] - np.array([119.5, 159.5]).reshape(2, 1, 1)) / 300.0
    depths = np.where(y > 0.0, height / np.maximum(y, 1e-9), np.nan)
    depths[depths > 200.0 * height] = np.nan
    image = np.stack((x, y, np.ones_like(x)), axis=-1) * depths[..., None]
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
    up, around = np.meshgrid(np.linspace(0.3, -0.4, 32), np.linspace(0, 6.28, 400), indexing="ij")
    rays = np.stack((np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)), axis=-1)
    ranges = np.minimum(np.where(rays[..., 2] < 0, -1.7 / np.minimum(rays[..., 2], -1e-9), np.inf), 30.0)
    sweep = rays * ranges[..., None] + (0.0, 0.0, 2.0)
    assert sweep[..., 2].min() > 0.0
    assert not pcgraph.segment(heights).camera
    assert not pcgraph.segment(sweep).camera
    assert pcgraph.segment(heights, camera=True).camera  # if told so


def test_a_list_told_to_be_a_cameras_has_the_voxels_of_its_image():
    image = image_of_steps(120, 160)
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


def scanned_ground(rings=20, n=1000):
    """Rings of ground around a scanner 2 m above it, as thin with range as a scanner sees it."""
    angle, down = np.meshgrid(np.linspace(0, 2 * np.pi, n, endpoint=False), np.linspace(0.04, 0.9, rings))  # radians
    reach = 2.0 / np.tan(down)
    return np.stack((reach * np.cos(angle), reach * np.sin(angle), np.zeros(angle.shape)), axis=-1).reshape(-1, 3)


def test_voxels_that_grow_with_range_keep_far_ground_in_one_piece():
    points = scanned_ground()
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
        pcgraph.segment(scanned_ground(5, 10), range_growth=1.0)
    with pytest.raises(ValueError, match="voxels grow in one way"):
        pcgraph.segment(scanned_ground(5, 10) + 5.0, range_growth=0.5, camera=True)


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


def sweep_of_a_lot(beams, lowest, highest, cars, rng):
    """Points of a turning scanner 1.8 m above a lot with two buildings, a wall and cars, given the middle and the yaw
    of each, and on which car each point lies."""
    things = [(14.0, 20.0, 0.3, 12.0, 8.0, 5.0), (-30.0, 5.0, 1.0, 10.0, 10.0, 6.0), (0.0, -28.0, 0.0, 30.0, 1.0, 2.0)]
    things += [(*car, 4.4, 1.8, 1.5) for car in cars]
    angles = np.meshgrid(np.radians(np.arange(0.0, 360.0, 0.2)), np.radians(np.linspace(lowest, highest, beams)))
    azimuth, elevation = (angle.ravel() for angle in angles)
    level = np.cos(elevation)
    rays = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)), axis=1)
    with np.errstate(divide="ignore"):
        ranges = np.where(rays[:, 2] < 0.0, -1.8 / rays[:, 2], np.inf)
        car = np.full(len(rays), -1)
        for number, (x, y, yaw, *size) in enumerate(things):
            turn = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
            place, ways, half = turn @ np.array((-x, -y, 1.8 - size[2] / 2.0)), rays @ turn.T, np.array(size) / 2.0
            ends = np.stack(((-half - place) / ways, (half - place) / ways))
            near, far = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
            hit = (near < far) & (near > 0.0) & (near < ranges)
            ranges[hit], car[hit] = near[hit], number - 3 if number >= 3 else -1
    seen = ranges < 80.0
    return rays[seen] * (ranges[seen] + rng.normal(0.0, 0.02, seen.sum()))[:, None], car[seen]


def overlaps(labels, car):
    """Intersection over union of each car and the label that has most of it."""
    found = []
    for number in range(car.max() + 1):
        own = car == number
        of_own, counts = np.unique(labels[own], return_counts=True)
        best = labels == of_own[counts.argmax()]
        found.append((own & best).sum() / (own | best).sum())
    return found


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("beams", "lowest", "highest"), [(16, -15.0, 15.0), (32, -30.67, 10.67)])
def test_cars_in_a_sweep_of_few_beams_are_objects(beams, lowest, highest, seed):
    """Less than half of the voxels touched five others: they stayed, and cars fell apart, or grew to 0.8 m."""
    rng, cars = np.random.default_rng(seed), []
    for i in range(10):
        angle, away = 2.4 * i + rng.uniform(-0.3, 0.3), 6.0 + 2.0 * i
        cars.append((away * np.cos(angle), away * np.sin(angle), rng.uniform(0.0, 3.0)))
    points, car = sweep_of_a_lot(beams, lowest, highest, cars, rng)
    assert np.mean(overlaps(pcgraph.segment(points).labels, car)) > 0.65


@pytest.mark.parametrize("seed", [3, 5])
def test_cars_in_a_few_sweeps_of_few_beams_are_objects(seed):
    """Voxels grew until three quarters of them touched five others, to a metre, though each step joined few more."""
    rng, made = np.random.default_rng(seed), street(seed, half_length=60.0)
    places = np.array([made.on_ground(x, -1.75) + np.array((0.0, 0.0, 2.0)) for x in (-15.0, 0.0, 15.0)])
    rays = [
        sphere_of_rays(np.arange(0.0, 360.0, 0.2) + turn, np.linspace(-15.0, 15.0, 16)) for turn in rng.uniform(size=3)
    ]
    seen = scan(made.scene, places, rays, 0.02, rng, reach=80.0)
    found = pcgraph.segment(seen.points)
    cars = [car for car in made.scene.numbers(CAR) if np.count_nonzero(seen.things == car) >= 50]
    assert found.surface.grid.size < 0.4
    assert mean_overlap(found.labels, seen.things, np.array(cars)) > 0.65


@pytest.mark.parametrize("seed", draws(4, 1))
def test_cars_parked_side_by_side_are_objects(seed):
    """Over gaps of eight voxel edges two or three were one."""
    rng = np.random.default_rng(seed)
    cars = [(3.0 * i - 7.5, 8.0 + rng.normal(0.0, 0.15), np.pi / 2.0 + rng.normal(0.0, 0.03)) for i in range(6)]
    points, car = sweep_of_a_lot(128, -25.0, 15.0, cars, rng)
    assert min(overlaps(pcgraph.segment(points).labels, car)) > 0.85


def test_viewpoints_that_hardly_differ_are_one():
    """A micrometre of drift took the growth with range away, and there were three times as many objects."""
    rng = np.random.default_rng(0)
    cars = [(8.0 * np.cos(i), 8.0 * np.sin(i), i) for i in range(6)]
    points, _ = sweep_of_a_lot(64, -25.0, 15.0, cars, rng)
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
    points, _ = sweep_of_a_lot(16, -15.0, 15.0, [(8.0, 0.0, 0.0)], np.random.default_rng(seed))
    stray = np.random.default_rng(seed).uniform((-40.0, -40.0, 0.0), (40.0, 40.0, 12.0), (60, 3))
    found = pcgraph.segment(np.concatenate((points, stray)))
    told = pcgraph.segment(np.concatenate((points, stray)), voxel_size=found.voxel_size)
    assert np.array_equal(found.outliers, told.outliers)
