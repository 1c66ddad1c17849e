# SPDX-License-Identifier: Apache-2.0
"""E57: what others write is read, what is written comes back, and broken files are refused."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pye57
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from laser_files import TYPES, as_cloudcompare_reads, assert_same, clouds, mixed_cloud
from pye57 import libe57

import pcgraph
from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.io.e57 import encode_e57, read_e57
from pcgraph.io.format import CloudFile

XYZ = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [-7.0, 8.0, 0.5]])
CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
TURN = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
"""Quaternion of a quarter turn about z."""


def read(content: bytes) -> Cloud:
    return read_e57(CloudFile(content))


class Writer:
    """An E57 file that is made by hand, to have what other programs write."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.image = libe57.ImageFile(str(path), "w")
        self.image.extensionsAdd("", libe57.E57_V1_0_URI)
        root = self.image.root()
        root.set("formatName", libe57.StringNode(self.image, "ASTM E57 3D Imaging Data File"))
        root.set("guid", libe57.StringNode(self.image, "{1}"))
        root.set("versionMajor", libe57.IntegerNode(self.image, 1))
        root.set("versionMinor", libe57.IntegerNode(self.image, 0))
        self.scans = libe57.VectorNode(self.image, True)
        root.set("data3D", self.scans)

    def double(self) -> libe57.FloatNode:
        return libe57.FloatNode(self.image)

    def integer(self, low: int, high: int) -> libe57.IntegerNode:
        return libe57.IntegerNode(self.image, low, low, high)

    def structure(self, **children: object) -> libe57.StructureNode:
        node = libe57.StructureNode(self.image)
        for name, child in children.items():
            node.set(name, libe57.FloatNode(self.image, child) if isinstance(child, float) else child)
        return node

    def pose(self, place: tuple[float, ...], turn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)) -> libe57.StructureNode:
        rotation = self.structure(**dict(zip("wxyz", map(float, turn), strict=True)))
        return self.structure(rotation=rotation, translation=self.structure(**dict(zip("xyz", place, strict=True))))

    def add(self, fields: dict[str, tuple[object, np.ndarray]], **children: object) -> None:
        """Add a scan of fields, each a node and its numbers, and of other children."""
        scan = self.structure(guid=libe57.StringNode(self.image, "{2}"), **children)
        prototype, buffers, arrays = libe57.StructureNode(self.image), libe57.VectorSourceDestBuffer(), []
        for name, (node, values) in fields.items():
            prototype.set(name, node)
            arrays.append(np.empty(len(values), np.float64 if values.dtype.kind == "f" else np.longlong))
            arrays[-1][:] = values
            buffers.append(libe57.SourceDestBuffer(self.image, name, arrays[-1], len(values), True, True))
        points = libe57.CompressedVectorNode(self.image, prototype, libe57.VectorNode(self.image, True))
        scan.set("points", points)
        self.scans.append(scan)
        writer = points.writer(buffers)
        writer.write(len(arrays[0]))
        writer.close()

    def xyz(self, points: np.ndarray = XYZ) -> dict[str, tuple[object, np.ndarray]]:
        return {name: (self.double(), column) for name, column in zip(CARTESIAN, points.T, strict=True)}

    def content(self) -> bytes:
        self.image.close()
        return self.path.read_bytes()


@pytest.fixture
def writer(tmp_path) -> Writer:
    return Writer(tmp_path / "made.e57")


def test_fields_of_the_standard(writer):
    fields = writer.xyz() | {
        "intensity": (writer.integer(0, 2047), np.array([0, 7, 2047])),
        "rowIndex": (writer.integer(0, 70000), np.array([0, 1, 70000])),
        "columnIndex": (writer.integer(0, 200), np.array([5, 5, 5])),
        "timeStamp": (writer.double(), np.array([0.0, 0.25, 0.5])),
        "returnIndex": (writer.integer(-1, 3), np.array([-1, 0, 3])),
    }
    writer.add(fields)
    cloud = read(writer.content())
    assert np.array_equal(cloud.points, XYZ)
    assert (cloud.viewpoint, cloud.colors, cloud.normals, cloud.labels) == (None, None, None, None)
    kinds = {"intensity": "u2", "rowIndex": "u4", "columnIndex": "u1", "timeStamp": "f8", "returnIndex": "i1"}
    assert {name: column.dtype.str[1:] for name, column in cloud.columns.items()} == kinds
    for name in kinds:
        assert np.array_equal(cloud.columns[name], fields[name][1])


