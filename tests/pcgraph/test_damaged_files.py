# SPDX-License-Identifier: Apache-2.0
"""Files of any fields, parts of files, and files that lie: a cloud whose arrays agree, or one sentence; soon.

Mutated ones are the business of tests/fuzz.
"""

from __future__ import annotations

import re
import time
import tracemalloc

import numpy as np
import pytest
from checks import SEEDS
from fuzz.cloud_files import CODES, CORPUS, ORDERS, fields_of, lies, pcd, ply
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import pcgraph
from pcgraph.cli import app
from pcgraph.errors import CloudReadError
from pcgraph.io.pcd import read_pcd
from pcgraph.io.ply import read_ply

pytestmark = pytest.mark.filterwarnings("ignore::pcgraph.plausibility.CloudWarning")  # any cloud, sane or not

READERS = {"pcd": read_pcd, "ply": read_ply}
FILES = {name: (READERS[name[:3]], content) for name, content in CORPUS.items()}


# --- the law ----------------------------------------------------------------------------------------------------------


def read_or_refused(reader, content):
    """The cloud or None; fails on anything that is neither a cloud whose arrays agree nor one sentence."""
    start = time.process_time()
    try:
        cloud = reader(bytes(content))
    except CloudReadError as error:
        message = str(error)
        assert message
        assert len(message.splitlines()) == 1
        cloud = None
    assert time.process_time() - start < 2.0
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
    reader, whole = FILES[name]
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
@given(seed=SEEDS, n=st.integers(0, 9), code=st.sampled_from(CODES), height=st.integers(0, 3))
def test_pcd_of_any_fields_comes_back(seed, n, code, height):
    fields = fields_of(np.random.default_rng(seed), n * height)
    check_fields(read_or_refused(read_pcd, pcd(code, fields, n, height)), fields, (n,) if height == 1 else (height, n))


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, n=st.integers(0, 9), code=st.sampled_from(sorted(ORDERS)))
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


@pytest.mark.parametrize("name", [name for name in CORPUS if "pcd" in name or name.startswith("ply ")])
def test_line_ends_of_windows_and_comments(name):
    reader, whole = FILES[name]
    end = re.search(rb"\n(DATA .*|end_header)\n", whole).end()
    plain = read_or_refused(reader, whole)
    comment = b"\n# caf\xc3\xa9 \xff\n" if "pcd" in name else b"\ncomment caf\xc3\xa9 \xff\n"
    header = whole[:end].replace(b"\n", b"\r\n")
    lines = whole[:end].replace(b"\n", comment, 1)
    for content in (header + whole[end:], lines + whole[end:]):
        other = read_or_refused(reader, content)
        assert np.array_equal(plain.points, other.points, equal_nan=True)


# --- lies -------------------------------------------------------------------------------------------------------------

LIES = list(lies())


def test_lies_are_refused_or_read_soon_and_in_little_memory():
    read_or_refused(*FILES["pcd binary_compressed"])  # compiled before memory is watched
    for name, content in LIES:
        tracemalloc.start()
        try:
            read_or_refused(READERS[name[:3]], content)
            peak = tracemalloc.get_traced_memory()[1]
        except Exception as error:
            raise AssertionError(f"{name}: {error!r}") from error
        finally:
            tracemalloc.stop()
        assert peak < 40 * len(content) + 200_000, name


def test_the_command_refuses_damaged_files_in_one_line(tmp_path):
    broken = {name: whole[: len(whole) * 2 // 3] for name, whole in CORPUS.items()}
    broken |= {name: content for name, content in LIES if name.endswith(("9 x 1", "bomb", "none", "empty", "zeros"))}
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
@given(seed=SEEDS, n=st.integers(1, 60), dtype=st.sampled_from(["f4", "f8"]), image=st.booleans())
def test_segmentations_come_back(seed, n, dtype, image, tmp_path_factory):
    rng = np.random.default_rng(seed)
    points = (rng.random((n, 3)) * 10.0 ** rng.integers(-6, 6) + 1.0).astype(dtype)
    points[1:][rng.random(n - 1) < 0.3] = np.nan
    points = points.reshape(n, 1, 3) if image else points
    result, folder = pcgraph.segment(points), tmp_path_factory.mktemp("back")
    for name in ("a.ply", "a.npz", "a.pcd", "a.npy"):
        pcgraph.write_segmentation(folder / name, pcgraph.Cloud(points), result)
        seen = result.labels >= 0 if name == "a.ply" else ...
        read = pcgraph.read_cloud(folder / name)
        assert read.points.dtype == points.dtype
        assert np.array_equal(read.points, points[seen].reshape(read.points.shape), equal_nan=True)
        for column, values in (("object", result.labels), ("supervoxel", result.supervoxels)):
            assert np.array_equal(read.columns[column].ravel(), values[seen].ravel())
