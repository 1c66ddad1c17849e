# SPDX-License-Identifier: Apache-2.0
"""Region linkage: its altitudes on graphs of a few nodes, and what it keeps together and apart."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scenes.graphs import random_graph
from scenes.tables import two_boxes_on_a_plane
from scipy.spatial.transform import Rotation
from tiers import draws

import pcgraph
from pcgraph.acquisition.kinds import Told, UnknownAcquisition
from pcgraph.tree.region_linkage import AltitudeConstants, MergeEdges, RegionLinkage, region_linkage

K = AltitudeConstants()


@pytest.mark.parametrize(("known", "side"), [(True, 1.0), (True, -1.0), (False, 1.0), (False, -1.0)])
@pytest.mark.parametrize(
    ("times_as_large", "weight", "relief", "uneven", "cost"),
    [
        (1, 7.0, 15.0, 0.0, 0.4),
        (100, 7.0, 0.0, 0.0, 0.4),
        (100, 7.0, 0.0, 50.0, 0.4),
        (5, 60.0, 1000.0, 0.0, 0.3),
        (5, 60.0, 1000.0, 0.0, 1.2),
    ],
)
@pytest.mark.parametrize("color", [0.0, 2.0])
def test_the_altitude_of_two_regions_is_the_formula(times_as_large, weight, relief, uneven, cost, known, side, color):
    """With the smaller region before the larger one, or behind it, if that is known; and that one flat, or uneven; a
    contact short or long for their size, a valley flat or steep, and colours that count or do not.
    """
    graph, leaves, _, _ = random_graph("random", 2, np.random.default_rng(0))
    grown = leaves.counts * np.array([1, times_as_large])
    leaves = replace(leaves, counts=grown, scatters=leaves.scatters * (grown / leaves.counts)[:, None, None])
    unit = float(np.median(graph.edge_features.voxel_edge))
    leaves.scatters[grown.argmax()] += uneven * unit**2 * grown.max() * np.eye(3)
    nodes = replace(graph.node_features, normal=_normals_towards_the_smaller(leaves, side))
    graph = replace(graph, node_features=nodes, acquisition=UnknownAcquisition(Told(normals=known)))
    leaves = replace(
        leaves, normals=nodes.normal * [[1.0], [0.95]], colors=np.array([[0.9, 0.2, 0.1], [0.5, 0.3, 0.3]])
    )
    costs, weights = np.array([cost]), np.array([weight])
    found = region_linkage(graph, leaves, MergeEdges.of(graph.edges, costs, weights), color, relief).altitudes[0]
    mean = leaves.counts.mean()

    def residual(scatter):
        return float(np.linalg.eigvalsh(scatter / (unit**2 * mean))[0])

    a, b = leaves.scatters
    n = leaves.counts.astype(float)
    apart = leaves.centroids[0] - leaves.centroids[1]
    union = a + b + n[0] * n[1] / n.sum() * np.outer(apart, apart)
    increase, length = residual(union) - residual(a) - residual(b), weight / 2
    square = color**2 * (0.4**2 + 0.1**2 + 0.2**2)
    increase += n[0] * n[1] / n.sum() / mean * square
    least = K.e1 * n.min() / mean * (residual(leaves.scatters[n.argmax()]) / (n.max() / mean) - K.q0)
    assert (least > increase) == (uneven > 0.0)
    increase = max(increase, least)
    scale, width = increase / length, K.width * math.sqrt(n.min() / mean)
    stands_out = relief * _relief(leaves, unit, length, width) if side > 0.0 or not known else 0.0
    smooth = 1.0 / (1.0 + (0.05 / K.v1) ** 2)
    if side > 0.0 and times_as_large > K.r1:
        stands_out += K.h1 * max(cost - K.h0, 0.0) * smooth * n.min() / (n.min() + K.m2 * mean)
    evidence = cost + stands_out + K.c0 + K.c1 * math.log(1 + scale / K.l0)
    shortness = (width / (length + width)) ** 0.75
    steep = max(cost - K.c2, 0.0) * max(K.s0 - shortness, 0.0) * smooth
    assert cost < 1.0 or steep > 0.05
    of_colors = K.k1 * cost * (1.0 - shortness) * square / (1.0 + square) * n.min() / (n.min() + K.m2 * mean)
    evidence = evidence * shortness + steep + of_colors
    weighed = increase / (increase + K.e0) * math.sqrt(scale / (scale + K.l0))
    weighed *= (1.0 + n.max() / (K.r * n.min())) ** 0.25 * n.min() / (n.min() + K.m0 * mean)
    assert found == pytest.approx(evidence * weighed, rel=1e-5, abs=2e-6)
    assert found > 1e-3
    assert relief < 1000.0 or (known and side < 0.0) or stands_out > 0.1 * evidence


def test_the_documentation_has_the_constants():
    text = (Path(__file__).parents[2] / "docs" / "pcgraph_method.md").read_text(encoding="utf-8")
    table = text[text.index("| constant | | constant |") : text.index("- *Concavity*")]
    found = {
        name: float(Fraction(value)) for name, value in re.findall(r"\| (\w\d?) \| ([\d./]+)(?: rad)? (?=\|)", table)
    }
    assert found == {name: getattr(K, name) for name in found}
    assert set(found) == {"c0", "c1", "c2", "k1", "s0", "v1", "e0", "e1", "q0", "l0", "r", "m0", "m2"}


def _normals_towards_the_smaller(leaves, side):
    small, large = np.argsort(leaves.counts, kind="stable")
    normal = np.linalg.eigh(leaves.scatters[large])[1][:, 0]
    towards = side * np.sign(normal @ (leaves.centroids[small] - leaves.centroids[large])) * normal
    return np.stack((towards, towards))


def _relief(leaves, unit, length, width):
    """R of the formula, of two regions that touch nothing else."""
    small, large = np.argsort(leaves.counts, kind="stable")
    m, larger = leaves.counts[[small, large]] / leaves.counts.mean()
    normal = np.linalg.eigh(leaves.scatters[large])[1][:, 0] / unit
    square = float(normal @ (leaves.centroids[small] - leaves.centroids[large])) ** 2
    across = [float(normal @ leaves.covariances[region] @ normal) for region in (small, large)]
    noise = 4.0 * across[0] + across[1] + K.v0
    around = min(length / (K.b1 * width), 1.0) ** 2 * max(1.0 - K.r1 * m / larger, 0.0) * m / (m + K.m2)
    return around / (1.0 + (noise / square) ** 8) / (1.0 + square / K.d1**2)


def _wall(height, slope=None):
    """A wall of 2 m x 1.5 m with a panel on it, or in it, or a hill on it, and which points are the panel's."""
    x, y = (c.ravel() for c in np.meshgrid(np.arange(0.0, 2.0, 0.01), np.arange(0.0, 1.5, 0.01)))
    outside = np.maximum(np.abs(x - 1.0) - 0.35, np.abs(y - 0.75) - 0.3)
    z = height * (outside < 0.0 if slope is None else np.clip(-outside / slope, 0.0, 1.0))
    z = z + np.random.default_rng(0).normal(0.0, 0.001, len(x))
    return np.stack((x, y, z), axis=1), (outside < 0.0).astype(int)


