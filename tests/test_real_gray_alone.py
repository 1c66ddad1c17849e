# SPDX-License-Identifier: Apache-2.0
"""Real Gray code without inverses: slstudio's skull, and a wall in JPEG without white and black."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesim.capture import Capture
from rangesim.codes import GrayCode
from rangesim.decoding import decode
from rangesim.files.image_files import read_stack
from rangesim.results.captures import import_capture
from rangesim.sensors import StructuredLight

SKULL = StructuredLight(1824, 1140, GrayCode(2), order=("white", "black", "columns_bit?"))
WALL = StructuredLight(
    1024,
    768,
    GrayCode(2),
    ("rows", "columns"),
    order=tuple(f"{axis}_bit{bit}" for bit in reversed(range(9)) for axis in ("rows", "columns")),
)


@pytest.mark.validation
def test_the_skull_agrees_with_its_authors_points(real_data: Path) -> None:
    """Their points, seen by their projector, lie where we decode them; pixel centres are integers there.

    A cell has two pixels, and their points lie on edges between cells: half of them within a pixel, all but 2 % in 4.
    """
    folder = real_data / "captures" / "slstudio_skull_gray"
    frames = np.stack([read_stack([path])[0] for path in sorted(folder.glob("frameSeq_*.png"))])
    image = decode(Capture(frames, SKULL))
    assert image.projector_column is not None
    points = np.load(folder / "authors_points.npz")["points"]
    points = points[np.isfinite(points[..., 2]) & (points[..., 2] != 0)].astype(np.float64)
    rotation = np.array(
        [
            [0.964402318, -0.120346159, 0.235467508],
            [0.153437316, 0.979882836, -0.127619177],
            [-0.215372086, 0.159205735, 0.963466883],
        ]
    )
    seen = _pixels(points, 2195.12036, (843.5, 675.5), -0.0580352657)
    lit = _pixels(
        points @ rotation.T + (-145.282562, -36.4983406, 67.9231644), 2601.52563, (866.541504, 1109.11121), -0.03149
    )
    x, y = np.rint(seen).astype(int).T
    off = lit[:, 0] - (image.projector_column[y, x] - 0.5)
    off = off[np.isfinite(off)]
    assert len(off) > 60_000
    assert abs(np.median(off)) < 0.1
    assert (np.abs(off) < 1).mean() > 0.5
    assert (np.abs(off) < 4).mean() > 0.98


def _pixels(points: np.ndarray, f: float, centre: tuple[float, float], k1: float) -> np.ndarray:
    """(n, 2) pixels of points (n, 3) in a camera's frame."""
    x = points[:, :2] / points[:, 2:]
    return np.asarray(f * x * (1 + k1 * (x**2).sum(axis=1, keepdims=True)) + centre)


def test_a_wall_without_white_and_black_comes_out_even(real_data: Path) -> None:
    """Also silent: warnings are errors in these tests, and the finest bit is finer than the camera resolves."""
    image = decode(import_capture(real_data / "captures" / "gray_jpeg", WALL))
    for coordinate, steps in ((image.projector_column, (0, 1)), (image.projector_row, (1, 0))):
        assert coordinate is not None
        wall = coordinate[70:110, 160:480]
        assert np.isfinite(wall).mean() > 0.8
        along = np.diff(wall, axis=1 - steps[0])
        assert np.nanpercentile(np.abs(along), 99) <= 12  # measured: 10
