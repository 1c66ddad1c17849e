# SPDX-License-Identifier: Apache-2.0
"""Points with normals, organised as the image they come from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pcgraph.kernel_cache import cached_njit
from pcgraph.parallel import MIN_ROWS, in_blocks
from rangesim.rig import Intrinsics
from rangesim.settings.config import ShortRepr

COORDINATES = ("camera", "world")
FAR_M = 100.0
"""Coordinates of a camera, in metres, beyond which points in the world are double precision."""
NORMAL_RADIUS = 2
"""Pixels; normals are fitted to a window of (2 r + 1)^2 pixels."""
MAX_SLOPE = 4.0
"""Depth step over lateral step between two pixels of one surface: 4 keeps surfaces seen up to 76 degrees off."""
STEP_FLOOR = 0.005
"""Fraction of z by which neighbours may always differ, for noise."""


@dataclass(frozen=True, eq=False, repr=False)
class PointCloud(ShortRepr):
    """Points, organised as the image they come from (h, w, ...) or as a list (n, ...).

    Parameters
    ----------
    points : (h, w, 3) or (n, 3) float32, metres, in `coordinates`; NaN where there is none. float64 in a world whose
        origin is more than `FAR_M` from the camera.
    coordinates : "camera" (OpenCV: x right, y down, z forward) or "world".
    normals : (..., 3) float32, unit, towards the camera, in `coordinates`; NaN where unknown (0 of `finite`). Or None.
    intensity : (...) float32, the capture's units. Or None.
    colors : (..., 3) uint8, RGB. Or None.
    confidence : (...) float32 in 0..1, see `RangeImage`. Or None.
    """

    points: np.ndarray
    coordinates: str = "camera"
    normals: np.ndarray | None = None
    intensity: np.ndarray | None = None
    colors: np.ndarray | None = None
    confidence: np.ndarray | None = None

    def __post_init__(self) -> None:
        shape = self.points.shape
        if len(shape) not in (2, 3) or shape[-1] != 3:
            raise ValueError(f"expected points of shape (n, 3) or (h, w, 3), got {shape}.")
        if self.coordinates not in COORDINATES:
            raise ValueError(f"expected coordinates to be one of {', '.join(COORDINATES)}, got {self.coordinates!r}.")
        for name, value in self.attributes().items():
            if value.shape not in (shape[:-1], shape):
                raise ValueError(f"expected {name} of shape {shape[:-1]} or {shape}, got {value.shape}.")

    def attributes(self) -> dict[str, np.ndarray]:
        """The arrays that are there beside the points, by name."""
        names = ("normals", "intensity", "colors", "confidence")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    @property
    def valid(self) -> np.ndarray:
        """(...) bool, where there is a point."""
        return np.asarray(np.isfinite(self.points).all(axis=-1))

    def finite(self) -> PointCloud:
        """The points that are there, as a list (n, ...), row by row; normals that are not known are 0, as NaN breaks
        what other programs make of all of them."""
        keep = self.valid
        kept = {k: v[keep] for k, v in self.attributes().items()}
        if "normals" in kept:
            kept["normals"] = np.nan_to_num(kept["normals"])
        return replace(self, points=self.points[keep], **kept)

    def save(self, path: str | Path) -> None:
        """Write `.ply` (the finite points) or `.pcd` (organised, NaN kept); see `point_cloud_files`."""
        from rangesim.point_cloud.point_cloud_files import save_point_cloud

        save_point_cloud(self, path)

    def to_open3d(self) -> Any:
        """`open3d.geometry.PointCloud` of the finite points, with normals and colours (of intensity, if none)."""
        import open3d

        finite = self.finite()
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(finite.points.astype(np.float64)))
        if finite.normals is not None:
            cloud.normals = open3d.utility.Vector3dVector(finite.normals.astype(np.float64))
        if finite.colors is not None:
            cloud.colors = open3d.utility.Vector3dVector(finite.colors / 255.0)
        elif finite.intensity is not None:
            grey = np.clip(finite.intensity / max(np.quantile(finite.intensity, 0.99), 1e-30), 0, 1)
            cloud.colors = open3d.utility.Vector3dVector(np.repeat(grey[:, None], 3, axis=1).astype(np.float64))
        return cloud


def organised_cloud(
    z: np.ndarray,
    camera: Intrinsics,
    T_world_camera: np.ndarray,
    intensity: np.ndarray,
    confidence: np.ndarray,
    coordinates: str = "camera",
) -> PointCloud:
    """Organised point cloud of a depth image, with normals.

    Parameters
    ----------
    z : (h, w) float32, metres, along the optical axis; NaN where there is no reading.
    camera : Intrinsics of the image. T_world_camera : (4, 4) float64, its pose.
    intensity : (h, w) float32, also made into grey colours. confidence : (h, w) float32 in 0..1.
    coordinates : "camera" or "world".

    Raises
    ------
    ValueError
        These coordinates are unknown.
    """
    if coordinates not in COORDINATES:
        raise ValueError(f"expected coordinates to be one of {', '.join(COORDINATES)}, got {coordinates!r}.")
    rays = camera.directions(camera.pixel_centres())
    depth = z.astype(np.float64)
    points, normals = rays * depth[..., None], lattice_normals(depth, rays)
    kind: type[np.floating] = np.float32
    if coordinates == "world":
        rotation, origin = T_world_camera[:3, :3], T_world_camera[:3, 3]
        points, normals = points @ rotation.T + origin, normals @ rotation.T
        kind = np.float64 if np.abs(origin).max() > FAR_M else kind
    return PointCloud(
        points=points.astype(kind),
        coordinates=coordinates,
        normals=normals.astype(np.float32),
        intensity=intensity,
        colors=_grey_colors(intensity, np.isfinite(z)),
        confidence=confidence,
    )


def lattice_normals(z: np.ndarray, rays: np.ndarray, radius: int = NORMAL_RADIUS) -> np.ndarray:
    """(h, w, 3) unit normals towards the camera from depths on an image lattice; NaN where there is no
    surface.

    On a plane n.X = 1 the inverse depth is linear in the image, 1/z = n.(x, y, 1). It is fitted by least
    squares to the window around each pixel; pixels across a depth step are left out, so edges are not rounded
    off.

    Parameters
    ----------
    z : (h, w) float, metres, NaN where invalid. rays : (h, w, 3) float, directions with z = 1, camera coordinates.
    """
    steps = np.arange(-radius, radius + 1)
    limits = np.maximum(MAX_SLOPE * np.hypot(*np.meshgrid(steps, steps)) * _pixel_size(rays), STEP_FLOOR)
    normals = np.empty((*z.shape, 3))
    arguments = (radius, limits, z, 1 / z, np.ascontiguousarray(rays, dtype=np.float64), normals)
    in_blocks(_fit_normals, len(z), *arguments, smallest=MIN_ROWS)
    return normals


@cached_njit(nogil=True, error_model="numpy")
def _fit_normals(start, stop, radius, limits, z, inverse, rays, normals):  # type: ignore[no-untyped-def]
    """Write the normals of the rows from `start` to `stop`."""
    h, w = z.shape
    for row in range(start, stop):
        for column in range(w):
            n = x = y = v = xx = xy = yy = xv = yv = 0.0  # sums over the window, relative to its centre pixel
            for i in range(max(0, row - radius), min(h, row + radius + 1)):
                for j in range(max(0, column - radius), min(w, column + radius + 1)):
                    limit = limits[i - row + radius, j - column + radius] * z[row, column]
                    if abs(z[i, j] - z[row, column]) <= limit:  # False with NaN
                        dx = rays[i, j, 0] - rays[row, column, 0]
                        dy = rays[i, j, 1] - rays[row, column, 1]
                        dv = inverse[i, j] - inverse[row, column]
                        n += 1
                        x += dx
                        y += dy
                        v += dv
                        xx += dx * dx
                        xy += dx * dy
                        yy += dy * dy
                        xv += dx * dv
                        yv += dy * dv
            count = max(n, 1.0)
            sxx, sxy, syy = xx - x * x / count, xy - x * y / count, yy - y * y / count
            sxv, syv = xv - x * v / count, yv - y * v / count
            determinant = sxx * syy - sxy * sxy
            if n < 3 or not determinant > 1e-3 * max(sxx, syy) ** 2:
                normals[row, column] = np.nan
                continue
            a, b = (sxv * syy - syv * sxy) / determinant, (syv * sxx - sxv * sxy) / determinant
            centre = inverse[row, column] + (v - a * x - b * y) / count
            c = centre - a * rays[row, column, 0] - b * rays[row, column, 1]
            length = np.sqrt(a * a + b * b + c * c)
            for k, component in enumerate((a, b, c)):
                normals[row, column, k] = -component / length


def _pixel_size(rays: np.ndarray) -> float:
    """Typical step between neighbouring rays at z = 1."""
    return float(np.median(np.abs(np.diff(rays[..., 0], axis=1)))) if rays.shape[1] > 1 else 1.0


def _grey_colors(intensity: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 grey: the 99th percentile of the valid pixels is white, with display gamma 2.2."""
    bright = float(np.percentile(intensity[valid], 99)) if valid.any() else 0.0
    fraction = np.clip(np.nan_to_num(intensity) / (bright if bright > 0 else 1.0), 0, 1) ** (1 / 2.2)
    return np.repeat(np.rint(255 * fraction).astype(np.uint8)[..., None], 3, axis=-1)
