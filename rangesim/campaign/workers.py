# SPDX-License-Identifier: Apache-2.0
"""The processes that carry out items: an embedded cluster of this machine, or one that a scheduler's address names."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from rangesim.errors import EnvironmentProblem
from rangesim.settings.bounds import check_fields, whole

if TYPE_CHECKING:
    from distributed import Client

ALLOWED_DEATHS = 2
"""Deaths of workers that Dask forgives an item: at the third one it is under suspicion. An item that waited on a
worker that died counts, too, so less would put many innocent items under suspicion."""
PACKAGES_OF_EXTRA = "pip install 'rangesim[campaign]'"


@dataclass(frozen=True)
class Workers:
    """Worker processes that carry out items, one item at a time each.

    Parameters
    ----------
    count : processes on this machine. None: as many as there are cores.
    scheduler : address of a Dask scheduler, such as "tcp://10.0.0.1:8786", whose workers do the work. None: the
        processes are started on this machine, and end with the run.
    """

    count: Annotated[int | None, whole(1)] = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.count is not None and self.scheduler is not None:
            raise ValueError(
                f"expected a count of workers or a scheduler, got both, {self.count} and {self.scheduler!r}: the "
                "scheduler has its own workers."
            )

    @contextmanager
    def connected(self) -> Iterator[Client]:
        """A client of the workers' scheduler while the block runs.

        Raises
        ------
        EnvironmentProblem
            Dask is not installed, or no worker can be reached or started.
        """
        try:
            from distributed import Client
        except ImportError:
            raise EnvironmentProblem(
                f"campaigns need Dask, which is not installed here: {PACKAGES_OF_EXTRA}."
            ) from None
        if self.scheduler is not None:
            with Client(self.scheduler, set_as_default=False, timeout=10) as client:
                yield client
            return
        with _local_cluster(self.count or cores()) as cluster, Client(cluster, set_as_default=False) as client:
            yield client


def cores() -> int:
    """Count of cores that this process may use."""
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)


@contextmanager
def _local_cluster(count: int) -> Iterator[object]:
    """A scheduler in this process and `count` workers, each a process of one Dask thread with a nanny."""
    import dask
    from distributed import LocalCluster, Nanny
    from distributed.system import MEMORY_LIMIT

    threads = str(max(1, cores() // count))
    # One thread for BLAS and OpenMP, because the order in which they sum depends on the number of threads.
    before_start = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

    class WorkerNanny(Nanny):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            self.pre_spawn_env |= before_start

    settings = {
        "distributed.scheduler.allowed-failures": ALLOWED_DEATHS,
        "distributed.scheduler.worker-saturation": 1.0,  # what waits on a worker that dies is suspected, too
        # A worker at a limit would wait for memory that nothing frees, so only the last one is kept: the nanny ends a
        # worker that takes nearly all of the machine's memory.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
    }
    before = dict(os.environ)
    try:
        with (
            dask.config.set(settings),
            LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                host="127.0.0.1",
                protocol="tcp",
                dashboard_address=None,
                silence_logs=logging.CRITICAL,
                memory_limit=MEMORY_LIMIT,
                worker_class=WorkerNanny,
                env={**before_start, "NUMBA_NUM_THREADS": threads, "RANGESIM_THREADS": threads},
            ) as cluster,
        ):
            yield cluster
    finally:
        for name in before_start:  # nannies set them in this process, too
            os.environ.pop(name, None)
            if name in before:
                os.environ[name] = before[name]
