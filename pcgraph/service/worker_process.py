# SPDX-License-Identifier: Apache-2.0
"""A worker process of the service: it reads tasks from standard input, and answers each on standard output, as JSON.

    python -m pcgraph.service.worker_process MAX_MEMORY_BYTES

Lines to the worker: {"task": name, ...arguments}. Lines from it: {"ready": true} after the kernels are compiled; then
for each task any number of {"stage": words}, and {"result": {...}} or {"problem": {"status": ..., "detail": ...}}.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import sys
import threading
from collections.abc import Callable
from typing import Any, TextIO

from pcgraph.errors import PcgraphError, one_line, without_long_words
from pcgraph.service.problems import Problem

_log = logging.getLogger("pcgraph.service")


def main() -> None:
    """Do tasks until the standard input is closed, as it is when the server ends."""
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s")
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print must not come between the answers

    def say(message: dict[str, Any]) -> None:
        answers.write(json.dumps(message, allow_nan=False) + "\n")
        answers.flush()

    from pcgraph.all_kernels import compile_kernels
    from pcgraph.service.tasks import TASKS, warm_up

    tasks: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(sys.stdin, tasks), daemon=True).start()
    compile_kernels()
    warm_up()
    _limit_memory(int(sys.argv[1]))
    say({"ready": True})
    while True:
        arguments = json.loads(tasks.get())
        say(_answer(TASKS[arguments.pop("task")], arguments, lambda words: say({"stage": words})))


def _read(stream: TextIO, tasks: queue.SimpleQueue[str]) -> None:
    """Put the lines of a stream into a queue; at the end of the stream, end the process at once."""
    for line in stream:
        tasks.put(line)
    os._exit(0)


def _limit_memory(n_bytes: int) -> None:
    """Make allocations of private memory beyond `n_bytes` fail; reserved address space does not count."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return
    resource.setrlimit(resource.RLIMIT_DATA, (n_bytes, n_bytes))


def _answer(do: Callable[..., Any], arguments: dict[str, Any], stage: Callable[[str], None]) -> dict[str, Any]:
    try:
        return {"result": do(stage=stage, **arguments)}
    except Exception as error:  # noqa: BLE001  # whatever it is, it belongs to this task, and the worker goes on
        problem = _problem_of(error)
        own = os.path.join(os.path.dirname(arguments["saved"]), "")  # no path of the server comes into a message
        detail = one_line(without_long_words(problem.detail.replace(own, ""))).rstrip(".")
        return {"problem": {"status": problem.status, "detail": detail}}


def _problem_of(error: Exception) -> Problem:
    """The problem that tells a client about the exception of a task."""
    if _memory_was_short(error):
        return Problem(413, "the cloud needs more memory than this service gives to one: send fewer points")
    if isinstance(error, Problem):
        return error
    if isinstance(error, (PcgraphError, ValueError)):
        return Problem(422, str(error))
    _log.error("a task failed", exc_info=error)
    if isinstance(error, OSError):
        return Problem(500, f"the service cannot keep its files: {error.strerror or 'the disk fails'}")
    return Problem(500, f"the service failed at this cloud ({type(error).__name__}); its log says where")


def _memory_was_short(error: BaseException | None) -> bool:
    """Whether a MemoryError caused an exception; closing a file after one may raise another exception."""
    while error is not None and not isinstance(error, MemoryError):
        error = error.__cause__ or error.__context__
    return error is not None


if __name__ == "__main__":
    main()
