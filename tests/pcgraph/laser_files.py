# SPDX-License-Identifier: Apache-2.0
"""Clouds for tests of the formats of laser scanners: any columns, and comparing all of them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pcgraph.cloud import Cloud

TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
NAMES = (
    "intensity",
    "classification",
    "gps_time",
    "user_data",
    "timeStamp",
    "rowIndex",
    "ring",
    "nir",
    "x y",
    "xyz",
    "array",
    "größe",
)
LONG_NAMES = tuple(f"a name of more than thirty-two characters, number {i}" for i in range(2))


@st.composite
def clouds(draw: st.DrawFn, points: st.SearchStrategy[float], types: tuple[str, ...] = TYPES) -> Cloud:
    """Clouds of few points with any columns."""
    n = draw(st.integers(0, 5))
    names = draw(st.lists(st.sampled_from(NAMES + LONG_NAMES), unique=True, max_size=5))
    columns = {}
    for name in names:
        kind = np.dtype(draw(st.sampled_from(types)))
        shape = (n, *draw(st.sampled_from([(), (), (1,), (3,), (5,)])))
        elements = hnp.from_dtype(kind, max_value=2**63 - 1) if kind == "u8" else hnp.from_dtype(kind)
        columns[name] = draw(hnp.arrays(kind, shape, elements=elements))
    return Cloud(
        draw(hnp.arrays(np.float64, (n, 3), elements=points)),
        draw(st.none() | hnp.arrays(np.uint8, (n, 3))),
        draw(st.none() | hnp.arrays(np.float32, (n, 3), elements=st.floats(-1, 1, width=32))),
        draw(st.none() | hnp.arrays(np.int32, (n,))),
        draw(st.none() | hnp.arrays(np.float64, st.sampled_from([(3,), (n, 3)]), elements=st.integers(-9, 9))),
        columns,
    )


def assert_same(read: Cloud, written: Cloud, but: tuple[str, ...] = ()) -> None:
    """Assert that all of two clouds is the same, in the same types, but for what is named."""
    for name in ("points", "colors", "normals", "labels", "viewpoint"):
        one, other = getattr(read, name), getattr(written, name)
        if name not in but:
            assert (one is None) == (other is None), name
            assert one is None or (one.dtype == other.dtype and np.array_equal(one, other)), name
    assert set(read.columns) == set(written.columns)
    for name, column in written.columns.items():
        found = read.columns[name]
        assert (found.dtype, found.shape) == (column.dtype, column.shape), name
        assert np.array_equal(found, column, equal_nan=column.dtype.kind == "f"), name


def mixed_cloud(n: int = 50, seed: int = 0) -> Cloud:
    """A cloud with colours, normals, labels and columns of several types, in coordinates of a map."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(n, 3))
    return Cloud(
        rng.uniform(-20.0, 20.0, (n, 3)) + np.array([412345.0, 5654321.0, 123.0]),
        rng.integers(0, 256, (n, 3), np.uint8),
        (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        rng.integers(-1, 9, n, np.int32),
        None,
        {
            "intensity": rng.integers(0, 65536, n, np.uint16),
            "gps_time": rng.uniform(0.0, 1e9, n),
            "classification": rng.integers(0, 256, n, np.uint8),
            "ring": rng.integers(0, 128, n, np.uint16),
            "reflectivity": rng.random(n, np.float32),
            "descriptor": rng.normal(size=(n, 4)).astype(np.float32),
        },
    )


def as_cloudcompare_reads(path: Path) -> dict[str, np.ndarray]:
    """Columns of a file by the names that CloudCompare gives them; skips the test if CloudCompare cannot read it."""
    program, screen = shutil.which("CloudCompare"), shutil.which("xvfb-run")
    if program is None or screen is None:
        pytest.skip("CloudCompare or xvfb-run is not installed")
    out = path.with_suffix(".asc")
    command = [screen, "-a", program, "-SILENT", "-AUTO_SAVE", "OFF", "-O", "-GLOBAL_SHIFT", "AUTO", str(path)]
    command += ["-C_EXPORT_FMT", "ASC", "-PREC", "9", "-ADD_HEADER", "-SAVE_CLOUDS", "FILE", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    said = done.stdout + done.stderr
    if "unhandled file extension" in said:
        pytest.skip(f"CloudCompare is built without a plugin for {path.suffix}")
    assert out.exists(), said[-2000:]
    lines = out.read_text().splitlines()
    return dict(zip(lines[0].lstrip("/").split(), np.loadtxt(lines[1:], ndmin=2).T, strict=True))
