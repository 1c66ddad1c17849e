# SPDX-License-Identifier: Apache-2.0
"""What counts as a cloud: arrays of any columns, messages of robots, clouds of other libraries; and NumPy's files."""

from __future__ import annotations

import io
import struct
import zipfile
from array import array
from types import SimpleNamespace

import numpy as np
import pytest

import pcgraph
from pcgraph.io import decode_cloud, encode_cloud, npz

POINTS = np.random.default_rng(0).random((12, 3)).astype(np.float32)
COLORS = np.random.default_rng(1).integers(0, 256, (12, 3), np.uint8)
RING = np.arange(12, dtype=np.uint16)


def rows(order: str = "<", shape=(12,)) -> np.ndarray:
    """A structured array as of `point_cloud2.read_points`, with gaps and a packed colour."""
    layout = {"names": ["x", "y", "z", "rgb", "ring", "t"], "offsets": [0, 4, 8, 16, 20, 24], "itemsize": 32}
    table = np.zeros(
        12, np.dtype(layout | {"formats": [order + kind for kind in ("f4", "f4", "f4", "f4", "u2", "f8")]})
    )
    for axis, values in zip("xyz", POINTS.T, strict=True):
        table[axis] = values
    table["rgb"] = (COLORS.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)).view(np.float32)
    table["ring"], table["t"] = RING, RING * 1e-9 + 1.7e9
    return table.reshape(shape)


def check_rows(cloud: pcgraph.Cloud, shape=(12,)) -> None:
    assert np.array_equal(cloud.points, POINTS.reshape(*shape, 3))
    assert np.array_equal(cloud.colors, COLORS.reshape(*shape, 3))
    assert list(cloud.columns) == ["ring", "t"]
    assert cloud.columns["ring"].dtype == np.uint16
    assert np.array_equal(cloud.columns["ring"], RING.reshape(shape))
    assert np.array_equal(cloud.columns["t"], (RING * 1e-9 + 1.7e9).reshape(shape))


# --- arrays -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(12,), (3, 4)])
@pytest.mark.parametrize("order", "<>")
def test_arrays_with_fields(order, shape):
    check_rows(pcgraph.as_cloud(rows(order, shape)), shape)
    check_rows(pcgraph.as_cloud(rows(order, shape).view(np.recarray)), shape)


def test_masked_numbers_of_arrays_with_fields_are_nan():
    table = np.ma.array(rows())
    table["x"][3] = table["ring"][4] = np.ma.masked
    cloud = pcgraph.as_cloud(table)
    assert np.isnan(cloud.points[3, 0])
    assert np.isnan(cloud.columns["ring"]).nonzero()[0].tolist() == [4]


def test_further_columns_of_an_array_are_columns():
    table = np.column_stack((POINTS, RING, RING * 2)).astype(np.float32)
    for given, shape in ((table, (12,)), (table.tolist(), (12,)), (table.reshape(3, 4, 5), (3, 4))):
        cloud = pcgraph.as_cloud(given)
        assert np.array_equal(cloud.points, POINTS.reshape(*shape, 3))
        assert list(cloud.columns) == ["column_3", "column_4"]
        assert np.array_equal(cloud.columns["column_4"], 2 * RING.reshape(shape))
    cloud = pcgraph.as_cloud(POINTS)
    assert np.shares_memory(cloud.points, POINTS)
    assert pcgraph.as_cloud(cloud) is cloud


