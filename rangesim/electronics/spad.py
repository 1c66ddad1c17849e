# SPDX-License-Identifier: Apache-2.0
"""Single-photon detectors (SPAD) for direct time of flight: a histogram of photon arrival times in each pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, NamedTuple

import numpy as np

from rangesim.electronics.detector import BandWidth, Bits, Blindness, Gate, PhotoDetector, streams
from rangesim.rig import Rig
from rangesim.settings.bounds import Bounds, Fraction, Pause, PositiveFraction, Seconds, Wavelength

if TYPE_CHECKING:
    from rangesim.electronics.ambient import Ambient
    from rangesim.electronics.spad_events import Circuit


MAX_MEAN = 1e9
"""Largest expected photon count with which a bin is drawn; it replaces larger ones. It changes nothing, because a
counter holds at most 65535 and saturates far below."""


MAX_PHOTONS = 1000.0
"""Largest mean number of photons of one SPAD and pulse that is drawn photon by photon; it replaces larger ones, which
would take minutes. A SPAD with a dead time of 1 ns is then dead more than 90 % of a period of 100 ns."""


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

    A pixel may be a macro-pixel: several SPADs that share its light and add to one histogram, each with a timer of its
    own, or all with one timer that takes only coincidences. Dead time, afterpulses and coincidences are drawn photon by
    photon, which takes about 0.1 us for each time that a SPAD fires.

    The number of laser pulses in an exposure is the exposure time over `Gate.period_s`, and their mean power is the
    laser's. Ambient light and dark counts spread evenly over the bins. Nothing is counted outside the bins.

    Parameters
    ----------
    wavelength_m : float, metres, wavelength of the emitter's light.
    quantum_efficiency : float in (0, 1], photon detection efficiency, fill factor included.
    dark_counts_hz : float, counts per second per pixel.
    bits : int in 1..16, depth of the counter of each bin.
    pile_up : bool. True: after each pulse, a timer counts only the first photon (Coates 1968), or coincidence of
        photons, even if it is light of an earlier pulse. False: every photon that finds its SPAD armed is counted.
    spads : int, number of SPADs of a pixel. `quantum_efficiency` and `dark_counts_hz` are those of the whole pixel.
    coincidence : int, number of photons within `coincidence_window_s` that are needed for a count, at the time of the
        last of them; each photon is used once. With 2 or more, a pixel has a single timer.
    coincidence_window_s : float, seconds.
    dead_time_s : float, seconds for which a SPAD is blind after it fired; photons that come then do not prolong it.
    afterpulsing : float from 0 to 0.9, probability that a SPAD, once armed again, fires of its own, unless a photon
        makes it fire before.
    afterpulse_decay_s : float, seconds, mean time from there to an afterpulse, which is exponential.
    ambient_transmission, band_width_m : the band-pass filter against ambient light, see `Detector`.
    min_exposure_s, max_exposure_s : float, seconds, limits of the automatic exposure.

    Raises
    ------
    ValueError
        A number out of its range.

    Notes
    -----
    Not modelled: crosstalk between SPADs, jitter (it is part of the sensor's pulse), timers that are blind while they
    convert, and SPADs of one pixel that see different light. All SPADs are armed when the exposure begins.

    Examples
    --------
    A laser with a pulse every 25.6 ns sends 3906 pulses in an exposure of 0.1 ms:

    >>> from rangesim import DirectToF, SpadDetector
    >>> detector = SpadDetector(bits=8)
    >>> detector.max_dn
    255
    >>> detector.pulses(DirectToF(bins=256, bin_s=100e-12).gate, exposure_s=1e-4)
    3906

    A macro-pixel of a flash LiDAR: 16 SPADs, and counts of two photons within 2 ns, which ambient light seldom brings:

    >>> macro = SpadDetector(spads=16, coincidence=2, coincidence_window_s=2e-9, dead_time_s=10e-9)
    """

    wavelength_m: Wavelength = 905e-9
    quantum_efficiency: PositiveFraction = 0.15
    dark_counts_hz: Annotated[float, Bounds("0 or positive", 0, 1e12)] = 500.0
    bits: Bits = 12
    pile_up: bool = True
    spads: Annotated[int, Bounds("a number of SPADs", 1, 4096)] = 1
    coincidence: Annotated[int, Bounds("a number of photons", 1, 64)] = 1
    coincidence_window_s: Seconds = 2e-9
    dead_time_s: Pause = 0.0
    afterpulsing: Annotated[float, Bounds("a probability", 0, 0.9)] = 0.0
    afterpulse_decay_s: Seconds = 20e-9
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

    def first_only(self, gate: Gate | None, exposure_s: float) -> int | None:
        """Number of times that a timer starts and takes one count at most: pulses times timers; None without `pile_up`.

        `rangesim.decoding.histogram.coates` undoes the pile-up of so many pulses.
        """
        timers = self.spads if self.coincidence == 1 else 1
        return self.pulses(gate, exposure_s) * timers if self.pile_up else None

    def blindness(self, gate: Gate | None, exposure_s: float) -> Blindness | None:
        """When the timers of a pixel are blind, or None, see `PhotoDetector.blindness`.

        It is None also where a pixel counts all coincidences, because no formula tells which of them are lost.
        """
        gate, firsts = _counting(gate), self.first_only(gate, exposure_s)
        if firsts is None and (self.dead_time_s == 0 or self.coincidence > 1):
            return None
        bin_s, dead_s = gate.open_s / gate.bins, self.dead_time_s if self.coincidence == 1 else 0.0
        trials = self.pulses(gate, exposure_s) * self.spads if firsts is None else firsts
        return Blindness(trials, firsts is not None, dead_s / bin_s, gate.period_s / bin_s)

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
        from rangesim.electronics.spad_events import count_events

        gate, height = _counting(gate), radiance.shape[1]
        pixel, firsts, circuit = self._pixel(gate, rig, exposure_s), self.first_only(gate, exposure_s), None
        if self.coincidence > 1 or self.dead_time_s > 0 or self.afterpulsing > 0:
            circuit = self._circuit(gate, exposure_s)
        result, rngs = np.empty(radiance.shape, dtype=self.dtype), streams(seed, height)

        def read(start: int, stop: int) -> None:
            for row in range(start, stop):
                means = np.ascontiguousarray(radiance[:, row], dtype=np.float32)
                if circuit is not None:
                    count_events(rngs[row], means, pixel, circuit, MAX_PHOTONS, result[:, row])
                elif firsts is not None:
                    count_first_photons(rngs[row], means, pixel, firsts, result[:, row])
                else:
                    count_photons(rngs[row], means, pixel, result[:, row])

        in_blocks(read, height, smallest=MIN_ROWS)
        return result

    def _circuit(self, gate: Gate, exposure_s: float) -> Circuit:
        from rangesim.electronics.spad_events import Circuit

        bin_s = gate.open_s / gate.bins
        return Circuit(
            spads=self.spads,
            coincidence=self.coincidence,
            window=self.coincidence_window_s / bin_s,
            first_only=self.pile_up,
            dead=self.dead_time_s / bin_s,
            afterpulsing=float(self.afterpulsing),
            decay=self.afterpulse_decay_s / bin_s,
            pulses=self.pulses(gate, exposure_s),
            period=gate.period_s / bin_s,
        )

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
