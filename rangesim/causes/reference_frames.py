# SPDX-License-Identifier: Apache-2.0
"""Noise-free frames of the straight light paths to the true surface alone, without any other light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rangesim.response import DenseResponse, LightPath, NumpyMath, Response, SparseResponse
from rangesim.rig import Beam, Rig
from rangesim.sensor import Sensor
from rangesim.signals import GroundTruth

_CHUNK_VALUES = 4_000_000
"""Largest number of weights that are computed at once, so that they take at most 32 MB. It changes no result."""
FOOTPRINT_PATHS = 55
"""Number of light paths over the area of a pixel, on a Fibonacci lattice.

With 55 paths, stripes of a twentieth of a pixel are resolved, because the points of the lattice lie evenly along both
sides of the pixel and over its area. More paths take more time.
"""
FOOTPRINT_STEP = 34
"""Step of the lattice along the second side of the pixel, counted in lattice points.

It is the Fibonacci number before `FOOTPRINT_PATHS`, because two such numbers make the lattice even.
"""
TEXTURE_PATHS = 13
"""Number of light paths over the area of a pixel for sensors that compare texture.

Every pixel of every camera then needs its area. Dots are about as wide as a pixel, so fewer paths than
`FOOTPRINT_PATHS` suffice. With 55, `explain` takes three times as long, and no failed pixel of the tabletop gets
another cause.
"""
TEXTURE_STEP = 8
"""Step of the lattice with `TEXTURE_PATHS`, counted in lattice points: the Fibonacci number before it, see
`FOOTPRINT_STEP`."""


Pixels = np.ndarray | tuple[np.ndarray, np.ndarray]
"""Which n pixels of an image are meant: a mask (h, w), or their rows and columns (n,)."""


def single_path_frames(sensor: Sensor, rig: Rig, truth: GroundTruth) -> np.ndarray:
    """(k, h, w) float32, W/m2/sr, frames of the straight path to the true point of each pixel, with a radiance of 1.

    Where a reading of these frames is wrong, no other light is to blame: the distance is beyond the range of the
    sensor, or the sensor's resolution is too coarse. Pixels without a surface get no light.
    """
    return footprint_frames(sensor, rig, truth, np.zeros(truth.z.shape, dtype=bool))


def footprint_frames(sensor: Sensor, rig: Rig, truth: GroundTruth, spread: np.ndarray) -> np.ndarray:
    """(k, h, w) float32, W/m2/sr, frames of straight paths that cover the whole area of some pixels.

    In the pixels `spread`, the frames are the mean over `FOOTPRINT_PATHS` (or `TEXTURE_PATHS`) straight paths to the
    tangent plane of the surface. In the other pixels they are as in `single_path_frames`. Where a reading of these
    frames is wrong, the pixel is too coarse for the pattern, or covers too many distances of its one surface. Where
    such a reading is correct, the inclination of the surface alone does no harm.

    Parameters
    ----------
    spread : (h, w) bool, pixels that have a surface.
    """
    where = np.isfinite(truth.z)
    channels = [np.zeros((response.channels, *where.shape), dtype=np.float32) for response in sensor.responses()]
    for some, is_spread in ((where & ~spread, False), (spread, True)):
        if some.any():
            for image, values in zip(channels, straight_light(sensor, rig, truth, some, is_spread), strict=True):
                image[:, some] = values
    return sensor.frames(channels, where.astype(np.float32), np.zeros(where.shape, dtype=np.float32))


def frames_of_pixels(
    sensor: Sensor, rig: Rig, truth: GroundTruth, where: np.ndarray, is_spread: bool = False
) -> np.ndarray:
    """(k, 1, n) float32, W/m2/sr, frames of n pixels alone, as `straight_light` lights them.

    They are those of `single_path_frames`, or of `footprint_frames`, for a sensor that is read by pixel
    (`Decoder.pixel_reader`).
    """
    light = straight_light(sensor, rig, truth, where, is_spread)
    white = np.ones((1, np.count_nonzero(where)), dtype=np.float32)
    return sensor.frames([values[:, None] for values in light], white, np.zeros_like(white))


def straight_light(
    sensor: Sensor, rig: Rig, truth: GroundTruth, where: np.ndarray, is_spread: bool
) -> list[np.ndarray]:
    """Channels (c, n) float32, W/m2/sr, of each response of a sensor: straight paths to n pixels, of radiance 1.

    Parameters
    ----------
    where : (h, w) bool, the n pixels, which have a surface.
    is_spread : whether the paths cover the whole area of each pixel. If not, there is one, through its centre.
    """
    paths, step = (TEXTURE_PATHS, TEXTURE_STEP) if sensor.compares_texture else (FOOTPRINT_PATHS, FOOTPRINT_STEP)
    reading, n = rig.camera.reading(truth), np.arange(paths)[:, None]
    offsets = (n + 0.5) * np.array([1, step]) / paths % 1.0 - 0.5
    rows, columns = np.nonzero(where)
    light = [np.zeros((response.channels, len(rows)), dtype=np.float32) for response in sensor.responses()]
    most = sum(response.channels for response in sensor.responses()) * (paths if is_spread else 1)
    together = max(1, _CHUNK_VALUES // max(most, 1))
    for begin in range(0, len(rows), together):
        part = slice(begin, begin + together)
        at = rows[part], columns[part]
        path = _paths_beside(rig, truth, reading, at, offsets) if is_spread else _straight_path(rig, truth, reading, at)
        for response, values in zip(sensor.responses(), light, strict=True):
            _add(values[:, part], response, path)
    return light


def _add(values: np.ndarray, response: Response, path: LightPath) -> None:
    """Add the mean over m light paths to each of n pixels to the channels of a response.

    Parameters
    ----------
    values : (c, n) float32; they are changed. path : LightPath of (m, n) paths.
    """
    radiance = 1 / len(path.u)
    if isinstance(response, SparseResponse):
        every = [np.broadcast_arrays(*pair, path.u)[:2] for pair in response.bin_weights(path, NumpyMath())]
        pairs = [(bins.astype(np.intp), radiance * parts, bins < response.channels) for bins, parts in every]
        for n in range(len(path.u)):
            for bins, parts, inside in pairs:
                (pixels,) = np.nonzero(inside[n])
                values[bins[n, pixels], pixels] += parts[n, pixels]
        return
    assert isinstance(response, DenseResponse)
    weights = [np.broadcast_to(w, path.u.shape).astype(np.float32) for w in response.weights(path, NumpyMath())]
    for n in range(len(path.u)):  # one after the other, so that the sum does not depend on the number of pixels
        for row, weight in zip(values, weights, strict=True):
            row += radiance * weight[n]


def points_in_projector(rig: Rig, reading: np.ndarray, where: Pixels) -> np.ndarray:
    """(n, 3) float64 points at these readings (h, w) of n pixels, in projector coordinates, metres.

    Coordinates of a beam are those of the camera, from the emitter of each ray.
    """
    origins, directions = rig.camera.rays_at(where)
    points = origins + directions * reading[where].astype(np.float64)[:, None]
    return _to_projector(rig, where, origins)(points)


def _to_projector(rig: Rig, where: Pixels, origins: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Function from points (..., n, 3) in camera coordinates to those in projector coordinates, metres.

    where : the n pixels of the points. origins : (n, 3), origins of the rays through their centres.
    """
    if isinstance(rig.projector, Beam):
        emitters = rig.emitter_offsets[where]
        return lambda points: np.asarray(points - origins - emitters)
    return lambda points: np.asarray((points - rig.T_camera_projector[:3, 3]) @ rig.T_camera_projector[:3, :3])


