# SPDX-License-Identifier: Apache-2.0
"""The data sheet of a device (pixels, field of view, range, emitter, noise), and the settings that follow from it.

The sheet speaks of angles and of metres from the device, an `Instrument` of focal lengths and poses.
`DataSheet.settings` turns one into the other, so that a number stands once in the file of a device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from rangesim.decoding.working_range import Nearest
from rangesim.rig import Camera, Fisheye, Intrinsics, look_at, translation
from rangesim.settings.bounds import Bounds, Coordinate, Metres, PositiveFraction, check_fields, whole
from rangesim.settings.config import to_dict

Degrees = Annotated[float, Bounds("degrees of a field of view", 1e-3, 360)]
"""A full angle of a field of view, degrees; a scanner that turns has 360, which is the largest."""
Lux = Annotated[float, Bounds("0 or positive", 0, 1e6)]
"""An illuminance by sunlight, lux: the sun at noon gives about 1e5, so the bound excludes only nonsense."""
Size = tuple[Annotated[int, whole(1, "pixels")], Annotated[int, whole(1, "pixels")]]
"""Numbers of pixels across and down."""
MAX_PINHOLE_DEG = 175.0
"""Largest angle, degrees, of the field of view of a pinhole. Towards 180 degrees its image grows without end; devices
with a wider view have a camera of another kind."""


@dataclass(frozen=True)
class PublishedNoise:
    """Standard deviations of single readings on a wall that faces the device, as somebody published them.

    Parameters
    ----------
    range_m : metres, distances of the wall.
    sigma_m : metres, standard deviation of a reading at each of them.
    reflectance : fraction of the light that the wall reflects, as a matte surface.
    sunlight_lux : lux, sunlight on the wall; 0: none.
    is_bound : whether the figures are upper bounds, below which the device may be as good as it likes.
    fitted_at_m : metres, the distance at which the emitter's power was chosen so that simulated readings have this
        noise; the other distances are predictions. None: nothing was fitted.

    Raises
    ------
    ValueError
        A number out of its range, or lists of different length.

    Examples
    --------
    >>> PublishedNoise(range_m=(1.0, 2.0), sigma_m=(0.002, 0.008)).slope  # of a stereo camera
    2.0
    """

    range_m: tuple[Metres, ...]
    sigma_m: tuple[Metres, ...]
    reflectance: PositiveFraction = 0.8
    sunlight_lux: Lux = 0.0
    is_bound: bool = False
    fitted_at_m: Metres | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.range_m or len(self.range_m) != len(self.sigma_m):
            raise ValueError(
                f"expected as many sigma_m as range_m, at least one, got {len(self.sigma_m)} and {len(self.range_m)}."
            )
        if self.fitted_at_m not in (None, *self.range_m):
            raise ValueError(f"expected fitted_at_m to be one of {self.range_m}, got {self.fitted_at_m:g}.")

    @property
    def slope(self) -> float:
        """Exponent p of sigma ~ range^p between the first and the last figure; NaN if there is one only."""
        if len(self.range_m) < 2:
            return math.nan
        return math.log(self.sigma_m[-1] / self.sigma_m[0]) / math.log(self.range_m[-1] / self.range_m[0])


@dataclass(frozen=True)
class DataSheet:
    """Numbers of a data sheet.

    Parameters
    ----------
    resolution_px : pixels of the range image across and down; of a scanner, directions.
    field_of_view_deg : degrees, full angles of the field of view across and down.
    range_m : metres, nearest and farthest reading.
    projection : "pinhole", or "equidistant" for a wide lens whose angle grows evenly with the distance from the middle
        of the image. Other cameras are stated with the instrument.
    range_along : "z" if the range is the depth along the optical axis, "ray" if it is the distance along the ray.
    emitter_offset_m : metres, place of the emitter in the camera's frame (x right, y down, z forward). None: as the
        instrument says.
    emitter_field_of_view_deg : degrees, full angles of the emitter's light; None: those of the camera.
    emitter_resolution_px : pixels of the emitter across and down; None: those of the camera.
    axes_meet_m : metres in front of the camera, where the emitter's axis meets the camera's; None: they are parallel.
    noise : PublishedNoise; None: nobody published any.

    Raises
    ------
    ValueError
        A number out of its range, or a nearest reading that is not nearer than the farthest.

    Examples
    --------
    >>> sheet = DataSheet((640, 576), (75.0, 65.0), (0.5, 3.86))
    >>> round(sheet.camera.fx, 1), round(sheet.camera.fy, 1)  # half of the pixels over the tangent of half of the angle
    (417.0, 452.1)
    >>> sheet.settings()["decoder"]
    {'working_range': {'near_m': 0.5, 'far_m': 3.86, 'along': 'z'}}
    """

    resolution_px: Size
    field_of_view_deg: tuple[Degrees, Degrees]
    range_m: tuple[Nearest, Metres]
    projection: Literal["pinhole", "equidistant"] = "pinhole"
    range_along: Literal["z", "ray"] = "z"
    emitter_offset_m: tuple[Coordinate, Coordinate, Coordinate] | None = None
    emitter_field_of_view_deg: tuple[Degrees, Degrees] | None = None
    emitter_resolution_px: Size | None = None
    axes_meet_m: Metres | None = None
    noise: PublishedNoise | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.range_m[0] >= self.range_m[1]:
            raise ValueError(f"expected range_m as nearest, farthest, got {self.range_m}.")

    @property
    def camera(self) -> Camera:
        """The camera with this resolution, field of view and projection, and the principal point in the middle."""
        if self.projection == "pinhole":
            return pinhole(self.resolution_px, self.field_of_view_deg)
        (width, height), (across, down) = self.resolution_px, self.field_of_view_deg
        return Fisheye(width, height, width / math.radians(across), height / math.radians(down), width / 2, height / 2)

    def settings(self, has_camera: bool = False, has_projector: bool = False) -> dict[str, Any]:
        """Settings of an `Instrument` that follow from the sheet, as plain data.

        They are `camera`, `projector` and `T_camera_projector`, if the sheet states them, and the decoder's
        `working_range`.

        Parameters
        ----------
        has_camera, has_projector : whether the instrument states its own camera or projector, which then replaces that
            of the sheet.
        """
        near_m, far_m = self.range_m
        result: dict[str, Any] = {
            "decoder": {"working_range": {"near_m": near_m, "far_m": far_m, "along": self.range_along}}
        }
        if not has_camera:
            result["camera"] = to_dict(self.camera)
        if self.emitter_offset_m is not None:
            if not has_projector:
                field_deg = self.emitter_field_of_view_deg or self.field_of_view_deg
                result["projector"] = to_dict(pinhole(self.emitter_resolution_px or self.resolution_px, field_deg))
            pose = translation(*self.emitter_offset_m)
            if self.axes_meet_m is not None:
                pose = look_at(self.emitter_offset_m, (0.0, 0.0, self.axes_meet_m), up=(0.0, -1.0, 0.0))
            result["T_camera_projector"] = pose.tolist()
        return result


def pinhole(resolution_px: tuple[int, int], field_of_view_deg: tuple[float, float]) -> Intrinsics:
    """Intrinsics of these pixels and full angles, degrees, with the principal point in the middle.

    Raises
    ------
    ValueError
        An angle above `MAX_PINHOLE_DEG`.
    """
    if max(field_of_view_deg) > MAX_PINHOLE_DEG:
        raise ValueError(
            f"expected a field of view of at most {MAX_PINHOLE_DEG:g} degrees for a pinhole, got {field_of_view_deg}; "
            "state another projection, or the camera of the instrument."
        )
    (width, height), (across, down) = resolution_px, field_of_view_deg
    fx, fy = (0.5 * n / math.tan(math.radians(a) / 2) for n, a in ((width, across), (height, down)))
    return Intrinsics(width, height, fx, fy, width / 2, height / 2)
