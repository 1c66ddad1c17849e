# SPDX-License-Identifier: Apache-2.0
"""Clouds of a scanner that moves while it scans, put together as if all points had been measured at one moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from rangesim.motion.pose_tracks import Track
from rangesim.point_cloud import PointCloud
from rangesim.rig import pose


def deskewed(
    cloud: PointCloud,
    track: Track,
    T_world_camera: ArrayLike | None = None,
    moment_s: float = 0.0,
    start_s: float = 0.0,
) -> PointCloud:
    """The cloud without the distortion that the scanner's own motion causes (de-skewing, motion compensation).

    A scanner reports its points in its own coordinates, each measured at its own time, while these coordinates move. A
    cloud in camera coordinates is moved to where the camera is at `moment_s`: p' = T_wc(moment)^-1 T_wc(t) p with
    T_wc(t) = T(t) T_world_camera. A cloud in world coordinates was made with the rig at rest, and becomes T(t) p.

    Parameters
    ----------
    cloud : PointCloud with `time_s`, metres; points without a time must be NaN.
    track : motion of the rig as in `Motion.rig`: world transforms T(t), applied to the rig as it stands. For recorded
        poses T_world_camera(t), give a `PoseTrack` of them and leave `T_world_camera` out.
    T_world_camera : (4, 4) float, metres, pose of the rig as it stands; None: the identity. It does not matter for a
        cloud in world coordinates.
    moment_s : seconds after the start of the scan, on the clock of `time_s`: the moment in whose camera coordinates the
        result is.
    start_s : seconds on the track's clock at which `time_s` is 0.

    Returns
    -------
    PointCloud
        With the same organisation and attributes; normals are turned along.

    Raises
    ------
    ValueError
        The cloud has no times, a finite point has none, or T_world_camera is not rigid.

    Examples
    --------
    A scanner that moves 1 m/s forward measures a post 5 m ahead of the start again and again:

    >>> from rangesim.motion import ConstantTwist
    >>> points = np.array([[0, 0, 5.0], [0, 0, 4.9]], dtype=np.float32)
    >>> cloud = PointCloud(points, time_s=np.array([0.0, 0.1]))
    >>> deskewed(cloud, ConstantTwist(velocity_m_s=(0.0, 0.0, 1.0))).points
    array([[0., 0., 5.],
           [0., 0., 5.]], dtype=float32)
    """
    if cloud.time_s is None:
        raise ValueError("expected a cloud with the time of each point, got one without time_s.")
    known = np.isfinite(cloud.time_s)
    if (cloud.valid & ~known).any():
        raise ValueError("expected a time for each finite point, got points whose time_s is not finite.")
    times, place = np.unique(np.where(known, cloud.time_s, moment_s), return_inverse=True)
    moves = track.poses_at(start_s + times)
    if cloud.coordinates == "camera":
        rig = np.eye(4) if T_world_camera is None else pose(T_world_camera, "T_world_camera")
        moves = np.linalg.inv(track.at(start_s + moment_s) @ rig) @ moves @ rig
    rotations, translations = moves[:, :3, :3][place], moves[:, :3, 3][place]
    shape = cloud.points.shape
    rotations, translations = rotations.reshape(*shape, 3), translations.reshape(shape)
    points = np.einsum("...ij,...j->...i", rotations, cloud.points) + translations
    turned = {}
    if cloud.normals is not None:
        turned["normals"] = np.einsum("...ij,...j->...i", rotations, cloud.normals).astype(cloud.normals.dtype)
    return replace(cloud, points=points.astype(cloud.points.dtype), **turned)
