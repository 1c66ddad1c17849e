# SPDX-License-Identifier: Apache-2.0
"""Numbers so small that they only guard divisions: what is smaller counts as zero."""

from __future__ import annotations

import numpy as np

TINY = float(np.finfo(np.float64).tiny)
"""Least normal number of double precision, about 2e-308: a divisor that is at least this is never zero."""
NEARLY_ZERO = 1e-12
"""Least divisor, dimensionless, among numbers of the order of 1; chosen so that single precision holds it, too."""
