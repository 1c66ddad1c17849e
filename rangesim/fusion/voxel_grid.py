# SPDX-License-Identifier: Apache-2.0
"""Regular grids of voxels in the world, on which the readings of a sensor, the truth and a CT are compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from rangesim.settings import limits
from rangesim.settings.bounds import Coordinate, Metres, check_fields, whole
from rangesim.settings.config import shown

WHOLE = slice(None)
"""All voxels along an axis."""


@dataclass(frozen=True)
class VoxelGrid:
    """Cubic voxels in rows along the world's x, y and z axes.

    Parameters
    ----------
    shape : (nx, ny, nz), number of voxels along each axis. Arrays on the grid are indexed [x, y, z].
    voxel_m : metres, edge of a voxel.
    corner_m : (x, y, z), metres, world, lowest corner of the first voxel.

    Raises
    ------
    ValueError
        A number out of its range, or more voxels than `rangesim.settings.limits` allows.

    Examples
    --------
    >>> from rangesim.fusion import VoxelGrid
    >>> grid = VoxelGrid(shape=(2, 2, 1), voxel_m=0.5, corner_m=(-0.5, -0.5, 0.0))
    >>> grid.centres()[0, 1, 0].tolist()
    [-0.25, 0.25, 0.25]
    >>> place, inside = grid.indices([[0.1, -0.4, 0.2], [3.0, 0.0, 0.0]])
    >>> place[0].tolist(), inside.tolist()
    ([1, 0, 0], [True, False])
    """

    shape: tuple[Annotated[int, whole(1)], Annotated[int, whole(1)], Annotated[int, whole(1)]]
    voxel_m: Metres
    corner_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_fields(self)
        limits.check("voxels", int(np.prod([float(n) for n in self.shape])), f"voxels, not {shown(self.shape)}")

    @classmethod
    def around(cls, points: ArrayLike, voxel_m: float, margin_m: float = 0.0) -> VoxelGrid:
        """Smallest grid that contains points and a margin on all sides; the points are in its middle.

        points : (n, 3), metres, world. voxel_m : metres, edge of a voxel. margin_m : metres.

        Raises
        ------
        ValueError
            No points, points that are not finite, or a size that is not positive.
        """
        P = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if not len(P) or not np.isfinite(P).all():
            raise ValueError(f"expected finite points (n, 3) to put a grid around, got {shown(P)}.")
        if not voxel_m > 0 or not margin_m >= 0:
            raise ValueError(f"expected a positive voxel_m and no negative margin_m, got {voxel_m!r} and {margin_m!r}.")
        low, high = P.min(axis=0) - margin_m, P.max(axis=0) + margin_m
        shape = np.maximum(1, np.ceil((high - low) / voxel_m - 1e-9).astype(np.int64))
        corner = (low + high) / 2 - shape * voxel_m / 2
        return cls(tuple(map(int, shape)), float(voxel_m), tuple(map(float, corner)))  # type: ignore[arg-type]

    def centres(self, part: slice = WHOLE) -> np.ndarray:
        """Centres of the voxels: (nx, ny, nz, 3) float64, metres, world. `part` selects a range of indices along x."""
        axes = [c + (np.arange(n) + 0.5) * self.voxel_m for c, n in zip(self.corner_m, self.shape, strict=True)]
        return np.stack(np.meshgrid(axes[0][part], *axes[1:], indexing="ij"), axis=-1)

    def indices(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Voxels that contain points (..., 3), metres, world.

        Returns
        -------
        tuple
            (..., 3) int64, indices of the voxels; 0 outside the grid. (...) bool, whether the point is in the grid.
        """
        P = np.asarray(points, dtype=np.float64)
        place = np.floor((P - np.asarray(self.corner_m)) / self.voxel_m)
        inside = ((place >= 0) & (place < self.shape)).all(axis=-1)  # False with NaN
        return np.where(inside[..., None], place, 0).astype(np.int64), inside
