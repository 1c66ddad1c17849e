# SPDX-License-Identifier: Apache-2.0
"""What is known of each pixel before a cause is named: its reading, its light, its geometry."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Capture
from rangesim.causes.light_budget import LightBudget, light_budget, white_radiance
from rangesim.causes.reference_frames import (
    depth_on_plane,
    footprint_frames,
    points_in_projector,
    single_path_frames,
)
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.electronics.spad import SpadDetector
from rangesim.evaluation.comparison import neighbours
from rangesim.evaluation.depth_edges import across, depth_edges
from rangesim.evaluation.reference_readings import ReferenceReadings
from rangesim.response import DIRECT, KINDS, MULTIPATH
from rangesim.signals import GroundTruth

if TYPE_CHECKING:
    from rangesim.signals import Signals

NEAR = 2
"""Pixels around an edge pixel, in both directions, that show how its surface fares off the edge."""
DIM = 0.1
"""Less than this fraction of what white paper would return here is little light."""
DISTURBING = 0.005
"""Fraction of the projector's light, other than direct, from which it can shift a reading by the tolerance."""
MAX_PULSES_HIT = 0.9
"""Fraction of the pulses with a photon from which less light makes less noise: 2.3 photons a pulse, where Coates'
estimate is best at 1 to 2."""
MOTION_FRACTION = 0.1
"""Fraction of the tolerance from which motion counts: triangulation magnifies it by distance over baseline, 5 or
more."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Masks and measures per pixel, each (h, w); they hold for failed pixels, and say nothing of others."""

    readings: ReferenceReadings
    tolerance_m: float

    @property
    def image(self) -> RangeImage:
        """The range image whose failures are explained."""
        return self.readings.image

    @property
    def capture(self) -> Capture:
        """The capture that the range image was decoded from."""
        return self.readings.capture

    @property
    def signals(self) -> Signals:
        """The light that the capture was exposed from."""
        return self.readings.signals

    @property
    def truth(self) -> GroundTruth:
        """The true surfaces."""
        return self.signals.truth

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
        return self._wrong(self._of_failed_pixels(self.readings.projector_alone))

    @cached_property
    def saturated(self) -> np.ndarray:
        """Some frame at its largest digital number, or no pulse left, which the decoder refused or made the error."""
        full = self.capture.saturated(self.capture.frames) | (self.image.status == Status.SATURATED)
        return full & (self.missing | ~self.optical)

    @cached_property
    def piled_up(self) -> np.ndarray:
        """Whether more than `MAX_PULSES_HIT` of the pulses brought a photon, or the decoder says
        that they ran out though no counter is full."""
        detector, capture = self.capture.detector, self.capture
        if not isinstance(detector, SpadDetector) or not detector.pile_up:
            return np.zeros(self.truth.z.shape, dtype=bool)
        pulses = detector.pulses(capture.sensor.gate, capture.exposure_s)
        ran_out = (self.image.status == Status.SATURATED) & ~capture.saturated(capture.frames)
        return np.asarray(ran_out | (capture.frames.sum(axis=0, dtype=np.float64) > MAX_PULSES_HIT * pulses))

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
        return depth_edges(self.truth.z, self.tolerance_m)

    @cached_property
    def merely_inclined(self) -> np.ndarray:
        """Pixels whose edge is one steep surface, which is read right over the area of the pixel, without the
        other light that disturbs it."""
        return self.inclined & self._may_blur & ~self.blurred

    @cached_property
    def inclined(self) -> np.ndarray:
        """All eight neighbours lie where the plane that touches the surface in the pixel's centre is: it holds one
        surface, however steep."""
        rig, where = self.signals.rig, self.failed & self.at_edge
        rows, columns = np.nonzero(where)
        fits = np.ones(len(rows), dtype=bool)
        for y, x in ((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)):
            at = np.clip(rows + y, 0, where.shape[0] - 1), np.clip(columns + x, 0, where.shape[1] - 1)
            there = self.truth.z[at].astype(np.float64)
            plane = depth_on_plane(rig, self.truth, where, rig.camera.directions(rig.camera.pixel_centres()[at]))
            fits &= np.abs(there - plane) <= across(np.fmin(there, plane), self.tolerance_m) - np.fmin(there, plane)
        result = np.zeros(where.shape, dtype=bool)
        result[where] = fits
        return result

    @cached_property
    def fails_off_edge(self) -> np.ndarray:
        """Around the pixel, off the edge, the same surface is off by half as much or more: it is not the edge."""
        result, where = np.zeros(self.failed.shape, dtype=bool), self.failed & self.at_edge
        error = np.where(self.missing, np.inf, np.abs(self.error))
        around = error_off_edge(where, error, self.at_edge, self.truth.z, self.truth.instance, self.tolerance_m)
        result[where] = around >= self._half_of_error[where]
        return result

    @cached_property
    def moving(self) -> np.ndarray:
        """The surface moves by more than `MOTION_FRACTION` of the tolerance during the acquisition."""
        motion_m = self.signals.motion_m
        if motion_m is None:
            return np.zeros(self.truth.z.shape, dtype=bool)
        return np.nan_to_num(motion_m) > MOTION_FRACTION * self.tolerance_m

    # ---- The light -----------------------------------------------------------------------------------

    @cached_property
    def budget(self) -> LightBudget:
        """What light there is, and what is needed."""
        return light_budget(self.signals, self.capture, self.readings.decoder)

    @cached_property
    def enough(self) -> np.ndarray:
        """Projector light above the thresholds of the decoder."""
        return np.asarray(self.budget.signal >= self.budget.needed)

    @cached_property
    def enough_direct(self) -> np.ndarray:
        """Direct light alone above the thresholds of the decoder."""
        return np.asarray(self.signals.energy.direct >= self.budget.needed)

    @cached_property
    def swamped(self) -> np.ndarray:
        """Without ambient light the projector's would do, and ambient light makes most of the noise."""
        return np.asarray((self.budget.signal >= self.budget.needed_in_the_dark) & self.mostly_ambient)

    @cached_property
    def mostly_ambient(self) -> np.ndarray:
        """Ambient light makes most of the noise, hence most of what the detector collects."""
        return np.asarray(self.budget.ambient_fraction > 0.5)

    @cached_property
    def faint(self) -> np.ndarray:
        """Less direct light than `DIM` of what a white Lambertian surface would return in this place."""
        rig, normal = self.signals.rig, self.truth.normal[self.failed] @ self.signals.rig.T_world_projector[:3, :3]
        white = white_radiance(rig, self._in_projector, normal)
        return self._of_failed(self.signals.energy.direct[self.failed] < DIM * white)

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
        light = [getattr(self.signals.energy, kind) for kind in KINDS]
        if self.capture.sensor.first_return_frame is not None:
            light[MULTIPATH] = np.zeros_like(light[MULTIPATH])
        return light

    # ---- The range of the sensor ---------------------------------------------------------------------

    @cached_property
    def coarse(self) -> np.ndarray:
        """The straight path to the surface, alone, is not read to the tolerance, or makes half of the error or more."""
        return self._wrong(self._read(single_path_frames(self.capture.sensor, self.signals.rig, self.truth)))

    @cached_property
    def blurred(self) -> np.ndarray:
        """Straight paths to all over the pixel's area, on one plane, are not read to the tolerance, or make half of the
        error or more; where it matters, as other light disturbs the pixel too."""
        rig, spread = self.signals.rig, self._may_blur
        if not spread.any():
            return spread
        return spread & self._wrong(self._read(footprint_frames(self.capture.sensor, rig, self.truth, spread)))

    @cached_property
    def _may_blur(self) -> np.ndarray:
        """Lit surfaces, neither mirrors nor glass, that fail without noise, and get other light."""
        lit = ~self.in_shadow & ~self.is_a("transparent", "mirror")
        return self.failed & self.optical & self.disturbed & lit

    @cached_property
    def beyond_range(self) -> np.ndarray:
        """Path length that a time-of-flight sensor takes for another, or has no bin for."""
        length = self.truth.range_m[self.failed] + np.linalg.norm(self._in_projector, axis=-1)
        return self._of_failed(self.capture.sensor.is_beyond_range(length))

    @cached_property
    def wrong_period(self) -> np.ndarray:
        """Of sensors that read a phase: no distance, as phases contradict each other, or one off by half a period."""
        period_m = self.capture.sensor.shortest_period_m
        if period_m is None:
            return np.zeros(self.failed.shape, dtype=bool)
        refused = np.isin(self.image.status, [Status.UNWRAPPING_FAILED, Status.OUT_OF_RANGE])
        return np.asarray(refused | (np.abs(self.image.range_m - self.truth.range_m) > period_m / 2))

    # ---- Helpers -------------------------------------------------------------------------------------

    @cached_property
    def _half_of_error(self) -> np.ndarray:
        """Half of the error, in metres; the tolerance where there is no reading.

        An effect that shifts a reading by more than that made most of its error.
        """
        return np.asarray(np.where(self.missing, self.tolerance_m, np.abs(self.error) / 2))

    def _read(self, frames: np.ndarray) -> np.ndarray:
        """(n,) depths that the decoder reads of noise-free frames (k, h, w) in the failed pixels, metres."""
        (z,) = self.readings.read([Capture(frames, self.capture.sensor, self.signals.rig)])
        return self._of_failed_pixels(z)

    def _of_failed_pixels(self, z: np.ndarray) -> np.ndarray:
        """(n,) float64 depths of the failed pixels, out of depths (h, w) of all pixels, metres."""
        return z[self.failed].astype(np.float64)

    def _wrong(self, z: np.ndarray) -> np.ndarray:
        """Where depths z (n,) of the failed pixels are off by half of their error or more."""
        error = np.abs(z - self.truth.z[self.failed])
        return self._of_failed(~(error <= self._half_of_error[self.failed]))

    def _of_failed(self, values: np.ndarray) -> np.ndarray:
        """(h, w) bool of (n,) values of the failed pixels."""
        result = np.zeros(self.failed.shape, dtype=bool)
        result[self.failed] = values
        return result

    @cached_property
    def _in_projector(self) -> np.ndarray:
        """(n, 3) true surface points of the failed pixels in projector coordinates, metres."""
        return points_in_projector(self.signals.rig, self.truth.z, self.failed)


def error_off_edge(
    where: np.ndarray, error: np.ndarray, edge: np.ndarray, z: np.ndarray, instance: np.ndarray, tolerance_m: float
) -> np.ndarray:
    """(n,) float: median error of the same surface off the edge, around each of the n pixels `where`; NaN for none.

    Parameters
    ----------
    where, edge : (h, w) bool. error : (h, w) float, metres, not negative; infinity without a reading.
    z : (h, w) float, metres, true depth. instance : (h, w) int, of the surface.
    """
    rows, columns = np.nonzero(where)
    steps = np.arange(-NEAR, NEAR + 1)
    y = np.clip(rows[:, None, None] + steps[:, None], 0, z.shape[0] - 1)
    x = np.clip(columns[:, None, None] + steps, 0, z.shape[1] - 1)
    own_z, own = z[where][:, None, None], instance[where][:, None, None]
    same = (instance[y, x] == own) & ~edge[y, x] & (z[y, x] <= across(own_z, tolerance_m))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # windows without any such pixel: NaN
        return np.asarray(np.nanmedian(np.where(same, error[y, x], np.nan), axis=(1, 2)))
