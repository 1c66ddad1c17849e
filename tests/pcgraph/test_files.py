# SPDX-License-Identifier: Apache-2.0
"""Files: what is written comes back, and broken files are refused in one sentence."""

from __future__ import annotations

import re
import struct
import warnings

import numpy as np
import pytest
from fuzz.cloud_files import CODES, pcd, ply
from hypothesis import given, settings
from hypothesis import strategies as st

import pcgraph
from pcgraph.errors import CloudReadError
from pcgraph.io import decode_cloud, encode_cloud
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


def text_files(rows: list[str]) -> dict:
    """Readers and files of x, y, z, w for each row given, as PCD and as PLY; their first row is in line 12 and 13."""
    names = ["x", "y", "z", "w"]
    pcd = f"# by hand\nVERSION 0.7\nFIELDS {' '.join(names)}\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    pcd += "WIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n"
    ply = "ply\nformat ascii 1.0\ncomment by hand\nelement camera 1\nproperty int id\nelement vertex 3\n"
    ply += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    body = "\n".join(rows) + "\n"
    return {"pcd": (read_pcd, (pcd + body).encode()), "ply": (read_ply, (ply + "7\n" + body).encode())}


@pytest.mark.parametrize("kind", ["pcd", "ply"])
@pytest.mark.parametrize(
    ("rows", "row", "got"),
    [
        (["1 2 3 4", "5 6 7", "9 9 9 9 9"], 1, "3"),  # as many numbers in all as the header promises
        (["1 2 3 4", "5 6 7 8 0", "9 9 9"], 1, "more than 4"),
        (["1 2 3 4 0 \r", "5 6 7 8", "9 9 9 9"], 0, "more than 4"),
        (["", "1 2 3 4", " \t\r", "5 6 7 8", "9"], 4, "1"),
    ],
)
def test_rows_of_text_are_as_long_as_the_header_says(kind, rows, row, got):
    """They were read as one stream of numbers, so that a number too many moved all that follow."""
    reader, content = text_files(rows)[kind]
    line = row + (12 if kind == "pcd" else 13)
    with pytest.raises(CloudReadError, match=f"expected 4 numbers in each line.*line {line} has {got}: correct"):
        reader(content)


@pytest.mark.parametrize("kind", ["pcd", "ply"])
def test_empty_lines_and_blanks_are_no_rows(kind):
    reader, content = text_files(["", "1 2 3 4 \r", " \t", "\t5 6  7 8\r", "9 9 9 9"])[kind]
    for text in (content, content + b"3 0 1 2\n", content.replace(b"7\n\n", b"\n7\n"), content.rstrip(b"\n")):
        cloud = reader(text)
        assert cloud.points.tolist() == [[1, 2, 3], [5, 6, 7], [9, 9, 9]]
        assert cloud.columns["w"].tolist() == [4, 8, 9]
    with pytest.raises(CloudReadError, match="promises 3 points, but 2 rows of numbers follow"):
        reader(content.replace(b"9 9 9 9\n", b""))
    with pytest.raises(CloudReadError, match=r"numbers only in the ascii data, got in line 1[67]: .*'nine'"):
        reader(content.replace(b"9 9 9 9", b"9 9 9 nine"))


@pytest.mark.parametrize("file", ["pcd", "ply"])
@pytest.mark.parametrize(
    ("kind", "words", "wrong"),
    [
        ("u1", ["0", "255", "300"], "300"),
        ("u1", ["255", "-1", "0"], "-1"),
        ("u1", ["0.25", "1", "0"], "0.25"),
        ("i1", ["127", "-128", "-129"], "-129"),
        ("u2", ["65536", "1", "2"], "65536"),
        ("i4", ["1", "nan", "3"], "nan"),
        ("i4", ["1", "2", "3000000000"], "3000000000"),
        ("u4", ["4294967295", "4294967296", "0"], "4294967296"),
        ("i4", ["1", "inf", "3"], "inf"),
    ],
)
def test_whole_numbers_of_text_are_as_the_header_says(file, kind, words, wrong):
    """They wrapped: a red of 300 became 44, a label of nan -2147483648."""
    rows = [f"1 2 3 {word}" for word in words]
    size, letter = kind[1], kind[0].upper()
    name = {"i1": "char", "u1": "uchar", "u2": "ushort", "i4": "int", "u4": "uint"}[kind]

    def content(rows):
        reader, text = text_files(rows)[file]
        text = text.replace(b"SIZE 4 4 4 4\nTYPE F F F F", f"SIZE 4 4 4 {size}\nTYPE F F F {letter}".encode())
        return reader, text.replace(b"float w", f"{name} w".encode())

    row = words.index(wrong) + 1
    reader, text = content(rows)
    with pytest.raises(CloudReadError, match=f"'w' holds whole numbers from .*row {row} of numbers has {wrong}: "):
        reader(text)
    rows[row - 1] = "1 2 3 1.0e1"
    reader, text = content(rows)
    column = reader(text).columns["w"]
    assert column.dtype == kind
    assert column.tolist() == [10 if word == wrong else int(word) for word in words]


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [("I", "9223372036854775808"), ("U", "18446744073709551616"), ("U", "-1"), ("I", "0.5"), ("I", "nan")],
)
def test_whole_numbers_of_64_bits_of_text(kind, wrong):
    """One that is written with an exponent made all others of its column round; one too large was rounded."""
    most = {"I": 2**63 - 1, "U": 2**64 - 1}[kind]
    content = text_files([f"1 2 3 {most}", f"1 2 3 {most - 10}", "1 2 3 1e1"])["pcd"][1]
    content = content.replace(b"SIZE 4 4 4 4\nTYPE F F F F", b"SIZE 4 4 4 8\nTYPE F F F " + kind.encode())
    assert read_pcd(content).columns["w"].tolist() == [most, most - 10, 10]
    with pytest.raises(CloudReadError, match="whole numbers from"):
        read_pcd(content.replace(b"1e1", wrong.encode()))