@pytest.mark.parametrize("height", [0.01, 0.02, 0.03])
def test_what_stands_in_relief_is_an_object(height):
    """A step of half a voxel to less than two, which normals of voxels don't show."""
    points, truth = _wall(height)
    found = pcgraph.segment(points, viewpoint=(1.0, 0.75, 3.0))
    assert 0.5 < height / found.voxel_size < 2.0
    assert found.labels.max() == 1
    assert pcgraph.metrics.segmentation_covering(found.labels, truth) > 0.97
    without = pcgraph.segment(points, viewpoint=(1.0, 0.75, 3.0), linkage=RegionLinkage(relief=0.0))
    assert without.labels.max() == 0


@pytest.mark.parametrize("height", [-0.01, -0.02, -0.03])
def test_what_is_sunk_into_a_surface_is_not(height):
    points, _ = _wall(height)
    assert pcgraph.segment(points, viewpoint=(1.0, 0.75, 3.0)).labels.max() == 0
    assert pcgraph.segment(points, viewpoint=(1.0, 0.75, -3.0)).labels.max() == 1  # from behind it stands out


@pytest.mark.parametrize("turn", [0.0, 90.0, 180.0, 270.0])
def test_turning_a_sheet_seen_from_who_knows_where_changes_no_object(turn):
    """Which of its sides is the outer one, nothing tells."""
    points, truth = _wall(0.02)
    found = pcgraph.segment(points @ Rotation.from_euler("x", turn, degrees=True).as_matrix().T)
    assert not found.acquisition.sides_known
    assert pcgraph.metrics.segmentation_covering(found.labels, truth) > 0.97


