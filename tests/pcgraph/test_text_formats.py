# SPDX-License-Identifier: Apache-2.0
"""Text files of points: the dialects in use, what is refused, and that what is written comes back."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from shutil import which

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import pcgraph
from pcgraph.cloud import Cloud
from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.io.format import CloudFile
from pcgraph.io.ptx import read_ptx
from pcgraph.io.text import encode_pts, encode_text, read_text

COLORS = [[10, 20, 30], [0, 128, 255]]
UNIT = "0.6 0 0.8", "0 -1 0"


def read(text: str | bytes, columns: tuple[str, ...] | None = None, is_pts: bool = False) -> Cloud:
    content = text.encode() if isinstance(text, str) else text
    return read_text(CloudFile(content, columns=columns), is_pts)


# ---- Dialects ------------------------------------------------------------------------------------------------------

XYZ = "1 2.5 -3e0\n4 5 6\n"
SAME = {
    "blanks": XYZ,
    "tabs": XYZ.replace(" ", "\t"),
    "commas": XYZ.replace(" ", ","),
    "commas and blanks": XYZ.replace(" ", ", "),
    "semicolons": XYZ.replace(" ", ";"),
    "decimal commas": "1;2,5;-3e0\n4;5;6\n",
    "many blanks around": "  1   2.5\t -3e0  \n\n   4 5 6  ",
    "lines of Windows": XYZ.replace("\n", "\r\n"),
    "lines of old Macs": XYZ.replace("\n", "\r"),
    "no line end": XYZ.rstrip(),
    "mark of UTF-8": b"\xef\xbb\xbf" + XYZ.encode(),
    "UTF-16": XYZ.encode("utf-16"),
    "UTF-16, big end first": b"\xfe\xff" + XYZ.encode("utf-16-be"),
    "separators at the end": "1,2.5,-3,\n4,5,6,\n",
    "quoted numbers": '"1","2.5","-3"\n"4","5","6"\n',
    "signs and exponents": "+1.0E+0 25e-1 -.3e1\n4. 05 6.000\n",
    "comments": "# a scan of\n// two points\n%%\n1 2.5 -3\n# between\n4 5 6 # behind\n",
    "comment in Latin-1": "# Gew\xf6lbe\n".encode("latin-1") + XYZ.encode(),
    "names": "x y z\n" + XYZ,
    "names and blank lines": "\nX,Y,Z\n\n" + XYZ.replace(" ", ","),
    "names in quotes": '"x";"y";"z"\n' + XYZ.replace(" ", ";"),
    "names with units": "x [m],y [m],z (m)\n" + XYZ.replace(" ", ","),
    "names of CloudCompare": "//X Y Z\n" + XYZ,
    "names of NumPy": "# x y z\n" + XYZ,
    "names between tabs": "X\tY\tZ\n" + XYZ,
    "count": "2\n" + XYZ,
    "names and count": "//X Y Z\n2\n" + XYZ,
    "blocks with counts": "1\n1 2.5 -3\n1\n4 5 6\n",
    "a block of no points": "0\n2\n" + XYZ,
}


@pytest.mark.parametrize("dialect", SAME)
def test_the_same_points_in_many_dialects(dialect: str) -> None:
    cloud = read(SAME[dialect])
    assert cloud.points.tolist() == [[1, 2.5, -3], [4, 5, 6]]
    assert cloud.points.dtype == np.float32
    assert cloud.colors is cloud.normals is cloud.labels is None
    assert cloud.columns == {}


def test_nan_has_many_spellings() -> None:
    words = ("nan", "NaN", "-nan", "NA", "N/A", "null", "NULL", "None", "1.#IND", "-1.#IND00", "1.#QNAN", "-nan(ind)")
    for word in words:
        for row in (f"{word} 1 2\n3 4 5\n", f"3,4,5\n{word},1,2\n", f"9;9;9\n{word};1;2\n"):
            points = read(row).points
            assert np.isnan(points).sum() == 1, word
    assert np.isnan(read("1,2,3\n,5,6\n").points[1]).tolist() == [True, False, False]
    assert np.isnan(read("x,y,z,t\n1,2,3,\n4,5,6,7\n").columns["t"]).tolist() == [True, False]
    assert read("1 2 inf\n-INF 4 1.#INF\n").points.tolist() == [[1, 2, np.inf], [-np.inf, 4, np.inf]]
    assert read(",x,y,z\n0,1,2,3\n").columns["column_0"].tolist() == [0]
    assert "Banana" in read("x,y,z,Banana NA\n1,2,3,NA\n".replace(" NA", "")).columns


@pytest.mark.parametrize(
    ("rows", "is_pts", "found"),
    [
        (["1 2 3 0.5", "4 5 6 0.25"], False, {"intensity"}),
        (["1 2 3 10 20 30", "4 5 6 0 128 255"], False, {"colors"}),
        (["1 2 3 1000 20 30", "4 5 6 0 128 255"], False, {"column_3", "column_4", "column_5"}),
        ([f"1 2 3 {UNIT[0]}", f"4 5 6 {UNIT[1]}"], False, {"normals"}),
        (["1 2 3 0.1 0.2 0.3", "4 5 6 0.4 0.5 0.6"], False, {"column_3", "column_4", "column_5"}),
        (["1 2 3 -700 10 20 30", "4 5 6 99 0 128 255"], False, {"intensity", "colors"}),
        (["1 2 3 7 10 20 30", "4 5 6 99 0 128 255"], True, {"intensity", "colors"}),
        (["1 2 3 7 10 20 30", "4 5 6 99 0 128 255"], False, {f"column_{i}" for i in range(3, 7)}),
        (["1 2 3 10 20 30 0.5", "4 5 6 0 128 255 0.25"], False, {"colors", "column_6"}),
        (["1 2 3 9 8", "4 5 6 7 6"], False, {"column_3", "column_4"}),
    ],
)
def test_columns_without_names_are_named_where_there_is_no_doubt(
    rows: list[str], is_pts: bool, found: set[str]
) -> None:
    cloud = read("\n".join(rows), is_pts=is_pts)
    own = {name for name in ("colors", "normals") if getattr(cloud, name) is not None}
    assert own | set(cloud.columns) == found
    if cloud.colors is not None:
        assert cloud.colors.tolist() == COLORS


@pytest.mark.parametrize(
    "header", ["//X Y Z R G B Scalar field", "X,Y,Z,Red,Green,Blue,Scalar field", '# x y z r g b "Scalar field"']
)
def test_names_in_a_line_above_the_rows(header: str) -> None:
    rows = "1 2 3 10 20 30 7\n4 5 6 0 128 255 8\n"
    cloud = read(f"{header}\n{rows.replace(' ', ',') if ',' in header else rows}")
    assert cloud.colors.tolist() == COLORS
    assert cloud.columns["Scalar field"].tolist() == [7, 8]


def test_colours_of_other_ranges() -> None:
    assert read("x y z Rf Gf Bf\n1 2 3 1 0.5 0\n4 5 6 0 0 0.2\n").colors.tolist() == [[255, 128, 0], [0, 0, 51]]
    assert read("x y z R G B\n1 2 3 65535 32896 257\n").colors.tolist() == [[255, 128, 1]]
    packed = read("x y z rgb\n1 2 3 4278190335\n4 5 6 65280\n")
    assert packed.colors.tolist() == [[0, 0, 255], [0, 255, 0]]


def test_numbers_of_points_are_no_coordinates() -> None:
    text = "1 691234.5 5334567.25 512.1\n2 691235.5 5334568.25 512.2\n7 691236.5 5334569.25 512.3\n"
    with pytest.raises(CloudReadError, match="the first column seems to count the points"):
        read(text)
    cloud = read(text, ("id", "x", "y", "z"))
    assert (cloud.points[0].tolist(), cloud.columns["id"].tolist()) == ([691234.5, 5334567.25, 512.1], [1, 2, 7])
    assert read("1 5 6 7\n2 5 6 7\n3 5 6 8\n").points[2].tolist() == [3, 5, 6]


def test_the_user_names_the_columns() -> None:
    rows = "7 1 2 3 10 20 30\n8 4 5 6 0 128 255\n"
    names = ("label", "X", "y", "z", "r", "g", "b")
    for text in (rows, "an own title\n" + rows, "a b c d e f g\n" + rows):
        cloud = read(text, names)
        assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
        assert cloud.labels.tolist() == [7, 8]
        assert cloud.colors.tolist() == COLORS
    with pytest.raises(CloudReadError, match="expected 6 numbers in each row, as columns names, got 7"):
        read(rows, names[:6])
    with pytest.raises(CloudReadError, match="distinct"):
        read(rows, ("x", "y", "z", "a", "a", "b", "c"))


def test_types_are_as_wide_as_numbers_need() -> None:
    text = "x y z i f time id wide\n0.5 1 2 3 0.25 0.1 1700000000000000001 18446744073709551615\n0.5 1 2 4 1.0 2 3 4\n"
    cloud = read(text)
    kinds = {name: column.dtype.name for name, column in cloud.columns.items()}
    assert kinds == {"i": "int32", "f": "float32", "time": "float64", "id": "int64", "wide": "uint64"}
    assert cloud.columns["id"][0] == 1700000000000000001
    assert cloud.columns["wide"][0] == 2**64 - 1
    assert read("500000.123 1 2\n").points.dtype == np.float64


def test_files_are_known_by_their_ends(tmp_path: Path) -> None:
    for suffix in (".xyz", ".txt", ".csv", ".asc", ".pts", ".XYZ", ".xyzn", ".xyzrgb"):
        (tmp_path / f"a{suffix}").write_text(XYZ)
        assert pcgraph.read_cloud(tmp_path / f"a{suffix}").points.shape == (2, 3)
    (tmp_path / "a.dat").write_text(XYZ)
    assert pcgraph.read_cloud(tmp_path / "a.dat", "text", ["z", "y", "x"]).points[0].tolist() == [-3, 2.5, 1]
    (tmp_path / "b.xyzrgb").write_text("1 2 3 0.2 0 1\n")
    assert pcgraph.read_cloud(tmp_path / "b.xyzrgb").colors.tolist() == [[51, 0, 255]]


def test_files_without_points() -> None:
    assert read("x,y,z,t\n").points.shape == (0, 3)
    assert set(read("x,y,z,t\n").columns) == {"t"}
    assert read("0\n", is_pts=True).points.shape == (0, 3)


# ---- What is refused -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2 3\n4 5\n", "expected 3 numbers in each row, as in the first, but line 2 has 2"),
        ("# c\n\n1,2,3\n4,5,6,7\n", "but line 4 has 4"),
        ("x y z\n1 2 3\n4 five 6\n", "expected numbers only in the rows, but line 3 has 'five'"),
        ("1 2 3\n4_0 5 6\n", "line 2 has '4_0'"),
        ("1 2\n3 4\n", "expected x, y and z in each row, got 2 numbers"),
        ("1,5 2,5 3,5\n", "line 1 seems to have decimal commas"),
        ("1,5\t2\t3,5\n", "line 1 seems to have decimal commas"),
        ("east north up\n1 2 3\n", "line 1 is neither a comment .* nor 3 names of columns"),
        ("x y z t\n1 2 3\n", "line 1 is neither"),
        ("a title\n1 2 3\n", "name the columns by columns="),
        ("", "expected rows of numbers, but line 1 and all others have none"),
        ("# nothing\n", "line 1 and all others have none"),
        ("word\n" * 20_000, "expected rows of numbers, but the first 1[0-9]+ lines have none"),
        (
            "x,y,z,name\n1,2,3,tree\n",
            "expected numbers only .* but line 2 has 'tree': leave out columns of words",
        ),
        ("x,y,z,t\n" + "1,2,3,2020-01-01\n" * 5000, "line 2 has '2020-01-01'"),
        ("1\n# cut off, as the count promises a row\n", "there are 1 more than the file has"),
        ("3\n1.00 2.00 3.00\n4 5 6\n", "there are 1 more than the file has"),
        ("1\n1 2 3\n4 5 6\n", "line 3 has one point more than the count"),
        ("1000000000\n1 2 3\n", "line 1 promises 1000000000 points, but the whole file has only 17 bytes"),
        ("1\n1 2 3\n999999999\n1 2 3\n", "line 3 promises 999999999 points"),
        ("x y z x\n1 2 3 4\n", "distinct"),
        ("1 2 3\n" + "4" * 200_000, "line 2 has 65536 bytes or more"),
        (b"x" * 10**6, "line 1 has 65536 bytes or more"),
        (" ".join(["1"] * 2000), "at most 1024 numbers"),
        (b"\x00\x01\x02\x03 1 2 3\n" * 10, "got binary data"),
        (bytes(range(128, 256)) * 9, "line 1 and all others have none"),
        (b"\xff\xfe\x00\xd8\x00\xd8\x31\x00", "line 1"),
    ],
)
def test_other_files_are_refused_in_one_sentence(text: str | bytes, words: str) -> None:
    with pytest.raises(CloudReadError, match=words) as caught:
        read(text)
    assert len(str(caught.value)) < 300


# ---- PTX -----------------------------------------------------------------------------------------------------------

POSE = "10 20 30\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n"


def test_ptx_of_one_scan_is_organised_in_the_common_frame() -> None:
    rows = ["1 0 0 0.5", "0 0 0 0.5", "0 2 0 0.25", "0 0 3 0", "1 1 1 1", "2 2 2 0"]
    cloud = read_ptx(CloudFile(("3\n2\n" + POSE + "\n".join(rows) + "\n").encode()))
    assert cloud.points.shape == (2, 3, 3)
    assert cloud.points[0, 0].tolist() == [10, 21, 30]  # a quarter turn to the left, then the place
    assert np.isnan(cloud.points[1, 0]).all()
    assert cloud.points[0, 1].tolist() == [8, 20, 30]
    assert cloud.columns["intensity"].tolist() == [[0.5, 0.25, 1], [0.5, 0, 0]]
    assert cloud.viewpoint.tolist() == [10, 20, 30]


def test_ptx_points_are_those_of_lastools() -> None:
    """The example of rapidlasso's page on the matrix of PTX files, which agrees with CloudCompare and Cyclone."""
    matrix = "-0.955179 0.296021 -0.002106 0\n-0.296023 -0.955180 0.001152 0\n-0.001670 0.001724 0.999997 0\n"
    text = f"1\n2\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n{matrix}3.847211 12.235314 -0.425777 1\n"
    text += "1.111111 2.111111 3.111 0.111\n1.666666 2.666666 3.666 0.678\n"
    points = read_ptx(CloudFile(text.encode())).points
    assert points.shape == (2, 1, 3)
    assert points.reshape(-1, 3).round(3).tolist() == [[2.156, 10.553, 2.685], [1.46, 10.188, 3.24]]


