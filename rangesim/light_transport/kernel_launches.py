# SPDX-License-Identifier: Apache-2.0
"""Kernel launches of bounded time.

A running kernel cannot be stopped, and Python handles a signal (Ctrl-C) only after it. So this module cuts work into
launches of less than a second, and waits for each launch. The time that launches take decides where the work is cut,
and nothing else: the results are the same bytes, however it is cut.

While a kernel is compiled, no signal is handled either: this takes a tenth of a second to a few seconds, once per
machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from pcgraph.plumbing import interrupts

LAUNCH_S = 1.0
"""Duration in seconds that a launch should have. It is short, because Ctrl-C waits for a launch. If it were shorter,
more time would go into the start of kernels."""
UNWATCHED_LAUNCH_S = 20.0
"""The same duration, in seconds, where nobody waits for a launch, because no progress is reported and a separate thread
handles signals by ending the process."""
MAX_OVERRUN = 1.5
"""Largest ratio of the iterations of a launch to those that fit into its duration. Lanes that have not finished then go
on in the next launch, so that one slow lane cannot make a launch long."""
FIRST_UNITS = 1 << 22
"""Work of a first launch, in iterations of a loop or rays, for which no time has been measured yet. If it is
too large for a slow machine, Ctrl-C waits longer, but only once."""
MAX_STRETCH = 2.0
"""Largest ratio by which launches become longer if it takes long to make the kernel (thousands of shapes), because each
launch makes the kernel again."""
LANES_TOGETHER = 16
"""Number of lanes per vector of the widest processors. The lanes of a vector are counted together, because a vector
works as long as one of its lanes does."""
MIN_AT_WORK = 256
"""Smallest number of lanes that is assumed when a launch's iterations are chosen: fewer lanes take as long as this
many."""
MAX_GROWTH = 8.0
"""Largest ratio of the work of a launch to that of the launch before, so that one launch that was short by chance does
not make the next one very long."""
MAX_ITERATIONS = 1 << 31
"""Largest number of iterations of a launch, so that 32 bits can count them."""
REPORT_S = 0.1
"""Smallest time between two reports of progress, in seconds, so that reports cost nothing and a display still moves."""

State = TypeVar("State")
Report = Callable[[float], None]
"""A function that is called with the fraction done, 0..1, after each launch."""


class Launches:
    """Launches of one kind of work. The time of earlier launches decides on the size of later ones.

    Parameters
    ----------
    is_watched : whether somebody waits for reports between launches. If nobody does, and if a separate thread handles
        signals by ending the process, launches may be long.

    Attributes
    ----------
    units : int, the work that the next launch should do.

    Examples
    --------
    >>> launches = Launches(is_watched=True)
    >>> launches.units = 1000
    >>> list(launches.ranges(2500))
    [(0, 834), (834, 1667), (1667, 2500)]
    """

    def __init__(self, is_watched: bool = False) -> None:
        self.launch_s = LAUNCH_S if is_watched or not interrupts.handled else UNWATCHED_LAUNCH_S
        self.units = int(FIRST_UNITS * self.launch_s / LAUNCH_S)

    def evaluate(self, arrays: object, units: int) -> float:
        """Compute Dr.Jit arrays, wait for them, and learn from the time that these units of work took; returns it."""
        seconds = evaluate(arrays)
        self.learn(units, seconds)
        return seconds

    def learn(self, units: int, seconds: float, prepared_s: float = 0.0) -> None:
        """Fit the size of the next launch to the time that these units took, and to the time to make the kernel."""
        launch_s = self.launch_s * min(max(2 * prepared_s / self.launch_s, 1), MAX_STRETCH)
        fits = units * launch_s / max(seconds, 1e-6)
        if fits > self.units:
            self.units = int(min(fits, MAX_GROWTH * self.units))
        elif seconds > launch_s / 2:  # a shorter launch took mostly overhead
            self.units = max(1, int(fits))

    def run(
        self,
        loop: Callable[[State, mi.UInt32], tuple[State, mi.UInt32]],
        state: State,
        lanes: int,
        pending: Callable[[], Sequence[mi.Float]] = list,
        report: Callable[[State], None] = lambda state: None,
    ) -> tuple[State, int]:
        """Run a loop until all lanes are finished; returns their state, and the iterations that they took together.

        Parameters
        ----------
        loop : function of a state and the largest number of iterations (UInt32), which returns the next state and the
            number of iterations that each lane took (UInt32). A lane that takes fewer than allowed is finished.
        state : the state of the lanes before the first launch.
        lanes : int, number of lanes.
        pending : returns the buffers to which the loop scatters.
        report : called with the state after each launch.
        """
        dr.make_opaque(state)  # like the state of later launches, so that they share a kernel
        total, at_work = 0, lanes
        while at_work:
            most = min(max(1, int(self.units * MAX_OVERRUN) // at_work), MAX_ITERATIONS)
            start = time.perf_counter()
            state, taken = loop(state, dr.opaque(mi.UInt32, most))
            seconds = evaluate([state, taken, pending()])
            iterations = taken.numpy()
            self.learn(int(iterations.sum()), seconds, time.perf_counter() - start - seconds)
            total += int(iterations.sum())
            # The lanes of a vector are at work as long as one of them is, and few lanes take as long as many
            groups = np.logical_or.reduceat(iterations == most, np.arange(0, lanes, LANES_TOGETHER))
            at_work = max(MIN_AT_WORK, LANES_TOGETHER * int(groups.sum())) if groups.any() else 0
            report(state)
        return state, total

    def ranges(
        self, count: int, per_item: float = 1, multiple_of: int = 1, *, at_least: int = 1, at_most: int = 1 << 32
    ) -> Iterator[tuple[int, int]]:
        """Ranges that cut 0..count into launches of even size, each a pair of its begin and its end.

        Parameters
        ----------
        count : int, number of items.
        per_item : units of work of an item.
        multiple_of : int; every range but the last holds a multiple of this number of items.
        at_least, at_most : int, bounds of the number of items of a range.
        """
        begin = 0
        while begin < count:
            left = -(-(count - begin) // multiple_of)
            most = max(1, min(max(at_least, int(self.units / per_item)), at_most) // multiple_of)
            end = min(count, begin + -(-left // -(-left // most)) * multiple_of)  # of even size
            yield begin, end
            begin = end


@contextmanager
def raised_as_it_is() -> Iterator[None]:
    """Raise the original exception if one is raised while Dr.Jit traces a loop, for example by a signal handler.

    Dr.Jit would turn it into a RuntimeError.
    """
    try:
        yield
    except RuntimeError as error:
        root: BaseException = error
        while root.__cause__ is not None:
            root = root.__cause__
        if root is error:
            raise
        raise root from None


def evaluate(arrays: object) -> float:
    """Compute a nested structure of Dr.Jit arrays and wait for it; returns the seconds that its kernels took.

    The time in which kernels were compiled does not count, unless Dr.Jit has a single thread: then it runs the kernels
    before it returns.
    """
    begin = time.perf_counter()
    try:
        dr.eval(arrays)  # with several threads, returns when the last kernel is compiled and under way
        if mi.variant().startswith("cuda") or dr.thread_count() > 1:
            begin = time.perf_counter()
    finally:
        dr.sync_thread()  # also if a signal came: no kernel is left behind
    return time.perf_counter() - begin


def min_lanes() -> int:
    """Number of lanes that keep the whole device busy."""
    return 1 << 18 if mi.variant().startswith("cuda") else max(4096, 512 * dr.thread_count())


def report_part(report: Report, before: float, part: float, fraction: float) -> None:
    """Report progress from within a part of the work.

    `before` is the fraction of the whole that was done before the part, `part` the size of the part as a fraction of
    the whole, and `fraction` the fraction of the part that is done.
    """
    report(before + part * fraction)


class Progress:
    """Passes reports of progress to a function, at most ten times a second; the last report is always passed on.

    `call` is None if nobody wants reports.
    """

    def __init__(self, call: Report | None) -> None:
        self.call = call
        self.last_s = -REPORT_S

    def __call__(self, fraction: float) -> None:
        now = time.monotonic()
        if self.call is not None and (fraction >= 1 or now - self.last_s >= REPORT_S):
            self.last_s = now
            self.call(fraction)
