# SPDX-License-Identifier: Apache-2.0
"""Single-photon detectors (SPAD) for direct time of flight: a histogram of photon arrival times in each pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, NamedTuple

import numpy as np

from rangesim.electronics.detector import BandWidth, Bits, Gate, PhotoDetector, streams
from rangesim.rig import Rig
from rangesim.settings.bounds import Bounds, Fraction, PositiveFraction, Seconds, Wavelength

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient


MAX_MEAN = 1e9
"""Largest expected photon count with which a bin is drawn; it replaces larger ones. It changes nothing, because a
counter holds at most 65535 and saturates far below."""


class CountingPixel(NamedTuple):
    """The linear response of one bin of a `SpadDetector` to radiance, for one exposure time.

    counts_per_radiance : expected counts per W/m2/sr.
    dark : expected counts without light.
    max_mean : counts, largest expected number that is drawn.
    max_dn : digital numbers, largest count that the counter holds.
    """

    counts_per_radiance: float
    dark: float
    max_mean: float
    max_dn: int


@dataclass(frozen=True)
class SpadDetector(PhotoDetector):
    """Single-photon detector (SPAD) with a histogram memory in each pixel.

    The number of laser pulses in an exposure is the exposure time over `Gate.period_s`, and their mean power is the
    laser's. Ambient light and dark counts spread evenly over the bins. Nothing is counted outside the bins.

    Parameters
    ----------
    wavelength_m : float, metres, wavelength of the emitter's light.
    quantum_efficiency : float in (0, 1], photon detection efficiency, fill factor included.
    dark_counts_hz : float, counts per second per pixel.
    bits : int in 1..16, depth of the counter of each bin.
    pile_up : bool. True: after each pulse, only the first photon is counted (Coates 1968), even if it is light of an
        earlier pulse. False: every photon is counted.
    ambient_transmission, band_width_m : the band-pass filter against ambient light, see `Detector`.
    min_exposure_s, max_exposure_s : float, seconds, limits of the automatic exposure.

    Raises
    ------
    ValueError
        A number out of its range.

    Examples
    --------
    A laser with a pulse every 25.6 ns sends 3906 pulses in an exposure of 0.1 ms:

    >>> from rangesim import DirectToF, SpadDetector
    >>> detector = SpadDetector(bits=8)
    >>> detector.max_dn
    255
    >>> detector.pulses(DirectToF(bins=256, bin_s=100e-12).gate, exposure_s=1e-4)
    3906
    """

    wavelength_m: Wavelength = 905e-9
    quantum_efficiency: PositiveFraction = 0.15
    dark_counts_hz: Annotated[float, Bounds("0 or positive", 0, 1e12)] = 500.0
    bits: Bits = 12
    pile_up: bool = True
    ambient_transmission: Fraction = 0.02
    band_width_m: BandWidth = 30e-9
    min_exposure_s: Seconds = 10e-6
    max_exposure_s: Seconds = 0.1

    type_name: ClassVar[str] = "spad"

    def __post_init__(self) -> None:
        self._check()

    def check(self, gate: Gate | None) -> None:
        _counting(gate)

    @property
    def capacity_e(self) -> float:
        return float(self.max_dn)

    def pulses(self, gate: Gate | None, exposure_s: float) -> int:
        """Number of laser pulses in an exposure, at least 1."""
        return max(1, round(exposure_s / _counting(gate).period_s))

    def ambient_fraction(self, gate: Gate | None, ambient: Ambient | None = None) -> float:
        """Factor on the scene's ambient light: its part that passes the filter while photons are counted."""
        gate = _counting(gate)
        return super().ambient_fraction(gate, ambient) * gate.open_s / gate.period_s

    def mean_electrons(self, radiance: np.ndarray, gate: Gate | None, rig: Rig, exposure_s: float) -> np.ndarray:
        pixel = self._pixel(_counting(gate), rig, exposure_s)
        return np.asarray(pixel.counts_per_radiance * np.asarray(radiance, dtype=np.float64) + pixel.dark)

    def photons_per_pulse(self, radiance: np.ndarray, gate: Gate | None, rig: Rig) -> np.ndarray:
        """Mean number of photons that a pixel detects per laser pulse: (h, w) float64.

        Ambient light and dark counts are included. All photons of a pulse count here, even with `pile_up`. With
        `pile_up`, the fraction of pulses that add a count to the histogram is 1 - exp(-photons).
        """
        gate = _counting(gate)
        pixel = self._pixel(gate, rig, gate.period_s)  # an exposure of one pulse
        return np.asarray(
            pixel.counts_per_radiance * radiance.sum(axis=0, dtype=np.float64) + len(radiance) * pixel.dark
        )

    def read_out(self, radiance: np.ndarray, gate: Gate | None, rig: Rig, exposure_s: float, seed: int) -> np.ndarray:
        from pcgraph.parallel import MIN_ROWS, in_blocks
        from rangesim.electronics.shot_noise import count_first_photons, count_photons

        gate, height = _counting(gate), radiance.shape[1]
        pixel, pulses = self._pixel(gate, rig, exposure_s), self.pulses(gate, exposure_s)
        result, rngs = np.empty(radiance.shape, dtype=self.dtype), streams(seed, height)

        def read(start: int, stop: int) -> None:
            for row in range(start, stop):
                means = np.ascontiguousarray(radiance[:, row], dtype=np.float32)
                if self.pile_up:
                    count_first_photons(rngs[row], means, pixel, pulses, result[:, row])
                else:
                    count_photons(rngs[row], means, pixel, result[:, row])

        in_blocks(read, height, smallest=MIN_ROWS)
        return result

    def _pixel(self, gate: Gate, rig: Rig, exposure_s: float) -> CountingPixel:
        pulses = self.pulses(gate, exposure_s)
        return CountingPixel(
            counts_per_radiance=self.electron_rate_per_radiance(rig) * pulses * gate.period_s,
            dark=float(self.dark_counts_hz * pulses * gate.open_s / gate.bins),
            max_mean=MAX_MEAN,
            max_dn=self.max_dn,
        )


def _counting(gate: Gate | None) -> Gate:
    """The gate of a sensor that counts photons; ValueError if there is none."""
    if gate is None:
        raise ValueError("expected a sensor that counts photons, such as DirectToF, for a SpadDetector.")
    return gate
