# SPDX-License-Identifier: Apache-2.0
"""Features that are given beside the points: any unit, noise and constants count for nothing, what differs parts."""

from __future__ import annotations

from dataclasses import fields
from functools import cache

import numpy as np
import pytest
from checks import same_partition
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes.rays import camera
from scenes.surfaces import SPACING, patch
from scenes.tables import two_boxes_on_a_plane

import pcgraph
from pcgraph.columns import CLIP, RobustScaling
from pcgraph.features.moments import moments_of_groups
from pcgraph.io.ply import encode_ply
from pcgraph.metrics import undersegmentation_error

SQUARE = patch((0, 0, 1), (0.8, 0, 0), (0, 0.8, 0))
HALF = (SQUARE[:, 0] > 0.4133).astype(int)
OPTIONS = {"voxel_size": 2 * SPACING, "seed_size": 0.12, "viewpoint": (0.4, 0.4, -1.0)}
RNG = np.random.default_rng(5)
INTENSITY = np.where(HALF, 30.0, 10.0) + RNG.standard_normal(len(SQUARE))


@cache
def without_features():
    """The segmentation of the square by its points alone."""
    return pcgraph.segment(SQUARE, **OPTIONS)


@cache
def by_intensity():
    """The segmentation of the square whose halves differ in intensity."""
    return pcgraph.segment(SQUARE, features=INTENSITY, **OPTIONS)


def same_bytes(a, b):
    """Whether two segmentations agree in all but the features themselves."""
    assert np.array_equal(a.labels, b.labels)
    assert np.array_equal(a.supervoxels, b.supervoxels)
    for one, other in ((a.tree, b.tree), (a.graph, b.graph)):
        for name in ("parents", "altitudes", "edges"):
            assert getattr(one, name, np.zeros(1)).tobytes() == getattr(other, name, np.zeros(1)).tobytes()
    for name, column in a.leaves.columns().items():
        assert name == "features" or column.tobytes() == b.leaves.columns()[name].tobytes()
    for field in fields(a.graph.edge_features):
        of_a, of_b = (getattr(result.graph.edge_features, field.name) for result in (a, b))
        assert of_a.tobytes() == of_b.tobytes()


@pytest.mark.parametrize("method", [pcgraph.SurfaceGrowth(), pcgraph.Vccs(spatial_weight=0.2)], ids=["growth", "vccs"])
def test_coplanar_halves_that_differ_in_intensity_alone_become_different_supervoxels(method):
    blind = pcgraph.segment(SQUARE, **OPTIONS, method=method)
    seeing = pcgraph.segment(SQUARE, features=INTENSITY, **OPTIONS, method=method)
    assert undersegmentation_error(blind.supervoxels, HALF) > 0.1
    inside = np.abs(SQUARE[:, 0] - 0.4133) > 2 * SPACING  # but for voxels that hold both
    sides = [np.unique(seeing.supervoxels[inside & (side == HALF)]) for side in (0, 1)]
    assert not np.intersect1d(*sides).size
    means = seeing.graph.node_features.features
    assert means.shape == (seeing.graph.n_nodes, 1)
    assert means[sides[0]].max() < means[sides[1]].min()
    off = type(method)(feature_weight=0.0, spatial_weight=method.spatial_weight)
    same_bytes(pcgraph.segment(SQUARE, features=INTENSITY, **OPTIONS, method=off), blind)


@pytest.mark.parametrize(("unit", "offset"), [(2.0**-30, 0.0), (1e-3, 0.0), (-7.0, 0.0), (1.0, 1e6), (255.0, -3e4)])
def test_unit_and_offset_do_not_matter(unit, offset):
    expected = by_intensity()
    found = pcgraph.segment(SQUARE, features=INTENSITY * unit + offset, **OPTIONS)
    assert np.array_equal(found.supervoxels, expected.supervoxels)
    features = np.sign(unit) * found.graph.node_features.features
    assert features == pytest.approx(expected.graph.node_features.features, abs=1e-3)


CONSTANT = {
    "constant": np.full(len(SQUARE), 7.3),
    "integer": np.full(len(SQUARE), 7, np.uint8),
    "nan": np.full(len(SQUARE), np.nan),
    "constant or unknown": np.where(HALF, 7.3, np.nan),
}


@pytest.mark.parametrize("name", CONSTANT)
def test_a_constant_changes_nothing_to_the_byte(name):
    same_bytes(pcgraph.segment(SQUARE, features=CONSTANT[name], **OPTIONS), without_features())
    alone = by_intensity()
    both = pcgraph.segment(SQUARE, features=np.stack((CONSTANT[name], INTENSITY), axis=1), **OPTIONS)
    same_bytes(both, alone)
    assert (both.graph.node_features.features[:, 0] == 0.0).all()
    assert np.array_equal(both.graph.node_features.features[:, 1:], alone.graph.node_features.features)


