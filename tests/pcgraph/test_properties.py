# SPDX-License-Identifier: Apache-2.0
"""Laws of `pcgraph.segment` and `pcgraph.update` that hold for any cloud, any input form and any setting."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest
from checks import SEEDS, assert_covered_and_connected, refines, same_partition
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes.rooms import things_on_a_floor
from scenes.tables import two_boxes_on_a_plane
from tiers import draws

import pcgraph
from pcgraph import (
    ConvexityLinkage,
    FelzenszwalbLinkage,
    LccpLinkage,
    MumfordShahLinkage,
    QuasiFlatLinkage,
    SurfaceGrowth,
    Vccs,
    WardLinkage,
)
from pcgraph.voxels.grid import voxel_grid

pytestmark = pytest.mark.filterwarnings("ignore::pcgraph.plausibility.CloudWarning")  # any cloud, sane or not

METHODS = [SurfaceGrowth(), Vccs(), SurfaceGrowth(0.0, 0.0, 0.0), Vccs(color_weight=0.0)]
LINKAGES = [
    ConvexityLinkage(),
    LccpLinkage(),
    FelzenszwalbLinkage(),
    WardLinkage(),
    MumfordShahLinkage(),
    QuasiFlatLinkage(),
]


# --- clouds -----------------------------------------------------------------------------------------------------------


def lattice(rng, n):
    return rng.integers(0, rng.integers(1, 9), (n, 3)) * 0.125


def plane(rng, n):
    return rng.random((n, 2)) @ rng.normal(size=(2, 3)) + rng.normal(size=3)


def line(rng, n):
    return rng.random((n, 1)) * rng.normal(size=3) + rng.normal(size=3)


def shell(rng, n):
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) + [0.0, 0.0, 2.0]


def duplicates(rng, n):
    return rng.random((max(1, n // 5), 3))[rng.integers(0, max(1, n // 5), n)]


def clusters(rng, n):
    return rng.normal(size=(4, 3))[rng.integers(0, 4, n)] + rng.normal(size=(n, 3)) * 10.0 ** rng.integers(
        -6, 0, (n, 1)
    )


def scales(rng, n):
    return rng.normal(size=(n, 3)) * 10.0 ** rng.integers(-9, 10, (n, 1))


def offset(rng, n):
    return rng.random((n, 3)) + rng.normal(size=3) * 10.0 ** rng.integers(2, 9)


def boxes(rng, n):
    points, _, _ = two_boxes_on_a_plane()
    return points[rng.permutation(len(points))[: 4 * n]]


SHAPES = [lattice, plane, line, shell, duplicates, clusters, scales, offset, boxes]
GENERIC = [plane, shell, boxes]
quick = settings(max_examples=20, deadline=None)
rngs = SEEDS.map(np.random.default_rng)
sizes_of_cloud = st.integers(1, 120)
over_clouds = given(rng=rngs, n=sizes_of_cloud, shape=st.sampled_from(SHAPES))
over_generic_clouds = given(rng=rngs, n=sizes_of_cloud, shape=st.sampled_from(GENERIC))


def cloud_of(shape, rng, n):
    return np.ascontiguousarray(shape(rng, n), float)


def extent(points):
    return float(np.ptp(points, axis=0).max()) or 1.0


@st.composite
def settings_of(draw, points):
    """Keywords for `segment` that fit these points, from voxels far below the spacing to larger than the cloud."""
    chosen = {"method": draw(st.sampled_from(METHODS)), "linkage": draw(st.sampled_from(LINKAGES))}
    if draw(st.booleans()):
        chosen["voxel_size"] = extent(points) * draw(st.sampled_from([1e-9, 1e-3, 0.03, 0.1, 0.3, 3.0, 1e9]))
        if draw(st.booleans()):
            chosen["seed_size"] = chosen["voxel_size"] * draw(st.sampled_from([1.0, 1.5, 4.0, 30.0, 1e12]))
    if "seed_size" not in chosen and draw(st.booleans()):
        chosen["n_supervoxels"] = draw(st.sampled_from([1, 7, 1000]))
    kind = draw(st.sampled_from(["default", "inside", "one", "each", "camera", "range"]))
    if kind == "inside":
        chosen["viewpoint"] = points[len(points) // 2]
    elif kind == "one":
        chosen["viewpoint"] = draw(st.sampled_from([(0.0, 0.0, 0.0), (1e9, 0.0, -1e9), (0.3, -2.0, 5.0)]))
    elif kind == "each":
        chosen["viewpoint"] = points[::-1] + draw(st.sampled_from([0.0, 1.0, 1e6]))
    elif kind == "camera":
        chosen["camera"] = True
        chosen["viewpoint"] = points.min(axis=0) - extent(points) * draw(st.sampled_from([0.01, 1.0, 100.0]))
    elif kind == "range":
        chosen["range_growth"] = draw(st.sampled_from([1e-9, 0.3, 0.5, 0.9, 0.99]))
        if draw(st.booleans()):
            chosen["viewpoint"] = points[0]
    return chosen


def attributes(rng, n):
    """Colours and normals in one of the forms that callers have, or none."""
    normals = rng.normal(size=(n, 3))
    odd = rng.random((n, 3))
    normals[odd[:, 0] < 0.2] = 0.0
    normals[odd[:, 1] < 0.1, 1] = np.nan
    normals[odd[:, 2] < 0.1] *= 1e300
    colors = rng.random((n, 3))
    return (
        [None, colors, colors.astype(np.float16), (colors * 255).astype(np.uint8)][rng.integers(4)],
        [None, normals, np.tile([0.0, 0.0, -1.0], (n, 1)), normals.astype(">f8")][rng.integers(4)],
    )


# --- laws -------------------------------------------------------------------------------------------------------------


def assert_edges_are_the_contacts(result):
    """Edges are unique, sorted, i < j, and exactly the pairs of supervoxels of which two voxels touch."""
    edges, grid, owner = result.graph.edges, result.surface.grid, result.surface.supervoxels
    row = np.repeat(np.arange(grid.n_voxels), np.diff(grid.indptr))
    links = set(zip(row.tolist(), grid.neighbours.tolist(), strict=True))
    assert links == {(b, a) for a, b in links}
    pairs = {tuple(sorted((int(owner[a]), int(owner[b])))) for a, b in links if owner[a] != owner[b]}
    assert edges.tolist() == sorted(map(list, pairs))
    for name, column in result.graph.edge_features.columns().items():
        assert len(column) == len(edges)
        assert np.isfinite(column).all(), name


def assert_moments_are_direct(moments, points, leaf):
    """Counts, means and scatters agree with the sums over each group's points."""
    for group in range(int(leaf.max()) + 1):
        mine = points[leaf == group]
        local = mine - mine[0]
        mean = local.mean(axis=0)
        scatter = (local - mean).T @ (local - mean)
        rounding = 1e-15 * np.abs(mine).max()
        spread = np.sqrt(np.trace(scatter))
        assert moments.counts[group] == len(mine)
        assert np.abs(moments.centroids[group] - (mine[0] + mean)).max() <= 1e-6 * np.abs(local).max() + 4 * rounding
        bound = 1e-6 * np.abs(scatter).max() + len(mine) * (4 * rounding) ** 2 + 8 * rounding * spread
        assert np.abs(moments.scatters[group] - scatter).max() <= bound


