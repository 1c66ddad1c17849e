# SPDX-License-Identifier: Apache-2.0
"""Codes of structured light, each a file with its patterns and its decoder (docs/codes.md).

A code follows one axis of the projector. `rangesim.StructuredLight` shows it along columns, rows or both.
"""

from rangesim.codes.axis_code import AxisCode, AxisFrames, Contrast
from rangesim.codes.binary import BinaryCode
from rangesim.codes.bit_code import BitCode
from rangesim.codes.code import AXES, Code, CodeThresholds
from rangesim.codes.de_bruijn import DeBruijnStripes
from rangesim.codes.ensemble import EnsembleCode
from rangesim.codes.fringes import FringeConvention
from rangesim.codes.gray import GrayCode
from rangesim.codes.gray_phase import GrayPhase
from rangesim.codes.image_stack import ImageStack
from rangesim.codes.line_sweep import LineSweep
from rangesim.codes.max_min_stripe import MaxMinStripeCode
from rangesim.codes.micro_phase_shifting import MicroPhaseShifting
from rangesim.codes.modulated_phase_shifting import ModulatedPhaseShifting
from rangesim.codes.multi_frequency import Heterodyne, MultiFrequency, NumberTheoretic
from rangesim.codes.n_step import PhaseShift
from rangesim.codes.ramp import RampCode
from rangesim.codes.thresholds import GrayThresholds
from rangesim.codes.xor import XorCode

__all__ = [
    "AXES",
    "AxisCode",
    "AxisFrames",
    "BinaryCode",
    "BitCode",
    "Code",
    "CodeThresholds",
    "Contrast",
    "DeBruijnStripes",
    "EnsembleCode",
    "FringeConvention",
    "GrayCode",
    "GrayPhase",
    "GrayThresholds",
    "Heterodyne",
    "ImageStack",
    "LineSweep",
    "MaxMinStripeCode",
    "MicroPhaseShifting",
    "ModulatedPhaseShifting",
    "MultiFrequency",
    "NumberTheoretic",
    "PhaseShift",
    "RampCode",
    "XorCode",
]