@pytest.mark.parametrize("kind", ["i4", "u4"])
@pytest.mark.parametrize("name", ["rgb", "rgba"])
def test_packed_colours_of_text_with_a_sign_or_without(kind, name):
    """The bits are the same; those of more than 31 became black where the header says int."""
    for word in ("4294901760", "-65536", "16711680"):  # red, opaque or not
        for cloud in colored_texts([word, "255"], kind, name):
            assert cloud.colors.tolist() == [[255, 0, 0], [0, 0, 255]]
    with pytest.raises(CloudReadError, match="whole numbers from -2147483648 to 4294967295"):
        colored_texts(["4294967296"], kind, name)


@pytest.mark.parametrize("kind", ["pcd", "ply"])
def test_numbers_as_python_alone_writes_them_are_none(kind):
    reader, content = text_files(["1 2 3 4", "1_0 2 3 4", "5 6 7 8"])[kind]
    with pytest.raises(
        CloudReadError, match=f"numbers only in the ascii data, got in line {13 + (kind == 'ply')}: '1_0'"
    ):
        reader(content)


@pytest.mark.parametrize("code", ["ascii", "binary_little_endian", "binary_big_endian", "pcd ascii", "pcd binary"])
@pytest.mark.parametrize(
    ("kind", "x", "dtype"),
    [
        ("i4", [2**24, -(2**24), 0], "f4"),
        ("i4", [2**24 + 1, 0, 0], "f8"),
        ("i4", [0, -(2**24) - 1, 5], "f8"),
        ("i4", [-(2**31), 2**31 - 1, 1], "f8"),
        ("u4", [2**32 - 1, 0, 2**31 + 1], "f8"),
        ("u4", [7, 0, 2**24], "f4"),
        ("i2", [-(2**15), 2**15 - 1, 0], "f4"),
    ],
)
def test_whole_coordinates_stay_exact(code, kind, x, dtype):
    """Beyond 2**24 they were rounded to float32: map coordinates in millimetres, by up to 128 mm."""
    fields = [("x", kind, np.array(x)[:, None])] + [(name, "f4", np.full((3, 1), 0.1)) for name in "yz"]
    cloud = read_pcd(pcd(code[4:], fields, 3, 1)) if code.startswith("pcd") else read_ply(ply(code, fields, 3))
    assert cloud.points.dtype == dtype
    assert cloud.points[:, 0].tolist() == x
    assert cloud.points[:, 1:].tolist() == np.full((3, 2), 0.1, np.float32).tolist()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16-le", "cp1252", "cp1251", "cp850"])
@pytest.mark.parametrize("by", ["Åsa", "Хорхе", "x\x85y", "a\x1cb\x1d\x1e\x0b\x0c", "à\xa0"])
def test_headers_with_words_of_any_language(encoding, by):
    """Letters of UTF-8 hold bytes that end lines or words in other codes: a comment broke the header."""
    name = by.encode(encoding, "replace").replace(b"\n", b"")
    rows = [f"comment by {i}".encode() + name for i in range(2)] + [b"obj_info " + name]
    content = PLY.replace(b"element vertex", b"\n".join(rows) + b"\nelement vertex")
    for text in (content, content.replace(b"comment by", b"comment")):
        assert np.array_equal(read_ply(text).points, XYZ, equal_nan=True)
    content = pcd_header("binary").replace(b"WIDTH", b"# by " + name + b"\n#" + name + b"\nWIDTH") + pcd_body()
    assert np.array_equal(read_pcd(content).points, XYZ.reshape(2, 2, 3), equal_nan=True)


def test_names_of_fields_of_any_language():
    """`Å` was split within the letter, `à` at its second byte, which is a blank in Latin-1."""
    for word in ("Å", "nà", "Хорхе"):
        name = word.encode()
        read = read_ply(PLY.replace(b"float z\n", b"float z\nproperty uchar " + name + b"\n") + bytes(4))
        assert list(read.columns) == [word]
        columns = {"x": np.zeros(4), "y": np.ones(4), "z": np.ones(4), word: np.arange(4.0)}
        assert_same_columns(read_ply(encode_ply(columns)).columns, dict(list(columns.items())[3:]))
        content = pcd_header("binary", fields="x y z rgb label w").replace(b" w\n", b" " + name + b"\n")
        assert list(read_pcd(content + bytes(6 * 4 * 4)).columns) == [word]
    latin = PLY.replace(b"float z\n", b"float z\nproperty uchar h\xf6he\n") + bytes(4)
    assert list(read_ply(latin).columns) == ["h\xf6he"]


