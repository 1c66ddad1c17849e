# SPDX-License-Identifier: Apache-2.0
"""Adaptive sampling: each pixel takes as many samples as keep the renderer's noise small against the detector's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated

import numpy as np

from rangesim.capture import bright_level
from rangesim.capture.exposure import auto_exposure_s, expose, mean_radiance
from rangesim.decoding import decode
from rangesim.decoding.disparities import ImageNoise
from rangesim.electronics.ambient import Ambient
from rangesim.errors import without_warnings
from rangesim.evaluation.closed_forms import light_of_exposure
from rangesim.evaluation.reference_readings import halves, read_pixels, sampling_draw
from rangesim.instrument.instrument import Instrument
from rangesim.light_transport.samples_per_pixel import Sampler
from rangesim.robust_scale import TO_SIGMA
from rangesim.sensor import Decoder, Sensor, pixel_reader_of
from rangesim.settings.bounds import Bounds, check_fields, whole

if TYPE_CHECKING:
    from rangesim.electronics.detector import PhotoDetector
    from rangesim.response import Response
    from rangesim.signals import GroundTruth, StillSignals

FIRST_SPP = 8
"""Number of samples that every pixel takes first; their scatter tells how many more the pixel needs. With fewer samples
the scatter is known less well; with more, pixels that need few samples take longer than they must."""
FRACTION = 1 / 3
"""Largest ratio of the sampling noise to the detector's noise. At 1/3 the two together are 5 % above the detector's
noise alone, because variances add."""
NEGLIGIBLE = 1e-5
"""Ratio of a standard deviation to the median depth of the scene below which sampling noise is always small enough. It
limits the samples of noise-free captures, where a tenth of this ratio would need a hundred times as many samples."""
NEGLIGIBLE_OF_BRIGHT = ImageNoise.relative
"""Ratio of a standard deviation of a noise-free frame to its bright pixels below which sampling noise is always small
enough, for sensors of several cameras. It is the noise that their decoder assumes in such frames by default."""
BLOCK_PX = 16
"""Edge in pixels of the squares in which the noise of an instance is estimated. In larger squares the estimate uses
more pixels; in smaller ones it follows changes of the noise better."""
ENOUGH_PIXELS = 16
"""Number of pixels that tell the noise of a group to a third of itself, so that a quarter of them need not be read.

