# SPDX-License-Identifier: Apache-2.0
"""Objects on supports of scenes with known answers."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scenes.surfaces import SPACING, patch, sphere
from scenes.tables import VIEWPOINT, box

import pcgraph
from pcgraph.detection import find_planes, object_labels, objects_on
from pcgraph.learning import leaf_descriptors


def test_objects_on_the_ground_stand_in_their_boxes(boxes):
    points, truth, result = boxes
    found = objects_on(result, points=points)
    assert len(found) == 2
    read = json.loads(json.dumps([thing.to_dict() for thing in found], allow_nan=False))
    assert [thing["count"] for thing in read] == [thing.count for thing in found]
    assert read[0]["box"]["size"][2] == read[0]["height"] == found[0].height
    assert read[0]["supervoxels"] == found[0].supervoxels.tolist()
    assert (read[0]["shape"]["kind"], read[0]["shape"]["radius"]) == ("box", None)
    assert read[0]["shape"]["box"]["center"] == found[0].shape.box.center.tolist()
    labels = object_labels(result, found)
    for thing, size, x, y in zip(found, (0.3, 0.25), (0.3, 1.0), (0.4, 0.5), strict=True):
        # A supervoxel at its foot may hold some ground, up to a voxel (0.035) wide.
        assert thing.box.size == pytest.approx([size] * 3, abs=0.045)
        assert thing.box.center == pytest.approx([x + size / 2, y + size / 2, size / 2], abs=0.03)
        assert thing.height == pytest.approx(size, abs=1e-4)
        assert thing.free_box.volume == pytest.approx(size**3, rel=0.3)
        assert thing.shape.kind == "box"
    for k, number in ((0, 1), (1, 2)):
        both = ((labels == k) & (truth == number)).sum()
        assert both / ((labels == k) | (truth == number)).sum() > 0.9


def test_a_scan_of_bare_table_takes_no_object_away():
    """Two boxes that touch, of different height; only `Segmentation.objects` knows them after a scan without them."""
    low, high = box(0.4, 0.3, 0.2), box(0.6, 0.3, 0.2) * [1, 1, 2.0] + [0, 0.08, 0]
    table = patch((0, 0, 0), (1.2, 0, 0), (0, 0.8, 0))
    table = table[~((table[:, 0] > 0.39) & (table[:, 0] < 0.81) & (table[:, 1] > 0.29))]
    first = pcgraph.segment(np.vstack((table, low, high)), viewpoint=VIEWPOINT, voxel_size=3.5 * SPACING)
    before = objects_on(first)
    assert len(before) == 2
    second = pcgraph.update(first, table[table[:, 0] < 0.2], viewpoint=VIEWPOINT)
    after = objects_on(second)
    assert [thing.count for thing in after] == [thing.count for thing in before]
    whole, one_scan = leaf_descriptors(second), leaf_descriptors(first)
    at = [i for i, name in enumerate(whole[1]) if name == "segment: length"]
    things = np.concatenate([thing.supervoxels for thing in after])
    assert whole[0][things][:, at] == pytest.approx(one_scan[0][things][:, at])


def test_a_sphere_on_the_table_is_found_with_its_radius():
    table = patch((0, 0, 0), (1, 0, 0), (0, 1, 0))
    table = table[np.linalg.norm(table[:, :2] - 0.5, axis=1) > 0.12]
    cap = sphere(0.12, 6000, -0.2)[0]
    seen = (cap * (np.array([0.0, -1.5, 1.88]) - cap)).sum(axis=1) > 0  # the side that faces the viewpoint
    cap = cap[seen & (cap[:, 2] > -0.1)] + [0.5, 0.5, 0.12]
    noise = 0.0005 * np.random.default_rng(0).normal(size=(len(table) + len(cap), 3))
    result = pcgraph.segment(np.vstack((table, cap)) + noise, viewpoint=(0.5, -1, 2), voxel_size=0.015)
    found = objects_on(result)
    assert len(found) == 1
    assert found[0].shape.kind == "sphere"
    assert found[0].shape.radius == pytest.approx(0.12, rel=0.03)
    assert found[0].shape.center == pytest.approx([0.5, 0.5, 0.12], abs=0.005)
    assert found[0].height == pytest.approx(0.24, abs=0.01)


def test_things_on_the_tables_of_rooms(rooms):
    hits = things = extra = 0
    for view, result, planes in rooms:
        table = int(np.argmin(np.abs(planes.offsets - view.table) + (planes.roles != "horizontal")))
        found = objects_on(result, planes, table)
        labels = object_labels(result, found)
        height = view.points @ view.up
        for thing in np.unique(view.things[view.things > 4]):
            true = view.things == thing
            if true.sum() < 150 or height[true].min() < view.table - 0.05:
                continue
            things += 1
            overlap = [((labels == k) & true).sum() / ((labels == k) | true).sum() for k in range(len(found))]
            hits += max(overlap) > 0.75
        extra += len(found)
    assert things > 10
    assert hits >= 0.9 * things
    assert extra <= 1.15 * things


def test_wrong_arguments_are_refused(boxes):
    points, _, result = boxes
    planes = find_planes(result)
    for support in (len(planes), -1, "table", 0.5):
        with pytest.raises(ValueError, match="support"):
            objects_on(result, planes, support)
    with pytest.raises(ValueError, match="call find_planes again"):
        objects_on(pcgraph.segment(points[:200], voxel_size=0.05), planes)
    with pytest.raises(ValueError, match="min_points"):
        objects_on(result, planes, min_points="a")
    with pytest.raises(ValueError, match="points of shape"):
        objects_on(result, planes, points=points[:-1])
    with pytest.raises(ValueError, match="margin"):
        objects_on(result, planes, margin=-1.0)


@pytest.mark.parametrize("kind", ["points", "cloud", "labels", "nothing"])
def test_what_is_no_segmentation_is_refused_in_a_sentence(boxes, kind, tmp_path):
    """Points in place of their segmentation ended in an AttributeError."""
    points, _, result = boxes
    given = {"points": points, "cloud": pcgraph.Cloud(points), "labels": result.labels, "nothing": None}[kind]
    calls = [lambda: find_planes(given), lambda: objects_on(given), lambda: object_labels(given, [])]
    calls += [lambda: objects_on(given, find_planes(result), points=points)]
    calls += [lambda: pcgraph.write_segmentation(tmp_path / "a.ply", points, given)]
    calls += [lambda: pcgraph.labelled_cloud(points, given)]
    for call in calls:
        with pytest.raises(ValueError, match=rf"expected a Segmentation, .* got {type(given).__name__}$"):
            call()
    with pytest.raises(ValueError, match=f"expected planes as find_planes returns them, got {type(points).__name__}"):
        objects_on(result, points)
    assert list(tmp_path.iterdir()) == []
