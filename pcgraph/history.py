# SPDX-License-Identifier: Apache-2.0
"""History of a scene: the voxels and supervoxels of earlier scans, and which of them are forgotten.

A supervoxel is kept or forgotten as a whole. Its moments are sums over points that are not kept, so that a part cannot
be subtracted; and the rest might not be connected.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcgraph.features.moments import Moments
from pcgraph.segmentation import Segmentation
from pcgraph.voxels.grid import VoxelGrid, grid_without
from pcgraph.voxels.surface import Surface
from pcgraph.voxels.visibility import depth_order_of

_CLEARLY_BEHIND = 2.0
"""Distance, in voxel edges: a point farther than this behind a voxel was seen through the voxel.

Measured: at 1, a still scene loses two to five times as many voxels. At 3, a box that has moved by less than its length
keeps 0.2 to 0.3 of its voxels instead of 0.1.
"""


@dataclass(frozen=True, eq=False)
class History:
    """History of a scene from all scans so far: v voxels in k supervoxels.

    Attributes
    ----------
    surface : Surface of v voxels
    leaves : Moments of k supervoxels
        They have no normals.
    objects : (k,) int32
        Object of each supervoxel.
    ages : (k,) int32
        Number of scans since a scan last saw a point of the supervoxel; 0 if the last scan did.
    next_object : int
        Smallest number that no object has had yet.
    numbers : (k_earlier,) int32
        New number of each supervoxel of the segmentation from which this was made; -1 if it is forgotten.
    """

    surface: Surface
    leaves: Moments
    objects: NDArray[np.int32]
    ages: NDArray[np.int32]
    next_object: int
    numbers: NDArray[np.int32]

    @classmethod
    def of(cls, earlier: Segmentation) -> History:
        """The history that a segmentation holds, with nothing forgotten."""
        numbers = np.arange(earlier.tree.n_leaves, dtype=np.int32)
        leaves = replace(earlier.leaves, normals=None)
        return cls(earlier.surface, leaves, earlier.objects, earlier.ages, earlier.next_object, numbers)

    def without(self, forgotten: NDArray[np.bool_]) -> History:
        """The history without some supervoxels, (k,) bool; the others are numbered without gaps, in the same order."""
        if not forgotten.any():
            return self
        stays = ~forgotten
        numbers = np.where(stays, np.cumsum(stays) - 1, -1).astype(np.int32)
        grid, normals, supervoxels = self.surface.grid, self.surface.normals, self.surface.supervoxels
        voxel_stays = stays[supervoxels]
        surface = Surface(grid_without(grid, ~voxel_stays), normals[voxel_stays], numbers[supervoxels[voxel_stays]])
        return History(
            surface,
            self.leaves[np.flatnonzero(stays)],
            self.objects[stays],
            self.ages[stays],
            self.next_object,
            np.where(self.numbers >= 0, numbers[self.numbers], np.int32(-1)),
        )

    def depth_order(self, place: NDArray[np.float64], shown: VoxelGrid) -> NDArray[np.int8]:
        """Order of a new scan and each voxel along the ray from a place, (v,) int8.

        Parameters
        ----------
        place : (3,) float64, metres
            Position of the sensor.
        shown : VoxelGrid of the new scan

        Returns
        -------
        (v,) int8
            -1: the scan is nearer than the voxel. 1: it is farther. 0: neither, because it met something at the voxel
            or measured nothing there.
        """
        return depth_order_of(self.surface.grid, self.surface.normals, place, shown, _CLEARLY_BEHIND)

    def seen_through(self, order: NDArray[np.int8]) -> NDArray[np.bool_]:
        """Whether a new scan sees through most voxels of each supervoxel, (k,) bool; hidden voxels do not count.

        Parameters
        ----------
        order : (v,) int8
            As `depth_order` returns it.
        """
        k, supervoxels = len(self.objects), self.surface.supervoxels
        farther, neither = (np.bincount(supervoxels[order == side], minlength=k) for side in (1, 0))
        return farther > neither
