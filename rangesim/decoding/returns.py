# SPDX-License-Identifier: Apache-2.0
"""Several returns of one photon histogram: pulses of a known shape, fitted one after the other.

A pixel that sees an edge, a pane, or a cover glass gets light back from several distances. `find_returns` looks for the
strongest pulse, subtracts what it explains, and looks again (matching pursuit). Each time, the places and strengths of
all pulses found so far are fitted anew, each with the light of the others as background. The fit is the maximum of the
Poisson likelihood, so that the places are as precise as the photons allow (`FoundReturns.sigma`).

References
----------
Wagner et al.: "Gaussian decomposition and calibration of a novel small-footprint full-waveform digitising airborne
laser scanner", ISPRS J. 60 (2006). Fessler & Hero: "Space-alternating generalized expectation-maximization algorithm",
IEEE Trans. Signal Processing 42 (1994).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rangesim.decoding.status import Status
from rangesim.response import Pulse
from rangesim.settings.config import ShortRepr

STEPS_PER_BIN = 32
"""Number of entries of a `PulseShape` per bin. Between them the arrived light is interpolated linearly, which moves a
pulse of one bin by less than a thousandth of a bin."""
GAUSSIAN_SIGMAS = 5.0
"""Standard deviations at which the table of a Gaussian pulse ends; 6e-7 of the pulse lie beyond."""
SPARROW_SIGMAS = 2.0
"""Distance of two Gaussian pulses of equal strength, in their standard deviations, at which the dip between them
vanishes (Sparrow's limit). Pulses that are closer count as one return."""
MIN_DISTANCE_BINS = 1.0
"""Least distance of two returns in bins, for pulses that are shorter than a bin, because a bin does not tell where
in it the light is."""


class PulseShape(NamedTuple):
    """The shape of a pulse, tabulated for kernels.

    start : bins, time of the first entry; 0 is where the path length of a pulse is read.
    steps : number of entries per bin.
    before, behind : numbers of bins that the pulse reaches before and behind the bin of its place.
    arrived : (t,) float64, fraction of the pulse that has arrived.
    density : (t,) float64, its derivative, per bin.
    sigma : bins, standard deviation of the Gaussian that needs as many photons to rise above an even background. For a
        pulse with a long tail it is far less than the pulse's own.
    """

    start: float
    steps: float
    before: int
    behind: int
    arrived: np.ndarray
    density: np.ndarray
    sigma: float

    def arrived_at(self, bins: np.ndarray) -> np.ndarray:
        """(...) float64, fraction of the pulse that has arrived `bins` (...) behind its place."""
        return np.interp(bins, self.start + np.arange(len(self.arrived)) / self.steps, self.arrived)

    @classmethod
    def gaussian(cls, sigma_bins: float) -> PulseShape:
        """The shape of a Gaussian pulse; with a standard deviation of 0, of light that stays in one bin.

        Examples
        --------
        >>> round(PulseShape.gaussian(4.0).sigma, 2)
        4.01
        """
        from scipy.special import ndtr

        if sigma_bins == 0:  # a bin wide, so that the middle of the bin explains its light best
            return _shape(-0.5, 0.5, lambda bins: np.clip(bins + 0.5, 0.0, 1.0))
        reach = GAUSSIAN_SIGMAS * sigma_bins
        return _shape(-reach, reach, lambda bins: ndtr(bins / sigma_bins))

    @classmethod
    def measured(cls, pulse: Pulse, bin_s: float) -> PulseShape:
        """The shape of a measured pulse in bins of `bin_s` seconds."""
        return _shape(pulse.start_s / bin_s, pulse.stop_s / bin_s, lambda bins: pulse.arrived(bins * bin_s))


def _shape(start: float, stop: float, arrived_at: Callable[[np.ndarray], np.ndarray]) -> PulseShape:
    """The table of a pulse between two times, bins. arrived_at : fraction that has arrived at times (t,), bins."""
    steps = int(np.ceil((stop - start) * STEPS_PER_BIN - 1e-9)) + 1
    bins = start + np.arange(steps) / STEPS_PER_BIN
    arrived = np.asarray(arrived_at(bins), dtype=np.float64)
    arrived = (arrived - arrived[0]) / (arrived[-1] - arrived[0])
    template = np.diff(np.interp(np.arange(np.floor(start) - 1, np.ceil(stop) + 2) + 0.5, bins, arrived))
    sigma = float(1 / (2 * np.sqrt(np.pi) * (template**2).sum()))
    density = np.gradient(arrived, 1 / STEPS_PER_BIN)
    before, behind = int(np.ceil(-start)) + 1, int(np.ceil(bins[-1])) + 1
    return PulseShape(float(start), float(STEPS_PER_BIN), before, behind, arrived, density, sigma)


class ReturnRules(NamedTuple):
    """Requirements on a return; it has to meet all of them.

    most : largest number of returns of a pixel; the strongest are kept.
    sigmas : least strength in standard deviations of what lies under it: the background, and the other returns' light.
        A quarter of its square is added, in counts, because Poisson counts stray farther upwards: their square root has
        the standard deviation 1/2 (Anscombe, Biometrika 35, 1948).
    counts : least strength, in counts (or the unit of the histogram).
    tolerance : least strength as a fraction of what the other returns bring to its place. The shape of a pulse is known
        no better, so that a weaker return is taken for an error of the shape.
    """

    most: int
    sigmas: float
    counts: float
    tolerance: float


class FoundReturns(NamedTuple):
    """Returns of n histograms, nearest first; (most, n) float64, NaN where there is none, but a strength of 0.

    place : bins from the start of the first bin.
    strength : counts of the pulse, also of the part that the ends of the histogram cut off.
    sigma : bins, standard deviation of `place` by the shot noise (the Cramér-Rao bound at the places found, for all
        places and strengths at once, so that it grows where returns overlap).
    """

    place: np.ndarray
    strength: np.ndarray
    sigma: np.ndarray


def find_returns(
    histogram: np.ndarray,
    shape: PulseShape,
    rules: ReturnRules,
    is_cyclic: bool = False,
    excess: np.ndarray | None = None,
) -> FoundReturns:
    """Returns of each histogram, nearest first.

    Parameters
    ----------
    histogram : (k, n) float, counts without pile-up, one histogram per column.
    is_cyclic : whether the first bin follows on the last one.
    excess : (k, n) float, variance of the counts over their means, see `pile_up_excess`; None: 1, as of photons.

    Examples
    --------
    Two Gaussian pulses of 1000 and 250 photons, 16.3 bins apart, on one count a bin:

    >>> import numpy as np
    >>> shape, edges = PulseShape.gaussian(3.0), np.arange(65)[:, None]
    >>> pulses = 1000 * shape.arrived_at(edges - 20.0) + 250 * shape.arrived_at(edges - 36.3)
    >>> found = find_returns(1 + np.diff(pulses, axis=0), shape, ReturnRules(most=3, sigmas=5, counts=5, tolerance=0.1))
    >>> found.place[:, 0].round(1), found.strength[:, 0].round()
    (array([20. , 36.3,  nan]), array([1000.,  250.,    0.]))
    """
    from rangesim.decoding.returns_kernels import fit_returns

    place, strength, sigma = np.empty((3, rules.most, histogram.shape[1]))
    distance = max(SPARROW_SIGMAS * shape.sigma, MIN_DISTANCE_BINS)
    counts = np.ascontiguousarray(histogram, dtype=np.float64)
    ratio = np.ones((1, 1)) if excess is None else np.ascontiguousarray(excess, dtype=np.float64)
    fit_returns(counts, ratio, shape, rules, bool(is_cyclic), distance, place, strength, sigma)
    return FoundReturns(place, strength, sigma)


@dataclass(frozen=True, eq=False, repr=False)
class Returns(ShortRepr):
    """All returns of each pixel of a range image, nearest first.

    Each array is (k, h, w); where a pixel has fewer than k returns, `status` is LOW_SIGNAL and the numbers are NaN.

    Parameters
    ----------
    range_m : float32, metres, Euclidean distance from the camera; also given where `status` is SATURATED or
        OUT_OF_RANGE, as long as the return has a place.
    strength : float32, counts of the return's pulse (for a noise-free capture, W/m2/sr).
    sigma_m : float32, metres, standard deviation of `range_m` by the noise of the frames; NaN also where not known.
    status : uint8, values of `Status`. OUT_OF_RANGE: a return that is no target, because it is nearer than the
        decoder's `min_range_m`, or outside the histogram.

    Raises
    ------
    ValueError
        The arrays differ in shape, or have not three axes.

    Examples
    --------
    >>> import numpy as np
    >>> two = np.array([1.0, 1.5], dtype=np.float32).reshape(2, 1, 1)
    >>> returns = Returns(range_m=two, strength=100 / two, sigma_m=two / 1000, status=np.zeros((2, 1, 1), np.uint8))
    >>> returns.number
    array([[2]])
    """

    range_m: np.ndarray
    strength: np.ndarray
    sigma_m: np.ndarray
    status: np.ndarray

    def __post_init__(self) -> None:
        shapes = {a.shape for a in (self.range_m, self.strength, self.sigma_m, self.status)}
        if len(shapes) != 1 or self.range_m.ndim != 3:
            raise ValueError(f"expected four arrays of one shape (k, h, w), got {sorted(shapes)}.")

    @property
    def number(self) -> np.ndarray:
        """(h, w) int, number of returns whose `status` is OK."""
        return np.asarray((self.status == Status.OK).sum(axis=0))
