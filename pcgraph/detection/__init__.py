# SPDX-License-Identifier: Apache-2.0
"""Planes, objects on a support, and their shapes and boxes; names load on first use. See docs/detection.md."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pcgraph.detection.boxes import OrientedBox, standing_box, tight_box
    from pcgraph.detection.objects import DetectedObject, object_labels, objects_on
    from pcgraph.detection.plane_detection import Planes, find_planes
    from pcgraph.detection.shapes import Shape, fit_shape

__all__ = [
    "DetectedObject",
    "OrientedBox",
    "Planes",
    "Shape",
    "find_planes",
    "fit_shape",
    "object_labels",
    "objects_on",
    "standing_box",
    "tight_box",
]

_HOMES = {
    "DetectedObject": "objects",
    "OrientedBox": "boxes",
    "Planes": "plane_detection",
    "Shape": "shapes",
    "find_planes": "plane_detection",
    "fit_shape": "shapes",
    "object_labels": "objects",
    "objects_on": "objects",
    "standing_box": "boxes",
    "tight_box": "boxes",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'pcgraph.detection' has no attribute {name!r}")
    return getattr(import_module(f"pcgraph.detection.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