def assert_tree_is_nested(result):
    tree = result.tree
    assert not np.isnan(tree.altitudes).any()
    assert (tree.altitudes[tree.parents] >= tree.altitudes).all()
    k = result.graph.n_nodes
    numbers = np.unique(np.linspace(1, k, 12).astype(int))
    cuts = [tree.cut(n=int(number)) for number in numbers]
    assert [int(cut.max()) + 1 for cut in cuts] == numbers.tolist()
    levels = np.unique(tree.altitudes)[::-1][:: max(1, k // 12)]
    by_altitude = [tree.cut(altitude=level) for level in levels.tolist() if np.isfinite(level)]
    least = [tree.cut(altitude=0.0, min_size=size) for size in (1, 2, 5, 1000)]
    energy = pcgraph.plane_energy(tree, result.graph)
    optimal = [tree.cut_optimal(energy, scale) for scale in (1e3, 1.0, 1e-3, 0.0)]
    for family in (cuts, by_altitude, [*least][::-1], optimal):
        for coarse, fine in pairwise(family):
            assert refines(fine, coarse)


@settings(max_examples=60, deadline=None)
@given(rng=rngs, n=sizes_of_cloud, shape=st.sampled_from(SHAPES), data=st.data())
def test_any_cloud_in_any_setting_keeps_every_promise(rng, n, shape, data):
    points = cloud_of(shape, rng, n)
    chosen = data.draw(settings_of(points))
    colors, normals = attributes(rng, len(points))
    result = pcgraph.segment(points, colors, normals, **chosen)
    assert_covered_and_connected(points, result)
    assert np.array_equal(result.labels, result.cut(altitude=chosen["linkage"].default_object_altitude))
    assert_edges_are_the_contacts(result)
    assert_moments_are_direct(result.leaves, points, result.supervoxels)
    assert_tree_is_nested(result)
    assert result.tree.moments.counts[-1] == len(points)
    assert np.allclose(np.linalg.norm(result.surface.normals, axis=1), 1.0)
    saliency = result.saliency()
    assert saliency.shape == result.labels.shape
    assert (saliency >= 0.0).all()


@quick
@given(rng=rngs, h=st.integers(1, 12), w=st.integers(1, 12), camera=st.sampled_from([None, False, True]))
def test_images_with_holes_rows_and_columns_missing(rng, h, w, camera):
    image = rng.random((h, w, 3)) * 0.2 + [0.0, 0.0, 1.0]
    holes = rng.random((h, w)) < rng.choice([0.0, 0.3, 0.9])
    holes[rng.random(h) < 0.3] = True
    holes[:, rng.random(w) < 0.2] = True
    holes[rng.integers(h), rng.integers(w)] = False
    image[holes, rng.integers(3)] = rng.choice([np.nan, np.inf, -np.inf])
    colors = rng.random((h, w, 3))
    colors[holes] = np.nan  # of a point that is not there, the colour does not matter
    result = pcgraph.segment(image, colors, viewpoint=(0, 0, 0), camera=camera)
    assert_covered_and_connected(image, result)
    assert np.array_equal(np.isnan(result.saliency()), holes)
    result.occlusions()
    result.primitives(image)
    # The same points without the holes are the same supervoxels, given what their order told of the camera's depth.
    flat, sizes = image[~holes], {"voxel_size": result.voxel_size, "seed_size": result.seed_size}
    same = pcgraph.segment(flat, colors[~holes], viewpoint=(0, 0, 0), camera=result.camera, **sizes)
    assert np.array_equal(same.supervoxels, result.supervoxels[~holes])
    assert np.array_equal(same.tree.altitudes, result.tree.altitudes)


def test_images_seen_from_one_viewpoint_per_point():
    image = np.random.default_rng(0).random((20, 10, 3)) + 1.0
    viewpoints = 0.1 * image  # of a camera that moved
    result = pcgraph.segment(image, viewpoint=viewpoints)
    assert not result.camera
    assert_covered_and_connected(image, result)
    for wrong in ({"camera": True}, {"range_growth": 0.5}):
        with pytest.raises(ValueError, match="one viewpoint"):
            pcgraph.segment(image, viewpoint=viewpoints, **wrong)


@quick
@over_clouds
def test_order_does_not_matter(rng, n, shape):
    points = cloud_of(shape, rng, n)
    colors, normals = attributes(rng, len(points))
    order = rng.permutation(len(points))
    first = pcgraph.segment(points, colors, normals)
    second = pcgraph.segment(
        points[order], None if colors is None else colors[order], None if normals is None else normals[order]
    )
    assert np.array_equal(first.supervoxels[order], second.supervoxels)
    assert np.array_equal(first.graph.edges, second.graph.edges)
    assert first.leaves.counts.tolist() == second.leaves.counts.tolist()
    # Elsewhere ties abound, as between normals that point in opposite directions on one plane.
    if shape in GENERIC and normals is None:
        assert same_partition(first.labels[order], second.labels)


@quick
@given(rng=rngs, n=sizes_of_cloud, shape=st.sampled_from(SHAPES), times=st.integers(2, 5))
def test_every_point_several_times_and_the_same_scan_again_add_nothing_new(rng, n, shape, times):
    points = cloud_of(shape, rng, n)
    first = pcgraph.segment(points, voxel_size=extent(points) / 8)
    at_once = pcgraph.segment(np.repeat(points, times, axis=0), voxel_size=extent(points) / 8)
    assert np.array_equal(np.repeat(first.supervoxels, times), at_once.supervoxels)
    assert np.array_equal(first.graph.edges, at_once.graph.edges)
    again = pcgraph.update(first, points)
    assert again.graph.n_nodes == first.graph.n_nodes
    assert np.array_equal(again.surface.supervoxels, first.surface.supervoxels)
    assert again.leaves.counts.sum() == 2 * first.leaves.counts.sum()
    assert np.array_equal(again.graph.edges, first.graph.edges)


@quick
@given(
    rng=rngs,
    n=sizes_of_cloud,
    shape=st.sampled_from(SHAPES),
    power=st.integers(-60, 60),
    growth=st.sampled_from([0, 0.5]),
)
def test_a_power_of_two_as_unit_changes_ties_at_most(rng, n, shape, power, growth):
    points, unit = cloud_of(shape, rng, n), 2.0**power
    voxel, viewpoint = extent(points) / 8, points.mean(axis=0) + extent(points)
    first, second = (
        pcgraph.segment(points * u, voxel_size=voxel * u, viewpoint=viewpoint * u, range_growth=growth)
        for u in (1.0, unit)
    )
    assert np.array_equal(first.supervoxels, second.supervoxels)
    assert np.array_equal(first.surface.grid.centroids * unit, second.surface.grid.centroids)
    assert np.array_equal(first.graph.edges, second.graph.edges)
    if shape in GENERIC:
        assert np.array_equal(first.labels, second.labels)
        assert second.tree.altitudes == pytest.approx(first.tree.altitudes, rel=1e-9)


@pytest.mark.parametrize("unit", [2.0**-10, 2.0, 2.0**10])
def test_the_unit_of_points_that_nothing_but_bridges_joins_does_not_matter(unit):
    points = np.array([[0.2, 0.02, 0.0], [0.52, 1.07, 0.0], [0.94, 0.43, 0.0], [0.98, 0.63, 0.2]])
    first, second = (
        pcgraph.segment(points * u, voxel_size=0.15 * u, viewpoint=np.array([1.7, 1.6, 1.1]) * u) for u in (1.0, unit)
    )
    assert len(first.graph.joined) == 0
    assert len(first.graph.bridges.edges) == 3
    assert first.tree.altitudes.max() > 0.0
    assert np.array_equal(first.tree.altitudes, second.tree.altitudes)


@pytest.mark.parametrize("seed", draws(4, 1))
def test_neither_unit_nor_place_nor_rounding_changes_objects(seed):
    """Each of these was another draw of the points that tell the spacing, of cells and of seeds."""
    points = things_on_a_floor(seed)
    expected = pcgraph.segment(points)
    others = {"millimetres": points * 1e3, "feet": points / 0.3048, "a map": points + np.array((5e5, 5e6, 300.0))}
    for name, moved in others.items():
        assert np.array_equal(pcgraph.segment(moved).labels, expected.labels), name
    for rounded in (points.astype(np.float32), (points + np.array((1.2, 3.4, 5.6))).astype(np.float32)):
        found = pcgraph.segment(rounded)
        assert pcgraph.metrics.weighted_overlap(found.labels, expected.labels) > 0.99


@quick
@given(rng=rngs, steps=st.tuples(*[st.integers(-(2**9), 2**9)] * 3))
def test_a_shift_by_whole_cells_of_both_grids_changes_ties_at_most(rng, steps):
    points = np.round(shell(rng, 2000) * 2.0**20) / 2.0**20  # so that the shift does not round, but means do
    first, second = (
        pcgraph.segment(points + move, voxel_size=0.125, seed_size=0.5, viewpoint=np.array([0.2, 0.1, 9.0]) + move)
        for move in (np.zeros(3), np.array(steps) * 0.5)
    )
    assert np.array_equal(first.surface.grid.voxel_of_point, second.surface.grid.voxel_of_point)
    assert np.abs(first.surface.normals - second.surface.normals).max() <= 1e-9
    assert pcgraph.metrics.weighted_overlap(second.supervoxels, first.supervoxels) > 0.75


@settings(max_examples=10, deadline=None)  # of six segmentations each
@over_clouds
def test_the_form_of_the_arrays_does_not_matter_and_they_stay_as_they_are(rng, n, shape):
    points = cloud_of(shape, rng, n).astype(np.float32)
    colors, normals = rng.integers(0, 256, (len(points), 3)).astype(np.uint8), rng.normal(size=points.shape)
    wide = np.empty((len(points), 7), np.float64)
    wide[:, 1:7:2] = points
    locked = points.copy()
    locked.flags.writeable = False
    copies = points.copy(), colors.copy(), normals.copy()
    first = pcgraph.segment(points, colors, normals)
    assert all(np.array_equal(a, b) for a, b in zip((points, colors, normals), copies, strict=True))
    shades = colors * (1.0 / 255.0)
    forms = [
        (points.astype(np.float64), shades, normals * 4.0),
        (points.astype(">f4"), shades.astype(">f8"), normals.astype(">f8")),
        (wide[:, 1:7:2], np.asfortranarray(colors), np.asfortranarray(normals)),
        (locked, colors, normals.tolist()),
        (points[::-1][::-1], colors, normals),
    ]
    for form in forms:
        other = pcgraph.segment(*form)
        assert np.array_equal(first.supervoxels, other.supervoxels)
        assert np.array_equal(first.tree.altitudes, other.tree.altitudes)


@pytest.mark.parametrize("dtype", ["i1", "u1", ">i2", "i8", "u8", "f2", ">f8", "g"])
def test_every_type_of_number_means_its_value(dtype):
    numbers = np.random.default_rng(0).integers(0, 100, (80, 3))
    assert np.array_equal(pcgraph.segment(numbers.astype(dtype)).supervoxels, pcgraph.segment(numbers).supervoxels)


@pytest.mark.parametrize("growth", [0.3, 0.9, 0.99, 0.999])
@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9, 1e90])
def test_a_point_at_the_scanner_itself_has_a_place(growth, unit):
    points = np.random.default_rng(0).normal(size=(30, 3)) * unit
    result = pcgraph.segment(points, viewpoint=points[7], range_growth=growth)
    assert np.isfinite(result.surface.grid.warped).all()
    assert_covered_and_connected(points, result)


