# SPDX-License-Identifier: Apache-2.0
"""Codes of structured light, each a file with its patterns and its decoder (docs/codes.md).

A code follows one axis of the projector. `rangesim.StructuredLight` shows it along columns, rows or both.
"""

from rangesim.codes.axis_code import AxisCode, AxisFrames, Contrast
from rangesim.codes.code import AXES, Code, CodeThresholds
from rangesim.codes.fringes import FringeConvention
from rangesim.codes.gray import GrayCode
from rangesim.codes.gray_phase import GrayPhase
from rangesim.codes.multi_frequency import Heterodyne, MultiFrequency, NumberTheoretic
from rangesim.codes.n_step import PhaseShift
from rangesim.codes.thresholds import GrayThresholds

__all__ = [
    "AXES",
    "AxisCode",
    "AxisFrames",
    "Code",
    "CodeThresholds",
    "Contrast",
    "FringeConvention",
    "GrayCode",
    "GrayPhase",
    "GrayThresholds",
    "Heterodyne",
    "MultiFrequency",
    "NumberTheoretic",
    "PhaseShift",
]
