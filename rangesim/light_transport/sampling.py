# SPDX-License-Identifier: Apache-2.0
"""Random numbers and the places of samples within a pixel."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def random_stream(a: Any, b: Any, apart: bool = False) -> Any:
    """PCG32 that depends on the UInt32 `a` and `b` alone, not on the lane; `apart`: a second, independent one."""
    states = [mi.UInt64(x) for x in mi.sample_tea_32(a, b)]
    return mi.PCG32(1, *(reversed(states) if apart else states))  # 1: no lane number mixed in


def stratified(shift: Any, sample: Any) -> Any:
    """Place of a sample within its pixel: the R2 sequence (Roberts 2018), shifted per pixel; fills the pixel evenly."""
    n = mi.Float(sample)
    p = shift + mi.Point2f(n * 0.7548776662466927, n * 0.5698402909980532)
    return p - dr.floor(p)