def test_noise_changes_nothing_to_the_byte():
    noise = np.random.default_rng(1).standard_cauchy((len(SQUARE), 3))
    same_bytes(pcgraph.segment(SQUARE, features=noise, **OPTIONS), without_features())


def test_order_does_not_matter():
    points, truth, viewpoint = two_boxes_on_a_plane()
    rng = np.random.default_rng(2)
    features = np.stack((truth + 0.3 * rng.standard_normal(len(points)), points[:, 0], rng.random(len(points))), axis=1)
    features[rng.random(len(points)) < 0.1, 0] = np.nan
    order = rng.permutation(len(points))
    first = pcgraph.segment(points, viewpoint=viewpoint, features=features)
    second = pcgraph.segment(points[order], viewpoint=viewpoint, features=features[order])
    assert np.array_equal(first.supervoxels[order], second.supervoxels)
    assert first.leaves.features.tobytes() == second.leaves.features.tobytes()
    assert same_partition(first.labels[order], second.labels)


def test_shape_type_and_holes_of_the_input():
    image = camera(np.arange(60) * 0.01 - 0.3, np.arange(50) * 0.01 - 0.25)
    image[3:6, 7] = np.nan
    levels = np.where(image[..., 0] > 0.013, 200, 40).astype(np.uint16)
    listed = pcgraph.segment(image.reshape(-1, 3), viewpoint=(0, 0, 0), features=levels.reshape(-1), camera=True)
    for features in (levels, levels[..., None], levels.astype(np.float16), levels.tolist()):
        found = pcgraph.segment(image, features=features)
        assert np.array_equal(found.supervoxels.reshape(-1), listed.supervoxels)
    hole = levels.astype(float)
    hole[3:6, 7] = np.inf  # where there is no point
    assert np.array_equal(pcgraph.segment(image, features=hole).supervoxels, found.supervoxels)


# --- scaling ----------------------------------------------------------------------------------------------------------


def test_normal_values_are_standardised():
    values = np.random.default_rng(0).normal(40.0, 3.0, (50_000, 1))
    scaling = RobustScaling.of(values)
    assert scaling.centers == pytest.approx([40.0], abs=0.05)
    assert scaling.spreads == pytest.approx([3.0], rel=0.02)
    assert scaling.scaled(values).std() == pytest.approx(1.0, rel=0.02)
    wild = values.copy()
    wild[:1000] = 1e12  # heavy tails change little
    assert RobustScaling.of(wild).spreads == pytest.approx(scaling.spreads, rel=0.05)
    assert RobustScaling.of(wild).scaled(wild).max() == CLIP


@pytest.mark.parametrize("rare", [0.3, 0.2, 0.03, 0.001])
def test_a_column_of_two_values_keeps_them_apart(rare):
    values = np.zeros((10_000, 1))
    values[: int(rare * len(values))] = 5.0
    scaled = RobustScaling.of(values).scaled(values)
    assert scaled.max() - scaled.min() > 1.3


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.floats(allow_infinity=False, width=64), min_size=1, max_size=40),
    power=st.integers(-40, 40),
)
def test_any_column_is_scaled_to_finite_numbers(values, power):
    column = np.array(values)[:, None]
    scaled = RobustScaling.of(column).scaled(column)
    assert (np.abs(scaled) <= CLIP).all()
    assert (scaled[np.isnan(column)] == 0.0).all()
    known = column[~np.isnan(column)]
    if len(known) and np.abs(known).min() > 1e-200 and np.abs(known).max() < 1e200:
        again = RobustScaling.of(column * 2.0**power).scaled(column * 2.0**power)
        assert np.array_equal(again, scaled)


def test_means_of_voxels_nodes_and_trees_are_those_of_numpy():
    result = pcgraph.segment(SQUARE, features=np.stack((INTENSITY, SQUARE[:, 1]), axis=1), **OPTIONS)
    scaled = result.feature_scaling.scaled(np.stack((INTENSITY, SQUARE[:, 1]), axis=1)).astype(float)
    grid, leaf = result.surface.grid, result.supervoxels
    for owner, means in ((grid.voxel_of_point, grid.features), (leaf, result.leaves.features)):
        expected = np.stack([np.bincount(owner, column) for column in scaled.T], axis=1) / np.bincount(owner)[:, None]
        assert np.array_equal(means, expected)  # sums of whole steps are exact
    root = result.tree.features().features[-1]
    assert root == pytest.approx(scaled.mean(axis=0), abs=1e-12)


def test_features_without_points_change_no_other_moment():
    rng = np.random.default_rng(3)
    points, groups = rng.random((90, 3)), np.repeat([0, 1, 2], 30).astype(np.int32)
    with_features = moments_of_groups(points, None, groups, 3, rng.random((90, 2)).astype(np.float32))
    assert with_features.colors is None
    assert np.array_equal(with_features.scatters, moments_of_groups(points, None, groups, 3).scatters)


# --- scans that follow ------------------------------------------------------------------------------------------------


