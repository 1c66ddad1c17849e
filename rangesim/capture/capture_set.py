# SPDX-License-Identifier: Apache-2.0
"""Captures of several cameras that share an emitter and a moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rangesim.capture.capture import Capture
from rangesim.sensor import Sensor
from rangesim.settings.config import ShortRepr


@dataclass(frozen=True, eq=False, repr=False)
class CaptureSet(ShortRepr):
    """Captures that several cameras took at one moment, in the light of one emitter.

    The first camera is the reference: a range image of the set is one of its pixels. A sensor with several cameras
    (`Sensor.n_cameras`) is decoded from a set. `Capture` has `captures` and `reference`, too, so that a function can
    take either.

    Parameters
    ----------
    captures : two captures or more, of one sensor; the reference camera comes first. All have rigs or none has. The
        size of the images may differ.

    Raises
    ------
    ValueError
        Fewer than two captures, captures of different sensors, rigs with different emitters, or only some with a rig.

    Examples
    --------
    Images of a real pair of cameras, which are rectified already:

    >>> import numpy as np
    >>> from rangesim import Capture
    >>> from rangesim.sensors import ActiveStereo
    >>> left, right = np.zeros((2, 1, 48, 64), dtype=np.uint8)
    >>> pair = CaptureSet((Capture(left, ActiveStereo()), Capture(right, ActiveStereo())))
    >>> pair.reference.frames.shape, pair.sensor.type_name
    ((1, 48, 64), 'active-stereo')
    """

    captures: tuple[Capture, ...]

    def __post_init__(self) -> None:
        captures = tuple(self.captures) if isinstance(self.captures, Sequence) else ()
        if len(captures) < 2 or not all(isinstance(capture, Capture) for capture in captures):
            raise ValueError(f"expected two captures or more, got {self.captures!r}.")
        object.__setattr__(self, "captures", captures)
        first = captures[0]
        for number, other in enumerate(captures[1:], 1):
            if other.sensor != first.sensor:
                raise ValueError(
                    f"expected captures of one sensor, got {first.sensor.type_name} and, as number {number}, "
                    f"{other.sensor.type_name} or other settings."
                )
            if (other.rig is None) != (first.rig is None):
                raise ValueError("expected a rig of every capture, or of none.")
            if (
                first.rig is not None
                and other.rig is not None
                and (names := other.rig.differences_of_emitter(first.rig))
            ):
                raise ValueError(
                    f"expected rigs with one emitter (see Rig.with_camera), but rig {number} has another {names[0]}."
                )

    @property
    def reference(self) -> Capture:
        """The capture of the reference camera, the first one."""
        return self.captures[0]

    @property
    def sensor(self) -> Sensor:
        """The sensor that all captures are of."""
        return self.reference.sensor


Captured = Capture | CaptureSet
"""What a sensor took at one moment: the capture of its camera, or those of its cameras."""


def together(captures: Sequence[Capture]) -> Captured:
    """The captures of one moment: a set of several, or the only one."""
    return captures[0] if len(captures) == 1 else CaptureSet(tuple(captures))