def test_ptx_of_several_scans_is_a_list_with_a_viewpoint_for_each_point() -> None:
    scan = "1\n2\n" + POSE + "1 0 0 0.5 1 2 3\n0 0 0 0 0 0 0\n"
    cloud = read_ptx(CloudFile((scan + scan.replace("10 20 30", "0 0 5")).encode()))
    assert cloud.points.shape == (4, 3)
    assert cloud.columns["scan"].tolist() == [0, 0, 1, 1]
    assert cloud.viewpoint.tolist() == [[10, 20, 30]] * 2 + [[0, 0, 5]] * 2
    assert cloud.colors[0].tolist() == [1, 2, 3]
    assert cloud.points[2].tolist() == [0, 1, 5]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("1\n2\n" + POSE + "1 0 0 0\n", "expected 2 rows of 4 or 7 numbers, .* got 1 rows of 4"),
        ("1\n1\n" + POSE, "expected a row of numbers after line 10"),
        ("1\n1\n" + POSE + "1 2 3\n", "got 1 rows of 3"),
        ("100000\n100000\n" + POSE + "1 0 0 0\n", "line 10 promises 10000000000 points"),
        ("1.5\n1\n" + POSE + "1 0 0 0\n", "got 1.5 and 1"),
        ("nan\n1\n" + POSE + "1 0 0 0\n", "got nan and 1"),
        ("1\n1\n" + POSE[:-20], "expected 4 numbers in line 8, one of the ten"),
        ("1\n1\n" + POSE.replace("0 0 1 0\n", "0 0 1 5\n") + "1 0 0 0\n", "last column is 0 0 0 1 in lines 7 to 10"),
        ("1\n2\n" + POSE + "1 0 0 0\n1 0\n", "line 12 has 2"),
    ],
)
def test_broken_ptx_files_are_refused(text: str, words: str) -> None:
    with pytest.raises(CloudReadError, match=words):
        read_ptx(CloudFile(text.encode()))


