# SPDX-License-Identifier: Apache-2.0
"""Point clouds with normals, organised in the rows and columns of the image that they come from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgraph.kernel_cache import cached_njit
from pcgraph.parallel import MIN_ROWS, in_blocks
from rangesim.rig import Camera, Intrinsics, PixelRays, tangents
from rangesim.settings.config import ShortRepr

COORDINATES = ("camera", "world")
"""Coordinate frames that points may be in."""
FAR_M = 100.0
"""Largest coordinate of a camera in the world, in metres, up to which points in the world have single precision.

Beyond it they have double precision, because neighbouring numbers of single precision are 8 µm apart at 100 m.
"""
SCAN_DTYPES = {"time_s": np.float64, "ring": np.uint16, "return_number": np.uint8}
"""Arrays that scanning instruments tell of each point, with their types."""
NORMAL_RADIUS = 2
"""Radius, in pixels, of the window of (2 r + 1)^2 pixels that a normal is fitted to.

A larger window averages more noise and rounds small details off. Other values were not measured.
"""
MAX_SLOPE = 4.0
"""Largest ratio of depth step to lateral step between two pixels that count as one surface.

With 4, the pixels of a surface keep their neighbours if its normal is up to 76 degrees off the ray. A larger value
joins surfaces across depth edges; with a smaller one, pixels of steep surfaces lose their neighbours.
"""
MAX_ROUGHNESS = 0.01
"""Largest standard deviation of the points about the plane that a scanner's normal is fitted to, as a fraction of the
range. Rays of a scanner are far apart, so a window often holds parts of several surfaces. On a scene of a street, 5 %
of the normals of a VLP-16 are off by more than 30 degrees with it, instead of 13 %, and 11 % are unknown."""
STEP_FLOOR = 0.005
"""Fraction of z by which the depths of neighbours on one surface may always differ, so that noise separates none."""


@dataclass(frozen=True, eq=False, repr=False)
class PointCloud(ShortRepr):
    """Points, organised as the image they come from (h, w, ...) or as a list (n, ...).

    Parameters
    ----------
    points : (h, w, 3) or (n, 3) float32, metres, in `coordinates`; NaN where there is no point. They are float64 in
        world coordinates if the camera is more than `FAR_M` from the origin.
    coordinates : "camera" (OpenCV: x right, y down, z forward) or "world".
    normals : (..., 3) float32, unit vectors towards the camera, in `coordinates`; NaN where unknown, but 0 in the
        result of `finite`. None: not known.
    intensity : (...) float32, in the units of the capture's frames. None: not known.
    colors : (..., 3) uint8, RGB. None: not known.
    confidence : (...) float32 in 0..1, see `RangeImage`. None: not known.
    time_s : (...) float64, seconds, when each point was measured, after the first ray of its scan. None: not known.
    ring : (...) uint16, number of the beam that measured each point, from the uppermost (0) downwards unless its maker
        counts otherwise. None: not known.
    return_number : (...) uint8, 1 for the first return of a ray, 2 for the second. None: not known.

    Raises
    ------
    ValueError
        The coordinates are unknown, the arrays do not fit together, or `ring` or `return_number` has another type.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim import PointCloud
    >>> points = np.array([[[0, 0, 1], [0.1, 0, 1], [np.nan, np.nan, np.nan]]], dtype=np.float32)
    >>> cloud = PointCloud(points, intensity=np.array([[10, 20, 0]], dtype=np.float32))
    >>> cloud.valid
    array([[ True,  True, False]])
    >>> cloud.finite().points.shape, cloud.finite().intensity
    ((2, 3), array([10., 20.], dtype=float32))
    """

    points: np.ndarray
    coordinates: str = "camera"
    normals: np.ndarray | None = None
    intensity: np.ndarray | None = None
    colors: np.ndarray | None = None
    confidence: np.ndarray | None = None
    time_s: np.ndarray | None = None
    ring: np.ndarray | None = None
    return_number: np.ndarray | None = None

    def __post_init__(self) -> None:
        shape = self.points.shape
        if len(shape) not in (2, 3) or shape[-1] != 3:
            raise ValueError(f"expected points of shape (n, 3) or (h, w, 3), got {shape}.")
        if self.coordinates not in COORDINATES:
            raise ValueError(f"expected coordinates to be one of {', '.join(COORDINATES)}, got {self.coordinates!r}.")
        for name, value in self.attributes().items():
            if value.shape not in (shape[:-1], shape):
                raise ValueError(f"expected {name} of shape {shape[:-1]} or {shape}, got {value.shape}.")
        for name, dtype in SCAN_DTYPES.items():
            value = getattr(self, name)
            if value is not None and (value.dtype != dtype or value.shape != shape[:-1]):
                raise ValueError(
                    f"expected {name} of shape {shape[:-1]} and type {np.dtype(dtype)}, "
                    f"got {value.shape} and {value.dtype}."
                )

    def attributes(self) -> dict[str, np.ndarray]:
        """Arrays besides the points that are not None, by name."""
        names = ("normals", "intensity", "colors", "confidence", *SCAN_DTYPES)
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    @property
    def valid(self) -> np.ndarray:
        """(...) bool, whether there is a point."""
        return np.asarray(np.isfinite(self.points).all(axis=-1))

    def finite(self) -> PointCloud:
        """The points that are finite, as a list (n, ...), row by row.

        Unknown normals become 0, because many programs compute from all normals, and one NaN spoils their result.
        """
        keep = self.valid
        kept = {k: v[keep] for k, v in self.attributes().items()}
        if "normals" in kept:
            kept["normals"] = np.nan_to_num(kept["normals"])
        return replace(self, points=self.points[keep], **kept)

    def save(self, path: str | Path) -> None:
        """Write a `.ply` file (finite points only) or a `.pcd` file (organised, with NaN).

        It raises the errors of `rangesim.point_cloud.point_cloud_files.save_point_cloud`.
        """
        from rangesim.point_cloud.point_cloud_files import save_point_cloud

        save_point_cloud(self, path)

    def to_open3d(self) -> Any:
        """`open3d.geometry.PointCloud` of the finite points, with normals and colours; where the cloud has no colours,
        its intensity gives grey values."""
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
    reading_m: np.ndarray,
    camera: Camera,
    T_world_camera: np.ndarray,
    intensity: np.ndarray,
    confidence: np.ndarray,
    coordinates: str = "camera",
) -> PointCloud:
    """Organised point cloud of an image of readings, with normals, and with the times and rings of a scanner.

    Parameters
    ----------
    reading_m : (h, w) float32, metres, depths z along the optical axis of a pinhole camera, or ranges along the rays of
        any other; NaN where there is no reading.
    camera : Camera of the image. The normals are unknown (None) if its pixels have no neighbours.
    T_world_camera : (4, 4) float64, maps camera coordinates to world coordinates, metres.
    intensity : (h, w) float32, in the units of the capture's frames; the cloud's grey colours are made from it.
    confidence : (h, w) float32 in 0..1.
    coordinates : "camera" or "world", the frame of the points and normals.

    Raises
    ------
    ValueError
        The coordinates are unknown.

    Examples
    --------
    A wall at 1 m, seen by a camera of 4 x 3 pixels:

    >>> import numpy as np
    >>> from rangesim.point_cloud import organised_cloud
    >>> from rangesim.rig import Camera, Intrinsics, tangents
    >>> z = np.ones((3, 4), dtype=np.float32)
    >>> cloud = organised_cloud(z, Intrinsics.from_fov(4, 3, 60), np.eye(4), intensity=z, confidence=z)
    >>> cloud.points.shape
    (3, 4, 3)
    >>> cloud.normals[1, 1].round(6) + 0
    array([ 0.,  0., -1.], dtype=float32)
    """
    if coordinates not in COORDINATES:
        raise ValueError(f"expected coordinates to be one of {', '.join(COORDINATES)}, got {coordinates!r}.")
    depth, normals = reading_m.astype(np.float64), None
    if isinstance(camera, Intrinsics):
        rays = camera.directions(camera.pixel_centres())
        points, normals = rays * depth[..., None], lattice_normals(depth, rays)
    else:
        table = camera.rays
        points = table.origins + table.directions * depth[..., None]
        if camera.has_neighbours:
            normals = _ordered_normals(points, table, camera.lattice)
    kind: type[np.floating] = np.float32
    if coordinates == "world":
        rotation, origin = T_world_camera[:3, :3], T_world_camera[:3, 3]
        points = points @ rotation.T + origin
        normals = None if normals is None else normals @ rotation.T
        kind = np.float64 if np.abs(origin).max() > FAR_M else kind
    return PointCloud(
        points=points.astype(kind),
        coordinates=coordinates,
        normals=None if normals is None else normals.astype(np.float32),
        intensity=intensity,
        colors=_grey_colors(intensity, np.isfinite(reading_m)),
        confidence=confidence,
        time_s=camera.times_s,
        ring=camera.rings,
    )


def lattice_normals(z: np.ndarray, rays: np.ndarray, radius: int = NORMAL_RADIUS) -> np.ndarray:
    """(h, w, 3) float64 unit normals towards the camera, in camera coordinates, of a depth image; NaN where there is no
    surface.

    On a plane n.X = 1 the inverse depth is linear in the image, 1/z = n.(x, y, 1). The function fits n by least squares
    to the window around each pixel. It leaves out pixels across a depth step, so that edges are not rounded off.

    Parameters
    ----------
    z : (h, w) float, metres; NaN where there is no reading.
    rays : (h, w, 3) float, directions of the pixels with z = 1, camera coordinates.
    radius : pixels, see `NORMAL_RADIUS`.
    """
    steps = np.arange(-radius, radius + 1)
    limits = np.maximum(MAX_SLOPE * np.hypot(*np.meshgrid(steps, steps)) * _pixel_size(rays), STEP_FLOOR)
    normals = np.empty((*z.shape, 3))
    arguments = (radius, limits, z, 1 / z, np.ascontiguousarray(rays, dtype=np.float64), normals)
    in_blocks(_fit_normals, len(z), *arguments, smallest=MIN_ROWS)
    return normals


def _ordered_normals(points: np.ndarray, rays: PixelRays, lattice: NDArray[np.int64] | None) -> np.ndarray:
    """(h, w, 3) normals of points on rays, fitted where the rays lie on a lattice, see `Camera.lattice`."""
    if lattice is None:
        return ray_normals(points, rays.origins, rays.directions)
    result = np.empty(points.shape)
    laid_out, origins, directions = (a.reshape(-1, 3)[lattice] for a in (points, rays.origins, rays.directions))
    result.reshape(-1, 3)[lattice.ravel()] = ray_normals(laid_out, origins, directions).reshape(-1, 3)
    return result


def ray_normals(
    points: np.ndarray, origins: np.ndarray, directions: np.ndarray, radius: int = NORMAL_RADIUS
) -> np.ndarray:
    """(h, w, 3) float64 unit normals towards the camera of points on rays that are no pinhole's; NaN where there is no
    surface.

    The method is that of `lattice_normals`, in the frame of each pixel's own ray: x to the right of the ray, y down and
    z along it. It leaves out points whose depths differ by more than `MAX_SLOPE` times the angle to them and by more
    than `STEP_FLOOR`. There is no normal where the points are rougher than `MAX_ROUGHNESS`.

    Parameters
    ----------
    points, origins, directions : (h, w, 3) float, metres and unit, the points, and the rays that they lie on.
    radius : pixels, see `NORMAL_RADIUS`.
    """
    right, down = tangents(directions)
    normals, reach = np.empty(points.shape), _reach(directions, radius)
    arrays = (np.ascontiguousarray(a, dtype=np.float64) for a in (points, origins, right, down, directions))
    in_blocks(_fit_ray_normals, len(points), radius, reach, *arrays, normals, smallest=MIN_ROWS)
    return normals


def _reach(directions: np.ndarray, radius: int) -> float:
    """Largest tangent of the angle between a ray and those that count for its normal.

    It takes in the whole window where rays are spaced alike along rows and columns. Where the spacing along one is much
    larger, it takes in the next rays along that one alone: farther ones see other surfaces.
    """
    steps = [np.linalg.norm(np.diff(directions, axis=axis), axis=-1) for axis in (0, 1)]
    spacing = [float(np.nanmedian(s)) for s in steps if s.size]
    return max(np.sqrt(2) * radius * min(spacing), 1.5 * max(spacing)) if spacing else np.inf


@cached_njit(nogil=True, error_model="numpy")
def _regressed(n, x, y, v, xx, xy, yy, xv, yv):  # type: ignore[no-untyped-def]
    """Slopes a, b and value c of the plane v = a x + b y + c through n points: least squares, from sums over them.

    With them come the determinant of the spread of (x, y), which is 0 where the points do not determine the slopes, the
    diagonal of that spread, and the sum of squares of v that the slopes explain.
    """
    count = max(n, 1.0)
    sxx, sxy, syy = xx - x * x / count, xy - x * y / count, yy - y * y / count
    sxv, syv = xv - x * v / count, yv - y * v / count
    determinant = sxx * syy - sxy * sxy
    divisor = determinant if determinant != 0.0 else 1.0
    a, b = (sxv * syy - syv * sxy) / divisor, (syv * sxx - sxv * sxy) / divisor
    return a, b, (v - a * x - b * y) / count, determinant, sxx, syy, a * sxv + b * syv


@cached_njit(nogil=True, error_model="numpy")
def _fit_ray_normals(start, stop, radius, reach, points, origins, right, down, along, normals):  # type: ignore[no-untyped-def]
    """Write the normals of the rows from `start` to `stop`."""
    h, w = points.shape[:2]
    local = np.empty(3)
    for row in range(start, stop):
        for column in range(w):
            range_m = 0.0
            for k in range(3):
                range_m += (points[row, column, k] - origins[row, column, k]) * along[row, column, k]
            n = x = y = v = xx = xy = yy = xv = yv = vv = 0.0
            for i in range(max(0, row - radius), min(h, row + radius + 1)):
                for j in range(max(0, column - radius), min(w, column + radius + 1)):
                    local[:] = 0.0
                    for k in range(3):
                        d = points[i, j, k] - origins[row, column, k]
                        local[0] += d * right[row, column, k]
                        local[1] += d * down[row, column, k]
                        local[2] += d * along[row, column, k]
                    if not local[2] > 0:  # also if a range is NaN
                        continue
                    dx, dy, dv = local[0] / local[2], local[1] / local[2], 1 / local[2] - 1 / range_m
                    angle = np.sqrt(dx * dx + dy * dy)
                    limit = max(MAX_SLOPE * angle, STEP_FLOOR) * range_m
                    if abs(local[2] - range_m) <= limit and angle <= 1.01 * reach:
                        n += 1
                        x += dx
                        y += dy
                        v += dv
                        vv += dv * dv
                        xx += dx * dx
                        xy += dx * dy
                        yy += dy * dy
                        xv += dx * dv
                        yv += dy * dv
            a, b, offset, determinant, sxx, syy, explained = _regressed(n, x, y, v, xx, xy, yy, xv, yv)
            if n < 3 or not determinant > 1e-3 * sxx * syy:
                normals[row, column] = np.nan
                continue
            scatter = (vv - v * v / n - explained) / n  # of inverse depths about the plane
            if scatter * range_m * range_m > MAX_ROUGHNESS * MAX_ROUGHNESS:
                normals[row, column] = np.nan
                continue
            c = 1 / range_m + offset
            length = np.sqrt(a * a + b * b + c * c)
            for k in range(3):
                normals[row, column, k] = (
                    -(a * right[row, column, k] + b * down[row, column, k] + c * along[row, column, k]) / length
                )


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
                    if abs(z[i, j] - z[row, column]) <= limit:  # False if a depth is NaN
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
            a, b, offset, determinant, sxx, syy, _ = _regressed(n, x, y, v, xx, xy, yy, xv, yv)
            if n < 3 or not determinant > 1e-3 * max(sxx, syy) ** 2:
                normals[row, column] = np.nan
                continue
            centre = inverse[row, column] + offset
            c = centre - a * rays[row, column, 0] - b * rays[row, column, 1]
            length = np.sqrt(a * a + b * b + c * c)
            for k, component in enumerate((a, b, c)):
                normals[row, column, k] = -component / length


def _pixel_size(rays: np.ndarray) -> float:
    """Median step between neighbouring rays of a row, at z = 1."""
    return float(np.median(np.abs(np.diff(rays[..., 0], axis=1)))) if rays.shape[1] > 1 else 1.0


def _grey_colors(intensity: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 grey for display, with gamma 2.2; the 99th percentile of the valid pixels is white."""
    bright = float(np.percentile(intensity[valid], 99)) if valid.any() else 0.0
    fraction = np.clip(np.nan_to_num(intensity) / (bright if bright > 0 else 1.0), 0, 1) ** (1 / 2.2)
    return np.repeat(np.rint(255 * fraction).astype(np.uint8)[..., None], 3, axis=-1)
