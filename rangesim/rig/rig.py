# SPDX-License-Identifier: Apache-2.0
"""Where the camera and the emitter are, and how their pixels map to rays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.rig import camera_model
from rangesim.rig.camera_model import CameraModel, fold_radius2
from rangesim.settings import limits
from rangesim.settings.bounds import (
    MAX_COORDINATE_M,
    Bounds,
    Exponent,
    Metres,
    Watts,
    check_fields,
    check_number,
    whole,
)
from rangesim.settings.config import from_dict, shown, to_dict

Array = NDArray[np.float64]

SAME_PLACE = 1e-5
"""Metres and radians; emitters no farther apart are in one place."""
ROTATION_TOLERANCE = 1e-4
"""Largest entry of |R R^T - I|, dimensionless, of a matrix that counts as a rotation. A matrix written with five
decimals is off by at most 2e-5 and passes; a scale of 1.0001 does not."""
RESIDUAL_PX = 1e-3
"""Where the inverse of a lens model reprojects worse than this, there is none."""


FocalLength = Annotated[float, Bounds("positive and finite", 1e-3, 1e9)]
"""Pixels."""
PrincipalPoint = Annotated[float, Bounds("a pixel coordinate", -1e9, 1e9)]
Coefficient = Annotated[float, Bounds("a coefficient", -1e6, 1e6)]


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole with Brown-Conrady distortion, OpenCV's model and axes: x right, y down, z forward.

    Parameters
    ----------
    width, height : int, pixels
    fx, fy, cx, cy : float, pixels; pixel centres lie at integer + 0.5: the middle of an image is (width/2, height/2).
    distortion : tuple of 0 to 5 floats, OpenCV's order k1, k2, p1, p2, k3.
    """

    width: Annotated[int, whole(1)]
    height: Annotated[int, whole(1)]
    fx: FocalLength
    fy: FocalLength
    cx: PrincipalPoint
    cy: PrincipalPoint
    distortion: tuple[Coefficient, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        limits.check("pixels", self.width * self.height, f"pixels, not {shown(self.width)} x {shown(self.height)}")
        if len(self.distortion) > 5:
            raise ValueError(f"expected at most 5 distortion coefficients, got {shown(self.distortion)}.")

    @classmethod
    def from_fov(cls, width: int, height: int, fov_x_deg: float) -> Intrinsics:
        """Square pixels, principal point in the centre, horizontal field of view in degrees."""
        check_number("fov_x_deg", fov_x_deg, Bounds("degrees between 0 and 180", 1e-6, 180 - 1e-6))
        for name, value in (("width", width), ("height", height)):
            check_number(name, value, whole(1))
        f = 0.5 * width / np.tan(np.radians(fov_x_deg) / 2)
        return cls(width, height, float(f), float(f), width / 2, height / 2)

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same lens with another pixel count; the horizontal field of view and the shape of pixels are kept."""
        for name, value in (("width", width), ("height", height)):
            check_number(name, value, whole(1, "pixels"))
        scale = width / self.width
        cx, cy = (self.cx - self.width / 2) * scale + width / 2, (self.cy - self.height / 2) * scale + height / 2
        return Intrinsics(width, height, self.fx * scale, self.fy * scale, cx, cy, self.distortion)

    def pixel_centres(self, rows: slice = slice(None)) -> Array:
        """(height, width, 2) pixel coordinates (x, y) of the pixel centres, of all rows or some."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height)[rows] + 0.5)
        return np.stack([x, y], axis=-1)

    def normalise(self, pixels: ArrayLike) -> Array:
        """(..., 2) undistorted image-plane coordinates x/z, y/z of pixel coordinates (..., 2).

        NaN where the distortion has no inverse: beyond the radius at which its polynomial turns round.
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        u, v = pixels[..., 0], pixels[..., 1]
        if not any(self.distortion):
            return np.stack(camera_model.from_pixel(self.model, u, v), axis=-1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x, y, exists = camera_model.unproject(self.model, u, v, RESIDUAL_PX)
        result = np.stack([x, y], axis=-1)
        result[~exists] = np.nan
        return result

    def project(self, points: ArrayLike) -> Array:
        """(..., 2) pixel coordinates of points (..., 3) in coordinates of this device; NaN behind it and beyond the
        radius at which the distortion turns round."""
        points = np.asarray(points, dtype=np.float64)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        x, y = points[..., 0] / z, points[..., 1] / z
        if not any(self.distortion):
            return np.stack(camera_model.to_pixel(self.model, x, y), axis=-1)
        u, v, appears = camera_model.project(self.model, x, y)
        result = np.stack([u, v], axis=-1)
        result[~appears] = np.nan
        return result

    def directions(self, pixels: ArrayLike) -> Array:
        """(..., 3) ray directions with z = 1 (not unit length) through pixel coordinates (..., 2); NaN where
        `normalise` is."""
        xy = self.normalise(pixels)
        result = np.ones((*xy.shape[:-1], 3))
        result[..., :2] = xy
        return result

    @property
    def coefficients(self) -> tuple[float, float, float, float, float]:
        """k1, k2, p1, p2, k3, the missing ones 0."""
        return (*self.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]  # type: ignore[return-value]

    @property
    def fold_radius2(self) -> float:
        """Squared radius on the image plane at which the distortion folds the image; infinity if it does not."""
        return fold_radius2(self.coefficients)

    @property
    def model(self) -> CameraModel:
        """The parameters as `rangesim.rig.camera_model` and kernels take them."""
        fx, fy, cx, cy, *coefficients = map(float, (self.fx, self.fy, self.cx, self.cy, *self.coefficients))
        return CameraModel(fx, fy, cx, cy, tuple(coefficients), self.fold_radius2)


def pose(matrix: ArrayLike, name: str) -> Array:
    """A read-only (4, 4) float64 copy of a rigid transform; ValueError if it is not one."""
    try:
        result: Array = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"expected {name} to be a (4, 4) matrix, got {shown(matrix)}.") from None
    if result.shape != (4, 4):
        raise ValueError(f"expected {name} to be a (4, 4) matrix, got shape {result.shape}.")
    if not np.isfinite(result).all():
        raise ValueError(f"expected {name} to hold finite numbers, got {result.tolist()}.")
    if np.abs(result).max() > MAX_COORDINATE_M:
        raise ValueError(f"expected {name} to move by at most {MAX_COORDINATE_M:g} m, got {np.abs(result).max():g}.")
    check_rigid(result, name)
    result.setflags(write=False)
    return result


def check_rigid(T: NDArray[np.floating[Any]], name: str) -> None:
    """Raise ValueError unless a pose (4, 4), or each of several (n, 4, 4), is a rotation and a translation.

    name : what the poses are, for the message; the first one that is not rigid is named by its index.
    """
    R = T[..., :3, :3]
    is_rotation = np.isclose(R @ np.swapaxes(R, -1, -2), np.eye(3), atol=ROTATION_TOLERANCE).all(axis=(-2, -1))
    is_rigid = is_rotation & (np.linalg.det(R) > 0) & np.isclose(T[..., 3, :], [0, 0, 0, 1]).all(axis=-1)
    if not is_rigid.all():
        if T.ndim > 2:
            first = int(np.argmin(is_rigid))
            name, T = f"{name}[{first}]", T[first]
        raise ValueError(f"expected {name} to be rigid (a rotation and metres of translation), got {T.tolist()}.")


def is_same_pose(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two poses (4, 4) differ by no more than `SAME_PLACE`."""
    return bool(np.abs(np.linalg.inv(first) @ second - np.eye(4)).max() <= SAME_PLACE)


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """(4, 4) T_world_device of a device at `origin` that looks at `target`, metres, OpenCV axes."""
    o, t, u = (np.asarray(a, dtype=np.float64) for a in (origin, target, up))
    for name, value in (("origin", o), ("target", t), ("up", u)):
        if value.shape != (3,) or not (np.abs(value) <= MAX_COORDINATE_M).all():
            raise ValueError(f"expected {name} to be three finite coordinates, got {shown(value.tolist())}.")
    z = t - o
    x = np.cross(z, u)
    if np.linalg.norm(z) == 0 or np.linalg.norm(x) == 0:
        raise ValueError(f"expected target {t.tolist()} apart from origin {o.tolist()} and not along up {u.tolist()}.")
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    result = np.eye(4)
    result[:3] = np.stack([x, np.cross(z, x), z, o], axis=1)
    return result


@dataclass(frozen=True)
class Lens:
    """The lens of a camera or a projector: thin, or a pinhole.

    Parameters
    ----------
    aperture_radius_m : metres, radius of the entrance (exit) pupil.
    focus_m : metres, depth z of the plane in focus of a thin lens with this aperture; None: sharp everywhere. See
        docs/optics.md for what a projector out of focus does to its patterns.
    vignetting : exponent n >= 0 of the relative illumination cos^n of the angle to the optical axis: 4 is the natural
        law, 0 an even image. It takes from a projector's power what it darkens.
    """

    aperture_radius_m: Metres
    focus_m: Metres | None = None
    vignetting: Exponent = 0.0

    def __post_init__(self) -> None:
        check_fields(self)


CAMERA_LENS, PROJECTOR_LENS = Lens(0.75e-3), Lens(2e-3)
"""The defaults: sharp and even."""


def translation(x: float, y: float, z: float) -> Array:
    """(4, 4) pure translation in metres."""
    result = np.eye(4)
    result[:3, 3] = x, y, z
    return result


_FLAT = {
    f"{device}_{setting}": (f"{device}_lens", setting)
    for device in ("camera", "projector")
    for setting in ("aperture_radius_m", "focus_m", "vignetting")
}


@dataclass(frozen=True, eq=False)
class Rig:
    """A camera and the emitter (projector or modulated lamp) fixed to it.

    Parameters
    ----------
    camera : Intrinsics
    projector : Intrinsics; of a ToF lamp, its field of illumination (the pixel count only names coordinates).
    T_world_camera : (4, 4) float64, maps camera coordinates to world coordinates, metres.
    T_camera_projector : (4, 4) float64, maps projector coordinates to camera coordinates, metres.
    camera_lens, projector_lens : Lens
    projector_power_w : float, mean radiant power that leaves the projector when it shows white.
    """

    camera: Intrinsics
    projector: Intrinsics
    T_world_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    T_camera_projector: np.ndarray = field(default_factory=lambda: np.eye(4))
    camera_lens: Lens = CAMERA_LENS
    projector_lens: Lens = PROJECTOR_LENS
    projector_power_w: Watts = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_camera", pose(self.T_world_camera, "T_world_camera"))
        object.__setattr__(self, "T_camera_projector", pose(self.T_camera_projector, "T_camera_projector"))
        check_fields(self)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Rig) and to_dict(self) == to_dict(other)

    def __hash__(self) -> int:
        return hash((self.camera, self.projector, self.T_world_camera.tobytes(), self.T_camera_projector.tobytes()))

    @classmethod
    def from_dict(cls, data: Any, where: str = "rig") -> Rig:
        """The rig of plain data, see `rangesim.settings.config.from_dict`.

        In captures and calibrations of before lenses were structures, each had its settings beside the others'.
        """
        if isinstance(data, Mapping):
            values = {key: value for key, value in data.items() if key not in _FLAT}
            for key in data.keys() & _FLAT.keys():
                lens, setting = _FLAT[key]
                if not isinstance(values.setdefault(lens, {}), Mapping):
                    raise ValueError(f"{where}.{lens}: expected a table of settings, got {shown(values[lens])}.")
                values[lens] = {**values[lens], setting: data[key]}
            data = values
        return from_dict(cls, data, where)

    def with_camera(
        self, T_camera_other: ArrayLike, intrinsics: Intrinsics | None = None, lens: Lens | None = None
    ) -> Rig:
        """The rig of another camera beside the same emitter, as for active stereo: `transport` takes several at once.

        Parameters
        ----------
        T_camera_other : (4, 4) float64, maps the other camera's coordinates to those of this one, metres. One 0.1 m
            to the right that looks at the same point 0.8 m away: ``look_at((0.1, 0, 0), (0, 0, 0.8), (0, -1, 0))``.
        intrinsics, lens : of the other camera; None: as this one's.

        Raises
        ------
        ValueError
            The matrix is not rigid, or intrinsics or lens are something else.
        """
        T = pose(T_camera_other, "T_camera_other")
        for name, value, kind in (("intrinsics", intrinsics, Intrinsics), ("lens", lens, Lens)):
            if value is not None and not isinstance(value, kind):
                raise ValueError(f"expected {name} as {kind.__name__}, got {shown(value)}.")
        return replace(
            self,
            camera=self.camera if intrinsics is None else intrinsics,
            camera_lens=self.camera_lens if lens is None else lens,
            T_world_camera=self.T_world_camera @ T,
            T_camera_projector=np.linalg.inv(T) @ self.T_camera_projector,
        )

    def shares_emitter(self, other: Rig) -> bool:
        """Whether the emitters of two rigs are one and the same: in one place, with one lens and power."""
        return not self.differences_of_emitter(other)

    def differences_of_emitter(self, other: Rig) -> list[str]:
        """What is not the same of the emitters of two rigs, by name; places may differ by `SAME_PLACE`."""
        found = [
            k for k in ("projector", "projector_lens", "projector_power_w") if getattr(self, k) != getattr(other, k)
        ]
        same = is_same_pose(self.T_world_projector, other.T_world_projector)
        return found if same else [*found, "T_world_projector"]

    def shares_camera_pose(self, other: Rig) -> bool:
        """Whether the cameras of two rigs stand in one place and look the same way."""
        return is_same_pose(self.T_world_camera, other.T_world_camera)

    @property
    def T_world_projector(self) -> Array:
        """(4, 4) float64, maps projector coordinates to world coordinates, metres."""
        return np.asarray(self.T_world_camera @ self.T_camera_projector)

    @property
    def baseline_m(self) -> float:
        """Distance between camera centre and projector centre, metres."""
        return float(np.linalg.norm(self.T_camera_projector[:3, 3]))

    @property
    def projector_irradiance(self) -> float:
        """Irradiance in W/m2 that white casts on a fronto-parallel plane at z = 1 m."""
        p = self.projector
        return self.projector_power_w * p.fx * p.fy / (p.width * p.height)

    @property
    def camera_illumination(self) -> NDArray[np.float32]:
        """(h, w) float32 in 0..1, fraction of the light that vignetting leaves a pixel: cos^n of its ray to the
        axis."""
        rays = self.camera.directions(self.camera.pixel_centres())
        fraction = np.linalg.norm(rays, axis=-1) ** -self.camera_lens.vignetting
        return np.nan_to_num(fraction, nan=0.0).astype(np.float32)  # no ray, no light
