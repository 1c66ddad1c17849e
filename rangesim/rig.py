# SPDX-License-Identifier: Apache-2.0
"""Where the camera and the emitter are, and how their pixels map to rays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rangesim.config import to_dict

Array = NDArray[np.float64]

RESIDUAL_PX = 1e-3
"""Where the inverse of a lens model reprojects worse than this, there is none."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole with Brown-Conrady distortion, OpenCV's model and frame: x right, y down, z forward.

    Parameters
    ----------
    width, height : int, pixels
    fx, fy, cx, cy : float, pixels; pixel centres lie at integer + 0.5: the middle of an image is (width/2, height/2).
    distortion : tuple of 0 to 5 floats, OpenCV's order k1, k2, p1, p2, k3.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"expected a positive image size, got {self.width} x {self.height}.")
        if not (self.fx > 0 and self.fy > 0 and np.isfinite([self.fx, self.fy, self.cx, self.cy]).all()):
            raise ValueError(f"expected positive finite focal lengths in pixels, got fx {self.fx}, fy {self.fy}.")
        if len(self.distortion) > 5:
            raise ValueError(f"expected at most 5 distortion coefficients, got {len(self.distortion)}.")

    @classmethod
    def from_fov(cls, width: int, height: int, fov_x_deg: float) -> Intrinsics:
        """Square pixels, principal point in the centre, horizontal field of view in degrees."""
        if not 0 < fov_x_deg < 180:
            raise ValueError(f"expected a field of view between 0 and 180 degrees, got {fov_x_deg}.")
        f = 0.5 * width / np.tan(np.radians(fov_x_deg) / 2)
        return cls(width, height, float(f), float(f), width / 2, height / 2)

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same lens with another pixel count; the horizontal field of view and the shape of pixels are kept."""
        scale = width / self.width
        cx, cy = (self.cx - self.width / 2) * scale + width / 2, (self.cy - self.height / 2) * scale + height / 2
        return Intrinsics(width, height, self.fx * scale, self.fy * scale, cx, cy, self.distortion)

    def pixel_centres(self) -> Array:
        """(height, width, 2) pixel coordinates (x, y) of all pixel centres."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return np.stack([x, y], axis=-1)

    def normalise(self, pixels: ArrayLike) -> Array:
        """(..., 2) undistorted image-plane coordinates x/z, y/z of pixel coordinates (..., 2).

        NaN where the distortion has no inverse: beyond the radius at which its polynomial turns round.
        """
        distorted = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        if not any(self.distortion):
            return distorted
        target_x, target_y = np.ascontiguousarray(distorted[..., 0]), np.ascontiguousarray(distorted[..., 1])
        x, y = target_x, target_y
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(50):  # fixed point of Brown-Conrady, as there is no closed inverse
                radial, tangential_x, tangential_y = self._distortion_terms(x, y)
                next_x, next_y = (target_x - tangential_x) / radial, (target_y - tangential_y) / radial
                step = max(np.abs(next_x - x).max(initial=0), np.abs(next_y - y).max(initial=0))
                x, y = next_x, next_y
                if step < 1e-12:
                    break
            radial, tangential_x, tangential_y = self._distortion_terms(x, y)
            off_x, off_y = x * radial + tangential_x - target_x, y * radial + tangential_y - target_y
            inverse = np.hypot(off_x * self.fx, off_y * self.fy) <= RESIDUAL_PX
        return np.where(inverse[..., None], np.stack([x, y], axis=-1), np.nan)

    def project(self, points: ArrayLike) -> Array:
        """(..., 2) pixel coordinates of points (..., 3) in this device's frame; NaN behind it."""
        points = np.asarray(points, dtype=np.float64)
        z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        xy = points[..., :2] / z
        if any(self.distortion):
            x, y = xy[..., 0], xy[..., 1]
            radial, tangential_x, tangential_y = self._distortion_terms(x, y)
            xy = np.stack([x * radial + tangential_x, y * radial + tangential_y], axis=-1)
        return xy * [self.fx, self.fy] + [self.cx, self.cy]

    def directions(self, pixels: ArrayLike) -> Array:
        """(..., 3) ray directions with z = 1 (not unit length) through pixel coordinates (..., 2); NaN where
        `normalise` is."""
        xy = self.normalise(pixels)
        return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)

    def _distortion_terms(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        k1, k2, p1, p2, k3 = (*self.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return radial, 2 * p1 * xy + p2 * (r2 + 2 * xx), p1 * (r2 + 2 * yy) + 2 * p2 * xy


def pose(matrix: ArrayLike, name: str) -> Array:
    """A read-only (4, 4) float64 copy of a rigid transform; ValueError if it is not one."""
    result: Array = np.array(matrix, dtype=np.float64)
    if result.shape != (4, 4) or not np.isfinite(result).all():
        raise ValueError(f"expected {name} to be a finite (4, 4) matrix, got shape {result.shape}.")
    rotation = result[:3, :3]
    rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0
    if not rigid or not np.allclose(result[3], [0, 0, 0, 1]):
        raise ValueError(f"expected {name} to be rigid (a rotation and metres of translation), got {result.tolist()}.")
    result.setflags(write=False)
    return result


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """(4, 4) T_world_device of a device at `origin` that looks at `target`, metres, OpenCV frame."""
    o, t, u = (np.asarray(a, dtype=np.float64) for a in (origin, target, up))
    z = t - o
    x = np.cross(z, u)
    if np.linalg.norm(z) == 0 or np.linalg.norm(x) == 0:
        raise ValueError(f"expected target {t.tolist()} apart from origin {o.tolist()} and not along up {u.tolist()}.")
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    result = np.eye(4)
    result[:3] = np.stack([x, np.cross(z, x), z, o], axis=1)
    return result


def translation(x: float, y: float, z: float) -> Array:
    """(4, 4) pure translation in metres."""
    result = np.eye(4)
    result[:3, 3] = x, y, z
    return result


@dataclass(frozen=True, eq=False)
class Rig:
    """A camera and the emitter (projector or modulated lamp) fixed to it.

    Parameters
    ----------
    camera : Intrinsics
    projector : Intrinsics; of a ToF lamp, its field of illumination (the pixel count only names coordinates).
    T_world_camera : (4, 4) float64, maps camera coordinates to world coordinates, metres.
    T_camera_projector : (4, 4) float64, maps projector coordinates to camera coordinates, metres.
    camera_aperture_radius_m, projector_aperture_radius_m : float, metres, radius of the entrance (exit) pupil.
    projector_power_w : float, mean radiant power that leaves the projector when it shows white.
    """

    camera: Intrinsics
    projector: Intrinsics
    T_world_camera: np.ndarray = field(default_factory=lambda: np.eye(4))
    T_camera_projector: np.ndarray = field(default_factory=lambda: np.eye(4))
    camera_aperture_radius_m: float = 0.75e-3
    projector_aperture_radius_m: float = 2e-3
    projector_power_w: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_camera", pose(self.T_world_camera, "T_world_camera"))
        object.__setattr__(self, "T_camera_projector", pose(self.T_camera_projector, "T_camera_projector"))
        for name in ("camera_aperture_radius_m", "projector_aperture_radius_m", "projector_power_w"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} to be positive, got {getattr(self, name)}.")

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, Rig) and to_dict(self) == to_dict(other)

    def __hash__(self) -> int:
        return hash((self.camera, self.projector, self.T_world_camera.tobytes(), self.T_camera_projector.tobytes()))

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
