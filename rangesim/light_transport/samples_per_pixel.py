# SPDX-License-Identifier: Apache-2.0
"""The interface of a sampler, which looks at the first samples of a pass and decides how many each pixel takes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from rangesim.response import Response
    from rangesim.signals import GroundTruth, StillSignals


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
