# SPDX-License-Identifier: Apache-2.0
"""Damaged, lying and absurd files: a cloud whose arrays agree, or one sentence; soon, and in little memory."""

from __future__ import annotations

import re
import struct
import subprocess
import sys
import time
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import pcgraph
from pcgraph.cli import app
from pcgraph.errors import CloudReadError
from pcgraph.io.pcd import read_pcd
from pcgraph.io.ply import encode_ply, read_ply

CODES = ("ascii", "binary", "binary_compressed")
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
KINDS = {"F": "f", "I": "i", "U": "u"}
PLY_TYPES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"}
PLY_TYPES |= {"f4": "float", "f8": "double"}


# --- files by hand ----------------------------------------------------------------------------------------------------


def text_of(number) -> str:
    return repr(number.item()) if number.dtype.kind == "f" else str(number)


def lzf(plain: bytes) -> bytes:
    """LZF stream of literals, and of copies where the last 8 bytes repeat."""
    stream, at = b"", 0
    while at < len(plain):
        if at >= 8 and plain[at : at + 8] == plain[at - 8 : at]:
            stream, at = stream + bytes([6 << 5, 7]), at + 8
        else:
            piece = plain[at : at + 8]
            stream, at = stream + bytes([len(piece) - 1]) + piece, at + len(piece)
    return stream


def pcd(code: str, fields, width: int, height: int) -> bytes:
    """PCD file of fields (name, dtype, (n, count) array)."""
    words = {
        "FIELDS": [name for name, _, _ in fields],
        "SIZE": [dtype[1] for _, dtype, _ in fields],
        "TYPE": [dtype[0].upper() for _, dtype, _ in fields],
        "COUNT": [str(values.shape[1]) for _, _, values in fields],
        "WIDTH": [str(width)],
        "HEIGHT": [str(height)],
        "VIEWPOINT": ["1 2 3 1 0 0 0"],
        "POINTS": [str(width * height)],
        "DATA": [code],
    }
    header = "# made by hand\nVERSION 0.7\n" + "".join(f"{key} {' '.join(value)}\n" for key, value in words.items())
    columns = [values.astype("<" + dtype) for _, dtype, values in fields]
    if code == "ascii":
        rows = [" ".join(text_of(number) for column in columns for number in column[i]) for i in range(width * height)]
        return header.encode() + "\n".join(rows).encode() + b"\n"
    if code == "binary":
        return header.encode() + b"".join(column[i].tobytes() for i in range(width * height) for column in columns)
    plain = b"".join(column.tobytes() for column in columns)
    stream = lzf(plain)
    return header.encode() + struct.pack("<II", len(stream), len(plain)) + stream


def ply(code: str, fields, n: int) -> bytes:
    """PLY file of fields (name, dtype, (n, 1) array), with an element before the vertices and faces behind."""
    order = ORDERS[code]
    lines = ["ply", f"format {code} 1.0", "comment end_header comes later", "element camera 1", "property short id"]
    lines += [f"element vertex {n}", *(f"property {PLY_TYPES[dtype]} {name}" for name, dtype, _ in fields)]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    columns = [values.astype(order + dtype)[:, 0] for _, dtype, values in fields]
    if code == "ascii":
        rows = ["7", *(" ".join(text_of(column[i]) for column in columns) for i in range(n)), "3 0 1 2", ""]
        return "\n".join(lines[:-1] + rows).encode()
    body = b"".join(column[i : i + 1].tobytes() for i in range(n) for column in columns)
    face = struct.pack(order + "Biii", 3, 0, 1, 2)
    return "\n".join(lines).encode() + struct.pack(order + "h", 7) + body + face


