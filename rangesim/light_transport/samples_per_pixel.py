# SPDX-License-Identifier: Apache-2.0
"""The numbers of samples that pixels take, decided by the first samples of a pass.

A `Sampler` decides by what is measured. `samples_for_caustics` adds samples where caustics are uneven within a pixel.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import uniform_filter

if TYPE_CHECKING:
    from rangesim.response import Response
    from rangesim.signals import GroundTruth, StillSignals


ENOUGH = 0.01
"""Ratio of the standard error of a pixel's caustics to the shot noise that a detector has at 10^4 electrons in a pixel
of median brightness, below which no samples are added. It is the square root of 1 / 10^4."""
FRACTION_FOR_CAUSTICS = 0.05
"""Largest number of samples that are added for caustics, as a fraction of those that a pass has taken. With 0.1 the
noise of a focus is 0.9 instead of 0.94 %, and a pass takes up to a tenth longer."""
MOST_FOR_CAUSTICS = 256
"""Largest number of samples of a pixel with uneven caustics, if no sampler sets another limit: the brightest pixels of
a focus have 0.6 % noise then."""
FALL = 1.5
"""Exponent with which the variance of uneven light falls with the number of samples. It is 1 for random samples and 1.5
for evenly spread ones across an edge, because only those in cells on the edge are uncertain."""
STEP = 4
"""The number of added samples is a multiple of this: two halves of pairs."""


def samples_for_caustics(error: np.ndarray, light: np.ndarray, samples: np.ndarray, most: int) -> np.ndarray:
    """Number of samples to be added in each pixel for its caustics, (n,) int.

    Noise is large where light is uneven within a pixel, as in a focus. The noise of its neighbours decides about a
    pixel. Its own samples do not, so its mean has no bias.

    Parameters
    ----------
    error : (h, w) W/m2/sr, draw of the error of the caustics of each pixel. light : (h, w) W/m2/sr, all light of the
        projector.
    samples : (n,) int, numbers of samples that were taken. most : int, largest number of samples of a pixel.

    Examples
    --------
    >>> samples_for_caustics(np.array([[0, 0.1, 0]]), np.ones((1, 3)), np.array([16, 64, 16]), 256)
    array([0, 0, 0])
    """
    variance = np.square(error, dtype=np.float64)
    around = np.maximum(9 * uniform_filter(variance, 3, mode="constant") - variance, 0).ravel() / 8
    median = np.median(light[light > 0]) if (light > 0).any() else 0.0
    allowed = ENOUGH**2 * median * light.ravel()
    noisy = np.flatnonzero((around > allowed) & (allowed > 0))
    first = samples[noisy]
    factors, room = (around[noisy] / allowed[noisy]) ** (1 / FALL), np.maximum(most - first, 0)

    def added(level: float) -> np.ndarray:
        return np.asarray(STEP * (np.clip(first * (factors / level - 1), 0, room) // STEP)).astype(np.int64)

    level = 1.0  # it rises until the samples suffice
    while added(level).sum() > FRACTION_FOR_CAUSTICS * samples.sum():
        level *= 1.1
    result = np.zeros(len(samples), np.int64)
    result[noisy] = added(level)
    return result


class Sampler(ABC):
    """An object that decides how many samples (camera paths) each pixel takes.

    `rangesim.instrument.adaptive_sampling.AdaptiveSampling` decides by the noise of the readings. The light transport
    knows this interface only, so that it needs no sensors and no decoders.
    """

    @property
    @abstractmethod
    def first_spp(self) -> int:
        """Number of samples that each pixel takes before `samples` is called."""

    @property
    @abstractmethod
    def most_spp(self) -> int:
        """Largest number of samples that a pixel may take."""

    @abstractmethod
    def check(self, responses: Sequence[Response]) -> None:
        """Raise ValueError if the sampler needs a response that the pass does not accumulate."""

    @abstractmethod
    def samples(self, truth: GroundTruth, signals_of: Callable[[Sequence[Response]], StillSignals]) -> np.ndarray:
        """Number of samples that each pixel should take, (h, w) int, the first samples included.

        Parameters
        ----------
        truth : GroundTruth of the pass.
        signals_of : function that returns the signals of the first samples, with the channels of the given responses.
        """
