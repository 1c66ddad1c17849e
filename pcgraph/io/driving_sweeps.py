# SPDX-License-Identifier: Apache-2.0
"""Sweeps of LiDARs in data sets of driving: KITTI's .bin, and nuScenes' .pcd.bin, which is no PCD file.

Both are float32, little end first, without a header; x to the front or right, z up, metres. KITTI has x, y, z,
reflectance (Geiger et al., IJRR 32, 2013), nuScenes x, y, z, intensity, ring (Caesar et al., CVPR 2020). SemanticKITTI
(Behley et al., ICCV 2019) adds ``labels/000000.label`` to ``velodyne/000000.bin``: 32 bits for each point, the lower 16
are its class, the upper 16 number its object.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcgraph.cloud import Cloud, cloud_from_columns, columns_of_cloud
from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.io.format import CloudFile, Format
from pcgraph.plumbing.plain_files import read_file

MAX_COORDINATE_M = 1e4
"""Largest coordinate in a sweep, metres. Any LiDAR reaches far less."""
MAX_RING = 255
"""Largest number of a ring: no scanner has more than 256. nuScenes' has 32."""
KITTI_COLUMNS = ("x", "y", "z", "intensity")
NUSCENES_COLUMNS = (*KITTI_COLUMNS, "ring")


def sweep_table(content: bytes, columns: tuple[str, ...]) -> NDArray[np.float32]:
    """(n, c) float32 numbers of a sweep, one column for each of the names; a view of the content.

    Raises
    ------
    CloudReadError
        The content is empty, has another number of bytes, or points farther than `MAX_COORDINATE_M`.
    """
    if not content or len(content) % (4 * len(columns)):
        raise CloudReadError(
            f"expected {len(columns)} numbers of 4 bytes for each point, {', '.join(columns)}, got {len(content)} bytes"
        )
    table = np.frombuffer(content, "<f4").reshape(-1, len(columns))
    if not (np.abs(table[:, :3]) <= MAX_COORDINATE_M).all() or not np.isfinite(table[:, 3:]).all():
        raise CloudReadError(f"expected points within {MAX_COORDINATE_M:g} m, got others or no numbers")
    return table


def read_kitti(file: CloudFile) -> Cloud:
    """Cloud of a sweep of KITTI, (n,), with the reflectance, 0 to 1, as the column ``intensity``, float32.

    If the file lies in a folder ``velodyne`` with SemanticKITTI's ``labels`` beside it, the classes are `labels`, and
    the numbers of objects are the column ``instance``, uint16.

    Raises
    ------
    CloudReadError
        The content is no list of such points, or there are more or fewer labels than points.
    """
    table = sweep_table(file.content, KITTI_COLUMNS)
    cloud = _cloud(table, KITTI_COLUMNS)
    found = None if file.path is None else _labels_beside(file.path)
    if found is None:
        return cloud
    packed = np.frombuffer(read_file(found, CloudReadError), np.uint8)
    if len(packed) != 4 * len(table):
        raise CloudReadError(f"expected 4 bytes for each of {len(table)} points in {found}, got {len(packed)} bytes")
    halves = packed.view("<u2").reshape(-1, 2).astype(np.uint16)
    columns = {**cloud.columns, "instance": halves[:, 1].copy()}
    return replace(cloud, labels=halves[:, 0].astype(np.int32), columns=columns)


def read_nuscenes(file: CloudFile) -> Cloud:
    """Cloud of a sweep of nuScenes, (n,), with the columns ``intensity``, float32, and ``ring``, uint8.

    Raises
    ------
    CloudReadError
        The content is no list of such points, or a ring is no whole number from 0 to 255.
    """
    table = sweep_table(file.content, NUSCENES_COLUMNS)
    if not _are_rings(table[:, 4]):
        raise CloudReadError(f"expected whole numbers from 0 to {MAX_RING} as rings, the fifth number of each point")
    cloud = _cloud(table, NUSCENES_COLUMNS)
    return replace(cloud, columns={**cloud.columns, "ring": table[:, 4].astype(np.uint8)})


