# SPDX-License-Identifier: Apache-2.0
"""A rig: a camera and an emitter, their lenses, and their poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.rig.beam import Beam
from rangesim.rig.cameras import Camera, Optics
from rangesim.rig.cover_glass import CoverGlass
from rangesim.rig.intrinsics import Intrinsics
from rangesim.rig.poses import SAME_PLACE, Array, is_same_pose, pose
from rangesim.rig.zones import Zones
from rangesim.settings.bounds import Exponent, Fraction, Metres, Watts, Wavelength, check_fields
from rangesim.settings.config import from_dict, shown, to_dict


@dataclass(frozen=True)
class Lens:
    """The lens of a camera or a projector.

    Parameters
    ----------
    aperture_radius_m : radius of the entrance pupil (of a projector: the exit pupil), metres.
    focus_m : depth z of the plane in focus, metres. None: everything is in focus, as through a pinhole. docs/optics.md
        says what a projector out of focus does to its patterns.
    vignetting : exponent n >= 0 of the relative illumination cos^n of the angle to the optical axis: 4 is the natural
        law, 0 an even image. The light that a projector loses by vignetting is missing from its power.

    stray_light : fraction of the image's light that a camera's lens scatters evenly over the image, its veiling glare:
        a pixel gets (1 - fraction) of its own light, and the fraction of the mean over all pixels. 0.01 to 0.05 are
        common (ISO 9358). It does not concern projectors.

    Examples
    --------
    >>> Lens(aperture_radius_m=2e-3, focus_m=0.8, vignetting=4)
    Lens(aperture_radius_m=0.002, focus_m=0.8, vignetting=4, stray_light=0.0)
    """

    aperture_radius_m: Metres
    focus_m: Metres | None = None
    vignetting: Exponent = 0.0
    stray_light: Fraction = 0.0

    def __post_init__(self) -> None:
        check_fields(self)


CAMERA_LENS = Lens(0.75e-3)
"""Default lens of a camera: everything in focus, an even image, a pupil of 1.5 mm (f = 6 mm at f/4)."""
PROJECTOR_LENS = Lens(2e-3)
"""Default lens of a projector: everything in focus, an even image, a pupil of 4 mm."""


_OLD_LENS_KEYS = {
    f"{device}_{setting}": (f"{device}_lens", setting)
    for device in ("camera", "projector")
    for setting in ("aperture_radius_m", "focus_m", "vignetting")
}
"""Lens and setting of each key that older files of rigs have at the top level; see `Rig.from_dict`."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A camera and its emitter: their intrinsics, lenses and poses.

    The emitter is called projector here, even if it shows no image. The emitter of a time-of-flight camera has
    intrinsics too: they describe its field of illumination, and its pixels serve only as coordinates. The emitter of a
    scanner is a `Beam`, which lights the spot of one ray at a time.

    Parameters
    ----------
    camera : Camera: `Intrinsics` for a pinhole, or one with other rays.
    projector : Intrinsics, or Beam.
    T_world_camera : (4, 4) float64, rigid, maps camera coordinates to world coordinates, metres.
    T_camera_projector : (4, 4) float64, rigid, maps projector coordinates to camera coordinates, metres. A beam starts
        at its ray, so for a beam it is the identity.
    camera_lens, projector_lens : Lens
    projector_power_w : float, radiant power in watts that leaves the projector when it shows white.
    wavelength_m : wavelength of the emitter's light, metres; None: not stated.
    cover_glass : CoverGlass, a window in front of camera and emitter that returns a little light; None: it returns
        none.

    Raises
    ------
    ValueError
        A pose that is not rigid, or a value out of its bounds.

    Examples
    --------
    >>> from rangesim.rig import look_at
    >>> camera = Intrinsics.from_fov(640, 480, fov_x_deg=50.0)
    >>> projector = Intrinsics.from_fov(1280, 800, fov_x_deg=60.0)
    >>> beside = look_at((0.2, 0, 0), (0, 0, 1), up=(0, -1, 0))  # 0.2 m to the right of the camera, turned inwards
    >>> Rig(camera, projector, T_camera_projector=beside).baseline_m
    0.2
    """

    camera: Camera
    projector: Optics
    T_world_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    T_camera_projector: np.ndarray = field(default_factory=lambda: np.eye(4))
    camera_lens: Lens = CAMERA_LENS
    projector_lens: Lens = PROJECTOR_LENS
    projector_power_w: Watts = 1.0
    wavelength_m: Wavelength | None = None
    cover_glass: CoverGlass | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_camera", pose(self.T_world_camera, "T_world_camera"))
        object.__setattr__(self, "T_camera_projector", pose(self.T_camera_projector, "T_camera_projector"))
        check_fields(self)
        if not isinstance(self.camera, Camera):
            raise ValueError(f"expected camera as a Camera, such as Intrinsics, got {shown(self.camera)}.")
        if not isinstance(self.projector, (Intrinsics, Beam)):
            raise ValueError(f"expected projector as Intrinsics or Beam, got {shown(self.projector)}.")
        if not self.camera.traced.is_pinhole and self.camera_lens != Lens(self.camera_lens.aperture_radius_m):
            raise ValueError(
                "expected a camera_lens without focus_m, vignetting and stray_light for a "
                f"{type(self.camera).__name__}: only a pinhole camera has them."
            )
        if self.projector_lens.stray_light:
            raise ValueError("expected a projector_lens without stray_light: it is that of a camera's image.")
        if isinstance(self.projector, Beam):
            self._check_beam(self.projector)

    def _check_beam(self, beam: Beam) -> None:
        """Raise ValueError if the beam contradicts another part of the rig."""
        if np.abs(self.T_camera_projector - np.eye(4)).max() > SAME_PLACE:
            raise ValueError(
                "expected T_camera_projector to be the identity for a beam, which starts at its ray; state offset_m."
            )
        if self.projector_lens.focus_m is not None or self.projector_lens.vignetting:
            raise ValueError("expected a projector_lens without focus_m and vignetting for a beam.")
        if isinstance(self.camera, Zones):
            raise ValueError("expected a projector for a camera of zones, which measure at the same time, got a Beam.")
        size = self.camera.height, self.camera.width
        if beam.directions is not None and beam.directions.shape[:2] != size:
            raise ValueError(
                f"expected a beam direction for each of {size[0]} x {size[1]} pixels (h x w), got "
                f"{beam.directions.shape[0]} x {beam.directions.shape[1]}."
            )

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Rig) and to_dict(self) == to_dict(other)

    def __hash__(self) -> int:
        return hash((self.camera, self.projector, self.T_world_camera.tobytes(), self.T_camera_projector.tobytes()))

    @classmethod
    def from_dict(cls, data: Any, where: str = "rig") -> Rig:
        """The rig of plain data; see `rangesim.settings.config.from_dict`.

        Captures and calibrations written before `Lens` existed have its settings at the top level, such as
        `camera_focus_m`. They are read too.
        """
        if isinstance(data, Mapping):
            values = {key: value for key, value in data.items() if key not in _OLD_LENS_KEYS}
            for key in data.keys() & _OLD_LENS_KEYS.keys():
                lens, setting = _OLD_LENS_KEYS[key]
                if not isinstance(values.setdefault(lens, {}), Mapping):
                    raise ValueError(f"{where}.{lens}: expected a table of settings, got {shown(values[lens])}.")
                values[lens] = {**values[lens], setting: data[key]}
            data = values
        return from_dict(cls, data, where)

    def with_camera(self, T_camera_other: ArrayLike, intrinsics: Camera | None = None, lens: Lens | None = None) -> Rig:
        """The rig of a further camera with the same emitter, for example for active stereo.

        `rangesim.transport` takes the rigs of several cameras at once.

        Parameters
        ----------
        T_camera_other : (4, 4) float64, rigid, maps coordinates of the further camera to those of this one, metres. For
            a camera 0.1 m to the right that looks at the same point at a depth of 0.8 m, it is
            ``look_at((0.1, 0, 0), (0, 0, 0.8), (0, -1, 0))``.
        intrinsics, lens : those of the further camera; None: those of this camera.

        Raises
        ------
        ValueError
            The matrix is not rigid, `intrinsics` is no Camera, or `lens` is no Lens.
        """
        T = pose(T_camera_other, "T_camera_other")
        for name, value, kind in (("intrinsics", intrinsics, Camera), ("lens", lens, Lens)):
            if value is not None and not isinstance(value, kind):
                raise ValueError(f"expected {name} as {kind.__name__}, got {shown(value)}.")
        return replace(
            self,
            camera=self.camera if intrinsics is None else intrinsics,
            camera_lens=self.camera_lens if lens is None else lens,
            T_world_camera=self.T_world_camera @ T,
            T_camera_projector=np.linalg.inv(T) @ self.T_camera_projector,
        )

    @property
    def traced(self) -> Rig:
        """The rig with the camera whose rays are traced: this one, or for zones that with the finer camera."""
        return self if self.camera.traced is self.camera else replace(self, camera=self.camera.traced)

    @cached_property
    def emitter_offsets(self) -> Array:
        """(h, w, 3) float64, metres, camera coordinates, from the origin of each ray of the camera to its emitter."""
        if isinstance(self.projector, Beam):
            return self.projector.frames(self.camera.rays).offsets
        to_projector = self.T_camera_projector[:3, 3]
        if self.camera.is_pinhole:
            return np.broadcast_to(to_projector, (self.camera.height, self.camera.width, 3))
        return np.asarray(to_projector - self.camera.rays.origins)

    def __getstate__(self) -> dict[str, Any]:
        """Fields by name: what is computed from them is not pickled."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @property
    def pinhole(self) -> Intrinsics:
        """The camera, which has to be a pinhole; ValueError if it is not."""
        if not isinstance(self.camera, Intrinsics):
            raise ValueError(f"expected a pinhole camera (Intrinsics), got a {type(self.camera).__name__}.")
        return self.camera

    @property
    def image_projector(self) -> Intrinsics:
        """The projector, which has to have an image plane; ValueError if it is a beam."""
        if not isinstance(self.projector, Intrinsics):
            raise ValueError(f"expected a projector (Intrinsics), got a {type(self.projector).__name__}.")
        return self.projector

    def shares_emitter(self, other: Rig) -> bool:
        """Whether two rigs have the same emitter: the same intrinsics, lens, power and place."""
        return not self.differences_of_emitter(other)

    def differences_of_emitter(self, other: Rig) -> list[str]:
        """Names of the attributes in which the emitters of two rigs differ; places may differ by `SAME_PLACE`."""
        of_emitter = ("projector", "projector_lens", "projector_power_w", "wavelength_m")
        found = [name for name in of_emitter if getattr(self, name) != getattr(other, name)]
        if isinstance(self.projector, Beam) and self.camera != other.camera:
            found.append("camera, whose rays the beam follows")
        same = is_same_pose(self.T_world_projector, other.T_world_projector)
        return found if same else [*found, "T_world_projector"]

    def shares_camera_pose(self, other: Rig) -> bool:
        """Whether the cameras of two rigs have the same pose, within `SAME_PLACE`."""
        return is_same_pose(self.T_world_camera, other.T_world_camera)

    @property
    def T_world_projector(self) -> Array:
        """(4, 4) float64, maps projector coordinates to world coordinates, metres."""
        return np.asarray(self.T_world_camera @ self.T_camera_projector)

    @property
    def baseline_m(self) -> float:
        """Distance in metres between the centres of camera and projector."""
        return float(np.linalg.norm(self.T_camera_projector[:3, 3]))

    @property
    def projector_irradiance(self) -> float:
        """Irradiance in W/m2 of a fronto-parallel plane at z = 1 m when the projector shows white; for a beam, its
        power in watts."""
        p = self.projector
        if not isinstance(p, Intrinsics):
            return self.projector_power_w
        return self.projector_power_w * p.fx * p.fy / (p.width * p.height)

    @property
    def cover_glass_radiance(self) -> float:
        """Radiance in W/m2/sr of a surface that would bring each pixel as much light as the cover glass; 0 without."""
        if self.cover_glass is None:
            return 0.0
        etendue = self.camera.etendue_m2sr(self.camera_lens.aperture_radius_m)
        return float(self.cover_glass.fraction * self.projector_power_w / etendue)

    @property
    def camera_illumination(self) -> NDArray[np.float32]:
        """(h, w) float32, relative illumination of the camera's pixels, from 0 to 1.

        It is cos^n of the angle between a pixel's ray and the optical axis; see `Lens.vignetting`. For a camera that is
        no pinhole it is the solid angle of the pixel, relative to the largest. Of zones it is the sum over their
        pixels, relative to that of the largest zone. Pixels without a ray have 0.
        """
        if isinstance(self.camera, Zones):
            light = self.camera.matrix @ self.traced.camera_illumination.ravel().astype(np.float64)
            largest = self.camera.solid_angle_sr().max() / np.nanmax(self.camera.traced.solid_angle_sr())
            return (light / largest).reshape(self.camera.height, self.camera.width).astype(np.float32)
        if not isinstance(self.camera, Intrinsics):
            shape, solid_angle = (self.camera.height, self.camera.width), self.camera.solid_angle_sr()
            relative = np.nan_to_num(solid_angle / np.nanmax(solid_angle), nan=0.0)
            return np.broadcast_to(relative, shape).astype(np.float32)
        if not self.camera_lens.vignetting:
            return np.ones((self.camera.height, self.camera.width), dtype=np.float32)
        rays = self.camera.directions(self.camera.pixel_centres())
        fraction = np.linalg.norm(rays, axis=-1) ** -self.camera_lens.vignetting
        return np.nan_to_num(fraction, nan=0.0).astype(np.float32)
