# SPDX-License-Identifier: Apache-2.0
"""Camera and emitter: intrinsics, poses, lenses, calibration files."""

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