def test_bits_that_are_no_number_are_no_point():
    points = np.random.default_rng(0).random((40, 3)).astype(np.float32)
    points.view(np.uint32)[3, 1] = 0x7F800001  # a signalling NaN: a plain conversion would warn
    result = pcgraph.segment(points, normals=points)
    assert result.supervoxels[3] == -1
    assert np.count_nonzero(result.supervoxels < 0) == 1
    normals = np.ones((40, 3), np.float32)
    normals.view(np.uint32)[5] = 0x7F800001
    assert_covered_and_connected(points[4:], pcgraph.segment(points[4:], normals=normals[4:]))


@pytest.mark.parametrize(
    ("name", "value"),
    [("voxel_size", size) for size in (5e-324, 1e-300, 1e-200, 1e-100, 1e-20, 1e20, 1e90, 1e100, 1e200, 1e308)]
    + [("seed_size", size) for size in (1e6, 1e20, 1e90, 1e100, 1e200, 1e308)]
    + [("viewpoint", (far, -far, 0.0)) for far in (1e20, 1e90, 1e100, 1e200, 1.7e308)],
)
@pytest.mark.parametrize("method", [SurfaceGrowth(), Vccs()])
def test_absurd_sizes_work_or_are_refused(name, value, method):
    points = np.random.default_rng(0).random((50, 3)) - 0.5
    try:
        result = pcgraph.segment(points, method=method, **{"voxel_size": 0.1, name: value})
    except ValueError as error:
        assert "expected" in str(error)  # noqa: PT017
        assert value in (5e-324, 1e-300, 1e200, 1e308) or name == "viewpoint"
    else:
        assert_covered_and_connected(points, result)


