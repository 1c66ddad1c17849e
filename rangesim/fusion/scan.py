# SPDX-License-Identifier: Apache-2.0
"""Range images of one scene from several places, with their poses: what fusion takes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rangesim.decoding.range_image import RangeImage
from rangesim.rig import Array, pose
from rangesim.settings.config import ShortRepr

if TYPE_CHECKING:
    from rangesim.signals import GroundTruth


@dataclass(frozen=True, eq=False, repr=False)
class Scan(ShortRepr):
    """Range images of one scene from several places.

    images : one for each view, each with `camera`, `T_world_camera` and the `confidence` of its readings. `fuse` takes
    them as they are. truths : ground truth of each; empty where there is none. true_poses : (n, 4, 4) float64,
    T_world_camera that the views were rendered from; None of a real scan.
    """

    images: tuple[RangeImage, ...]
    truths: tuple[GroundTruth, ...] = ()
    true_poses: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.images)

    @property
    def poses(self) -> Array:
        """(n, 4, 4) float64, T_world_camera of each view as its image has it: known, or found by `align`."""
        return np.stack([np.asarray(i.T_world_camera) for i in self.images])

    def with_poses(self, poses: ArrayLike) -> Scan:
        """The same readings, taken from other places (n, 4, 4)."""
        matrices = np.asarray(poses, dtype=np.float64)
        if matrices.shape != (len(self.images), 4, 4):
            raise ValueError(f"expected poses of shape ({len(self.images)}, 4, 4), got {matrices.shape}.")
        placed = [
            replace(i, T_world_camera=pose(T, f"pose {k}"))
            for k, (i, T) in enumerate(zip(self.images, matrices, strict=True))
        ]
        return replace(self, images=tuple(placed))

    def points(self) -> list[Array]:
        """(n, 3) float64, metres, camera coordinates of each view's readings."""
        clouds = (image.to_point_cloud().points.reshape(-1, 3).astype(np.float64) for image in self.images)
        return [p[np.isfinite(p).all(axis=1)] for p in clouds]