def test_segment_and_update_take_any_source(boxes):
    points, _, result = boxes
    table = np.column_stack((points, np.arange(len(points))))
    found = pcgraph.segment(table, viewpoint=result.viewpoint)
    assert np.array_equal(found.labels, result.labels)
    assert np.array_equal(pcgraph.update(result, table).labels, pcgraph.update(result, points).labels)
    assert pcgraph.segment(table, features="column_3").graph.node_features.features.shape[1] == 1


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.zeros((4, 2)), r"points of shape \(n, 3\) or \(h, w, 3\), or with further columns, .* got \(4, 2\)"),
        (np.zeros((3, 100)), r"expected a row for each point, got \(3, 100\): transpose the array"),
        (np.zeros((2, 2, 2, 3)), r"got \(2, 2, 2, 3\)"),
        (np.zeros(3, [("x", "f4"), ("y", "f4")]), "expected the fields x, y and z, but z is missing; found: x, y"),
        (np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("name", "U3")]), "fields of numbers, got <U3 .* 'name'"),
        (object(), "expected points as an array .* or what pcgraph.as_cloud takes, got object"),
        (SimpleNamespace(points=POINTS), r"got SimpleNamespace; pass its \.points \(and \.colors\)"),
    ],
)
def test_what_is_no_cloud_is_refused_in_a_sentence(given, message):
    with pytest.raises(ValueError, match=message):
        pcgraph.as_cloud(given)


# --- messages of robots -----------------------------------------------------------------------------------------------


def message(shape=(1, 12), order: str = "<", row_gap: int = 0, **changed) -> SimpleNamespace:
    """A sensor_msgs/PointCloud2."""
    table = rows(order)
    kinds = {"f4": 7, "u2": 4, "f8": 8}
    fields = [
        SimpleNamespace(name=name, offset=offset, datatype=kinds[kind.str[1:]], count=1)
        for name, (kind, offset) in table.dtype.fields.items()
    ]
    lines = table.reshape(shape).view(np.uint8).reshape(shape[0], -1)
    data = np.pad(lines, ((0, 0), (0, row_gap))).tobytes()
    own = {
        "fields": fields,
        "height": shape[0],
        "width": shape[1],
        "point_step": 32,
        "row_step": shape[1] * 32 + row_gap,
    }
    return SimpleNamespace(**(own | {"is_bigendian": order == ">", "data": data} | changed))


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(
    "kind", [bytes, bytearray, lambda data: array("B", data), list, lambda d: np.frombuffer(d, "u1")]
)
def test_messages_of_robots(kind, order):
    check_rows(pcgraph.as_cloud(message(order=order, data=kind(message(order=order).data))))
    check_rows(pcgraph.as_cloud(message((3, 4), order, row_gap=7)), (3, 4))
    assert pcgraph.as_cloud(message(width=0, data=kind(b""), row_step=0)).points.shape == (0, 3)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"data": b"short"}, "expected 1 rows of 12 points of 32 bytes, got 5 bytes"),
        ({"row_step": 5}, "in rows of 5"),
        ({"height": -1, "width": -12}, "expected -1 rows of -12 points"),
        ({"point_step": 20}, "fields within a point_step of 20 bytes"),
        ({"fields": [SimpleNamespace(name="x", offset=0, datatype=9, count=1)]}, "datatypes 1 to 8, got x"),
        ({"fields": [SimpleNamespace(name="x", offset=0, datatype=7, count=1)] * 2}, "distinct names .* got x, x"),
        ({"fields": [SimpleNamespace(name="x", offset=0, datatype=7, count=1)]}, "but y, z is missing"),
    ],
)
def test_messages_that_lie_are_refused(changed, told):
    with pytest.raises(ValueError, match=told):
        pcgraph.as_cloud(message(**changed))


# --- other libraries --------------------------------------------------------------------------------------------------


def test_clouds_of_open3d():
    o3d = pytest.importorskip("open3d")
    legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    bare = pcgraph.as_cloud(legacy)
    assert bare.colors is bare.normals is None
    legacy.colors, legacy.normals = o3d.utility.Vector3dVector(COLORS / 255), o3d.utility.Vector3dVector(POINTS)
    tensor = o3d.t.geometry.PointCloud(o3d.core.Tensor(POINTS))
    tensor.point["colors"], tensor.point["normals"] = o3d.core.Tensor(COLORS), o3d.core.Tensor(POINTS)
    tensor.point["ring"] = o3d.core.Tensor(RING[:, None])
    for cloud in (pcgraph.as_cloud(legacy), pcgraph.as_cloud(tensor)):
        assert np.array_equal(cloud.points, POINTS)
        assert np.array_equal(cloud.colors, COLORS)
        assert np.array_equal(cloud.normals, POINTS)
    assert np.array_equal(pcgraph.as_cloud(tensor).columns["ring"], RING)
    with pytest.raises(ValueError, match="Open3D cloud with positions, got an empty one"):
        pcgraph.as_cloud(o3d.t.geometry.PointCloud())