# ---- What is written comes back ------------------------------------------------------------------------------------

NUMBERS = st.sampled_from(["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8", "b1"]).map(np.dtype)


@st.composite
def clouds(draw: st.DrawFn) -> Cloud:
    n = draw(st.integers(0, 5))
    some = st.booleans()

    def array(kind: np.dtype, *more: int):
        return draw(hnp.arrays(kind, (n, *more)))

    names = st.sampled_from(["intensity", "ring", "Scalar field", "a,b", "Zeit", "d\xe9j\xe0", "scan", "x2"])
    return Cloud(
        array(draw(st.sampled_from([np.dtype("f4"), np.dtype("f8")])), 3),
        colors=array(np.dtype("u1"), 3) if draw(some) else None,
        normals=array(np.dtype("f4"), 3) if draw(some) else None,
        labels=array(np.dtype("i4")) if draw(some) else None,
        columns={name: array(draw(NUMBERS)) for name in draw(st.sets(names, max_size=3))},
    )


@settings(max_examples=60, deadline=None)
@given(clouds(), st.sampled_from([".csv", ".txt", ".xyz"]))
def test_every_number_of_every_column_comes_back(cloud: Cloud, suffix: str) -> None:
    found = read(encode_text(cloud, suffix))
    for name in ("points", "colors", "normals", "labels"):
        given_, back = getattr(cloud, name), getattr(found, name)
        assert (given_ is None) == (back is None)
        assert given_ is None or np.array_equal(given_, back, equal_nan=True), name
    assert set(found.columns) == set(cloud.columns)
    for name, column in cloud.columns.items():
        back = found.columns[name]
        assert np.array_equal(column, back, equal_nan=column.dtype.kind == "f"), name
        assert column.size == 0 or (back.dtype.kind == "f") == (column.dtype.kind == "f")


