# SPDX-License-Identifier: Apache-2.0
"""What every range sensor has in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from rangesim.response import Response


class Sensor(ABC):
    """A measuring principle: which responses to light paths it reads, and which frames it makes of them.

    A sensor holds no geometry (that is the `Rig`), no electronics (`Detector`) and no decoder (`rangesim.decoding`).
    Subclasses are frozen dataclasses.
    """

    type_name: ClassVar[str]
    """Name in configuration files and sidecars."""

    @abstractmethod
    def responses(self) -> tuple[Response, ...]:
        """The basis of linear functionals that the transport pass has to accumulate."""

    @abstractmethod
    def frames(self, channels: Sequence[np.ndarray], steady: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        """(k, h, w) float32 mean radiance of the frames, W/m2/sr, from what the transport pass accumulated.

        Parameters
        ----------
        channels : one (c, h, w) float32 per response, in the order of `responses()`, W/m2/sr.
        steady : (h, w) float32, radiance under constant light of the projector at full power, without ambient.
        ambient : (h, w) float32, radiance of all other light that passes the camera's filter.
        """

    @abstractmethod
    def frame_names(self) -> list[str]:
        """One short name per frame, as used for files and plots."""

    def frames_per_exposure(self, single_tap: bool = False) -> int:
        """How many frames, one after another in the capture, one and the same exposure fills.

        `single_tap` : pixels have but one charge store, so that frames which could share an exposure do not.
        """
        return 1

    def check(self, width: int, height: int) -> None:
        """Raise ValueError if this sensor does not fit a projector of that many pixels."""
        for response in self.responses():
            response.check(width, height)

    @property
    def n_frames(self) -> int:
        """Number of frames in a capture."""
        return len(self.frame_names())