def test_attributes_of_open3d_that_are_matrices():
    o3d = pytest.importorskip("open3d")
    matrices = np.arange(108.0).reshape(12, 3, 3)
    legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    legacy.covariances = o3d.utility.Matrix3dVector(matrices)
    assert np.array_equal(pcgraph.as_cloud(legacy).columns["covariances"], matrices.reshape(12, 9))
    tensor = o3d.t.geometry.PointCloud(o3d.core.Tensor(POINTS))
    tensor.point["own"] = o3d.core.Tensor(matrices)
    assert np.array_equal(pcgraph.as_cloud(tensor).columns["own"], matrices.reshape(12, 9))
    tensor.point["x"] = o3d.core.Tensor(RING[:, None])
    with pytest.raises(ValueError, match="attributes of other names than x"):
        pcgraph.as_cloud(tensor)


class Frame:
    """A DataFrame as pandas and Polars have it."""

    def __init__(self, **columns: np.ndarray) -> None:
        self.table = columns
        self.columns, self.dtypes = list(columns), [values.dtype for values in columns.values()]

    def __len__(self) -> int:
        return len(self.table["x"])

    def __getitem__(self, name: str) -> np.ndarray:
        return self.table[name]

    def to_numpy(self) -> np.ndarray:
        return np.column_stack(list(self.table.values()))


def test_tables_with_named_columns():
    x, y, z = POINTS.T
    check = pcgraph.as_cloud(Frame(ring=RING, z=z, x=x, y=y))
    assert np.array_equal(check.points, POINTS)
    assert check.columns["ring"].dtype == np.uint16
    with pytest.raises(ValueError, match="columns of numbers under distinct names, got <U1 in 'name'"):
        pcgraph.as_cloud(Frame(x=x, y=y, z=z, name=np.full(12, "a")))


def test_what_numpy_cannot_take_is_refused_in_a_sentence():
    class OnDevice:
        def __array__(self, dtype=None, copy=None) -> np.ndarray:
            raise TypeError("can't convert cuda:0 device type tensor to numpy")

    with pytest.raises(ValueError, match="points that NumPy can take, but OnDevice refuses: TypeError: can't convert"):
        pcgraph.as_cloud(OnDevice())


@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "a.csv", "a.npy"])
def test_columns_that_would_become_colors_of_8_bits_are_refused(name):
    shades = dict.fromkeys("rgb", np.linspace(0.0, 1.0, 12))
    with pytest.raises(pcgraph.CloudWriteError, match="got r, g, b; rename those columns"):
        encode_cloud(pcgraph.Cloud(POINTS, columns=shades), name)
    assert decode_cloud(encode_cloud(pcgraph.Cloud(POINTS, COLORS, columns=shades), name), name).columns["g"][5] > 0


def test_clouds_and_meshes_of_trimesh():
    trimesh = pytest.importorskip("trimesh")
    cloud = pcgraph.as_cloud(trimesh.PointCloud(POINTS, colors=COLORS))
    assert np.array_equal(cloud.points, POINTS)
    assert np.array_equal(cloud.colors, COLORS)
    assert pcgraph.as_cloud(trimesh.PointCloud(POINTS)).colors is None
    box = trimesh.creation.box()
    cloud = pcgraph.as_cloud(box)
    assert np.array_equal(cloud.points, box.vertices)
    assert cloud.normals.shape == (8, 3)
    assert cloud.colors is None


# --- NumPy's files ----------------------------------------------------------------------------------------------------