@settings(max_examples=30, deadline=None)
@given(st.data(), st.integers(1, 4), st.booleans(), st.booleans())
def test_every_number_of_a_pts_file_comes_back(
    data: st.DataObject, n: int, has_colors: bool, has_intensity: bool
) -> None:
    points = data.draw(hnp.arrays("f8", (n, 3)))
    colors = data.draw(hnp.arrays("u1", (n, 3))) if has_colors else None
    columns = {"intensity": data.draw(hnp.arrays(data.draw(NUMBERS), n))} if has_intensity else {}
    found = read(encode_pts(Cloud(points, colors, columns=columns), ".pts"), is_pts=True)
    assert np.array_equal(found.points, points, equal_nan=True)
    assert (found.colors is None) == (colors is None)
    assert colors is None or np.array_equal(found.colors, colors)
    assert set(found.columns) == set(columns)
    for name, column in columns.items():
        assert np.array_equal(found.columns[name], column, equal_nan=column.dtype.kind == "f")


def test_scans_go_from_ptx_to_csv_and_back(tmp_path: Path) -> None:
    """With the place of each point's scanner; holes are left out."""
    scan = "1\n2\n" + POSE + "1 0 0 0.5 1 2 3\n0 0 0 0 0 0 0\n"
    (tmp_path / "a.ptx").write_text(scan + scan.replace("10 20 30", "0 0 5"))
    cloud = pcgraph.read_cloud(tmp_path / "a.ptx")
    pcgraph.write_cloud(tmp_path / "a.csv", cloud)
    found = pcgraph.read_cloud(tmp_path / "a.csv")
    assert np.array_equal(found.points, cloud.points[::2])
    assert np.array_equal(found.viewpoint, cloud.viewpoint[::2])
    assert found.columns["scan"].tolist() == [0, 1]


