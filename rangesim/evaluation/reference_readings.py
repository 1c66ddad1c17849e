# SPDX-License-Identifier: Apache-2.0
"""Reference readings of a range image: readings decoded from the same light without noise, or from parts of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rangesim.capture import Capture, Captured
from rangesim.capture.exposure import capture_of_frames, noise_free_capture
from rangesim.decoding import decode
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import without_warnings
from rangesim.sensor import Decoder, Sensor, pixel_reader_of

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient
    from rangesim.rig import Rig
    from rangesim.signals import Signals


@dataclass(frozen=True, eq=False)
class ReferenceReadings:
    """Depths that the decoder of a range image reads from other captures; each is (h, w) float32, metres.

    Each is decoded when it is first used, and only once. The noise (`range_noise.noise_of`) and the causes of failures
    (`rangesim.causes.rules.causes_of`) share it. The decoder warned when it made the range image; it does not warn
    again.

    Parameters
    ----------
    image : RangeImage, decoded from `capture`.
    capture : Capture or CaptureSet, as `rangesim.expose` made it from `signals`.
    signals : Signals of the pass.
    radiance : (k, h, w) float32, W/m2/sr, as `rangesim.capture.exposure.Exposure` has it, if it is still known.
    """

    image: RangeImage
    capture: Captured
    signals: Signals
    radiance: np.ndarray | None = None

    @property
    def decoder(self) -> Decoder:
        """The decoder that made the range image."""
        return self.image.decoder or self.capture.sensor.default_decoder

    def read(self, captures: Sequence[Captured]) -> list[np.ndarray]:
        """Depths of captures, read by the decoder of the range image."""
        return read(captures, self.decoder)

    @property
    def is_by_pixel(self) -> bool:
        """Whether some pixels can be read without the others, see `Decoder.pixel_reader`."""
        return pixel_reader_of(self.decoder, self.capture.sensor) is not None

    def read_pixels(self, frames: np.ndarray, where: np.ndarray) -> np.ndarray:
        """Depths of some pixels, NaN in the others, if `is_by_pixel`: see `read_pixels`."""
        return read_pixels(frames, where, self.capture.sensor, self.decoder, self.signals.rig)

    @cached_property
    def noise_free(self) -> np.ndarray:
        """Depths without the noise and the limits of the detector, in the ambient light of the capture."""
        signals, sensor, radiance = self.signals, self.capture.sensor, self.radiance
        is_still = signals.motion_m is None and sensor.n_cameras == 1
        if radiance is None or not is_still or signals.energy.ambient.any():  # the detector's filter passed less of it
            return self.read([noise_free_capture(signals, sensor, self.capture.reference.ambient)])[0]
        return self.read([capture_of_frames(signals, sensor, lambda one: radiance)])[0]

    @cached_property
    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """Depths of each half of the samples, without noise, in the ambient light of the capture: see `halves`."""
        return halves(self.signals, self.capture.sensor, self.decoder, self.capture.reference.ambient)

    @cached_property
    def without_glass(self) -> np.ndarray | None:
        """Depths in the emitter's light alone, without that off the device's cover glass; None if there is no glass.

        Signals of motion hold the glass's light in their frames, and keep it.
        """
        if self.signals.rig.cover_glass is None:
            return None
        sensor = self.capture.sensor

        def bare(one: Signals) -> np.ndarray:
            return replace(one, rig=replace(one.rig, cover_glass=None)).frames(sensor, 0.0)

        return self.read([capture_of_frames(self.signals, sensor, bare)])[0]

    @cached_property
    def emitter_alone(self) -> np.ndarray:
        """Depths in the emitter's light alone: without noise, ambient light, and the vignetting and stray light of the
        lens.

        A sensor that reads no light of the emitter is read in ambient light.
        """
        if not self.capture.sensor.reads_emitter:
            return self.noise_free
        moves = self.signals.motion_m is not None
        lens = self.signals.rig.camera_lens
        if not (moves or self.signals.energy.ambient.any() or lens.vignetting or lens.stray_light):
            return self.noise_free
        sensor = self.capture.sensor

        def frames_of(one: Signals) -> np.ndarray:
            return sensor.at_pixels(one.frames(sensor, 0.0))

        return self.read([capture_of_frames(self.signals, sensor, frames_of)])[0]


def read(captures: Sequence[Captured], decoder: Decoder) -> list[np.ndarray]:
    """Depths of captures, (h, w) float32 each, metres. The decoder does not warn."""
    with without_warnings():
        return [_read(capture, decoder) for capture in captures]


def _read(capture: Captured, decoder: Decoder) -> np.ndarray:
    """Depths of a capture, without checks of the capture as a whole, which could only find what the simulation did."""
    reader = pixel_reader_of(decoder, capture.sensor)
    if reader is None or not isinstance(capture, Capture):
        return decode(capture, decoder).reading_m
    return decoder.placed(reader(capture), capture.rig).reading_m


def read_pixels(frames: np.ndarray, where: np.ndarray, sensor: Sensor, decoder: Decoder, rig: Rig) -> np.ndarray:
    """Depths of some pixels, (h, w) float32, metres, NaN in the others, for a decoder that reads by pixel.

    Parameters
    ----------
    frames : (k, 1, n) float32, W/m2/sr, noise-free frames of these pixels. where : (h, w) bool, the n pixels.
    """
    reader = pixel_reader_of(decoder, sensor)
    assert reader is not None
    return decoder.placed(reader(Capture(frames, sensor)).spread(where), rig).reading_m


def halves(
    signals: Signals, sensor: Sensor, decoder: Decoder, ambient: Ambient | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Depths of each half of the samples, without noise, (h, w) float64 each, metres.

    Raises
    ------
    ValueError
        The signals do not know their sampling error (`Signals.knows_sampling_error`), or lack the sensor.
    """
    above, below = read([noise_free_capture(signals, sensor, ambient, error) for error in (1.0, -1.0)], decoder)
    return above.astype(np.float64), below.astype(np.float64)


def sampling_draw(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """(h, w) float32, metres, a draw with the variance of the error that sampling makes in each reading.

    It is infinite where only one half has a reading, and NaN where none has.

    above, below : (h, w) float64, metres, depths of the halves.
    """
    return np.where(np.isnan(above) != np.isnan(below), np.inf, (above - below) / 2).astype(np.float32)
