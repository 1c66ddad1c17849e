# SPDX-License-Identifier: Apache-2.0
"""Distance that the surface behind each pixel moves, from ground truth and pose tracks."""

from __future__ import annotations

import numpy as np

from rangesim.motion.pose_tracks import Poses, apply
from rangesim.rig import Rig
from rangesim.signals import GroundTruth

STILL = 1e-9
"""Metres, and radians: a transform whose entries all differ from the identity by less than this is at rest. Double
precision rounds coordinates of up to kilometres by less."""


def displacement(truth: GroundTruth, rig: Rig, start: Poses, end: Poses) -> np.ndarray:
    """Distance that the surface point behind each pixel moves, in camera coordinates: (h, w) float32, metres.

    It is 0 where there is no surface.

    Parameters
    ----------
    truth : ground truth of the camera at `start`.
    rig : Rig without motion, with the camera that `truth` belongs to.
    start, end : poses of everything that moves, before and after.
    """
    points = rig.camera.points(truth)
    result = np.zeros(truth.z.shape, dtype=np.float32)
    T_camera_world = np.linalg.inv(end.place(rig))
    for index, name in enumerate(truth.instance_names):
        seen = truth.instance == index
        T = T_camera_world @ _carry(name, start, end) @ start.place(rig)
        if seen.any() and np.abs(T - np.eye(4)).max() > STILL:
            result[seen] = np.linalg.norm(apply(T, points[seen]) - points[seen], axis=-1)
    return np.nan_to_num(result)


def _carry(name: str, start: Poses, end: Poses) -> np.ndarray:
    """World transform (4, 4) that moves an object from its place in `start` to its place in `end`."""
    if name not in start.objects:
        return np.eye(4)
    return np.asarray(end.objects[name] @ np.linalg.inv(start.objects[name]))
