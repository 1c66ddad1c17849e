# SPDX-License-Identifier: Apache-2.0
"""The part of a campaign that runs in worker processes: one item at a time."""

from __future__ import annotations

import faulthandler
import os
import pickle
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

from pcgraph.plumbing.python_files import place_of_failure
from rangesim.environment.versions import source_digest, versions
from rangesim.errors import sentence

if TYPE_CHECKING:
    from collections.abc import Iterator

    from distributed import Worker

FIRST_ITEMS = 10
"""Items after which the memory of a worker should no longer grow: by then modules, kernels and scenes are loaded."""
MAX_GROWTH = 2.0
"""Memory of a worker over its memory after the first items, at which it is replaced by a new process. Scenes of
different sizes stay below it; a leak passes it at some time."""
TELLING_S = 2.0
"""Seconds that a message takes at most to the driver, before the process of an item that hangs ends itself."""
GRACE_S = 60.0
"""Seconds after the time limit at which a process ends that does not even run the thread that watches the limit."""
THREAD_VARIABLES = ("NUMBA_NUM_THREADS", "RANGESIM_THREADS")
"""Environment variables of the threads of pcgraph's kernels and of Dr.Jit. No result depends on their number."""


class Job(NamedTuple):
    """One item for a worker.

    topic : of events that this run listens to. number : of the job in the run. function, argument : pickles. made_with
    : versions that the driver has. limit_s : seconds that the item may take. sharing : workers on one machine.
    """

    topic: str
    number: int
    function: bytes
    argument: bytes
    made_with: dict[str, str]
    limit_s: float
    sharing: int


class Reply(NamedTuple):
    """Answer of a worker process for one item.

    content : the result; None if there is none. error : one line about the failure, else empty. traceback : of the
    exception. unfit : why this worker takes no items of the run, else empty. warned : category and text of each
    warning. seconds : that the item took. worker : its address. rss : bytes of memory of the process. has_grown :
    whether that is much more than after its first items.
    """

    content: bytes | None
    error: str
    traceback: str
    unfit: str
    warned: tuple[tuple[str, str], ...]
    seconds: float
    worker: str
    rss: int
    has_grown: bool


@cache
def all_versions() -> dict[str, str]:
    """Versions of everything that the bytes of an item, or of a pickle, may depend on."""
    return {**versions(), "sources of rangesim": source_digest()[:16]}


_function: tuple[bytes, Callable[[Any], Any]] | None = None
"""The function that this process carries out, with its pickle: one that came by value keeps its globals, and so what it
has cached."""
_first_rss: list[int] = []
"""Bytes of memory after each of the first items."""


def carry_out(job: Job) -> Reply:
    """Call the function of a job with its argument; return the result or the error."""
    from distributed import get_worker

    global _function
    worker = get_worker()
    start = time.monotonic()
    content, error, trace = None, "", ""
    if unfit := _unfit(worker, job):
        return Reply(None, "", "", unfit, (), 0.0, worker.address, 0, False)
    for name in THREAD_VARIABLES:  # before the function is unpickled, which imports what it needs
        os.environ.setdefault(name, str(max(1, (os.cpu_count() or 1) // job.sharing)))
    with _within_time_limit(worker, job), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if _function is None or _function[0] != job.function:
                _function = job.function, pickle.loads(job.function)
            result = _function[1](pickle.loads(job.argument))
            if isinstance(result, bytes):
                content = result
            else:
                error = f"expected bytes of the function, got {type(result).__name__}"
        except BaseException as problem:  # noqa: BLE001  # an item that calls sys.exit has failed, too
            error = sentence(" ".join((place_of_failure(problem), f"{type(problem).__name__}: {problem}")).strip())
            trace = "".join(traceback.format_exception(problem))
    warned = tuple(dict.fromkeys((one.category.__name__, sentence(str(one.message))) for one in caught))
    seconds = time.monotonic() - start
    return Reply(content, error, trace, "", warned, seconds, worker.address, *_memory())


def _unfit(worker: Worker, job: Job) -> str:
    """Why this worker cannot take the job; empty if it can."""
    own = all_versions()
    others = {name: other for name, other in own.items() if job.made_with.get(name) != other}
    if others:
        told = ", ".join(f"{name} {other} (here {job.made_with.get(name)})" for name, other in others.items())
        return f"it has {told}; install the same versions there"
    if worker.state.nthreads != 1:
        return (
            f"it has {worker.state.nthreads} threads, and a worker takes one item at a time: start it with --nthreads 1"
        )
    return ""


def _memory() -> tuple[int, bool]:
    """Bytes of memory of this process, and whether that is much more than after its first items."""
    import psutil

    rss = psutil.Process().memory_info().rss
    if len(_first_rss) < FIRST_ITEMS:
        _first_rss.append(rss)
    return rss, rss > MAX_GROWTH * max(_first_rss)


@contextmanager
def _within_time_limit(worker: Worker, job: Job) -> Iterator[None]:
    """End this process if the block takes longer than the job's limit, after telling the driver where it hangs."""
    ended, thread = threading.Event(), threading.get_ident()

    def watch() -> None:
        if ended.wait(job.limit_s):
            return
        frame = sys._current_frames().get(thread)
        where = "".join(traceback.format_stack(frame)) if frame else ""
        news = {"number": job.number, "limit_s": job.limit_s, "where": where}
        worker.loop.add_callback(worker.log_event, job.topic, news)
        if not ended.wait(TELLING_S):
            os._exit(1)

    faulthandler.dump_traceback_later(job.limit_s + GRACE_S, exit=True)  # for code that keeps Python's lock
    threading.Thread(target=watch, name="time limit", daemon=True).start()
    try:
        yield
    finally:
        ended.set()
        faulthandler.cancel_dump_traceback_later()


async def replace_process(dask_worker: Worker) -> None:
    """Let the nanny of a worker start a new process in its place; its next item goes to another worker, or waits."""
    if dask_worker.nanny is not None:
        await dask_worker.close_gracefully(restart=True, reason="rangesim-memory")
