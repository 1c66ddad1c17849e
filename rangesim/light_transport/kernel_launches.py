# SPDX-License-Identifier: Apache-2.0
"""Kernel launches of bounded time.

A running kernel cannot be stopped, and Python handles a signal (Ctrl-C) only after it: so work is cut into launches of
less than a second, and each is waited for. The time they take says where the work is cut and nothing else; all that
is cut here has the same bytes however it is cut.

Compiling a kernel is one more stretch without signals: a tenth of a second to a few seconds, once per machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from pcgraph.plumbing import interrupts

LAUNCH_S = 1.0
"""What a launch should take, seconds."""
UNWATCHED_LAUNCH_S = 20.0
"""The same where nobody waits: no report of progress, and signals that end the process from a thread of their own."""
LONGEST = 1.5
"""Times the duration of a launch, after which it ends even if lanes have not finished."""
FIRST_UNITS = 1 << 21
"""Work of a first launch: as many iterations of a loop, rays or photons."""
LONGER_WHERE_PREPARED_LONG = 2.0
"""Times as long, at most, where it takes long to make the kernel (thousands of shapes)."""
LANES_TOGETHER = 16
MIN_AT_WORK = 256
STEEPEST = 8.0
"""Growth of the work from one launch to the next, at most."""
MAX_ITERATIONS = 1 << 31
"""Of a launch, so that they can be counted."""
REPORT_S = 0.1
"""Between two reports of progress, seconds, at least."""

State = TypeVar("State")
Report = Callable[[float], None]
"""Called with the fraction done, 0..1, after each launch."""


class Launches:
    """Launches of one kind of work, each as large as the time of the earlier ones suggests.

    is_watched : whether somebody waits for reports between launches. If not, and if signals end the process from a
        thread of their own, launches may be long.
    units : int, the work that the next launch should do.
    """

    def __init__(self, is_watched: bool = False) -> None:
        self.launch_s = LAUNCH_S if is_watched or not interrupts.handled else UNWATCHED_LAUNCH_S
        self.units = int(FIRST_UNITS * self.launch_s / LAUNCH_S)

    def evaluate(self, arrays: Any, units: int) -> None:
        """Compute Dr.Jit arrays that are so many units of work, and wait for them."""
        self.learn(units, evaluate(arrays))

    def learn(self, units: int, seconds: float, prepared_s: float = 0.0) -> None:
        """Fit the next launch to the time that this one took, and took to be prepared."""
        launch_s = self.launch_s * min(max(2 * prepared_s / self.launch_s, 1), LONGER_WHERE_PREPARED_LONG)
        fits = units * launch_s / max(seconds, 1e-6)
        if fits > self.units:
            self.units = int(min(fits, STEEPEST * self.units))
        elif seconds > launch_s / 2:  # a shorter launch says how long its overhead takes
            self.units = max(1, int(fits))

    def run(
        self,
        loop: Callable[[State, Any], tuple[State, Any]],
        state: State,
        lanes: int,
        pending: Callable[[], Any] = list,
        report: Callable[[State], None] = lambda state: None,
    ) -> tuple[State, int]:
        """The state of the lanes when all of them are finished, and the iterations of the loop that they took together.

        Parameters
        ----------
        loop : makes of a state and the most iterations allowed (UInt32) the next state and (lanes,) the iterations that
            were taken: fewer than allowed by a lane that is finished.
        pending : the buffers that it scatters to.
        report : called with the state after each launch.
        """
        dr.make_opaque(state)  # like the state of later launches, so that they share a kernel
        total, at_work = 0, lanes
        while at_work:
            most = min(max(1, int(self.units * LONGEST) // at_work), MAX_ITERATIONS)
            start = time.perf_counter()
            state, taken = loop(state, dr.opaque(mi.UInt32, most))
            seconds = evaluate([state, taken, pending()])
            iterations = taken.numpy()
            self.learn(int(iterations.sum()), seconds, time.perf_counter() - start - seconds)
            total += int(iterations.sum())
            # Neighbours are at work together, and a few lanes take as long as many
            groups = np.logical_or.reduceat(iterations == most, np.arange(0, lanes, LANES_TOGETHER))
            at_work = max(MIN_AT_WORK, LANES_TOGETHER * int(groups.sum())) if groups.any() else 0
            report(state)
        return state, total

    def ranges(
        self, count: int, per_item: float = 1, multiple_of: int = 1, *, at_least: int = 1, at_most: int = 1 << 32
    ) -> Iterator[tuple[int, int]]:
        """Ranges that cut 0..count, one for each launch, where an item is so many units of work."""
        begin = 0
        while begin < count:
            left = -(-(count - begin) // multiple_of)
            most = max(1, min(max(at_least, int(self.units / per_item)), at_most) // multiple_of)
            end = min(count, begin + -(-left // -(-left // most)) * multiple_of)  # of even size
            yield begin, end
            begin = end


@contextmanager
def raised_as_it_is() -> Iterator[None]:
    """Let through what was raised while Dr.Jit traced a loop, by the handler of a signal for example: Dr.Jit makes a
    RuntimeError of it."""
    try:
        yield
    except RuntimeError as error:
        root: BaseException = error
        while root.__cause__ is not None:
            root = root.__cause__
        if root is error:
            raise
        raise root from None


def evaluate(arrays: Any) -> float:
    """Compute Dr.Jit arrays and wait for them; the seconds that the kernels took, once they were compiled. A single
    thread runs them before it comes back, so that there the time in which they were compiled is among them."""
    begin = time.perf_counter()
    try:
        dr.eval(arrays)  # where there are more, returns when the last kernel is compiled and under way
        if mi.variant().startswith("cuda") or dr.thread_count() > 1:
            begin = time.perf_counter()
    finally:
        dr.sync_thread()  # also if a signal came: no kernel is left behind
    return time.perf_counter() - begin


def min_lanes() -> int:
    """Lanes that keep all of the device busy."""
    return 1 << 18 if mi.variant().startswith("cuda") else max(4096, 512 * dr.thread_count())


def report_part(report: Report, before: float, part: float, fraction: float) -> None:
    """Report the fraction done of a part of the work, which begins where `before` of it is done."""
    report(before + part * fraction)


class Progress:
    """Reports to a caller who may not want any, at most ten times a second; the last report is always made."""

    def __init__(self, call: Report | None) -> None:
        self.call = call
        self.last_s = -REPORT_S

    def __call__(self, fraction: float) -> None:
        now = time.monotonic()
        if self.call is not None and (fraction >= 1 or now - self.last_s >= REPORT_S):
            self.last_s = now
            self.call(fraction)
