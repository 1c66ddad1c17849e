# SPDX-License-Identifier: Apache-2.0
"""What took a cloud is decided once: by what was given, by the pixels, by the spacing of the points."""

from __future__ import annotations

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


def test_spacing_tells_a_scanner_and_rings_tell_it_for_sure() -> None:
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
    assert found.told.evidence.is_sure
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
        assert len(found.scans) == 2
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
