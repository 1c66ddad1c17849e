# SPDX-License-Identifier: Apache-2.0
"""Pool of the service's worker processes, and the queue of tasks for them.

If a worker crashes, takes too long or is killed, only its own task ends, and a new worker replaces it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from pcgraph.service.problems import Problem, busy
from pcgraph.service.settings import ServiceSettings

_log = logging.getLogger("pcgraph.service")

MAX_LINE = 1 << 20
"""Largest line from a worker, bytes: a summary with all its warnings has some thousands. Chosen by eye; not varied."""
MAX_START_SECONDS = 600.0
"""Seconds within which a worker must be ready: to compile the kernels takes half a minute, and three minutes on a busy
machine. Chosen by eye; not varied."""
PAUSE_SECONDS = 1.0
"""Seconds before another try to start a worker that could not start, so that a broken installation does not fill the
log. Chosen by eye; not varied."""
RETRY_SECONDS = 2
"""Seconds after which a client may ask a busy service again. Chosen by eye; not varied."""


@dataclass(eq=False)
class Order:
    """A task that waits for a worker, or that a worker is doing.

    Attributes
    ----------
    task : dict
        Name and arguments of the task, as plain values.
    on_stage : callable
        Function that is called with each stage of the task, in words.
    answer : future of dict
        Result of the task, or a `Problem`. It is cancelled with the order.
    worker : Worker, or None
        The worker that does the task now.
    """

    task: dict[str, Any]
    on_stage: Callable[[str], None]
    answer: asyncio.Future[dict[str, Any]] = field(default_factory=lambda: asyncio.get_running_loop().create_future())
    worker: Worker | None = None

    def cancel(self) -> None:
        """Cancel the task; a worker that does it is killed."""
        self.answer.cancel()
        if self.worker is not None:
            self.worker.kill()


class Worker:
    """A worker process, started and ready."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self.ended = asyncio.ensure_future(process.wait())
        """Its exit status, as soon as it has ended."""
        self._killed = False

    @classmethod
    async def start(cls, settings: ServiceSettings) -> Worker:
        """A new worker with compiled kernels; Problem if it does not become ready."""
        threads = str(settings.threads_per_worker)
        environment = {name: value for name, value in os.environ.items() if name != "PCGRAPH_TOKEN"}
        environment |= dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), threads)
        limit = str(int(settings.max_memory_gb * 1e9))
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-P", "-m", "pcgraph.service.worker_process", limit),
            stdin=PIPE,
            stdout=PIPE,
            env=environment,
            limit=MAX_LINE,
            start_new_session=True,  # Ctrl-C is for the server, which ends its workers itself
        )
        worker = cls(process)
        try:
            async with asyncio.timeout(MAX_START_SECONDS):
                ready = await worker._line()
        except BaseException:
            worker.kill()
            raise
        if not ready.get("ready"):
            raise Problem(500, f"a worker process ended ({in_words(await worker.ended)}) before it was ready")
        return worker

    async def do(self, order: Order, max_seconds: float) -> dict[str, Any]:
        """Result of a task, or the Problem that the worker reports; if it reports neither, it is killed."""
        assert self._process.stdin is not None
        order.worker = self
        try:
            async with asyncio.timeout(max_seconds):
                with suppress(ConnectionError):  # it has ended, which the next line tells
                    self._process.stdin.write(json.dumps(order.task).encode() + b"\n")
                    await self._process.stdin.drain()
                while "stage" in (message := await self._line()):
                    order.on_stage(message["stage"])
        except TimeoutError:
            self.kill()
            raise Problem(
                504, f"took longer than {max_seconds:g} s and was ended: send fewer points, or a larger voxel_size"
            ) from None
        finally:
            order.worker = None
        if "problem" in message:
            raise Problem(**message["problem"])
        if "result" not in message:
            self.kill()
            raise Problem(
                500,
                f"the worker process ended ({in_words(await self.ended)}): try again; if it ends again, the cloud is "
                "the cause",
            )
        result: dict[str, Any] = message["result"]
        return result

    async def _line(self) -> dict[str, Any]:
        """The next message of the worker; empty if the worker has ended, or if the message is not valid."""
        assert self._process.stdout is not None
        try:
            line = await self._process.stdout.readline()
            message = json.loads(line) if line else {}
        except ValueError:
            message = None
        if not isinstance(message, dict):
            self.kill()
            return {}
        return message

    @property
    def usable(self) -> bool:
        """True while the worker can take an order."""
        return not (self._killed or self.ended.done())

    def kill(self) -> None:
        """End the process at once."""
        self._killed = True
        if self._process.returncode is None:
            with suppress(ProcessLookupError):  # Process.kill would take the exit status, for which asyncio waits
                os.kill(self._process.pid, signal.SIGKILL)


