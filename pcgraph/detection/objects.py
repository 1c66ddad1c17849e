# SPDX-License-Identifier: Apache-2.0
"""Objects on a support: what stands on a table, a floor or a shelf."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcgraph.detection.boxes import OrientedBox, standing_box, tight_box
from pcgraph.detection.pieces import connected_pieces, gathered, supervoxels_above
from pcgraph.detection.planes import Planes, find_planes
from pcgraph.detection.shapes import Shape, fit_shape
from pcgraph.inputs import non_negative
from pcgraph.segmentation import Segmentation
from pcgraph.short_repr import ShortRepr

LEAST_HEIGHT = 3.0  # voxel edges
LEAST_SUPERVOXELS = 0.5  # median supervoxels, in points


@dataclass(frozen=True)
class DetectedObject(ShortRepr):
    """One thing on a support.

    Attributes
    ----------
    supervoxels : (s,) int32
        Ascending.
    count : int
        Number of points.
    box : OrientedBox
        Standing on the support: smallest rectangle around the footprint (its longer side first) times the
        height (third axis, away from the support).
    free_box : OrientedBox
        Small box in any pose, longest axis first.
    shape : Shape
        Which of plane, box, sphere and cylinder fits its voxels.
    """

    supervoxels: NDArray[np.int32]
    count: int
    box: OrientedBox
    free_box: OrientedBox
    shape: Shape

    @property
    def height(self) -> float:
        """Of its highest point above the support, metres."""
        return float(self.box.size[2])


def objects_on(
    segmentation: Segmentation,
    planes: Planes | None = None,
    support: int | None = None,
    *,
    points: ArrayLike | None = None,
    margin: float | None = None,
    min_height: float | None = None,
    min_points: int | None = None,
) -> list[DetectedObject]:
    """Objects on a plane, the one with most points first.

    Parameters
    ----------
    segmentation : Segmentation
    planes : Planes, optional
        Default: `find_planes(segmentation)`.
    support : int, optional
        Index of the plane they stand on. Default: the largest horizontal one.
    points : the points that were segmented, optional
        Boxes are drawn around these; without them around the centroids of voxels, so up to half a voxel per side
        too small.
    margin : float, metres, optional
        How far beyond the convex outline of the plane a supervoxel's centroid may lie. Default: 1 voxel.
    min_height : float, metres, optional
        Least height of an object above the plane. Default: 3 voxels.
    min_points : int, optional
        Least number of points. Default: half that of the median supervoxel.

    Returns
    -------
    list of DetectedObject
        Empty if there is no horizontal plane, or nothing on it. A box covers what was seen: hidden sides are not
        guessed, except that it reaches down to the support.

    Raises
    ------
    ValueError
        An argument is not as above, the planes are another segmentation's, or there is none of that index.

    Notes
    -----
    An object is a connected part of one segment (`Segmentation.objects`) that does not belong to the support and
    lies above it. A piece that lies mostly within the box of a larger one goes to it, and so does one that hangs
    beside another without reaching the support, such as the inside of a cup (`fragments.joined_fragments`).
    """
    planes = find_planes(segmentation) if planes is None else planes
    if len(planes.plane_of_supervoxel) != segmentation.tree.n_leaves:
        raise ValueError(
            f"expected planes of this segmentation, of {segmentation.tree.n_leaves} supervoxels, got planes of "
            f"{len(planes.plane_of_supervoxel)}; call find_planes again"
        )
    index = _support(planes, support)
    if index is None:
        return []
    edge = float(np.median(segmentation.surface.grid.edge_lengths))
    sizes = segmentation.graph.node_features.size
    reach = edge if margin is None else non_negative("margin", margin)
    lowest = LEAST_HEIGHT * edge if min_height is None else non_negative("min_height", min_height)
    fewest = (
        LEAST_SUPERVOXELS * float(np.median(sizes)) if min_points is None else (non_negative("min_points", min_points))
    )
    up = planes.normals[index] * (-1.0 if planes.normals[index] @ planes.up < -0.5 else 1.0)
    bottom = float(up @ planes.centroids[index])
    above = supervoxels_above(segmentation, planes, index, up, bottom, reach)
    places, leaf_of_place = _places(segmentation, points)
    found = []
    for leaves in gathered(segmentation, planes, index, connected_pieces(segmentation, above), up, bottom, edge):
        member, count = places[np.isin(leaf_of_place, leaves)], int(sizes[leaves].sum())
        box = standing_box(member, up, bottom)
        if box.size[2] >= lowest and count >= fewest:
            found.append(DetectedObject(leaves, count, box, tight_box(member), _shape(segmentation, leaves, up)))
    return sorted(found, key=lambda thing: (-thing.count, int(thing.supervoxels[0])))


def object_labels(segmentation: Segmentation, objects: list[DetectedObject]) -> NDArray[np.int32]:
    """Index of each point's object in the points' shape, int32; -1 where it belongs to none or is not finite."""
    of_leaf = np.full(segmentation.tree.n_leaves, -1, np.int32)
    for i, thing in enumerate(objects):
        of_leaf[thing.supervoxels] = i
    return segmentation.on_points(of_leaf)


def _shape(segmentation: Segmentation, leaves: NDArray[np.int32], up: NDArray[np.float64]) -> Shape:
    surface = segmentation.surface
    member = np.isin(surface.supervoxels, leaves)
    return fit_shape(surface.grid.centroids[member], surface.normals[member], up)


def _support(planes: Planes, support: int | None) -> int | None:
    if support is not None:
        if not isinstance(support, int | np.integer) or not 0 <= support < len(planes):
            raise ValueError(f"expected support as one of the {len(planes)} planes, a whole number, got {support!r}")
        return int(support)
    level = np.flatnonzero(planes.roles == "horizontal")
    return int(level[0]) if len(level) else None


def _places(segmentation: Segmentation, points: ArrayLike | None) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Points, or centroids of voxels, (q, 3), with their supervoxels."""
    if points is None:
        return segmentation.surface.grid.centroids, segmentation.surface.supervoxels
    array = np.asarray(points)
    if array.shape != (*segmentation.supervoxels.shape, 3):
        raise ValueError(f"expected points of shape {(*segmentation.supervoxels.shape, 3)}, got {array.shape}")
    finite = segmentation.supervoxels >= 0
    return array[finite].astype(np.float64), segmentation.supervoxels[finite]
