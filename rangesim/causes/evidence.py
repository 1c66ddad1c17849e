# SPDX-License-Identifier: Apache-2.0
"""Evidence of each pixel for the cause of its failure: its reading, its light and its geometry, as masks."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_dilation

from rangesim.capture import Capture
from rangesim.capture.exposure import capture_of_frames
from rangesim.causes.light_budget import LightBudget, light_budget, white_radiance
from rangesim.causes.reference_frames import (
    TangentPlanes,
    footprint_frames,
    frames_of_pixels,
    points_in_projector,
    single_path_frames,
)
from rangesim.decoding.range_image import RangeImage
from rangesim.decoding.status import Status
from rangesim.evaluation.depth_edges import across, depth_edges
from rangesim.evaluation.neighbourhood import IMAGE, Neighbourhood, neighbourhood
from rangesim.evaluation.reference_readings import ReferenceReadings
from rangesim.response import DIRECT, KINDS, MULTIPATH
from rangesim.signals import GroundTruth

if TYPE_CHECKING:
    from rangesim.signals import Signals

NEAR = 2
"""Radius, in pixels, of the window around a pixel at an edge; the same surface off the edge is sought in this window.

A larger window may reach parts of the surface under other light; a smaller one finds fewer pixels off the edge. Other
values were not measured.
"""
DIM = 0.1
"""Fraction of the direct light that a white Lambertian surface would return, below which a surface is faint.

It separates glossy surfaces that reflect the light elsewhere from those that return it. Other values were not measured.
"""
DISTURBING = 0.005
"""Fraction of indirect light in the emitter's light above which this light can shift a reading by the tolerance.

With a larger fraction, the rules blame the resolution for errors that multipath made; with a smaller one, they blame
multipath for errors that the resolution made. Other values were not measured.
"""
DISTURBING_TEXTURE = 0.5
"""Fraction of indirect light in the emitter's light above which it disturbs a sensor that compares texture.

Indirect light shows no sharp dots, so it only makes them fainter, and shifts nothing. With `DISTURBING` in its place,
only 5 to 10 % of the pixels of the tabletop that were called multipath were right in direct light alone.
"""
MAX_PULSES_HIT = 0.9
"""Fraction of the laser pulses with a detected photon above which pile-up makes a reading worse.

A pixel reaches it at 2.3 photons per pulse. The noise of Coates' estimate is least at 1 to 2 photons per pulse.
"""
MOTION_FRACTION = 0.1
"""Motion during the acquisition, as a fraction of the tolerance, above which it can explain an error.

