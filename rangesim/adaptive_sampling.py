# SPDX-License-Identifier: Apache-2.0
"""How many samples a pixel needs: so many that sampling adds little to the noise of the detectors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from rangesim.ambient import Ambient
from rangesim.bounds import Bounds, check_fields, whole
from rangesim.decoding import decode
from rangesim.exposure import expose
from rangesim.instrument import Instrument
from rangesim.reading_noise import TO_SIGMA, reading_noise
from rangesim.sensors import Sensor

if TYPE_CHECKING:
    from rangesim.signals import GroundTruth, Signals

SHARE = 1 / 3
"""Of the detector's noise, that of sampling at most: together they are then a twentieth above the detector's alone."""
NEGLIGIBLE = 1e-5
"""Standard deviation, over the median depth of the scene, that is small enough in any case."""
BLOCK_PX = 16
"""Edge of the squares whose pixels of one instance are judged together."""


@dataclass(frozen=True)
class AdaptiveSampling:
    """Samples in rounds, each of three times as many as were taken before, until sampling adds little to the noise.

    Where an instrument has no detector, all noise is the renderer's, and only what is negligible is small.

    Parameters
    ----------
    instruments : whose detectors, exposures and decoders decide; every one has to be content.
    max_spp : int >= 1, samples that no pixel exceeds.
    share : positive, standard deviation of a reading by sampling, over that by the detector, that is small enough.
    ambient : Ambient, as for `expose`.
    """

    instruments: tuple[Instrument, ...]
    max_spp: Annotated[int, whole(1, "spp")] = 64
    share: Annotated[float, Bounds("positive and finite", 1e-6, 1e6)] = SHARE
    ambient: Ambient | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def of(cls, sensors: Sequence[Sensor]) -> AdaptiveSampling:
        """For sensors with their usual detectors."""
        return cls(tuple(Instrument(f"sensor-{i}", sensor) for i, sensor in enumerate(sensors)))

    def unfinished(self, truth: GroundTruth, signals_of: Callable[[Sensor], Signals]) -> np.ndarray:
        """(h, w) bool, pixels that need more samples; `signals_of` gives the signals of one sensor so far."""
        group = groups(truth.instance)
        result = np.zeros(truth.instance.shape, bool)
        z = truth.z[np.isfinite(truth.z)]
        negligible = NEGLIGIBLE * float(np.median(z)) if z.size else 0.0
        for one in self.instruments:
            signals = signals_of(one.sensor)
            capture = expose(signals, one.sensor, one.detector, one.exposure_s, 0, self.ambient)
            noise = reading_noise(decode(capture), capture, signals)
            enough = np.full(group.max() + 1, negligible)
            if capture.is_digital:  # where nothing can be read, samples are of no use
                enough = np.maximum(enough, self.share * group_sigma(noise.detector, group, where_unknown=np.inf))
            result |= (group_sigma(noise.sampling, group) > enough)[group]
        return result


def groups(instance: np.ndarray) -> np.ndarray:
    """(h, w) int, numbers of groups: pixels of one instance (-1 counts as one) in a square of `BLOCK_PX`."""
    h, w = instance.shape
    y, x = np.ogrid[:h, :w]
    block = y // BLOCK_PX * (w // BLOCK_PX + 1) + x // BLOCK_PX
    _, number = np.unique(block * (instance.max() + 2) + instance + 1, return_inverse=True)
    return np.asarray(number.reshape(h, w))


def group_sigma(errors: np.ndarray, group: np.ndarray, where_unknown: float = 0.0) -> np.ndarray:
    """(groups,) standard deviation about 0 of errors (h, w), from the median of the absolute values that are not NaN;
    `where_unknown` in groups without any."""
    known = ~np.isnan(errors)
    values, of = np.abs(errors[known]), group[known]
    values = np.append(values[np.lexsort((values, of))], 0)
    n = np.bincount(of, minlength=int(group.max()) + 1)
    middle = np.where(n > 0, np.cumsum(n) - n + n // 2, -1)
    return np.asarray(np.where(n > 0, TO_SIGMA * values[middle], where_unknown))
