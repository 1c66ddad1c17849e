# SPDX-License-Identifier: Apache-2.0
"""What `rangesim decode` writes."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np

import rangesim
from rangesim.capture import Capture
from rangesim.cli.decode_summary import likely_cause, status_fractions
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import FileFormatError
from rangesim.files.result_directories import DirectoryKind, new_directory
from rangesim.files.schema import write_json
from rangesim.report import figures, palette
from rangesim.results.range_image_files import save_range_image
from rangesim.settings.config import to_dict

SIDECAR = "decoded.json"
FORMAT = "rangesim-decoded"
DECODED = DirectoryKind(FORMAT, SIDECAR, FileFormatError)
"""Directories that hold what a capture decodes to."""


def write_decoded(image: RangeImage, capture: Capture, directory: Path) -> None:
    """Write range.npz, pictures of its maps, the settings, fractions of all statuses and the likely cause if they are
    bad, and cloud.ply if there are points.

    The files appear when all are complete; FileFormatError if the directory exists and holds something else.
    """
    settings = {"sensor": to_dict(capture.sensor), "rig": to_dict(capture.rig), "rangesim": rangesim.__version__}
    outcome = {"status": status_fractions(image), "likely_cause": likely_cause(image, capture)}
    with new_directory(directory, DECODED) as folder:
        write_json(folder / SIDECAR, {"format": FORMAT, **settings, **outcome})
        save_range_image(image, folder / "range.npz")
        for name, uri in _pictures(image).items():
            (folder / f"{name}.png").write_bytes(base64.b64decode(uri.partition(",")[2]))
        if image.camera is not None and image.valid.any():
            image.to_point_cloud().save(folder / "cloud.ply")


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