It is small because triangulation multiplies motion by the ratio of distance to baseline, which is 5 or more.
"""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence per pixel, each (h, w); a mask is bool. It is valid for failed pixels, and undefined for the others.

    readings : ReferenceReadings, the range image with its capture, its signals and the readings to compare with.
    tolerance_m : float, metres, error above which a pixel failed.
    """

    readings: ReferenceReadings
    tolerance_m: float

    @property
    def image(self) -> RangeImage:
        """The range image whose failures are explained."""
        return self.readings.image

    @property
    def capture(self) -> Capture:
        """The capture of the camera that the range image is of."""
        return self.readings.capture.reference

    @property
    def signals(self) -> Signals:
        """The light that the capture was exposed from."""
        return self.readings.signals

    @property
    def truth(self) -> GroundTruth:
        """The true surfaces."""
        return self.signals.truth

    @cached_property
    def true_m(self) -> np.ndarray:
        """(h, w) float32, metres, true readings, see `Camera.reading`."""
        return self.signals.rig.camera.reading(self.truth)

    # ---- The reading ---------------------------------------------------------------------------------

    @cached_property
    def missing(self) -> np.ndarray:
        """Whether the pixel has no reading."""
        return ~self.image.valid

    @cached_property
    def error(self) -> np.ndarray:
        """float64, z - true z in metres; NaN without a reading or a surface."""
        return np.where(self.image.valid, self.image.reading_m.astype(np.float64) - self.true_m, np.nan)

    @cached_property
    def failed(self) -> np.ndarray:
        """Whether there is a surface, but no reading of it within the tolerance."""
        return np.isfinite(self.true_m) & ~(np.abs(self.error) <= self.tolerance_m)

    @cached_property
    def optical(self) -> np.ndarray:
        """Whether optics is to blame: even without noise, ambient light and saturation, the pixel fails or keeps at
        least half of its error."""
        return self._wrong(self.readings.emitter_alone)

    @cached_property
    def saturated(self) -> np.ndarray:
        """Whether some frame is saturated, or the pulses ran out, and so the decoder refused the pixel or erred."""
        full = self.capture.saturated(self.capture.frames) | (self.image.status == Status.SATURATED)
        return full & (self.missing | ~self.optical)

    @cached_property
    def out_of_range(self) -> np.ndarray:
        """Whether the decoder refused the reading, and the surface lies outside the decoder's working range indeed."""
        decoder = self.image.decoder or self.capture.sensor.default_decoder
        refused = self.image.status == Status.OUT_OF_RANGE
        if decoder.working_range is None:
            return np.zeros(refused.shape, dtype=bool)
        return np.asarray(refused & decoder.working_range.is_outside(self.truth.z, self.truth.range_m))

    @cached_property
    def off_glass(self) -> np.ndarray:
        """Whether light off the device's window is to blame.

        It is where the reading without this light is right, and where the decoder refused a surface because it is so
        close that the decoder cannot tell it from the window.
        """
        without = self.readings.without_glass
        if without is None:
            return np.zeros(self.true_m.shape, dtype=bool)
        healed = ~self._wrong(without)
        return np.asarray(self.optical & (healed | (self.image.status == Status.OUT_OF_RANGE)))

    @cached_property
    def veiled(self) -> np.ndarray:
        """Whether stray light of the camera's lens is to blame: the reading without noise fails, or keeps half of its
        error, but not the one without what the lens adds."""
        if not self.signals.rig.camera_lens.stray_light:
            return np.zeros(self.true_m.shape, dtype=bool)
        return np.asarray(~self.optical & self._wrong(self.readings.noise_free))

    @cached_property
    def piled_up(self) -> np.ndarray:
        """Whether more than `MAX_PULSES_HIT` of the pulses brought a photon, or the decoder found that the pulses ran
        out although no counter is full."""
        capture, blind = self.capture, self.capture.blindness
        if blind is None:
            return np.zeros(self.true_m.shape, dtype=bool)
        ran_out = (self.image.status == Status.SATURATED) & ~capture.saturated(capture.frames)
        if not blind.until_next_pulse:
            return ran_out
        return np.asarray(ran_out | (capture.frames.sum(axis=0, dtype=np.float64) > MAX_PULSES_HIT * blind.trials))

    # ---- The surface ---------------------------------------------------------------------------------

    def is_a(self, *materials: str) -> np.ndarray:
        """Whether the first surface is of one of these material classes."""
        names = self.truth.material_names
        return np.isin(self.truth.material, [names.index(m) for m in materials if m in names])

    @cached_property
    def in_shadow(self) -> np.ndarray:
        """Whether the emitter does not light the surface at the centre of the pixel, and the sensor reads its light."""
        if not self.capture.sensor.reads_emitter:
            return np.zeros(self.truth.z.shape, dtype=bool)
        return ~self.truth.projector_visible

    @cached_property
    def hidden(self) -> np.ndarray:
        """Whether a further camera of the sensor does not see the surface at the centre of the pixel."""
        result = np.zeros(self.truth.z.shape, dtype=bool)
        for other in self.signals.cameras[1:]:
            result[self.failed] |= _hidden_from(other, self._in_world, self.tolerance_m)
        return result

    @cached_property
    def unlit(self) -> np.ndarray:
        """Whether the pixel is in shadow, and has no lit part from which most of its light and enough light comes."""
        return self.in_shadow & ~(self.enough & self.mostly(DIRECT))

    @cached_property
    def beside_shadow(self) -> np.ndarray:
        """Whether a neighbouring pixel is in shadow, so that this one may be lit in part."""
        return np.any(self.pixels.shifted(self.in_shadow & np.isfinite(self.true_m), 1), axis=0)

    @cached_property
    def pixels(self) -> Neighbourhood:
        """The neighbourhood of each pixel."""
        return neighbourhood(self.signals.rig.camera)

    @cached_property
    def at_edge(self) -> np.ndarray:
        """Whether a depth edge lies between the pixel and one of its neighbours, within a zone, or as far away as the
        reading of the pixel reaches (`Decoder.reach_px`)."""
        edges, reach = depth_edges(self.true_m, self.tolerance_m, self.pixels), self.readings.decoder.reach_px
        if self.truth.nearest_m is not None and self.truth.farthest_m is not None:
            edges = edges | (self.truth.farthest_m > across(self.truth.nearest_m, self.tolerance_m))
        return edges if not reach else binary_dilation(edges, np.ones((3, 3)), iterations=reach)

    def inclined(self, where: np.ndarray) -> np.ndarray:
        """Whether all neighbours of pixels `where` (h, w) lie on the tangent plane of the surface at the pixel's
        centre: the pixel covers one surface, however steep. It is False for readings that reach beyond the pixel, and
        so to a true edge."""
        if self.readings.decoder.reach_px:
            return np.zeros(where.shape, dtype=bool)
        rig = self.signals.rig
        planes, (rows, columns) = TangentPlanes(rig, self.truth, self.true_m, where), self.pixels.around(where, 1)
        origins, rays = (x.reshape(*rows.shape, 3) for x in rig.camera.rays_at((rows.ravel(), columns.ravel())))
        fits = np.ones(len(rows), dtype=bool)
        for n in range(rows.shape[1]):
            there = self.true_m[rows[:, n], columns[:, n]].astype(np.float64)
            plane = planes.readings(origins[:, n], rays[:, n])
            fits &= np.abs(there - plane) <= across(np.fmin(there, plane), self.tolerance_m) - np.fmin(there, plane)
        result = np.zeros(where.shape, dtype=bool)
        result[where] = fits
        return result

    def fails_off_edge(self, where: np.ndarray) -> np.ndarray:
        """Whether pixels near pixels `where` (h, w), on the same surface, but off the edge, have at least half of the
        error: then the edge is not to blame. It is False for readings that reach beyond the pixel, whose neighbours
        share their edge."""
        result = np.zeros(where.shape, dtype=bool)
        if self.readings.decoder.reach_px:
            return result
        error = np.where(self.missing, np.inf, np.abs(self.error))
        surfaces = self.true_m, self.truth.instance
        around = error_off_edge(where, error, self.at_edge, *surfaces, self.tolerance_m, self.pixels)
        result[where] = around >= self._half_of_error[where]
        return result

    @cached_property
    def moving(self) -> np.ndarray:
        """Whether the surface moves by more than `MOTION_FRACTION` of the tolerance during the acquisition."""
        motion_m = self.signals.motion_m
        if motion_m is None:
            return np.zeros(self.true_m.shape, dtype=bool)
        return np.nan_to_num(motion_m) > MOTION_FRACTION * self.tolerance_m

    # ---- The light -----------------------------------------------------------------------------------

    @cached_property
    def budget(self) -> LightBudget:
        """LightBudget: the light of each pixel, and the light that its sensor needs there."""
        return light_budget(self.signals, self.capture, self.readings.decoder)

    @cached_property
    def enough(self) -> np.ndarray:
        """Whether the emitter's light is above the thresholds of the decoder."""
        return np.asarray(self.budget.signal >= self.budget.needed)

    @cached_property
    def enough_direct(self) -> np.ndarray:
        """Whether direct light alone is above the thresholds of the decoder."""
        return np.asarray(self.signals.energy.direct >= self.budget.needed)

    @cached_property
    def swamped(self) -> np.ndarray:
        """Whether the emitter's light would suffice without ambient light, which makes most of the noise."""
        if not self.capture.sensor.reads_emitter:
            return np.zeros(self.truth.z.shape, dtype=bool)
        return np.asarray((self.budget.signal >= self.budget.needed_in_the_dark) & self.mostly_ambient)

    @cached_property
    def mostly_ambient(self) -> np.ndarray:
        """Whether ambient light makes most of the variance of the noise, and so most of the detector's electrons."""
        return np.asarray(self.budget.ambient_fraction > 0.5)

    @cached_property
    def faint(self) -> np.ndarray:
        """Whether direct light is less than `DIM` of what a white Lambertian surface would return at this place."""
        rig, normal = self.signals.rig, self.truth.normal[self.failed] @ self.signals.rig.T_world_projector[:3, :3]
        white = white_radiance(rig, self._in_projector, normal)
        return self._of_failed(self.signals.energy.direct[self.failed] < DIM * white)

    @cached_property
    def disturbed(self) -> np.ndarray:
        """Whether enough of the emitter's light is not direct to shift the reading by the tolerance."""
        if not self.capture.sensor.reads_emitter:
            return np.zeros(self.failed.shape, dtype=bool)
        light = np.sum(self._kinds, axis=0)
        least = DISTURBING_TEXTURE if self.capture.sensor.compares_texture else DISTURBING
        return np.asarray(light - self._kinds[DIRECT] > least * light)

    def mostly(self, kind: int, among: range = range(len(KINDS))) -> np.ndarray:
        """Whether this kind of light is the largest among some kinds, and not zero.

        kind : index into `KINDS`. among : range of such indices.
        """
        parts = np.stack([self._kinds[k] for k in among])
        return np.asarray((parts.argmax(axis=0) == kind - among.start) & (parts[kind - among.start] > 0))

    @cached_property
    def _kinds(self) -> list[np.ndarray]:
        """Radiance of each of `KINDS`, W/m2/sr; 0 for multipath where the sensor reads only the first return."""
        light = [getattr(self.signals.energy, kind) for kind in KINDS]
        if self.capture.sensor.first_return_frame is not None:
            light[MULTIPATH] = np.zeros_like(light[MULTIPATH])
        return light

    # ---- The range of the sensor ---------------------------------------------------------------------

    def coarse(self, where: np.ndarray) -> np.ndarray:
        """Whether the reading of the straight path alone to pixels `where` (h, w) is missing, or still has half of the
        error or more.

        A sensor that compares texture needs straight paths to the whole area of each pixel; beside a depth edge, the
        edge is to blame.
        """
        sensor = self.capture.sensor
        if not sensor.reads_emitter:
            return np.zeros(where.shape, dtype=bool)
        if sensor.compares_texture:
            return where & self._wrong_over_areas & ~self.at_edge
        if self.readings.is_by_pixel:
            return self._wrong_alone(where, is_spread=False)
        return where & self._wrong_at_centres

    @cached_property
    def textureless(self) -> np.ndarray:
        """Whether a sensor that compares texture found too little of it for a reading; without dots, whether the
        texture of the surface itself, if it has any, gave no reading."""
        sensor = self.capture.sensor
        if not sensor.compares_texture:
            return np.zeros(self.missing.shape, dtype=bool)
        return self.missing & ((self.image.status == Status.LOW_SIGNAL) | (not sensor.reads_emitter))

    def blurred(self, where: np.ndarray) -> np.ndarray:
        """Whether the reading of straight paths to the whole area of pixels `where` (h, w), on their tangent planes,
        has half of the error or more, or is missing; it is looked at only where other light disturbs the pixel too."""
        where = where & self.may_blur
        if self.capture.sensor.compares_texture:
            return where & self.coarse(where)
        if self.readings.is_by_pixel:
            return self._wrong_alone(where, is_spread=True)
        return where & self._wrong_over_areas

    @cached_property
    def may_blur(self) -> np.ndarray:
        """Whether the pixel fails without noise, is disturbed by indirect light, and shows a lit surface that is
        neither a mirror nor glass."""
        lit = ~self.in_shadow & ~self.is_a("transparent", "mirror")
        return self.failed & self.optical & self.disturbed & lit

    @cached_property
    def beyond_range(self) -> np.ndarray:
        """Whether a time-of-flight sensor confuses the path length with another one, or has no bin for it; or whether
        a matcher of texture found its match outside its range."""
        if self.capture.sensor.compares_texture:
            return np.asarray(self.failed & (self.image.status == Status.OUT_OF_RANGE))
        length = self.truth.range_m[self.failed] + np.linalg.norm(self._in_projector, axis=-1)
        return self._of_failed(self.capture.sensor.is_beyond_range(length))

    @cached_property
    def wrong_period(self) -> np.ndarray:
        """Whether a sensor that measures phases chose a wrong period: its phases contradict each other, or the distance
        is wrong by more than half a period."""
        period_m = self.capture.sensor.shortest_period_m
        if period_m is None:
            return np.zeros(self.failed.shape, dtype=bool)
        refused = np.isin(self.image.status, [Status.UNWRAPPING_FAILED, Status.OUT_OF_RANGE])
        return np.asarray(refused | (np.abs(self.image.range_m - self.truth.range_m) > period_m / 2))

    # ---- Helpers -------------------------------------------------------------------------------------

    @cached_property
    def _half_of_error(self) -> np.ndarray:
        """float64, half of the error in metres; the tolerance where there is no reading.

        An effect that shifts a reading by more than this made most of its error.
        """
        return np.asarray(np.where(self.missing, self.tolerance_m, np.abs(self.error) / 2))

    def _wrong_alone(self, where: np.ndarray, is_spread: bool) -> np.ndarray:
        """(h, w) bool, whether failed pixels `where` have half of their error or more, or no reading, in frames of
        straight paths to these pixels alone; False elsewhere.

        is_spread : whether the paths cover the area of each pixel. If not, there is one, to its centre.
        """
        if not where.any():
            return where
        frames = frames_of_pixels(self.capture.sensor, self.signals.rig, self.truth, where, is_spread)
        return where & self._wrong(self.readings.read_pixels(frames, where))

    @cached_property
    def _wrong_at_centres(self) -> np.ndarray:
        """(h, w) bool, whether failed pixels are still wrong in straight paths to the centres of all pixels.

        It stands for `_wrong_alone` where the decoder reads whole images only.
        """
        return self._wrong_in(lambda one: single_path_frames(self.capture.sensor, one.rig, one.truth))

    @cached_property
    def _wrong_over_areas(self) -> np.ndarray:
        """The same in straight paths that cover the area of the pixels that may be blurred; if the decoder compares
        texture, the area of all pixels of all cameras."""
        sensor = self.capture.sensor

        def frames_of(one: Signals) -> np.ndarray:
            spread = np.isfinite(one.truth.z) if sensor.compares_texture else self.may_blur
            return footprint_frames(sensor, one.rig, one.truth, spread)

        return self._wrong_in(frames_of)

    def _wrong_in(self, frames_of: Callable[[Signals], np.ndarray]) -> np.ndarray:
        """(h, w) bool, `_wrong` in noise-free frames (k, h, w), which a function makes for each camera."""
        return self._wrong(self.readings.read([capture_of_frames(self.signals, self.capture.sensor, frames_of)])[0])

    def _wrong(self, z: np.ndarray) -> np.ndarray:
        """(h, w) bool, whether failed pixels have half of their error or more in depths z (h, w), or NaN there."""
        error = np.abs(z[self.failed].astype(np.float64) - self.true_m[self.failed])
        return self._of_failed(~(error <= self._half_of_error[self.failed]))

    def _of_failed(self, values: np.ndarray) -> np.ndarray:
        """(h, w) bool with (n,) values in the failed pixels, and False elsewhere."""
        result = np.zeros(self.failed.shape, dtype=bool)
        result[self.failed] = values
        return result

    @cached_property
    def _in_projector(self) -> np.ndarray:
        """(n, 3) float64 true surface points of the failed pixels in projector coordinates, metres."""
        return points_in_projector(self.signals.rig, self.true_m, self.failed)

    @cached_property
    def _in_world(self) -> np.ndarray:
        """(n, 3) float64 true surface points of the failed pixels in world coordinates, metres."""
        T = self.signals.rig.T_world_projector
        return np.asarray(self._in_projector @ T[:3, :3].T + T[:3, 3])


