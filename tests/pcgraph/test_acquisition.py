# SPDX-License-Identifier: Apache-2.0
"""What took a cloud is decided once: by what was given, by the pixels, by the spacing of the points."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scenes.images import floor_wall_and_boxes
from scenes.rooms import furniture, furniture_in_rings
from scenes.surfaces import Floats, faces, random_turn

import pcgraph
from pcgraph.acquisition.kinds import (
    CameraImage,
    Evidence,
    OnePlace,
    Scanner,
    SeveralPlaces,
    SeveralScans,
    UnknownAcquisition,
)

SHIFT = np.array([40.0, -25.0, 7.0])


def box() -> Floats:
    return faces((0.0, 0.0, 0.0), (0.4, 0.3, 0.5), 0.01).points


@pytest.mark.parametrize("as_list", [False, True])
@pytest.mark.parametrize("moved", [False, True])
def test_an_image_tells_its_camera_in_any_frame(as_list: bool, moved: bool) -> None:
    image = floor_wall_and_boxes(0).points
    turn, place = (random_turn(1), SHIFT) if moved else (np.eye(3), np.zeros(3))
    points = image @ turn.T + place
    found = pcgraph.segment(points.reshape(-1, 3) if as_list else points).acquisition
    assert isinstance(found, CameraImage)
    assert found.told.evidence is Evidence.PIXELS
    assert found.place == pytest.approx(place, abs=1e-3)  # m
    assert found.axis @ turn[:, 2] == pytest.approx(1.0, abs=1e-4)
    assert found.is_one_scan
    assert found.sides_known
    assert str(found).startswith("seen by one camera at (")
    assert "sure" in repr(found)


def test_spacing_tells_a_scanner_and_rings_tell_it_nearer() -> None:
    points, place = furniture(0)
    found = pcgraph.segment(points + SHIFT).acquisition
    assert isinstance(found, Scanner)
    assert found.told.evidence is Evidence.SPACING
    assert not found.told.evidence.is_sure
    assert "likely" in repr(found)
    assert np.linalg.norm(found.place - SHIFT - place) < 0.3  # m
    points, place = furniture_in_rings(0, 32)
    found = pcgraph.segment(points + SHIFT).acquisition
    assert isinstance(found, Scanner)
    assert found.told.evidence is Evidence.RINGS
    assert not found.told.evidence.is_sure  # two scans may lie over each other
    assert np.linalg.norm(found.place - SHIFT - place) < 0.05  # m


def test_what_is_given_is_not_guessed() -> None:
    """Not the place, nor that it was no camera, nor how voxels grow."""
    image = floor_wall_and_boxes(0, shape=(120, 160), noise=0.0).points
    aside = (0.1, -0.2, -1.0)
    given = pcgraph.segment(image, viewpoint=aside, camera=False, range_growth=0.0).acquisition
    assert isinstance(given, OnePlace)
    assert given.told.evidence is Evidence.GIVEN
    assert given.place.tolist() == list(aside)
    assert not given.is_one_scan
    growing = pcgraph.segment(image, viewpoint=aside, range_growth=0.3).acquisition
    assert isinstance(growing, Scanner)
    assert growing.growth == 0.3
    assert growing.law is None
    for turned in (image, image @ random_turn(1).T + SHIFT):
        even = pcgraph.segment(turned, range_growth=0.0)
        assert np.ptp(even.surface.grid.edge_lengths) == 0.0
        assert not even.acquisition.is_one_scan
        assert even.acquisition.told.evidence is Evidence.PIXELS
    camera = pcgraph.segment(image.reshape(-1, 3)[::7], camera=True).acquisition
    assert isinstance(camera, CameraImage)
    assert not camera.place.any()


def test_a_body_seen_from_all_around_was_seen_from_unknown_places() -> None:
    result = pcgraph.segment(box())
    found = result.acquisition
    assert isinstance(found, UnknownAcquisition)
    assert found.viewpoint is None
    assert not found.is_one_scan
    assert not found.sides_known
    assert "seen from unknown places" in repr(result)
    normals = faces((0.0, 0.0, 0.0), (0.4, 0.3, 0.5), 0.01).normals
    assert pcgraph.segment(box(), normals=normals).acquisition.sides_known
    normals[1:] = np.nan
    assert not pcgraph.segment(box(), normals=normals).acquisition.sides_known


def test_a_viewpoint_for_each_point_follows_the_points_that_are_left() -> None:
    points = box()
    points[::50] = np.nan
    places = np.where(points[:, :1] < 0.2, (-3.0, 0.0, 1.0), (3.0, 0.0, 1.0))
    result = pcgraph.segment(points, viewpoint=places)
    assert isinstance(result.acquisition, SeveralPlaces)
    assert result.acquisition.sides_known
    left = result.supervoxels >= 0
    assert result.viewpoint.tolist() == places[left].tolist()
    assert np.isnan(result.acquisition.places[::50]).all()


def test_scans_are_known_as_far_as_each_of_them_is() -> None:
    points = box()
    result = pcgraph.segment(points, viewpoint=(0.2, -3.0, 1.0))
    known, unknown = pcgraph.update(result, points + 0.001, viewpoint=(3.0, 0.1, 1.0)), pcgraph.update(result, points)
    for found, sides_known in ((known.acquisition, True), (unknown.acquisition, False)):
        assert isinstance(found, SeveralScans)
        assert found.number == 2
        assert found.sides_known == sides_known
        assert found.one_viewpoint is None
    third = pcgraph.update(known, points).acquisition
    assert isinstance(third, SeveralScans)
    assert str(third).startswith("3 scans, the last seen from unknown")


def test_objects_keep_their_numbers_from_scan_to_scan() -> None:
    """Of boxes on a floor that come into view one after the other, each keeps the number with which it came."""
    floor = faces((0.0, 0.0, -0.01), (4.0, 1.0, 0.0), 0.01, "+z").points
    boxes = [faces((x, 0.3, 0.0), (x + 0.3, 0.6, 0.4), 0.01, "-x +x -y +y +z").points for x in (3.3, 0.3, 2.3, 1.3)]
    place = (2.0, -2.0, 3.0)
    result = pcgraph.segment(np.vstack((floor, boxes[0])), viewpoint=place)
    numbers = [result.labels[0], result.labels[-1]]
    for added in boxes[1:]:
        before, result = result, pcgraph.update(result, added, viewpoint=place)
        assert result.objects[: len(before.objects)].tolist() == before.objects.tolist()
        numbers.append(result.labels[-1])
    assert len(set(numbers)) == len(numbers) == 5


def test_the_number_of_an_object_that_has_joined_another_is_not_given_again() -> None:
    x, y = np.meshgrid(np.arange(0.0, 1.0, 0.02), np.arange(0.0, 1.0, 0.02))
    plate, place = np.stack((x, y, np.zeros_like(x)), axis=-1).reshape(-1, 3), (1.0, 0.5, 5.0)
    smaller = plate[plate[:, 0] < 0.7]
    apart = pcgraph.segment(np.vstack((plate, smaller + np.array([1.3, 0.0, 0.0]))), viewpoint=place)
    assert np.unique(apart.objects).tolist() == [0, 1]
    joined = pcgraph.update(apart, plate[plate[:, 0] < 0.3] + np.array([1.0, 0.0, 0.0]), viewpoint=place)
    kept = apart.labels[0]
    assert np.unique(joined.objects).tolist() == [kept]
    third = pcgraph.update(joined, plate + np.array([0.0, 3.0, 0.0]), viewpoint=place)
    assert np.unique(third.objects).tolist() == [kept, 2]
    again = pcgraph.update(third, plate + np.array([0.0, 6.0, 0.0]), viewpoint=place)
    assert np.unique(again.objects).tolist() == [kept, 2, 3]


@pytest.mark.parametrize("each", [False, True])
def test_later_scans_keep_no_rows_of_earlier_ones(each: bool) -> None:
    image = floor_wall_and_boxes(0, shape=(60, 80), noise=0.0).points
    place = np.zeros(3) if not each else np.where(image[..., :1] < 0.0, (0.0, 0.0, 0.0), (0.3, 0.0, 0.0))
    result, sizes = pcgraph.segment(image, camera=False), []
    for _ in range(3):
        result = pcgraph.update(result, image, viewpoint=place)
        sizes.append(len(pickle.dumps(result.acquisition)))
    assert sizes[2] < 1.05 * sizes[1]


@pytest.mark.parametrize("height", [20.0, 1000.0])
def test_a_height_map_was_seen_by_no_camera_at_the_origin(height: float) -> None:
    """Its columns are in the order of x/z, and neighbours lie side by side, wherever it lies."""
    x, y = np.meshgrid(np.arange(-25.0, 25.0, 0.5), np.arange(-20.0, 20.0, 0.5))
    heights = np.stack((x, y, height + 2.0 * np.sin(x / 6.0) * np.cos(y / 5.0)), axis=-1)
    assert not pcgraph.segment(heights).acquisition.told.evidence.is_sure
    assert not isinstance(pcgraph.segment(heights, viewpoint=(0.0, 0.0, 0.0)).acquisition, CameraImage)
    assert isinstance(pcgraph.segment(heights, camera=True).acquisition, CameraImage)  # if told so


def test_a_single_pixel_does_not_tell_where_from() -> None:
    image = np.full((60, 80, 3), np.nan)
    image[20, 30] = (1.0, 2.0, 3.0)
    assert isinstance(pcgraph.segment(image).acquisition, UnknownAcquisition)
    assert isinstance(pcgraph.segment(image[20:21, 30:31]).acquisition, UnknownAcquisition)


def test_a_column_of_pixels_has_neighbours_as_a_row_has() -> None:
    """A path that leaps tells no place, whichever way it runs."""
    rng = np.random.default_rng(0)
    line = np.cumsum(rng.normal(size=(300, 3)) ** 3, axis=0)  # a path with leaps, not in view of the origin
    for image in (line[None], line[:, None]):
        assert not pcgraph.segment(image).acquisition.told.evidence.is_sure


def test_equal_points_do_not_tell_where_from() -> None:
    assert not pcgraph.segment(np.ones((40, 50, 3))).acquisition.told.evidence.is_sure
