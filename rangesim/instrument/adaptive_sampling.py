# SPDX-License-Identifier: Apache-2.0
"""How many samples a pixel needs: so many that sampling adds little to the noise of the detectors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from rangesim.capture.exposure import expose
from rangesim.decoding import decode
from rangesim.electronics.ambient import Ambient
from rangesim.evaluation.range_noise import sampling_draw
from rangesim.instrument.instrument import Instrument
from rangesim.light_transport.sampler import Sampler
from rangesim.robust_scale import TO_SIGMA
from rangesim.sensor import Sensor
from rangesim.settings.bounds import Bounds, check_fields, whole

if TYPE_CHECKING:
    from rangesim.response import Response
    from rangesim.signals import GroundTruth, StillSignals

FIRST_SPP = 8
"""Samples that all pixels get."""
FRACTION = 1 / 3
"""Of the detector's noise, that of sampling at most: together they are then a twentieth above the detector's alone."""
NEGLIGIBLE = 1e-5
"""Standard deviation, over the median depth of the scene, that is small enough in any case."""
BLOCK_PX = 16
"""Edge of the squares whose pixels of one instance are judged together."""


@dataclass(frozen=True)
class AdaptiveSampling(Sampler):
    """Some samples of every pixel, and then as many more as the noise of its readings asks for.

    The variance of a mean falls with the number of samples, so the first ones tell how many there have to be (two-stage
    sampling: Stein, Ann. Math. Statist. 16, 1945). Pixels are judged in groups, for every instrument; the noisiest one
    decides.

    Where an instrument has no detector, all noise is the renderer's, and only what is negligible is small.

    Parameters
    ----------
    instruments : whose detectors, exposures and decoders decide.
    max_spp : int >= 1, samples that no pixel exceeds.
    fraction : positive, standard deviation of a reading by sampling, over that by the detector, that is small enough.
    ambient : Ambient, as for `expose`.
    """

    instruments: tuple[Instrument, ...]
    max_spp: Annotated[int, whole(1, "spp")] = 64
    fraction: Annotated[float, Bounds("positive and finite", 1e-6, 1e6)] = FRACTION
    ambient: Ambient | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def of(cls, sensors: Sequence[Sensor]) -> AdaptiveSampling:
        """For sensors with their default detectors."""
        return cls(tuple(Instrument(f"sensor-{i}", sensor) for i, sensor in enumerate(sensors)))

    @property
    def first_spp(self) -> int:
        return min(FIRST_SPP, self.max_spp)

    @property
    def most_spp(self) -> int:
        return self.max_spp

    def check(self, responses: Sequence[Response]) -> None:
        for instrument in self.instruments:
            if missing := set(instrument.sensor.responses()) - set(responses):
                raise ValueError(
                    f"expected sensors that have {missing.pop()}, for instrument {instrument.name!r} of spp."
                )

    def samples(self, truth: GroundTruth, signals_of: Callable[[Sequence[Response]], StillSignals]) -> np.ndarray:
        group = groups(truth.instance)
        excess = np.zeros(group.max() + 1)  # of the variance, over what is small enough
        z = truth.z[np.isfinite(truth.z)]
        negligible = NEGLIGIBLE * float(np.median(z)) if z.size else 0.0
        for instrument in self.instruments:
            signals = signals_of(instrument.sensor.responses())
            capture = expose(
                signals, instrument.sensor, instrument.detector_in_use, instrument.exposure_s, 0, self.ambient
            )
            image = decode(capture, instrument.decoder)
            middle, sampling = sampling_draw(image, capture, signals)
            from_middle = (image.z - middle).astype(np.float32)  # at little cost, the detector's error, or more
            enough = np.full(len(excess), negligible)
            if capture.is_digital:  # where nothing can be read, samples are of no use
                enough = np.maximum(enough, self.fraction * group_sigma(from_middle, group, where_unknown=np.inf))
            with np.errstate(divide="ignore", invalid="ignore"):
                excess = np.fmax(excess, (group_sigma(sampling, group) / enough) ** 2)
        wanted = 4 * np.ceil(self.first_spp * np.minimum(excess, self.max_spp) / 4)  # whole pairs in both halves
        return np.clip(wanted, self.first_spp, max(self.first_spp, self.max_spp // 4 * 4)).astype(np.int64)[group]


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
