# SPDX-License-Identifier: Apache-2.0
"""Scan: range images of one scene from several places, with their poses."""

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

    `rangesim.scan` renders them; real range images can be put into a `Scan` as well. `rangesim.fusion.align` takes a
    scan, and `rangesim.fusion.fuse` its images.

    images : one range image for each view, each with `camera`, `T_world_camera` and `confidence`.
    truths : ground truth of each view; empty if there is none.
    true_poses : (n, 4, 4) float64, metres, T_world_camera from which the views were rendered; None for a real scan.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim import Intrinsics, RangeImage, look_at
    >>> from rangesim.fusion import Scan
    >>> camera, z = Intrinsics.from_fov(32, 24, 40.0), np.ones((24, 32), np.float32)
    >>> range_m = z * np.linalg.norm(camera.directions(camera.pixel_centres()), axis=-1)
    >>> wall = RangeImage(z, range_m, 0.5 * z, np.zeros(z.shape, np.uint8), z, camera, np.eye(4))
    >>> scan = Scan((wall, wall)).with_poses([np.eye(4), look_at((1, 0, 0), (0, 0, 0))])
    >>> len(scan), scan.poses[1][:3, 3].tolist(), scan.points()[0].shape
    (2, [1.0, 0.0, 0.0], (768, 3))
    """

    images: tuple[RangeImage, ...]
    truths: tuple[GroundTruth, ...] = ()
    true_poses: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.images)

    @property
    def poses(self) -> Array:
        """Poses T_world_camera of the images: (n, 4, 4) float64, metres."""
        return np.stack([np.asarray(i.T_world_camera) for i in self.images])

    def with_poses(self, poses: ArrayLike) -> Scan:
        """The same readings with other poses (n, 4, 4), T_world_camera, metres.

        Raises
        ------
        ValueError
            Another number of poses, or a pose that is not rigid.
        """
        matrices = np.asarray(poses, dtype=np.float64)
        if matrices.shape != (len(self.images), 4, 4):
            raise ValueError(f"expected poses of shape ({len(self.images)}, 4, 4), got {matrices.shape}.")
        placed = [
            replace(i, T_world_camera=pose(T, f"pose {k}"))
            for k, (i, T) in enumerate(zip(self.images, matrices, strict=True))
        ]
        return replace(self, images=tuple(placed))

    def points(self) -> list[Array]:
        """Readings of each view as points in camera coordinates: (n, 3) float64 each, metres."""
        clouds = (image.to_point_cloud().points.reshape(-1, 3).astype(np.float64) for image in self.images)
        return [p[np.isfinite(p).all(axis=1)] for p in clouds]
