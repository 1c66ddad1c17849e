# SPDX-License-Identifier: Apache-2.0
"""Sweeps of LiDARs in driving data sets: ``.bin`` of KITTI, and ``.pcd.bin`` of nuScenes, which is not a PCD file.

Both hold float32 numbers, little-endian, without a header, in metres; x points forwards (KITTI) or right (nuScenes), z
up. KITTI has x, y, z, reflectance (Geiger et al., IJRR 32, 2013). nuScenes has x, y, z, intensity, ring (Caesar et al.,
CVPR 2020). SemanticKITTI (Behley et al., ICCV 2019) adds ``labels/000000.label`` to ``velodyne/000000.bin``. It has 32
bits for each point: the lower 16 are the class, the upper 16 are the number of the object.
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
"""Largest coordinate in a sweep, metres, because no LiDAR reaches that far: a file with larger ones has another
layout. Chosen by eye; not varied."""
MAX_RING = 255
"""Largest ring number, a count from 0: no scanner has more than 256 rings; that of nuScenes has 32."""
KITTI_COLUMNS = ("x", "y", "z", "intensity")
NUSCENES_COLUMNS = (*KITTI_COLUMNS, "ring")


def sweep_table(content: bytes, columns: tuple[str, ...]) -> NDArray[np.float32]:
    """(n, c) float32 numbers of a sweep, one column for each name; a view of the content.

    Raises
    ------
    CloudReadError
        The content is empty, its length is no multiple of a point's, or a coordinate is above `MAX_COORDINATE_M`.
    """
    if not content or len(content) % (4 * len(columns)):
        raise CloudReadError(
            f"expected {len(columns)} numbers of 4 bytes for each point, {', '.join(columns)}, got {len(content)} bytes"
        )
    table = np.frombuffer(content, "<f4").reshape(-1, len(columns))
    if not (np.abs(table[:, :3]) <= MAX_COORDINATE_M).all() or not np.isfinite(table[:, 3:]).all():
        raise CloudReadError(f"expected finite numbers, and points within {MAX_COORDINATE_M:g} m, got others")
    return table


def read_kitti(file: CloudFile) -> Cloud:
    """Cloud of a sweep of KITTI, (n,), with the reflectance, 0 to 1, as the column ``intensity``, float32.

    If the file lies in a folder ``velodyne`` with SemanticKITTI's ``labels`` beside it, the classes are `labels`, and
    the numbers of objects are the column ``instance``, uint16.

    Raises
    ------
    CloudReadError
        The content is not a list of such points, or the number of labels differs from that of points.
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
        The content is not a list of such points, or a ring is not a whole number from 0 to 255.
    """
    table = sweep_table(file.content, NUSCENES_COLUMNS)
    if not _are_rings(table[:, 4]):
        raise CloudReadError(f"expected whole numbers from 0 to {MAX_RING} as rings, the fifth number of each point")
    cloud = _cloud(table, NUSCENES_COLUMNS)
    return replace(cloud, columns={**cloud.columns, "ring": table[:, 4].astype(np.uint8)})


def read_sweep(file: CloudFile) -> Cloud:
    """Cloud of a sweep of nuScenes, if the fifth number of each point is a ring, else of KITTI.

    Raises
    ------
    CloudReadError
        The bytes fit neither format, or they fit both, because every fourth number is also from 0 to 1. Or a fourth
        number is negative, which no reflectance is: the points may have six numbers.
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
        The cloud has other columns, or numbers that float32 would round.
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
    """SemanticKITTI's file of labels for a sweep, if it exists; the sweep has to be in a folder ``velodyne``."""
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
