# SPDX-License-Identifier: Apache-2.0
"""What `rangesim decode` writes."""

from __future__ import annotations

import base64
import shutil
import tempfile
from pathlib import Path

import numpy as np

from rangesim.capture import Capture
from rangesim.errors import FileFormatError
from rangesim.range_image import RangeImage
from rangesim.report import figures, palette
from rangesim.result_files import save_range_image

MARK = "range.npz"


def write_decoded(image: RangeImage, capture: Capture, directory: Path) -> None:
    """Write range.npz, pictures of its maps, and cloud.ply if there are points; the directory appears when complete.

    Raises
    ------
    FileFormatError
        `directory` exists, is not empty and was not written by this function.
    """
    if directory.exists() and (
        not directory.is_dir() or (any(directory.iterdir()) and not (directory / MARK).is_file())
    ):
        raise FileFormatError(f"{directory} exists and holds something else; nothing was written.")
    directory.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=f".{directory.name}-", dir=directory.parent))
    try:
        inside = staging / "new"
        inside.mkdir()
        save_range_image(image, inside / MARK)
        for name, uri in _pictures(image).items():
            (inside / f"{name}.png").write_bytes(base64.b64decode(uri.partition(",")[2]))
        if image.camera is not None and image.valid.any():
            image.to_point_cloud().save(inside / "cloud.ply")
        if directory.exists():
            directory.rename(staging / "old")
        inside.rename(directory)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _pictures(image: RangeImage) -> dict[str, str]:
    """Data URIs of the maps by file name."""
    maps = {"columns": image.projector_column, "rows": image.projector_row, "depth": image.z}
    table = palette.color_table("viridis")
    pictures = {
        name: figures.color_map(_stretched(m), table)
        for name, m in maps.items()
        if m is not None and np.isfinite(m).any()
    }
    pictures["status"] = figures.png(image.status, palette.STATUS_COLORS)
    return pictures


def _stretched(values: np.ndarray) -> np.ndarray:
    """Values as 0..1 between their 1st and 99th percentile."""
    low, high = np.nanpercentile(values, [1, 99])
    return np.asarray((values - low) / max(high - low, 1e-12))
