# SPDX-License-Identifier: Apache-2.0
"""LAS, LAZ and COPC: what others write is read, what is written comes back, and broken files are refused."""

from __future__ import annotations

import struct
import sys
from io import BytesIO

import laspy
import lazrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from laser_files import as_cloudcompare_reads, assert_same, clouds, mixed_cloud
from laspy.vlrs.vlrlist import VLRList

import pcgraph
from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.io import decode_cloud, encode_cloud
from pcgraph.io.las import encode_las, read_las

WHITE = {"red": 65535, "green": 65535, "blue": 65535}
POINT_COUNT_AT = 247
"""Place of the count of points in a header of LAS 1.4."""
COUNT_OF_RECORDS_AT = 100


def random_record(header: laspy.LasHeader, n: int, seed: int = 0) -> laspy.ScaleAwarePointRecord:
    """Points with random numbers in all dimensions."""
    rng = np.random.default_rng(seed)
    record = laspy.ScaleAwarePointRecord.zeros(n, header=header)
    for dimension in header.point_format.dimensions:
        if dimension.kind.name == "BitField":
            record[dimension.name] = rng.integers(0, dimension.max + 1, n, np.uint8)
        elif dimension.kind.name == "FloatingPoint":
            record.array[dimension.name] = rng.normal(size=record.array[dimension.name].shape)
        else:
            stored = record.array[dimension.name]
            low, high = np.iinfo(stored.dtype).min, np.iinfo(stored.dtype).max
            record.array[dimension.name] = rng.integers(low, high, stored.shape, stored.dtype, endpoint=True)
    return record


def las_bytes(header: laspy.LasHeader, record: laspy.ScaleAwarePointRecord, compress: bool = False) -> bytes:
    stream = BytesIO()
    with laspy.open(stream, mode="w", header=header, do_compress=compress, closefd=False) as writer:
        writer.write_points(record)
    return stream.getvalue()


def header_of(version: str, point_format: int, scale: float = 0.01) -> laspy.LasHeader:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = np.full(3, scale), np.array([400000.0, 5600000.0, -7.5])
    return header


DIALECTS = [
    ("1.0", 0), ("1.0", 1), ("1.1", 0), ("1.1", 1), ("1.2", 0), ("1.2", 1), ("1.2", 2), ("1.2", 3), ("1.3", 3),
    ("1.3", 4), ("1.3", 5), ("1.4", 0), ("1.4", 3), ("1.4", 5), ("1.4", 6), ("1.4", 7), ("1.4", 8), ("1.4", 9),
    ("1.4", 10),
]  # fmt: skip


@pytest.mark.parametrize(("version", "point_format"), DIALECTS)
def test_all_point_formats_of_all_versions(version, point_format):
    """Every dimension is a column with the numbers that laspy reads."""
    header = header_of("1.2" if version in ("1.0", "1.1") else version, point_format)
    record = random_record(header, 20)
    for compress in (False, True) if point_format not in (4, 5) else (False,):
        content = bytearray(las_bytes(header, record, compress))
        content[25] = int(version[-1])
        cloud, truth = read_las(bytes(content)), laspy.read(BytesIO(bytes(content)))
        assert np.array_equal(cloud.points, truth.xyz)
        assert cloud.points.dtype == np.float64
        assert cloud.points[0, 0] == record.array["X"][0] * 0.01 + 400000.0
        names = set(truth.point_format.dimension_names) - {"X", "Y", "Z", *WHITE}
        assert set(cloud.columns) == names
        for name in names:
            assert np.array_equal(cloud.columns[name], np.asarray(truth[name])), name
        assert (cloud.colors is None) == ("red" not in set(truth.point_format.dimension_names))
        if cloud.colors is not None:
            assert np.array_equal(cloud.colors[:, 1], np.rint(truth.green / 257.0))


