# SPDX-License-Identifier: Apache-2.0
"""How far the surface behind each pixel moves, from ground truth and pose tracks."""

from __future__ import annotations

import numpy as np

from rangesim.motion.track import Poses, apply
from rangesim.rig import Rig
from rangesim.signals import GroundTruth

STILL = 1e-9
"""Entries of a transform that differ less from the identity, in metres and radians, are roundings."""


def displacement(truth: GroundTruth, rig: Rig, start: Poses, end: Poses) -> np.ndarray:
    """(h, w) float32, metres: how far the surface points that the pixels see move, as seen from the rig.

    Parameters
    ----------
    truth : what the pixels of the camera see at `start`.
    rig : Rig, where it stands without motion, with the camera that `truth` is of.
    start, end : where everything is, before and after; both distances are taken in camera coordinates.
    """
    points = rig.camera.directions(rig.camera.pixel_centres()) * truth.z[..., None]
    result = np.zeros(truth.z.shape, dtype=np.float32)
    T_camera_world = np.linalg.inv(end.place(rig))
    for index, name in enumerate(truth.instance_names):
        seen = truth.instance == index
        T = T_camera_world @ _carry(name, start, end) @ start.place(rig)
        if seen.any() and np.abs(T - np.eye(4)).max() > STILL:
            result[seen] = np.linalg.norm(apply(T, points[seen]) - points[seen], axis=-1)
    return np.nan_to_num(result)


def _carry(name: str, start: Poses, end: Poses) -> np.ndarray:
    """(4, 4) world transform that carries an object from one poses to another."""
    if name not in start.objects:
        return np.eye(4)
    return np.asarray(end.objects[name] @ np.linalg.inv(start.objects[name]))
