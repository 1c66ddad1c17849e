# SPDX-License-Identifier: Apache-2.0
"""Labelled Kinect clouds (mOSD), and the measures of supervoxels on them, for the benchmarks of pcgraph."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcgraph import read_cloud

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "mosd"


@dataclass(frozen=True)
class LabelledCloud:
    """One cloud with its truth.

    Attributes
    ----------
    name : str
        Of the file.
    points : (h, w, 3) float32, metres, camera frame
        NaN where the sensor saw nothing.
    colors : (h, w, 3) uint8
    parts, objects : (h, w) int32
        True segments, -1 where there is no label or no point: the labels as they are (parts of the table and of
        objects count on their own), and labels // 10 (the table is 0).
    """

    name: str
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    parts: NDArray[np.int32]
    objects: NDArray[np.int32]

    @property
    def finite(self) -> NDArray[np.bool_]:
        """(h, w), whether all three coordinates are finite."""
        return np.logical_and.reduce(np.isfinite(self.points), axis=-1)


def load_clouds(folder: Path | str = DATA) -> list[LabelledCloud]:
    """All clouds of a folder, in order of their names.

    Raises
    ------
    SystemExit
        The folder holds no PCD file.
    """
    paths = sorted(Path(folder).glob("*.pcd"))
    if not paths:
        raise SystemExit(f"no .pcd file in {folder}: put labelled clouds of mOSD there, or name a folder with --data")
    return [_load(path) for path in paths]


def _load(path: Path) -> LabelledCloud:
    cloud = read_cloud(path)
    if cloud.colors is None or cloud.labels is None or not cloud.organised:
        raise SystemExit(f"expected an organised cloud with colours and labels, got {path}")
    true = (cloud.labels > 0) & np.isfinite(cloud.points).all(axis=-1)
    parts = np.where(true, cloud.labels, -1).astype(np.int32)
    objects = np.where(true, cloud.labels // 10, -1).astype(np.int32)
    return LabelledCloud(path.name, cloud.points, cloud.colors, parts, objects)
