# SPDX-License-Identifier: Apache-2.0
"""Files as other programs write them: each kind made anew from its header, of the same two points.

The headers are those that users reported where another reader failed, or that the programs named write.
"""

from __future__ import annotations

import struct

import numpy as np
import pytest

import pcgraph
from pcgraph.io import decode_cloud

POINTS = np.array([[0.5, -1.25, 2.0], [7.0, 7.5, 9.0]])
UTM = POINTS + np.array([500_000.125, 4_500_000.25, 0.0])
FAR = "500000.625 4499999 2", "500007.125 4500007.75 9"
XYZ = "property float x\nproperty float y\nproperty float z\n"
RGB = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
COLORS = [[255, 128, 0], [1, 2, 3]]
PACKED = [f"{x:.9g}" for x in np.array([0xFF8000, 0x010203], np.uint32).view(np.float32)]
P, Q = POINTS.tolist()


def ply(properties: str, rows: tuple[str, ...], before: str = "", between: str = "", name: str = "vertex") -> bytes:
    """Ascii PLY of two points; `rows` hold the data of the elements `before`, too."""
    header = f"ply\nformat ascii 1.0\n{before}element {name} 2\n{properties}{between}end_header\n"
    return (header + "\n".join(rows) + "\n").encode()


def binary(
    properties: str, kinds: str, rows: list[tuple], before: str = "", lead: bytes = b"", order: str = "<"
) -> bytes:
    name = "little" if order == "<" else "big"
    header = f"ply\nformat binary_{name}_endian 1.0\n{before}element vertex {len(rows)}\n{properties}end_header\n"
    return header.encode() + lead + b"".join(struct.pack(order + kinds, *row) for row in rows)


def pcd(rows: tuple[str, ...], header: str = "", fields: str = "x y z", data: str = "DATA ascii") -> bytes:
    """Ascii PCD of two points; `header` takes the place of the lines between FIELDS and DATA."""
    n = len(fields.split())
    usual = f"SIZE{' 4' * n}\nTYPE{' F' * n}\nCOUNT{' 1' * n}\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\n"
    return f"VERSION .7\nFIELDS {fields}\n{header or usual}{data}\n".encode() + "\n".join(rows).encode() + b"\n"


A, B = "0.5 -1.25 2", "7 7.5 9"
FACE = "element face 1\nproperty list uchar int vertex_indices\n"
LISTS = [(2, 1, 2, *P), (2, 3, 4, *Q)]
FACES = FACE.replace("1", "2")
FRAME = "element phoxi_frame_params 1\nproperty uint32 frame_width\nproperty uint32 frame_height\n"
NORMALS = XYZ.replace("float ", "float n")
WITH_FIELD = "SIZE 4 4 4 4\nTYPE F F F {}\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n"

