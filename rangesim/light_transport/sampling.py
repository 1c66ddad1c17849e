# SPDX-License-Identifier: Apache-2.0
"""Random numbers, and the places of samples within a pixel and on the lens."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence, fractions of a pixel: 1 / phi and 1 / phi^2 with phi^3 = phi + 1 (Roberts 2018)."""
R4 = (0.8566748838545029, 0.733891856627126, 0.6287067210378087, 0.5385972572236101)
"""Steps of the R4 sequence, fractions of a pixel and of the lens: the first four powers of 1 / phi with phi^5 = phi + 1
(Roberts 2018)."""
GOLDEN_STEP = 2654435769
"""Step of a sequence of fractions of 2^32: 2^32 divided by the golden ratio, because its multiples modulo 2^32 are
spread evenly, however many there are."""


class Seed(NamedTuple):
    """The two halves of a seed of 64 bits. They are opaque, so that all seeds share a kernel.

    low, high : UInt32.
    """

    low: mi.UInt32
    high: mi.UInt32

    @classmethod
    def of(cls, seed: int) -> Seed:
        """The halves of a checked seed (`rangesim.settings.seeds.check_seed`)."""
        return cls(dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), dr.opaque(mi.UInt32, seed >> 32))


class Stream(Enum):
    """Names of independent streams of random numbers that share a seed and a number."""

    FIRST = "first"
    SECOND = "second"


def random_stream(seed: Seed, number: mi.UInt32, stream: Stream = Stream.FIRST) -> mi.PCG32:
    """Random numbers that depend only on the seed, the number and the stream, and not on the lane.

    The block cipher TEA mixes seed and number (Zafar, Olano, Curtis: GPU random numbers via the tiny encryption
    algorithm, HPG 2010). TEA maps no two inputs to the same output. A seed of more than 32 bits goes through TEA twice,
    and the upper half of the seed is added in between, so that no two seeds give the same numbers.
    """
    once = [mi.UInt32(x) for x in mi.sample_tea_32(seed.low, number)]
    twice = mi.sample_tea_32(once[0] + seed.high, once[1])
    states = [mi.UInt64(dr.select(seed.high == 0, a, b)) for a, b in zip(once, twice, strict=True)]
    # 1: no lane number mixed in
    return mi.PCG32(1, *(reversed(states) if stream is Stream.SECOND else states))


def of_part(rng: mi.PCG32, part: mi.UInt32) -> mi.PCG32:
    """The random numbers of one of several parts that share a seed. Parts are 2^40 numbers apart in the stream."""
    return rng + mi.Int64(mi.UInt64(part) << 40)


class Continued:
    """A stream of random numbers for a loop that carries its state alone.

    Dr.Jit traces a loop twice if the loop carries something that it never changes, such as the increment of a PCG32.
    With thousands of shapes, that takes seconds. Dr.Jit does not look into this class, so the loop does not
    carry the increment.
    """

    def __init__(self, rng: mi.PCG32) -> None:
        self.rng = rng

    def at(self, state: mi.UInt64) -> mi.PCG32:
        """The generator in that state."""
        rng = mi.PCG32(self.rng)
        rng.state = state
        return rng


def stratified(shift: mi.Point2f, sample: mi.UInt32) -> mi.Point2f:
    """Place of a sample within its pixel, in the unit square.

    The places follow the R2 sequence (Roberts 2018), which fills the pixel evenly; `shift` differs from pixel to pixel.
    """
    return _sequence(shift, sample, R2)


def in_pairs(
    shift: mi.Point2f, lens_shift: mi.Point2f | None, sample: mi.UInt32, samples: mi.UInt32
) -> tuple[mi.Point2f, mi.Point2f | None]:
    """Places of a sample in its pixel and on the lens, each in the unit square.

    The place on the lens is None without `lens_shift`. Samples come in pairs: the second is the first, mirrored about
    the centres of pixel and lens. If the number of samples is odd, the last one is at the centres. A quantity that is
    linear in the place, as phase and depth are on a plane, then has no sampling error: its mean is its value at the
    centre (antithetic variates; Hammersley and Morton, Proc. Camb. Phil. Soc. 52, 1956). The pairs follow the R2
    sequence, or the R4 sequence if there is a lens.

    Parameters
    ----------
    shift, lens_shift : Point2f, shift of the sequence in this pixel and on the lens, uniform in the unit square.
    sample, samples : UInt32, number of the sample, and number of samples of the pixel.
    """
    pair, mirrors = sample >> 1, (sample & 1) == 1
    alone = ~mirrors & (sample + 1 == samples)

    def place(p: mi.Point2f) -> mi.Point2f:
        return dr.select(alone, 0.5, dr.select(mirrors, 1 - p, p))

    if lens_shift is None:
        return place(stratified(shift, pair)), None
    in_pixel = _sequence(shift, pair, R4[:2])
    return place(in_pixel), place(_sequence(lens_shift, pair, R4[2:]))


def along_golden(shift: mi.UInt32, number: mi.UInt32) -> mi.Float:
    """A number in 0..1 for each sample; those of a pixel fill the interval evenly.

    They are the multiples of the golden ratio modulo 1, the sequence of one dimension with the lowest discrepancy
    (Niederreiter, "Random Number Generation and Quasi-Monte Carlo Methods", 1992), shifted by `shift` / 2^32.
    """
    return mi.Float(shift + number * mi.UInt32(GOLDEN_STEP) >> 8) * 2**-24


def used_up(number: mi.Float, probability: mi.Float) -> mi.Float:
    """A number in 0..1 that is uniform, if `number` is so and has decided for something of this probability.

    All numbers that decide the same way form one interval whose length is the probability. Stretched to a length of 1,
    wherever it begins, it covers 0..1 once modulo 1. So one number can decide several times, and evenly spread numbers
    are shared out evenly among all outcomes together.
    """
    stretched = number / probability
    return stretched - dr.floor(stretched)


def _sequence(shift: mi.Point2f, number: mi.UInt32, steps: tuple[float, ...]) -> mi.Point2f:
    """Points of an additive recurrence in the unit square: shift + number * steps, modulo 1."""
    p = shift + mi.Point2f(*(mi.Float(number) * step for step in steps))
    return p - dr.floor(p)


def aligned(values: np.ndarray, dtype: type[np.generic]) -> np.ndarray:
    """A flat copy of the values whose memory starts at a multiple of 64 bytes, as Dr.Jit's own arrays do.

    Dr.Jit reads arrays of NumPy in place, and compiles a kernel again if one of its inputs has another alignment.
    Arrays of NumPy start at any multiple of 16 bytes.
    """
    flat = np.ravel(np.asarray(values, dtype))
    memory = np.empty(flat.nbytes + 64, np.uint8)
    first = -memory.ctypes.data % 64
    copy = memory[first : first + flat.nbytes].view(dtype)
    copy[:] = flat
    return copy
