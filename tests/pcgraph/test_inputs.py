# SPDX-License-Identifier: Apache-2.0
"""Wrong arguments get one clear sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scenes.tables import two_boxes_on_a_plane

import pcgraph
from pcgraph.io.ply import encode_ply

POINTS = np.random.default_rng(0).random((20, 3))

BAD = {
    "empty": ((np.empty((0, 3)),), {}, "at least one point"),
    "all NaN": ((np.full((4, 3), np.nan),), {}, "all 4 points are NaN"),
    "two columns": ((np.ones((4, 2)),), {}, r"shape \(n, 3\)"),
    "one row": ((np.ones(3),), {}, r"shape \(n, 3\)"),
    "strings": ((np.full((4, 3), "a"),), {}, "dtype"),
    "bool": ((np.ones((4, 3), bool),), {}, "dtype"),
    "complex": ((np.ones((4, 3), complex),), {}, "dtype"),
    "dict": (({"points": POINTS},), {}, "got dict"),
    "nothing": ((None,), {}, "a pcgraph.Cloud or what pcgraph.as_cloud takes, got NoneType"),
    "object": ((object(),), {}, "expected points as an array .*got object"),
    "ragged": (([[1, 2, 3], [1, 2]],), {}, "different lengths"),
    "too large": ((POINTS * 1e200,), {}, "below"),
    "few colours": ((POINTS, POINTS[:5]), {}, "points' shape"),
    "bright colours": ((POINTS, POINTS * 255), {}, "within 0..1"),
    "NaN colours": ((POINTS, POINTS * np.nan), {}, "within 0..1"),
    "int colours": ((POINTS, np.ones((20, 3), np.int64)), {}, "uint8"),
    "few normals": ((POINTS, None, POINTS[:5]), {}, "points' shape"),
    "flat viewpoint": ((POINTS,), {"viewpoint": (0, 0)}, "viewpoint"),
    "NaN viewpoint": ((POINTS,), {"viewpoint": (0, 0, np.nan)}, "viewpoint"),
    "zero voxel": ((POINTS,), {"voxel_size": 0}, "voxel_size above 0"),
    "negative voxel": ((POINTS,), {"voxel_size": -0.1}, "voxel_size"),
    "NaN voxel": ((POINTS,), {"voxel_size": float("nan")}, "voxel_size"),
    "word voxel": ((POINTS,), {"voxel_size": "small"}, "voxel_size"),
    "small seed": ((POINTS,), {"voxel_size": 0.2, "seed_size": 0.1}, "seed_size of at least"),
    "behind the camera": ((POINTS - 0.5,), {"camera": True, "viewpoint": (0, 0, 0)}, "in front of"),
    "NaN altitude": ((POINTS,), {"object_altitude": float("nan")}, "object_altitude"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments(name):
    arguments, options, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        pcgraph.segment(*arguments, **options)


def test_uint8_and_float_colours_agree():
    colors = np.random.default_rng(1).integers(0, 256, (20, 3)).astype(np.uint8)
    a = pcgraph.segment(POINTS, colors, voxel_size=0.2)
    b = pcgraph.segment(POINTS, colors / 255.0, voxel_size=0.2)
    assert np.array_equal(a.supervoxels, b.supervoxels)


def test_default_viewpoint():
    found = pcgraph.segment(POINTS + 1.0).viewpoint
    assert found.shape == (3,)
    assert (np.abs(found - 1.5) > 0.4).any()  # not amid the points
    assert pcgraph.segment((POINTS - 0.5).reshape(4, 5, 3)).viewpoint.tolist() == [0, 0, 0]


def test_inputs_are_left_alone():
    points, normals = POINTS.copy(), POINTS.copy()
    pcgraph.segment(points, normals=normals)
    assert np.array_equal(points, POINTS)
    assert np.array_equal(normals, POINTS)


@pytest.mark.parametrize("method", [pcgraph.SurfaceGrowth, pcgraph.Vccs])
def test_weights_of_methods_are_checked(method):
    with pytest.raises(ValueError, match="color_weight"):
        method(color_weight=-1)
    with pytest.raises(ValueError, match="normal_weight"):
        method(normal_weight=float("nan"))


COLORS = np.random.default_rng(1).integers(0, 256, (20, 3)).astype(np.uint8)
NORMALS = np.tile([0.0, 0.0, 1.0], (20, 1))


def same(a, b):
    """Whether two segmentations are the same."""
    pairs = [(a.supervoxels, b.supervoxels), (a.tree.altitudes, b.tree.altitudes), (a.viewpoint, b.viewpoint)]
    pairs.append((a.tree.moments.centroids, b.tree.moments.centroids))
    return all(np.array_equal(first, second) for first, second in pairs)


def test_one_viewpoint_repeated_for_each_point_is_one():
    points, place = two_boxes_on_a_plane()[0], np.array([0.1, 0.2, -3.0])
    assert same(
        pcgraph.segment(points, viewpoint=np.tile(place, (len(points), 1))), pcgraph.segment(points, viewpoint=place)
    )


def test_a_cloud_brings_its_colours_normals_and_viewpoint():
    cloud = pcgraph.Cloud(POINTS, COLORS, NORMALS, viewpoint=np.array([0.0, 0.0, 9.0]))
    expected = pcgraph.segment(POINTS, COLORS, NORMALS, (0, 0, 9), voxel_size=0.2)
    assert same(pcgraph.segment(cloud, voxel_size=0.2), expected)
    assert not same(pcgraph.segment(cloud, viewpoint=(0, 0, 8), voxel_size=0.2), expected)
    other = pcgraph.segment(cloud, COLORS[::-1], -NORMALS, (0, 0, -9), voxel_size=0.2)
    assert same(other, pcgraph.segment(POINTS, COLORS[::-1], -NORMALS, (0, 0, -9), voxel_size=0.2))
    later = pcgraph.update(expected, cloud)
    assert same(later, pcgraph.update(expected, POINTS, COLORS, NORMALS, (0, 0, 9)))


@pytest.mark.parametrize("kind", [str, Path])
def test_a_file_by_name(kind, tmp_path):
    columns = {name: POINTS[:, i] for i, name in enumerate("xyz")}
    columns |= {name: COLORS[:, i] for i, name in enumerate(("red", "green", "blue"))}
    (tmp_path / "a.ply").write_bytes(encode_ply(columns))
    expected = pcgraph.segment(POINTS, COLORS, voxel_size=0.2)
    assert same(pcgraph.segment(kind(tmp_path / "a.ply"), voxel_size=0.2), expected)
    assert same(pcgraph.update(expected, kind(tmp_path / "a.ply")), pcgraph.update(expected, POINTS, COLORS))
    with pytest.raises(pcgraph.CloudReadError, match="cannot read"):
        pcgraph.segment(kind(tmp_path / "b.ply"))
    with pytest.raises(pcgraph.CloudReadError, match=r"ending in \.pcd, \.ply, "):
        pcgraph.segment(kind("POINTS"))


def test_a_name_in_place_of_a_linkage_or_method_is_told_which_there_are():
    classes = r"ConvexityLinkage\(\), .*QuasiFlatLinkage\(\), .*WardLinkage\(\), got"
    with pytest.raises(ValueError, match=classes + r" 'ward'; did you mean pcgraph\.WardLinkage\(\)\?$"):
        pcgraph.segment(np.ones((3, 3)), linkage="ward")
    with pytest.raises(ValueError, match=classes + " 3$"):
        pcgraph.segment(np.ones((3, 3)), linkage=3)
    with pytest.raises(ValueError, match=r"pcgraph\.Vccs\(\), got 'Vcs'; did you mean pcgraph\.Vccs\(\)"):
        pcgraph.segment(np.ones((3, 3)), method="Vcs")


@pytest.mark.parametrize("wrong", ["0.2", b"1"])
def test_sizes_are_numbers(wrong):
    with pytest.raises(ValueError, match="expected a finite voxel_size"):
        pcgraph.segment(POINTS, voxel_size=wrong)


@pytest.mark.parametrize("argument", ["method", "linkage"])
def test_what_is_no_method_or_linkage_is_refused_whatever_it_is(argument):
    """0 and the empty text were taken for the default."""
    for wrong in (0, "", False, "lccp"):
        with pytest.raises(ValueError, match=f"expected a {argument} such as"):
            pcgraph.segment(POINTS, **{argument: wrong})


def scene_with_holes(dtype, organised):
    """Two planes as a camera sees them, in 1/1000 m of any type, and which points are none."""
    y, x = np.mgrid[:40, :50]
    points = np.stack((x * 20, y * 20, np.where(x < 20, 900, 1400)), axis=-1).astype(dtype)
    holes = np.random.default_rng(4).random((40, 50)) < 0.2
    return (points, holes) if organised else (points.reshape(-1, 3), holes.reshape(-1))


@pytest.mark.parametrize("organised", [True, False])
@pytest.mark.parametrize("dtype", ["f4", "f8", "i2", "i4", "u2"])
def test_masked_points_are_none(dtype, organised, tmp_path):
    """Masks were passed over: what lies beneath, often a fill value, was taken for measured."""
    points, holes = scene_with_holes(dtype, organised)
    colors = np.random.default_rng(5).integers(0, 256, points.shape).astype(np.uint8)
    expected = pcgraph.segment(
        np.where(holes[..., None], np.nan, points.astype(float)), colors, features=points[..., 0]
    )
    for mask in (holes[..., None] & np.ones(3, bool), holes[..., None] & np.array([False, True, False])):
        beneath = points.copy()
        beneath[mask] = 17
        masked = np.ma.masked_array(beneath, mask)
        for given in (masked, pcgraph.Cloud(masked)):
            found = pcgraph.segment(given, np.ma.masked_array(colors, mask), features=points[..., 0])
            assert same(found, expected)
            assert (found.labels[holes] == -1).all()
            pcgraph.write_segmentation(tmp_path / "a.ply", given, found)
            written = pcgraph.read_cloud(tmp_path / "a.ply")
            assert np.array_equal(written.points, points[~holes])
            assert np.array_equal(written.columns["object"], expected.labels[~holes])
    unmasked = np.ma.masked_array(points, np.zeros(points.shape, bool))
    assert same(pcgraph.segment(unmasked), pcgraph.segment(points))


def test_masked_features_are_unknown_and_masked_colours_are_refused():
    points, holes = scene_with_holes("f8", organised=True)
    numbers = points[..., 0].copy()
    expected = pcgraph.segment(points, features=np.where(holes, np.nan, numbers))
    numbers[holes] = -1e9
    masked = np.ma.masked_array(numbers, holes)
    assert same(pcgraph.segment(points, features=masked), expected)
    assert same(pcgraph.segment(pcgraph.Cloud(points, columns={"t": masked}), features="t"), expected)
    for colors in (np.zeros(points.shape), np.zeros(points.shape, np.uint8)):
        masked = np.ma.masked_array(colors, np.repeat(holes[..., None], 3, axis=-1))
        with pytest.raises(ValueError, match="colors of all finite points, but some are masked"):
            pcgraph.segment(points, masked)