PLY = {
    # lists
    "descriptor of each vertex, CloudCompare#1455": (
        ply(XYZ + "property list uint float64 descriptor\n", (f"{A} 2 1.5 2.5", f"{B} 2 3.5 4.5")),
        {"descriptor": np.array([[1.5, 2.5], [3.5, 4.5]])},
    ),
    "views of each vertex, CloudCompare#760": (
        ply(
            XYZ + "property float intensity\nproperty uchar type\nproperty list uchar int view\n",
            (f"{A} 0.5 7 3 0 4 9", f"{B} 1 8 0"),
            between="element face 0\nproperty list ushort int vertex_indices\n",
        ),
        {"intensity": np.float32([0.5, 1.0]), "type": np.uint8([7, 8])},  # views that differ in number are left out
    ),
    "views of each vertex, binary": (
        binary(XYZ + "property list uchar int view\n", "fffB", [(*P, 0), (*Q, 1)]) + bytes(4),
        {},
    ),
    "a list before the coordinates, binary": (
        binary("property list uchar ushort test_values\n" + XYZ, "BHHfff", [(2, 1, 2, *P), (2, 3, 4, *Q)]),
        {"test_values": np.uint16([[1, 2], [3, 4]])},
    ),
    "faces before vertices": (ply(XYZ, ("3 0 1 1", A, B), before=FACE), {}),
    "faces of several sizes before vertices, binary": (
        binary(
            XYZ,
            "fff",
            [P, Q],
            FACE.replace("1\n", "2\n", 1),
            struct.pack("<B3iB4i", 3, 0, 1, 1, 4, 0, 1, 1, 0),
        ),
        {},
    ),
    "faces before vertices, big endian": (
        binary(XYZ, "fff", [P, Q], FACE, struct.pack(">B3i", 3, 0, 1, 1), order=">"),
        {},
    ),
    "triangle strips before vertices, scans of Stanford": (
        ply(XYZ, ("5 0 1 1 0 -1", A, B), before="element tristrips 1\nproperty list int int vertex_indices\n"),
        {},
    ),
    "lengths of 32 bits, PoissonRecon#221": (
        ply(XYZ, (A, B, "3 0 1 1"), between=FACE.replace("uchar", "int")),
        {},
    ),
    "frame of a scanner behind the vertices, Photoneo": (
        ply(
            XYZ,
            (A, B, "2064 1544"),
            between=FRAME,
        ),
        {},
    ),
    # colours
    "diffuse colours and a class, OpenSfM": (
        ply(
            XYZ + RGB.replace("uchar ", "uchar diffuse_") + "property uchar class\n",
            (f"{A} 255 128 0 2", f"{B} 1 2 3 6"),
        ),
        {"colors": COLORS, "class": np.uint8([2, 6])},
    ),
    "r g b, MeshLab#186": (
        ply(XYZ + "property uchar r\nproperty uchar g\nproperty uchar b\n", (f"{A} 255 128 0", f"{B} 1 2 3")),
        {"colors": COLORS},
    ),
    "capital letters": (
        ply(
            (XYZ + RGB).replace("x\n", "X\n").replace("red", "Red").replace("green", "GREEN"),
            (f"{A} 255 128 0", f"{B} 1 2 3"),
        ),
        {"colors": COLORS},
    ),
    "green and blue before red, Open3D#5994": (
        ply(XYZ + "property uchar green\nproperty uchar blue\nproperty uchar red\n", (f"{A} 128 0 255", f"{B} 2 3 1")),
        {"colors": COLORS},
    ),
    "alpha, MeshLab": (
        ply(
            XYZ + RGB + "property uchar alpha\n",
            (f"{A} 255 128 0 255", f"{B} 1 2 3 9"),
            before="comment VCGLIB generated\n",
        ),
        {"colors": COLORS, "alpha": np.uint8([255, 9])},
    ),
    "colours as floats, assimp#1167": (
        ply(XYZ + RGB.replace("uchar", "float"), (f"{A} 1 0.50196 0", f"{B} 0.00392 0.00784 0.01176")),
        {"colors": COLORS},
    ),
    "colours of 16 bits": (
        ply(XYZ + RGB.replace("uchar", "ushort"), (f"{A} 65535 32896 0", f"{B} 257 514 771")),
        {"colors": COLORS},
    ),
    "colours in a line of their own, RealSense#14706": (
        ply(XYZ.replace("float", "float32") + RGB, (f"{A} ", "255 128 0 ", f"{B} ", "1 2 3 ")),
        {"colors": COLORS},
    ),
    "COLMAP, dense": (
        binary(
            XYZ + NORMALS + RGB,
            "6f3B",
            [(*P, 0, 0, 1, *COLORS[0]), (*Q, 0, 1, 0, *COLORS[1])],
        ),
        {"colors": COLORS, "normals": [[0, 0, 1], [0, 1, 0]]},
    ),
    "no colours but harmonics, Gaussian splats": (
        binary(
            XYZ + "property float f_dc_0\nproperty float opacity\n",
            "5f",
            [(*P, 1.5, -2.0), (*Q, 0.5, 3.0)],
        ),
        {"f_dc_0": np.float32([1.5, 0.5]), "opacity": np.float32([-2.0, 3.0])},
    ),
    "confidence and value, MVE": (
        ply(XYZ + "property float confidence\nproperty float value\n", (f"{A} 1 0.25", f"{B} 2 0.5")),
        {"confidence": np.float32([1, 2]), "value": np.float32([0.25, 0.5])},
    ),
    # scalars and coordinates
    "scalar fields and big offsets, CloudCompare": (
        ply(
            XYZ.replace("float", "double") + "property float scalar_Intensity\nproperty float scalar_GpsTime\n",
            (f"{FAR[0]} 0.5 3", f"{FAR[1]} 1 4"),
            before="comment Created by CloudCompare v2.13\nobj_info Generated by CloudCompare!\n",
        ),
        {"points": UTM, "scalar_Intensity": np.float32([0.5, 1]), "scalar_GpsTime": np.float32([3, 4])},
    ),
    "names of types with sizes": (
        ply("property float64 x\nproperty float32 y\nproperty int16 z\nproperty uint8 ring\n", (f"{A} 3", f"{B} 4")),
        {"ring": np.uint8([3, 4])},
    ),
    "whole numbers of 64 bits": (
        ply(XYZ + "property int64 stamp\n", (f"{A} 1700000000000000001", f"{B} -1")),
        {"stamp": np.int64([1_700_000_000_000_000_001, -1])},
    ),
    "element vertices": (ply(XYZ, (A, B), name="vertices"), {}),
    "element point": (ply(XYZ, (A, B), name="point"), {}),
    # text
    "comments in any encoding": (
        ply(XYZ, (A, B), before="comment Größe\n").replace(b"comment ", b"comment \xe5\x81\xff\x85 "),
        {},
    ),
    "lines of Windows": (ply(XYZ, (A, B)).replace(b"\n", b"\r\n"), {}),
    "header of Windows before binary data": (
        binary(XYZ, "fff", [P, Q], "comment a\n").replace(b"\n", b"\r\n", 8),
        {},
    ),
    "lines of old Macintosh": (ply(XYZ, (A, B)).replace(b"\n", b"\r"), {}),
    "byte order mark of an editor": (b"\xef\xbb\xbf" + ply(XYZ, (A, B)), {}),
    "blanks at the ends of lines": (ply(XYZ, (A, B)).replace(b"\n", b" \t\n"), {}),
    "NaN of Windows": (
        ply(XYZ + "property float quality\n", (f"{A} -1.#IND00", f"{B} 1.#QNAN")),
        {"quality": np.float32([np.nan, np.nan])},
    ),
}

