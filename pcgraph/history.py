# SPDX-License-Identifier: Apache-2.0
"""Memory of earlier scans, and how it forgets: by age, and what a new scan sees through.

A supervoxel is kept or forgotten as a whole. The points behind its moments are not kept, so that no part of it could be
taken out of them; and what is left of it might not be connected.
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
"""Distance, in voxel edges, from which on what is seen past a voxel is behind it. At 1 a still scene loses two to five
times as much; at 3 a box that has moved by less than its length keeps 0.2 to 0.3 of its voxels in place of 0.1."""


@dataclass(frozen=True, eq=False)
class History:
    """What is known of a scene from the scans so far: v voxels in k supervoxels.

    Attributes
    ----------
    surface : Surface of v voxels
    leaves : Moments of k supervoxels
        Without normals.
    objects : (k,) int32
        Object of each supervoxel.
    ages : (k,) int32
        Number of scans since the last one that saw a point of the supervoxel; 0 if the last one did.
    next_object : int
        Least number that no object has had.
    numbers : (k_earlier,) int32
        Number of each supervoxel of the segmentation from which this was made, -1 if it is forgotten.
    """

    surface: Surface
    leaves: Moments
    objects: NDArray[np.int32]
    ages: NDArray[np.int32]
    next_object: int
    numbers: NDArray[np.int32]

    @classmethod
    def of(cls, earlier: Segmentation) -> History:
        """All that a segmentation knows of its scans."""
        numbers = np.arange(earlier.tree.n_leaves, dtype=np.int32)
        leaves = replace(earlier.leaves, normals=None)
        return cls(earlier.surface, leaves, earlier.objects, earlier.ages, earlier.next_object, numbers)

    def without(self, forgotten: NDArray[np.bool_]) -> History:
        """The same without some supervoxels, (k,) bool; the others are numbered without gaps, in their order."""
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
        """Whether a new scan, seen from a place, (3,) metres, is nearer in the direction of each voxel, -1, farther, 1,
        or neither, 0: there is something, or nothing was measured; (v,) int8."""
        return depth_order_of(self.surface.grid, self.surface.normals, place, shown, _CLEARLY_BEHIND)

    def seen_through(self, order: NDArray[np.int8]) -> NDArray[np.bool_]:
        """Supervoxels, (k,) bool, through more of whose voxels than not a new scan sees; hidden ones do not count.

        Parameters
        ----------
        order : (v,) int8
            As `depth_order` returns it.
        """
        k, supervoxels = len(self.objects), self.surface.supervoxels
        farther, neither = (np.bincount(supervoxels[order == side], minlength=k) for side in (1, 0))
        return farther > neither
