# SPDX-License-Identifier: Apache-2.0
"""Noise of a range image by where it comes from: the detector, which is physics, and the sampling of light paths, which
is the renderer's and should be small against it.

Signals keep one draw of their sampling error (`rangesim.signals.SamplingError`). Added to them and subtracted, it gives
the signals of each half of the samples. Half the difference of what a decoder reads in these without noise is a draw of
the sampling error of the reading, whatever the decoder makes of it. What a reading with noise differs by from that
without is the error of the detector. Readings that a half lacks, or has alone, tell how uncertain the fraction of
missing ones is.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rangesim.capture import Capture
from rangesim.capture.exposure import exposed_again
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import SamplingWarning, sentence
from rangesim.evaluation.reference_readings import ReferenceReadings
from rangesim.robust_scale import sigma_from_median
from rangesim.settings.seeds import SEEDS
from rangesim.signals import ALL

if TYPE_CHECKING:
    from rangesim.signals import GroundTruth, Signals

SMALL = 0.5
"""Sampling noise over the detector's, above which a warning is due: the sum of both is an eighth larger then."""
SMALL_LOSS = 0.03
"""Uncertainty of the fraction of pixels with a reading, above which a warning is due: losses that differ by less are
rarely told apart by the few pixels of a material."""
ENOUGH_PIXELS = 100
"""Readings of a material, or nothing is warned about."""
NOISE_SEEDS = (SEEDS - 3, SEEDS - 2, SEEDS - 1)
"""Seeds of the detector's noise where a capture is repeated; far from those that people and `derived_seed` give."""


@dataclass(frozen=True, eq=False)
class Repeats:
    """Pixels without a reading by the same decoder in repeated captures, each (h, w) bool.

    whole : of all samples, the range image itself. again : of all samples, with other noise of the detector.
    halves : of each half of the samples, with other noise of the detector.
    """

    whole: np.ndarray
    again: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]

    def completeness_error(self, mask: np.ndarray) -> float | None:
        """Bound on how far the fraction of pixels of `mask` (h, w) bool with a reading is from that of very many
        samples; None without pixels.

        A pixel that has a reading with half of the samples and none with all of them, or the other way round, is one
        that sampling decides about. More samples may change as many again, most of them in one direction, so the
        larger of the two fractions is taken, summed over both halves. Twice the pixels that the detector's noise alone
        changes are subtracted, and the standard error of these counts is added, which matters where pixels are few.
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
    """Errors of the readings of a range image, each (h, w) float32, metres, of z; NaN where there is no reading.

    detector : the error that the detector's noise made of each reading; NaN also where it is not known.
    sampling : a draw of the error that the sampling of light paths makes; of the same variance, not the error itself.
        Infinite where sampling decides whether there is a reading at all.
    repeats : what repeated captures read; None: the detector of the capture is not known.
    """

    detector: np.ndarray
    sampling: np.ndarray
    repeats: Repeats | None = None

    def by_material(self, truth: GroundTruth) -> list[dict[str, Any]]:
        """`detector_sigma_m`, `sampling_sigma_m` and `completeness_error` per material class of `truth` that occurs,
        "all" last.

        The sigmas are robust: 1.4826 times the median of the absolute error, metres; None where there is nothing to
        tell, or half of the errors are infinite. The last says by how much a pass of very many samples may change
        `rangesim.evaluation.comparison.ErrorStatistics.completeness`; None where that is not known.
        """
        return [
            {
                "detector_sigma_m": robust_sigma(self.detector[mask]),
                "sampling_sigma_m": robust_sigma(self.sampling[mask]),
                "completeness_error": self.repeats and self.repeats.completeness_error(mask & truth.projector_visible),
            }
            for mask in truth.classes().values()
        ]


def range_noise(image: RangeImage, capture: Capture, signals: Signals) -> RangeNoise:
    """Noise of a range image that was decoded from a capture of these signals.

    Raises
    ------
    ValueError
        The signals do not know their sampling error (`Signals.knows_sampling_error`), or lack the capture's sensor.
    """
    return noise_of(ReferenceReadings(image, capture, signals))


def noise_of(readings: ReferenceReadings) -> RangeNoise:
    """Noise of a range image, from its reference readings; errors as of `range_noise`."""
    image, capture = readings.image, readings.capture
    above, below = readings.halves
    _, sampling = _middle_and_draw(image, above, below)
    if not capture.is_digital:
        nothing = np.full(image.z.shape, np.nan, np.float32)
        return RangeNoise(nothing, sampling, Repeats(~image.valid, ~image.valid, (np.isnan(above), np.isnan(below))))
    clean = readings.noise_free.astype(np.float64)
    repeats = None
    if capture.detector is not None:
        seeds_and_errors = zip(NOISE_SEEDS, (0.0, 1.0, -1.0), strict=True)
        captures = [exposed_again(capture, readings.signals, *each) for each in seeds_and_errors]
        again, above, below = readings.read(captures)
        repeats = Repeats(~image.valid, np.isnan(again), (np.isnan(above), np.isnan(below)))
    return RangeNoise((image.z - clean).astype(np.float32), sampling, repeats)


def sampling_draw(image: RangeImage, capture: Capture, signals: Signals) -> tuple[np.ndarray, np.ndarray]:
    """The mean of what both halves of the samples read without noise, (h, w) float64, and `RangeNoise.sampling`.

    Where sampling is large, a decoder is not linear, and this mean is not what it reads of all samples.

    Raises
    ------
    ValueError
        As `range_noise`.
    """
    return _middle_and_draw(image, *ReferenceReadings(image, capture, signals).halves)


def _middle_and_draw(image: RangeImage, above: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean of both halves' depths and `RangeNoise.sampling`, each (h, w)."""
    above, below = above.astype(np.float64), below.astype(np.float64)
    sampling = np.where(np.isnan(above) | np.isnan(below), np.inf, (above - below) / 2)
    sampling[~image.valid] = np.nan
    return (above + below) / 2, sampling.astype(np.float32)