PCD = {
    "version .5 with COLUMNS": (
        f"# .PCD v.5 - Point Cloud Data file format\nCOLUMNS x y z\nPOINTS 2\nDATA ascii\n{A}\n{B}\n".encode(),
        {},
    ),
    "without SIZE, TYPE and COUNT": (pcd((A, B), "WIDTH 2\nHEIGHT 1\nPOINTS 2\n"), {}),
    "without HEIGHT": (pcd((A, B), "SIZE 4 4 4\nTYPE F F F\nWIDTH 2\n"), {}),
    "without WIDTH and HEIGHT": (pcd((A, B), "SIZE 4 4 4\nTYPE F F F\nPOINTS 2\n"), {}),
    "without POINTS and VIEWPOINT": (pcd((A, B), "SIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\n"), {}),
    "intensity, Open3D#7332": (
        pcd((f"{A} 17", f"{B} 0.5"), fields="x y z intensity"),
        {"intensity": np.float32([17, 0.5])},
    ),
    "colours as a float": (
        pcd((f"{A} {PACKED[0]}", f"{B} {PACKED[1]}"), fields="x y z rgb"),
        {"colors": COLORS},
    ),
    "colours as U": (pcd((f"{A} 16744448", f"{B} 66051"), WITH_FIELD.format("U"), "x y z rgb"), {"colors": COLORS}),
    "colours as I, with a sign": (
        pcd((f"{A} -32768", f"{B} 66051"), WITH_FIELD.format("I"), "x y z rgba"),
        {"colors": COLORS},
    ),
    "padding, perception_pcl": (
        b"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z _ intensity _\nSIZE 4 4 4 1 4 1\n"
        b"TYPE F F F U F U\nCOUNT 1 1 1 4 1 12\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA binary\n"
        + b"".join(struct.pack("<fff4xf12x", *p, 3.0) for p in POINTS),
        {"intensity": np.float32([3, 3])},
    ),
    "histograms of each point": (
        pcd((f"{A} 1 2 3", f"{B} 4 5 6"), "COUNT 1 1 1 3\nWIDTH 2\n", "x y z fpfh"),
        {"fpfh": np.float32([[1, 2, 3], [4, 5, 6]])},
    ),
    "doubles with big offsets": (
        pcd(FAR, "SIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n"),
        {"points": UTM},
    ),
    "viewpoints of each point": (
        pcd((f"{A} 1 2 3", f"{B} 4 5 6"), fields="x y z vp_x vp_y vp_z"),
        {"viewpoint": [[1, 2, 3], [4, 5, 6]]},
    ),
    "lines of Windows": (pcd((A, B)).replace(b"\n", b"\r\n"), {}),
    "capital letters and small": (pcd((A, B), data="data ASCII").replace(b"FIELDS", b"Fields"), {}),
    "comments behind and between": (
        pcd((A, B)).replace(b"WIDTH 2", b"# size\nWIDTH 2 # of the cloud").replace(b"x y z", b"x y z # metres"),
        {},
    ),
    "names of NaN": (
        pcd((f"{A} nan", f"{B} -NaN(ind)"), fields="x y z curvature"),
        {"curvature": np.float32([np.nan, np.nan])},
    ),
    "the word DATA among binary numbers, PCL#6122": (
        b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nDATA binary\n" + b"DATA" + struct.pack("<5f", *np.arange(5.0)),
        {"points": [[13.265933990478516, 0, 1], [2, 3, 4]]},
    ),
}


