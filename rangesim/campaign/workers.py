# SPDX-License-Identifier: Apache-2.0
"""The processes that carry out items: an embedded cluster of this machine, or one that a scheduler's address names."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Annotated, Any

from rangesim.campaign.in_worker import THREAD_VARIABLES
from rangesim.errors import EnvironmentProblem
from rangesim.settings.bounds import Bounds, check_fields

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

ALLOWED_DEATHS = 2
"""Deaths of workers that Dask forgives an item: at the third one it is under suspicion. An item that waited on a worker
that died counts, too, so less would put many innocent items under suspicion."""
FIRST_ANSWER_S = 10.0
"""Seconds in which a scheduler has to answer at first: its address may be wrong, and the user should hear it soon."""
WAIT_S = 300.0
"""Seconds that a run waits for a scheduler that it has lost, and for workers if there are none: long enough for a
restart by systemd, Kubernetes or by hand, short enough not to hold an allocation of a cluster for hours."""
COUNT = Bounds("a whole number of processes", 1, 1024, kind=int)
"""Bounds of the count of workers on one machine, above the cores of any."""
BLAS_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables of the threads of BLAS and of OpenMP."""


@dataclass(frozen=True)
class Workers:
    """Worker processes that carry out items, one item at a time each.

    Parameters
    ----------
    count : largest number of processes on this machine. None: as many as there are cores.
    scheduler : address of a Dask scheduler, such as "tcp://10.0.0.1:8786", whose workers do the work. None: the
        processes are started on this machine, and end with the run.
    """

    count: Annotated[int, COUNT] | None = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.count is not None and self.scheduler is not None:
            raise ValueError(
                f"expected a count of workers or a scheduler, got both, {self.count} and {self.scheduler!r}: the "
                "scheduler has its own workers."
            )

    @contextmanager
    def connected(self, items: int, answer_s: float = FIRST_ANSWER_S) -> Iterator[Client]:
        """A client of the workers' scheduler while the block runs; there is at least one worker.

        Parameters
        ----------
        items : count of items that are to be done. No more processes than that are started on this machine.
        answer_s : seconds in which the scheduler has to answer.

        Raises
        ------
        EnvironmentProblem
            Dask is not installed, the scheduler does not answer, or there is no worker in `WAIT_S` seconds.
        """
        try:
            from distributed import Client
        except ImportError:
            raise EnvironmentProblem(
                "campaigns need Dask, and it is not installed: pip install 'rangesim[campaign]'."
            ) from None
        with _quiet():
            if self.scheduler is None:
                count = min(self.count or cores(), items)
                with _local_cluster(count) as cluster, Client(cluster, set_as_default=False) as client:
                    yield client
                return
            with _client_of(self.scheduler, answer_s) as client:
                try:
                    client.wait_for_workers(1, timeout=WAIT_S)
                except TimeoutError:
                    raise EnvironmentProblem(no_workers(self.scheduler)) from None
                yield client


def no_workers(scheduler: str | None) -> str:
    """Sentence about a scheduler that has had no worker for `WAIT_S` seconds."""
    start = f"no worker has come to {scheduler}" if scheduler else "no worker process could be started here"
    advice = f": start some, dask worker {scheduler} --nthreads 1 --nworkers N" if scheduler else ""
    return f"{start} for {WAIT_S:g} s{advice}."


def cores() -> int:
    """Count of cores that this process may use."""
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask from logging deaths of workers on stderr while the block runs; the outcome tells them."""
    handlers = [(handler, handler.level) for handler in logging.getLogger("distributed").handlers]
    for handler, _ in handlers:  # all of Dask's loggers have these
        handler.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for handler, level in handlers:
            handler.setLevel(level)


@contextmanager
def _client_of(scheduler: str, answer_s: float) -> Iterator[Client]:
    """A client of the scheduler at an address, which has `answer_s` seconds to answer."""
    from distributed import Client

    until = time.monotonic() + answer_s
    client = None
    while client is None:
        try:
            client = Client(scheduler, set_as_default=False, timeout=min(5.0, answer_s))
        except OSError as problem:
            if time.monotonic() > until:
                raise EnvironmentProblem(
                    f"no scheduler answers at {scheduler} within {answer_s:g} s: start one there, dask scheduler, or "
                    "correct the address."
                ) from problem
            time.sleep(0.5)
        except ValueError as problem:
            raise ValueError(f"expected the address of a scheduler such as tcp://10.0.0.1:8786: {problem}") from problem
    with client:
        yield client


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Keep Ctrl-C from the threads and processes that the block starts, and from all that those start: the driver alone
    ends on it, and its workers with it."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # the first call would let interrupts through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _started(kind: Callable[..., LocalCluster], **options: Any) -> LocalCluster:
    """A cluster that has started; EnvironmentProblem if its processes do not start."""
    try:
        with _without_interrupts():
            return kind(**options)
    except RuntimeError as problem:
        cause: BaseException = problem
        while cause.__cause__ is not None:
            cause = cause.__cause__
        raise EnvironmentProblem(
            f"worker processes could not be started ({cause}); a script has to do its work below if __name__ == "
            "'__main__', because every worker imports it."
        ) from problem


@contextmanager
def _local_cluster(count: int) -> Iterator[LocalCluster]:
    """A scheduler in this process and `count` workers, each a process of one Dask thread with a nanny."""
    import dask
    from distributed import LocalCluster, Nanny
    from distributed.system import MEMORY_LIMIT

    # One thread for BLAS and OpenMP, because the order in which they sum depends on the number of threads.
    threads = {**dict.fromkeys(BLAS_VARIABLES, "1"), **dict.fromkeys(THREAD_VARIABLES, str(max(1, cores() // count)))}

    class WorkerNanny(Nanny):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            self.pre_spawn_env |= threads  # the libraries read them when they are loaded
            # Dask lets malloc hand free memory back at once, and each larger array with it: a scene takes 1.2 times as
            # long, and after 1000 scenes a worker is 3 % smaller.
            self.pre_spawn_env.pop("MALLOC_TRIM_THRESHOLD_", None)

    settings = {
        "distributed.scheduler.allowed-failures": ALLOWED_DEATHS,
        "distributed.scheduler.worker-saturation": 1.0,  # what waits on a worker that dies is suspected, too
        # On a busy machine a new process takes longer than the usual 15 s, after which its nanny would be given up.
        "distributed.deploy.lost-worker-timeout": f"{WAIT_S} s",
        "distributed.scheduler.worker-ttl": None,  # a jump of the clock would end all workers
        # Dask's profiler keeps the call stacks of an hour, so a worker would grow by 0.7 MB with each scene.
        "distributed.worker.profile.enabled": False,
        # A worker at one of these limits would wait for memory that nothing frees. The last limit is kept: the nanny
        # ends a worker that takes nearly all of the machine's memory.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
    }
    before = dict(os.environ)
    # Semaphores of a driver that is ended are removed by a process of their own, without a warning.
    warned = [os.environ.get("PYTHONWARNINGS"), "ignore:resource_tracker:UserWarning"]
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, warned))
    try:
        with dask.config.set(settings):
            cluster = _started(
                LocalCluster,
                n_workers=count,
                threads_per_worker=1,
                host="127.0.0.1",
                protocol="tcp",
                dashboard_address="127.0.0.1:0",  # any free port: the scheduler has a web server, with no page here
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
                memory_limit=MEMORY_LIMIT,
                worker_class=WorkerNanny,
            )
            with cluster:
                yield cluster
    finally:
        for name in set(os.environ) - set(before):  # nannies set variables in this process, too
            del os.environ[name]
        os.environ.update(before)
