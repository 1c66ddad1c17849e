# SPDX-License-Identifier: Apache-2.0
"""What every test may use: real data where it is, and Dr.Jit's LLVM chosen before Mitsuba is imported."""

from __future__ import annotations

import gc
import os
import signal
from contextlib import suppress
from pathlib import Path

import pytest

from rangesim.environment.llvm import ensure_llvm
from rangesim.errors import EnvironmentProblem

# Threads that wait for work spin, those of BLAS, of OpenMP and of Dr.Jit: a core's time that other workers need. So
# each worker has cores of its own, and Dr.Jit as many threads; those of pcgraph do not spin, and stay as many as there
# are cores, for what several of them do at once is tested, too.
for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(threads, "1")
worker = os.environ.get("PYTEST_XDIST_WORKER", "")
if worker and hasattr(os, "sched_setaffinity"):
    cores = sorted(os.sched_getaffinity(0))
    os.environ.setdefault("NUMBA_NUM_THREADS", str(len(cores)))
    first = int(worker.removeprefix("gw")) % len(cores)
    os.sched_setaffinity(0, cores[first :: int(os.environ["PYTEST_XDIST_WORKER_COUNT"])])

with suppress(EnvironmentProblem):  # tests that render say it again; those of decoders need no LLVM
    ensure_llvm()

# A shell that starts the tests in the background lets them, and all that they start, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Importing and collecting make objects by the hundred thousand that stay, and no garbage to look for among them.
gc.disable()


LONGEST = ("test_readme.py", "test_fuzz.py", "test_interruption.py", "test_trust.py", "test_own_sensors.py")
"""The files that take longest, which start processes or run all examples."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The files that take longest first: else one worker ends minutes after the others."""
    rank = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(LONGEST)))


def pytest_collection_finish() -> None:
    """From here on garbage is collected, but what is there by now is not looked through again and again."""
    gc.freeze()
    gc.enable()


REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real captures and clouds beside the repository; skips the test where there is none."""
    if not REAL_DATA.is_dir():
        pytest.skip(f"no real data at {REAL_DATA}")
    return REAL_DATA
