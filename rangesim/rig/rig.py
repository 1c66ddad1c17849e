# SPDX-License-Identifier: Apache-2.0
"""A rig: a camera and an emitter, their lenses, and their poses.

Coordinates of a device follow OpenCV: x right, y down, z forward, metres. `T_a_b` maps coordinates of b to coordinates
of a.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.rig import camera_model
from rangesim.rig.camera_model import CameraModel, fold_radius2
from rangesim.rig.cover_glass import CoverGlass
from rangesim.settings import limits
from rangesim.settings.bounds import (
    MAX_COORDINATE_M,
    Bounds,
    Exponent,
    Metres,
    Watts,
    Wavelength,
    check_fields,
    check_number,
    whole,
)
from rangesim.settings.config import from_dict, shown, to_dict

Array = NDArray[np.float64]
"""An array of float64."""

SAME_PLACE = 1e-5
"""Largest difference of two poses, in metres and radians, that count as the same place. Poses that were computed along
different ways differ by rounding, about 1e-16. A pose that differs by less than 10 um is no other place either, because
nobody can adjust a device so finely."""
ROTATION_TOLERANCE = 1e-4
"""Largest entry of |R R^T - I|, dimensionless, of a matrix that counts as a rotation. A matrix written with five
decimals is off by at most 2e-5 and passes; a scale of 1.0001 does not."""
RESIDUAL_PX = 1e-3
"""Pixels by which a ray may miss its pixel when it is projected again; if it misses by more, the pixel has no ray.
After Newton's method the miss is far below this value where the lens model has an inverse, and far above it
elsewhere."""
FocalLength = Annotated[float, Bounds("positive and finite", 1e-3, 1e9)]
"""A focal length in pixels; the bounds only exclude nonsense."""
PrincipalPoint = Annotated[float, Bounds("a pixel coordinate", -1e9, 1e9)]
"""A coordinate of the principal point in pixels; it may lie outside the image, so the bounds only exclude nonsense."""
Coefficient = Annotated[float, Bounds("a coefficient", -1e6, 1e6)]
"""A coefficient of distortion, dimensionless; the bounds only exclude nonsense."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a camera or projector: a pinhole with Brown-Conrady distortion, the model of OpenCV.

    Pixel coordinates (x, y) begin at the upper left corner of the image. Pixel centres lie at integer + 0.5 (OpenCV has
    them at integers), so the middle of the image is (width / 2, height / 2).

    Parameters
    ----------
    width, height : int, size of the image, pixels.
    fx, fy : float, focal lengths, pixels.
    cx, cy : float, principal point, pixels.
    distortion : tuple of 0 to 5 floats, the coefficients k1, k2, p1, p2, k3 in OpenCV's order; missing ones are 0.

    Raises
    ------
    ValueError
        A value out of its bounds, more than five coefficients, or more pixels than `rangesim.settings.limits` allows.

    Examples
    --------
    >>> camera = Intrinsics(640, 480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> camera.project([0.1, 0.0, 1.0])
    array([370., 240.])
    >>> camera.directions([370.0, 240.0])
    array([0.1, 0. , 1. ])
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
        """Intrinsics with square pixels, the principal point in the middle, and no distortion.

        fov_x_deg : horizontal field of view, degrees.

        Examples
        --------
        >>> round(Intrinsics.from_fov(640, 480, fov_x_deg=90.0).fx, 6)
        320.0
        """
        check_number("fov_x_deg", fov_x_deg, Bounds("degrees between 0 and 180", 1e-6, 180 - 1e-6))
        for name, value in (("width", width), ("height", height)):
            check_number(name, value, whole(1))
        f = 0.5 * width / np.tan(np.radians(fov_x_deg) / 2)
        return cls(width, height, float(f), float(f), width / 2, height / 2)

    def resized(self, width: int, height: int) -> Intrinsics:
        """Intrinsics of the same lens with another number of pixels.

        The horizontal field of view and the shape of the pixels stay the same.
        """
        for name, value in (("width", width), ("height", height)):
            check_number(name, value, whole(1, "pixels"))
        scale = width / self.width
        cx, cy = (self.cx - self.width / 2) * scale + width / 2, (self.cy - self.height / 2) * scale + height / 2
        return Intrinsics(width, height, self.fx * scale, self.fy * scale, cx, cy, self.distortion)

    def pixel_centres(self, rows: slice = slice(None)) -> Array:
        """(height, width, 2) float64, pixel coordinates (x, y) of the pixel centres.

        rows : the rows to return; default all.
        """
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height)[rows] + 0.5)
        return np.stack([x, y], axis=-1)

    def normalise(self, pixels: ArrayLike) -> Array:
        """(..., 2) float64, undistorted coordinates x/z, y/z on the image plane of pixel coordinates (..., 2).

        NaN where the distortion has no inverse, that is beyond the radius at which its polynomial stops growing.
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
        """(..., 2) float64, pixel coordinates of points (..., 3) in coordinates of this device, metres.

        NaN behind the device, and beyond the radius at which the polynomial of the distortion stops growing.
        """
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
        """(..., 3) float64, directions of the rays through pixel coordinates (..., 2), scaled to z = 1.

        NaN where `normalise` has NaN.
        """
        xy = self.normalise(pixels)
        result = np.ones((*xy.shape[:-1], 3))
        result[..., :2] = xy
        return result

    @property
    def coefficients(self) -> tuple[float, float, float, float, float]:
        """All five coefficients k1, k2, p1, p2, k3; missing ones are 0."""
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
    """A rigid transform as a read-only (4, 4) float64 copy.

    name : what the transform is, for the message.

    Raises
    ------
    ValueError
        The matrix is not a rotation and a translation of at most `MAX_COORDINATE_M`.
    """
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
        raise ValueError(f"expected {name} to be rigid (a rotation and a translation in metres), got {T.tolist()}.")


def is_same_pose(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two poses (4, 4) are equal within `SAME_PLACE`."""
    return bool(np.abs(np.linalg.inv(first) @ second - np.eye(4)).max() <= SAME_PLACE)


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """(4, 4) float64, T_world_device of a device at `origin` that looks at `target`.

    Parameters
    ----------
    origin, target : (3,) metres, world.
    up : (3,) direction in the world that is upwards in the image.

    Raises
    ------
    ValueError
        A coordinate that is not finite, `target` at `origin`, or `up` along the direction of view.

    Examples
    --------
    A camera 2 m above the ground that looks straight down; the last two columns are its direction of view and place:

    >>> T = look_at((0, 0, 2), (0, 0, 0), up=(0, 1, 0))
    >>> T[:3, 2], T[:3, 3]
    (array([ 0.,  0., -1.]), array([0., 0., 2.]))
    """
    o, t, u = (np.asarray(a, dtype=np.float64) for a in (origin, target, up))
    for name, value in (("origin", o), ("target", t), ("up", u)):
        if value.shape != (3,) or not (np.abs(value) <= MAX_COORDINATE_M).all():
            raise ValueError(f"expected {name} to be three finite coordinates, got {shown(value.tolist())}.")
    z = t - o
    x = np.cross(z, u)
    if np.linalg.norm(z) == 0 or np.linalg.norm(x) == 0:
        raise ValueError(
            f"expected target {t.tolist()} to differ from origin {o.tolist()}, and not to lie along up {u.tolist()}."
        )
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    result = np.eye(4)
    result[:3] = np.stack([x, np.cross(z, x), z, o], axis=1)
    return result


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

    Examples
    --------
    >>> Lens(aperture_radius_m=2e-3, focus_m=0.8, vignetting=4)
    Lens(aperture_radius_m=0.002, focus_m=0.8, vignetting=4)
    """

    aperture_radius_m: Metres
    focus_m: Metres | None = None
    vignetting: Exponent = 0.0

    def __post_init__(self) -> None:
        check_fields(self)


CAMERA_LENS = Lens(0.75e-3)
"""Default lens of a camera: everything in focus, an even image, a pupil of 1.5 mm (f = 6 mm at f/4)."""
PROJECTOR_LENS = Lens(2e-3)
"""Default lens of a projector: everything in focus, an even image, a pupil of 4 mm."""


def translation(x: float, y: float, z: float) -> Array:
    """(4, 4) float64, the translation by (x, y, z), metres."""
    result = np.eye(4)
    result[:3, 3] = x, y, z
    return result


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
    intrinsics too: they describe its field of illumination, and its pixels serve only as coordinates.

    Parameters
    ----------
    camera, projector : Intrinsics
    T_world_camera : (4, 4) float64, rigid, maps camera coordinates to world coordinates, metres.
    T_camera_projector : (4, 4) float64, rigid, maps projector coordinates to camera coordinates, metres.
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
    >>> camera = Intrinsics.from_fov(640, 480, fov_x_deg=50.0)
    >>> projector = Intrinsics.from_fov(1280, 800, fov_x_deg=60.0)
    >>> beside = look_at((0.2, 0, 0), (0, 0, 1), up=(0, -1, 0))  # 0.2 m to the right of the camera, turned inwards
    >>> Rig(camera, projector, T_camera_projector=beside).baseline_m
    0.2
    """

    camera: Intrinsics
    projector: Intrinsics
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

    def with_camera(
        self, T_camera_other: ArrayLike, intrinsics: Intrinsics | None = None, lens: Lens | None = None
    ) -> Rig:
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
            The matrix is not rigid, `intrinsics` is no Intrinsics, or `lens` is no Lens.
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
        """Whether two rigs have the same emitter: the same intrinsics, lens, power and place."""
        return not self.differences_of_emitter(other)

    def differences_of_emitter(self, other: Rig) -> list[str]:
        """Names of the attributes in which the emitters of two rigs differ; places may differ by `SAME_PLACE`."""
        of_emitter = ("projector", "projector_lens", "projector_power_w", "wavelength_m")
        found = [name for name in of_emitter if getattr(self, name) != getattr(other, name)]
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
        """Irradiance in W/m2 of a fronto-parallel plane at z = 1 m when the projector shows white."""
        p = self.projector
        return self.projector_power_w * p.fx * p.fy / (p.width * p.height)

    @property
    def cover_glass_radiance(self) -> float:
        """Radiance in W/m2/sr of a surface that would bring each pixel as much light as the cover glass; 0 without."""
        if self.cover_glass is None:
            return 0.0
        etendue = np.pi * self.camera_lens.aperture_radius_m**2 / (self.camera.fx * self.camera.fy)
        return float(self.cover_glass.fraction * self.projector_power_w / etendue)

    @property
    def camera_illumination(self) -> NDArray[np.float32]:
        """(h, w) float32, relative illumination of the camera's pixels, from 0 to 1.

        It is cos^n of the angle between a pixel's ray and the optical axis; see `Lens.vignetting`. Pixels without a ray
        have 0.
        """
        rays = self.camera.directions(self.camera.pixel_centres())
        fraction = np.linalg.norm(rays, axis=-1) ** -self.camera_lens.vignetting
        return np.nan_to_num(fraction, nan=0.0).astype(np.float32)
