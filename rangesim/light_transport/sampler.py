# SPDX-License-Identifier: Apache-2.0
"""The interface of a sampler: it looks at the first samples of a pass and decides how many more each pixel takes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from rangesim.response import Response
    from rangesim.signals import GroundTruth, StillSignals


class Sampler(ABC):
    """Decides how many samples (camera paths) each pixel takes.

    `rangesim.instrument.adaptive_sampling.AdaptiveSampling` decides by the noise of readings. The light transport knows
    this interface alone.
    """

    @property
    @abstractmethod
    def first_spp(self) -> int:
        """Number of samples that each pixel takes before the sampler is asked."""

    @property
    @abstractmethod
    def most_spp(self) -> int:
        """Largest number of samples of a pixel."""

    @abstractmethod
    def check(self, responses: Sequence[Response]) -> None:
        """Raise ValueError if a pass that accumulates these responses does not tell what the sampler needs to know."""

    @abstractmethod
    def samples(self, truth: GroundTruth, signals_of: Callable[[Sequence[Response]], StillSignals]) -> np.ndarray:
        """(h, w) int, the number of samples that each pixel should take, the first ones included.

        Parameters
        ----------
        truth : GroundTruth of the pass.
        signals_of : makes signals of the first samples, with the channels of the given responses.
        """
