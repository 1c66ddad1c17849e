# SPDX-License-Identifier: Apache-2.0
"""Results of a transport pass: the light that sensors expose, the energy split, and the ground truth."""

from rangesim.signals.signals import (
    ALL,
    NO_SAMPLING_ERROR,
    EnergySplit,
    GroundTruth,
    SamplingError,
    Signals,
    SignalSet,
    StillSignals,
    Surface,
    Truncation,
)

__all__ = [
    "ALL",
    "NO_SAMPLING_ERROR",
    "EnergySplit",
    "GroundTruth",
    "SamplingError",
    "SignalSet",
    "Signals",
    "StillSignals",
    "Surface",
    "Truncation",
]
