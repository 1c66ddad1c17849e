# SPDX-License-Identifier: Apache-2.0
"""Rigs of a camera and an emitter: cameras of any rays, lenses, beams, poses, and calibration files."""

from rangesim.rig.beam import Beam
from rangesim.rig.cameras import Acceptance, Camera, Optics, PixelRays, tangents
from rangesim.rig.cover_glass import CoverGlass
from rangesim.rig.intrinsics import RESIDUAL_PX, Coefficient, FocalLength, Intrinsics, PrincipalPoint
from rangesim.rig.poses import Array, check_rigid, is_same_pose, look_at, pose, translation
from rangesim.rig.ray_cameras import Fisheye, Orthographic, RayTable, ScanningCamera
from rangesim.rig.rig import CAMERA_LENS, PROJECTOR_LENS, Lens, Rig
from rangesim.rig.scanners import Lissajous, MovingCamera, Risley, Spinning
from rangesim.rig.zones import Zones

__all__ = [
    "CAMERA_LENS",
    "PROJECTOR_LENS",
    "RESIDUAL_PX",
    "Acceptance",
    "Array",
    "Beam",
    "Camera",
    "Coefficient",
    "CoverGlass",
    "Fisheye",
    "FocalLength",
    "Intrinsics",
    "Lens",
    "Lissajous",
    "MovingCamera",
    "Optics",
    "Orthographic",
    "PixelRays",
    "PrincipalPoint",
    "RayTable",
    "Rig",
    "Risley",
    "ScanningCamera",
    "Spinning",
    "Zones",
    "check_rigid",
    "is_same_pose",
    "look_at",
    "pose",
    "tangents",
    "translation",
]
