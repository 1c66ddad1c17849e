# SPDX-License-Identifier: Apache-2.0
"""Random numbers and the places of samples within a pixel."""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np


class Seed(NamedTuple):
    """The halves of a seed of 64 bits, UInt32 and opaque, so that no kernel is compiled for a seed."""

    low: Any
    high: Any

    @classmethod
    def of(cls, seed: int) -> Seed:
        """The halves of a checked seed (`rangesim.settings.seeds.check_seed`)."""
        return cls(dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), dr.opaque(mi.UInt32, seed >> 32))


class Stream(Enum):
    """Independent streams of random numbers for one seed and number."""

    FIRST = "first"
    SECOND = "second"
    THIRD = "third"


def random_stream(seed: Seed, number: Any, stream: Stream = Stream.FIRST) -> Any:
    """PCG32 that depends on the seed and the UInt32 `number` alone, not on the lane.

    Both are mixed by the block cipher TEA (Zafar, Olano, Curtis: GPU random numbers via the tiny encryption
    algorithm, HPG 2010), which is one to one. A seed of more than 32 bits goes through it twice, its upper half
    added in between: so no seed is another one in disguise.
    """
    pair = (number, seed.low) if stream is Stream.THIRD else (seed.low, number)
    once = [mi.UInt32(x) for x in mi.sample_tea_32(*pair)]
    twice = mi.sample_tea_32(once[0] + seed.high, once[1])
    states = [mi.UInt64(dr.select(seed.high == 0, a, b)) for a, b in zip(once, twice, strict=True)]
    return mi.PCG32(1, *(reversed(states) if stream is Stream.SECOND else states))  # 1: no lane number mixed in


def of_part(rng: Any, part: Any) -> Any:
    """The numbers of a PCG32 for one of several parts (UInt32) that share its seed, 2^40 numbers apart."""
    return rng + mi.Int64(mi.UInt64(part) << 40)


class Continued:
    """A stream of which a loop carries the state alone.

    What a loop carries and never changes, like the increment, makes Dr.Jit trace it twice: that takes seconds where
    there are thousands of shapes. This class hides it, and whatever else is held by an object that is no array.
    """

    def __init__(self, rng: Any) -> None:
        self.rng = rng

    def at(self, state: Any) -> Any:
        """The PCG32 in that state (UInt64)."""
        rng = mi.PCG32(self.rng)
        rng.state = state
        return rng


def stratified(shift: Any, sample: Any) -> Any:
    """Place of a sample within its pixel: the R2 sequence (Roberts 2018), shifted per pixel; fills the pixel evenly."""
    return _sequence(shift, sample, (0.7548776662466927, 0.5698402909980532))


def in_pairs(shift: Any, lens_shift: Any, sample: Any, samples: Any) -> tuple[Any, Any]:
    """Places of a sample in its pixel and on the lens (None without a `lens_shift`), each in the unit square.

    Every second sample is the one before it mirrored about the centres; of an odd number of samples, the last one is at
    the centres. What is linear in the place, as phase and depth are on a plane, then has no sampling error at all: its
    mean is its value at the centre (antithetic variates; Hammersley and Morton, Proc. Camb. Phil. Soc. 52, 1956).
    The pairs follow the R2 sequence, with a lens the R4 sequence.
    """
    pair, mirrors = sample >> 1, (sample & 1) == 1
    alone = ~mirrors & (sample + 1 == samples)

    def place(p: Any) -> Any:
        return dr.select(alone, 0.5, dr.select(mirrors, 1 - p, p))

    if lens_shift is None:
        return place(stratified(shift, pair)), None
    in_pixel = _sequence(shift, pair, (0.8566748838545029, 0.733891856627126))
    return place(in_pixel), place(_sequence(lens_shift, pair, (0.6287067210378087, 0.5385972572236101)))


def _sequence(shift: Any, number: Any, steps: tuple[float, float]) -> Any:
    p = shift + mi.Point2f(*(mi.Float(number) * step for step in steps))
    return p - dr.floor(p)


def aligned(values: np.ndarray, dtype: type[np.generic]) -> np.ndarray:
    """A flat copy whose memory starts at a multiple of 64 bytes, as Dr.Jit's own arrays do.

    Dr.Jit reads arrays of NumPy where they lie, and compiles a kernel anew where one of its inputs begins at another
    alignment; NumPy's begin at multiples of 16, as it happens.
    """
    flat = np.ravel(np.asarray(values, dtype))
    memory = np.empty(flat.nbytes + 64, np.uint8)
    first = -memory.ctypes.data % 64
    copy = memory[first : first + flat.nbytes].view(dtype)
    copy[:] = flat
    return copy
