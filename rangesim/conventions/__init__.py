# SPDX-License-Identifier: Apache-2.0
"""Conventions of real captures, found from their frames: order, missing frames, start and direction of fringes."""

from rangesim.conventions.detection import Convention, detect_convention, detect_order

__all__ = ["Convention", "detect_convention", "detect_order"]
