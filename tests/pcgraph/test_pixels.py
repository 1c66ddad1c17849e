# SPDX-License-Identifier: Apache-2.0
"""Lists of points that a pinhole camera took, in any frame: which camera that was, and which pixels they are."""

from __future__ import annotations

import numpy as np
import pytest
from scenes.images import VGA, floor_wall_and_boxes
from scenes.rays import turning
from scipy.spatial.transform import Rotation

import pcgraph
from pcgraph.acquisition.pixels import with_pixels
from pcgraph.acquisition.resection import NO_PLANE, resection
from pcgraph.inputs import clean_cloud
from pcgraph.metrics import weighted_overlap


def in_world(points, seed):
    """Points, (n, 3), in single precision, of a frame turned and moved at random; the camera's place and axis there."""
    rng = np.random.default_rng(seed)
    turn, place = Rotation.random(rng=rng).as_matrix(), rng.uniform(-5.0, 5.0, 3)
    return (points @ turn.T + place).astype(np.float32), place, turn[:, 2]


def image_of(points):
    return with_pixels(clean_cloud(points, None, None)).image


@pytest.mark.parametrize("noise", [1e-5, 0.0005, 0.003])
@pytest.mark.parametrize("seed", range(6))
def test_a_list_tells_the_camera_that_took_it(seed, noise):
    image, _ = floor_wall_and_boxes(seed, noise=noise)
    points, place, axis = in_world(image.reshape(-1, 3), seed)
    kept = np.random.default_rng(seed).permutation(len(points))[: int(0.9 * len(points))]
    found = image_of(points[kept])
    assert np.allclose(found.view.place, place, atol=1e-4)
    assert found.view.axis @ axis > 1.0 - 1e-8
    assert sorted(found.shape) == [240, 320]
    row, column = np.divmod(kept, 320)
    own = np.stack(np.divmod(found.at, found.shape[1]))
    own = own if found.shape == (240, 320) else own[::-1]
    for pixels, size, line in zip(own, (240, 320), (row, column), strict=True):  # either way
        assert np.array_equal(pixels, line) or np.array_equal(size - 1 - pixels, line)


@pytest.mark.parametrize("seed", range(4))
def test_steps_of_depth_do_not_deceive(seed):
    """Where inverse depth comes in steps, a pixel more for each of them is a whole number of pixels, too."""
    image, _ = floor_wall_and_boxes(seed, noise=1.4e-3, step=2.85e-3)
    points, place, axis = in_world(image.reshape(-1, 3), seed)
    found = image_of(points)
    assert np.allclose(found.view.place, place, atol=1e-3)
    assert found.view.axis @ axis > 1.0 - 1e-6
    assert sorted(found.shape) == [240, 320]


@pytest.mark.parametrize("seed", range(3))
def test_a_list_in_a_world_frame_has_the_objects_of_its_image_in_any_order(seed):
    image, truth = floor_wall_and_boxes(seed, noise=0.002)
    points, place, _ = in_world(image.reshape(-1, 3), seed)
    as_image = pcgraph.segment(points.reshape(image.shape))
    as_list = pcgraph.segment(points)
    assert as_list.camera
    assert np.allclose(as_list.viewpoint, place, atol=1e-4)
    assert as_list.voxel_size == pytest.approx(as_image.voxel_size, rel=1e-5)
    assert weighted_overlap(as_list.labels, as_image.labels.reshape(-1)) > 0.99
    assert weighted_overlap(as_list.labels, truth.reshape(-1)) > 0.95
    order = np.random.default_rng(seed).permutation(len(points))
    again = pcgraph.segment(points[order])
    for name in ("labels", "supervoxels", "outliers"):
        assert np.array_equal(getattr(as_list, name)[order], getattr(again, name))
    given = pcgraph.segment(points, viewpoint=place)
    assert given.camera
    assert weighted_overlap(given.labels, as_list.labels) > 0.99


@pytest.mark.parametrize(("rows", "columns"), [(4, 1), (1, 4), (6, 1), (1, 6)])
@pytest.mark.parametrize("seed", range(6))
def test_surfaces_are_whole_whatever_the_shape_of_pixels(seed, rows, columns):
    points, truth = floor_wall_and_boxes(seed, VGA)
    result = pcgraph.segment(points[::rows, ::columns])
    assert len(np.unique(result.labels)) <= 6  # wall, floor, boxes, and what flies
    assert weighted_overlap(result.labels, truth[::rows, ::columns]) > 0.9


@pytest.mark.parametrize("unit", [2.0**-20, 1e-3, 1000.0, 2.0**40])
def test_no_unit_hides_a_camera(unit):
    image, _ = floor_wall_and_boxes(0)
    points, place, _ = in_world(image.reshape(-1, 3), 1)
    assert np.allclose(image_of(points.astype(np.float64) * unit).view.place / unit, place, atol=1e-4)