def test_a_thing_in_a_hollow_of_rolling_ground_is_no_less_one_than_on_a_hill():
    """The plane of the ground runs through what stands in the hollow."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0.0, 40.0, (2, 80_000))
    ground = np.stack((x, y, np.sin(x * np.pi / 10.0) + rng.normal(0.0, 0.01, len(x))), axis=1)
    clouds, things = [ground], 0
    for middle_x in (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0):
        for middle_y in (10.0, 20.0, 30.0):
            bale = rng.normal(size=(120, 3))
            bale = bale / np.linalg.norm(bale, axis=1, keepdims=True) * 0.6
            height = np.sin(middle_x * np.pi / 10.0)
            bale = bale[bale[:, 2] > -0.3] + [middle_x, middle_y, height + 0.4]
            clouds.append(bale)
            things += 1
    points, truth = np.concatenate(clouds), np.repeat(np.arange(things + 1), [len(cloud) for cloud in clouds])
    labels = pcgraph.segment(points).labels
    alone = [truth[labels == np.bincount(labels[truth == thing] + 1).argmax() - 1] for thing in range(1, things + 1)]
    assert sum(np.mean(found > 0) > 0.9 for found in alone) == things


@pytest.mark.parametrize(
    ("degrees", "noise", "least"),
    [(28.0, 0.01, 0.97), (33.0, 0.03, 0.97), (38.0, 0.06, 0.96), (48.0, 0.03, 0.97), (48.0, 0.06, 0.96)],
)
@pytest.mark.parametrize("seed", draws(3, 1))
def test_heaps_are_objects_however_long_the_line_around_them(degrees, noise, least, seed):
    """Of 28 to 43 degrees, as sand and gravel lie, they were one object with the ground, of 48 in more noise."""
    rng = np.random.default_rng(seed)
    places, radii = rng.uniform(0.0, 30.0, (60_000, 2)), np.array([3.0, 4.0, 5.0, 6.0])
    middles = np.array([(8.0, 8.0), (22.0, 8.0), (8.0, 22.0), (22.0, 22.0)])
    off = np.linalg.norm(places[:, None] - middles, axis=2)
    heights = np.tan(np.radians(degrees)) * np.maximum(radii - off, 0.0)
    points = np.column_stack((places, heights.max(axis=1) + rng.normal(0.0, noise, len(places))))
    truth = np.where(heights.max(axis=1) > 0.0, heights.argmax(axis=1) + 1, 0)
    assert pcgraph.metrics.segmentation_covering(pcgraph.segment(points).labels, truth) > least


@pytest.mark.parametrize(("height", "slope"), [(0.0, None), (0.05, 0.2), (0.08, 0.2), (0.1, 0.3)])
def test_a_gentle_hill_is_no_object(height, slope):
    """Of 22 degrees at most: the valley around it is below the altitude of objects."""
    points, _ = _wall(height, slope)
    assert pcgraph.segment(points, viewpoint=(1.0, 0.75, 3.0)).labels.max() == 0


@pytest.mark.parametrize("slope", [0.15, 0.2])
def test_a_hollow_of_which_a_valley_surrounds_the_floor_is_no_object(slope):
    points, truth = _wall(-0.1, slope)
    found = pcgraph.segment(points, viewpoint=(1.0, 0.75, 3.0))
    assert found.labels.max() == 0
    heap = pcgraph.segment(points * [1.0, 1.0, -1.0], viewpoint=(1.0, 0.75, 3.0))
    assert heap.labels.max() == 1
    assert pcgraph.metrics.segmentation_covering(heap.labels, truth) > 0.95


@pytest.mark.parametrize("kind", ["random", "chain", "star"])
def test_altitudes_rise_and_all_that_is_connected_merges(kind):
    graph, leaves, _, _ = random_graph(kind, 200, np.random.default_rng(3))
    merges = RegionLinkage().merges(graph, leaves)
    assert (np.diff(merges.altitudes) >= 0).all()
    assert len(np.unique(merges.pairs)) == merges.pairs.size
    again = RegionLinkage().merges(graph, leaves)
    assert again.pairs.tobytes() == merges.pairs.tobytes()


def test_a_plane_is_one_region_before_a_box_is():
    points, truth, viewpoint = two_boxes_on_a_plane()
    result = pcgraph.segment(points, viewpoint=viewpoint)
    assert pcgraph.metrics.segmentation_covering(result.labels, truth) > 0.99
    flat = np.unique(result.supervoxels[(truth == 0) & (np.abs(points[:, 2]) < 1e-9)])
    whole = result.tree.cut(altitude=0.001)
    assert np.bincount(whole[flat]).max() > 0.9 * len(flat)


def test_concavity_parts_what_convexity_joins():
    x, y = (c.ravel() for c in np.meshgrid(np.arange(0.0, 1.0, 0.01), np.arange(0.0, 1.0, 0.01)))
    roof = np.stack((x - 0.5, y, 0.3 - 0.8 * np.abs(x - 0.5)), axis=1)
    seen_from = {"above": (0.0, 0.5, 9.0), "below": (0.0, 0.5, -9.0)}
    merged_at = {side: pcgraph.segment(roof, viewpoint=place).tree.altitudes[-1] for side, place in seen_from.items()}
    assert merged_at["below"] > 3 * merged_at["above"]
    assert pcgraph.segment(roof, viewpoint=seen_from["above"]).labels.max() == 0
    assert pcgraph.segment(roof, viewpoint=seen_from["below"]).labels.max() == 1


def test_a_gap_narrower_than_a_voxel_costs_nothing_beyond_its_contact():
    """Centroids of voxels of several sizes can be nearer than the larger edge; the price was negative there, and the
    altitudes with a high price were not finite."""
    points, _, _ = two_boxes_on_a_plane()
    points = points[(points[:, 0] < 0.8) | (points[:, 0] > 0.9)]
    result = pcgraph.segment(points, voxel_size=0.03)
    gaps = result.graph.gaps
    assert len(gaps.widths)
    found = [
        RegionLinkage(gap=10.0).merges(replace(result.graph, gaps=replace(gaps, widths=widths)), result.leaves)
        for widths in (np.full(len(gaps.widths), 0.3), np.ones(len(gaps.widths)))
    ]
    assert np.isfinite(found[0].altitudes).all()
    assert np.array_equal(found[0].altitudes, found[1].altitudes)


def test_settings_are_checked():
    with pytest.raises(ValueError, match="gap"):
        RegionLinkage(gap=-1.0)
    with pytest.raises(ValueError, match="relief"):
        RegionLinkage(relief=np.nan)
    with pytest.raises(ValueError, match="BoundaryCost"):
        RegionLinkage(cost=3)


def _two_halves_of_a_plane(colors):
    x, y = (c.ravel() for c in np.meshgrid(np.arange(0.0, 1.0, 0.01), np.arange(0.0, 0.5, 0.01)))
    return pcgraph.segment(np.stack((x, y, 0.0 * x), axis=1), colors(x), viewpoint=(0.5, 0.25, 2.0))


def test_colours_part_a_plane_last_but_never_into_objects():
    truth = (np.meshgrid(np.arange(0.0, 1.0, 0.01), np.arange(0.0, 0.5, 0.01))[0].ravel() > 0.495).astype(int)
    painted = _two_halves_of_a_plane(lambda x: np.where(x[:, None] > 0.495, (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)))
    assert pcgraph.metrics.segmentation_covering(painted.cut(n=2), truth) > 0.98
    assert painted.labels.max() == 0
    plain = _two_halves_of_a_plane(lambda x: np.full((len(x), 3), 0.4))
    bare = _two_halves_of_a_plane(lambda x: None)
    assert plain.tree.altitudes.tobytes() == bare.tree.altitudes.tobytes()


def test_colour_that_is_noise_changes_no_object():
    points, truth, viewpoint = two_boxes_on_a_plane()
    noise = np.random.default_rng(0).random((len(points), 3))
    result = pcgraph.segment(points, noise, viewpoint=viewpoint)
    assert pcgraph.metrics.segmentation_covering(result.labels, truth) > 0.99


def _wedge(degrees, colors):
    """Two strips that meet at 180 degrees less so many, along a line three times as long as they are wide: a valley."""
    rng, n = np.random.default_rng(0), 30_000
    x, y = rng.uniform(-1.0, 1.0, n), rng.uniform(0.0, 6.0, n)
    points = np.stack((x, y, np.abs(x) * math.tan(math.radians(degrees) / 2.0)), axis=1) + rng.normal(0, 0.002, (n, 3))
    right = x > 0.0
    return points, np.clip(np.array(colors)[right.astype(int)] + rng.normal(0.0, 0.02, (n, 3)), 0.0, 1.0), right


_WHITE, _BROWN = (0.8, 0.8, 0.8), (0.5, 0.3, 0.2)


@pytest.mark.parametrize("degrees", [15, 25])
def test_a_valley_along_which_colours_change_parts_objects_however_long(degrees):
    points, colors, right = _wedge(degrees, (_WHITE, _BROWN))
    labels = pcgraph.segment(points, colors, viewpoint=(0.0, 3.0, 8.0)).labels
    assert pcgraph.metrics.segmentation_covering(labels, right.astype(int)) > 0.99


@pytest.mark.parametrize(
    ("degrees", "colors"), [(25, (_WHITE, _WHITE)), (-25, (_WHITE, _BROWN)), (0, (_WHITE, _BROWN))]
)
def test_without_a_valley_or_without_a_change_of_colour_one_thing_stays_one(degrees, colors):
    points, colors, _ = _wedge(degrees, colors)
    assert pcgraph.segment(points, colors, viewpoint=(0.0, 3.0, 8.0)).objects.max() == 0