def full_cloud(n: int = 40) -> Cloud:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(n, 3))
    return Cloud(
        rng.normal(size=(n, 3)).astype(np.float32),
        rng.integers(0, 256, (n, 3), dtype=np.uint8),
        (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        columns={"intensity": rng.random(n), "object": rng.integers(-1, 9, n, dtype=np.int32)},
    )


@pytest.mark.parametrize("keep", ["", "intensity", "colors", "intensity colors"])
def test_pts_files_hold_intensity_and_colours(keep: str) -> None:
    cloud = full_cloud()
    small = Cloud(
        cloud.points,
        colors=cloud.colors if "colors" in keep else None,
        columns={"intensity": cloud.columns["intensity"]} if "intensity" in keep else {},
    )
    content = encode_pts(small, ".pts")
    assert content.startswith(b"40\n")
    found = read(content, is_pts=True)
    assert np.array_equal(found.points, small.points)
    assert set(found.columns) == set(small.columns)
    assert (found.colors is None) == (small.colors is None)
    assert small.colors is None or np.array_equal(found.colors, small.colors)
    with pytest.raises(CloudWriteError, match=r"has also nx, ny, nz, object: write a \.csv"):
        encode_pts(cloud, ".pts")


def test_names_that_a_text_does_not_keep_are_refused() -> None:
    points = np.zeros((1, 3))
    for name in ("two\nlines", 'a "quoted" one', "x [m]"):
        with pytest.raises(CloudWriteError, match="expected names of columns that a text keeps"):
            encode_text(Cloud(points, columns={name: np.zeros(1)}), ".txt")
    with pytest.raises(CloudWriteError, match="at most 64 bits"):
        encode_text(Cloud(points, columns={"c": np.zeros(1, complex)}), ".csv")
    with pytest.raises(CloudWriteError, match="another name than 'x'"):
        encode_text(Cloud(points, columns={"x": np.zeros(1)}), ".csv")
    with pytest.raises(CloudWriteError, match="'v_0' comes twice"):
        encode_text(Cloud(points, columns={"v": np.zeros((1, 2)), "v_0": np.zeros(1)}), ".csv")
    vectors = encode_text(Cloud(points, columns={"v": np.arange(2.0)[None]}), ".csv")
    assert vectors.splitlines()[0] == b"x,y,z,v_0,v_1"


# ---- Readers of others ---------------------------------------------------------------------------------------------


def test_numpy_reads_what_is_written(tmp_path: Path) -> None:
    cloud = full_cloud()
    table = np.column_stack([cloud.points, cloud.colors, cloud.normals, *cloud.columns.values()])
    for suffix, options in ((".csv", {"delimiter": ",", "skiprows": 1}), (".txt", {"comments": "//"})):
        (tmp_path / "a").write_bytes(encode_text(cloud, suffix))
        assert np.array_equal(np.loadtxt(tmp_path / "a", **options), table)


def test_open3d_reads_what_is_written_and_is_read(tmp_path: Path) -> None:
    import open3d as o3d

    cloud = full_cloud()
    (tmp_path / "a.xyz").write_bytes(encode_text(cloud, ".xyz"))
    assert np.allclose(np.asarray(o3d.io.read_point_cloud(str(tmp_path / "a.xyz")).points), cloud.points)
    small = Cloud(cloud.points, cloud.colors, columns={"intensity": np.round(100 * cloud.columns["intensity"])})
    (tmp_path / "a.pts").write_bytes(encode_pts(small, ".pts"))
    found = o3d.io.read_point_cloud(str(tmp_path / "a.pts"))
    assert np.allclose(np.asarray(found.points), cloud.points)
    assert np.allclose(np.asarray(found.colors) * 255, cloud.colors)
    theirs = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points.astype(np.float64)))
    theirs.colors = o3d.utility.Vector3dVector(cloud.colors / 255)
    theirs.normals = o3d.utility.Vector3dVector(cloud.normals.astype(np.float64))
    for suffix in ("xyz", "pts", "xyzn", "xyzrgb"):
        assert o3d.io.write_point_cloud(str(tmp_path / f"b.{suffix}"), theirs)
        back = pcgraph.read_cloud(tmp_path / f"b.{suffix}")
        assert np.allclose(back.points, cloud.points, atol=1e-6), suffix
        if suffix in ("pts", "xyzrgb"):
            assert np.array_equal(back.colors, cloud.colors)
        if suffix == "xyzn":
            assert np.allclose(back.normals, cloud.normals, atol=1e-6)


