# SPDX-License-Identifier: Apache-2.0
"""Campaigns: speed-up of two workers, kills, memory of a worker, and what Dask adds to an item.

    python benchmarks/campaign.py [--only speedup] [--only kills] [--only memory] [--only overhead] [--quick]

An item is a sample of the data set of `campaign_plan.py`: ten parts on a table, three sensors, 160 x 120 pixels.

- speedup: one worker of one thread against two such workers, items per second once the workers are warm; the median of
  three rounds, which alternate. Two processes of Python's own pool against one show what the machine allows.
- kills: a run that is killed at least 20 times over 200 items, by SIGKILL, against an undisturbed one, byte by byte.
  Half of it runs on an embedded cluster, where workers and driver are killed; half on a second scheduler process,
  reached by its address, which is killed, too. Some drivers are killed at a rename, before or after it.
- memory: resident memory of a worker over 1000 items: the median of the last 50 over that of the 50 after the first 10.
- overhead: time of an item that does nothing, one worker.

The last line is JSON. With --quick, fewer items and smaller images, to see that it runs.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import multiprocessing
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import psutil
from campaign_plan import TEN_PARTS

from rangesim.campaign import ItemStore, Outcome, Workers, run_items, workers
from rangesim.campaign.in_worker import THREAD_VARIABLES
from rangesim.campaign.workers import BLAS_VARIABLES
from rangesim.dataset import DatasetSpec, spec_from_dict
from rangesim.dataset.sample import sample_bytes

PORT = 18787
"""Port of the second scheduler, other than Dask's usual one."""
KINDS = ("worker", "driver", "worker", "driver at a rename")
"""What is killed in turn on the embedded cluster."""
KINDS_BY_ADDRESS = ("worker", "scheduler", "driver", "worker")
"""What is killed in turn if the scheduler is a process of its own."""


class Size(NamedTuple):
    """How much work a benchmark does."""

    width: int
    scenes: int
    kills: int
    timed: int
    rounds: int
    remembered: int
    empty: int


FULL = Size(width=160, scenes=200, kills=20, timed=60, rounds=3, remembered=1000, empty=2000)
QUICK = Size(width=48, scenes=24, kills=4, timed=16, rounds=1, remembered=30, empty=200)


