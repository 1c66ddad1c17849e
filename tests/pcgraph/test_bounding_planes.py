# SPDX-License-Identifier: Apache-2.0
"""Pieces of a plane that bounds the scene are one if something hides what is missing; pieces of others are not."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from checks import main_object
from scenes.rooms import THREE_WALLS as WALLS
from scenes.rooms import desk, floor, sheet
from scenes.surfaces import labelled

import pcgraph
from pcgraph.acquisition.kinds import Told, UnknownAcquisition
from pcgraph.graph.continuations import continuations, faces_of
from pcgraph.tree.tree import segmentation_tree

UNKNOWN, NOWHERE = UnknownAcquisition(Told()), np.empty((0, 3))  # nobody says from where the clouds were seen


def segmented(*sheets, **settings):
    """Segmentation of some sheets, and the number of the sheet of each point."""
    points, which = labelled(sheets)
    return pcgraph.segment(points, **settings), which


def are_one(result, which, first=0, second=1):
    return len({main_object(result.labels, which, number, least=0.95) for number in (first, second)}) == 1


def pairs_of(result):
    """Means of the supervoxels of each pair on bounding planes, (r, 2, 3), that the segmentation took."""
    graph = result.graph
    faces = faces_of(graph.edges, graph.edge_features, graph.n_nodes)
    found = continuations(result.surface, graph.node_features, faces, UNKNOWN, NOWHERE)
    assert found.coplanar.all()
    taken = {tuple(pair) for pair in graph.joined.tolist()}
    assert {tuple(pair) for pair in found.pairs.tolist()} <= taken
    return graph.node_features.centroid[found.pairs]


def test_a_floor_of_which_a_strip_is_hidden_below_a_desk_is_one():
    result, which = segmented(floor(0.0, 1.7), floor(2.3, 4.0), *WALLS, desk(1.7, 2.3))
    assert are_one(result, which)
    assert not are_one(result, which, 0, 2)
    assert not are_one(result, which, 0, 5)
    x, _, z = np.moveaxis(pairs_of(result), -1, 0)
    assert len(x) >= 10
    assert z == pytest.approx(0.0, abs=0.01)
    assert (x.min(axis=1) < 1.7).all()
    assert (x.max(axis=1) > 2.3).all()
    without = replace(result.graph, continuations=None)
    tree = segmentation_tree(result.linkage.merges(without, result.leaves), result.leaves)
    assert not are_one(replace(result, labels=result.on_points(tree.cut(altitude=result.object_altitude))), which)


def test_a_strip_that_nothing_hides_parts_a_floor():
    for over in ((), (desk(1.7, 2.3, 1.4),), (desk(0.5, 1.2),)):  # nothing, far above, and elsewhere
        result, which = segmented(floor(0.0, 1.7), floor(2.3, 4.0), *WALLS, *over)
        assert not are_one(result, which)
        assert not len(pairs_of(result))


def test_a_hole_through_which_something_shows_parts_a_floor():
    """Something deep enough, and so little of it that the floor bounds the scene none the less."""
    pit = sheet([1.9, 0.9, -0.5], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0])
    result, which = segmented(floor(0.0, 1.7), floor(2.3, 4.0), *WALLS, desk(1.7, 2.3), pit)
    assert np.count_nonzero(which == 6) < 0.005 * len(which)
    assert not len(pairs_of(result))
    elsewhere = sheet([0.5, 0.9, -0.5], [0.2, 0.0, 0.0], [0.0, 0.2, 0.0])
    result, which = segmented(floor(0.0, 1.7), floor(2.3, 4.0), *WALLS, desk(1.7, 2.3), elsewhere)
    assert len(pairs_of(result))


def test_a_partition_hides_no_floor():
    partition = [sheet([x, 0.0, 0.05], [0.0, 2.0, 0.0], [0.0, 0.0, 1.5]) for x in (1.9, 2.1)]
    result, _ = segmented(floor(0.0, 1.88), floor(2.12, 4.0), *WALLS, *partition)
    assert not len(pairs_of(result))


@pytest.mark.parametrize("depth", [0.08, 0.15])
def test_a_wall_hides_nothing_between_the_panels_that_are_set_in_it(depth):
    """Nothing lies behind them, and the frame before what is between; but it faces as they do, and is larger."""
    wall = sheet([0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 2.0])
    x, _, z = wall.T
    holes = [(np.abs(x - middle) < 0.5) & (np.abs(z - 1.0) < 0.6) for middle in (1.0, 2.2)]
    panels = [sheet([middle - 0.5, depth, 0.4], [1.0, 0.0, 0.0], [0.0, 0.0, 1.2]) for middle in (1.0, 2.2)]
    ground = sheet([0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, -2.0, 0.0])
    result, _ = segmented(*panels, wall[~(holes[0] | holes[1])], ground, viewpoint=(2.0, -2.0, 1.4))
    assert not len(pairs_of(result))


def test_two_tables_of_one_height_are_two():
    tables = floor(0.3, 1.7, 0.7), floor(2.1, 3.6, 0.7)
    result, which = segmented(*tables, floor(0.0, 4.0), *WALLS, desk(1.6, 2.2, 0.9))
    assert not are_one(result, which)
    assert not len(pairs_of(result))


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
    assert not len(pairs_of(result))


def test_boards_with_little_before_them_are_two():
    result, _ = segmented(floor(0.0, 1.7), floor(2.3, 4.0), desk(1.8, 2.2))
    assert not len(pairs_of(result))


def test_a_gap_too_wide_for_each_piece_is_bridged_by_what_two_of_them_are_together():
    near = sheet([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    beside = sheet([0.0, 1.3, 0.0], [1.0, 0.0, 0.0], [0.0, 0.7, 0.0])
    beyond = sheet([1.9, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.9, 0.0])
    over = (*WALLS, sheet([1.1, 0.1, 0.7], [0.7, 0.0, 0.0], [0.0, 0.7, 0.0]))
    bench = sheet([0.1, 1.05, 0.3], [0.8, 0.0, 0.0], [0.0, 0.2, 0.0])
    result, which = segmented(near, beyond, *over)
    assert not are_one(result, which)
    result, which = segmented(near, beyond, *over, bench, beside)
    assert are_one(result, which)
    assert are_one(result, which, 0, 7)


def test_order_frame_and_unit_do_not_count():
    sheets = (floor(0.0, 1.7), floor(2.3, 4.0), *WALLS, desk(1.7, 2.3))
    points, which = labelled(sheets)
    order = np.random.default_rng(1).permutation(len(points))
    plain = pcgraph.segment(points)
    shuffled = pcgraph.segment(points[order])
    assert np.array_equal(shuffled.supervoxels, plain.supervoxels[order])
    assert np.array_equal(shuffled.graph.continuations.pairs, plain.graph.continuations.pairs)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    for moved in (points @ turn.T, points * 1000.0, points + np.array([500.0, -200.0, 30.0])):
        assert are_one(pcgraph.segment(moved), which)


def test_after_an_update_pieces_of_several_scans_are_one():
    first = np.concatenate((floor(0.0, 1.7), *WALLS[::2], desk(1.7, 2.3)))
    second = np.concatenate((floor(2.3, 4.0), WALLS[1]))
    result = pcgraph.update(pcgraph.segment(first, viewpoint=(2.0, 1.0, 1.4)), second, viewpoint=(2.0, 1.0, 1.4))
    x = pairs_of(result)[..., 0]
    assert len(x)
    assert (x.min(axis=1) < 2.0).all()
    assert (x.max(axis=1) > 2.0).all()


@pytest.mark.validation
@pytest.mark.filterwarnings("ignore")  # more objects than a tenth of the supervoxels
def test_many_pieces_take_little_time():
    """A floor in 1600 pieces below as many boards. All pairs of pieces were looked at once, which took a minute."""
    x, y = (0.5 * np.mgrid[:40, :40]).reshape(2, -1)
    corners = np.stack((x, y, np.zeros_like(x)), axis=1)[:, None]
    pieces, boards = (np.random.default_rng(n).random((1600, n, 3)) for n in (400, 60))
    boards = boards * [0.25, 0.25, 0.002] + np.array([0.325, 0.325, 0.2]) + corners
    cloud = np.concatenate((pieces * [0.35, 0.35, 0.002] + corners, boards), axis=1).reshape(-1, 3)
    result = pcgraph.segment(cloud, normals=np.tile([0.0, 0.0, 1.0], (len(cloud), 1)))
    graph = result.graph
    faces = faces_of(graph.edges, graph.edge_features, graph.n_nodes)
    assert np.count_nonzero(np.bincount(faces[result.surface.supervoxels]) >= 40) > 1500
    begun = time.process_time()
    continuations(result.surface, graph.node_features, faces, UNKNOWN, NOWHERE)
    assert time.process_time() - begun < 10.0
