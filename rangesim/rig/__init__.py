# SPDX-License-Identifier: Apache-2.0
"""Rigs of a camera and an emitter: intrinsics, the camera model, lenses, poses, and calibration files."""

from rangesim.rig.cover_glass import CoverGlass
from rangesim.rig.rig import (
    CAMERA_LENS,
    PROJECTOR_LENS,
    RESIDUAL_PX,
    Array,
    Coefficient,
    FocalLength,
    Intrinsics,
    Lens,
    PrincipalPoint,
    Rig,
    check_rigid,
    is_same_pose,
    look_at,
    pose,
    translation,
)

__all__ = [
    "CAMERA_LENS",
    "PROJECTOR_LENS",
    "RESIDUAL_PX",
    "Array",
    "Coefficient",
    "CoverGlass",
    "FocalLength",
    "Intrinsics",
    "Lens",
    "PrincipalPoint",
    "Rig",
    "check_rigid",
    "is_same_pose",
    "look_at",
    "pose",
    "translation",
]