def fields_of(rng, n, counts=True):
    """Fields x y z with others before, between and behind, of all types."""
    names = ["x", "y", "z", *rng.permutation(["label", "rgb", "nx", "ny", "nz", "red", "green", "blue", "t"])[:4]]
    fields = []
    for name in rng.permutation(names).tolist():
        kinds = ["f4", "f8", "i2", "u1", "i4"] if name in "xyz" or name[0] == "n" else ["u4", "i4", "f4", "u1"]
        dtype = "u4" if name == "rgb" else str(rng.choice(kinds))
        values = rng.integers(0, 100, (n, int(rng.integers(1, 4)) if counts and name == "t" else 1)).astype(float)
        if dtype[0] == "f" and len(values):
            values[rng.integers(0, n)] = rng.choice([np.nan, np.inf, -np.inf, 1e-30, 0.1])
        fields.append((name, dtype, values))
    return fields


def corpus():
    """Valid files by name, with their readers."""
    rng = np.random.default_rng(3)
    files = {}
    for code in CODES:
        files[f"pcd {code}"] = read_pcd, pcd(code, fields_of(rng, 6), 3, 2)
    for code in ORDERS:
        files[f"ply {code}"] = read_ply, ply(code, fields_of(rng, 5, counts=False), 5)
    points = rng.random((20, 3))
    columns = {name: points[:, i] for i, name in enumerate("xyz")}
    files["ply of our own"] = read_ply, encode_ply(columns | {"labels": np.arange(20, dtype=np.int32)})
    return files


CORPUS = corpus()
READERS = {"pcd": read_pcd, "ply": read_ply}


# --- the law ----------------------------------------------------------------------------------------------------------


def read_or_refused(reader, content):
    """The cloud or None; fails on anything that is neither a cloud whose arrays agree nor one sentence."""
    start = time.perf_counter()
    try:
        cloud = reader(bytes(content))
    except CloudReadError as error:
        message = str(error)
        assert message
        assert len(message.splitlines()) == 1
        cloud = None
    assert time.perf_counter() - start < 2.0
    if cloud is None:
        return None
    shape = cloud.points.shape[:-1]
    assert cloud.points.dtype in (np.float32, np.float64)
    assert cloud.points.shape == (*shape, 3)
    assert len(shape) in (1, 2)
    if cloud.colors is not None:
        assert cloud.colors.dtype == np.uint8
        assert cloud.colors.shape == (*shape, 3)
    if cloud.normals is not None:
        assert cloud.normals.shape == (*shape, 3)
    if cloud.labels is not None:
        assert cloud.labels.dtype == np.int32
        assert cloud.labels.shape == shape
    if cloud.viewpoint is not None:
        assert np.isfinite(cloud.viewpoint).all()
    return cloud


@pytest.mark.parametrize("name", CORPUS)
def test_no_part_of_a_file_is_taken_for_the_whole(name):
    reader, whole = CORPUS[name]
    expected = read_or_refused(reader, whole)
    assert expected is not None
    shape = expected.points.shape
    least = len(whole)
    for length in range(len(whole)):
        cloud = read_or_refused(reader, whole[:length])
        if cloud is not None:  # what is missing lies behind the points, or it is digits of the last number
            assert cloud.points.shape == shape
            least = min(least, length)
    # Before the last point's last number nothing is accepted; faces behind it need not be there.
    tail = {"pcd ascii": 20, "ply ascii": 30}.get(name, 13 if name.startswith("ply b") else 0)
    assert least >= len(whole) - tail


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 9), code=st.sampled_from(CODES), height=st.integers(0, 3))
def test_pcd_of_any_fields_comes_back(seed, n, code, height):
    fields = fields_of(np.random.default_rng(seed), n * height)
    check_fields(read_or_refused(read_pcd, pcd(code, fields, n, height)), fields, (n,) if height == 1 else (height, n))


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 9), code=st.sampled_from(sorted(ORDERS)))
def test_ply_of_any_fields_comes_back(seed, n, code):
    fields = fields_of(np.random.default_rng(seed), n, counts=False)
    check_fields(read_or_refused(read_ply, ply(code, fields, n)), fields, (n,))


