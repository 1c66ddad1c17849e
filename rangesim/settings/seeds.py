# SPDX-License-Identifier: Apache-2.0
"""Seeds of random numbers: the check of a seed, and further seeds derived from one."""

from __future__ import annotations

from typing import Any

import numpy as np

SEEDS = 1 << 64
"""Number of different seeds, 0 to 2^64 - 1: as many as an unsigned integer of 64 bits holds. Each seed gives another
stream of random numbers in every part of the package."""
_LOW_BITS = (1 << 32) - 1
"""Mask of the lower 32 bits of a seed: `numpy.random.SeedSequence` takes words of 32 bits."""


def check_seed(seed: Any, name: str = "seed") -> int:
    """The seed as a Python integer.

    name : name of the argument, for the message.

    Raises
    ------
    ValueError
        The seed is not a whole number from 0 to 2^64 - 1. A bool does not count as a number.

    Examples
    --------
    >>> check_seed(np.int64(7))
    7
    """
    if isinstance(seed, (bool, np.bool_)) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < SEEDS:
        raise ValueError(f"expected {name} to be a whole number from 0 to 2^64 - 1, got {seed!r}.")
    return int(seed)


def derived_seed(seed: int, *key: int) -> int:
    """A further seed, different for every seed and key, for example one per view of a scan.

    A seed below 2^32 gives a seed below 2^32. Any other seed gives a seed of 64 bits.

    key : whole numbers of 32 bits.

    Examples
    --------
    >>> derived_seed(0, 1) == derived_seed(0, 1), derived_seed(0, 1) == derived_seed(0, 2)
    (True, False)
    """
    # The upper half goes into `spawn_key`, so that it cannot be mistaken for a number of `key`
    low, high = seed & _LOW_BITS, seed >> 32
    if not high:
        return int(np.random.SeedSequence([low, *key]).generate_state(1)[0])
    return int(np.random.SeedSequence([low, *key], spawn_key=(high,)).generate_state(1, np.uint64)[0])
