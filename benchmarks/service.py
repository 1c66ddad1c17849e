# SPDX-License-Identifier: Apache-2.0
"""The service under load: many clients with good and bad uploads, a killed worker, a stuck job.

    python benchmarks/service.py [--clients 64] [--seconds 60] [--seed 0]

It starts `pcgraph serve` on a free port of 127.0.0.1, and ends it. Each client repeats one of these steps, at random:

- Most often it uploads a cloud that `pcgraph.segment` has segmented in this process, and asks for its labels and for a
  finer cut. Both must be equal.
- Else it uploads something bad, which must be refused with the right status: a truncated file, random bytes, a file
  above the limit of size (with and without a Content-Length), a wrong parameter, or an upload that arrives too slowly.

At half time one worker is killed with SIGKILL. One cloud takes longer than the server's time limit; its job must fail
with the status 504.

    requests    answers of the server
    wrong       answers with a wrong status, wrong labels or no labels, except those of the killed worker (`lost`)
    p50_ms      time from the start of a good upload until its segmentation is done, median; p95_ms: 95 %
    refused     answers with the status 503: the service is busy
    rss_growth  memory of the server and its workers: median of the last quarter of the time over that of the second,
                minus 1; in less than a minute it shows the warm-up only

The last line is JSON.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

import pcgraph
from pcgraph.io import encode_cloud

LIMITS = {"max-seconds": 10, "max-upload-mb": 100, "max-upload-seconds": 5, "max-stored-gb": 0.05, "max-memory-gb": 3}
"""Settings of the server: short times, so that slow uploads and the stuck job end within the minute, and a small store,
so that it has to make room."""
CUT = 12
"""Count of segments in the finer cut. Chosen by eye; not varied."""
MAX_REQUESTS = 200_000
"""Largest count of requests; the clients stop then even before the time is over."""
ACTIONS = {"good": 0.80, "cut off": 0.04, "garbage": 0.04, "too large": 0.03, "too large, unsaid": 0.02,
           "wrong parameter": 0.04, "slow": 0.03}  # fmt: skip
"""Relative frequency of each step of a client."""
STUCK_POINTS = 5_000_000
"""Points of the stuck cloud, noise in a cube."""
STUCK_VOXEL = 0.005
"""Edge of its voxels, metres: one core takes 28 s for them, three times as long as the limit, and 1.9 GB."""
RECOVERY_SECONDS = 20
"""Seconds within which a new worker must be ready; it takes some three on a free core."""


@dataclass(frozen=True)
class Known:
    """A cloud as a file, and its expected labels."""

    name: str
    content: bytes
    labels: NDArray[np.int32]
    cut: NDArray[np.int32]


@dataclass
class Tally:
    """Counts and times of all requests."""

    answers: Counter[str] = field(default_factory=Counter)
    wrong: Counter[str] = field(default_factory=Counter)
    lost: int = 0
    refused: int = 0
    seconds: list[float] = field(default_factory=list)


def box_on_a_table(n: int, rng: np.random.Generator) -> pcgraph.Cloud:
    """n points of a table and three boxes on it, 1 mm of noise, and intensities."""
    xy = rng.uniform(-0.5, 0.5, (n, 2))
    height = np.zeros(n)
    for x, y, size, high in zip(*rng.uniform(-0.35, 0.35, (2, 3)), *rng.uniform(0.1, 0.2, (2, 3)), strict=True):
        height[(np.abs(xy - (x, y)) < size / 2).all(axis=1)] = high
    points = np.column_stack((xy, height)) + rng.normal(0.0, 1e-3, (n, 3))
    return pcgraph.Cloud(points.astype(np.float32), columns={"intensity": rng.uniform(0, 1, n).astype(np.float32)})


def known_clouds(rng: np.random.Generator) -> list[Known]:
    """Clouds of several sizes in several formats, segmented here."""
    found = []
    for number, (n, end) in enumerate(((2000, "ply"), (4000, "pcd"), (6000, "npz"), (3000, "laz"), (12000, "ply"))):
        name = f"cloud{number}.{end}"
        content = encode_cloud(box_on_a_table(n, rng), name)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(content)
            result = pcgraph.segment(path)
        found.append(Known(name, content, result.labels, result.cut(CUT)))
    return found


class Client:
    """One client, which sends one request after the other."""

    def __init__(self, http: httpx.AsyncClient, known: list[Known], tally: Tally, seed: int) -> None:
        self.http, self.known, self.tally = http, known, tally
        self.rng = np.random.default_rng(seed)

    async def run(self, until: float) -> None:
        actions, weights = list(ACTIONS), list(ACTIONS.values())
        while time.monotonic() < until and self.tally.answers.total() < MAX_REQUESTS:
            action = actions[self.rng.choice(len(actions), p=weights)]
            cloud = self.known[self.rng.integers(len(self.known))]
            try:
                await (self.good(cloud) if action == "good" else self.bad(action, cloud))
            except httpx.HTTPError as error:
                self.tally.wrong[f"{action}: no answer, {type(error).__name__} {error}"] += 1

    async def ask(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """The answer to a request, which is repeated as long as the answer is 503."""
        while True:
            answer = await self.http.request(method, path, **arguments)
            self.tally.answers[str(answer.status_code)] += 1
            if answer.status_code != 503:
                return answer
            self.tally.refused += 1
            await asyncio.sleep(float(answer.headers["Retry-After"]) * self.rng.uniform(0.5, 1.5))

    async def good(self, cloud: Known) -> None:
        start = time.monotonic()
        if self.rng.random() < 0.5:
            made = await self.ask("POST", "/segmentations", params={"name": cloud.name}, content=cloud.content)
        else:
            made = await self.ask("POST", "/segmentations", files={"cloud": (cloud.name, cloud.content)})
        job = await self.outcome(made)
        if "state" not in job:
            return self.failed("good", job)
        self.tally.seconds.append(time.monotonic() - start)
        for parameters, right in (({}, cloud.labels), ({"n": CUT}, cloud.cut)):
            answer = await self.ask("GET", job["links"]["labels"], params=parameters)
            if answer.status_code == 404:  # removed to make room for others
                continue
            if answer.status_code != 200:
                self.failed("labels", answer.json())
            elif not np.array_equal(np.load(BytesIO(answer.content))["labels"], right):
                self.tally.wrong[f"the labels of {cloud.name} differ"] += 1
        if self.rng.random() < 0.3:
            answer = await self.ask("DELETE", job["links"]["self"])
            if answer.status_code not in (204, 404):
                self.tally.wrong[f"remove: {answer.text}"] += 1
        return None

    async def outcome(self, made: httpx.Response) -> dict[str, Any]:
        """The finished job of an upload, or its problem."""
        job: dict[str, Any] = made.json()
        while job.get("state") in ("queued", "running"):
            job = (await self.ask("GET", job["links"]["self"], params={"wait": 10})).json()
        problem: dict[str, Any] | None = job.get("problem")
        return job if problem is None else problem

    def failed(self, action: str, problem: dict[str, Any]) -> None:
        """Count a failure: lost with the killed worker, or wrong."""
        if "SIGKILL" in problem["detail"]:
            self.tally.lost += 1
        else:
            self.tally.wrong[f"{action}: {json.dumps(problem)}"] += 1

    async def bad(self, action: str, cloud: Known) -> None:
        parameters: dict[str, Any] = {"name": cloud.name}
        content: bytes | AsyncIterator[bytes]
        content, right = cloud.content, 422
        if action == "cut off":
            content = cloud.content[: int(len(cloud.content) * self.rng.uniform(0.0, 0.9))]
        elif action == "garbage":
            content = self.rng.bytes(int(self.rng.integers(1, 5000)))
        elif action == "too large":
            content, right = bytes(int(1e6 * LIMITS["max-upload-mb"]) + 1), 413
        elif action == "too large, unsaid":
            content, right = endless(), 413
        elif action == "wrong parameter":
            parameters["voxel_sise"] = 0.1
        elif action == "slow":
            content, right = drip(), 408
        try:
            answer = await self.http.post("/segmentations", params=parameters, content=content)
        except (httpx.ReadError, httpx.WriteError):
            if action in ("slow", "too large, unsaid"):  # ended while it sends, so that it may miss the answer
                self.tally.answers["ended"] += 1
                return
            raise
        self.tally.answers[str(answer.status_code)] += 1
        if answer.status_code == 503:
            self.tally.refused += 1
            return
        outcome = await self.outcome(answer)
        if outcome.get("status") != right:
            self.failed(action, {"detail": "", **outcome})


async def endless() -> AsyncIterator[bytes]:
    for _ in range(1000):
        yield bytes(1 << 20)


async def drip() -> AsyncIterator[bytes]:
    for _ in range(1000):
        yield b"p"
        await asyncio.sleep(0.5)


# ---- The server ----------------------------------------------------------------------------------------------------


def start_server() -> tuple[subprocess.Popen[str], str]:
    limits = [f"--{name}={value}" for name, value in LIMITS.items()]
    command = [sys.executable, "-m", "pcgraph", "serve", "--port=0", *limits]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    line = server.stdout.readline()
    if not line.startswith("serving at "):
        raise SystemExit(f"the server did not start: {line}")
    return server, line.split()[-1]


def children(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(word) for task in tasks for word in task.read_text().split()]


def resident_bytes(pid: int) -> int:
    """Resident memory of a process and its children; 0 if it has just ended."""
    total = 0
    for one in (pid, *children(pid)):
        try:
            total += int(Path(f"/proc/{one}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except OSError:
            continue
    return total


async def watch_memory(pid: int, samples: list[tuple[float, int]]) -> None:
    while True:
        samples.append((time.monotonic(), resident_bytes(pid)))
        await asyncio.sleep(0.25)


async def kill_one(pid: int, at: float) -> int:
    await asyncio.sleep(max(0.0, at - time.monotonic()))
    worker = children(pid)[0]
    os.kill(worker, signal.SIGKILL)
    return worker


async def begin_stuck_job(http: httpx.AsyncClient, rng: np.random.Generator) -> str:
    """Path of a job that takes too long, returned when it has begun."""
    points = rng.uniform(0.0, 1.0, (STUCK_POINTS, 3)).astype(np.float32)
    content = encode_cloud(pcgraph.Cloud(points), "stuck.ply")
    parameters: dict[str, Any] = {"name": "stuck.ply", "voxel_size": STUCK_VOXEL, "wait": 0}
    path: str = (await http.post("/segmentations", params=parameters, content=content)).headers["Location"]
    while (await http.get(path)).json()["state"] == "queued":
        await asyncio.sleep(0.1)
    return path


async def end_of(http: httpx.AsyncClient, path: str) -> dict[str, Any]:
    """The job at a path once it is done or has failed, asked for at once: the small store keeps it for a while only."""
    while True:
        job: dict[str, Any] = (await http.get(path, params={"wait": LIMITS["max-seconds"]})).json()
        if job.get("state") not in ("queued", "running"):
            return job


async def recovered(http: httpx.AsyncClient, pid: int, killed: int) -> bool:
    """Whether all workers are ready again, within some seconds, and none is the killed one."""
    for _ in range(RECOVERY_SECONDS):
        health = (await http.get("/health")).json()
        if health["ready"] and health["workers"] == len(children(pid)) and killed not in children(pid):
            return True
        await asyncio.sleep(1.0)
    return False


# ---- The run -------------------------------------------------------------------------------------------------------


async def load(address: str, pid: int, known: list[Known], arguments: argparse.Namespace) -> dict[str, Any]:
    tally, samples = Tally(), list[tuple[float, int]]()
    limits = httpx.Limits(max_connections=None)
    async with httpx.AsyncClient(base_url=address, timeout=120.0, limits=limits) as http:
        stuck = await begin_stuck_job(http, np.random.default_rng(arguments.seed))
        ended = asyncio.create_task(end_of(http, stuck))
        begin = time.monotonic()
        until = begin + arguments.seconds
        watching = asyncio.create_task(watch_memory(pid, samples))
        kill = asyncio.create_task(kill_one(pid, begin + arguments.seconds / 2))
        clients = [Client(http, known, tally, 1000 * arguments.seed + i) for i in range(arguments.clients)]
        await asyncio.gather(*(client.run(until) for client in clients))
        end = time.monotonic()
        watching.cancel()
        job = await ended
        if (job.get("problem") or {}).get("status") != 504:
            tally.wrong[f"stuck: {json.dumps(job)[:300]}"] += 1
        if not await recovered(http, pid, await kill):
            tally.wrong["workers did not come back"] += 1
    quarter = (end - begin) / 4
    second = [rss for at, rss in samples if begin + quarter <= at < begin + 2 * quarter]
    last = [rss for at, rss in samples if end - quarter <= at <= end]
    milliseconds = 1e3 * np.array(tally.seconds)
    for sentence, count in tally.wrong.items():
        print(f"wrong {count} times: {sentence}")
    print("answers by status:", dict(sorted(tally.answers.items())))
    return {
        "requests": tally.answers.total(),
        "wrong": tally.wrong.total(),
        "p95_ms": round(float(np.percentile(milliseconds, 95))),
        "rss_growth": round(float(np.median(last) / np.median(second) - 1.0), 4),
        "p50_ms": round(float(np.percentile(milliseconds, 50))),
        "segmentations": len(tally.seconds),
        "lost": tally.lost,
        "refused": tally.refused,
        "rss_mb": round(float(np.median(last)) / 1e6),
        "clients": arguments.clients,
        "seconds": round(end - begin, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    known = known_clouds(np.random.default_rng(arguments.seed))
    server, address = start_server()
    try:
        result = asyncio.run(load(address, server.pid, known, arguments))
    finally:
        server.send_signal(signal.SIGTERM)
        status = server.wait(30)
    if status:
        result["wrong"] += 1
        print(f"wrong: the server ended with status {status}")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