def colored_texts(words: list[str], kind: str, name: str) -> list:
    """Clouds of x, y, z and a packed colour for each word given, as PCD and as PLY of text."""
    fields = [(axis, "f4", np.ones((len(words), 1))) for axis in "xyz"]
    fields.append((name, kind, np.full((len(words), 1), 7777)))
    files = [pcd("ascii", fields, len(words), 1), ply("ascii", fields, len(words))]
    for word in words:
        files = [re.sub(rb"7777(\.0)?", word.encode(), content, count=1) for content in files]
    return [read_pcd(files[0]), read_ply(files[1])]


@pytest.mark.parametrize("name", ["rgb", "rgba", "RGB"])
@pytest.mark.parametrize(("kind", "red"), [("f4", "2.3418052e-38"), ("u4", "16711680"), ("i4", "16711680")])
def test_packed_colours_of_text_that_are_nan_are_none(kind, red, name):
    """They were the bits of that number: a dark red, (192, 0, 0)."""
    for cloud in colored_texts(["nan", red, "NaN", "-nan"], kind, name):
        assert cloud.colors.tolist() == [[0, 0, 0], [255, 0, 0], [0, 0, 0], [0, 0, 0]]
    for cloud in colored_texts(["nan", "nan"], kind, name):
        assert cloud.colors is None
        assert cloud.columns == {}
    for cloud in colored_texts([], kind, name):
        assert cloud.colors.shape == (0, 3)


def test_packed_colours_of_bytes_may_be_nan():
    """Opaque colours with much red are the bits of a nan: PCL keeps them in float32."""
    packed = np.array([0xFFFF0000, 0xFF800001, 0x7FC00000, 0xFFC01020], np.uint32)
    assert np.isnan(packed.view(np.float32)).all()
    cloud = read_pcd(pcd_of({"rgb": packed.view(np.float32)}, "binary"))
    assert cloud.colors.reshape(-1, 3).tolist() == [[255, 0, 0], [128, 0, 1], [192, 0, 0], [192, 16, 32]]


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
    colors, object_of = np.random.default_rng(1).integers(0, 256, (50, 3), np.uint8), np.arange(50, dtype=np.int32)
    for dtype, suffix in (("f4", "ply"), ("f8", "ply"), ("f4", "pcd"), ("f8", "pcd")):
        ours = pcgraph.Cloud(points.astype(dtype), colors, points.astype(dtype), columns={"object": object_of})
        path = str(tmp_path / f"ours.{suffix}")
        pcgraph.write_cloud(path, ours)
        read = pcgraph.as_cloud(o3d.t.io.read_point_cloud(path))
        assert np.array_equal(read.points, ours.points)
        assert np.array_equal(read.columns["object"], object_of)
        if (dtype, suffix) != ("f8", "pcd"):  # of which the older reader makes zeros
            read = pcgraph.as_cloud(o3d.io.read_point_cloud(path))
            assert np.array_equal(read.points, ours.points)
        assert np.array_equal(read.colors, colors)
        assert np.array_equal(read.normals, ours.normals)


@pytest.mark.parametrize("name", ["a.ply", "a.npz"])
def test_results_go_with_their_own_points(tmp_path, boxes, name):
    points, _, result = boxes
    pcgraph.write_segmentation(tmp_path / name, points, result)
    assert (tmp_path / name).exists()
    for other in (points[:10], np.concatenate((points, points)), pcgraph.Cloud(points[1:])):
        with pytest.raises(ValueError, match="expected the points that were segmented"):
            pcgraph.write_segmentation(tmp_path / f"wrong_{name}", other, result)
    assert not (tmp_path / f"wrong_{name}").exists()


@pytest.mark.parametrize("dtype", ["u1", "i4", "i8", "f2", "f4", "f8", "f16"])
def test_results_go_with_points_of_any_dtype_that_is_segmented(tmp_path, dtype):
    points = np.random.default_rng(0).integers(0, 100, (2000, 3)).astype(dtype)
    for cloud in (points, points.tolist()):
        pcgraph.write_segmentation(tmp_path / "a.ply", cloud, pcgraph.segment(cloud))
        read = pcgraph.read_cloud(tmp_path / "a.ply")
        assert read.points.dtype.kind == "f"
        assert np.array_equal(read.points, points)


