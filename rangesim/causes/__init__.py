# SPDX-License-Identifier: Apache-2.0
"""Finds why a pixel has no reading, or a wrong one. docs/causes.md has the definitions and the test scenes."""

from rangesim.causes.cause import Cause, CauseMap
from rangesim.causes.rules import explain

__all__ = ["Cause", "CauseMap", "explain"]