@pytest.mark.parametrize(
    ("suffix", "name"), [(suffix, name) for suffix, made in (("ply", PLY), ("pcd", PCD)) for name in made]
)
def test_files_of_other_programs_are_read_with_all_their_columns(suffix, name):
    content, expected = {"ply": PLY, "pcd": PCD}[suffix][name]
    cloud = decode_cloud(content, f"a.{suffix}")
    own = {"points": POINTS, "colors": None, "normals": None, "labels": None, "viewpoint": None}
    for key in own:
        wanted = expected.get(key, own[key])
        if wanted is None:
            assert getattr(cloud, key) is None
        else:
            assert np.array_equal(getattr(cloud, key), wanted), key
    columns = {key: values for key, values in expected.items() if key not in own}
    assert list(cloud.columns) == list(columns)
    for key, values in columns.items():
        assert cloud.columns[key].dtype == values.dtype
        assert np.array_equal(cloud.columns[key], values, equal_nan=True)


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
@pytest.mark.parametrize("row", ["0,5 -1,25 2", "0.5,-1.25,2", "0.5, -1.25, 2"])
def test_commas_are_named(suffix, row):
    """MeshLab writes decimal commas where the system does (PCL#1069)."""
    content = ply(XYZ, (row, B)) if suffix == "ply" else pcd((row, B))
    with pytest.raises(pcgraph.CloudReadError, match="it has commas: write decimal points, and blanks between"):
        decode_cloud(content, f"a.{suffix}")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"3 0 1 1", b"3 0 1", "the PLY header promises|expected"),
        (b"2 1.5 2.5", b"2 1.5", "expected 6 numbers in line 9, as its lists tell, got 5"),
        (b"2 1.5 2.5", b"-1 1.5 2.5", "expected the length of a list in line 9, got -1"),
        (b"2 1.5 2.5", b"1.5 1.5 2.5", "expected the length of a list in line 9, got 1.5"),
        (b"2 1.5 2.5", b"", "expected the length of a list in line 9, got nothing"),
        (b"2 1.5 2.5", b"2 1.5 two", "numbers only in the ascii data, got in line 9: .*'two'"),
        (b"2 1.5 2.5", b"2 1.5 2_5", "numbers only in the ascii data, got in line 9: '2_5'"),
    ],
)
def test_damaged_lists_are_refused(old, new, message):
    content = PLY["descriptor of each vertex, CloudCompare#1455"][0]
    if old not in content:
        content = binary(XYZ, "fff", [P, Q], FACE, b"\x03" + bytes(9))
    with pytest.raises(pcgraph.CloudReadError, match=message):
        decode_cloud(content.replace(old, new), "a.ply")
