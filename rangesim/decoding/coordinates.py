# SPDX-License-Identifier: Apache-2.0
"""Coordinates: the first result of a decoder, before any geometry.

A decoder works in two steps. The first one reads the frames alone: it gives projector coordinates or path lengths, with
their standard deviations. The second one is geometry, and needs a rig: it makes a range image of them. Calibration
takes the first step alone, because it has yet to find the rig.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.settings.config import ShortRepr

if TYPE_CHECKING:
    from typing import Self

    from rangesim.rig import Rig


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Coordinates(ShortRepr, ABC):
    """Readings of the camera's pixels before any geometry.

    Subclasses add the coordinates: `ProjectorCoordinates` and `PathLengths`. They are NaN where `status` is not OK.

    Parameters
    ----------
    status : (h, w) integer, values of `Status`; kept as uint8.
    confidence : (h, w) float, strength of the useful signal, as in `RangeImage`; kept as float32, clipped to 0..1.
    intensity : (h, w) float, mean signal in the capture's units; kept as float32.
    """

    status: np.ndarray
    confidence: np.ndarray
    intensity: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "status", np.asarray(self.status).astype(np.uint8))
        object.__setattr__(self, "confidence", np.clip(self.confidence, 0, 1).astype(np.float32))
        object.__setattr__(self, "intensity", np.asarray(self.intensity, dtype=np.float32))

    @property
    def valid(self) -> np.ndarray:
        """(h, w) bool, where `status` is OK."""
        return np.asarray(self.status == Status.OK)

    @abstractmethod
    def range_image(self, rig: Rig | None) -> RangeImage:
        """Range image of these coordinates.

        Parameters
        ----------
        rig : Rig that took the capture; None: z is NaN everywhere.
        """

    def spread(self, where: np.ndarray) -> Self:
        """Coordinates of an image (h, w), of which n pixels have those of this row (1, n), and the others no reading.

        Parameters
        ----------
        where : (h, w) bool, the n pixels.
        """
        images = {}
        for field in fields(self):
            values = getattr(self, field.name)
            if isinstance(values, np.ndarray):
                rest = Status.LOW_SIGNAL if field.name == "status" else 0
                images[field.name] = np.full(where.shape, rest, values.dtype)
                images[field.name][where] = values[0]
        return replace(self, **images)

    def _image(self, rig: Rig | None, z: np.ndarray, range_m: np.ndarray, status: np.ndarray) -> RangeImage:
        """Range image with these depths, and with the confidence and the intensity of the coordinates."""
        return RangeImage(
            z=z,
            range_m=range_m,
            confidence=self.confidence,
            status=status,
            intensity=self.intensity,
            camera=rig.camera if rig else None,
            T_world_camera=rig.T_world_camera if rig else None,
        )

    def _keep_valid(self, name: str, dtype: type[np.floating]) -> None:
        """Set the array of that name, if there is one, to NaN wherever `status` is not OK."""
        values = getattr(self, name)
        if values is not None:
            valid_values = np.where(self.valid, values, np.float32(np.nan))
            object.__setattr__(self, name, valid_values.astype(dtype, copy=False))
