# SPDX-License-Identifier: Apache-2.0
"""Meshes: vertices as other readers see them, points all over a surface, and broken files."""

from __future__ import annotations

import json
import struct
import warnings

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import pcgraph
from pcgraph.errors import CloudReadError
from pcgraph.io.format import CloudFile
from pcgraph.io.mesh import _left_out, read_mesh, sample_surface

BALL = trimesh.creation.icosphere(subdivisions=3)
TRIANGLE = b"v 0 0 0\nv 1 0 0\nv 1 1 0\n"


def read(content: bytes, kind: str) -> pcgraph.Cloud:
    """The cloud of a file whose few vertices are no surprise."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "read the .* vertices of the mesh")
        return read_mesh(CloudFile(content), kind)


def exported(mesh: trimesh.Trimesh, kind: str, **options: object) -> bytes:
    content = mesh.export(file_type=kind, **options)
    return content if isinstance(content, bytes) else content.encode()


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".off", ".glb", ".ply"])
def test_vertices_are_those_that_open3d_reads(suffix, tmp_path):
    import open3d

    path = tmp_path / f"ball{suffix}"
    path.write_bytes(exported(BALL, suffix[1:]))
    theirs = open3d.io.read_triangle_mesh(str(path))
    if suffix == ".stl":
        theirs.remove_duplicated_vertices()
    cloud = pcgraph.read_cloud(path) if suffix == ".ply" else read(path.read_bytes(), suffix[1:].replace("glb", "gltf"))
    assert len(cloud.points) == len(BALL.vertices)
    assert np.allclose(sorted(cloud.points.tolist()), sorted(np.asarray(theirs.vertices).tolist()), atol=1e-7)


def test_colours_and_normals_where_the_file_has_them():
    ball = BALL.copy()
    ball.visual.vertex_colors = np.random.default_rng(0).integers(0, 256, (len(ball.vertices), 4), np.uint8)
    for kind in ("obj", "glb"):
        bare = read(exported(BALL, kind, include_normals=False), kind.replace("glb", "gltf"))
        assert (bare.colors, bare.normals) == (None, None)
        full = read(exported(ball, kind, include_normals=True), kind.replace("glb", "gltf"))
        away, same = cKDTree(ball.vertices).query(full.points)
        assert away.max() < 1e-6
        assert np.array_equal(full.colors, ball.visual.vertex_colors[same, :3])
        assert np.allclose(full.normals, ball.vertex_normals[same], atol=1e-5)


def test_obj_without_faces_is_a_cloud():
    assert read(TRIANGLE, "obj").colors is None
    cloud = read(b"v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 0.2\n", "obj")
    assert cloud.colors.tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 51]]


def test_scenes_are_in_one_frame():
    """Meshes with their places in a scene; normals turn, and stay normals under a scale."""
    scene = trimesh.Scene()
    place = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1), (0, 0, 0))
    place[:3, 3] = (10.0, 0.0, 0.0)
    flat = np.diag([2.0, 1.0, 0.5, 1.0])
    scene.add_geometry(BALL, transform=place)
    scene.add_geometry(BALL, transform=flat)
    cloud = read(scene.export(file_type="glb", include_normals=True), "gltf")
    n = len(BALL.vertices)
    assert len(cloud.points) == 2 * n
    by_place = cloud.points[:, 0] > 5.0
    assert np.allclose(cloud.normals[by_place], cloud.points[by_place] - (10.0, 0.0, 0.0), atol=0.01)
    ellipsoid = cloud.points[~by_place] / (4.0, 1.0, 0.25)
    ellipsoid /= np.linalg.norm(ellipsoid, axis=1, keepdims=True)
    assert np.allclose(cloud.normals[~by_place], ellipsoid, atol=0.05)


def test_a_gltf_file_beside_its_buffer(tmp_path):
    for name, content in trimesh.Scene(BALL).export(file_type="gltf").items():
        (tmp_path / name).write_bytes(content)
    cloud = pcgraph.sample_surface(tmp_path / "model.gltf", 100)
    assert np.allclose(np.linalg.norm(cloud.points, axis=1), 1.0, atol=0.02)
    with pytest.raises(CloudReadError, match="with the files beside it that it names: give its path"):
        read((tmp_path / "model.gltf").read_bytes(), "gltf")  # from a pipe, there is nothing beside it


def test_few_vertices_are_said_to_be_few(tmp_path):
    path = tmp_path / "box.obj"
    path.write_bytes(exported(trimesh.creation.box(), "obj"))
    with pytest.warns(UserWarning, match=r"read the 8 vertices of the mesh, not its 12 faces: pcgraph.sample_surface"):
        assert pcgraph.read_cloud(path).points.shape == (8, 3)
    read_mesh(CloudFile(exported(trimesh.creation.icosphere(subdivisions=4), "off")), "off")  # has many: no warning


# ---- Points all over a surface -------------------------------------------------------------------------------------


def test_sampling_gives_each_face_its_fraction_of_the_points():
    box = trimesh.creation.box((3.0, 2.0, 1.0))
    cloud = sample_surface(box, 1001)
    counts = np.bincount(cloud.columns["face"], minlength=12)
    assert np.abs(counts - 1001 * box.area_faces / box.area).max() < 1.0
    assert np.allclose(np.abs(cloud.points / (1.5, 1.0, 0.5)).max(axis=1), 1.0)  # they lie on it
    assert np.array_equal(cloud.normals, box.face_normals[cloud.columns["face"]])
    again = sample_surface(box, 1001)
    assert np.array_equal(cloud.points, again.points)


def test_samples_are_more_even_than_random_ones():
    def nearest(points):
        return cKDTree(points).query(points, k=2)[0][:, 1]

    plane = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    ours = nearest(sample_surface(plane, 2000).points)
    random = nearest(trimesh.sample.sample_surface(plane, 2000, seed=0)[0])
    assert ours.std() / ours.mean() < 0.7 * random.std() / random.mean()


def test_sampled_colours_lie_between_those_of_the_corners(tmp_path):
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    mesh.visual.vertex_colors = [[0, 0, 0, 255], [255, 0, 0, 255], [0, 255, 0, 255]]
    cloud = sample_surface(mesh, 500)
    assert np.abs(cloud.colors[:, :2] - 255.0 * cloud.points[:, :2]).max() <= 0.5
    path = tmp_path / "one.ply"
    path.write_bytes(exported(mesh, "ply"))
    assert np.array_equal(sample_surface(path, 500).colors, cloud.colors)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, face_colors=[[1, 2, 3, 255]])
    assert (sample_surface(mesh, 5).colors == (1, 2, 3)).all()


def test_what_cannot_be_sampled(tmp_path):
    path = tmp_path / "points.obj"
    path.write_bytes(TRIANGLE)
    with pytest.raises(CloudReadError, match="faces of some finite area, but it has none"):
        sample_surface(path, 10)
    with pytest.raises(ValueError, match="n_points of at least 1, got 0"):
        sample_surface(BALL, 0)
    with pytest.raises(CloudReadError, match=r"expected a mesh file ending in .obj, .*, got 'cloud.pcd'"):
        sample_surface("cloud.pcd", 10)


# ---- Files that are not right --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("obj", b""),
        ("obj", b"no mesh"),
        ("obj", b"v 1 2\n"),
        ("obj", TRIANGLE + b"f 1 2 900000000\n"),
        ("obj", TRIANGLE + b"f 1 2 -7\n"),
        ("obj", b"v one two three\n"),
        ("off", b""),
        ("off", b"OFF\n1000000000000 1 0\n0 0 0\n"),
        ("off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 9\n"),
        ("stl", b""),
        ("stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50)),
        ("stl", b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0\n"),
        ("gltf", b""),
        ("gltf", b"[]"),
        ("gltf", b"{}"),
        ("gltf", b"glTF" + bytes(16)),
        ("gltf", exported(BALL, "glb")[:-1]),
    ],
)
def test_broken_files_are_refused(kind, content):
    with pytest.raises(CloudReadError, match=r"the mesh file is damaged: |expected a mesh with vertices"):
        read(content, kind)


@pytest.mark.parametrize(
    ("kind", "content", "names"),
    [
        ("off", b"# CN\nCNOFF\n1 0 0\n0 0 0 255 0 0 0 0 1\n", "colors, normals"),
        ("obj", b"v 0 0 0\nvn 0 0 1\n", "normals"),
    ],
)
def test_what_trimesh_leaves_out_is_told(kind, content, names):
    with pytest.warns(UserWarning, match=f"left out what the mesh file has besides: {names}$"):
        assert len(read(content, kind).points) == 1
    assert len(read(content.replace(b"CNOFF", b"OFF").replace(b"vn", b"#"), kind).points) == 1  # warnings are errors


def test_vertices_of_no_face_that_are_left_out():
    with pytest.warns(UserWarning, match="left out what the mesh file has besides: 1 vertices of no face"):
        assert len(read(TRIANGLE + b"v 7 7 7\nf 1 2 3\n", "obj").points) == 3


def test_attributes_of_gltf_files_that_are_left_out():
    primitives = [{"mode": 0, "attributes": {"POSITION": 0, "NORMAL": 1, "_RING": 2}}, {"attributes": {"NORMAL": 1}}]
    scene = json.dumps({"meshes": [{"primitives": primitives}]}).encode()
    assert _left_out(scene, "gltf", 0, 0) == ["NORMAL", "_RING"]


@pytest.mark.parametrize("content", [b"glTF\1\0\0\0" + bytes(16), b'{"accessors": {"one": {"count": 3}}}'])
def test_gltf_of_version_1_is_refused(content):
    with pytest.raises(CloudReadError, match="expected glTF of version 2, got version 1"):
        read(content, "gltf")


def test_zeros_that_a_gltf_file_promises():
    """Accessors without data are zeros; 10**10 of them would take 120 GB."""
    scene = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "count": 10**10, "type": "VEC3"}],
    }
    with pytest.raises(CloudReadError, match="promises 10000000000 elements, but it is only"):
        read(json.dumps(scene).encode(), "gltf")
