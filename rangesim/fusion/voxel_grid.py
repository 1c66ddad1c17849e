# SPDX-License-Identifier: Apache-2.0
"""Regular grids of voxels in the world, on which what a sensor saw, the truth and a CT are compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from rangesim import limits
from rangesim.settings.bounds import Coordinate, Metres, check_fields, whole
from rangesim.settings.config import shown

ALL = slice(None)


@dataclass(frozen=True)
class VoxelGrid:
    """Cubes in rows along x, y and z.

    Parameters
    ----------
    shape : (nx, ny, nz) voxels. Arrays on the grid are indexed [x, y, z].
    voxel_m : metres, edge of a voxel.
    corner_m : (x, y, z) metres, world, the lowest corner of the first voxel.
    """

    shape: tuple[Annotated[int, whole(1)], Annotated[int, whole(1)], Annotated[int, whole(1)]]
    voxel_m: Metres
    corner_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_fields(self)
        limits.check("voxels", int(np.prod([float(n) for n in self.shape])), f"voxels, not {shown(self.shape)}")

    @classmethod
    def around(cls, points: ArrayLike, voxel_m: float, margin_m: float = 0.0) -> VoxelGrid:
        """The smallest grid that holds points (n, 3), world, and a margin around them; they lie in its middle."""
        P = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if not len(P) or not np.isfinite(P).all():
            raise ValueError(f"expected finite points (n, 3) to put a grid around, got {shown(P)}.")
        if not voxel_m > 0 or not margin_m >= 0:
            raise ValueError(f"expected a positive voxel_m and no negative margin_m, got {voxel_m!r} and {margin_m!r}.")
        low, high = P.min(axis=0) - margin_m, P.max(axis=0) + margin_m
        shape = np.maximum(1, np.ceil((high - low) / voxel_m - 1e-9).astype(np.int64))
        corner = (low + high) / 2 - shape * voxel_m / 2
        return cls(tuple(map(int, shape)), float(voxel_m), tuple(map(float, corner)))  # type: ignore[arg-type]

    def centres(self, part: slice = ALL) -> np.ndarray:
        """(nx, ny, nz, 3) float64, metres, world, of all voxels, or of those in a part of the rows along x."""
        axes = [c + (np.arange(n) + 0.5) * self.voxel_m for c, n in zip(self.corner_m, self.shape, strict=True)]
        return np.stack(np.meshgrid(axes[0][part], *axes[1:], indexing="ij"), axis=-1)

    def indices(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """(..., 3) int64, the voxels that points (..., 3), world, lie in, and (...) bool, whether they are of the
        grid."""
        P = np.asarray(points, dtype=np.float64)
        place = np.floor((P - np.asarray(self.corner_m)) / self.voxel_m)
        inside = ((place >= 0) & (place < self.shape)).all(axis=-1)  # False with NaN
        return np.where(inside[..., None], place, 0).astype(np.int64), inside
