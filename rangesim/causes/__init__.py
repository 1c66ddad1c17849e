# SPDX-License-Identifier: Apache-2.0
"""Why a pixel has no reading, or a wrong one. Definitions and test scenes: docs/causes.md."""

from rangesim.causes.cause import Cause, CauseMap
from rangesim.causes.rules import explain

__all__ = ["Cause", "CauseMap", "explain"]
