# SPDX-License-Identifier: Apache-2.0
"""Means over samples, and the error of these means.

Samples are taken in two halves. Half the difference of their means has the same variance as the error of the mean of
all samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from functools import cached_property, partial

import numpy as np

from pcgraph.kernel_cache import cached_njit
from pcgraph.parallel import in_blocks
from rangesim.light_transport.accumulators import Accumulators
from rangesim.light_transport.indirect_filter import CHANNELS_AT_ONCE, LightFilter
from rangesim.light_transport.kernel_launches import Launches, Report, report_part
from rangesim.light_transport.loop import PathSettings, PathSums, Radiance, SampleAllocation, View, trace
from rangesim.response import Response
from rangesim.rig import Rig
from rangesim.signals import SamplingError

BYTES_PER_LANE = 512
"""Memory per lane besides its channels, in bytes, an upper bound from which the size of tiles follows."""
MIN_FOR_HALVES = 3
"""Smallest number of samples per pixel that can be divided into halves: samples come in pairs, so the halves are a pair
and a single sample."""
SMOOTH = [i for i, field in enumerate(fields(Radiance)) if field.name in ("multipath", "smooth_caustic")]
"""Indices of the kinds of light that neighbouring pixels may share, in the order of the fields of `Radiance`."""


class Sums:
    """Sums over the samples of each pixel of an image.

    channels : response -> (c, h, w) float32.
    smooth : the same for smooth light, if it is kept apart; else empty.
    radiance : (7, h, w) float32, W/m2/sr, in the order of the fields of `Radiance`.
    """

    def __init__(self, h: int, w: int) -> None:
        self.shape = h, w
        self.channels: dict[Response, np.ndarray] = {}
        self.smooth: dict[Response, np.ndarray] = {}
        self.radiance: np.ndarray | None = None

    def add(self, some: Pixels, columns: slice, traced: PathSums, accumulators: Accumulators) -> None:
        """Add these columns (n) of the traced sums to some pixels (n,)."""
        for response, values in zip(accumulators.responses, accumulators.images(), strict=True):
            for part, of_part in zip((self.channels, self.smooth), values, strict=False):
                part[response] = some.added(of_part[:, columns], part.get(response))
        self.radiance = some.added(traced.radiance[:, columns], self.radiance)


class Pixels:
    """Some pixels of an image, to which sums are added.

    Parameters
    ----------
    flat : (n,) int, their flat indices, ascending.
    shape : (h, w) of the image.
    """

    def __init__(self, flat: np.ndarray, shape: tuple[int, int]) -> None:
        self.flat, self.shape = flat, shape
        self.are_all = len(flat) == shape[0] * shape[1]

    @cached_property
    def _runs(self) -> np.ndarray:
        """(k + 1,) int, bounds of successive pixels."""
        return np.flatnonzero(np.diff(self.flat, prepend=-2, append=-2) != 1)

    def added(self, values: np.ndarray, images: np.ndarray | None) -> np.ndarray:
        """The images (c, h, w) with the values (c, n) added; None: the first values.

        The first values of a whole image are not copied: the result is a view of them.
        """
        if images is None and self.are_all and values.flags.writeable:
            return values.reshape(-1, *self.shape)
        if images is None:
            images = np.zeros((len(values), *self.shape), np.float32)
        in_blocks(_add, len(images), values, self.flat, self._runs, images.reshape(len(images), -1), smallest=1)
        return images


@cached_njit(nogil=True, error_model="numpy")
def _add(start, stop, values, pixels, runs, image):  # type: ignore[no-untyped-def]
    """Add `values` (c, n) to the pixels (n,) of an image (c, h w); `runs` (k + 1,) are bounds of successive pixels."""
    for c in range(start, stop):
        row, into = values[c], image[c]
        for i in range(len(runs) - 1):
            begin, end = runs[i], runs[i + 1]
            there = into[pixels[begin] : pixels[begin] + end - begin]
            here = row[begin:end]
            for k in range(end - begin):
                there[k] += here[k]


class Halves:
    """Computes means and draws of their error from the sums over two halves of the samples.

    If there is only one sum, it computes means alone.

    With means a and b over p and q samples, (a - b) sqrt(p q) / (p + q) has the variance of the mean of all samples.

    Parameters
    ----------
    samples : p and q, (h, w) int each; or one such array.

    Examples
    --------
    >>> import numpy as np
    >>> halves = Halves([np.array([[1]]), np.array([[1]])])
    >>> sums = np.array([[[4.0]]], np.float32), np.array([[[2.0]]], np.float32)
    >>> halves.mean_and_error(sums, sums)
    >>> float(sums[0].item()), float(sums[1].item())
    (3.0, 1.0)
    """

    def __init__(self, samples: Sequence[np.ndarray]) -> None:
        counts = [n.astype(np.float32) for n in samples]
        self.total = counts[0]
        if len(counts) == 2:
            p, q = counts
            self.total = p + q
            self.of_a, self.of_b = np.sqrt(q / p) / self.total, np.sqrt(p / q) / self.total

    def mean_and_error(self, sums: Sequence[np.ndarray], out: Sequence[np.ndarray]) -> None:
        """Write the mean over all samples to `out[0]`, and a draw of its error to `out[1]`.

        `sums` are those of the halves, (c, h, w) each; `out` are the same arrays, or arrays of zeros.
        """
        flat = [x.reshape(len(x), -1) for x in (*sums, *out)]
        if len(sums) == 1:
            in_blocks(_write_mean, len(flat[0]), *flat, self.total.ravel(), smallest=1)
            return
        factors = self.of_a.ravel(), self.of_b.ravel(), self.total.ravel()
        in_blocks(_write_mean_and_error, len(flat[0]), *flat, *factors, smallest=1)


@cached_njit(nogil=True, error_model="numpy")
def _write_mean(start, stop, sums, mean, total):  # type: ignore[no-untyped-def]
    """The means of `Halves` without halves; sums (c, n), total (n,). Channels without any light are left out."""
    n = sums.shape[1]
    for c in range(start, stop):
        added, whole = sums[c], mean[c]
        lit = 0
        while lit < n and added[lit] == 0:
            lit += 1
        if lit < n:
            for i in range(n):
                whole[i] = added[i] / total[i]


@cached_njit(nogil=True, error_model="numpy")
def _write_mean_and_error(start, stop, a, b, mean, error, of_a, of_b, total):  # type: ignore[no-untyped-def]
    """The means and drawn errors of `Halves`; sums (c, n), factors (n,). Channels without any light are left out."""
    n = a.shape[1]
    for c in range(start, stop):
        first, second, whole, drawn = a[c], b[c], mean[c], error[c]
        lit = 0
        while lit < n and first[lit] == 0 and second[lit] == 0:
            lit += 1
        if lit < n:
            for i in range(n):
                x, y = first[i], second[i]
                whole[i] = (x + y) / total[i]
                drawn[i] = x * of_a[i] - y * of_b[i]


class Estimate:
    """The image of a camera as estimated from the samples taken so far.

    Parameters
    ----------
    view, settings : View and PathSettings, for the path loop.
    rig : Rig, whose camera takes the image.
    responses : the responses whose channels are summed up.
    keeps_apart : whether smooth light has sums of its own, so that neighbours can share it.
    has_halves : whether samples are divided into halves. Every pixel then needs `MIN_FOR_HALVES` samples at once.
    memory_bytes : largest size of the renderer's arrays.
    launches : Launches, which remember how much work fits into a launch.
    """

    def __init__(
        self,
        view: View,
        settings: PathSettings,
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
        self.halves = [Sums(*self.shape) for _ in range(1 + has_halves)]
        self.samples = [np.zeros(self.shape, np.uint32) for _ in self.halves]
        self.tally: np.ndarray | None = None
        self.rounds = 0

    def sample(self, pixels: np.ndarray, samples: np.ndarray, report: Report) -> None:
        """Take more samples of some pixels.

        Parameters
        ----------
        pixels : (n,) int, flat indices in ascending order.
        samples : (n,) int, number of samples to be taken of each.
        report : called with the fraction done after each launch.
        """
        before = np.stack([taken.ravel()[pixels] for taken in self.samples]).sum(axis=0, dtype=np.uint32)
        samples = samples.astype(np.uint32)
        total, done = int(samples.sum(dtype=np.int64)), 0
        for begin, end in self._tiles(len(pixels)):
            some, of_tile, first = pixels[begin:end], samples[begin:end], before[begin:end]
            allocation = SampleAllocation(some, of_tile, of_tile + first, self.irradiance, first)
            allocation = replace(allocation, part=self.rounds)
            if len(self.halves) == 2:
                allocation = allocation.in_halves()
            accumulators = Accumulators(self.responses, len(allocation.pixels), self.keeps_apart)
            now = int(of_tile.sum(dtype=np.int64))
            so_far = partial(report_part, report, done / total, now / total)
            traced = trace(self.view, self.settings, allocation, accumulators, self.launches, so_far)
            of_image = Pixels(some, self.shape)
            for half, sums in enumerate(self.halves):
                columns = slice(half * len(some), (half + 1) * len(some))
                sums.add(of_image, columns, traced, accumulators)
                self.samples[half].ravel()[some] += allocation.samples[columns]
                self.tally = of_image.added(traced.tally[:, columns], self.tally)
            done += now
        self.rounds += 1

    def caustics_and_light(self) -> tuple[np.ndarray, np.ndarray]:
        """Draw of the error of the caustics at first vertices, and mean of all light of the projector, (h, w) each,
        W/m2/sr. It needs halves."""
        sums = [half.radiance for half in self.halves if half.radiance is not None]
        mean, error = [np.zeros_like(x) for x in sums]
        Halves(self.samples).mean_and_error(sums, [mean, error])
        return Radiance(*error).caustic, projector_light(Radiance(*mean))

    def mean_tally(self) -> np.ndarray:
        """(6, h, w) float32, means over samples, in the order of the fields of `Tally`."""
        assert self.tally is not None
        return np.asarray(self.tally / np.asarray(sum(self.samples)).astype(np.float32))

    def means(
        self, shared: LightFilter | None, responses: Sequence[Response] | None = None
    ) -> tuple[dict[Response, np.ndarray], Radiance, SamplingError | None]:
        """Means of channels and radiance over all samples, and a draw of their error (None without halves).

        Parameters
        ----------
        shared : LightFilter of the smooth light that is kept apart; None if no light is kept apart.
        responses : the responses whose channels are returned; more samples may be taken afterwards. None returns all
            channels and uses up the sums.
        """
        channels, errors, halves = {}, {}, Halves(self.samples)
        for r in self.responses if responses is None else responses:
            sums = [half.channels[r] for half in self.halves]
            out = [_place(x, responses is None) for x in sums]
            for begin in range(0, r.channels, CHANNELS_AT_ONCE):
                some = slice(begin, begin + CHANNELS_AT_ONCE)
                halves.mean_and_error([x[some] for x in sums], [x[some] for x in out])
                if shared:
                    smooth = [half.smooth[r][some] for half in self.halves]
                    parts = [np.zeros(x.shape, x.dtype) for x in smooth]
                    halves.mean_and_error(smooth, parts)
                    for x, part in zip(out, parts, strict=True):
                        shared.apply(part)
                        x[some] += part
            channels[r] = out[0]
            errors[r] = out[-1]
            if responses is None:
                for half in self.halves:
                    del half.channels[r]
                    half.smooth.pop(r, None)
        sums = [half.radiance for half in self.halves if half.radiance is not None]
        out = [_place(x, responses is None) for x in sums]
        halves.mean_and_error(sums, out)
        if shared:
            for x in out:
                light = x[SMOOTH]
                shared.apply(light)
                x[SMOOTH] = light
        error = SamplingError(errors, projector_light(Radiance(*out[1]))) if len(out) == 2 else None
        return channels, Radiance(*out[0]), error

    def _tiles(self, pixels: int) -> Iterator[tuple[int, int]]:
        """Ranges of pixels, of about equal size, whose arrays fit into the memory."""
        bytes_per_pixel = len(self.halves) * (
            BYTES_PER_LANE + 4 * (1 + self.keeps_apart) * sum(r.channels for r in self.responses)
        )
        if self.memory_bytes < bytes_per_pixel:
            raise ValueError(f"expected a memory budget of at least {bytes_per_pixel} bytes, got {self.memory_bytes}.")
        tiles = -(-pixels * bytes_per_pixel // self.memory_bytes)
        size = max(1, -(-pixels // tiles))
        for begin in range(0, pixels, size):
            yield begin, min(begin + size, pixels)


def _place(sums: np.ndarray, is_last: bool) -> np.ndarray:
    """The array for the means: that of the sums if they are not needed any more, or zeros.

    Sums that are a view of a larger array do not hold means, because these would keep all of its memory.
    """
    is_alone = sums.base is None or (isinstance(sums.base, np.ndarray) and sums.base.nbytes == sums.nbytes)
    return sums if is_last and is_alone else np.zeros(sums.shape, sums.dtype)


def projector_light(radiance: Radiance) -> np.ndarray:
    """(h, w) float32, W/m2/sr, all light of the projector but the glint of `glint.py`."""
    straight = radiance.direct + radiance.multipath + radiance.specular
    return np.asarray(straight + radiance.caustic + radiance.smooth_caustic + radiance.glint)
