# SPDX-License-Identifier: Apache-2.0
"""The window in front of a device, which sends a little of the emitter's light straight into the camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from rangesim.settings.bounds import Bounds, Metres, check_fields


@dataclass(frozen=True)
class CoverGlass:
    """Light that the window of a device returns from the emitter to the camera, the same to pixels of the same size.

    Time-of-flight devices call it optical crosstalk. In a histogram it is a peak at a range of nearly zero; an AMCW
    camera reads all surfaces too near because of it. Its light belongs to the frames alone: neither the energy split
    nor the white image of the signals has it, because it says nothing of the scene.

    Parameters
    ----------
    fraction : fraction of the emitter's power that arrives at one pixel by way of the glass, 0 to 1; at the largest
        pixel, if the camera is no pinhole, and at others in proportion to their solid angle. A fingerprint makes it
        many times larger.
    path_m : metres, optical length of this way from the emitter to the camera.

    Examples
    --------
    >>> CoverGlass(fraction=2e-12, path_m=0.005)
    CoverGlass(fraction=2e-12, path_m=0.005)
    """

    fraction: Annotated[float, Bounds("a fraction", 0, 1)]
    path_m: Metres = 0.004

    def __post_init__(self) -> None:
        check_fields(self)