def test_bit_fields_are_bytes_and_times_doubles():
    cloud = read_las(las_bytes(header_of("1.4", 6), random_record(header_of("1.4", 6), 9)))
    kinds = {"return_number": "u1", "overlap": "u1", "classification": "u1", "gps_time": "f8", "intensity": "u2"}
    assert {name: cloud.columns[name].dtype.str[1:] for name in kinds} == kinds
    assert cloud.labels is None  # classes are no instances


@pytest.mark.parametrize("compress", [False, True])
def test_extra_bytes_of_all_types(compress):
    header = header_of("1.4", 6)
    kinds = [f"{base}{size}" for base, sizes in (("u", "1248"), ("i", "1248"), ("f", "48")) for size in sizes]
    header.add_extra_dims([laspy.ExtraBytesParams(f"one_{kind}", kind) for kind in kinds])
    header.add_extra_dims([laspy.ExtraBytesParams(f"{n}_{kind}", f"{n}{kind}") for n in (2, 3) for kind in kinds])
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("height above ground", "i4", scales=[0.001], offsets=[5.0]),
            laspy.ExtraBytesParams("beam", "3i2", scales=[0.5, 1.0, 2.0], offsets=[0.0, 0.0, 1.0]),
            laspy.ExtraBytesParams("with no data", "i2", no_data=[-32768]),
            laspy.ExtraBytesParams("label", "u2"),
        ]
    )
    record = random_record(header, 12)
    cloud = read_las(las_bytes(header, record, compress))
    for kind in kinds:
        for name in (f"one_{kind}", f"2_{kind}", f"3_{kind}"):
            assert cloud.columns[name].dtype == kind
            assert np.array_equal(cloud.columns[name], record.array[name])
    scaled = record.array["height above ground"] * 0.001 + 5.0
    assert cloud.columns["height above ground"].dtype == np.float64
    assert np.array_equal(cloud.columns["height above ground"], scaled)
    assert np.array_equal(cloud.columns["beam"], record.array["beam"] * [0.5, 1.0, 2.0] + [0.0, 0.0, 1.0])
    assert np.array_equal(cloud.columns["with no data"], record.array["with no data"])
    assert cloud.labels.tolist() == record.array["label"].tolist()


def test_extra_bytes_that_nothing_describes():
    """The record of a point is longer than its format, and no record tells of what."""
    header = header_of("1.2", 0)
    header.add_extra_dims([laspy.ExtraBytesParams("more", "3u1")])
    content = bytearray(las_bytes(header, random_record(header, 4)))
    at = content.index(b"LASF_Spec\0")
    content[at : at + 4] = b"none"
    assert read_las(bytes(content)).columns["ExtraBytes"].shape == (4, 3)


def test_normals_under_the_names_of_others():
    for names in (("NormalX", "NormalY", "NormalZ"), ("nx", "ny", "nz")):
        header = header_of("1.4", 6)
        header.add_extra_dims([laspy.ExtraBytesParams(name, "f4") for name in names])
        record = random_record(header, 5)
        cloud = read_las(las_bytes(header, record))
        assert np.array_equal(cloud.normals, np.stack([record.array[name] for name in names], axis=1))
        assert not set(names).intersection(cloud.columns)


@pytest.mark.parametrize(
    ("stored", "colors"),
    [
        ([65535, 32896, 257], [255, 128, 1]),
        ([65280, 512, 0], [254, 2, 0]),  # 8 bits times 256
        ([255, 128, 1], [255, 128, 1]),  # 8 bits against the standard
        ([256, 0, 0], [1, 0, 0]),
        ([0, 0, 0], None),
    ],
)
def test_colours_of_16_bits_and_of_8_in_16(stored, colors):
    header = header_of("1.2", 2)
    record = laspy.ScaleAwarePointRecord.zeros(2, header=header)
    for name, value in zip(WHITE, stored, strict=True):
        record[name] = np.array([0, value], np.uint16)
    cloud = read_las(las_bytes(header, record))
    assert (None if cloud.colors is None else cloud.colors.tolist()) == (colors and [[0, 0, 0], colors])