# --- one scan after another -------------------------------------------------------------------------------------------


@quick
@given(
    rng=rngs, n=sizes_of_cloud, shape=st.sampled_from(SHAPES), method=st.sampled_from(METHODS), split=st.floats(0, 1)
)
def test_updates_keep_what_is_known(rng, n, shape, method, split):
    points = cloud_of(shape, rng, n)
    cut = min(max(1, int(split * len(points))), len(points))
    overlap = cut // 2
    one, two = points[:cut], points[overlap:]
    first = pcgraph.segment(one, voxel_size=extent(points) / 8, method=method)
    second = pcgraph.update(first, two, method=method)
    leaf = np.concatenate((first.supervoxels, second.supervoxels))
    everything = np.vstack((one, two))
    k = first.graph.n_nodes
    assert second.supervoxels.min() >= 0
    assert np.array_equal(np.unique(leaf), np.arange(second.graph.n_nodes))
    assert (second.leaves.counts[:k] >= first.leaves.counts).all()
    assert_moments_are_direct(second.leaves, everything, leaf)
    assert_edges_are_the_contacts(second)
    assert_tree_is_nested(second)
    grid = voxel_grid(everything, first.voxel_size, first.surface.grid.warp)
    assert np.array_equal(second.surface.grid.cells, grid.cells)
    assert second.surface.grid.counts.tolist() == grid.counts.tolist()
    # A voxel that was known keeps its supervoxel.
    now = dict(zip(map(tuple, second.surface.grid.cells.tolist()), second.surface.supervoxels.tolist(), strict=True))
    before = zip(map(tuple, first.surface.grid.cells.tolist()), first.surface.supervoxels.tolist(), strict=True)
    assert all(now[cell] == owner for cell, owner in before)