def check_fields(cloud, fields, shape):
    stored = {name: values[:, 0].astype(dtype) for name, dtype, values in fields}
    if shape[0] == 0 and len(shape) == 1:
        shape = cloud.points.shape[:-1]
    assert cloud.points.shape == (*shape, 3)
    for axis, name in enumerate("xyz"):
        assert np.array_equal(cloud.points[..., axis].ravel(), stored[name], equal_nan=True)
    if "label" in stored and stored["label"].dtype.kind in "iu":
        assert np.array_equal(cloud.labels.ravel(), stored["label"])
    if "rgb" in stored:
        assert np.array_equal(cloud.colors.reshape(-1, 3)[:, 2], stored["rgb"] % 256)
    if {"nx", "ny", "nz"} <= set(stored):
        assert np.array_equal(cloud.normals[..., 1].ravel(), stored["ny"], equal_nan=True)


HOSTILE = [
    "0", "-1", "1", "2", "3", "4096", "4097", "999999999", str(2**31), str(2**32), str(2**40), str(10**12),
    str(10**15), str(2**63), str(2**64), "9" * 400, "9" * 4290, "9" * 4299, "9" * 4300, "9" * 5000, "1e3", "1_0",
    "0x10", "nan", "inf", "-0", "+2", "", "\x00", "\xff\xfe", "²", "F", "I", "U", "x", "y", "z", "rgb", "label",
    "list", "uchar", "int", "float", "double", "vertex", "face", "element", "property", "end_header", "ascii",
    "binary", "binary_compressed", "binary_big_endian", "DATA", "WIDTH", "COUNT", "#", "comment", "\r", "\n",
    "a" * 70000,
]  # fmt: skip
readers_and_files = st.sampled_from(sorted(CORPUS)).map(CORPUS.get)


@settings(max_examples=250, deadline=None)
@given(file=readers_and_files, data=st.data())
def test_headers_with_words_swapped_lost_doubled_and_made_up(file, data):
    reader, whole = file
    end = re.search(rb"\n(DATA .*|end_header)\n", whole).end()
    words = re.split(rb"([ \n])", whole[:end])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(words) - 1))
        change = data.draw(st.sampled_from(["replace", "lose", "double", "swap", "insert"]))
        word = data.draw(st.sampled_from(HOSTILE)).encode("utf-8")
        other = data.draw(st.integers(0, len(words) - 1))
        if change == "replace":
            words[at] = word
        elif change == "lose" and len(words) > 1:
            del words[at]
        elif change == "double":
            words[at] = words[at] + b" " + words[at]
        elif change == "insert":
            words.insert(at, b"\n" + word + b" ")
        elif other < len(words) and at < len(words):
            words[at], words[other] = words[other], words[at]
    read_or_refused(reader, b"".join(words) + whole[end:])


@settings(max_examples=250, deadline=None)
@given(file=readers_and_files, data=st.data())
def test_bytes_flipped_lost_and_inserted(file, data):
    reader, whole = file
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 8))):
        at = data.draw(st.integers(0, len(damaged)))
        change = data.draw(st.sampled_from(["flip", "lose", "insert", "numbers"]))
        if change == "flip" and at < len(damaged):
            damaged[at] ^= 1 << data.draw(st.integers(0, 7))
        elif change == "lose":
            del damaged[at : at + data.draw(st.integers(1, 9))]
        elif change == "insert":
            damaged[at:at] = data.draw(st.binary(min_size=1, max_size=9))
        else:
            odd = [
                b"nan",
                b"-inf",
                b"1e999",
                b"1e-999",
                b"0x1",
                b"1,5",
                b"--1",
                b"1e",
                b"\xff\xff\x80\x7f",
                b"\x00" * 8,
            ]
            damaged[at : at + 3] = data.draw(st.sampled_from(odd))
    read_or_refused(reader, damaged)