@pytest.mark.validation
@pytest.mark.skipif(not (which("CloudCompare") and which("xvfb-run")), reason="needs CloudCompare and xvfb-run")
@pytest.mark.parametrize("suffix", [".txt", ".xyz", ".csv", ".pts", ".asc"])
def test_cloudcompare_reads_what_is_written_and_is_read(tmp_path: Path, suffix: str) -> None:
    cloud = replace(full_cloud(), columns={"object": full_cloud().columns["object"]})
    if suffix == ".pts":
        cloud = replace(cloud, normals=None, columns={})
    encode = encode_pts if suffix == ".pts" else encode_text
    path = tmp_path / f"a{suffix}"
    path.write_bytes(encode(cloud, suffix))
    command = ["xvfb-run", "-a", "CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF", "-O", path]
    for options, name in ((("PLY",), "b.ply"), (("ASC", "-ADD_HEADER", "-ADD_PTS_COUNT"), "b.asc")):
        saved = ["-C_EXPORT_FMT", *options, "-SAVE_CLOUDS", "FILE", tmp_path / name]
        subprocess.run([*command, *saved], check=True, timeout=120, capture_output=True)
        found = pcgraph.read_cloud(tmp_path / name)
        assert np.allclose(found.points, cloud.points, atol=1e-5), name
        assert np.array_equal(found.colors, cloud.colors), name
        if suffix != ".pts":
            assert np.allclose(found.normals, cloud.normals, atol=3e-3), name  # it keeps 16 bits of a normal
            assert any(np.array_equal(column, cloud.columns["object"]) for column in found.columns.values()), name


