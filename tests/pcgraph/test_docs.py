# SPDX-License-Identifier: Apache-2.0
"""The snippets of pcgraph's documents run as they stand, on an image of a box on a table with true labels."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scenes.rays import camera, to_plane

import pcgraph
from pcgraph.metrics import level_curves

DOCS = Path(__file__).resolve().parents[2] / "docs"
HEADER = """VERSION 0.7
FIELDS x y z rgb label intensity
SIZE 4 4 4 4 4 2
TYPE F F F U U U
COUNT 1 1 1 1 1 1
WIDTH 80
HEIGHT 60
VIEWPOINT 0 0 0 1 0 0 0
POINTS 4800
DATA ascii
"""


def table_with_a_box() -> str:
    """PCD of 80 x 60 pixels: table 1 m below and before a level camera, a box on it, nothing above the horizon."""
    directions = camera((np.arange(80) - 39.5) / 60, (np.arange(60) - 9.5) / 60)
    to_table = np.where(directions[..., 1] > 0.2, to_plane(directions, (0, 1, 0), 1.0), np.inf)
    to_front = np.full((60, 80), 2.0)
    front = directions * to_front[..., None]
    hit = (abs(front[..., 0]) < 0.4) & (front[..., 1] < 1.0) & (front[..., 1] > 0.6) & (to_front < to_table)
    points = directions * np.where(hit, to_front, to_table)[..., None]
    points[~np.isfinite(points).all(axis=-1)] = np.nan
    labels = np.where(np.isnan(points[..., 0]), 0, np.where(hit, 20, 1)).ravel()
    shades = np.where(hit, 0xC05020, 0x808890).ravel()
    lines = (
        f"{x:.6g} {y:.6g} {z:.6g} {shade} {label} {900 + 40 * label}"
        for (x, y, z), shade, label in zip(points.reshape(-1, 3), shades, labels, strict=True)
    )
    return HEADER + "\n".join(lines) + "\n"


@pytest.mark.parametrize("name", ["pcgraph", "files", "recipes", "tree", "detection", "learning", "metrics"])
def test_snippets_run(name, tmp_path, monkeypatch):
    (tmp_path / "scan.pcd").write_text(table_with_a_box())
    monkeypatch.chdir(tmp_path)
    cloud = pcgraph.read_cloud("scan.pcd")
    given = {"points": cloud.points, "colors": cloud.colors, "more_points": cloud.points, "more_colors": cloud.colors}
    names = {**given, "np": np, "pcgraph": pcgraph}
    snippets = re.findall(r"```python\n(.*?)```", (DOCS / f"{name}.md").read_text(), re.DOTALL)
    assert snippets
    monkeypatch.setattr(level_curves, "LEVEL_SCORES", {**level_curves.LEVEL_SCORES})  # snippets add to them
    for snippet in snippets:
        exec(compile(snippet, f"{name}.md", "exec"), names)