With it, 25 to 30 % of the pixels are read. In 6 passes over random scenes, the number of samples of a pass changed by
2.5 % against reading all pixels (with another seed: 3.2 %), that of a pixel by 5 % (12 %).
"""
SPP_STEP = 4
"""The number of samples is a multiple of this, because the samples come in two halves, each of antithetic pairs."""


@dataclass(frozen=True)
class AdaptiveSampling(Sampler):
    """A sampler that takes a few samples in every pixel, and then as many more as the noise of the readings needs.

    The variance of a mean is inversely proportional to the number of samples. The first samples therefore tell how many
    samples are needed (two-stage sampling: Stein, Ann. Math. Statist. 16, 1945). The noise is estimated in groups of
    pixels, for every instrument. The instrument that needs the most samples decides how many a pixel takes.

    An instrument without a detector has only the renderer's noise; its limit is `NEGLIGIBLE`.

    Parameters
    ----------
    instruments : instruments whose detectors, exposures and decoders give the readings and the detectors' noise.
    max_spp : int >= 1, largest number of samples of a pixel.
    fraction : positive, largest ratio of the standard deviation of a reading that sampling causes to the one that the
        detector causes.
    ambient : Ambient, as for `rangesim.expose`.

    Raises
    ------
    ValueError
        A number out of its range.

    Examples
    --------
    >>> from rangesim.light_transport.transport_settings import TransportSettings
    >>> from rangesim.sensors import AmcwToF
    >>> sampler = AdaptiveSampling.of([AmcwToF()])
    >>> sampler.first_spp, sampler.most_spp
    (8, 64)
    >>> settings = TransportSettings(spp=sampler, seed=1)  # for `rangesim.transport`
    """

    instruments: tuple[Instrument, ...]
    max_spp: Annotated[int, whole(1, "spp")] = 64
    fraction: Annotated[float, Bounds("positive and finite", 1e-6, 1e6)] = FRACTION
    ambient: Ambient | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def of(cls, sensors: Sequence[Sensor]) -> AdaptiveSampling:
        """The sampler for sensors with their default detectors and decoders."""
        return cls(tuple(Instrument(f"sensor-{i}", sensor) for i, sensor in enumerate(sensors)))

    @property
    def first_spp(self) -> int:
        return min(FIRST_SPP, self.max_spp)

    @property
    def most_spp(self) -> int:
        return self.max_spp

    def check(self, responses: Sequence[Response]) -> None:
        for instrument in self.instruments:
            if missing := set(instrument.sensor.responses()) - set(responses):
                raise ValueError(
                    f"expected sensors with the response {missing.pop()}, for instrument {instrument.name!r} of spp."
                )

    def samples(self, truth: GroundTruth, signals_of: Callable[[Sequence[Response]], StillSignals]) -> np.ndarray:
        group = groups(truth.instance)
        some = few_of_each(group)
        excess = np.zeros(group.max() + 1)  # ratio of the variance by sampling to the largest one allowed, per group
        for instrument in self.instruments:
            signals = signals_of(instrument.sensor.responses())
            if instrument.sensor.n_cameras > 1:  # a reading needs the signals of all cameras
                excess = np.fmax(excess, self._excess_of_frames(instrument, signals, group))
                continue
            true_m, seen = signals.rig.camera.reading(truth), np.isfinite(truth.z)
            negligible = NEGLIGIBLE * float(np.median(true_m[seen])) if seen.any() else 0.0
            decoder = instrument.decoder or instrument.sensor.default_decoder
            pixels = _Pixels(signals, instrument.sensor, decoder, some, self.ambient)
            above, below = pixels.halves()
            draw, enough = sampling_draw(above, below), np.full(len(excess), negligible)
            if instrument.detector_in_use is not None and not instrument.sensor.is_ideal:
                errors = pixels.detector_errors(instrument.detector_in_use, instrument.exposure_s, (above + below) / 2)
                errors[np.isnan(draw)] = np.nan
                draw[errors > true_m[some]] = np.nan  # more noise than distance: there is no reading to be spoilt
                # A group without any reading needs no further samples: its limit is infinite
                enough = np.maximum(enough, self.fraction * group_sigma(errors, group[some], where_unknown=np.inf))
            with np.errstate(divide="ignore", invalid="ignore"):
                excess = np.fmax(excess, (group_sigma(draw, group[some]) / enough) ** 2)
        wanted = SPP_STEP * np.ceil(self.first_spp * np.minimum(excess, self.max_spp) / SPP_STEP)
        most = max(self.first_spp, self.max_spp // SPP_STEP * SPP_STEP)
        return np.clip(wanted, self.first_spp, most).astype(np.int64)[group]

    def _excess_of_frames(self, instrument: Instrument, signals: StillSignals, group: np.ndarray) -> np.ndarray:
        """Ratio of the sampling variance of the frames of one camera to the largest one allowed, per group.

        The largest one is that of the detector's noise times `fraction` squared; without noise, the standard deviation
        may be `NEGLIGIBLE_OF_BRIGHT` of the bright pixels.
        """
        sensor = instrument.sensor
        transmission = 1.0 if self.ambient is None else self.ambient.scale
        light = signals.frames(sensor, transmission)
        error = signals.frames(sensor, transmission, sampling_errors=1.0) - light
        taken = expose(signals, sensor, instrument.detector_in_use, instrument.exposure_s, 0, self.ambient)
        noise = np.full(light.shape, NEGLIGIBLE_OF_BRIGHT * bright_level(light))
        if taken.is_digital:
            own = [taken.noise(frame) for frame in taken.frames]
            values = taken.frames.astype(np.float64) - taken.black_level
            gain = max(float(values.sum()), 1.0) / max(float(light.sum(dtype=np.float64)), 1e-30)
            if all(one is not None for one in own):
                noise = self.fraction * np.stack([np.asarray(one, dtype=np.float64) for one in own]) / gain
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = [group_sigma((e / n).astype(np.float32), group) ** 2 for e, n in zip(error, noise, strict=True)]
        return np.asarray(np.max(ratios, axis=0))


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Some pixels of one sensor, with what is known of the errors of their readings.

    signals : StillSignals of the whole image. some : (h, w) bool, the n pixels. ambient : as for `AdaptiveSampling`.
    """

    signals: StillSignals
    sensor: Sensor
    decoder: Decoder
    some: np.ndarray
    ambient: Ambient | None

    @cached_property
    def is_by_pixel(self) -> bool:
        """Whether these pixels can be read without the others."""
        is_veiled = self.signals.rig.camera_lens.stray_light > 0
        return not is_veiled and pixel_reader_of(self.decoder, self.sensor) is not None

    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """Depths of each half of the samples, without noise, (n,) float64 each, metres."""
        if not self.is_by_pixel:
            above, below = halves(self.signals, self.sensor, self.decoder, self.ambient)
            return above[self.some], below[self.some]
        above, below = (self._read(sampling_errors) for sampling_errors in (1.0, -1.0))
        return above, below

    @cached_property
    def _row(self) -> tuple[StillSignals, np.ndarray]:
        """The light of these pixels as an image of one row, and the relative illumination (1, n) of the pixels."""
        row, illumination = self.signals.row_of_pixels(self.some, self.sensor), self.signals.rig.camera_illumination
        return row, illumination[self.some][None]

    def _radiance(self, transmission: float, sampling_errors: float = 0.0) -> np.ndarray:
        """(k, 1, n) float32, W/m2/sr, frames of these pixels, for that fraction of the ambient light."""
        row, illumination = self._row
        frames = row.frames(self.sensor, transmission, sampling_errors)
        return frames if (illumination == 1).all() else np.asarray(frames * illumination)

    def _read(self, sampling_errors: float) -> np.ndarray:
        """(n,) float64, metres, depths with so many draws of the sampling error, without noise."""
        frames = self._radiance(1.0 if self.ambient is None else self.ambient.scale, sampling_errors)
        found = read_pixels(frames, self.some, self.sensor, self.decoder, self.signals.rig)
        return found[self.some].astype(np.float64)

    def detector_errors(self, detector: PhotoDetector, exposure_s: float | None, clean_m: np.ndarray) -> np.ndarray:
        """(n,) float64, metres, errors that the detector's noise makes, for `group_sigma`; NaN without a reading.

        They are the typical ones by the decoder's closed form. If there is none, they are those of a capture.

        Parameters
        ----------
        exposure_s : float, seconds; None: automatic. clean_m : (n,) float64, metres, readings without noise.
        """
        signals, sensor, rig = self.signals, self.sensor, self.signals.rig
        if not self.is_by_pixel:
            radiance = mean_radiance(signals, sensor, detector, self.ambient)[:, self.some][:, None]
        else:
            passed = detector.ambient_fraction(sensor.gate, self.ambient)
            radiance = self._radiance(passed)
        if exposure_s is None:
            exposure_s = auto_exposure_s(radiance, sensor, detector, rig)
        light = light_of_exposure(signals, sensor, detector, exposure_s, self.ambient).of_pixels(self.some)
        theory_m = self.decoder.depth_error_m(sensor, light)
        if theory_m is not None:
            brightest_e = radiance.max(axis=0) * detector.electron_rate_per_radiance(rig) * exposure_s
            return np.where(brightest_e < detector.capacity_e, theory_m / TO_SIGMA, np.nan)[0]
        with without_warnings():  # the measurement itself will warn
            image = decode(expose(signals, sensor, detector, exposure_s, 0, self.ambient), self.decoder)
        return np.asarray(image.reading_m[self.some] - clean_m)


