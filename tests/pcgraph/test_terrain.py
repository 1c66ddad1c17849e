# SPDX-License-Identifier: Apache-2.0
"""From far above, the ground is one object, though what stands on it parts it; what only lies low is none of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checks import main_object
from scenes.land import COURT, ROOF, SHED, SIDE, STREET, banked, block

import pcgraph
from pcgraph.graph.continuations import continuations, faces_of
from pcgraph.tree.tree import segmentation_tree


def found_in(result):
    graph = result.graph
    faces = faces_of(graph.edges, graph.edge_features, graph.n_nodes)
    found = continuations(result.surface, graph.node_features, faces, result.acquisition, np.empty((0, 3)))
    return found.chosen(~found.coplanar)


@pytest.mark.parametrize("court", [0.0, 3.0, -3.0])
@pytest.mark.parametrize("frame", ["level", "down", "tilted"])
def test_a_court_is_one_with_the_street_around_the_block(court, frame):
    """In whatever frame, z down too, and though it lies higher or lower; the roof is another."""
    points, on = block(court)
    if frame == "down":
        points = points[:, [1, 0, 2]] * (1.0, 1.0, -1.0)
    if frame == "tilted":
        points = points @ np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0] + 1000.0
    result = pcgraph.segment(points)
    street, court, roof = (main_object(result.labels, on, what) for what in (STREET, COURT, ROOF))
    assert street == court != roof
    pairs = found_in(result)
    assert len(pairs.pairs)


def test_it_joins_no_sooner_than_objects_are_cut():
    """Below that the tree is as without: which pieces are one ground says nothing of their own parts."""
    result = pcgraph.segment(block(3.0)[0])
    hidden = result.graph.continuations
    without = replace(result.graph, continuations=hidden.chosen(hidden.coplanar))
    tree = segmentation_tree(result.linkage.merges(without, result.leaves), result.leaves)
    below = np.nextafter(np.round(result.object_altitude * 2**20) / 2**20, 0.0)
    np.testing.assert_array_equal(result.cut(altitude=below), result.on_points(tree.cut(altitude=below)))
    assert result.objects.max() == tree.cut(altitude=result.object_altitude).max() - 1


@pytest.mark.parametrize("shed", [3.5, 6.0])
def test_a_flat_roof_in_the_court_is_not_ground(shed):
    """From its border it goes down, however low it is beside what stands around."""
    points, on = block(shed=shed)
    labels = pcgraph.segment(points).labels
    street, court, shed = (main_object(labels, on, what) for what in (STREET, COURT, SHED))
    assert street == court != shed


def test_a_terrace_nearly_as_high_as_what_stands_around_is_another():
    points, on = block(court=9.0)
    labels = pcgraph.segment(points).labels
    assert main_object(labels, on, STREET) != main_object(labels, on, COURT)


def test_where_walls_are_seen_it_was_not_from_far_above():
    """Then what is one is known from what touches."""
    result = pcgraph.segment(block(walls=True)[0])
    assert not len(found_in(result).pairs)


def test_a_scanner_over_the_court_knows_what_it_did_not_see():
    """Its own range tells how voxels grow: what one scanner took is not asked."""
    points, _ = block()
    result = pcgraph.segment(points, viewpoint=(60.0, 60.0, 100.0), range_growth=0.5)
    assert not len(found_in(result).pairs)


def test_ground_that_touches_ground_at_a_bank_is_one_with_it():
    """Things stand on both; of bare levels one may stand on the other, as a bale of hay does on a field.

    One draw of eight: in six the two levels stay apart.
    """
    points, on = banked(True)
    result = pcgraph.segment(points)
    pairs = {tuple(pair) for pair in found_in(result).pairs.tolist()}
    assert pairs & {tuple(pair) for pair in result.graph.edges.tolist()}
    street, court = (main_object(result.labels, on, what) for what in (STREET, COURT))
    assert street == court
    assert not np.isin(street, result.labels[on == ROOF])
    points, on = banked(False)
    labels = pcgraph.segment(points).labels
    assert main_object(labels, on, STREET) != main_object(labels, on, COURT)


@pytest.mark.parametrize("scene", [block, lambda seed: banked(True, seed)])
@pytest.mark.parametrize("seed", range(3))
def test_what_it_joins_is_in_one_object(scene, seed):
    result = pcgraph.segment(scene(seed=seed)[0])
    one, other = result.objects[found_in(result).pairs].T
    np.testing.assert_array_equal(one, other)


def test_a_crate_on_a_table_from_above_is_not_the_table():
    """Its rim is too narrow to be what ground is hidden under: a floor 5 mm above the table is the crate's."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0.0, 0.8, (2, 70_000))
    off = np.maximum(np.abs(x - 0.4), np.abs(y - 0.4))
    on = np.where(off > 0.15, STREET, np.where(off > 0.13, ROOF, COURT))
    z = np.choose(on, [0.0, 0.005, 0.06]) + rng.normal(0.0, 3e-4, len(x))
    labels = pcgraph.segment(np.stack((x, y, z), axis=1)).labels
    assert main_object(labels, on, STREET) != main_object(labels, on, COURT)


def test_valleys_in_a_plateau_are_valleys():
    """What stands between them is the land itself, the largest face of all, from which it goes down."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0.0, SIDE, (2, 12_000))
    on = np.where((np.abs(x - 30.0) < 12.0) & (np.abs(y - 60.0) < 40.0), STREET, ROOF)
    on[(np.abs(x - 90.0) < 12.0) & (np.abs(y - 60.0) < 40.0)] = COURT
    z = np.where(on == ROOF, 15.0, 0.0) + rng.normal(0.0, 0.05, len(x))
    result = pcgraph.segment(np.stack((x, y, z), axis=1))
    assert not len(found_in(result).pairs)
