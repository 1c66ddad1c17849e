# SPDX-License-Identifier: Apache-2.0
"""Seeds: which numbers they may be, and how one gives others."""

from __future__ import annotations

from typing import Any

import numpy as np

SEEDS = 1 << 64
"""Seeds are whole numbers from 0 to one less than this; each has its own stream of random numbers everywhere."""
_LOW = (1 << 32) - 1


def check_seed(seed: Any, name: str = "seed") -> int:
    """The seed as a Python integer.

    Raises
    ------
    ValueError
        It is no whole number of 0 to 2^64 - 1; a bool is none either.
    """
    if isinstance(seed, (bool, np.bool_)) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < SEEDS:
        raise ValueError(f"expected {name} to be a whole number from 0 to 2^64 - 1, got {seed!r}.")
    return int(seed)


def derived_seed(seed: int, *key: int) -> int:
    """Another seed, one for each seed and key (whole numbers of 32 bits): of 32 bits for a seed of 32, else of 64.

    The upper half of a seed is a key of its own kind (`spawn_key`), so that it is never taken for one of `key`.
    """
    low, high = seed & _LOW, seed >> 32
    if not high:
        return int(np.random.SeedSequence([low, *key]).generate_state(1)[0])
    return int(np.random.SeedSequence([low, *key], spawn_key=(high,)).generate_state(1, np.uint64)[0])
