# SPDX-License-Identifier: Apache-2.0
"""Compiled loops over many elements, cut into one block per thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from numba import config

from pcgraph.kernel_cache import cached_njit


def _compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator of compiled functions that are kept on disk."""
    return cached_njit(nogil=True, no_cfunc_wrapper=True, error_model="numpy", **options)


kernel = _compiled()
"""Decorator of a compiled function that Python calls; kernels may call it, too.

What is divided by zero is infinite or NaN, as in NumPy: checks would keep loops from being vectorised. Wrappers that
nobody calls are left out here and below: they would cost a third of the time that compiling takes.
"""
routine = _compiled(no_cpython_wrapper=True)
"""Decorator of a compiled function that only kernels call."""
summing_routine = _compiled(no_cpython_wrapper=True, fastmath={"reassoc"})
"""Decorator of a compiled function, called by kernels only, whose sums are vectorised (SIMD): five times as fast.

Their last digits then depend on the kind of processor, as NumPy's own do, but not on the number of threads.
"""
inlined = _compiled(inline="always")
"""Decorator of a small function of many arguments, called often by kernels: it is inlined."""

_A = TypeVar("_A")
_B = TypeVar("_B")
MIN_BLOCK = 4096
"""Least count of elements in a thread's block, because the start of a thread costs as much as some thousands of
them."""
MIN_ROWS = 16
"""Least count of image rows in a thread's block, for the same reason."""


def in_blocks(loop: Callable[..., _A], n: int, *arguments: object, smallest: int = MIN_BLOCK) -> list[_A]:
    """Results of `loop(start, stop, *arguments)` over contiguous blocks of 0..n, run in threads, in their order.

    Threads are started anew and joined: no pool outlives the call, so a process may fork at any time and
    several threads may call at once. As many run as ``NUMBA_NUM_THREADS`` says, by default one per core.

    Parameters
    ----------
    loop : callable that spends its time with the GIL released, such as one compiled with ``nogil=True``
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
    """Results of two independent calls, in two threads if there are as many; both should release the GIL."""
    if int(config.NUMBA_NUM_THREADS) < 2:
        return first(), second()
    with ThreadPoolExecutor(1) as other:
        later = other.submit(second)
        return first(), later.result()
