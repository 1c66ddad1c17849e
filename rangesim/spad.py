# SPDX-License-Identifier: Apache-2.0
"""Photon counters for direct time of flight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, NamedTuple

import numpy as np

from rangesim.bounds import Bounds, Fraction, PositiveFraction, Seconds, Wavelength
from rangesim.detector import BandWidth, Bits, PhotoDetector, streams
from rangesim.rig import Rig
from rangesim.sensors import DirectToF, Sensor

if TYPE_CHECKING:
    from rangesim.ambient import Ambient


MAX_MEAN = 1e9
"""Photons of a bin, on average: more are drawn as this many, which saturates every counter."""


class CountingPixel(NamedTuple):
    """What an exposure makes of radiance, in one bin of a `SpadDetector`.

    photons : per W/m2/sr. dark, max_mean : counts. max_dn : digital numbers.
    """

    photons: float
    dark: float
    max_mean: float
    max_dn: int


@dataclass(frozen=True)
class SpadDetector(PhotoDetector):
    """Single-photon counter with a histogram memory per pixel.

    An exposure holds as many pulses of the laser's mean power as there are periods in it (`DirectToF.period_s`).
    Ambient light and dark counts spread evenly over the bins; before start_s nothing is counted.

    Parameters
    ----------
    wavelength_m : float, metres.
    quantum_efficiency : float in (0, 1], photon detection efficiency, fill factor included.
    dark_counts_hz : float, counts per second per pixel.
    bits : int in 1..16, depth of the counter of a bin.
    pile_up : bool; True: only the first photon of each histogram is counted (Coates 1968), be it of an earlier
        pulse. False: every photon.
    ambient_transmission, band_width_m : the band-pass filter against ambient light, as of `Detector`.
    min_exposure_s, max_exposure_s : float, seconds, limits of the automatic exposure.
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

    @property
    def capacity_e(self) -> float:
        return float(self.max_dn)

    def pulses(self, sensor: Sensor, exposure_s: float) -> int:
        """Number of laser pulses in an exposure."""
        period_s, _ = _gate_s(sensor)
        return max(1, round(exposure_s / period_s))

    def ambient_share(self, sensor: Sensor, ambient: Ambient | None = None) -> float:
        """Factor on the scene's ambient light: what passes the filter while the histogram is open."""
        period_s, open_s = _gate_s(sensor)
        return super().ambient_share(sensor, ambient) * open_s / period_s

    def mean_electrons(self, radiance: np.ndarray, sensor: Sensor, rig: Rig, exposure_s: float) -> np.ndarray:
        pixel = self._pixel(sensor, rig, exposure_s)
        return np.asarray(pixel.photons * np.asarray(radiance, dtype=np.float64) + pixel.dark)

    def read_out(self, radiance: np.ndarray, sensor: Sensor, rig: Rig, exposure_s: float, seed: int) -> np.ndarray:
        from pcgraph.parallel import SMALLEST_ROWS, in_blocks
        from rangesim.shot_noise import count_first_photons, count_photons

        pixel, pulses, height = self._pixel(sensor, rig, exposure_s), self.pulses(sensor, exposure_s), radiance.shape[1]
        result, rngs = np.empty(radiance.shape, dtype=self.dtype), streams(seed, height)

        def read(start: int, stop: int) -> None:
            for row in range(start, stop):
                means = np.ascontiguousarray(radiance[:, row], dtype=np.float32)
                if self.pile_up:
                    count_first_photons(rngs[row], means, pixel, pulses, result[:, row])
                else:
                    count_photons(rngs[row], means, pixel, result[:, row])

        in_blocks(read, height, smallest=SMALLEST_ROWS)
        return result

    def _pixel(self, sensor: Sensor, rig: Rig, exposure_s: float) -> CountingPixel:
        pulses, (period_s, open_s) = self.pulses(sensor, exposure_s), _gate_s(sensor)
        return CountingPixel(
            photons=self.electrons_per_radiance(rig) * pulses * period_s,
            dark=float(self.dark_counts_hz * pulses * open_s / sensor.n_frames),
            max_mean=MAX_MEAN,
            max_dn=self.max_dn,
        )


def _gate_s(sensor: Sensor) -> tuple[float, float]:
    """Seconds from pulse to pulse, and seconds of them during which photons are counted."""
    if not isinstance(sensor, DirectToF):
        raise ValueError(f"expected a direct-tof sensor for a SpadDetector, got {sensor.type_name}.")
    return sensor.period_s, sensor.bins * sensor.bin_s