@pytest.mark.validation
@pytest.mark.skipif(not (which("CloudCompare") and which("xvfb-run")), reason="needs CloudCompare and xvfb-run")
def test_cloudcompare_reads_the_same_points_of_ptx_files(tmp_path: Path) -> None:
    """The matrix, the common frame and the holes."""
    rng = np.random.default_rng(1)
    texts = []
    for _ in range(2):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.linalg.det(rotation)
        place = rng.normal(size=3).round(3)
        lines = ["5", "4", " ".join(map(repr, place.tolist()))]
        lines += [" ".join(map(repr, row)) for row in rotation.tolist()]
        lines += [" ".join(map(repr, [*row, 0.0])) for row in rotation.tolist()]
        lines += [" ".join(map(repr, [*place.tolist(), 1.0]))]
        rows = np.column_stack([rng.normal(size=(20, 3)) * 5, rng.random(20)]).round(4)
        rows[3, :3] = 0
        texts.append("\n".join([*lines, *(" ".join(map(repr, row)) for row in rows.tolist())]) + "\n")
    (tmp_path / "a.ptx").write_text("".join(texts))
    command = ["xvfb-run", "-a", "CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF", "-O", "a.ptx"]
    command += ["-C_EXPORT_FMT", "ASC", "-PREC", "7", "-NO_TIMESTAMP", "-SAVE_CLOUDS"]
    subprocess.run(command, check=True, timeout=120, capture_output=True, cwd=tmp_path)
    names = ["x", "y", "z", "intensity"]
    theirs = np.concatenate(
        [pcgraph.read_cloud(tmp_path / name, columns=names).points for name in ("a_0.asc", "a_1.asc")]
    )
    ours = pcgraph.read_cloud(tmp_path / "a.ptx").finite().points
    assert len(ours) == len(theirs) == 38
    assert np.allclose(ours[np.lexsort(ours.T)], theirs[np.lexsort(theirs.T)], atol=1e-4)


def test_truth_values_and_errors_of_spreadsheets() -> None:
    cloud = read('x,y,z,ok,v\n1,2,3,True,#N/A\n4,5,6,"FALSE",<NA>\n7,8,9,true,2.5\n')
    assert cloud.columns["ok"].tolist() == [1, 0, 1]
    assert np.array_equal(cloud.columns["v"], [np.nan, np.nan, 2.5], equal_nan=True)
