# SPDX-License-Identifier: Apache-2.0
"""Noise of a range image by where it comes from: the detector, which is physics, and the sampling of light paths, which
is the renderer's and should be small against it.

Signals keep one draw of their sampling error (`rangesim.signals.SamplingError`). Added to them and subtracted, it gives
two noise-free captures; half the difference of their readings is a draw of the sampling error of the reading, whatever
the decoder makes of it. What a reading with noise differs by from the mean of the two is the error of the detector.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rangesim.capture import Capture
from rangesim.capture.exposure import noise_free_capture
from rangesim.decoding.range_image import RangeImage
from rangesim.errors import SamplingWarning, sentence, without_warnings
from rangesim.signals import ALL

if TYPE_CHECKING:
    from rangesim.signals import GroundTruth, Signals

TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over the median of the absolute value."""
SMALL = 0.5
"""Sampling noise over the detector's, above which a warning is due: the sum of both is an eighth larger then."""
ENOUGH_PIXELS = 100
"""Readings of a material, or nothing is warned about."""


@dataclass(frozen=True, eq=False)
class RangeNoise:
    """Errors of the readings of a range image, each (h, w) float32, metres, of z; NaN where there is no reading.

    detector : the error that the detector's noise made of each reading; NaN also where it is not known.
    sampling : a draw of the error that the sampling of light paths makes; of the same variance, not the error itself.
        Infinite where sampling decides whether there is a reading at all.
    """

    detector: np.ndarray
    sampling: np.ndarray

    def by_material(self, truth: GroundTruth) -> list[dict[str, Any]]:
        """`detector_sigma_m` and `sampling_sigma_m` per material class of `truth` that occurs, "all" last.

        Robust: 1.4826 times the median of the absolute error, metres; None where there is nothing to tell, or half of
        the errors are infinite.
        """
        return [
            {
                "detector_sigma_m": robust_sigma(self.detector[mask]),
                "sampling_sigma_m": robust_sigma(self.sampling[mask]),
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
    from rangesim.decoding import decode

    with without_warnings():
        above, below = (
            decode(noise_free_capture(signals, capture.sensor, capture.ambient, error), image.decoder).z.astype(float)
            for error in (1.0, -1.0)
        )
    detector = image.z - (above + below) / 2 if capture.is_digital else np.full(image.z.shape, np.nan)
    sampling = np.where(np.isnan(above) | np.isnan(below), np.inf, (above - below) / 2)
    sampling[~image.valid] = np.nan
    return RangeNoise(detector.astype(np.float32), sampling.astype(np.float32))


def warn_of_sampling(tables: Mapping[str, Sequence[dict[str, Any]]]) -> None:
    """Warn of the material classes on which sampling is not small against the detector's noise.

    Parameters
    ----------
    tables : of each instrument by name, rows with `material`, `pixels` and what `RangeNoise.by_material` gives.

    Warns
    -----
    SamplingWarning
    """
    noisy = []
    for name, rows in tables.items():
        ratios = {r["material"]: noise_ratio(r) for r in rows if r["material"] != ALL and r["pixels"] >= ENOUGH_PIXELS}
        if found := [f"{ratio:.1f} on {material}" for material, ratio in ratios.items() if ratio > SMALL]:
            noisy.append(f"{name}: {', '.join(found)}")
    if noisy:
        text = f"the renderer's sampling noise over the detector's is {'; '.join(noisy)}; more samples (spp) lower it."
        warnings.warn(SamplingWarning(sentence(text)), stacklevel=3)


def noise_ratio(row: dict[str, Any]) -> float:
    """Sampling noise over the detector's, of a row; 0 where either is not known, or there is none."""
    sampling, detector = row["sampling_sigma_m"], row["detector_sigma_m"]
    return sampling / detector if sampling and detector else 0.0


def robust_sigma(errors: np.ndarray) -> float | None:
    """Standard deviation about 0 from the median of the absolute value of those errors that are not NaN; None if there
    are none, or it is infinite."""
    known = np.abs(errors[~np.isnan(errors)])
    median = float(np.median(known)) if known.size else np.inf
    return TO_SIGMA * median if np.isfinite(median) else None