def test_results_come_back(tmp_path, boxes):
    points, _, result = boxes
    names = ["a.csv", "a.npy", "a.npz", "a.pcd", "a.ply"]
    for name in names:
        pcgraph.write_segmentation(tmp_path / name, points, result, levels=[2, 9])
        read = pcgraph.read_cloud(tmp_path / name)
        assert np.array_equal(read.points, points)
        assert list(read.columns) == ["object", "part", "supervoxel", "level_2", "level_9"]
        assert all(column.dtype == np.int32 for column in read.columns.values())
        assert np.array_equal(read.columns["object"], result.labels)
        assert np.array_equal(read.columns["part"], result.parts)
        assert np.array_equal(read.columns["supervoxel"], result.supervoxels)
        assert np.array_equal(read.columns["level_9"], result.cut(9))
        assert read.colors is read.labels is None
    with pytest.raises(pcgraph.CloudWriteError, match=r"ending in .*\.ply.*, got 'a\.doc'"):
        pcgraph.write_segmentation(tmp_path / "a.doc", points, result)
    with pytest.raises(pcgraph.CloudWriteError, match="cannot write"):
        pcgraph.write_segmentation(tmp_path / "no" / "a.ply", points, result)
    with pytest.raises(ValueError, match="expected a whole number n"):
        pcgraph.write_segmentation(tmp_path / "b.ply", points, result, levels=[0])
    assert sorted(path.name for path in tmp_path.iterdir()) == names


def test_colours_of_objects_stand_before_the_clouds_own_if_asked_for(boxes):
    points, _, result = boxes
    colors = np.random.default_rng(0).integers(0, 256, points.shape, np.uint8)
    cloud = pcgraph.labelled_cloud(pcgraph.Cloud(points, colors), result, colorize=True)
    assert len(np.unique(cloud.colors, axis=0)) == 3
    own = [cloud.columns[f"original_{name}"] for name in ("red", "green", "blue")]
    assert np.array_equal(np.stack(own, axis=1), colors)
    assert list(pcgraph.labelled_cloud(points, result, colorize=True).columns) == ["object", "part", "supervoxel"]


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


def test_files_whose_points_do_not_fit_into_memory(monkeypatch):
    def full() -> None:
        raise MemoryError

    monkeypatch.setattr("pcgraph.io.pcd.lzf_decompressor", full)
    with pytest.raises(CloudReadError, match=r"a\.pcd: the points do not fit into memory"):
        decode_cloud(pcd_header("binary_compressed") + struct.pack("<II", 4, 80) + b"four", "a.pcd")


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


@pytest.mark.parametrize("count", [b"3", b"4"])
def test_two_vertex_elements_are_refused(count):
    second = b"element vertex " + count + b"\nproperty float x\nproperty float y\nproperty float z\nend_header"
    body = XYZ[: int(count)].tobytes()
    with pytest.raises(
        CloudReadError, match=f"one element called vertex in the PLY header, got 2, of 4 and {int(count)}"
    ):
        read_ply(PLY.replace(b"end_header", second) + body)
    faces = b"element face 0\nelement face 0\nend_header"
    assert np.array_equal(read_ply(PLY.replace(b"end_header", faces)).points, XYZ, equal_nan=True)


@pytest.mark.parametrize("code", ["ascii", "binary_big_endian", "binary_little_endian"])
def test_two_format_lines_are_refused(code):
    for first, second in (("binary_little_endian", code), (code, "binary_little_endian")):
        lines = f"format {first} 1.0\nformat {second} 1.0".encode()
        with pytest.raises(CloudReadError, match=f"one format line in the PLY header, got '{first}' and '{second}'"):
            read_ply(PLY.replace(b"format binary_little_endian 1.0", lines))


@pytest.mark.parametrize(
    "line", ["FIELDS z y x rgb label", "WIDTH 1", "height 1", "VIEWPOINT 0 0 0 1 0 0 0", "SIZE 4 4 4 4 4"]
)
def test_pcd_lines_that_come_twice_are_refused(line):
    header = pcd_header("binary").replace(b"DATA", line.encode() + b"\nDATA")
    with pytest.raises(CloudReadError, match=f"one {line.split()[0].upper()} line in the PCD header, got two"):
        read_pcd(header + pcd_body())


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


# --- further columns --------------------------------------------------------------------------------------------------

COLUMNS = {
    "intensity": np.array([0.1, np.nan, -3.5, 1e30], np.float32),
    "GpsTime": np.array([1.6e9 + 1e-6, 0.0, -1.0, 2.0]),
    "ring": np.array([0, 127, 65535, 9], np.uint16),
    "echo": np.array([-128, 0, 1, 127], np.int8),
    "beam": np.array([-32768, 0, 1, 32767], np.int16),
    "classification": np.array([0, 2, 6, 255], np.uint8),
    "row": np.array([-(2**31), 0, 1, 2**31 - 1], np.int32),
    "id": np.array([0, 1, 2, 2**32 - 1], np.uint32),
}
OF_PCD = {
    "stamp": np.array([-(2**63), 0, 2**53 + 1, 2**63 - 1], np.int64),
    "hash": np.array([0, 1, 2**53 + 1, 2**64 - 1], np.uint64),
    "spectrum": np.arange(12, dtype=np.float32).reshape(4, 3),
}


