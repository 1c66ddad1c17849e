# SPDX-License-Identifier: Apache-2.0
"""Point clouds and segmentations in files."""

from __future__ import annotations

from pcgraph.io.read import read_cloud
from pcgraph.io.write import write_segmentation

__all__ = ["read_cloud", "write_segmentation"]