def test_updates_use_the_scale_of_the_first_scan():
    left, right = SQUARE[:, 0] < 0.5, SQUARE[:, 0] > 0.3
    first = pcgraph.segment(SQUARE[left], features=INTENSITY[left], **OPTIONS)
    second = pcgraph.update(first, SQUARE[right], features=INTENSITY[right])
    assert second.feature_scaling is first.feature_scaling
    both = np.concatenate((INTENSITY[left], INTENSITY[right]))[:, None]
    scaled, leaf = first.feature_scaling.scaled(both)[:, 0], np.concatenate((first.supervoxels, second.supervoxels))
    assert second.leaves.features[:, 0] == pytest.approx(np.bincount(leaf, scaled) / np.bincount(leaf), abs=1e-9)
    for features, message in (
        (None, "features with both scans or with neither"),
        (np.ones((right.sum(), 2)), "1 columns of features as in the earlier scan, got 2"),
    ):
        with pytest.raises(ValueError, match=message):
            pcgraph.update(first, SQUARE[right], features=features)
    with pytest.raises(ValueError, match="features with both scans or with neither"):
        pcgraph.update(without_features(), SQUARE, features=INTENSITY)


# --- names of columns -------------------------------------------------------------------------------------------------


def test_columns_by_name(tmp_path):
    columns = {"Intensity": INTENSITY, "wide": np.stack((INTENSITY, SQUARE[:, 1]), axis=1), "beam": HALF.astype("u1")}
    cloud = pcgraph.Cloud(SQUARE, columns=columns)
    same_bytes(pcgraph.segment(cloud, **OPTIONS), without_features())  # none counts unless named
    for names, table in (
        ("Intensity", INTENSITY),
        (["wide"], columns["wide"]),
        (("beam", "Intensity"), np.stack((HALF, INTENSITY), axis=1)),
        (INTENSITY, INTENSITY),
    ):
        expected = by_intensity() if table is INTENSITY else pcgraph.segment(SQUARE, features=table, **OPTIONS)
        found = pcgraph.segment(cloud, features=names, **OPTIONS)
        same_bytes(found, expected)
        assert np.array_equal(found.leaves.features, expected.leaves.features)
    stored = {name: SQUARE[:, i] for i, name in enumerate("xyz")} | {"Intensity": INTENSITY}
    (tmp_path / "a.ply").write_bytes(encode_ply(stored))
    of_file = pcgraph.segment(tmp_path / "a.ply", features="Intensity", **OPTIONS)
    same_bytes(of_file, by_intensity())
    later = pcgraph.update(of_file, tmp_path / "a.ply", features="Intensity")
    assert later.leaves.features == pytest.approx(of_file.leaves.features, abs=1e-12)


n = len(SQUARE)
CLOUD = pcgraph.Cloud(SQUARE, columns={"ring": HALF, "short": HALF[:5], "text": np.full(n, "a"), "far": HALF / 0.3})
BAD = {
    "unknown name": (CLOUD, "intensity", "columns of the cloud, got 'intensity'; there are: ring, short, text, far"),
    "no columns": (pcgraph.Cloud(SQUARE), "x", "got 'x'; there are: none"),
    "short column": (CLOUD, ["ring", "short"], r"the column 'short' in the points' shape \(6561,\), got \(5,\)"),
    "column of text": (CLOUD, "text", "the column 'text' of a floating-point or integer dtype"),
    "names for an array": (SQUARE, "ring", "got 'ring'; there are: none"),
    "few": (SQUARE, INTENSITY[:-1], r"features of the points' leading shape, \(6561,\) or \(6561,\) \+ \(d,\), got"),
    "too deep": (SQUARE, INTENSITY[:, None, None], "leading shape"),
    "none": (SQUARE, np.empty((n, 0)), "leading shape"),
    "a number": (SQUARE, 3.0, "leading shape"),
    "infinite": (SQUARE, np.where(HALF, np.inf, 0.0), "finite features at finite points, or NaN where unknown"),
    "words": (SQUARE, np.full(n, "a"), "features of a floating-point or integer dtype"),
    "truth values": (SQUARE, HALF > 0, "features of a floating-point or integer dtype, got bool"),
    "ragged": (SQUARE, [[1.0], [1.0, 2.0]], "features as a regular array"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_features(name):
    points, features, message = BAD[name]
    with pytest.raises(ValueError, match=message) as error:
        pcgraph.segment(points, features=features)
    assert "\n" not in str(error.value)


def test_exports_have_features_by_number():
    graph = pcgraph.segment(SQUARE, features=np.stack((INTENSITY, SQUARE[:, 1]), axis=1), **OPTIONS).graph
    names = graph.to_pyg()["x_names"]
    assert {"feature_0", "feature_1"} < {*names}
    assert graph.to_networkx().nodes[0]["feature_1"] == graph.node_features.features[0, 1]
    plain = without_features().graph
    assert plain.node_features.features.shape == (plain.n_nodes, 0)
    assert "features" not in plain.node_features.columns()