def table_of(columns, order="<"):
    """Rows of x, y, z and these columns."""
    fields = [(name, column.dtype.newbyteorder(order), column.shape[1:]) for name, column in columns.items()]
    rows = np.empty(4, np.dtype([(axis, order + "f4") for axis in "xyz"] + fields))
    for i, axis in enumerate("xyz"):
        rows[axis] = XYZ[:, i]
    for name, column in columns.items():
        rows[name] = column
    return rows


def words_of(row) -> str:
    return " ".join(repr(number) for value in row.tolist() for number in np.ravel(np.asarray(value, object)))


def pcd_of(columns, data: str) -> bytes:
    rows = table_of(columns)
    kinds = [rows.dtype[name] for name in rows.dtype.names]
    counts = [int(np.prod(kind.shape)) for kind in kinds]
    header = (
        f"VERSION 0.7\nFIELDS {' '.join(rows.dtype.names)}\nSIZE {' '.join(str(k.base.itemsize) for k in kinds)}\n"
        f"TYPE {' '.join(k.base.kind.upper() for k in kinds)}\nCOUNT {' '.join(map(str, counts))}\n"
        f"WIDTH 2\nHEIGHT 2\nDATA {data}\n"
    ).encode()
    if data == "ascii":
        return header + "\n".join(words_of(row) for row in rows).encode()
    if data == "binary":
        return header + rows.tobytes()
    plain = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
    literals = b"".join(bytes([len(plain[i : i + 32]) - 1]) + plain[i : i + 32] for i in range(0, len(plain), 32))
    return header + struct.pack("<II", len(literals), len(plain)) + literals


def ply_of(columns, code: str) -> bytes:
    rows = table_of(columns, ">" if "big" in code else "<")
    kinds = {"f4": "float", "f8": "double", "u1": "uchar", "i1": "char", "i2": "short", "u2": "ushort", "i4": "int"}
    kinds["u4"] = "uint32"
    lines = [f"property {kinds[rows.dtype[name].str[1:]]} {name}" for name in rows.dtype.names]
    header = "\n".join(["ply", f"format {code} 1.0", "element vertex 4", *lines, "end_header"]) + "\n"
    return header.encode() + ("\n".join(map(words_of, rows)).encode() if code == "ascii" else rows.tobytes())


def assert_same_columns(found, expected):
    assert list(found) == list(expected)
    for name, column in expected.items():
        assert found[name].dtype == column.dtype, name
        assert found[name].dtype.isnative
        assert np.array_equal(found[name].reshape(column.shape), column, equal_nan=column.dtype.kind == "f"), name


@pytest.mark.parametrize("data", BODIES)
def test_pcd_columns_come_as_they_are_stored(data):
    columns = COLUMNS | OF_PCD
    cloud = read_pcd(pcd_of(columns, data))
    assert cloud.organised
    assert cloud.columns["ring"].shape == (2, 2)
    assert cloud.columns["spectrum"].shape == (2, 2, 3)
    assert_same_columns(cloud.columns, columns)


