# SPDX-License-Identifier: Apache-2.0
"""Macro-pixels of several SPADs, photon by photon in compiled loops: dead time, afterpulses, coincidence.

Each SPAD fires at the next photon after it is armed. The photons of a SPAD are a Poisson process whose rate follows the
histogram of the mean light, so the next one is found by inversion: the light that has arrived grows by an exponential
deviate from photon to photon (time rescaling). The work grows with the number of firings, not with the light that finds
a SPAD dead. Nothing is approximated but what `rangesim.electronics.spad.SpadDetector` says.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcgraph.kernel_cache import cached_njit


class Circuit(NamedTuple):
    """A macro-pixel and its timing, as kernels take it; times are in bins of the histogram.

    spads : number of SPADs that share the pixel's light evenly.
    coincidence, window : a count is made of so many firings within such a time. first_only : whether a timer takes only
        the first count after each pulse.
    dead : time for which a SPAD is blind after it fired. afterpulsing : probability that it then fires again of its
        own, after a time that is exponential with the mean `decay`.
    pulses : number of laser pulses. period : time from pulse to pulse, at least the number of bins.
    """

    spads: int
    coincidence: int
    window: float
    first_only: bool
    dead: float
    afterpulsing: float
    decay: float
    pulses: int
    period: float


@cached_njit(nogil=True, error_model="numpy")
def count_events(rng, radiance, pixel, circuit, max_photons, counts):  # type: ignore[no-untyped-def]
    """Write the counts of one image row.

    radiance : (bins, w) float32, W/m2/sr, mean radiance. pixel : `rangesim.electronics.spad.CountingPixel`.
    circuit : `Circuit`. max_photons : largest mean number of photons of a SPAD and pulse that is drawn.
    counts : (bins, w) unsigned integers, the output.
    """
    bins, columns = radiance.shape
    histories = circuit.pulses * circuit.spads
    together = circuit.spads if circuit.coincidence > 1 else 1  # without coincidence, SPADs know nothing of each other
    arrived, found = np.empty(bins + 1), np.empty(bins)
    fires, recent = np.empty(together), np.empty(circuit.coincidence)
    for column in range(columns):
        arrived[0] = 0.0
        for b in range(bins):
            mean = max(pixel.counts_per_radiance * radiance[b, column] + pixel.dark, 0.0) / histories
            arrived[b + 1] = arrived[b] + mean
        if arrived[bins] > max_photons:
            arrived *= max_photons / arrived[bins]
        found[:] = 0.0
        if arrived[bins] > 0:
            for _ in range(circuit.spads // together):
                _history(rng, arrived, circuit, fires, recent, found)
        for b in range(bins):
            counts[b, column] = min(found[b], pixel.max_dn)


@cached_njit(nogil=True, error_model="numpy")
def _history(rng, arrived, circuit, fires, recent, found):  # type: ignore[no-untyped-def]
    """Add the counts of all pulses that the SPADs of one timer make.

    arrived : (bins + 1,) mean photons of a SPAD from the pulse to the end of each bin. fires : (n,) time at which each
    SPAD fires next. recent : times of the latest firings that no count was made of. found : (bins,) counts.
    """
    bins, last_pulse, waiting = len(found), -1.0, 0
    end = circuit.pulses * circuit.period
    for i in range(len(fires)):
        fires[i] = _next_photon(rng, 0.0, arrived, circuit)
    while True:
        s = int(np.argmin(fires)) if len(fires) > 1 else 0
        time = fires[s]
        if time >= end:
            return
        armed = time + circuit.dead
        fires[s] = _next_photon(rng, armed, arrived, circuit)
        if circuit.afterpulsing > 0 and rng.random() < circuit.afterpulsing:
            again = armed + circuit.decay * rng.standard_exponential()
            if again % circuit.period < bins:  # while the gate is closed, a SPAD is off
                fires[s] = min(fires[s], again)
        while waiting > 0 and time - recent[0] > circuit.window:
            waiting -= 1
            recent[:waiting] = recent[1 : waiting + 1]
        recent[waiting] = time
        waiting += 1
        if waiting < circuit.coincidence:
            continue
        waiting = 0
        pulse = math.floor(time / circuit.period)
        if circuit.first_only and pulse == last_pulse:
            continue
        last_pulse = pulse
        found[min(max(math.floor(time - pulse * circuit.period), 0), bins - 1)] += 1.0


@cached_njit(nogil=True, error_model="numpy")
def _next_photon(rng, time, arrived, circuit):  # type: ignore[no-untyped-def]
    """Time of the first photon after `time`; infinity if it comes after the last pulse."""
    bins = len(arrived) - 1
    of_pulse = arrived[bins]
    pulse = math.floor(time / circuit.period)
    within = time - pulse * circuit.period
    b = math.floor(within)
    so_far = of_pulse
    if b < bins:
        so_far = arrived[b] + (within - b) * (arrived[b + 1] - arrived[b])
    so_far += rng.standard_exponential()
    more = math.floor(so_far / of_pulse)
    pulse, so_far = pulse + more, so_far - more * of_pulse
    if pulse >= circuit.pulses:
        return math.inf
    b = min(np.searchsorted(arrived, so_far, side="right"), bins) - 1
    mean = arrived[b + 1] - arrived[b]
    return pulse * circuit.period + b + (min((so_far - arrived[b]) / mean, 1.0) if mean > 0 else 0.0)
