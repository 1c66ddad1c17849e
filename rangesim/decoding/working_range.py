# SPDX-License-Identifier: Apache-2.0
"""The ranges that a device reads: its decoder refuses readings outside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.settings.bounds import MAX_COORDINATE_M, Bounds, Metres, check_fields

if TYPE_CHECKING:
    from rangesim.rig import Camera
    from rangesim.signals import GroundTruth

Nearest = Annotated[float, Bounds("0 or positive", 1e-9, MAX_COORDINATE_M, or_zero=True)]
"""A least range in metres, which may be 0."""


@dataclass(frozen=True)
class WorkingRange:
    """Nearest and farthest reading that a device returns. Readings beyond them get `OUT_OF_RANGE`.

    Parameters
    ----------
    near_m : float, metres, least reading.
    far_m : float, metres, largest reading; None: no limit.
    along : what is limited. "z": the depth along the optical axis, as data sheets of depth cameras mean it; "ray": the
        distance along the ray, as those of scanners do.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.decoding.range_image import RangeImage
    >>> z, one = np.array([[0.3, 2.0, 9.0]], dtype=np.float32), np.ones((1, 3), dtype=np.float32)
    >>> image = RangeImage(z, z, one, np.zeros((1, 3), dtype=np.uint8), one)
    >>> WorkingRange(0.5, 4.5).applied_to(image).z
    array([[nan,  2., nan]], dtype=float32)
    """

    near_m: Nearest = 0.0
    far_m: Metres | None = None
    along: Literal["z", "ray"] = "z"

    def __post_init__(self) -> None:
        check_fields(self)
        if self.far_m is not None and self.near_m >= self.far_m:
            raise ValueError(f"expected near_m < far_m, got {self.near_m:g} and {self.far_m:g}.")

    def check(self, camera: Camera) -> None:
        """Raise ValueError if depths z are limited, but some rays of the camera lead sideways or backwards."""
        if self.along == "z" and not camera.is_forward:
            raise ValueError(
                'expected a working range along the ray (along = "ray"; in a sheet, range_along = "ray"), got one '
                f"along z: rays of this {type(camera).__name__} lead sideways or backwards, where z is no range."
            )

    def is_outside(self, surfaces: RangeImage | GroundTruth) -> np.ndarray:
        """(h, w) bool, whether a reading, or a true surface, lies outside this range; False where there is none."""
        reading = surfaces.z if self.along == "z" else surfaces.range_m
        with np.errstate(invalid="ignore"):  # NaN compares as inside
            is_outside = reading < self.near_m
            if self.far_m is not None:
                is_outside |= reading > self.far_m
        return np.asarray(is_outside)

    def applied_to(self, image: RangeImage) -> RangeImage:
        """The range image with NaN and `OUT_OF_RANGE` where it had a reading outside this range."""
        is_outside, nan = self.is_outside(image), np.float32(np.nan)
        return replace(
            image,
            z=np.where(is_outside, nan, image.z),
            range_m=np.where(is_outside, nan, image.range_m),
            status=np.where(is_outside, np.uint8(Status.OUT_OF_RANGE), image.status),
        )
