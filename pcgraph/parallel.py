# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over many elements, cut into one block per thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from numba import config, njit

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True, "error_model": "numpy"}
kernel = njit(**_OPTIONS)
"""Decorator of a compiled function that Python calls; kernels may call it, too.

What is divided by zero is infinite or NaN, as in NumPy: checks would keep loops from being done in lanes. Wrappers that
nobody calls are left out here and below: they would cost a third of the time that compiling takes.
"""
routine = njit(**_OPTIONS, no_cpython_wrapper=True)
"""Decorator of a compiled function that only kernels call."""
summing_routine = njit(**_OPTIONS, no_cpython_wrapper=True, fastmath={"reassoc"})
"""The same for one whose sums are taken in lanes, as wide as the processor's, and five times as fast.

Their last digits then depend on the kind of processor, as NumPy's own do, but not on the number of threads.
"""
inlined = njit(**_OPTIONS, inline="always")
"""The same for a small one of many arguments that is called often: handing them over would take as long as its work."""

_A = TypeVar("_A")
_B = TypeVar("_B")
MIN_BLOCK = 4096
"""Elements; starting a thread costs as much as some thousands of them."""
MIN_ROWS = 16
"""The same for elements that are rows of an image."""


def in_blocks(loop: Callable[..., _A], n: int, *arguments: object, smallest: int = MIN_BLOCK) -> list[_A]:
    """What `loop(start, stop, *arguments)` returns for blocks that cover 0..n, run at the same time, block by block.

    Threads are started anew and joined: no pool outlives the call, so a process may fork at any time and
    several threads may call at once. As many run as ``NUMBA_NUM_THREADS`` says, by default one per core.

    Parameters
    ----------
    loop : callable that spends its time without the interpreter's lock, such as one compiled with ``nogil=True``
        Writes only what belongs to its own block, so that no result depends on the number of threads.
    n : int
    arguments
        Handed on to every call.
    smallest : int
        Elements of a block, at least.
    """
    blocks = max(1, min(int(config.NUMBA_NUM_THREADS), n // smallest))
    bounds = [n * block // blocks for block in range(blocks + 1)]
    if blocks == 1:
        return [loop(0, n, *arguments)]
    with ThreadPoolExecutor(blocks - 1) as pool:
        others = [pool.submit(loop, bounds[b], bounds[b + 1], *arguments) for b in range(1, blocks)]
        first = loop(bounds[0], bounds[1], *arguments)
    return [first, *(other.result() for other in others)]  # raises what a loop raised


def side_by_side(first: Callable[[], _A], second: Callable[[], _B]) -> tuple[_A, _B]:
    """What two calls return that spend their time in compiled code and do not need each other."""
    if int(config.NUMBA_NUM_THREADS) < 2:
        return first(), second()
    with ThreadPoolExecutor(1) as other:
        later = other.submit(second)
        return first(), later.result()