def warn_of_sampling(tables: Mapping[str, Sequence[dict[str, Any]]], spp: int) -> None:
    """Warn of the material classes on which sampling is not small against the detector's noise, or decides which pixels
    have a reading.

    Parameters
    ----------
    tables : of each instrument by name, rows with `material`, `pixels`, `lit` and `completeness`, and what
        `RangeNoise.by_material` gives.
    spp : samples that a pixel had, at most.

    Warns
    -----
    SamplingWarning
    """
    noisy, lossy, largest = [], [], 0.0
    for name, rows in tables.items():
        of_class = [r for r in rows if r["material"] != ALL]
        ratios = {r["material"]: noise_ratio(r) for r in of_class if r["pixels"] >= ENOUGH_PIXELS}
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
    """Fraction of the lit pixels of a row without a reading, and its uncertainty."""
    return f"{100 * (1 - row['completeness']):.0f} ± {100 * row['completeness_error']:.0f} % on {row['material']}"


def _power_of_two(number: int) -> int:
    """The smallest power of two that is not below a number."""
    return 1 << (number - 1).bit_length()


def noise_ratio(row: dict[str, Any]) -> float:
    """Sampling noise over the detector's, of a row; 0 where either is not known, or there is none."""
    sampling, detector = row["sampling_sigma_m"], row["detector_sigma_m"]
    return sampling / detector if sampling and detector else 0.0


def robust_sigma(errors: np.ndarray) -> float | None:
    """Standard deviation about 0 from the median of the absolute value of those errors that are not NaN; None if there
    are none, or it is infinite."""
    known = errors[~np.isnan(errors)]
    sigma = sigma_from_median(known) if known.size else np.inf
    return sigma if np.isfinite(sigma) else None
