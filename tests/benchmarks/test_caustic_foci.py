# SPDX-License-Identifier: Apache-2.0
"""The width that caustic_foci.py finds of an edge, on images whose blur is known."""

from __future__ import annotations

import caustic_foci
import numpy as np
import pytest
from scipy.special import ndtr


@pytest.mark.parametrize(("sigma_px", "width_px"), [(0.01, 0.80), (0.5, 1.486), (1.5, 3.916)])
def test_the_width_of_an_edge_is_that_of_its_gaussian_and_of_a_pixel(sigma_px: float, width_px: float) -> None:
    """Widths are those of a Gaussian convolved with a box of one pixel, from 10 to 90 %."""
    row, column = np.mgrid[:240, :320]
    right = column - 160 - 0.08 * (row - 120)
    bright = np.mean([ndtr((right + x) / sigma_px) for x in (np.arange(32) + 0.5) / 32 - 0.5], axis=0)
    level = 1 + 0.5 * np.sin(column / 9)  # light need not be even
    found = caustic_foci.edge_width(level * bright, level * (1 - bright))
    assert found == pytest.approx(width_px, rel=0.03)
