# SPDX-License-Identifier: Apache-2.0
"""Camera and emitter: intrinsics, poses, lenses, calibration files."""

from rangesim.rig.rig import (
    RESIDUAL_PX,
    Array,
    Coefficient,
    FocalLength,
    Intrinsics,
    PrincipalPoint,
    Rig,
    look_at,
    pose,
    translation,
)

__all__ = [
    "RESIDUAL_PX",
    "Array",
    "Coefficient",
    "FocalLength",
    "Intrinsics",
    "PrincipalPoint",
    "Rig",
    "look_at",
    "pose",
    "translation",
]
