# SPDX-License-Identifier: Apache-2.0
"""The libraries that pcgraph is compared with: PCL's VCCS and LCCP, and Lin et al. 2018 as py4dgeo has it."""

from __future__ import annotations

import json
import logging
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

SOURCE = Path(__file__).resolve().parent / "pcl"
BUILD = Path(__file__).resolve().parent.parent / "build" / "pcl"  # git ignores it
LIN_VOXEL_M = 0.005
LIN_NEIGHBOURS = 15


@dataclass(frozen=True)
class PclSetting:
    """What PCL's VCCS is told: sizes in metres, its three importances, and its single camera transform."""

    voxel: float
    seed: float
    color: float
    spatial: float
    normal: float
    camera: bool

    def __str__(self) -> str:
        weights = f"{self.color:g}/{self.spatial:g}/{self.normal:g}"
        return f"{1e3 * self.voxel:g}/{1e3 * self.seed:g} mm {weights} {'camera' if self.camera else 'plain'}"


@dataclass(frozen=True)
class PclResult:
    """Labels and times of PCL.

    Attributes
    ----------
    supervoxels, segments : (h, w) int32
        Of VCCS and of LCCP (10 degrees, smoothness check on); 0 where PCL gave none, -1 where a point is not finite.
    vccs_s, vccs_cpu_s, lccp_s : (repeats,) float64, seconds
        Clock and processor time of VCCS (setters, setInputCloud, extract), clock time of LCCP with the adjacency.
    voxels : (repeats,) float64
        How many.
    """

    supervoxels: NDArray[np.int32]
    segments: NDArray[np.int32]
    vccs_s: NDArray[np.float64]
    vccs_cpu_s: NDArray[np.float64]
    lccp_s: NDArray[np.float64]
    voxels: NDArray[np.float64]


def pcl_driver() -> Path:
    """The program `pcl/pcl_supervoxels.cpp`, built if it is older than its source.

    Raises
    ------
    SystemExit
        CMake, pkg-config, a compiler or PCL is missing.
    """
    program = BUILD / "pcl_supervoxels"
    newest = max(path.stat().st_mtime for path in SOURCE.iterdir())
    if program.exists() and program.stat().st_mtime >= newest:
        return program
    missing = [tool for tool in ("cmake", "pkg-config", "c++") if shutil.which(tool) is None]
    if missing:
        raise SystemExit(f"{', '.join(missing)} not found: apt-get install cmake pkg-config g++ libpcl-dev")
    if subprocess.run(["pkg-config", "--exists", "pcl_segmentation"], check=False).returncode:
        raise SystemExit("PCL not found: apt-get install libpcl-dev (Debian, Ubuntu)")
    for command in (["cmake", "-S", str(SOURCE), "-B", str(BUILD)], ["cmake", "--build", str(BUILD)]):
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    return program


def run_pcl(points: NDArray[np.float32], colors: NDArray[np.uint8], setting: PclSetting, repeats: int = 1) -> PclResult:
    """PCL on one organised cloud, (h, w, 3) metres and (h, w, 3) uint8; a run that is not timed comes first."""
    height, width = points.shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "cloud"), Path(folder, "labels")
        size = np.array([width, height], np.uint32)
        source.write_bytes(size.tobytes() + points.astype(np.float32).tobytes() + colors.astype(np.uint8).tobytes())
        sizes = (setting.voxel, setting.seed, setting.color, setting.spatial, setting.normal)
        arguments = [source, target, *sizes, int(setting.camera), repeats]
        done = subprocess.run([pcl_driver(), *map(str, arguments)], check=True, capture_output=True, text=True)
        labels = np.fromfile(target, np.uint32).astype(np.int32).reshape(2, height, width)
    labels[:, ~np.isfinite(points).all(axis=-1)] = -1
    seconds = json.loads(done.stdout.splitlines()[-1])
    times = (np.array(seconds[name]) for name in ("vccs_s", "vccs_cpu_s", "lccp_s", "voxels"))
    return PclResult(labels[0], labels[1], *times)


def run_lin(points: NDArray[np.float32], resolution: float) -> tuple[NDArray[np.int32], float]:
    """Supervoxels of Lin et al. 2018 by py4dgeo (1.2): labels (h, w) int32, -1 where not finite, and seconds.

    The cloud (h, w, 3), metres, is voxelised at 5 mm (mean of a voxel's points); normals come from 15 neighbours and
    so does their graph. Time counts normals, py4dgeo's k-d tree and the segmentation, not the voxelisation.
    `resolution`, metres, sets the number of supervoxels: that of the occupied cubes of this size.
    """
    import _py4dgeo
    import py4dgeo

    logging.getLogger("py4dgeo").setLevel(logging.ERROR)  # its progress would go to stdout and to a file beside us
    finite = np.isfinite(points).all(axis=-1)
    found = points[finite].astype(np.float64)
    cells = np.floor(found / LIN_VOXEL_M).astype(np.int64)
    _, voxel_of_point = np.unique(cells, axis=0, return_inverse=True)
    voxel_of_point = voxel_of_point.ravel()
    counts = np.bincount(voxel_of_point)
    voxels = np.stack([np.bincount(voxel_of_point, found[:, k]) / counts for k in range(3)], axis=1)
    start = time.perf_counter()
    normals = _normals(voxels)
    epoch = py4dgeo.Epoch(np.ascontiguousarray(voxels))
    epoch.build_kdtree()
    groups = _py4dgeo.segment_pc_in_supervoxels(epoch, epoch.kdtree, normals, resolution, LIN_NEIGHBOURS, 1)[0]
    seconds = time.perf_counter() - start
    labels = np.full(finite.shape, -1, np.int32)
    labels[finite] = _groups_of(voxels, groups)[voxel_of_point]
    return labels, seconds


def _normals(points: NDArray[np.float64]) -> NDArray[np.float64]:
    _, neighbours = cKDTree(points).query(points, LIN_NEIGHBOURS, workers=2)
    spread = points[neighbours] - points[neighbours].mean(axis=1, keepdims=True)
    return np.ascontiguousarray(np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0])


def _groups_of(voxels: NDArray[np.float64], groups: list[NDArray[np.float64]]) -> NDArray[np.int32]:
    """Group of each voxel; py4dgeo answers with coordinates, copied as they are."""
    group = np.repeat(np.arange(len(groups), dtype=np.int32), [len(g) for g in groups])
    distance, index = cKDTree(np.concatenate(groups)).query(voxels)
    if distance.max() > 0.0 or len(group) != len(voxels):
        raise RuntimeError(f"expected each of {len(voxels)} voxels in one supervoxel of py4dgeo, got {len(group)}")
    return group[index]
