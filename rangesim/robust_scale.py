# SPDX-License-Identifier: Apache-2.0
"""Standard deviation of errors from their median, which outliers do not move (Huber: "Robust Statistics", 1981).

Half of a normal distribution lies within Phi^-1(3/4) = 0.6745 standard deviations of its mean, with Phi the cumulative
distribution function. So the median of the absolute deviations, times 1 / 0.6745, estimates the standard deviation.
Up to half of the errors may be outliers of any size before the estimate breaks down.
"""

from __future__ import annotations

import numpy as np

TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute deviations: 1 / Phi^-1(3/4) = 1.48260,
no unit, to the four decimals that the literature uses."""


def sigma_from_median(errors: np.ndarray, centre: float = 0.0) -> float:
    """Standard deviation of errors about a centre, from the median of their absolute deviations.

    Parameters
    ----------
    errors : (...) float, any unit; NaN gives NaN.
    centre : the value that the errors scatter about, in their unit. With the median of the errors, the result is the
        scaled median absolute deviation (MAD).

    Returns
    -------
    float
        In the unit of the errors; NaN, with NumPy's warning, if there are none.

    Examples
    --------
    One outlier among five errors has no influence:

    >>> import numpy as np
    >>> sigma_from_median(np.array([-2.0, -1.0, 0.0, 1.0, 1000.0]))
    1.4826
    """
    return TO_SIGMA * float(np.median(np.abs(errors - centre)))
