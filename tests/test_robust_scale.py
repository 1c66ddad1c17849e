# SPDX-License-Identifier: Apache-2.0
"""The standard deviation from a median is that of a normal distribution, with outliers or without."""

from __future__ import annotations

import doctest

import numpy as np
import pytest
from scipy.stats import norm

from rangesim import robust_scale
from rangesim.robust_scale import TO_SIGMA, sigma_from_median


def test_the_factor_is_that_of_the_normal_distribution():
    assert pytest.approx(1 / norm.ppf(3 / 4), abs=5e-5) == TO_SIGMA


@pytest.mark.parametrize("outliers", [0, 1000])
def test_outliers_hardly_change_it(outliers):
    errors = np.random.default_rng(1).normal(5.0, 2.0, 100_000)
    errors[:outliers] = 1e9
    assert sigma_from_median(errors, np.median(errors)) == pytest.approx(2.0, rel=0.03)
    assert sigma_from_median(errors - 5.0) == pytest.approx(2.0, rel=0.03)


def test_its_example_prints_what_it_says():
    assert doctest.testmod(robust_scale).failed == 0