def npz_of(**arrays) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def test_archives_of_any_writer():
    shades, wide = (COLORS / 255).astype(np.float32), np.arange(12) + 2**40
    content = npz_of(points=POINTS, colors=shades, labels=RING, stamp=wide, other=np.zeros(5), names=np.full(12, "a"))
    with pytest.warns(UserWarning, match="left out what holds no numbers: the array 'names'"):
        cloud = decode_cloud(content, "a.npz")
    assert np.array_equal(cloud.points, POINTS)
    assert np.array_equal(cloud.colors, COLORS)
    assert cloud.labels.tolist() == RING.tolist()
    assert list(cloud.columns) == ["stamp"]
    none = decode_cloud(npz_of(points=POINTS, colors=np.empty((0, 3), np.uint8), labels=wide), "a.npz")
    assert none.colors is none.labels is None
    assert none.columns["labels"].tolist() == wide.tolist()
    matrices = np.arange(108.0).reshape(12, 3, 3)
    cloud = decode_cloud(npz_of(positions=POINTS, covariance=matrices), "a.npz")  # the name is Open3D's
    assert np.array_equal(cloud.points, POINTS)
    assert np.array_equal(cloud.columns["covariance"], matrices.reshape(12, 9))
    x, y, z = POINTS.T
    apart = decode_cloud(npz_of(x=x, y=y, z=z, intensity=RING, colors=COLORS, labels=RING), "a.npz")
    assert np.array_equal(apart.points, POINTS)
    assert np.array_equal(apart.colors, COLORS)
    assert np.array_equal(apart.labels, RING)
    assert list(apart.columns) == ["intensity"]


def test_the_cloud_of_a_saved_segmentation():
    content = npz_of(**{"cloud/points": POINTS, "cloud/colors": COLORS, "cloud/columns/ring": RING, "labels": RING})
    cloud = decode_cloud(content, "a.npz")
    assert np.array_equal(cloud.points, POINTS)
    assert np.array_equal(cloud.colors, COLORS)
    assert cloud.labels is None
    assert list(cloud.columns) == ["ring"]


def test_arrays_of_any_writer():
    for points in (POINTS, POINTS.reshape(3, 4, 3), np.asfortranarray(POINTS), POINTS.astype(">f8")):
        stream = io.BytesIO()
        np.save(stream, points)
        assert np.array_equal(decode_cloud(stream.getvalue(), "a.npy").points, points)
    stream = io.BytesIO()
    np.save(stream, rows(shape=(3, 4)))
    check_rows(decode_cloud(stream.getvalue(), "a.npy"), (3, 4))
    whole = encode_cloud(pcgraph.Cloud(POINTS), "a.npy")
    assert np.array_equal(np.load(io.BytesIO(whole)), POINTS)  # points alone are a plain array


@pytest.mark.parametrize("suffix", ["npy", "npz", "pcd", "ply"])
def test_viewpoints_are_kept(suffix):
    name, places = f"a.{suffix}", POINTS.astype(np.float64)
    for viewpoint in (places, places[0], None):
        read = decode_cloud(encode_cloud(pcgraph.Cloud(POINTS, viewpoint=viewpoint), name), name)
        if viewpoint is None or (viewpoint.ndim == 1 and suffix in ("npy", "ply")):  # which have no place for it
            assert read.viewpoint is None
        else:
            assert np.array_equal(read.viewpoint, viewpoint)
        assert read.columns == {}


def npy(header: str, data: bytes = b"", version: int = 1) -> bytes:
    return b"\x93NUMPY" + struct.pack("<BBH", version, 0, len(header)) + header.encode() + data