def specification(size: Size) -> DatasetSpec:
    """The data set whose samples are the items: ten parts on a table, three sensors."""
    return spec_from_dict({"scenes": size.scenes, **TEN_PARTS, "width": size.width, "height": size.width * 3 // 4})


def samples(size: Size) -> Callable[[int], bytes]:
    """The function of an item: the bytes of the sample of a number."""
    return partial(sample_bytes, specification(size))


def nothing(_: int) -> bytes:
    return b""


def scenes(count: int) -> dict[str, int]:
    return {f"scene-{number:04}": number for number in range(count)}


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as path:
        yield Path(path)


def rate(count: int, function: Callable[[Any], bytes], items: dict[str, Any], warm: int) -> float:
    """Items per second of `count` workers of one thread, after the first `warm` items."""
    workers.cores = lambda: count
    ends: list[float] = []
    with folder() as out:
        outcome = run_items(
            function, items, ItemStore(out), Workers(count=count), on_done=lambda _: ends.append(time.monotonic())
        )
    assert outcome.computed == len(items), outcome
    return (len(ends) - warm) / (ends[-1] - ends[warm - 1])


def rate_of_pool(count: int, function: Callable[[Any], bytes], items: dict[str, Any], warm: int) -> float:
    """Items per second of `count` processes of Python's own pool, which only hands numbers out: the machine's limit."""
    threads = dict.fromkeys((*BLAS_VARIABLES, *THREAD_VARIABLES), "1")
    before = {name: os.environ.get(name) for name in threads}
    os.environ.update(threads)
    try:
        with multiprocessing.get_context("spawn").Pool(count) as pool:
            ends = [time.monotonic() for _ in pool.imap_unordered(function, items.values())]
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    return (len(ends) - warm) / (ends[-1] - ends[warm - 1])


def speedup(size: Size) -> dict[str, Any]:
    """How much faster two workers are than one, the same of two bare processes, and the scenes per hour of one."""
    rates: dict[str, dict[int, list[float]]] = {"dask": {1: [], 2: []}, "pool": {1: [], 2: []}}
    load = os.getloadavg()[0]
    for _, count, way in itertools.product(range(size.rounds), (1, 2), rates):
        of = rate if way == "dask" else rate_of_pool
        rates[way][count].append(of(count, samples(size), scenes(size.timed), warm=4))
        print(f"{count} workers, {way}: {rates[way][count][-1]:.3f} scenes per second", file=sys.stderr)
    median = {way: {count: statistics.median(found) for count, found in by.items()} for way, by in rates.items()}
    return {
        "speedup_2_workers": round(median["dask"][2] / median["dask"][1], 3),
        "speedup_2_processes": round(median["pool"][2] / median["pool"][1], 3),
        "scenes_per_hour_core": round(3600 * median["dask"][1]),
        "load_before": load,
        "rates": {way: {n: [round(x, 4) for x in found] for n, found in by.items()} for way, by in rates.items()},
    }


def overhead(size: Size) -> dict[str, Any]:
    """Milliseconds of an item that does nothing."""
    found = rate(1, nothing, {f"n{i}": i for i in range(size.empty)}, warm=20)
    return {"overhead_ms_per_task": round(1000 / found, 2)}


def memory(size: Size) -> dict[str, Any]:
    """Growth of a worker's resident memory over many items."""
    workers.cores = lambda: 1
    resident: list[int] = []

    def weigh(_: str) -> None:
        (worker,) = worker_processes(psutil.Process())
        resident.append(worker.memory_info().rss)

    with folder() as out:
        outcome = run_items(samples(size), scenes(size.remembered), ItemStore(out), Workers(count=1), on_done=weigh)
    part = min(50, (size.remembered - 10) // 2)
    first, last = statistics.median(resident[10 : 10 + part]), statistics.median(resident[-part:])
    return {
        "rss_growth": round(last / first - 1, 4),
        "rss_mb": [round(r / 1e6) for r in resident[:: max(1, len(resident) // 20)]],
        "replaced": outcome.replaced,
    }


# ---- Kills ---------------------------------------------------------------------------------------------------------


def worker_processes(above: psutil.Process) -> list[psutil.Process]:
    """Processes of Dask workers below a process."""
    found = []
    for process in above.children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if any("spawn_main" in word for word in process.cmdline()):
                found.append(process)
    return found


class Cluster:
    """A scheduler and two workers in processes of their own, which are started again when they have ended."""

    def __init__(self) -> None:
        self.address = f"tcp://127.0.0.1:{PORT}"
        self.closing = False
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.keeper = threading.Thread(target=self._keep, daemon=True)
        self.keeper.start()

    def _keep(self) -> None:
        dask = [sys.executable, "-m", "dask"]
        lines = {
            "scheduler": [*dask, "scheduler", "--host", "127.0.0.1", "--port", str(PORT), "--no-dashboard"],
            "workers": [*dask, "worker", self.address, "--nworkers", "2", "--nthreads", "1", "--no-dashboard"],
        }
        lines["workers"] += ["--death-timeout", "30"]
        while not self.closing:
            for name, line in lines.items():
                if name not in self.processes or self.processes[name].poll() is not None:
                    self.processes[name] = subprocess.Popen(line, stdout=-3, stderr=-3, start_new_session=True)
            time.sleep(0.2)

    def kill_scheduler(self) -> None:
        self.processes["scheduler"].kill()

    def workers(self) -> list[psutil.Process]:
        with contextlib.suppress(psutil.Error):
            return worker_processes(psutil.Process(self.processes["workers"].pid))
        return []

    def close(self) -> None:
        self.closing = True
        self.keeper.join()
        for process in self.processes.values():
            below = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
            process.kill()
            for one in below:
                with contextlib.suppress(psutil.Error):
                    one.kill()
            process.wait()


def driver(out: Path, size: Size, count: int, scheduler: str, die_at: int) -> subprocess.Popen[bytes]:
    """A driver in a process of its own, which kills itself at a rename if `die_at` is not 0 (after it, if odd)."""
    line = [sys.executable, __file__, "--drive", str(out), str(size.width), str(count), scheduler, str(die_at)]
    return subprocess.Popen(line, start_new_session=True)


def drive(out: str, width: str, count: str, scheduler: str, die_at: str) -> Outcome:
    """What a driver does."""
    renames, real = itertools.count(1), os.replace

    def replace(*args: Any, **kwargs: Any) -> None:
        dies = int(die_at) and next(renames) * 2 >= int(die_at)
        if dies and int(die_at) % 2 == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        real(*args, **kwargs)
        if dies:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = replace
    by = Workers(scheduler=scheduler) if scheduler else Workers(count=2)
    size = FULL._replace(width=int(width))
    return run_items(samples(size), scenes(int(count)), ItemStore(out), by)


def stored(out: Path) -> int:
    return len(list(out.glob("items/*/*.item")))


def disturbed(out: Path, size: Size, until: int, total: int, kills: int, cluster: Cluster | None) -> Counter[str]:
    """Run the items up to `until` of `total`, and kill something `kills` times; what was killed how often."""
    rng, done = random.Random(kills + until), Counter[str]()
    begin = stored(out)
    address = cluster.address if cluster else ""
    process = driver(out, size, until, address, 0)
    at = [begin + (until - begin) * (n + 0.5) / kills for n in range(kills)]
    for kind, target in zip(itertools.cycle(KINDS_BY_ADDRESS if cluster else KINDS), at, strict=False):
        while stored(out) < target and process.poll() is None:
            time.sleep(0.05)
        if process.poll() is not None:  # it has ended before its time
            break
        time.sleep(rng.uniform(0, 0.5))
        if kind == "driver at a rename":
            process.kill()
            process.wait()
            process = driver(out, size, until, address, rng.randrange(1, 6))
            process.wait()
            process = driver(out, size, until, address, 0)
        elif kind == "driver":
            process.kill()
            process.wait()
            process = driver(out, size, until, address, 0)
        elif kind == "scheduler":
            assert cluster is not None
            cluster.kill_scheduler()
        else:
            while not (found := cluster.workers() if cluster else worker_processes(psutil.Process(process.pid))):
                time.sleep(0.1)
            with contextlib.suppress(psutil.Error):
                rng.choice(found).kill()
        done[f"{kind}{' by address' if cluster else ''}"] += 1
        print(f"killed a {kind}, {stored(out)} of {total} items", file=sys.stderr)
    status = process.wait()
    assert status == 0, status
    return done


def kills(size: Size) -> dict[str, Any]:
    """Bytes that differ between a run that is killed again and again and an undisturbed one."""
    with folder() as place:
        calm, shaken = place / "calm", place / "shaken"
        items = scenes(size.scenes)
        run_items(samples(size), items, ItemStore(calm), Workers(count=2))
        done = disturbed(shaken, size, size.scenes // 2, size.scenes, size.kills // 2, None)
        cluster = Cluster()
        try:
            done += disturbed(shaken, size, size.scenes, size.scenes, size.kills - done.total(), cluster)
        finally:
            cluster.close()
        differing = 0
        for key in items:
            one, other = (ItemStore(out).read(key) if key in ItemStore(out) else b"" for out in (calm, shaken))
            differing += sum(a != b for a, b in itertools.zip_longest(one, other)) if one != other else 0
        return {
            "kills": done.total(),
            "differing_bytes": differing,
            "quarantined": len(ItemStore(shaken).quarantined),
            "killed": done,
            "litter": len(list(shaken.rglob("*.part"))),
        }


PARTS = {"speedup": speedup, "overhead": overhead, "memory": memory, "kills": kills}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=sorted(PARTS))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--drive", nargs=5, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.drive:
        sys.exit(drive(*args.drive).exit_status)
    size = QUICK if args.quick else FULL
    found: dict[str, Any] = {}
    for name in args.only or PARTS:
        found |= PARTS[name](size)
        print(name, found, file=sys.stderr)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
