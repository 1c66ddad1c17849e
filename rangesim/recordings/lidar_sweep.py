# SPDX-License-Identifier: Apache-2.0
"""One turn of a real LiDAR: what it measured along each ray, in rings and columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pcgraph.io.ouster_packets import columns_of_directions
from rangesim.point_cloud import PointCloud
from rangesim.rig.scan_patterns import ScanRays
from rangesim.settings.config import ShortRepr, shown

INTENSITIES = ("reflectivity", "signal", "near_ir")
"""Arrays of a sweep that can be the intensity of its points."""


@dataclass(frozen=True, eq=False, repr=False)
class LidarSweep(ShortRepr):
    """One turn of a LiDAR: h rings, w columns, k returns per ray.

    The arrays are as the sensor fires: the rays of a column belong to one moment. Where beams lead or follow the head,
    they look in different directions; `destaggered` shifts the rows so that columns are directions.

    Parameters
    ----------
    range_m : (k, h, w) float32, metres, distance from each ray's origin; NaN where there is no return.
    rays : ScanRays of (h, w) rays, metres, coordinates as OpenCV's (x right, y down, z forward); their times are the
        nominal ones.
    time_s : (w,) float64, seconds, when each column was measured, after the first; NaN for a column that is missing.
    start_ns : int, clock of the sensor at the first column, nanoseconds.
    frame : int, number of the turn as the sensor counts.
    pixel_shift : (h,) int64, columns by which `destaggered` shifts each row to the right.
    T_world_camera : (4, 4) float64, maps coordinates of the rays to the device's own ("world"), metres.
    reflectivity : (k, h, w) uint16, reflectivity as the device scales it. None: not known.
    signal : (k, h, w) uint16, photons of the return. None: not known.
    near_ir : (h, w) uint16, photons of the surroundings. None: not known.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig.scan_patterns import spinning
    >>> rays = spinning([0.1, 0.0], columns=4, period_s=0.1)
    >>> ranges = np.full((1, 2, 4), 3.0, dtype=np.float32)
    >>> sweep = LidarSweep(ranges, rays, rays.times_s[0], 0, 1, np.array([1, 0]), np.eye(4))
    >>> cloud = sweep.to_point_cloud()
    >>> cloud.points.shape, cloud.points[1, 1].round(3) + 0
    ((2, 4, 3), array([3., 0., 0.], dtype=float32))
    >>> cloud.ring[1, 1], cloud.time_s[1, 1]
    (np.uint16(1), np.float64(0.025))
    >>> sweep.destaggered(np.array([[10, 11, 12, 13], [20, 21, 22, 23]]))
    array([[13, 10, 11, 12],
           [20, 21, 22, 23]])
    """

    range_m: NDArray[np.float32]
    rays: ScanRays
    time_s: NDArray[np.float64]
    start_ns: int
    frame: int
    pixel_shift: NDArray[np.int64]
    T_world_camera: NDArray[np.float64]
    reflectivity: NDArray[np.uint16] | None = None
    signal: NDArray[np.uint16] | None = None
    near_ir: NDArray[np.uint16] | None = None

    @property
    def returns(self) -> int:
        """Largest number of returns of one ray."""
        return len(self.range_m)

    @property
    def is_complete(self) -> bool:
        """Whether all columns were recorded."""
        return bool(np.isfinite(self.time_s).all())

    def destaggered(self, values: np.ndarray) -> np.ndarray:
        """A copy of an array (..., h, w) or (h, w, 3) whose columns are directions instead of moments.

        Raises
        ------
        ValueError
            The array has other rows or columns.
        """
        h, w = self.range_m.shape[1:]
        source = columns_of_directions(self.pixel_shift, w)
        if values.shape[-2:] == (h, w):
            return np.take_along_axis(values, np.broadcast_to(source, values.shape), axis=-1)
        if values.shape == (h, w, 3):
            return np.take_along_axis(values, source[..., None], axis=1)
        raise ValueError(f"expected an array of shape (..., {h}, {w}) or ({h}, {w}, 3), got {values.shape}.")

    def to_point_cloud(
        self,
        return_number: int | None = 1,
        coordinates: str = "camera",
        intensity: str = "reflectivity",
        destaggered: bool = False,
    ) -> PointCloud:
        """The points with their time, ring and return.

        Parameters
        ----------
        return_number : which return of each ray, from 1, for an organised cloud (h, w); None: all returns, as a list
            (n,) without those that are missing.
        coordinates : "camera" (as OpenCV's, from the middle of the head) or "world" (the device's own).
        intensity : "reflectivity", "signal" or "near_ir": what the intensity of the points is. If the sensor did not
            send it, the points have none.
        destaggered : whether columns are directions instead of moments; for one return.

        Raises
        ------
        ValueError
            There is no such return, or the coordinates or the intensity are unknown.
        """
        if intensity not in INTENSITIES:
            raise ValueError(f"expected intensity to be one of {', '.join(INTENSITIES)}, got {shown(intensity)}.")
        chosen = range(self.returns) if return_number is None else [return_number - 1]
        if return_number is not None and not 1 <= return_number <= self.returns:
            raise ValueError(f"expected a return from 1 to {self.returns}, got {shown(return_number)}.")
        clouds = [self._cloud(index, coordinates, intensity, destaggered) for index in chosen]
        if return_number is not None:
            return clouds[0]
        lists = [cloud.finite() for cloud in clouds]
        columns = {name: np.concatenate([one.attributes()[name] for one in lists]) for name in lists[0].attributes()}
        return PointCloud(np.concatenate([one.points for one in lists]), coordinates, **columns)

    def _cloud(self, index: int, coordinates: str, intensity: str, destaggered: bool) -> PointCloud:
        """Organised cloud of the return with an index."""
        ranges = self.range_m[index].astype(np.float64)
        points = ranges[..., None] * self.rays.directions
        if self.rays.origins is not None:
            points += self.rays.origins
        if coordinates == "world":
            points = points @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]
        h, w = ranges.shape
        values = getattr(self, intensity)
        values = values if values is None or values.ndim == 2 else values[index]
        arrays = {
            "points": points.astype(np.float32),
            "intensity": None if values is None else values.astype(np.float32),
            "time_s": np.broadcast_to(self.time_s, (h, w)),
            "ring": np.broadcast_to(np.arange(h, dtype=np.uint16)[:, None], (h, w)),
            "return_number": np.full((h, w), index + 1, dtype=np.uint8),
        }
        if destaggered:
            arrays = {name: v if v is None else self.destaggered(v) for name, v in arrays.items()}
        return PointCloud(coordinates=coordinates, **arrays)
