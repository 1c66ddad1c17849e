# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks of pcgraph stand on: the synthetic rooms, and the drivers of the libraries compared with."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest
import room
from clouds import two_boxes_on_a_plane
from peers import PclSetting, run_lin, run_pcl
from scipy.spatial import cKDTree

PLAIN = PclSetting(0.01, 0.06, color=0.0, spatial=0.4, normal=1.0, camera=False)


def test_rooms_have_exactly_the_points_asked_for_and_are_as_dense_when_there_are_more(monkeypatch):
    monkeypatch.setattr(room, "CELLS", 2)  # of furniture: a fourth of what takes most of the points
    monkeypatch.setattr(room, "SIDE_M", 2.5)
    widths = []
    for n in (1, 50_000, 500_000):
        points, colors = room.rooms(n)
        assert points.shape == colors.shape == (n, 3)
        assert np.isfinite(points).all()
        assert all(np.array_equal(a, b) for a, b in zip(room.rooms(n), (points, colors), strict=True))
        widths.append(points[:, 0].max())
        if n > 1:
            distance = cKDTree(points).query(points[:: n // 4000], k=2)[0][:, 1]
            assert 0.6 * room.SPACING_M < np.median(distance) < room.SPACING_M
    assert widths[-1] > room.SIDE_M > widths[-2]  # a second room


def _corner(concave: bool) -> np.ndarray:
    """Two square walls that meet at a right angle, (64, 64, 3) metres, seen from the origin, one point not finite."""
    s = np.linspace(-0.2, 0.2, 64)
    x, y = np.meshgrid(s, s)
    points = np.stack([x, y, 1.0 - np.abs(x) if concave else 1.0 + np.abs(x)], axis=-1).astype(np.float32)
    points[0, 0] = np.nan
    return points


def _pcl_is_here() -> bool:
    if any(shutil.which(tool) is None for tool in ("cmake", "pkg-config", "c++")):
        return False
    return subprocess.run(["pkg-config", "--exists", "pcl_segmentation"], check=False).returncode == 0


@pytest.mark.skipif(not _pcl_is_here(), reason="PCL (libpcl-dev) is not here")
@pytest.mark.parametrize(("concave", "segments"), [(True, 2), (False, 1)])
def test_lccp_of_pcl_parts_walls_only_at_a_concave_edge(concave, segments):
    points = _corner(concave)
    colors = np.full(points.shape, 128, np.uint8)
    found = run_pcl(points, colors, PLAIN, repeats=2)
    assert found.supervoxels[0, 0] == found.segments[0, 0] == -1
    assert (found.supervoxels.ravel()[1:] >= 0).all()
    inner = np.abs(points[..., 0]) > 0.05  # PCL's supervoxels may straddle the edge
    assert len(np.unique(found.segments[inner & (found.segments > 0)])) == segments
    assert len(found.vccs_s) == len(found.lccp_s) == 2
    assert (found.vccs_s > 0.0).all()


def test_lin_gives_as_many_supervoxels_as_cubes_are_occupied():
    pytest.importorskip("py4dgeo")
    points = two_boxes_on_a_plane()[0].astype(np.float32)
    labels, seconds = run_lin(points.reshape(1, -1, 3), 0.1)
    cubes = np.unique(np.floor((points - points.min(axis=0)) / 0.1), axis=0)
    assert seconds > 0.0
    assert labels.min() == 0
    assert len(np.unique(labels)) == pytest.approx(len(cubes), rel=0.1)  # they count cubes of voxels' means
