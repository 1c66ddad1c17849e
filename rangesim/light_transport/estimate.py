# SPDX-License-Identifier: Apache-2.0
"""Means over samples, taken in rounds and in two halves, whose difference tells the error of the mean."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial

import numpy as np

from rangesim.light_transport.indirect import Guides, smooth
from rangesim.light_transport.launches import Launches, Report
from rangesim.light_transport.loop import Budget, Radiance, Settings, Traced, View, trace
from rangesim.light_transport.responses import Accumulators
from rangesim.light_transport.truncation import Tally
from rangesim.response import Response
from rangesim.rig import Rig
from rangesim.signals import SamplingError

BYTES_PER_LANE = 512
"""State of one lane besides its channels, an upper bound."""
FEWEST_FOR_HALVES = 3
"""Samples of a pixel: two and one."""
SMOOTH = [Radiance._fields.index("multipath"), Radiance._fields.index("faint")]
"""Light that neighbouring pixels may share."""


class Sums:
    """Sums over samples of each pixel, or means.

    channels : response -> (c, h, w) float32. smooth : the same of light that is kept apart; empty if none is.
    radiance : (6, h, w) float32, in the order of `Radiance`.
    """

    def __init__(
        self, channels: dict[Response, np.ndarray], smooth: dict[Response, np.ndarray], radiance: np.ndarray
    ) -> None:
        self.channels, self.smooth, self.radiance = channels, smooth, radiance

    @classmethod
    def zeros(cls, responses: Iterable[Response], keeps_apart: bool, h: int, w: int) -> Sums:
        """Sums over no samples."""
        channels, apart = (
            {r: np.zeros((r.channels, h, w), np.float32) for r in kept}
            for kept in (responses, responses if keeps_apart else ())
        )
        return cls(channels, apart, np.zeros((len(Radiance._fields), h, w), np.float32))

    def copy(self, responses: Iterable[Response]) -> Sums:
        """A copy of what these responses need."""
        channels, apart = ({r: kept[r].copy() for r in responses if r in kept} for kept in (self.channels, self.smooth))
        return Sums(channels, apart, self.radiance.copy())

    def add(self, pixels: np.ndarray, traced: Traced, accumulators: Accumulators) -> None:
        """Add the sums of pixels with these flat indices, in ascending order."""
        some: slice | np.ndarray = pixels
        if pixels[-1] - pixels[0] + 1 == len(pixels):
            some = slice(pixels[0], pixels[-1] + 1)
        parts = [self.channels, self.smooth] if self.smooth else [self.channels]
        for response, values in zip(self.channels, accumulators.images(), strict=True):
            for part, of_part in zip(parts, values, strict=True):
                part[response].reshape(response.channels, -1)[:, some] += of_part
        self.radiance.reshape(len(self.radiance), -1)[:, some] += traced.radiance

    def planes(self) -> Iterator[np.ndarray]:
        """Channels and radiance, one (h, w) view after the other."""
        for image in (*self.channels.values(), *self.smooth.values(), self.radiance):
            yield from image

    def divide(self, samples: np.ndarray) -> None:
        """Make means of these sums over so many samples (h, w)."""
        for plane in self.planes():
            plane /= samples

    def average(self, other: Sums, own_samples: np.ndarray, other_samples: np.ndarray) -> None:
        """Make means over all samples of these sums and the other; the other ones become a draw of the error of that.

        With means a and b over p and q samples, (a - b) sqrt(p q) / (p + q) has the variance of the mean of all.
        """
        p, q = own_samples.astype(np.float32), other_samples.astype(np.float32)
        n = p + q
        of_own, of_other = np.sqrt(q / p) / n, np.sqrt(p / q) / n
        for a, b in zip(self.planes(), other.planes(), strict=True):
            difference = a * of_own - b * of_other
            a += b
            a /= n
            b[:] = difference

    def share(self, guides: Guides) -> None:
        """Let neighbouring pixels share smooth light; the channels then have all light."""
        radiance = self.radiance[SMOOTH]
        smooth([radiance, *self.smooth.values()], guides)
        self.radiance[SMOOTH] = radiance
        while self.smooth:
            response, light = self.smooth.popitem()
            self.channels[response] += light


class Estimate:
    """What the samples taken so far say.

    Parameters
    ----------
    view, settings : View and Settings, what is sampled.
    rig, responses : whose image, and what is summed up.
    keeps_apart : whether smooth light is kept apart, to be shared by neighbours.
    has_halves : whether samples are dealt into halves; every pixel then needs `FEWEST_FOR_HALVES` at once.
    memory_bytes : of the arrays of the renderer.
    """

    def __init__(
        self,
        view: View,
        settings: Settings,
        rig: Rig,
        responses: Sequence[Response],
        keeps_apart: bool,
        has_halves: bool,
        memory_bytes: int,
        launches: Launches,
    ) -> None:
        self.view, self.settings, self.launches, self.memory_bytes = view, settings, launches, memory_bytes
        self.responses, self.keeps_apart, self.irradiance = responses, keeps_apart, rig.projector_irradiance
        self.shape = rig.camera.height, rig.camera.width
        self.halves = [Sums.zeros(responses, keeps_apart, *self.shape) for _ in range(1 + has_halves)]
        self.samples = [np.zeros(self.shape, np.uint32) for _ in self.halves]
        self.tally = np.zeros((len(Tally._fields), *self.shape), np.float32)
        self.rounds = 0

    def sample(self, pixels: np.ndarray, samples: np.ndarray, report: Report) -> None:
        """Take so many samples (n,) more of pixels (n,), given by ascending flat indices; all have had equally many.

        `report` gets the share done.
        """
        first = int(sum(taken.ravel()[pixels[0]] for taken in self.samples))
        samples = samples.astype(np.uint32)
        whole = Budget(pixels, samples, samples + np.uint32(first), self.irradiance, first, part=self.rounds)
        parts = whole.halves() if len(self.halves) == 2 else [whole]
        total, done = int(samples.sum(dtype=np.int64)), 0
        for begin, end in self._tiles(len(pixels)):
            for part, sums, taken in zip(parts, self.halves, self.samples, strict=True):
                budget = part.of(slice(begin, end))
                of_tile = int(budget.samples.sum(dtype=np.int64))
                accumulators = Accumulators(self.responses, end - begin, self.keeps_apart)
                so_far = partial(_report, report, done / total, of_tile / total)
                traced = trace(self.view, self.settings, budget, accumulators, self.launches, so_far)
                sums.add(budget.pixels, traced, accumulators)
                taken.ravel()[budget.pixels] += budget.samples
                self.tally.reshape(len(self.tally), -1)[:, budget.pixels] += traced.tally
                done += of_tile
        self.rounds += 1

    @property
    def total_samples(self) -> np.ndarray:
        """(h, w) uint32, samples taken of each pixel."""
        return np.asarray(sum(self.samples))

    def mean_tally(self) -> np.ndarray:
        """(6, h, w) float32, means over samples in the order of `Tally`."""
        return np.asarray(self.tally / self.total_samples.astype(np.float32))

    def means(self, guides: Guides, responses: Sequence[Response] | None = None) -> tuple[Sums, SamplingError | None]:
        """Means over all samples, and a draw of their error; light that is kept apart is shared as the guides say.

        With `responses` the means of these alone, and more samples may be taken; without, the sums are used up.
        """
        sums = self.halves if responses is None else [half.copy(responses) for half in self.halves]
        if len(sums) == 1:
            sums[0].divide(self.samples[0].astype(np.float32))
        else:
            sums[0].average(sums[1], *self.samples)
        if self.keeps_apart:
            for part in sums:
                part.share(guides)
        return sums[0], _error(sums[1]) if len(sums) == 2 else None

    def _tiles(self, pixels: int) -> Iterator[tuple[int, int]]:
        """Ranges of pixels that fit the memory, of about equal size."""
        bytes_per_pixel = BYTES_PER_LANE + 4 * (1 + self.keeps_apart) * sum(r.channels for r in self.responses)
        if self.memory_bytes < bytes_per_pixel:
            raise ValueError(f"expected a memory budget of at least {bytes_per_pixel} bytes, got {self.memory_bytes}.")
        tiles = -(-pixels * bytes_per_pixel // self.memory_bytes)
        size = max(1, -(-pixels // tiles))
        for begin in range(0, pixels, size):
            yield begin, min(begin + size, pixels)


def _error(drawn: Sums) -> SamplingError:
    radiance = Radiance(*drawn.radiance)
    projector = radiance.direct + radiance.multipath + radiance.via_delta + radiance.caustic + radiance.faint
    return SamplingError(drawn.channels, projector)


def _report(report: Report, before: float, share: float, of_tile: float) -> None:
    report(before + share * of_tile)