def test_the_pose_is_applied_and_its_place_is_the_viewpoint(writer):
    writer.image.extensionsAdd("nor", "http://www.libe57.org/E57_NOR_surface_normals.txt")
    normals = {f"nor:normal{axis}": (writer.double(), column) for axis, column in zip("XYZ", np.eye(3), strict=True)}
    writer.add(writer.xyz() | normals, pose=writer.pose((10.0, 20.0, 30.0), TURN))
    content = writer.content()
    cloud = read(content)
    turned = np.stack([-XYZ[:, 1], XYZ[:, 0], XYZ[:, 2]], axis=1)
    assert np.allclose(cloud.points, turned + np.array([10.0, 20.0, 30.0]), rtol=0.0, atol=1e-14)
    assert np.allclose(cloud.normals, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], rtol=0.0, atol=1e-15)
    assert cloud.viewpoint.tolist() == [10.0, 20.0, 30.0]
    with pye57.E57(str(writer.path)) as file:  # pye57's own
        theirs = file.read_scan(0, ignore_missing_fields=True)
    assert np.allclose(cloud.points, np.stack([theirs[name] for name in CARTESIAN], axis=1), rtol=0.0, atol=1e-14)


def test_several_scans(writer):
    wide = writer.integer(0, 65535)
    colors = {f"color{name}": (writer.integer(0, 255), np.array([255, 128, 0])) for name in ("Red", "Green", "Blue")}
    writer.add(writer.xyz() | colors, pose=writer.pose((1.0, 0.0, 0.0)))
    writer.add(writer.xyz(XYZ[:2]) | {"intensity": (wide, np.array([4, 5]))}, pose=writer.pose((0.0, 2.0, 0.0)))
    writer.add(writer.xyz(XYZ[:1]) | {"timeStamp": (writer.double(), np.array([9.0]))}, pose=writer.pose((0.0,) * 3))
    cloud = read(writer.content())
    expected = np.concatenate([XYZ + np.array([1.0, 0.0, 0.0]), XYZ[:2] + np.array([0.0, 2.0, 0.0]), XYZ[:1]])
    assert np.array_equal(cloud.points, expected)
    assert cloud.columns["scan"].dtype == np.uint16
    assert cloud.columns["scan"].tolist() == [0, 0, 0, 1, 1, 2]
    assert cloud.viewpoint.tolist() == [[1, 0, 0]] * 3 + [[0, 2, 0]] * 2 + [[0, 0, 0]]
    assert cloud.colors[:, 0].tolist() == [255, 128, 0, 0, 0, 0]
    assert cloud.columns["intensity"].tolist() == [0, 0, 0, 4, 5, 0]
    assert cloud.columns["intensity"].dtype == np.uint16
    assert np.array_equal(cloud.columns["timeStamp"], [np.nan] * 5 + [9.0], equal_nan=True)


def test_scans_without_a_pose_have_no_viewpoint(writer):
    writer.add(writer.xyz(), pose=writer.pose((1.0, 0.0, 0.0)))
    writer.add(writer.xyz())
    assert read(writer.content()).viewpoint is None


def test_spherical_coordinates_and_invalid_points(writer):
    ranges, azimuth, elevation = np.array([2.0, 3.0, 5.0]), np.array([0.0, np.pi / 2, 1.0]), np.array([0.0, 0.5, -1.0])
    fields = {
        "sphericalRange": (writer.double(), ranges),
        "sphericalAzimuth": (writer.double(), azimuth),
        "sphericalElevation": (writer.double(), elevation),
        "sphericalInvalidState": (writer.integer(0, 2), np.array([0, 0, 2])),
        "intensity": (writer.double(), np.array([0.5, 0.25, 0.0])),
    }
    writer.add(fields)
    cloud = read(writer.content())
    expected = [[2.0, 0.0, 0.0], [0.0, 3.0 * np.cos(0.5), 3.0 * np.sin(0.5)]]
    assert np.allclose(cloud.points, expected, rtol=0.0, atol=1e-15)
    assert {name: column.tolist() for name, column in cloud.columns.items()} == {"intensity": [0.5, 0.25]}