@quick
@over_clouds
def test_the_order_of_scans_changes_no_count(rng, n, shape):
    points = cloud_of(shape, rng, n)
    ends = np.stack((points.min(axis=0), points.max(axis=0)))  # voxels are counted from the corner of the first scan
    one, two = (np.concatenate((ends, part)) for part in (points[: len(points) // 2 + 1], points[len(points) // 2 :]))
    voxel = extent(points) / 8
    forth = pcgraph.update(pcgraph.segment(one, voxel_size=voxel), two)
    back = pcgraph.update(pcgraph.segment(two, voxel_size=voxel), one)
    assert np.array_equal(forth.surface.grid.cells, back.surface.grid.cells)
    assert forth.surface.grid.counts.tolist() == back.surface.grid.counts.tolist()
    assert forth.tree.moments.counts[-1] == back.tree.moments.counts[-1] == len(one) + len(two)


# --- threads and processes --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def expected():
    """What `fingerprint` returns in an undisturbed process."""
    return fingerprint()


def fingerprint(_=None):
    """All arrays of a segmentation as bytes."""
    points, _, viewpoint = two_boxes_on_a_plane()
    result = pcgraph.segment(points, viewpoint=viewpoint)
    arrays = [result.labels, result.supervoxels, result.graph.edges, result.tree.parents, result.tree.altitudes]
    arrays += [*result.graph.edge_features.columns().values(), *result.graph.node_features.columns().values()]
    return b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)


def test_four_threads_at_once_get_the_same_bytes(expected):
    with ThreadPoolExecutor(4) as pool:
        assert all(found == expected for found in pool.map(fingerprint, range(8)))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_gets_the_same_bytes(expected):
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(fingerprint).get(timeout=60) == expected


def test_an_interrupted_linkage_leaves_nothing_broken(expected):
    class Interrupted(ConvexityLinkage):
        def merges(self, graph, leaves):
            raise KeyboardInterrupt

    points, _, viewpoint = two_boxes_on_a_plane()
    with pytest.raises(KeyboardInterrupt):
        pcgraph.segment(points, viewpoint=viewpoint, linkage=Interrupted())
    assert fingerprint() == expected