def test_a_camera_in_coordinates_of_a_map_is_found():
    image, _ = floor_wall_and_boxes(1)
    turn = Rotation.from_euler("xyz", (1.9, 0.1, 0.7)).as_matrix()
    place = np.array([5e5, 5e6, 100.0])
    assert np.allclose(image_of(image.reshape(-1, 3) @ turn.T + place).view.place, place, atol=1e-4)


def no_images():
    rng = np.random.default_rng(0)
    image, _ = floor_wall_and_boxes(0)
    rays, turn = image.reshape(-1, 3), Rotation.from_rotvec((0.5, 1.0, -0.3)).as_matrix()
    x, y = np.meshgrid(np.arange(120) * 0.02, np.arange(100) * 0.02)
    height = 0.3 * np.sin(3.0 * x) * np.cos(2.0 * y)
    azimuths = np.linspace(0.0, 6.28, 500, endpoint=False)
    sweep = turning(np.linspace(-0.4, 0.3, 64), azimuths)
    ranges = np.minimum(1.5 / np.maximum(-sweep[:, 2], 1e-9), np.tile(8.0 + np.cos(3.0 * azimuths), 64))
    return {
        "two cameras": np.concatenate((rays, rays @ turn.T + (0.5, 0.1, 0.0))),
        "one point more": np.concatenate((rays, rays[:1] + 0.003)),
        "noise across the rays": rays + rng.normal(0.0, 0.003, rays.shape),
        "a height map": np.stack((x, y, height), axis=-1).reshape(-1, 3),
        "a low height map in millimetres": np.rint(
            np.stack((0.506 * x, 0.506 * y, 0.0005 * rng.normal(size=x.shape)), axis=-1).reshape(-1, 3) / 0.001
        )
        * 0.001,
        "cells of a voxel grid": np.unique(np.rint(rays / 0.02), axis=0) * 0.02,
        "a block of cells": np.stack(np.meshgrid(*[np.arange(16.0)] * 3), axis=-1).reshape(-1, 3),
        "a sweep": sweep * ranges[:, None],
        "a plane without noise": (rays / (1.0 + 0.3 * rays[:, :1] / rays[:, 2:]) / rays[:, 2:]),
        "points at random": rng.uniform(size=(20000, 3)),
        "a line": np.outer(np.arange(3000.0), (1.0, 2.0, 3.0)),
        "one place": np.tile([1.0, 2.0, 3.0], (20000, 1)),
    }


@pytest.mark.parametrize("kind", no_images())
def test_what_no_camera_took_is_a_mere_list(kind):
    points = no_images()[kind] @ Rotation.from_rotvec((0.2, -0.4, 0.9)).as_matrix().T + (3.0, -1.0, 2.0)
    cloud = clean_cloud(points, None, None)
    assert with_pixels(cloud) is cloud


def test_a_lattice_far_from_its_origin_was_not_seen_from_there():
    i, j = np.meshgrid(np.arange(100.0), np.arange(400.0), indexing="ij")
    cloud = clean_cloud(np.stack((5e5 + i, 4.5e6 + j, 0.0 * i + 100.0), axis=-1).reshape(-1, 3), None, None)
    assert with_pixels(cloud) is cloud


@pytest.mark.parametrize("unit", [1e95, 1e-150, 1e-158])
def test_no_unit_of_a_lattice_overflows(unit):
    points = unit * np.stack(np.meshgrid(*[np.arange(12.0)] * 3), axis=-1).reshape(-1, 3)
    cloud = clean_cloud(points, None, None)
    assert with_pixels(cloud) is cloud


@pytest.mark.parametrize("seed", range(5))
def test_resection_gives_back_a_camera(seed):
    rng = np.random.default_rng(seed)
    turn, place = Rotation.random(rng=rng).as_matrix(), rng.uniform(-100.0, 100.0, 3)
    points = rng.uniform((-1.0, -1.0, 2.0), (1.0, 1.0, 5.0), (40, 3))
    pixels = np.array([300.0, 280.0]) * points[:, :2] / points[:, 2:] + (120.0, 160.0)
    world = points @ turn.T + place
    camera = resection(world, pixels, NO_PLANE)
    seen, depths = camera.pixels(world)
    assert np.allclose(seen, pixels, atol=1e-8)
    assert np.allclose(np.abs(depths), points[:, 2], atol=1e-9)
    assert np.allclose(camera.place(world.min(axis=0), world.max(axis=0)), place, atol=1e-8)
    assert np.allclose(np.abs(camera.matrix[2, :3]), np.abs(turn[:, 2]), atol=1e-10)


def test_a_plane_tells_no_camera_and_a_parallel_view_no_place():
    rng = np.random.default_rng(0)
    plane = np.column_stack((rng.uniform(-1.0, 1.0, (40, 2)), np.full(40, 2.0)))
    assert resection(plane, 100.0 * plane[:, :2] / plane[:, 2:], NO_PLANE) is None
    points = rng.uniform(-1.0, 1.0, (40, 3))
    parallel = resection(points, 100.0 * points[:, :2])
    assert parallel.place(points.min(axis=0), points.max(axis=0)) is None
