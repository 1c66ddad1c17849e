# SPDX-License-Identifier: Apache-2.0
"""The pulse of a photon-counting sensor as it was measured: the instrument response of laser, detector and timer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np

from rangesim.settings.bounds import Bounds, check_fields

Sample = Annotated[float, Bounds("0 or positive", 0, 1e15)]
"""A sample of a pulse, in counts or any other unit of energy; its bound only excludes nonsense."""


@dataclass(frozen=True)
class Pulse:
    """A measured instrument response: the light that each of many equal spans of time holds.

    Time zero is the middle of the largest sample (of the first of them, if there are several). The light of a path then
    peaks at the path's length, as with a Gaussian pulse. Between the ends of samples, the light that has arrived is
    interpolated by a monotone cubic (Fritsch & Carlson), so that every sample keeps its light.

    Parameters
    ----------
    samples : floats, light in each span of time, in any unit; for example the counts of a reference SPAD. An array is
        turned into a tuple.
    sample_s : float, seconds, width of a sample; it need not be that of the sensor's bins.

    Raises
    ------
    ValueError
        A negative sample, or no light in any.

    Examples
    --------
    >>> pulse = Pulse((0.0, 6.0, 3.0, 1.0), sample_s=100e-12)
    >>> pulse.start_s, pulse.stop_s  # the span of time that has light
    (-5e-11, 2.5e-10)
    >>> pulse.arrived([-50e-12, 50e-12, 150e-12, 1e-9])
    array([0. , 0.6, 0.9, 1. ])

    References
    ----------
    Fritsch & Carlson: "Monotone piecewise cubic interpolation", SIAM J. Numer. Anal. 17 (1980).
    """

    samples: tuple[Sample, ...]
    sample_s: Annotated[float, Bounds("positive and finite", 1e-15, 1e-3)]

    def __post_init__(self) -> None:
        check_fields(self)
        if not any(self.samples):
            raise ValueError("expected samples of a pulse with light in at least one, got none.")

    @property
    def start_s(self) -> float:
        """Seconds from time zero at which the first light arrives, 0 or negative."""
        first = next(i for i, light in enumerate(self.samples) if light)
        return (first - self._peak - 0.5) * self.sample_s

    @property
    def stop_s(self) -> float:
        """Seconds from time zero at which all light has arrived."""
        last = max(i for i, light in enumerate(self.samples) if light)
        return (last - self._peak + 0.5) * self.sample_s

    def arrived(self, times_s: np.ndarray | list[float]) -> np.ndarray:
        """(...) float64, fraction of the light that has arrived by these times (...), seconds, from 0 to 1."""
        times = np.asarray(times_s, dtype=np.float64)
        at = np.clip(times / self.sample_s + self._peak + 0.5, 0, len(self.samples))
        return np.clip(self._cumulative(at), 0.0, 1.0)

    @property
    def _peak(self) -> int:
        """Index of the largest sample."""
        return self.samples.index(max(self.samples))

    @cached_property
    def _cumulative(self):  # type: ignore[no-untyped-def]
        """Fraction of the light before a place, in samples."""
        from scipy.interpolate import PchipInterpolator

        light = np.concatenate([[0.0], np.cumsum(self.samples)])
        return PchipInterpolator(np.arange(len(light)), light / light[-1])
