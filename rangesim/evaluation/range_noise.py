# SPDX-License-Identifier: Apache-2.0
"""Noise of a range image by its source: the detector, or the renderer's random sampling of light paths.

The noise of the detector is physics. The noise of sampling belongs to the renderer and should be small against it.

Signals keep one draw of their sampling error (`rangesim.signals.SamplingError`). The signals plus this draw are the
signals of one half of the samples; the signals minus it are those of the other half. The decoder reads both halves
without noise. Half the difference of the two readings is a draw of the sampling error of the reading, whatever the
decoder does.

The error that the detector makes is the difference between a reading with noise and the reading without.

Pixels that have a reading in only one half of the samples show how uncertain the fraction of missing readings is.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rangesim.capture import Captured
from rangesim.capture.exposure import exposed_again
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import SamplingWarning, sentence
from rangesim.evaluation.reference_readings import ReferenceReadings, sampling_draw
from rangesim.evaluation.surface_rows import MATERIAL, with_mean_over_objects
from rangesim.robust_scale import sigma_from_median
from rangesim.settings.seeds import SEEDS

if TYPE_CHECKING:
    from rangesim.signals import GroundTruth, Signals

SMALL = 0.5
"""Ratio of the sampling noise to the detector's noise above which a run warns.

At this ratio, both noises together are an eighth larger than the detector's noise alone, because variances add.
"""
SMALL_LOSS = 0.03
"""Uncertainty of the fraction of pixels with a reading above which a run warns, as a fraction of these pixels.

Smaller differences between two sensors are rarely significant, because a material covers few pixels.
"""
ENOUGH_PIXELS = 100
"""Least number of pixels of a material on which a run warns; statistics of fewer pixels vary too much to act on."""
NOISE_SEEDS = (SEEDS - 3, SEEDS - 2, SEEDS - 1)
"""Seeds of the detector's noise in repeated captures.

