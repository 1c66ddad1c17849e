# SPDX-License-Identifier: Apache-2.0
"""Planes, objects on a support, and their shapes and boxes; names load on first use. See docs/detection.md."""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from pcgraph.detection.boxes import OrientedBox as OrientedBox
    from pcgraph.detection.boxes import boxes_of_labels as boxes_of_labels
    from pcgraph.detection.boxes import standing_box as standing_box
    from pcgraph.detection.boxes import tight_box as tight_box
    from pcgraph.detection.objects import DetectedObject as DetectedObject
    from pcgraph.detection.objects import object_labels as object_labels
    from pcgraph.detection.objects import objects_on as objects_on
    from pcgraph.detection.plane_detection import Planes as Planes
    from pcgraph.detection.plane_detection import find_planes as find_planes
    from pcgraph.detection.shapes import Shape as Shape
    from pcgraph.detection.shapes import fit_shape as fit_shape
else:
    import lazy_loader

    __getattr__, __dir__, __all__ = lazy_loader.attach(
        __name__,
        submod_attrs={
            "boxes": ["OrientedBox", "boxes_of_labels", "standing_box", "tight_box"],
            "objects": ["DetectedObject", "object_labels", "objects_on"],
            "plane_detection": ["Planes", "find_planes"],
            "shapes": ["Shape", "fit_shape"],
        },
    )
