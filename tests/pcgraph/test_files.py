# SPDX-License-Identifier: Apache-2.0
"""Files: what is written comes back, and broken files are refused in one sentence."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pcgraph
from pcgraph.errors import CloudReadError
from pcgraph.io.pcd import decompress_lzf, lzf_decompressor, read_pcd
from pcgraph.io.ply import encode_ply, read_ply

XYZ = np.array([[0.5, -1.25, 2.0], [np.nan, np.nan, np.nan], [1e-3, 4.0, -8.0], [7.0, 7.5, 9.0]], "<f4")


def pcd_header(data: str, width: int = 2, height: int = 2, fields: str = "x y z rgb label") -> bytes:
    n = len(fields.split())
    types = " ".join("U" if name in ("rgb", "label") else "F" for name in fields.split())
    return (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {'4 ' * n}\n"
        f"TYPE {types}\nCOUNT {'1 ' * n}\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT 1 2 3 1 0 0 0\n"
        f"POINTS {width * height}\nDATA {data}\n"
    ).encode()


def pcd_body() -> bytes:
    rows = np.empty(4, np.dtype([("p", "<f4", 3), ("rgb", "<u4"), ("label", "<u4")]))
    rows["p"], rows["rgb"], rows["label"] = XYZ, [0xFF0000, 0x00FF00, 0x0000FF, 0x102030], [1, 2, 3, 40]
    return rows.tobytes()


def compressed_body() -> bytes:
    rows = np.frombuffer(pcd_body(), "<u4").reshape(4, 5)
    plain = rows.T.tobytes()
    literals = b"".join(bytes([len(plain[i : i + 32]) - 1]) + plain[i : i + 32] for i in range(0, len(plain), 32))
    return struct.pack("<II", len(literals), len(plain)) + literals


def ascii_body() -> bytes:
    lines = [
        f"{x:.9g} {y:.9g} {z:.9g} {rgb} {label}"
        for (x, y, z), rgb, label in zip(
            XYZ.tolist(), [0xFF0000, 0x00FF00, 0x0000FF, 0x102030], [1, 2, 3, 40], strict=True
        )
    ]
    return "\n".join(lines).encode()


BODIES = {"ascii": ascii_body, "binary": pcd_body, "binary_compressed": compressed_body}


@pytest.mark.parametrize("data", BODIES)
def test_pcd_keeps_shape_nan_colour_label_and_viewpoint(data):
    cloud = read_pcd(pcd_header(data) + BODIES[data]())
    assert cloud.organised
    assert cloud.points.dtype == np.float32
    assert np.array_equal(cloud.points, XYZ.reshape(2, 2, 3), equal_nan=True)
    assert cloud.colors[1, 1].tolist() == [0x10, 0x20, 0x30]
    assert cloud.labels.tolist() == [[1, 2], [3, 40]]
    assert cloud.viewpoint.tolist() == [1, 2, 3]


@pytest.mark.parametrize("decompress", [decompress_lzf, lzf_decompressor()])
def test_lzf_copies_overlap_themselves(decompress):
    target = np.empty(12, np.uint8)
    stream = np.frombuffer(bytes([1, 65, 66, 0xE0, 1, 1]), np.uint8)  # "AB", then 10 bytes from 2 back
    assert decompress(stream, target) == 12
    assert target.tobytes() == b"ABABABABABAB"


def test_ply_both_codes_and_byte_orders():
    header = "ply\nformat {} 1.0\ncomment made by hand\nelement camera 1\nproperty int id\nelement vertex 4\n"
    header += "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\n"
    header += "property uchar blue\nproperty double nx\nproperty double ny\nproperty double nz\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    colors, normals = np.arange(12, dtype=np.uint8).reshape(4, 3), np.eye(4, 3)
    for code, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        rows = np.empty(4, np.dtype([("p", order + "f4", 3), ("c", "u1", 3), ("n", order + "f8", 3)]))
        rows["p"], rows["c"], rows["n"] = XYZ, colors, normals
        face = struct.pack(order + "Biii", 3, 0, 1, 2)
        cloud = read_ply(header.format(code).encode() + struct.pack(order + "i", 9) + rows.tobytes() + face)
        assert np.array_equal(cloud.points, XYZ, equal_nan=True)
        assert np.array_equal(cloud.colors, colors)
        assert np.array_equal(cloud.normals, normals)
    lines = [" ".join(map(str, [*p, *c, *n])) for p, c, n in zip(XYZ, colors, normals, strict=True)]
    cloud = read_ply((header.format("ascii") + "9\n" + "\n".join(lines) + "\n3 0 1 2\n").encode())
    assert np.array_equal(cloud.points, XYZ, equal_nan=True)
    assert np.array_equal(cloud.normals, normals)


@pytest.mark.parametrize(
    ("kind", "stored", "expected"),
    [
        ("uchar", [255, 128, 1], [255, 128, 1]),
        ("ushort", [65535, 32896, 257], [255, 128, 1]),
        ("ushort", [257, 0, 0], [1, 0, 0]),
        ("int", [255, 128, 0], [255, 128, 0]),
        ("int", [300, -5, 1], [255, 0, 1]),
        ("short", [1, 0, 1], [1, 0, 1]),
        ("uint", [255, 128, 3], [255, 128, 3]),
        ("float", [255, 128, 3], [255, 128, 3]),
        ("double", [255, 127.6, "nan"], [255, 128, 0]),
        ("float", [1, 0.5, 0], [255, 128, 0]),
        ("float", ["nan", 0.2, "inf"], [0, 51, 255]),
    ],
)
def test_ply_colours_of_any_type(kind, stored, expected):
    names = "".join(f"property float {c}\n" for c in "xyz")
    names += "".join(f"property {kind} {c}\n" for c in ("red", "green", "blue"))
    values = " ".join(map(str, stored))
    text = f"ply\nformat ascii 1.0\nelement vertex 1\n{names}end_header\n0 0 1 {values}\n"
    assert read_ply(text.encode()).colors.tolist() == [expected]


def test_open3d_files_are_read_and_ours_read_back(tmp_path):
    o3d = pytest.importorskip("open3d")
    points = np.random.default_rng(0).random((50, 3))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(np.full((50, 3), 0.2))
    for name, options in (
        ("a.ply", {"write_ascii": True}),
        ("b.ply", {}),
        ("a.pcd", {"write_ascii": True}),
        ("b.pcd", {}),
        ("c.pcd", {"compressed": True}),
    ):
        o3d.io.write_point_cloud(str(tmp_path / name), cloud, **options)
        read = pcgraph.read_cloud(tmp_path / name)
        assert read.points == pytest.approx(points, abs=1e-6)
        assert np.unique(read.colors).tolist() == [51]
    result = pcgraph.segment(points)
    pcgraph.write_segmentation(tmp_path / "out.ply", pcgraph.Cloud(points), result)
    assert np.asarray(o3d.io.read_point_cloud(str(tmp_path / "out.ply")).points) == pytest.approx(points)


def test_results_come_back(tmp_path, boxes):
    points, _, result = boxes
    cloud = pcgraph.Cloud(points)
    pcgraph.write_segmentation(tmp_path / "a.ply", cloud, result)
    read = pcgraph.read_cloud(tmp_path / "a.ply")
    assert np.array_equal(read.points, points)
    assert np.array_equal(read.labels, result.labels)
    assert len(np.unique(read.colors, axis=0)) == 3
    pcgraph.write_segmentation(tmp_path / "a.npz", cloud, result)
    with np.load(tmp_path / "a.npz") as arrays:
        assert np.array_equal(arrays["supervoxels"], result.supervoxels)
        assert np.array_equal(arrays["edges"], result.graph.edges)
        assert np.array_equal(arrays["edge_convexity"], result.graph.edge_features.convexity)
        assert np.array_equal(arrays["tree_parents"], result.tree.parents)
    with pytest.raises(pcgraph.CloudWriteError, match=r"\.ply or \.npz"):
        pcgraph.write_segmentation(tmp_path / "a.txt", cloud, result)
    with pytest.raises(pcgraph.CloudWriteError, match="cannot write"):
        pcgraph.write_segmentation(tmp_path / "no" / "a.ply", cloud, result)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "a.ply"]


LIES = {
    "no header": b"hello",
    "no data line": pcd_header("binary")[:-20],
    "more points than bytes": pcd_header("binary", 1000, 1000) + pcd_body(),
    "huge": pcd_header("binary", 2**40, 2**20) + pcd_body(),
    "huge ascii": pcd_header("ascii", 2**40, 2**20) + ascii_body(),
    "negative": pcd_header("binary", -2, -2) + pcd_body(),
    "points contradict": pcd_header("binary").replace(b"POINTS 4", b"POINTS 5") + pcd_body(),
    "no z": pcd_header("binary", fields="x y w rgb label") + pcd_body(),
    "odd size": pcd_header("binary").replace(b"SIZE 4", b"SIZE 3") + pcd_body(),
    "few sizes": pcd_header("binary").replace(b"SIZE 4", b"SIZE") + pcd_body(),
    "unknown data": pcd_header("zipped") + pcd_body(),
    "words": pcd_header("ascii") + b"a " * 20,
    "width is a word": pcd_header("binary").replace(b"WIDTH 2", b"WIDTH w") + pcd_body(),
    "compressed sizes lie": pcd_header("binary_compressed") + struct.pack("<II", 2**31, 80) + b"abc",
    "compressed bomb": pcd_header("binary_compressed", 2**15, 2**12) + struct.pack("<II", 3, 2**31) + b"abc",
    "compressed too short": pcd_header("binary_compressed") + b"abc",
    "damaged stream": pcd_header("binary_compressed") + struct.pack("<II", 4, 80) + b"\xff\xff\xff\xff",
}


@pytest.mark.parametrize("name", LIES)
def test_lying_pcd_files_are_refused(name):
    with pytest.raises(CloudReadError):
        read_pcd(LIES[name])


PLY = encode_ply({"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2]})

PLY_LIES = {
    "no header": b"plywood",
    "truncated": PLY[:-3],
    "huge": PLY.replace(b"vertex 4", b"vertex 99999999999999"),
    "a number too long": PLY.replace(b"vertex 4", b"vertex " + b"9" * 5000),
    "no vertex": PLY.replace(b"element vertex", b"element vortex"),
    "no x": PLY.replace(b"float x", b"float w"),
    "twice x": PLY.replace(b"float y", b"float x"),
    "list": PLY.replace(b"property float x", b"property list uchar float x"),
    "unknown type": PLY.replace(b"float x", b"quark x"),
    "unknown line": PLY.replace(b"element", b"elephant"),
    "unknown code": PLY.replace(b"binary_little_endian", b"morse"),
}


@pytest.mark.parametrize("name", PLY_LIES)
def test_lying_ply_files_are_refused(name):
    with pytest.raises(CloudReadError):
        read_ply(PLY_LIES[name])


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_damaged_files_never_crash(data):
    whole = data.draw(st.sampled_from([PLY, *(pcd_header(name) + make() for name, make in BODIES.items())]))
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 6))):
        damaged[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    damaged = damaged[: data.draw(st.integers(0, len(whole)))]
    try:
        cloud = (read_ply if whole is PLY else read_pcd)(bytes(damaged))
    except CloudReadError:
        return
    assert cloud.points.shape[-1] == 3