def _straight_path(rig: Rig, truth: GroundTruth, reading: np.ndarray, where: Pixels) -> LightPath:
    """Direct path to the true point of each of n pixels, as (1, n) paths; a point outside the projector's image is
    clamped to the nearest place in it."""
    return _path(rig, points_in_projector(rig, reading, where)[None], truth.range_m[where][None])


def _paths_beside(rig: Rig, truth: GroundTruth, reading: np.ndarray, where: Pixels, offsets: np.ndarray) -> LightPath:
    """(m, n) light paths as in `_straight_path`, but to the tangent planes, at m offsets (m, 2), pixels, beside the
    centres."""
    planes = TangentPlanes(rig, truth, reading, where)
    origins, rays = rig.camera.rays_beside(where)(offsets[:, None])
    readings = planes.readings(origins, rays)
    along = rays * np.where(np.isfinite(readings), readings, planes.at_centres)[..., None]
    points = _to_projector(rig, where, planes.origins)(origins + along)
    return _path(rig, points, np.linalg.norm(along, axis=-1))


class TangentPlanes:
    """Tangent planes of the surfaces at the centres of n pixels.

    Parameters
    ----------
    reading : (h, w) float32, metres, true readings. where : the n pixels.

    Attributes
    ----------
    origins : (n, 3) float64, metres, camera coordinates, origins of the rays through the centres.
    at_centres : (n,) float32, metres, readings along these rays.
    """

    def __init__(self, rig: Rig, truth: GroundTruth, reading: np.ndarray, where: Pixels) -> None:
        self.origins, rays = rig.camera.rays_at(where)
        self.at_centres = reading[where]
        self._normals = truth.normal[where].astype(np.float64) @ rig.T_world_camera[:3, :3]
        self._heights = self.at_centres * np.sum(self._normals * rays, axis=-1)

    def readings(self, origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """(..., n) float64 readings, metres, where rays meet the planes; NaN behind the camera, or where they never do.

        origins, rays : (..., n, 3) float, camera coordinates, as `Camera.rays_at` returns them.
        """
        approach = np.sum(self._normals * rays, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            result = self._heights / approach + np.sum(self._normals * (self.origins - origins), axis=-1) / approach
        return np.where(np.isfinite(result) & (result > 0), result, np.nan)


def _path(rig: Rig, point: np.ndarray, range_m: np.ndarray) -> LightPath:
    """Light paths to points (m, n, 3), metres, in projector coordinates, at distances `range_m` (m, n) from the
    camera."""
    if isinstance(rig.projector, Beam):
        middle = np.full(range_m.shape, 0.5)
        return LightPath(middle, middle, range_m + np.linalg.norm(point, axis=-1), True)
    uv = np.nan_to_num(rig.image_projector.project(point))
    u, v = np.clip(uv[..., 0], 0, rig.projector.width), np.clip(uv[..., 1], 0, rig.projector.height)
    return LightPath(u, v, range_m + np.linalg.norm(point, axis=-1), True)