def in_words(status: int) -> str:
    """Exit status of a process: "signal SIGKILL", "exit status 1"."""
    return f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"


class WorkerPool:
    """A number of worker processes, which are replaced when they end, and a queue of orders."""

    def __init__(self, n_workers: int, settings: ServiceSettings) -> None:
        self._n_workers, self._settings = n_workers, settings
        self._waiting: deque[Order] = deque()
        self._arrived = asyncio.Event()
        self._keepers: list[asyncio.Task[None]] = []
        self._first_ready: asyncio.Future[None] | None = None
        self.n_ready = 0

    async def start(self) -> None:
        """Start the workers, and wait until the first one has compiled the kernels.

        Raises
        ------
        Problem
            The first worker could not start.
        """
        self._first_ready = asyncio.get_running_loop().create_future()
        self._keepers = [asyncio.create_task(self._keep(self._first_ready))]
        await self._first_ready
        self._keepers += [asyncio.create_task(self._keep()) for _ in range(self._n_workers - 1)]

    async def stop(self) -> None:
        """End all workers and cancel the orders that wait."""
        for order in self._waiting:
            order.cancel()
        self._waiting.clear()
        for keeper in self._keepers:
            keeper.cancel()
        await asyncio.gather(*self._keepers, return_exceptions=True)

    @property
    def n_waiting(self) -> int:
        return len(self._waiting)

    def position(self, order: Order) -> int | None:
        """Number of orders before this one in the queue; None if it does not wait."""
        return self._waiting.index(order) if order in self._waiting else None

    def put(self, task: dict[str, Any], on_stage: Callable[[str], None] = lambda _: None) -> Order:
        """Put a task into the queue, and return its order.

        Raises
        ------
        Problem
            Too many orders wait already.
        """
        if len(self._waiting) >= self._settings.max_queued:
            raise busy(f"{len(self._waiting)} requests wait for a worker already: try again later", RETRY_SECONDS)
        order = Order(task, on_stage)
        order.answer.add_done_callback(lambda answer: self._forget(order) if answer.cancelled() else answer.exception())
        self._waiting.append(order)
        self._arrived.set()
        return order

    def _forget(self, order: Order) -> None:
        with suppress(ValueError):  # it is in a worker, or done
            self._waiting.remove(order)

    async def _keep(self, first_ready: asyncio.Future[None] | None = None) -> None:
        """Keep one worker running, and give it one order after the other."""
        while True:
            try:
                worker = await Worker.start(self._settings)
            except (OSError, TimeoutError, Problem) as error:
                _log.error("cannot start a worker process: %s", error)
                if first_ready is not None and not first_ready.done():
                    first_ready.set_exception(error)
                    return
                await asyncio.sleep(PAUSE_SECONDS)
                continue
            if first_ready is not None and not first_ready.done():
                first_ready.set_result(None)
            self.n_ready += 1
            try:
                await self._serve(worker)
            finally:
                self.n_ready -= 1
                worker.kill()
                status = await worker.ended
            _log.warning("a worker process ended (%s); a new one takes its place", in_words(status))

    async def _serve(self, worker: Worker) -> None:
        """Give orders to a worker until it ends."""
        while order := await self._next(worker):
            try:
                result = await worker.do(order, self._settings.max_seconds)
            except Problem as problem:
                if not order.answer.done():
                    order.answer.set_exception(problem)
            except (KeyError, TypeError):  # no message of ours: whatever it is now, it is a worker no more
                worker.kill()
                if not order.answer.done():
                    order.answer.set_exception(Problem(500, "the worker process failed"))
            else:
                if not order.answer.done():
                    order.answer.set_result(result)

    async def _next(self, worker: Worker) -> Order | None:
        """The order that has waited longest; None if the worker has ended."""
        while worker.usable:
            if self._waiting:
                return self._waiting.popleft()
            self._arrived.clear()
            arrival = asyncio.create_task(self._arrived.wait())
            try:
                await asyncio.wait({arrival, worker.ended}, return_when=asyncio.FIRST_COMPLETED)
            finally:
                arrival.cancel()
        return None
