# SPDX-License-Identifier: Apache-2.0
"""Least differences between frames that the decoders of codes accept."""

from __future__ import annotations

from dataclasses import dataclass

from rangesim.sensor import Threshold
from rangesim.settings.bounds import check_fields


@dataclass(frozen=True)
class GrayThresholds:
    """Least differences between frames that a decoder accepts.

    If the detector is known, they are multiples of the noise. In digital captures of an unknown detector they are
    fractions of full scale, as in OpenCV. In noise-free captures they are fractions of the brightness.

    Parameters
    ----------
    contrast_sigmas, bit_sigmas : float, least white - black and least pattern - inverse, in standard deviations of the
        difference.
    contrast_of_scale, bit_of_scale : float, the same as fractions of full scale, for digital captures of unknown
        detectors.
    relative_contrast : float, least white - black of noise-free captures, as a fraction of white - black at the bright
        pixels.
    relative_bit : float, least pattern - inverse as a fraction of the pixel's white - black, unless the detector is
        unknown. Pixels in shadow see the patterns only by interreflection, and their fine stripes are fainter than that
        at every exposure.

    Examples
    --------
    >>> GrayThresholds(contrast_sigmas=8.0).contrast_sigmas
    8.0
    """

    contrast_sigmas: Threshold = 5.0
    bit_sigmas: Threshold = 3.0
    contrast_of_scale: Threshold = 40 / 255
    bit_of_scale: Threshold = 5 / 255
    relative_contrast: Threshold = 1e-4
    relative_bit: Threshold = 0.1

    def __post_init__(self) -> None:
        check_fields(self)
