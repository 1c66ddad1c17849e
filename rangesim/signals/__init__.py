# SPDX-License-Identifier: Apache-2.0
"""What one transport pass returns, and its files."""

from rangesim.signals.signals import (
    ALL,
    NO_SAMPLING_ERROR,
    EnergySplit,
    GroundTruth,
    SamplingError,
    Signals,
    StillSignals,
    Truncation,
)

__all__ = [
    "ALL",
    "NO_SAMPLING_ERROR",
    "EnergySplit",
    "GroundTruth",
    "SamplingError",
    "Signals",
    "StillSignals",
    "Truncation",
]