def copc_bytes(points: np.ndarray) -> bytes:
    """A COPC file of one node, the root of its octree: a LAZ file, an info record and a hierarchy."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    header.vlrs.append(laspy.VLR("copc", 1, "", bytes(160)))
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    record.x, record.y, record.z = points.T
    stream = BytesIO()
    with laspy.open(stream, mode="w", header=header, do_compress=True, closefd=False) as writer:
        writer.write_points(record)
        writer.write_evlrs(VLRList([laspy.VLR("copc", 1000, "", bytes(32))]))
    content = bytearray(stream.getvalue())
    written = laspy.open(BytesIO(bytes(content))).header
    source = BytesIO(bytes(content))
    source.seek(written.offset_to_point_data)
    packing = lazrs.LazVlr(written.vlrs[written.vlrs.index("LasZipVlr")].record_data)
    ((_, n_bytes),) = lazrs.read_chunk_table(source, packing)
    hierarchy = written.start_of_first_evlr + 60
    struct.pack_into("<5d2Q2d", content, 375 + 54, 0.0, 0.0, 0.0, 10.0, 1.0, hierarchy, 32, 0.0, 0.0)
    struct.pack_into("<4iQ2i", content, hierarchy, 0, 0, 0, 0, written.offset_to_point_data + 8, n_bytes, len(points))
    return bytes(content)


def test_copc_is_read_as_laz(tmp_path):
    points = np.round(np.random.default_rng(0).uniform(-9.0, 9.0, (100, 3)), 3)
    path = tmp_path / "tile.copc.laz"
    path.write_bytes(copc_bytes(points))
    with laspy.CopcReader.open(str(path)) as reader:  # it is one
        assert len(reader.query()) == 100
    assert np.allclose(pcgraph.read_cloud(path).points, points, rtol=0.0, atol=1e-12)


# ---- Write and read ------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(clouds(st.integers(-(10**7), 10**7).map(lambda steps: steps / 1000.0)), st.sampled_from([".las", ".laz"]))
def test_every_column_comes_back(cloud, suffix):
    content = encode_las(cloud, suffix)
    read = read_las(content)
    assert_same(read, cloud, but=("points",))
    assert np.allclose(read.points, cloud.points, rtol=1e-15, atol=1e-12)  # they are whole millimetres
    assert content == encode_las(cloud, suffix)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_others_find_columns_in_their_places(suffix):
    """laspy reads the standard dimensions, and the rest as extra bytes."""
    cloud = mixed_cloud()
    las = laspy.read(BytesIO(encode_las(cloud, suffix)))
    assert (str(las.header.version), las.point_format.id) == ("1.4", 7)
    assert las.header.are_points_compressed == (suffix == ".laz")
    assert np.abs(las.xyz - cloud.points).max() <= 5e-5
    for name in ("intensity", "gps_time", "classification", "ring", "reflectivity"):
        assert np.array_equal(las[name], cloud.columns[name])
        assert las[name].dtype == cloud.columns[name].dtype
    assert set(las.point_format.extra_dimension_names) == {
        *("ring", "reflectivity", "NormalX", "NormalY", "NormalZ", "label"),
        *(f"descriptor_{i}" for i in range(4)),
    }
    assert np.array_equal(las.NormalY, cloud.normals[:, 1])
    assert np.array_equal(las.label, cloud.labels)
    assert np.array_equal(las.blue, cloud.colors[:, 2].astype(int) * 257)
    assert (las.return_number == 1).all()
    assert las.header.global_encoding.wkt
    assert np.allclose(las.header.mins, cloud.points.min(axis=0), rtol=0.0, atol=1e-4)


@pytest.mark.parametrize(("time", "kind"), [(3.1e8, 1), (-5.0, 1), (604799.5, 0), (0.0, 0)])
def test_gps_times_beyond_a_week_are_flagged_as_standard_times(time, kind):
    cloud = Cloud(np.zeros((2, 3)), columns={"gps_time": np.array([np.nan, time])})
    header = laspy.read(BytesIO(encode_las(cloud, ".las"))).header
    assert header.global_encoding.gps_time_type == kind
    assert header.global_encoding.wkt


def test_the_smallest_point_format():
    cloud = mixed_cloud()
    nir = {"nir": np.arange(50, dtype=np.uint16)}
    for expected, given_cloud in (
        (6, Cloud(cloud.points)),
        (6, Cloud(cloud.points, columns=nir)),
        (7, Cloud(cloud.points, cloud.colors)),
        (8, Cloud(cloud.points, cloud.colors, columns=nir)),
    ):
        content = encode_las(given_cloud, ".las")
        assert laspy.open(BytesIO(content)).header.point_format.id == expected
        assert_same(read_las(content), given_cloud, but=("points",))


@pytest.mark.parametrize("scale", [1.0, 0.01, 0.001, 0.0001, 0.002, 0.00025, 1e-7])
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (412000.0, 5654000.0, 100.0), (412345.678912, 5654321.5, -0.125)])
def test_coordinates_of_las_files_stay_on_their_grid(scale, offset):
    rng = np.random.default_rng(0)
    points = rng.integers(-(10**6), 10**6, (300, 3)) * scale + offset
    content = encode_las(Cloud(points), ".las")
    read = read_las(content).points
    assert np.abs(read - points).max() <= 4.0 * np.spacing(np.abs(points).max())
    again = read_las(encode_las(Cloud(read), ".las")).points
    assert np.array_equal(again, read)
    if offset[0] == np.rint(offset[0]) and scale in (0.01, 0.001, 0.0001):
        assert (laspy.open(BytesIO(content)).header.scales == scale).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("extent", [1e-12, 1e-3, 0.3, 40.0, 1e3, 1e5, 2.147e5])
@pytest.mark.parametrize("middle", [0.0, 5654321.0])
def test_other_coordinates_are_kept_to_a_tenth_of_a_millimetre_or_better(dtype, extent, middle):
    points = (middle + np.random.default_rng(0).uniform(-extent, extent, (500, 3))).astype(dtype)
    away = np.abs(read_las(encode_las(Cloud(points), ".las")).points - points)
    resolution = np.spacing(np.abs(points).max())
    assert away.max() <= max(min(5e-5, 1e-7 * extent), 2.0 * resolution) * (1.0 + 1e-6)


def test_points_too_far_apart():
    far = np.array([[0.0, 0.0, 0.0], [0.123456789, 0.0, 0.0], [1e7, 0.0, 0.0]])
    with pytest.raises(CloudWriteError, match="within 429 km of each other, as LAS has 32 bits for each, got 0 to 1e"):
        encode_las(Cloud(far), ".las")
    single = read_las(encode_las(Cloud(far.astype(np.float32)), ".las")).points  # float32 resolves no more than LAS
    assert np.abs(single - far.astype(np.float32)).max() <= 1.0


def test_a_file_of_others_keeps_all_its_columns():
    """Dimensions that are zero everywhere are columns, too, and are there after writing."""
    header = header_of("1.2", 3)
    cloud = read_las(las_bytes(header, laspy.ScaleAwarePointRecord.zeros(3, header=header)))
    assert {"classification", "user_data", "gps_time", "scan_angle_rank"} <= set(cloud.columns)
    assert_same(read_las(encode_las(cloud, ".laz")), cloud)


def test_what_another_program_adds_to_our_file_is_read():
    las = laspy.read(BytesIO(encode_las(mixed_cloud(), ".las")))
    las.add_extra_dim(laspy.ExtraBytesParams("height", "f4"))
    las.height = np.arange(50)
    las.user_data = np.arange(50)
    stream = BytesIO()
    las.write(stream)
    cloud = read_las(stream.getvalue())
    assert set(cloud.columns) == {*mixed_cloud().columns, "height", "user_data"}
    assert cloud.columns["height"].tolist() == cloud.columns["user_data"].tolist() == list(range(50))


def test_more_columns_than_the_format_has():
    columns = {f"column {i}": np.zeros(1, np.uint8) for i in range(342)}
    with pytest.raises(CloudWriteError, match=r"at most 341 fields of extra bytes.* got 342"):
        encode_las(Cloud(np.zeros((1, 3)), columns=columns), ".las")
    del columns["column 0"]
    assert len(read_las(encode_las(Cloud(np.zeros((1, 3)), columns=columns), ".las")).columns) == 341


# ---- Files that are not right --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_files_that_are_cut_off(suffix):
    content = encode_las(mixed_cloud(), suffix)
    for length in {0, 3, 100, 226, 230, 374, len(content) // 2, len(content) - 1}:
        with pytest.raises(CloudReadError):
            read_las(content[:length])


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("count", [51, 10**6, 2**40, 2**63])
def test_more_points_than_there_are(suffix, count):
    content = bytearray(encode_las(mixed_cloud(), suffix))
    struct.pack_into("<Q", content, POINT_COUNT_AT, count)
    with pytest.raises(CloudReadError, match=r"promises|damaged"):
        read_las(bytes(content))


def test_fewer_points_than_there_are():
    content = bytearray(encode_las(mixed_cloud(), ".las"))
    struct.pack_into("<Q", content, POINT_COUNT_AT, 7)
    assert read_las(bytes(content)).points.shape == (7, 3)


def test_records_that_would_never_end():
    content = bytearray(encode_las(mixed_cloud(), ".las"))
    struct.pack_into("<I", content, COUNT_OF_RECORDS_AT, 2**32 - 1)
    with pytest.raises(CloudReadError, match="promises 4294967295 records, but the file has"):
        read_las(bytes(content))


def test_chunks_and_layers_longer_than_the_file():
    """lazrs takes memory for them first: 4 GB, or it ends the process."""
    content = bytearray(encode_las(Cloud(mixed_cloud().points), ".laz"))
    (start,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, start)
    layers = bytearray(content)
    struct.pack_into("<I", layers, start + 8 + 30 + 4, 2**32 - 1)
    with pytest.raises(CloudReadError, match=r"promises layers of 4294967.* bytes in a chunk of"):
        read_las(bytes(layers))
    struct.pack_into("<I", content, table + 4, 2**32 - 1)
    with pytest.raises(CloudReadError, match="promises 4294967295 chunks"):
        read_las(bytes(content))


def test_libraries_that_are_missing(monkeypatch):
    las, laz = (encode_las(mixed_cloud(), suffix) for suffix in (".las", ".laz"))
    monkeypatch.setitem(sys.modules, "lazrs", None)
    assert read_las(las).points.shape == (50, 3)
    with pytest.raises(CloudReadError, match=r"^reading .laz needs laspy and lazrs: pip install rangesim\[las\]$"):
        read_las(laz)
    with pytest.raises(CloudWriteError, match=r"^writing .laz needs laspy and lazrs: pip install rangesim\[las\]$"):
        encode_las(mixed_cloud(), ".laz")
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(CloudReadError, match=r"^reading .las needs laspy: pip install rangesim\[las\]$"):
        read_las(las)


# ---- Readers and writers of others ---------------------------------------------------------------------------------


@pytest.mark.validation
def test_laszip_unpacks_what_is_written():
    """LASzip is the first implementation of LAZ, in C++."""
    pytest.importorskip("laszip", reason="laszip is not installed: pip install laszip")
    cloud = mixed_cloud(200_000)
    las = laspy.read(BytesIO(encode_las(cloud, ".laz")), laz_backend=laspy.LazBackend.Laszip)
    assert np.abs(las.xyz - cloud.points).max() <= 5e-5
    for name in ("intensity", "gps_time", "classification", "ring", "reflectivity"):
        assert np.array_equal(las[name], cloud.columns[name])
    assert np.array_equal(np.stack([las[f"descriptor_{i}"] for i in range(4)], axis=1), cloud.columns["descriptor"])
    assert np.array_equal(np.stack([las.red, las.green, las.blue], axis=1), cloud.colors.astype(np.uint16) * 257)
    assert np.array_equal(las.label, cloud.labels)


@pytest.mark.validation
def test_copc_files_of_several_nodes(tmp_path):
    copclib = pytest.importorskip("copclib", reason="copclib is not installed: pip install copclib")
    path, rng = tmp_path / "tile.copc.laz", np.random.default_rng(0)
    config = copclib.CopcConfigWriter(7, copclib.Vector3(0.001, 0.001, 0.001), copclib.Vector3(0, 0, 0))
    writer = copclib.FileWriter(str(path), config)
    written = []
    for key, n in (((0, 0, 0, 0), 500), ((1, 0, 0, 0), 300), ((1, 1, 1, 0), 7)):
        points = copclib.Points(writer.copc_config.las_header)
        for x, y, z in np.round(rng.uniform(0.0, 9.0, (n, 3)), 3).tolist():
            point = points.CreatePoint()
            point.x, point.y, point.z, point.red, point.intensity = x, y, z, 257 * 9, 7
            points.AddPoint(point)
            written.append((x, y, z))
        writer.AddNode(copclib.VoxelKey(*key), points)
    writer.Close()
    cloud = pcgraph.read_cloud(path)
    assert np.allclose(sorted(cloud.points.tolist()), sorted(written), rtol=0.0, atol=1e-12)
    assert (cloud.colors == (9, 0, 0)).all()
    assert (cloud.columns["intensity"] == 7).all()


@pytest.mark.validation
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_cloudcompare_shows_all_columns(suffix, tmp_path):
    """CloudCompare converts a file of ours to text; the columns that it shows are ours."""
    cloud = mixed_cloud()
    path = tmp_path / f"cloud{suffix}"
    path.write_bytes(encode_las(cloud, suffix))
    table = as_cloudcompare_reads(path)
    assert np.abs(np.stack([table[axis] for axis in "XYZ"], axis=1) - cloud.points).max() <= 1e-4
    shown = {name.lower(): column for name, column in table.items()}
    for name in set(shown).intersection(cloud.columns):
        assert np.allclose(shown[name], cloud.columns[name])


def test_copc_files_are_only_read():
    content = encode_cloud(Cloud(np.ones((2, 3))), "a.laz")
    assert decode_cloud(content, "a.copc.laz").points.tolist() == [[1.0, 1.0, 1.0]] * 2
    with pytest.raises(CloudWriteError, match=r"files ending in \.copc\.laz are only read"):
        encode_cloud(Cloud(np.ones((2, 3))), "a.copc.laz")


def test_files_whose_writer_did_not_come_to_the_count_are_refused():
    content = bytearray(encode_las(Cloud(np.ones((2, 3))), ".las"))
    content[107:111] = bytes(4)
    content[POINT_COUNT_AT : POINT_COUNT_AT + 8] = bytes(8)
    with pytest.raises(CloudReadError, match="promises no points, but 60 bytes follow: its writer did not end"):
        read_las(bytes(content))
    assert len(read_las(encode_las(Cloud(np.ones((0, 3))), ".las")).points) == 0


def test_a_reference_system_that_is_left_out_is_told():
    header = header_of("1.4", 6)
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr('PROJCS["ETRS89 / UTM zone 32N"]'))
    content = las_bytes(header, laspy.ScaleAwarePointRecord.zeros(3, header=header))
    with pytest.warns(UserWarning, match="left out the coordinate reference system of the LAS file"):
        cloud = read_las(content)
    assert len(cloud.points) == 3
