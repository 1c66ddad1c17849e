# SPDX-License-Identifier: Apache-2.0
"""Pieces of a plane that bounds the scene are one object; pieces of any other plane are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pcgraph
from pcgraph.tree.tree import segmentation_tree

STEP = 0.02  # metres between points


def sheet(corner, first, second):
    """Points (n, 3) on a parallelogram, metres, 2 cm apart, jittered by 2 mm."""
    first, second = np.array(first), np.array(second)
    n, m = (max(int(np.linalg.norm(side) / STEP), 1) for side in (first, second))
    s, t = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(m) + 0.5) / m, indexing="ij")
    points = corner + s.reshape(-1, 1) * first + t.reshape(-1, 1) * second
    return points + np.random.default_rng(0).uniform(-0.002, 0.002, points.shape)


def floor(start, stop, height=0.0):
    return sheet([start, 0.0, height], [stop - start, 0.0, 0.0], [0.0, 2.0, 0.0])


WALLS = (
    sheet([-0.02, 0.0, 0.05], [0.0, 2.0, 0.0], [0.0, 0.0, 1.5]),
    sheet([4.02, 0.0, 0.05], [0.0, 2.0, 0.0], [0.0, 0.0, 1.5]),
    sheet([0.0, 2.02, 0.05], [4.0, 0.0, 0.0], [0.0, 0.0, 1.5]),
)


def segmented(*sheets, **settings):
    """Segmentation of some sheets, and the number of the sheet of each point."""
    which = np.repeat(np.arange(len(sheets)), [len(sheet) for sheet in sheets])
    return pcgraph.segment(np.concatenate(sheets), **settings), which


def main_object(labels, which, sheet):
    names, counts = np.unique(labels[which == sheet], return_counts=True)
    assert counts.max() > 0.95 * counts.sum()
    return names[counts.argmax()]


def are_one(result, which, first=0, second=1):
    return main_object(result.labels, which, first) == main_object(result.labels, which, second)


def test_a_floor_that_was_not_scanned_in_a_strip_is_one():
    result, which = segmented(floor(0.0, 1.7), floor(2.3, 4.0), *WALLS)
    assert are_one(result, which)
    assert not are_one(result, which, 0, 2)
    hidden = result.graph.continuations
    assert hidden.width == pytest.approx(0.6, abs=0.1)
    assert hidden.crossings.sum() >= 5
    without = replace(result.graph, continuations=None)
    tree = segmentation_tree(result.linkage.merges(without, result.leaves), result.leaves)
    assert not are_one(replace(result, labels=result.on_points(tree.cut(altitude=result.object_altitude))), which)


def test_a_hole_through_which_something_shows_parts_a_floor():
    """Something deep enough, and so little of it that the floor bounds the scene none the less."""
    pit = sheet([1.9, 0.9, -0.5], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0])
    result, which = segmented(floor(0.0, 1.7), floor(2.3, 4.0), *WALLS, pit)
    assert np.count_nonzero(which == 5) < 0.005 * len(which)
    assert not are_one(result, which)
    elsewhere = sheet([0.5, 0.9, -0.5], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0])
    result, which = segmented(floor(0.0, 1.7), floor(2.3, 4.0), *WALLS, elsewhere)
    assert are_one(result, which)


def test_two_tables_of_one_height_are_two():
    tables = floor(0.3, 1.7, 0.7), floor(2.1, 3.6, 0.7)
    result, which = segmented(*tables, floor(0.0, 4.0), *WALLS)
    assert not are_one(result, which)


def test_two_boxes_of_one_height_are_two_though_nothing_lies_above_them():
    """Their tops bound the scene from above; but they look away from it."""
    table = sheet([-0.5, -0.5, 0.0], [1.9, 0.0, 0.0], [0.0, 1.4, 0.0])
    x, y, _ = table.T
    sheets = [table[(y < 0.0) | (y > 0.4) | (np.abs(np.abs(x - 0.45) - 0.25) > 0.2)]]
    for x in (0.0, 0.5):
        sheets.append(sheet([x, 0.0, 0.3], [0.4, 0.0, 0.0], [0.0, 0.4, 0.0]))
        for y in (0.0, 0.4):
            sheets.append(sheet([x, y, 0.0], [0.4, 0.0, 0.0], [0.0, 0.0, 0.3]))
        for side in (x, x + 0.4):
            sheets.append(sheet([side, 0.0, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.3]))
    result, which = segmented(*sheets)
    assert not are_one(result, which, 1, 6)
    x, y, z = np.moveaxis(result.graph.node_features.centroid[result.graph.continuations.pairs], -1, 0)
    assert (z < 0.25).all()


def test_two_boards_with_nothing_before_them_are_two():
    result, which = segmented(floor(0.0, 1.7), floor(2.3, 4.0))
    assert not are_one(result, which)


def test_pieces_as_far_apart_as_they_are_wide_are_two():
    result, which = segmented(floor(0.0, 0.5), floor(3.0, 4.0), *WALLS)
    assert not are_one(result, which)


def test_a_gap_too_wide_for_each_piece_is_bridged_by_what_two_of_them_are_together():
    near = sheet([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    beside = sheet([0.0, 1.3, 0.0], [1.0, 0.0, 0.0], [0.0, 0.7, 0.0])
    beyond = sheet([2.1, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.9, 0.0])
    result, which = segmented(near, beyond, *WALLS)
    assert not are_one(result, which)
    result, which = segmented(near, beyond, *WALLS, beside)
    assert are_one(result, which)
    assert are_one(result, which, 0, 5)


def test_order_frame_and_unit_do_not_count():
    sheets = (floor(0.0, 1.7), floor(2.3, 4.0), *WALLS)
    points = np.concatenate(sheets)
    which = np.repeat(np.arange(len(sheets)), [len(sheet) for sheet in sheets])
    order = np.random.default_rng(1).permutation(len(points))
    plain = pcgraph.segment(points)
    shuffled = pcgraph.segment(points[order])
    assert np.array_equal(shuffled.supervoxels, plain.supervoxels[order])
    assert np.array_equal(shuffled.graph.continuations.pairs, plain.graph.continuations.pairs)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    for moved in (points @ turn.T, points * 1000.0, points + np.array([500.0, -200.0, 30.0])):
        assert are_one(pcgraph.segment(moved), which)


def test_after_an_update_pieces_of_several_scans_are_one():
    first = np.concatenate((floor(0.0, 1.7), *WALLS[::2]))
    second = np.concatenate((floor(2.3, 4.0), WALLS[1]))
    result = pcgraph.update(pcgraph.segment(first, viewpoint=(2.0, 1.0, 1.4)), second, viewpoint=(2.0, 1.0, 1.4))
    x = result.graph.node_features.centroid[result.graph.continuations.pairs, 0]
    assert len(x)
    assert (x.min(axis=1) < 2.0).all()
    assert (x.max(axis=1) > 2.0).all()
