# SPDX-License-Identifier: Apache-2.0
"""Range images: for each camera pixel one measurement, or the reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from rangesim.decoding.returns import Returns
from rangesim.decoding.status import Status
from rangesim.point_cloud import PointCloud, organised_cloud
from rangesim.rig import Camera, Intrinsics
from rangesim.settings.config import ShortRepr

if TYPE_CHECKING:
    from rangesim.sensor import Decoder

MIN_MEASURED = 0.5
"""Least fraction of the pixels that are measured in a sound capture of a whole scene. Below it, `Decoder.likely_cause`
and `rangesim decode` look for a mistake; a larger value makes them suspect captures of dark or distant scenes."""


@dataclass(frozen=True, eq=False, repr=False)
class RangeImage(ShortRepr):
    """Depth and range per camera pixel.

    Parameters
    ----------
    z : (h, w) float32, metres, along the optical axis of the camera; NaN where `status` is not OK.
    range_m : (h, w) float32, metres, Euclidean distance from the camera centre; NaN likewise.
    confidence : (h, w) float32 in 0..1, strength of the useful signal as a fraction of the largest signal that the
        capture can hold; for a noise-free capture, of the largest that it holds. The signal is white - black of
        structured light, twice the modulation amplitude of AMCW, the counts in the peak of direct time of flight (as a
        fraction of the highest peak), and the radiance of the ideal sensor.
    status : (h, w) uint8, values of `Status`.
    intensity : (h, w) float32, mean signal in the capture's units, for colouring points.
    camera : Camera, or None for an uncalibrated capture, whose z is all NaN.
    T_world_camera : (4, 4) float64, maps camera coordinates to world coordinates, metres; None as `camera`.
    projector_column, projector_row : (h, w) float32, decoded projector pixel coordinates (pixel centres at
        integer + 0.5), NaN where not decoded; None for sensors without a code along that axis.
    sampling_sigma_m : (h, w) float32, metres, standard deviation of a simulated z that the sampling of light paths
        causes. It is estimated from one pair of draws for each pixel, so take medians over many pixels. NaN where there
        is no reading, infinite where sampling decides whether there is one. None: not known, see
        `rangesim.evaluation.range_noise`.
    decoder : Decoder that made it; None: not known.
    returns : Returns, all returns of each pixel, of which `range_m` is one (the decoder's `reading`); None: the decoder
        looked for one alone.
    doubts : sentences in which the decoder says what in the capture contradicts itself, each with its likely cause.
    notes : sentences on what the decoder found in the capture and has corrected, such as a projector's gamma.

    Examples
    --------
    >>> import numpy as np
    >>> from rangesim.rig import Intrinsics
    >>> z = np.array([[1.0, np.nan]], dtype=np.float32)
    >>> status, one = np.array([[0, 1]], dtype=np.uint8), np.ones((1, 2), dtype=np.float32)
    >>> image = RangeImage(z, z, one, status, one, Intrinsics(2, 1, 2.0, 2.0, 1.0, 0.5), np.eye(4))
    >>> image.valid
    array([[ True, False]])
    >>> image.to_point_cloud().points[0, 0]
    array([-0.25,  0.  ,  1.  ], dtype=float32)
    """

    z: np.ndarray
    range_m: np.ndarray
    confidence: np.ndarray
    status: np.ndarray
    intensity: np.ndarray
    camera: Camera | None = None
    T_world_camera: np.ndarray | None = None
    projector_column: np.ndarray | None = None
    projector_row: np.ndarray | None = None
    sampling_sigma_m: np.ndarray | None = None
    decoder: Decoder | None = None
    returns: Returns | None = None
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def valid(self) -> np.ndarray:
        """(h, w) bool, where `status` is OK."""
        return np.asarray(self.status == Status.OK)

    @property
    def pinhole(self) -> Intrinsics:
        """The camera, which has to be a pinhole; ValueError if it is not, or if there is none."""
        if not isinstance(self.camera, Intrinsics):
            name = type(self.camera).__name__
            raise ValueError(f"expected a range image of a pinhole camera (Intrinsics), got one of {name}.")
        return self.camera

    @property
    def reading_m(self) -> np.ndarray:
        """(h, w) float32, metres, the readings: z of a pinhole camera, `range_m` of every other one."""
        return self.z if self.camera is None else self.camera.reading(self)

    @property
    def is_consistent(self) -> bool:
        """Whether z is finite where `status` is OK, and NaN elsewhere. Without a camera, z may be NaN anywhere."""
        finite, ok = np.isfinite(self.z), self.valid
        return not (finite > ok).any() and (self.camera is None or not (finite < ok).any())

    def to_point_cloud(self, coordinates: str = "camera", returns: Literal["reading", "all"] = "reading") -> PointCloud:
        """Point cloud of this image, with normals, intensities and confidences.

        Parameters
        ----------
        coordinates : "camera" or "world".
        returns : "reading", an organised cloud (h, w) with one point for each pixel; or "all", a list (n,) of all
            returns whose status is OK: the nearest of each pixel, row by row, then the second ones, and so on. Their
            `return_number` counts from 1, their intensity is the strength of the return, and they have no confidence.

        Raises
        ------
        ValueError
            The range image has no camera (uncalibrated capture), these coordinates are unknown, or all returns are
            asked for but were not decoded.
        """
        if self.camera is None or self.T_world_camera is None:
            raise ValueError("expected a calibrated range image: without a rig there are no points.")
        if returns == "reading":
            return organised_cloud(
                self.reading_m, self.camera, self.T_world_camera, self.intensity, self.confidence, coordinates
            )
        if returns != "all":
            raise ValueError(f"expected returns to be one of reading, all, got {returns!r}.")
        if self.returns is None:
            raise ValueError(
                "expected a range image with all returns; decode with a decoder that looks for several, such as "
                "DirectToFDecoder(max_returns=3)."
            )
        clouds = []
        for i, range_m in enumerate(self.returns.range_m):
            found = np.where(self.returns.status[i] == Status.OK, range_m, np.nan)
            z = self.camera.z_of(found).astype(np.float32)
            reading = self.camera.reading(replace(self, z=z, range_m=found.astype(np.float32)))
            strength, number = self.returns.strength[i], np.full(z.shape, i + 1, dtype=np.uint8)
            cloud = organised_cloud(reading, self.camera, self.T_world_camera, strength, strength, coordinates)
            clouds.append(replace(cloud, confidence=None, return_number=number).finite())
        arrays = {name: np.concatenate([getattr(c, name) for c in clouds]) for name in clouds[0].attributes()}
        return PointCloud(np.concatenate([c.points for c in clouds]), coordinates, **arrays)