def _hidden_from(other: Signals, points: np.ndarray, tolerance_m: float) -> np.ndarray:
    """(n,) bool, whether a camera does not see points: they lie outside its image, or behind what it sees there.

    Parameters
    ----------
    other : Signals of the camera.
    points : (n, 3) float, metres, world coordinates.
    tolerance_m : metres by which a point must be farther than all that the camera sees within one pixel.
    """
    T, camera = other.rig.T_world_camera, other.rig.pinhole
    in_camera = (points - T[:3, 3]) @ T[:3, :3]
    place = camera.project(in_camera)
    outside = np.asarray(~((place >= 0) & (place < [camera.width, camera.height])).all(axis=-1))
    column, row = np.where(outside[:, None], 0, place).astype(int).T
    seen = np.where(np.isfinite(other.truth.z), other.truth.z, np.inf).astype(np.float64)
    farthest = np.stack(IMAGE.shifted(seen, 1)).max(axis=0)
    return np.asarray(outside | (in_camera[:, 2] > farthest[row, column] + tolerance_m))


def error_off_edge(
    where: np.ndarray,
    error: np.ndarray,
    edge: np.ndarray,
    z: np.ndarray,
    instance: np.ndarray,
    tolerance_m: float,
    pixels: Neighbourhood = IMAGE,
) -> np.ndarray:
    """(n,) float64 median error, in metres, of the same surface off the edge around each of n pixels; NaN if this
    surface is nowhere in the window of `NEAR`.

    Parameters
    ----------
    where : (h, w) bool, the n pixels.
    error : (h, w) float, metres, absolute error; infinite without a reading.
    edge : (h, w) bool, whether a pixel lies at a depth edge.
    z : (h, w) float, metres, true depth.
    instance : (h, w) int, number of the surface that the pixel sees.
    tolerance_m : float, metres, see `depth_edges`.
    pixels : which pixels are neighbours.
    """
    y, x = pixels.around(where, NEAR)
    own_z, own = z[where][:, None], instance[where][:, None]
    same = (instance[y, x] == own) & ~edge[y, x] & (z[y, x] <= across(own_z, tolerance_m))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # windows without any such pixel: NaN
        return np.asarray(np.nanmedian(np.where(same, error[y, x], np.nan), axis=1))