def read_sweep(file: CloudFile) -> Cloud:
    """Cloud of a sweep: of nuScenes if the fifth number of each point is a ring, else of KITTI.

    Raises
    ------
    CloudReadError
        The bytes fit neither; or they fit both, because the fourth number of each point is also from 0 to 1; or a
        fourth number is negative, which no reflectance is, as where points have six numbers.
    """
    is_nuscenes = _is_nuscenes(file.content)
    if is_nuscenes and _is_kitti(file.content):
        raise CloudReadError(
            "the bytes may be points of four numbers (KITTI) or of five (nuScenes): "
            "read it with file_format='kitti' or file_format='nuscenes'"
        )
    if not is_nuscenes and _has_negative_reflectance(file.content):
        raise CloudReadError(
            "expected the fourth number of each point as its reflectance, got negative ones: if these are such points, "
            "read them with file_format='kitti'"
        )
    return read_nuscenes(file) if is_nuscenes else read_kitti(file)


def encode_sweep(cloud: Cloud, columns: tuple[str, ...]) -> bytes:
    """Bytes of a sweep with these columns.

    Raises
    ------
    CloudWriteError
        The cloud has others, or numbers that are not those of float32.
    """
    own = columns_of_cloud(cloud)
    if set(own) != set(columns):
        raise CloudWriteError(
            f"expected the columns {', '.join(columns)} and no others, got {', '.join(own)[:200]}: "
            "drop some, or write a .ply file"
        )
    table = np.empty((len(cloud.points), len(columns)), "<f4")
    for i, name in enumerate(columns):
        with np.errstate(over="ignore"):
            table[:, i] = own[name]
        if not np.array_equal(table[:, i], own[name]):
            raise CloudWriteError(
                f"expected numbers of float32 in {name!r}, which the file would round: write a .ply file"
            )
    return table.tobytes()


def _encode_bin(cloud: Cloud) -> bytes:
    content = encode_sweep(cloud, KITTI_COLUMNS)
    if _is_nuscenes(content):
        raise CloudWriteError(
            "these points would be read as those of nuScenes, because their numbers look like rings: "
            "write and read them with file_format='kitti'"
        )
    if _has_negative_reflectance(content):
        raise CloudWriteError(
            "expected intensities of at least 0, as those of KITTI, got negative ones: "
            "write and read them with file_format='kitti'"
        )
    return content


def _cloud(table: NDArray[np.float32], columns: tuple[str, ...]) -> Cloud:
    table = table.astype(np.float32, copy=False)
    return cloud_from_columns(dict(zip(columns, table.T, strict=True)), (len(table),))


def _are_rings(values: NDArray[np.float32]) -> bool:
    return bool(((values >= 0) & (values <= MAX_RING) & (values == np.rint(values))).all())


def _is_kitti(content: bytes) -> bool:
    """Whether the bytes are points of four numbers, and the fourth is a reflectance from 0 to 1."""
    try:
        reflectance = sweep_table(content, KITTI_COLUMNS)[:, 3]
    except CloudReadError:
        return False
    return bool(((reflectance >= 0) & (reflectance <= 1)).all())


def _has_negative_reflectance(content: bytes) -> bool:
    return bool((sweep_table(content, KITTI_COLUMNS)[:, 3] < 0).any())


def _is_nuscenes(content: bytes) -> bool:
    """Whether the bytes are points of five numbers, and the fifth is a ring."""
    try:
        return _are_rings(sweep_table(content, NUSCENES_COLUMNS)[:, 4])
    except CloudReadError:
        return False


def _labels_beside(path: Path) -> Path | None:
    """SemanticKITTI's labels of a sweep, if the folders are named as it names them and the file is there."""
    if path.parent.name != "velodyne":
        return None
    labels = path.parent.parent / "labels" / f"{path.stem}.label"
    return labels if labels.is_file() else None


KITTI = Format("kitti", (), read_kitti, lambda cloud, _: encode_sweep(cloud, KITTI_COLUMNS), holds_columns=False)
NUSCENES = Format(
    "nuscenes",
    (".pcd.bin",),
    read_nuscenes,
    lambda cloud, _: encode_sweep(cloud, NUSCENES_COLUMNS),
    holds_columns=False,
)
SWEEP = Format("bin", (".bin",), read_sweep, lambda cloud, _: _encode_bin(cloud), holds_columns=False)