def few_of_each(group: np.ndarray) -> np.ndarray:
    """(h, w) bool, pixels that tell the noise of each group: a quarter of them all, evenly spread, and all pixels of
    groups that have less than `ENOUGH_PIXELS` of these.

    group : (h, w) int, number of the group of each pixel.
    """
    quarter = np.zeros(group.shape, dtype=bool)
    quarter[::2, ::2] = True
    n = np.bincount(group[quarter], minlength=int(group.max()) + 1)
    return quarter | (n < ENOUGH_PIXELS)[group]


def groups(instance: np.ndarray) -> np.ndarray:
    """Number of the group of each pixel, (h, w) int: the pixels of one instance in one square of `BLOCK_PX`.

    instance : (h, w) int, number of the instance that a pixel sees; -1, for none, forms groups of its own.

    Examples
    --------
    >>> groups(np.array([[0, 0, -1], [0, 1, 1]]))
    array([[1, 1, 0],
           [1, 2, 2]])
    """
    h, w = instance.shape
    y, x = np.ogrid[:h, :w]
    block = y // BLOCK_PX * (w // BLOCK_PX + 1) + x // BLOCK_PX
    _, number = np.unique(block * (instance.max() + 2) + instance + 1, return_inverse=True)
    return np.asarray(number.reshape(h, w))


def group_sigma(errors: np.ndarray, group: np.ndarray, where_unknown: float = 0.0) -> np.ndarray:
    """Standard deviation of the errors in each group, (k,) float64.

    It is the median of the absolute values times `TO_SIGMA`, so that a few large errors have little influence.

    errors : (n,) or (h, w) with mean 0; NaN where there is none. group : int of that shape, number of the group.
    where_unknown : value for a group without any error.
    """
    known = ~np.isnan(errors)
    values, of = np.abs(errors[known]), group[known]
    values = np.append(values[np.lexsort((values, of))], 0)
    n = np.bincount(of, minlength=int(group.max()) + 1)
    middle = np.where(n > 0, np.cumsum(n) - n + n // 2, -1)
    return np.asarray(np.where(n > 0, TO_SIGMA * values[middle], where_unknown))
