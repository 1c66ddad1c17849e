# SPDX-License-Identifier: Apache-2.0
"""What is known of each pixel before a cause is named: its reading, its light, its geometry."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rangesim.capture import Capture
from rangesim.causes.light_budget import LightBudget
from rangesim.causes.single_path import in_projector, single_path_depth
from rangesim.comparison import EDGE_SHARE, neighbours
from rangesim.decoding.amcw import MAX_RANGE_M
from rangesim.range_image import RangeImage
from rangesim.response import DIRECT, KINDS, MULTIPATH, SPEED_OF_LIGHT
from rangesim.sensors import AmcwToF, DirectToF, IdealToF
from rangesim.signals import EnergySplit, GroundTruth
from rangesim.status import Status

FAINT = 0.1
"""Less than this share of what white paper would return here is little light."""
NEAR = 2
"""Pixels around an edge pixel, in both directions, that show how its surface fares off the edge."""
DISTURBING = 0.005
"""Share of the projector's light, other than direct, from which it can shift a reading by the tolerance."""
MOTION_SHARE = 0.1
"""Share of the tolerance from which motion counts: triangulation magnifies it by distance over baseline, 5 or more."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Masks and measures per pixel, each (h, w).

    image, clean : RangeImage of the capture, and of the same signals without noise and without ambient light.
    motion_m : (h, w) float, metres that what the pixel sees moves, or None: nothing does.
    """

    image: RangeImage
    clean: RangeImage
    capture: Capture
    truth: GroundTruth
    energy: EnergySplit
    budget: LightBudget
    motion_m: np.ndarray | None
    tolerance_m: float

    # ---- The reading ---------------------------------------------------------------------------------

    @cached_property
    def missing(self) -> np.ndarray:
        """No reading."""
        return ~self.image.valid

    @cached_property
    def error(self) -> np.ndarray:
        """z - true z, metres; NaN without a reading or a surface."""
        return np.where(self.image.valid, self.image.z.astype(np.float64) - self.truth.z, np.nan)

    @cached_property
    def failed(self) -> np.ndarray:
        """A surface, but no reading of it to the tolerance."""
        return np.isfinite(self.truth.z) & ~(np.abs(self.error) <= self.tolerance_m)

    @cached_property
    def optical(self) -> np.ndarray:
        """Without noise, ambient light and saturation the pixel fails as well, or is off by half as much or more."""
        clean = np.where(self.clean.valid, self.clean.z.astype(np.float64) - self.truth.z, np.nan)
        return np.asarray(~(np.abs(clean) <= self._half_of_error))

    @cached_property
    def saturated(self) -> np.ndarray:
        """Some frame at its largest digital number, which the decoder refused or which made the error."""
        return self.capture.saturated(self.capture.frames) & (self.missing | ~self.optical)

    # ---- The surface ---------------------------------------------------------------------------------

    def is_a(self, *materials: str) -> np.ndarray:
        """First surface of one of these classes."""
        names = self.truth.material_names
        return np.isin(self.truth.material, [names.index(m) for m in materials if m in names])

    @cached_property
    def in_shadow(self) -> np.ndarray:
        """The projector does not see the surface at the centre of the pixel."""
        return ~self.truth.projector_visible

    @cached_property
    def unlit(self) -> np.ndarray:
        """In shadow, and without a lit part that brings most of the light and enough of it."""
        return self.in_shadow & ~(self.enough & self.mostly(DIRECT))

    @cached_property
    def beside_shadow(self) -> np.ndarray:
        """A neighbouring pixel is in shadow, so that this one may be lit in part."""
        return np.any(neighbours(self.in_shadow & np.isfinite(self.truth.z), 1), axis=0)

    @cached_property
    def at_edge(self) -> np.ndarray:
        """Of the depths of the pixel and its eight neighbours, some lie across a depth edge."""
        own = np.where(np.isfinite(self.truth.z), self.truth.z, np.inf)
        near, far = self._window
        with np.errstate(invalid="ignore"):
            return np.asarray((own > self._beyond(near)) | (far > self._beyond(own)))

    @cached_property
    def fails_off_edge(self) -> np.ndarray:
        """Around the pixel, off the edge, the same surface is off by half as much or more: it is not the edge."""
        error = np.where(self.missing, np.inf, np.abs(self.error))
        off_edge = np.isfinite(self.truth.z) & ~self.at_edge
        around = [neighbours(a, NEAR) for a in (np.where(off_edge, error, np.nan), self.truth.instance, self.truth.z)]
        with np.errstate(invalid="ignore"):
            alike = [
                np.where((instance == self.truth.instance) & ~(z > self._beyond(self.truth.z)), e, np.nan)
                for e, instance, z in zip(*around, strict=True)
            ]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # windows without any such pixel: NaN, not off
            return np.asarray(np.nanmedian(alike, axis=0) >= self._half_of_error)

    def _beyond(self, depth: np.ndarray) -> np.ndarray:
        return np.maximum(depth * (1 + EDGE_SHARE), depth + self.tolerance_m)

    @cached_property
    def _window(self) -> tuple[np.ndarray, np.ndarray]:
        """Nearest and farthest true depth of the 3 x 3 pixels around; nothing counts as infinitely far."""
        from scipy.ndimage import maximum_filter, minimum_filter

        depth = np.where(np.isfinite(self.truth.z), self.truth.z, np.inf)
        return minimum_filter(depth, 3, mode="nearest"), maximum_filter(depth, 3, mode="nearest")

    @cached_property
    def moving(self) -> np.ndarray:
        """The surface moves by more than `MOTION_SHARE` of the tolerance during the acquisition."""
        if self.motion_m is None:
            return np.zeros(self.truth.z.shape, dtype=bool)
        return np.nan_to_num(np.abs(self.motion_m)) > MOTION_SHARE * self.tolerance_m

    # ---- The light -----------------------------------------------------------------------------------

    @cached_property
    def enough(self) -> np.ndarray:
        """Projector light above the thresholds of the decoder."""
        return np.asarray(self.budget.signal >= self.budget.needed)

    @cached_property
    def swamped(self) -> np.ndarray:
        """Without ambient light the projector's would do, and ambient light makes most of the noise."""
        b = self.budget
        return np.asarray((b.signal >= b.needed_in_the_dark) & (b.ambient_share > 0.5))

    @cached_property
    def faint(self) -> np.ndarray:
        """Less direct light than `FAINT` of what a white Lambertian surface would return in this place."""
        rig, truth = self.capture.rig, self.truth
        assert rig is not None
        normal = truth.normal @ rig.T_world_projector[:3, :3]
        point = self._in_projector
        distance = np.linalg.norm(point, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = np.abs((normal * point).sum(axis=-1)) / distance
            white = rig.projector_irradiance / np.pi * cosine * distance / point[..., 2] ** 3
            return np.asarray(self.energy.direct < FAINT * white)

    @cached_property
    def disturbed(self) -> np.ndarray:
        """Of the projector's light that the sensor reads, enough is not direct."""
        light = np.sum(self._kinds, axis=0)
        return np.asarray(light - self._kinds[DIRECT] > DISTURBING * light)

    def mostly(self, kind: int, among: range = range(len(KINDS))) -> np.ndarray:
        """This kind of light is the largest `among` these kinds, and there is some."""
        parts = np.stack([self._kinds[k] for k in among])
        return np.asarray((parts.argmax(axis=0) == kind - among.start) & (parts[kind - among.start] > 0))

    @cached_property
    def _kinds(self) -> list[np.ndarray]:
        """Radiance of each of `KINDS`; none of those that come after the first return for a sensor that stops there."""
        light = [getattr(self.energy, kind) for kind in KINDS]
        if isinstance(self.capture.sensor, IdealToF):
            light[MULTIPATH] = np.zeros_like(light[MULTIPATH])
        return light

    # ---- The range of the sensor ---------------------------------------------------------------------

    @cached_property
    def coarse(self) -> np.ndarray:
        """The straight path to the surface, alone, is not read to the tolerance, or makes half of the error or more."""
        sensor, rig = self.capture.sensor, self.capture.rig
        assert rig is not None  # signals always have one
        alone = np.abs(single_path_depth(sensor, rig, self.truth).astype(np.float64) - self.truth.z)
        return np.asarray(~(alone <= self._half_of_error))

    @cached_property
    def beyond_range(self) -> np.ndarray:
        """Path length that a time-of-flight sensor takes for another, or has no bin for."""
        sensor = self.capture.sensor
        length = self.truth.range_m + np.linalg.norm(self._in_projector, axis=-1)
        if isinstance(sensor, AmcwToF):
            return np.asarray(length > 2 * min(sensor.unambiguous_range_m, MAX_RANGE_M))
        if isinstance(sensor, DirectToF):
            start, bins = sensor.start_s * SPEED_OF_LIGHT, sensor.bins * sensor.bin_s * SPEED_OF_LIGHT
            return np.asarray((length < start) | (length > start + bins))
        return np.zeros(length.shape, dtype=bool)

    @cached_property
    def wrong_period(self) -> np.ndarray:
        """Phases of several frequencies that agree on no distance, or on one that is off by half a period."""
        sensor = self.capture.sensor
        if not isinstance(sensor, AmcwToF):
            return np.zeros(self.error.shape, dtype=bool)
        half_period_m = SPEED_OF_LIGHT / (4 * max(sensor.modulation_hz))
        off = np.abs(self.image.range_m - self.truth.range_m) > half_period_m
        return np.asarray(np.isin(self.image.status, [Status.WRAPPED, Status.OUT_OF_RANGE]) | off)

    @cached_property
    def _half_of_error(self) -> np.ndarray:
        """Half of the error, of which what exceeds it made most; the tolerance where there is no reading."""
        return np.asarray(np.where(self.missing, self.tolerance_m, np.abs(self.error) / 2))

    @cached_property
    def _in_projector(self) -> np.ndarray:
        """(h, w, 3) true surface points in the frame of the projector, metres."""
        rig = self.capture.rig
        assert rig is not None
        return in_projector(rig, self.truth.z)