@settings(max_examples=100, deadline=None)
@given(content=st.binary(max_size=300), kind=st.sampled_from(["pcd", "ply"]), header=st.booleans())
def test_noise(content, kind, header):
    start = {"pcd": b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nDATA ", "ply": b"ply\nformat "}[kind]
    read_or_refused(READERS[kind], (start if header else b"") + content)


@pytest.mark.parametrize("name", [name for name in CORPUS if "pcd" in name or name.startswith("ply ")])
def test_line_ends_of_windows_and_comments(name):
    reader, whole = CORPUS[name]
    end = re.search(rb"\n(DATA .*|end_header)\n", whole).end()
    plain = read_or_refused(reader, whole)
    comment = b"\n# caf\xc3\xa9 \xff\n" if "pcd" in name else b"\ncomment caf\xc3\xa9 \xff\n"
    header = whole[:end].replace(b"\n", b"\r\n")
    lines = whole[:end].replace(b"\n", comment, 1)
    for content in (header + whole[end:], lines + whole[end:]):
        other = read_or_refused(reader, content)
        assert np.array_equal(plain.points, other.points, equal_nan=True)


# --- lies -------------------------------------------------------------------------------------------------------------

XYZ = [(name, "f4", np.arange(4.0)[:, None]) for name in "xyz"]


def lies():
    """Names of files that promise more than they hold, with reader and content."""
    many = ("9" * 4290, "9" * 5000, str(10**18), str(10**15), str(10**12), "2147483648", "-4", "4.0", "four", "")
    for code in CODES:
        whole = pcd(code, XYZ, 4, 1)
        for number in many:
            for width, height in ((number, "1"), ("1", number), (number, number), (number, "0"), ("0", number)):
                lie = whole.replace(b"WIDTH 4", b"WIDTH " + width.encode())
                lie = lie.replace(b"HEIGHT 1", b"HEIGHT " + height.encode()).replace(b"POINTS 4\n", b"")
                yield f"pcd {code} {width[:20]} x {height[:20]}", read_pcd, lie
        for number in (*many, "4097", "0"):
            yield f"pcd {code} count {number[:20]}", read_pcd, whole.replace(b"COUNT 1", b"COUNT " + number.encode())
    for code in ORDERS:
        whole = ply(code, XYZ, 4)
        for number in many:
            for element in (b"vertex 4", b"camera 1"):
                lie = whole.replace(element, element[:7] + number.encode())
                yield f"ply {code} {element[:6].decode()} {number[:20]}", read_ply, lie
    sizes = pcd("binary_compressed", XYZ, 4, 1)
    at = sizes.index(b"compressed\n") + 11
    for packed in (0, 1, 8, 2**31, 2**32 - 1):
        for unpacked in (0, 47, 48, 49, 2**31, 2**32 - 1):
            content = sizes[:at] + struct.pack("<II", packed, unpacked) + sizes[at + 8 :]
            yield f"pcd sizes {packed} {unpacked}", read_pcd, content
    bomb = sizes[:at].replace(b"WIDTH 4", b"WIDTH 300000000").replace(b"POINTS 4\n", b"")
    yield "pcd bomb", read_pcd, bomb + struct.pack("<II", 1000, 3_600_000_000) + b"\x00a" + b"\xe0\xff\x00" * 300
    text = pcd("ascii", XYZ, 4, 1)
    start = text.index(b"ascii\n") + 6
    wide = text[:start].replace(b"WIDTH 4", b"WIDTH 100000").replace(b"POINTS 4\n", b"")
    yield "pcd one gigantic word", read_pcd, wide + b"1 " * 299_999 + b"1" * 1_000_000
    yield "pcd one gigantic line", read_pcd, wide + b"1 " * 300_000 + b"x" * 1_000_000
    yield "pcd a gigantic word that is none", read_pcd, wide + b"1 " * 299_999 + b"x" * 1_000_000
    yield "pcd gigantic header line", read_pcd, text.replace(b"VERSION 0.7", b"VERSION " + b"7" * 1_000_000)
    fields = " ".join(f"f{i}" for i in range(5000))
    yield "pcd many fields", read_pcd, text.replace(b"FIELDS x y z", b"FIELDS x y z " + fields.encode())
    plywood = ply("ascii", XYZ, 4)
    yield "ply gigantic comment", read_ply, plywood.replace(b"comment", b"comment " + b"c" * 1_000_000)
    yield "ply no end", read_ply, plywood.replace(b"end_header\n", b"")
    yield "ply lists first", read_ply, plywood.replace(b"property float y", b"property list int float y")
    yield "ply twice", read_ply, plywood.replace(b"float y", b"float x")
    yield "ply types", read_ply, plywood.replace(b"float y", b"float128 y")
    yield "ply empty", read_ply, b""
    yield "pcd empty", read_pcd, b""
    yield "pcd zeros", read_pcd, bytes(100_000)


LIES = list(lies())


def test_lies_are_refused_or_read_soon_and_in_little_memory():
    read_or_refused(*CORPUS["pcd binary_compressed"])  # compiled before memory is watched
    for name, reader, content in LIES:
        tracemalloc.start()
        try:
            read_or_refused(reader, content)
            peak = tracemalloc.get_traced_memory()[1]
        except Exception as error:
            raise AssertionError(f"{name}: {error!r}") from error
        finally:
            tracemalloc.stop()
        assert peak < 40 * len(content) + 200_000, name


def test_every_lie_is_refused_where_memory_is_short(tmp_path):
    resource = pytest.importorskip("resource")
    paths = []
    for number, (name, _, content) in enumerate(LIES):
        paths.append(tmp_path / f"{number}.{name[:3]}")
        paths[-1].write_bytes(content)
    code = (
        "import resource, sys, pcgraph\n"
        "from pcgraph.io import read_cloud\n"
        "size = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (size + 2**29,) * 2)\n"
        "for path in sys.argv[1:]:\n"
        "    try:\n"
        "        read_cloud(path)\n"
        "    except pcgraph.CloudReadError as error:\n"
        "        assert path in str(error)\n"
        "print('done')\n"
    )
    if sys.platform != "linux" or not resource.getpagesize():
        pytest.skip("the size of a process is read from /proc")
    command = [sys.executable, "-W", "error", "-c", code, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout == "done\n", done.stderr[-2000:]


def test_the_command_refuses_damaged_files_in_one_line(tmp_path):
    broken = {name: whole[: len(whole) * 2 // 3] for name, (_, whole) in CORPUS.items()}
    broken |= {name: content for name, _, content in LIES if name.endswith(("9 x 1", "bomb", "none", "empty", "zeros"))}
    for number, (name, content) in enumerate(broken.items()):
        path = tmp_path / f"{number}.{name[:3]}"
        path.write_bytes(content)
        done = CliRunner().invoke(app, ["segment", str(path), "--out", str(tmp_path / "out.ply")])
        assert done.exit_code == 1, name
        assert done.stdout == ""
        assert done.stderr.startswith("pcgraph: ")
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out.ply").exists()


# --- there and back ---------------------------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 60), dtype=st.sampled_from(["f4", "f8"]), image=st.booleans())
def test_segmentations_come_back(seed, n, dtype, image, tmp_path_factory):
    rng = np.random.default_rng(seed)
    points = (rng.random((n, 3)) * 10.0 ** rng.integers(-6, 6) + 1.0).astype(dtype)
    points[1:][rng.random(n - 1) < 0.3] = np.nan
    points = points.reshape(n, 1, 3) if image else points
    result, folder = pcgraph.segment(points), tmp_path_factory.mktemp("back")
    for name in ("a.ply", "a.npz"):
        pcgraph.write_segmentation(folder / name, pcgraph.Cloud(points), result)
    finite = result.labels >= 0
    read = pcgraph.read_cloud(folder / "a.ply")
    assert read.points.dtype == points.dtype
    assert np.array_equal(read.points, points[finite])
    assert np.array_equal(read.labels, result.labels[finite])
    with np.load(folder / "a.npz") as arrays:
        assert np.array_equal(arrays["labels"], result.labels)
        assert np.array_equal(arrays["supervoxels"], result.supervoxels)
        assert np.array_equal(arrays["tree_altitudes"], result.tree.altitudes)