def deflated(content: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", content)
    return stream.getvalue()


HEADER = "{'descr': '<f4', 'fortran_order': False, 'shape': (%s, 3)}"
NO_NUMBERS = "of a floating-point or integer dtype, got|expected the array 'points' as numbers, got"
LIES = {
    "no array": (b"hello", "its first bytes"),
    "too long": (npy(HEADER % 10**12, bytes(12)), "promises 12000000000000 bytes, but only"),
    "longer than any": (npy(HEADER % 10**30, bytes(12)), "promises"),
    "negative": (npy(HEADER % -1, bytes(12)), "expected the shape of an array"),
    "objects": (npy(HEADER.replace("<f4", "O") % 1, bytes(24)), "never unpickled"),
    "a type of nothing": (npy(HEADER.replace("'<f4'", "()") % 1, bytes(12)), "cannot be read"),
    "complex numbers": (
        npy(HEADER.replace("<f4", "<c8") % 1, bytes(24)),
        NO_NUMBERS,
    ),
    "bytes of no type": (
        npy(HEADER.replace("<f4", "V4") % 1, bytes(12)),
        NO_NUMBERS,
    ),
    "code": (npy("__import__('os')"), "cannot be read"),
    "nested": (npy("(" * 9000), "cannot be read"),
    "no header": (npy("{}"), "expected descr"),
    "a header too long": (npy(" " * 65535)[:8] + b"\xff\xff" + b" " * 10, "cannot be read"),
}


@pytest.mark.parametrize("name", LIES)
def test_arrays_that_lie_are_refused(name):
    content, told = LIES[name]
    for file, place in ((content, "a.npy"), (deflated(content), "a.npz")):
        with pytest.raises(
            pcgraph.CloudReadError, match=told if place == "a.npy" or "12 can" not in told else "promises"
        ):
            decode_cloud(file, place)


def test_archives_that_lie_are_refused(monkeypatch):
    whole = npz_of(points=POINTS)
    for content, told in (
        (b"PK", "archive cannot be read: File is not a zip file"),
        (whole[:-30], "archive cannot be read"),
        (npz_of(labels=RING), "expected an array 'points', or 'x', 'y' and 'z', found: labels"),
        (npz_of(points=np.zeros((4, 2))), r"archive cannot be read: expected points of shape"),
        (npz_of(points=POINTS, colors=COLORS[:5]), r"expected colors of shape \(12, 3\), got \(5, 3\)"),
        (npz_of(points=POINTS, labels=RING[:5]), r"expected labels of shape \(12,\), got \(5,\)"),
        (npz_of(points=POINTS, viewpoint=RING[:4]), r"expected viewpoint of shape \(3,\) or \(12, 3\), got \(4,\)"),
        (npz_of(x=1.0, y=1.0, z=1.0), r"expected x, y and z of shape \(n,\) or \(h, w\), got \(\)"),
        (npz_of(x=RING, y=RING, z=RING.astype(str)), "expected the array 'z' as numbers, got <U5"),
    ):
        with pytest.raises(pcgraph.CloudReadError, match=told):
            decode_cloud(content, "a.npz")
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 1
    with pytest.raises(pcgraph.CloudReadError, match="archive cannot be read"):
        decode_cloud(bytes(damaged), "a.npz")
    monkeypatch.setattr(npz, "MAX_BYTES", 4 * 12 * 3 - 1)
    with pytest.raises(pcgraph.CloudReadError, match="at most 143 bytes in all, decompressed"):
        decode_cloud(whole, "a.npz")


def test_some_points_keep_all_that_is_theirs():
    image = np.arange(18.0).reshape(2, 3, 3)
    cloud = pcgraph.Cloud(
        image, image.astype(np.uint8), -image, np.arange(6, dtype=np.int32).reshape(2, 3), image + 1.0, {"ring": image}
    )
    chosen = np.array([[True, False, False], [False, True, True]])
    part = cloud.select(chosen)
    for name in ("points", "colors", "normals", "labels", "viewpoint"):
        assert np.array_equal(getattr(part, name), getattr(cloud, name)[chosen])
    assert np.array_equal(part.columns["ring"], image[chosen])
    for wrong in ([0, 4], chosen[0], chosen.astype(int)):
        with pytest.raises(ValueError, match="expected one truth value for each point"):
            cloud.select(wrong)
