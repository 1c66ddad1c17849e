# SPDX-License-Identifier: Apache-2.0
"""The interface of a code: the stack of patterns by which a projector pixel is told from its neighbours.

A code follows one axis of the projector; a sensor shows it along columns, along rows, or along both. A new code is one
file with one subclass: the names of its frames, its patterns, and how they are decoded. All else has a default.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.thresholds import GrayThresholds
from rangesim.decoding.phase_shift import PhaseThresholds
from rangesim.response import DenseResponse, Stripes
from rangesim.sensor import Background, ReceivedLight, least_signal_for
from rangesim.settings.config import Named

AXES = ("columns", "rows")
"""Axes of a projector that a code may follow; the index of an axis here is the index of its projector coordinate."""

MAX_BEYOND_PROJECTOR = 0.02
"""Largest fraction of the decoded pixels that may see no place of the projector, before other conventions of a code are
tried. Interreflection and noise make less."""

MAX_LEFT_OUTSIDE = 0.1
"""Largest number of pixels outside the projector in another convention, as a fraction of that in the given one, at
which it explains the frames. Pixels that are wrong at random lie outside in both."""


class CodeThresholds(NamedTuple):
    """Thresholds of all kinds of codes. Each kind takes those that it needs."""

    gray: GrayThresholds
    phase: PhaseThresholds


class Code(Named, ABC):
    """A stack of patterns that codes one axis of a projector. Subclasses are frozen dataclasses.

    Examples
    --------
    >>> from rangesim.codes import GrayCode
    >>> GrayCode().names(8)
    ['bit2', 'bit2_inverse', 'bit1', 'bit1_inverse', 'bit0', 'bit0_inverse']
    >>> GrayCode().patterns(8)[0]
    array([0., 0., 0., 0., 1., 1., 1., 1.], dtype=float32)
    """

    known: ClassVar[dict[str, type[Any]]] = {}
    type_name: ClassVar[str]
    """Name on the command line and in files."""
    title: ClassVar[str] = ""
    """Name of a sensor with this code in running text; "": made of `type_name`."""
    tells_direction: ClassVar[bool] = True
    """Whether frames that are read in the wrong direction contradict each other. Fringes alone do not: if they move the
    other way, they agree on mirrored places."""
    is_by_pixel: ClassVar[bool] = False
    """Whether the place of a pixel depends on its own frames alone, if the response of the devices is linear and their
    noise is known. A decoder learns both from the whole image where they are not."""

    # ---- Patterns ----------------------------------------------------------------------------------------------------

    @abstractmethod
    def names(self, size: int) -> list[str]:
        """One short name per frame, without the axis.

        Parameters
        ----------
        size : int, projector pixels along the axis.
        """

    @abstractmethod
    def patterns(self, size: int) -> np.ndarray:
        """(n, size) float32 in 0..1: the patterns along the axis, at the centres of the projector's pixels."""

    def check(self, size: int) -> None:
        """Raise ValueError if the code cannot tell `size` projector pixels from each other."""

    def check_shown(self, size: int, shown: Sequence[str]) -> None:
        """Raise ValueError if the frames of the names `shown` do not suffice to decode; by default all are needed.

        Parameters
        ----------
        size : int, projector pixels along the axis. shown : names as in `names`, and "white" and "black" if shown.
        """
        if missing := [name for name in self.names(size) if name not in shown]:
            raise ValueError(f"expected an order with all frames of {self.type_name}: {', '.join(missing)} is missing.")

    def responses(self, axis: int, size: int) -> tuple[DenseResponse, ...]:
        """Responses of which the frames are made; by default one channel per frame.

        Parameters
        ----------
        axis : 0 for columns (u), 1 for rows (v). size : int, projector pixels along the axis.
        """
        return (stripes(self, axis, size, 1.0),)

    def frames(self, size: int, channels: Sequence[np.ndarray], white: np.ndarray) -> Iterator[np.ndarray]:
        """Radiance (h, w) of each frame without ambient light, W/m2/sr, in the order of `names`.

        Parameters
        ----------
        channels : one (c, h, w) float32 per response. white : (h, w) float32, radiance under light at full power.
        """
        yield from channels[0]

    # ---- Decoding ----------------------------------------------------------------------------------------------------

    @abstractmethod
    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        """Projector coordinates along the axis."""

    def white_and_black(self, size: int, names: list[str], frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(h, w) each: estimates of the image under full light and under none, for captures without such frames.

        By default each pixel's brightest and darkest value.

        Parameters
        ----------
        size : int, projector pixels along the axis. names : (n,) of the frames that were shown. frames : (n, h, w).
        """
        return frames.max(axis=0), frames.min(axis=0)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        """A sentence if the frames as a whole contradict their code, with the likely cause; None if they agree.

        Parameters
        ----------
        seen : as for `decode`. code : what `decode` returned.
        """
        return None

    def other_conventions(self) -> Iterator[tuple[Code, str]]:
        """Codes with the same number of frames whose patterns are in use under the same name, each with a sentence that
        says what differs; by default none. `rangesim.conventions.detect_convention` tries them."""
        yield from ()

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        """(h, w) float64, least light of the projector at full power that the thresholds accept, in the background's
        unit; by default what the difference of white and black needs.

        Parameters
        ----------
        size, shown : as for `check_shown`.
        """
        if background.noise_variance is None:
            return background.floor(thresholds.gray.relative_contrast)
        noise_variance = 2 * (background.ambient + background.noise_variance)  # white - black: the noise of two frames
        return least_signal_for(thresholds.gray.contrast_sigmas**2, 1.0, noise_variance)

    def place_sigma_px(self, axis: int, size: int, light: ReceivedLight) -> np.ndarray | None:
        """(h, w) float64, projector pixels, standard deviation of a place by a closed form; None if there is none.

        Parameters
        ----------
        axis, size : as for `responses`.
        """
        return None

    # ---- How it is presented -----------------------------------------------------------------------------------------

    @property
    def details(self) -> str:
        """The code and its settings in a few words."""
        return f"{self.type_name} code"

    def representative(self, size: int) -> list[str]:
        """Names of two frames that show how the code works, a coarse one and a fine one."""
        names = self.names(size)
        return [names[len(names) // 2], names[-1]]


@lru_cache(maxsize=64)  # a sensor is asked for its responses again and again, and the tables of large codes take time
def stripes(code: Code, axis: int, size: int, gamma: float) -> Stripes:
    """Response to the patterns of a code as a projector with that gamma shows them: one channel per frame."""
    return Stripes(axis, code.patterns(size) ** np.float32(gamma))