def test_cartesian_points_with_invalid_ones_among_them(writer):
    writer.add(writer.xyz() | {"cartesianInvalidState": (writer.integer(0, 2), np.array([1, 0, 2]))})
    cloud = read(writer.content())
    assert np.array_equal(cloud.points, XYZ[1:2])
    assert not cloud.columns


def test_scaled_integers(writer):
    fields = {
        name: (libe57.ScaledIntegerNode(writer.image, 0, -(2**20), 2**20, 0.001, 100.0), column)
        for name, column in zip(CARTESIAN, XYZ.T, strict=True)
    }
    writer.add(fields)
    cloud = read(writer.content())
    assert cloud.points.dtype == np.float64
    assert np.allclose(cloud.points, XYZ, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("white", [255, 65535, 1023])
@pytest.mark.parametrize("stated", [False, True])
def test_white_is_the_limit_of_colours(writer, white, stated):
    values = np.array([0, white // 2, white])
    high = 65535 if stated else white
    colors = {f"color{name}": (writer.integer(0, high), values) for name in ("Red", "Green", "Blue")}
    limits = {f"{name}Maximum": libe57.IntegerNode(writer.image, white) for name in colors}
    writer.add(writer.xyz() | colors, **({"colorLimits": writer.structure(**limits)} if stated else {}))
    assert read(writer.content()).colors[:, 2].tolist() == [0, 127, 255]


def test_fields_of_extensions_and_texts(writer):
    writer.image.extensionsAdd("demo", "https://example.org/demo")
    fields = writer.xyz() | {
        "demo:quality": (writer.double(), np.array([1.0, 2.0, 3.0])),
        "demo:intensity": (writer.double(), np.array([4.0, 5.0, 6.0])),
        "intensity": (writer.double(), np.array([7.0, 8.0, 9.0])),
    }
    writer.add(fields, name=libe57.StringNode(writer.image, "Ωμέγα"))
    columns = {name: column.tolist() for name, column in read(writer.content()).columns.items()}
    assert columns == {"quality": [1, 2, 3], "demo:intensity": [4, 5, 6], "intensity": [7, 8, 9]}


# ---- Write and read ------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(clouds(st.integers(-(2**20), 2**20).map(lambda value: value / 64.0), TYPES))
def test_every_column_comes_back(cloud):
    content = encode_e57(cloud, ".e57")
    assert_same(read(content), cloud)  # sums of such coordinates and whole viewpoints are exact
    assert content == encode_e57(cloud, ".e57")


def test_single_precision_stays():
    cloud = Cloud(XYZ.astype(np.float32) / 3.0, viewpoint=np.zeros(3), columns={"intensity": np.float32([0, 0.1, 1])})
    assert_same(read(encode_e57(cloud, ".e57")), cloud)


def test_others_find_columns_in_their_places(tmp_path):
    cloud = mixed_cloud()
    path = tmp_path / "cloud.e57"
    path.write_bytes(encode_e57(cloud, ".e57"))
    with pye57.E57(str(path)) as file:
        scan = file.read_scan_raw(0, ignore_unsupported_fields=True)
        fields = set(file.get_header(0).point_fields)
    assert np.array_equal(np.stack([scan[name] for name in CARTESIAN], axis=1), cloud.points)
    assert np.array_equal(scan["colorGreen"], cloud.colors[:, 1])
    assert np.array_equal(scan["intensity"], cloud.columns["intensity"])
    assert {"nor:normalX", "pcgraph:label", "pcgraph:ring", "pcgraph:descriptor_3"} < fields
    assert_same(pcgraph.read_cloud(path), cloud)


def test_numbers_beyond_the_format():
    big = Cloud(XYZ, columns={"hash": np.array([1, 2, 2**63], np.uint64)})
    with pytest.raises(
        CloudWriteError, match="whole numbers of 63 bits, but the column 'hash' has 9223372036854775808"
    ):
        encode_e57(big, ".e57")


# ---- Files that are not right --------------------------------------------------------------------------------------


def checksum(page: bytes) -> int:
    """CRC-32C of a page, as the standard has it."""
    value = 0xFFFFFFFF
    for byte in page:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
    return value ^ 0xFFFFFFFF


def edited(content: bytes, old: bytes, new: bytes) -> bytes:
    """The file with another text of the same length within one page of its XML, and the right checksum."""
    assert len(old) == len(new)
    assert old in content
    changed = bytearray(content.replace(old, new))
    for start in range(0, len(changed), 1024):
        if changed[start : start + 1020] != content[start : start + 1020]:
            struct.pack_into(">I", changed, start + 1020, checksum(bytes(changed[start : start + 1020])))
    return bytes(changed)


def test_files_that_are_cut_off_or_damaged():
    content = encode_e57(mixed_cloud(), ".e57")
    assert edited(content, b"recordCount", b"recordCount") == content
    for length in (0, 7, 40, 700, len(content) // 2, len(content) - 1):
        with pytest.raises(CloudReadError):
            read(content[:length])
    damaged = bytearray(content)
    damaged[1500] ^= 1
    with pytest.raises(CloudReadError, match="the E57 file is damaged: E57Exception: checksum mismatch"):
        read(bytes(damaged))


def test_more_points_than_there_are(writer):
    writer.add(writer.xyz())
    content = writer.content()
    with pytest.raises(CloudReadError, match="promises 9 points, but 3 follow"):
        read(edited(content, b'recordCount="3"', b'recordCount="9"'))
    many = encode_e57(Cloud(np.zeros((1000, 3))), ".e57")
    with pytest.raises(CloudReadError, match=r"promises 9999 points, but it is only .* bytes long"):
        read(edited(many, b'recordCount="1000"', b'recordCount="9999"'))


def test_pye57_reads_our_files_as_its_own(tmp_path):
    (tmp_path / "a.e57").write_bytes(encode_e57(mixed_cloud(), ".e57"))
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        found = file.read_scan(0, colors=True, intensity=True)
    assert np.array_equal(np.stack([found[name] for name in CARTESIAN], axis=1), mixed_cloud().points)


def test_xml_with_definitions_of_its_own():
    content = encode_e57(mixed_cloud(), ".e57")
    with pytest.raises(CloudReadError, match="without a DOCTYPE"):
        read(edited(content, b"<e57Root type=", b"<!DOCTYPE a []"))


def test_files_without_scans(writer):
    with pytest.raises(CloudReadError, match="with 1 to 65536 scans, got 0"):
        read(writer.content())


def test_scans_without_coordinates(writer):
    writer.add({"intensity": (writer.double(), np.zeros(2))})
    with pytest.raises(CloudReadError, match=r"expected the fields cartesianX, cartesianY, cartesianZ .*got intensity"):
        read(writer.content())


def test_a_library_that_is_missing(monkeypatch):
    content = encode_e57(mixed_cloud(), ".e57")
    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(CloudReadError, match=r"^reading .e57 needs pye57: pip install rangesim\[e57\]$"):
        read(content)
    with pytest.raises(CloudWriteError, match=r"^writing .e57 needs pye57: pip install rangesim\[e57\]$"):
        encode_e57(mixed_cloud(), ".e57")


# ---- Readers of others ---------------------------------------------------------------------------------------------


@pytest.mark.validation
def test_another_library_reads_what_is_written(tmp_path):
    """The package e57 stands on a reader in Rust that shares no code with libE57Format."""
    e57 = pytest.importorskip("e57", reason="e57 is not installed: pip install e57")
    cloud = mixed_cloud(100_000)
    path = tmp_path / "cloud.e57"
    path.write_bytes(encode_e57(cloud, ".e57"))
    found = e57.read_points(str(path))
    assert np.array_equal(found.points, cloud.points)
    assert np.allclose(found.color * 255.0, cloud.colors, atol=1e-4)
    assert np.array_equal(found.intensity[:, 0], cloud.columns["intensity"])


@pytest.mark.validation
def test_cloudcompare_shows_all_columns(tmp_path):
    cloud = mixed_cloud()
    path = tmp_path / "cloud.e57"
    path.write_bytes(encode_e57(cloud, ".e57"))
    table = as_cloudcompare_reads(path)
    assert np.abs(np.stack([table[axis] for axis in "XYZ"], axis=1) - cloud.points).max() <= 1e-3