@pytest.mark.parametrize("code", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_columns_come_as_they_are_stored(code):
    assert_same_columns(read_ply(ply_of(COLUMNS, code)).columns, COLUMNS)


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize(
    ("kind", "stored", "expected"),
    [
        ("i8", [5_000_000_000, 705_032_704, -1], None),  # the first two became one label
        ("u8", [2**33 + 7, 7, 0], None),
        ("u8", [2**64 - 1, 7, 0], None),
        ("i8", [2**31, 0, 0], None),
        ("i8", [2**31 - 1, -(2**31), 0], [2**31 - 1, -(2**31), 0]),
        ("u8", [3, 2, 1], [3, 2, 1]),
        ("u4", [2**32 - 1, 2**31 - 1, 0], [-1, 2**31 - 1, 0]),
    ],
)
def test_labels_that_32_bits_do_not_hold_stay_columns(code, kind, stored, expected):
    fields = [(axis, "f4", np.ones((3, 1))) for axis in "xyz"] + [("label", kind, np.array(stored, kind)[:, None])]
    cloud = read_pcd(pcd(code, fields, 3, 1))
    if expected is None:
        assert cloud.labels is None
        assert cloud.columns["label"].dtype == kind
        assert cloud.columns["label"].tolist() == stored
    else:
        assert cloud.labels.tolist() == expected
        assert cloud.columns == {}


@pytest.mark.parametrize("code", CODES)
def test_a_field_counts_once(code):
    """Of two fields of one name the first was lost, and of two numbers for each x the second."""
    rows = np.arange(6.0)[:, None]
    fields = [(name, "f4", rows + i) for i, name in enumerate(["x", "_", "y", "i", "_", "z"])]
    assert read_pcd(pcd(code, fields, 6, 1)).columns["i"].tolist() == (rows[:, 0] + 3).tolist()
    for name in ("x", "i"):
        with pytest.raises(CloudReadError, match="expected distinct FIELDS in the PCD header, got x _ y i"):
            read_pcd(pcd(code, [*fields, (name, "f4", rows)], 6, 1))
    with pytest.raises(CloudReadError, match="one number for each point in the field 'y', got 3"):
        read_pcd(pcd(code, [*fields[:2], ("y", "f4", np.ones((6, 3))), *fields[3:]], 6, 1))
    for name, kind in (("label", "i4"), ("rgb", "u4"), ("normal_x", "f4")):
        vectors = rows.astype(kind) + np.arange(2).astype(kind)
        others = [(name.replace("_x", axis), "f4", rows) for axis in ("_y", "_z") if name == "normal_x"]
        cloud = read_pcd(pcd(code, [*fields, (name, kind, vectors), *others], 6, 1))
        assert cloud.labels is cloud.colors is cloud.normals is None
        assert cloud.columns[name].tolist() == vectors.tolist()


def test_names_in_any_case_and_padding_as_pcl_writes_it():
    columns = {"Red": np.uint8([1, 2, 3, 4]), "GREEN": np.uint8([5, 6, 7, 8]), "blue": np.uint8([0, 0, 0, 9])}
    columns |= {"_": np.zeros((4, 3), np.uint8), "Label": np.int32([1, 2, 3, 4]), "rgb": np.float64([0, 0, 0, 0])}
    cloud = read_pcd(pcd_of(columns, "binary"))
    assert cloud.colors[1, 1].tolist() == [4, 8, 9]
    assert cloud.labels.tolist() == [[1, 2], [3, 4]]
    assert list(cloud.columns) == ["rgb"]  # not of four bytes, so no packed colour


@pytest.fixture(scope="module")
def scene():
    """A plane with a NaN, noise around it, and columns of every type."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(50) * 0.1, np.arange(50) * 0.1)
    plane = np.stack((x, y, np.zeros_like(x)), axis=-1).reshape(-1, 3)
    points = np.concatenate((plane, rng.uniform((0, 0, 0.5), (5, 5, 5), (300, 3))))
    points[7] = np.nan
    n = len(points)
    columns = {name: np.resize(column, (n, *column.shape[1:])) for name, column in (COLUMNS | OF_PCD).items()}
    columns |= {"noise": rng.standard_normal(n), "small": rng.random(n).astype(np.float16)}
    columns |= {"seen": rng.random(n) < 0.5, "labels": np.arange(n, dtype=np.int32)}
    cloud = pcgraph.Cloud(points, columns=columns)
    return cloud, pcgraph.segment(cloud, viewpoint=(2.5, 2.5, 9.0), voxel_size=0.35)


SUFFIXES = ("ply", "pcd", "npz", "npy")


def test_columns_are_written_back(scene, tmp_path):
    cloud, result = scene
    assert result.outliers.sum() > 50
    for suffix in SUFFIXES:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            pcgraph.write_segmentation(tmp_path / f"a.{suffix}", cloud, result)
        told = {str(one.message).split("'")[1] for one in caught if "to doubles" in str(one.message)}
        assert told == ({"stamp", "hash"} if suffix == "ply" else set())
        seen = np.isfinite(cloud.points[:, 0]) if suffix == "ply" else ...
        read = pcgraph.read_cloud(tmp_path / f"a.{suffix}")
        ours = {"object": result.labels, "part": result.parts, "supervoxel": result.supervoxels}
        expected = {name: column[seen] for name, column in (cloud.columns | ours).items()}
        if suffix != "npz":  # the only one that tells a column of this name from the cloud's own labels
            assert np.array_equal(read.labels, expected.pop("labels"))
        if suffix in ("ply", "pcd"):
            expected |= {"small": expected["small"].astype(np.float32), "seen": expected["seen"].astype(np.uint8)}
        if suffix == "ply":
            expected |= {name: expected[name].astype(float) for name in ("stamp", "hash")}
            rows = expected.pop("spectrum")
            expected |= {f"spectrum_{i}": rows[:, i] for i in range(3)}
        assert_same_columns(dict(sorted(read.columns.items())), dict(sorted(expected.items())))


def test_a_result_is_read_and_written_again(scene, tmp_path):
    cloud, result = scene
    cloud = pcgraph.Cloud(cloud.points, columns={n: cloud.columns[n] for n in COLUMNS})
    seen, clouds = result, [cloud]
    for i, size in enumerate((0.35, 0.5, 0.6)):
        seen = pcgraph.segment(clouds[-1], voxel_size=size)
        pcgraph.write_segmentation(tmp_path / f"{i}.ply", clouds[-1], seen, colorize=i == 2)
        clouds.append(pcgraph.read_cloud(tmp_path / f"{i}.ply"))
    first, second, third = clouds[1:]
    assert_same_columns({n: third.columns[n] for n in first.columns}, first.columns)
    assert_same_columns({n: third.columns[n] for n in second.columns}, second.columns)
    assert list(third.columns)[-6:] == [
        f"{prefix}_{name}" for prefix in ("pcgraph", "pcgraph2") for name in ("object", "part", "supervoxel")
    ]
    assert np.array_equal(third.columns["pcgraph2_object"], seen.labels)
    assert third.colors is not None


def test_columns_of_our_names_in_any_case_are_the_clouds(boxes):
    points, _, result = boxes
    own = np.arange(len(points))
    cloud = pcgraph.labelled_cloud(pcgraph.Cloud(points, columns={"Object": own, "PART": own}), result)
    assert list(cloud.columns) == ["Object", "PART", "pcgraph_object", "pcgraph_part", "supervoxel"]


@pytest.fixture(scope="module")
def own(scene):
    """The scene with colours, normals and labels of its own, and where they are finite."""
    rng, n = np.random.default_rng(5), len(scene[0].points)
    colors, labels = rng.integers(0, 256, (n, 3), np.uint8), rng.integers(-2, 2**31 - 1, n, np.int32)
    normals = rng.standard_normal((n, 3)).astype(np.float32)
    return pcgraph.Cloud(scene[0].points, colors, normals, labels), np.isfinite(scene[0].points[:, 0])


def assert_kept(read, cloud, seen):
    assert np.array_equal(read.colors, cloud.colors[seen])
    assert np.array_equal(read.normals, cloud.normals[seen])
    assert read.normals.dtype == cloud.normals.dtype
    assert np.array_equal(read.labels, cloud.labels[seen])


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    "names",
    [
        (),
        ("red", "Green", "blue"),  # beside packed colours
        ("red",),
        ("rgba",),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("r", "g", "b"),
        ("nx", "ny", "nz"),  # beside normal_x and so on
        ("normal_x", "normal_z"),
        ("labels",),
        ("LABEL",),
    ],
)
def test_colours_normals_and_labels_are_kept_beside_columns_of_any_name(names, suffix, own):
    cloud, finite = own
    columns = {name: np.arange(len(finite), dtype=np.int32) + i for i, name in enumerate(names)}
    cloud = pcgraph.Cloud(cloud.points, cloud.colors, cloud.normals, cloud.labels, columns=columns)
    read = decode_cloud(encode_cloud(cloud, f"a.{suffix}"), f"a.{suffix}")
    seen = finite if suffix == "ply" else ...
    assert_kept(read, cloud, seen)
    assert_same_columns(read.columns, {name: column[seen] for name, column in columns.items()})


def test_columns_that_would_be_taken_for_others_are_refused():
    points, column = np.zeros((2, 3)), np.arange(2, dtype=np.int32)
    for name, own in (("x", {}), ("rgb", {"colors": np.zeros((2, 3), np.uint8)})):
        cloud = pcgraph.Cloud(points, columns={name: column}, **own)
        for suffix in ("ply", "pcd", "npy"):
            with pytest.raises(pcgraph.CloudWriteError, match=f"other? name.*{name}"):
                encode_cloud(cloud, f"a.{suffix}")
        read = decode_cloud(encode_cloud(cloud, "a.npz"), "a.npz")  # which keeps them apart
        assert_same_columns(read.columns, {name: column})


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "f16"])
def test_colours_and_normals_of_any_float_and_labels_of_any_integer(dtype, scene, own, tmp_path):
    (cloud, finite), result = own, scene[1]
    shades, labels = (cloud.colors / 255).astype(dtype), np.arange(len(finite))
    pcgraph.write_segmentation(
        tmp_path / "a.ply", pcgraph.Cloud(cloud.points, shades, cloud.normals.astype(dtype), labels), result
    )
    read = pcgraph.read_cloud(tmp_path / "a.ply")
    assert np.array_equal(read.colors, cloud.colors[finite])
    assert np.array_equal(read.normals, cloud.normals[finite].astype(dtype))
    assert read.labels.dtype == np.int32
    assert np.array_equal(read.labels, labels[finite])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"colors": np.zeros((3, 3), np.uint8)}, r"cloud's colors in the shape \(4, 3\), got \(3, 3\)"),
        ({"normals": np.zeros((4, 4))}, r"cloud's normals in the shape \(4, 3\), got \(4, 4\)"),
        ({"labels": np.zeros((4, 1), int)}, r"cloud's labels in the shape \(4,\), got \(4, 1\)"),
        ({"viewpoint": np.zeros(4)}, r"cloud's viewpoint in the shape \(4, 3\), got \(4,\)"),
        ({"colors": np.full((4, 3), 1.5)}, "colors as uint8 or as floats within 0..1, got float64"),
        ({"colors": np.zeros((4, 3), int)}, "colors as uint8 or as floats within 0..1, got int64"),
        ({"normals": np.zeros((4, 3), int)}, "normals as floats, got int64"),
        ({"labels": np.full(4, 1 << 40)}, "cloud's labels in 32 bits"),
        ({"labels": np.full(4, np.nan)}, "cloud's labels as whole numbers"),
        ({"points": np.zeros((4, 2))}, r"points as numbers of shape \(n, 3\) or \(h, w, 3\)"),
        ({"columns": {"": np.zeros(4)}}, "names of columns as printable words, got ''"),
        ({"columns": {"a\x00": np.zeros(4)}}, r"names of columns as printable words, got 'a\\x00'"),
        ({"columns": {"\ud800": np.zeros(4)}}, r"names of columns as printable words, got '\\ud800'"),
        ({"columns": {3: np.zeros(4)}}, "names of columns as printable words, got 3"),
        ({"columns": {"a": np.zeros(3)}}, r"the column 'a' in the points' shape \(4,\), got \(3,\)"),
        ({"columns": {"a": np.zeros((4, 1, 1))}}, "the column 'a' in the points' shape"),
        ({"columns": {"a": np.full(4, "x")}}, "the column 'a' as an array of numbers"),
        ({"columns": {"a": [0] * 4}}, "the column 'a' as an array of numbers, got list"),
    ],
)
def test_clouds_that_cannot_be_written(arrays, message, tmp_path):
    cloud = pcgraph.Cloud(**({"points": np.zeros((4, 3))} | arrays))
    for suffix in SUFFIXES:
        with pytest.raises(pcgraph.CloudWriteError, match=message):
            pcgraph.write_cloud(tmp_path / f"a.{suffix}", cloud)
    assert not list(tmp_path.iterdir())


def test_columns_of_any_language_are_written_back():
    names = ["Å", "nà", "Хорхе", "∂", "two words", "two\x0blines"]
    cloud = pcgraph.Cloud(np.zeros((4, 3)), columns={name: np.arange(4) + i for i, name in enumerate(names)})
    for suffix in SUFFIXES:
        read = decode_cloud(encode_cloud(cloud, f"a.{suffix}"), f"a.{suffix}").columns
        words = [*names[:4], "two_words", "two_lines"]
        assert list(read) == (words if suffix in ("ply", "pcd") else names)
        assert all(column.tolist() == [i, i + 1, i + 2, i + 3] for i, column in enumerate(read.values()))
    twice = pcgraph.Cloud(np.zeros((4, 3)), columns={"a b": np.arange(4), "a_b": np.arange(4)})
    for suffix in ("ply", "pcd"):
        with pytest.raises(pcgraph.CloudWriteError, match="several are called 'a_b'"):
            encode_cloud(twice, f"a.{suffix}")


KINDS = ("i1", "u1", "i2", ">u2", "i4", "u4", "i8", "u8", "f2", "f4", ">f4", "f8", "?")


def cloud_of(rng) -> pcgraph.Cloud:
    """A cloud of any size, shape and parts, with columns of any types."""
    h, w = int(rng.integers(2, 4)), int(rng.integers(1, 5))
    shape = (h, w) if rng.random() < 0.5 else (h * w,)
    points = (rng.standard_normal((*shape, 3)) * 10.0 ** rng.integers(-3, 7)).astype(rng.choice(["f4", "f8"]))
    points[rng.random(shape) < 0.3] = np.nan
    parts = {
        "colors": rng.integers(0, 256, (*shape, 3), np.uint8),
        "normals": rng.standard_normal((*shape, 3)).astype(rng.choice(["f4", "f8"])),
        "labels": rng.integers(-(2**31), 2**31, shape, np.int32),
        "viewpoint": rng.standard_normal((*shape, 3) if rng.random() < 0.5 else 3),
    }
    columns = {}
    for i in range(rng.integers(0, 5)):
        kind, depth = np.dtype(rng.choice(KINDS)), () if rng.random() < 0.7 else (2,)
        columns[f"c{i}"] = (rng.random((*shape, *depth)) * 200).astype(kind)
    return pcgraph.Cloud(points, **{k: part for k, part in parts.items() if rng.random() < 0.5}, columns=columns)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), suffix=st.sampled_from(SUFFIXES))
def test_any_cloud_comes_back(seed, suffix):
    cloud = cloud_of(np.random.default_rng(seed))
    read = decode_cloud(encode_cloud(cloud, f"a.{suffix}"), f"a.{suffix}")
    expected = cloud.finite() if suffix == "ply" else cloud
    columns = dict(expected.columns)
    if suffix in ("ply", "pcd"):
        instead = {"b1": "u1", "f2": "f4"} | ({"i8": "f8", "u8": "f8"} if suffix == "ply" else {})
        columns = {n: column.astype(instead.get(column.dtype.str[1:], column.dtype)) for n, column in columns.items()}
    if suffix == "ply":
        parts = [
            (f"{n}_{i}" * (c.ndim > 1) or n, p) for n, c in columns.items() for i, p in enumerate(np.atleast_2d(c.T))
        ]
        columns = dict(parts)
    viewpoint = expected.viewpoint
    if suffix in ("ply", "npy") and viewpoint is not None and viewpoint.ndim == 1:
        viewpoint = None
    for found, wanted in zip(
        (read.points, read.colors, read.normals, read.labels, read.viewpoint, *read.columns.values()),
        (expected.points, expected.colors, expected.normals, expected.labels, viewpoint, *columns.values()),
        strict=True,
    ):
        assert (found is None) == (wanted is None)
        if wanted is not None:
            assert found.dtype == wanted.dtype.newbyteorder("=")
            assert np.array_equal(found, wanted, equal_nan=wanted.dtype.kind == "f")
    assert list(read.columns) == list(columns)