They are the three largest seeds, which hardly any capture has, so that its noise is not repeated.
"""


@dataclass(frozen=True, eq=False)
class Repeats:
    """Pixels without a reading by the same decoder, in a range image and in repeated captures; (h, w) bool each.

    whole : pixels without a reading in the range image itself.
    again : the same in a capture of all samples with other noise of the detector.
    halves : the same in captures of each half of the samples, with other noise of the detector.
    """

    whole: np.ndarray
    again: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]

    def completeness_error(self, mask: np.ndarray) -> float | None:
        """Bound on the change of the fraction of pixels with a reading if very many samples were taken.

        If a pixel has a reading with half of the samples and none with all of them, or the other way round, sampling
        decides about it. More samples may change as many pixels again, and most of them in one direction. The function
        therefore takes the larger of the two fractions, summed over both halves. It subtracts twice the number of
        pixels that the detector's noise alone changes, and adds the standard error of the counts, which matters where
        pixels are few.

        Parameters
        ----------
        mask : (h, w) bool, the pixels that are counted; without any, the bound is None.
        """
        if not mask.any():
            return None
        whole, again, halves = self.whole[mask], self.again[mask], [half[mask] for half in self.halves]
        errors = []
        for before in (False, True):
            same = whole == before
            by_both = sum(int(np.sum(same & (half != before))) for half in halves)
            by_detector = 2 * int(np.sum(same & (again != before)))
            errors.append(max(by_both - by_detector, 0) + math.sqrt(by_both + by_detector))
        return min(1.0, max(errors) / whole.size)


@dataclass(frozen=True, eq=False)
class RangeNoise:
    """Errors of z of a range image by their source, (h, w) float32, metres; NaN where there is no reading.

    detector : error that the detector's noise made in each reading; NaN also where it is not known.
    sampling : a draw with the variance of the error that the sampling of light paths makes; not the error itself.
        Infinite where sampling decides whether there is a reading at all.
    repeats : pixels that lack a reading in repeated captures; None: the detector of the capture is not known.
    """

    detector: np.ndarray
    sampling: np.ndarray
    repeats: Repeats | None = None

    def by_surface(self, truth: GroundTruth) -> list[dict[str, Any]]:
        """Noise per surface, one dict for each row of `compare`, with its `kind` and `name`.

        `detector_sigma_m` and `sampling_sigma_m` are standard deviations in metres, estimated as 1.4826 times the
        median of the absolute error; None where there are no readings, or half of the errors are infinite.
        `completeness_error` is the change of `rangesim.evaluation.comparison.ErrorStatistics.completeness` that a pass
        of very many samples may bring, see `Repeats.completeness_error`; None where it is not known.
        """
        rows = [
            {
                "kind": kind,
                "name": name,
                "detector_sigma_m": robust_sigma(self.detector[mask]),
                "sampling_sigma_m": robust_sigma(self.sampling[mask]),
                "completeness_error": self.repeats and self.repeats.completeness_error(mask & truth.projector_visible),
            }
            for kind, name, mask in truth.surfaces()
        ]
        return with_mean_over_objects(rows)


def range_noise(image: RangeImage, capture: Captured, signals: Signals) -> RangeNoise:
    """Noise of a range image that was decoded from a capture of these signals.

    Parameters
    ----------
    image : RangeImage, decoded from `capture`.
    capture : Capture or CaptureSet, as `rangesim.expose` made it from `signals`.
    signals : Signals that know their sampling error, as passes of at least 3 samples per pixel do.

    Raises
    ------
    ValueError
        The signals do not know their sampling error (`Signals.knows_sampling_error`), or lack the capture's sensor.
    """
    return noise_of(ReferenceReadings(image, capture, signals))


def noise_of(readings: ReferenceReadings) -> RangeNoise:
    """Noise of a range image, from its reference readings; the errors are those of `range_noise`."""
    image, capture = readings.image, readings.capture.reference
    sampling = sampling_errors(readings)
    if not capture.is_digital:
        nothing = np.full(image.z.shape, np.nan, np.float32)
        above, below = (np.isnan(half) for half in readings.halves)
        return RangeNoise(nothing, sampling, Repeats(~image.valid, ~image.valid, (above, below)))
    clean = readings.noise_free.astype(np.float64)
    repeats = None
    if capture.detector is not None:
        seeds_and_errors = zip(NOISE_SEEDS, (0.0, 1.0, -1.0), strict=True)
        captures = [exposed_again(readings.capture, readings.signals, *each) for each in seeds_and_errors]
        again, above, below = readings.read(captures)
        repeats = Repeats(~image.valid, np.isnan(again), (np.isnan(above), np.isnan(below)))
    return RangeNoise((image.reading_m - clean).astype(np.float32), sampling, repeats)


def sampling_errors(readings: ReferenceReadings) -> np.ndarray:
    """`RangeNoise.sampling` of a range image, (h, w) float32, metres.

    Raises
    ------
    ValueError
        As `range_noise`.
    """
    draw, is_read = sampling_draw(*readings.halves), readings.image.valid
    draw[is_read & np.isnan(draw)] = np.inf
    draw[~is_read] = np.nan
    return draw


def warn_of_sampling(tables: Mapping[str, Sequence[dict[str, Any]]], spp: int) -> None:
    """Warn of material classes on which sampling noise is not small, or sampling decides which pixels have a reading.

    Parameters
    ----------
    tables : rows of statistics, by the name of the instrument. Each row has `kind`, `name`, `pixels`, `lit` and
        `completeness`, and the values of `RangeNoise.by_surface`.
    spp : largest number of samples that a pixel had.

    Warns
    -----
    SamplingWarning
    """
    noisy, lossy, largest = [], [], 0.0
    for name, rows in tables.items():
        of_class = [r for r in rows if r["kind"] == MATERIAL]
        ratios = {r["name"]: noise_ratio(r) for r in of_class if r["pixels"] >= ENOUGH_PIXELS}
        if found := [f"{ratio:.1f} on {material}" for material, ratio in ratios.items() if ratio > SMALL]:
            noisy.append(f"{name}: {', '.join(found)}")
        known = [r for r in of_class if r["lit"] >= ENOUGH_PIXELS and r["completeness_error"] is not None]
        if unsure := [r for r in known if r["completeness_error"] > SMALL_LOSS]:
            lossy.append(f"{name}: {', '.join(_missing(r) for r in unsure)}")
            largest = max(largest, *(r["completeness_error"] for r in unsure))
    if noisy:
        text = f"the renderer's sampling noise over the detector's is {'; '.join(noisy)}; more samples (spp) lower it."
        warnings.warn(SamplingWarning(sentence(text)), stacklevel=3)
    if lossy:
        times = math.ceil((largest / SMALL_LOSS) ** 2)
        text = (
            f"the renderer's sampling noise decides which pixels have a reading; without one are {'; '.join(lossy)}; "
            f"about spp={_power_of_two(times * spp)} would leave {100 * SMALL_LOSS:.0f} points."
        )
        warnings.warn(SamplingWarning(sentence(text)), stacklevel=3)


def _missing(row: dict[str, Any]) -> str:
    """Text of the fraction of lit pixels without a reading in a row, with its uncertainty."""
    return f"{100 * (1 - row['completeness']):.0f} ± {100 * row['completeness_error']:.0f} % on {row['name']}"


def _power_of_two(number: int) -> int:
    """Smallest power of two that is not smaller than a number."""
    return 1 << (number - 1).bit_length()


def noise_ratio(row: dict[str, Any]) -> float:
    """Ratio of sampling noise to detector noise in a row of statistics; 0 where one of them is unknown or 0."""
    sampling, detector = row["sampling_sigma_m"], row["detector_sigma_m"]
    return sampling / detector if sampling and detector else 0.0


def robust_sigma(errors: np.ndarray) -> float | None:
    """Robust standard deviation about 0 of errors, from the median of their absolute values; NaN are left out.

    It is None if no errors are left, or half of them are infinite.
    """
    known = errors[~np.isnan(errors)]
    sigma = sigma_from_median(known) if known.size else np.inf
    return sigma if np.isfinite(sigma) else None
