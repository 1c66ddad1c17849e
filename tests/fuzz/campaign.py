# SPDX-License-Identifier: Apache-2.0
"""Many cases of many readers: watched, counted, grouped; and the smallest input of each new failure kept."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import pickle
import re
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any

from fuzz.hostile import NONSENSE
from fuzz.inputs import Input, dumps, from_json, to_json
from fuzz.readers import READERS, Cases
from fuzz.worker import LIMIT_S, PACKAGES, ROOT, Answer

CORPUS = Path(__file__).resolve().parent / "corpus"
MAX_KEPT_BYTES = 16_000
"""Larger inputs are named by their seed and number, and not kept."""
MAX_LOST = 25
"""A reader that has ended the worker so often is left alone."""
_GRACE_S = 1.0
"""The worker's own clock ends first, so that it can say where it hangs."""
_START_S = 300.0
"""Longest start of a worker: imports, the seeds, and on a fresh machine numba's compilation."""


class Watch:
    """A worker that is watched: it is ended when it is late, and started again when it is gone."""

    def __init__(self, store: Path, limit_s: float = LIMIT_S) -> None:
        self._store, self._limit_s = store, limit_s
        self._folder = Path(tempfile.mkdtemp(prefix="rangesim-fuzz-"))
        self._process: subprocess.Popen[bytes] | None = None
        self._buffer = b""

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._end()
        shutil.rmtree(self._folder, ignore_errors=True)

    def start(self) -> None:
        """Start the worker, which makes the seeds if there are none."""
        self._started()

    def answer(self, reader: str, one: Input | None = None, seed: int = 0, case: int = 0) -> Answer:
        """What became of an input, or of a numbered case; a late answer counts only if it is late again."""
        request: dict[str, Any] = {"reader": reader, "seed": seed, "case": case}
        if one is not None:
            request["input"] = base64.b64encode(pickle.dumps(one)).decode()
        found = self._ask(request)
        return self._ask(request) if found.kind == "late" else found

    def _ask(self, request: Mapping[str, Any]) -> Answer:
        process = self._started()
        if request["reader"] not in self._warm:  # imports and compilation are not part of an answer
            self._warm.add(request["reader"])
            if self._exchange({"warm": request["reader"]}, _START_S) != b"warm":
                raise RuntimeError(f"the seeds of {request['reader']} cannot be read: see {self._folder}/trace")
        start = time.monotonic()
        line = self._exchange(request, self._limit_s + _GRACE_S)
        if line:
            return Answer(**json.loads(line))
        seconds = time.monotonic() - start
        trace = (self._folder / "trace").read_text("utf-8", "replace")
        said = (self._folder / "output").read_text("utf-8", "replace")[-1000:]
        late = seconds > self._limit_s
        if not late:
            process.wait(_START_S)  # it is ending
        self._end()
        if late:
            return Answer("failed", "late", "no answer", _place(trace), f"no answer in {self._limit_s:g} s", seconds)
        if process.returncode == 1 and "fuzz/worker.py" in said:
            raise RuntimeError(f"the harness itself failed on {request['reader']}, seed {request['seed']}: {said}")
        signal = f"signal {-process.returncode}" if process.returncode < 0 else f"exit {process.returncode}"
        kind = "memory" if "memory" in said.lower() or "bad_alloc" in said else "crash"
        return Answer("failed", kind, signal, _place(trace), said, seconds)

    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            paths = [str(ROOT), str(ROOT / "tests"), *filter(None, [os.environ.get("PYTHONPATH")])]
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "PYTHONHASHSEED": "0"}
            command = [sys.executable, "-m", "fuzz.worker", str(self._folder), str(self._store), str(self._limit_s)]
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
            self._buffer, self._warm = b"", set[str]()
            if self._line(_START_S) != b"ready":
                raise RuntimeError(f"the fuzzing worker did not start: {' '.join(command)}")
        return self._process

    def _exchange(self, request: Mapping[str, Any], timeout_s: float) -> bytes:
        """The worker's line in answer to a request; empty if there is none."""
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()
        return self._line(timeout_s)

    def _line(self, timeout_s: float) -> bytes:
        """The next line of the worker; empty if it is gone or takes too long."""
        assert self._process is not None
        assert self._process.stdout is not None
        stream, end = self._process.stdout.fileno(), time.monotonic() + timeout_s
        while b"\n" not in self._buffer:
            ready, _, _ = select.select([stream], [], [], max(0.0, end - time.monotonic()))
            part = os.read(stream, 1 << 16) if ready else b""
            if not part:
                return b""
            self._buffer += part
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line

    def _end(self) -> None:
        if self._process is None:
            return
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.kill()
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()
        self._process = None


def _place(trace: str) -> str:
    """Innermost line of the packages in a dump of faulthandler, whose newest frame comes first."""
    frames = re.findall(r'File "(.+)", line (\d+)', trace)
    own = [(name, line) for name, line in frames if name.startswith(PACKAGES)]
    if not own and not frames:
        return ""
    name, line = (own or frames)[0]
    return f"{name.removeprefix(f'{ROOT}/').rpartition('site-packages/')[2]}:{line}"


# --- counting ---------------------------------------------------------------------------------------------------------


@dataclass
class Group:
    """Failures of one fault: how many, and an example."""

    reader: str
    answer: Answer
    case: int
    name: str
    count: int = 1
    kept: str = ""
    example: str = ""


@dataclass
class Tally:
    """What became of the tries of one reader."""

    reader: str
    tries: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    slowest_case: int = 0
    peak_mb: float = 0.0
    groups: dict[tuple[str, str, str], Group] = field(default_factory=dict)
    given_up: bool = False

    def add(self, answer: Answer, case: int, name: str) -> bool:
        """Count an answer; True if it is the first of its group of failures."""
        self.tries += 1
        self.outcomes[answer.outcome] += 1
        self.peak_mb = max(self.peak_mb, answer.peak_mb)
        if answer.seconds > self.slowest_s:
            self.slowest_s, self.slowest_case = answer.seconds, case
        if answer.outcome != "failed":
            return False
        if answer.group in self.groups:
            self.groups[answer.group].count += 1
            return False
        self.groups[answer.group] = Group(self.reader, answer, case, name)
        return True


def shares(total: int, readers: Iterable[str], at_least: int = 0) -> dict[str, int]:
    """How many of `total` tries each reader gets, by its share; at least `at_least`."""
    names = list(readers)
    weight = sum(READERS[name].share for name in names)
    return {name: max(at_least, round(total * READERS[name].share / weight)) for name in names}


def fuzz_reader(
    watch: Watch, cases: Cases, numbers: Iterable[int], seed: int = 0, say: Callable[[Tally], None] = lambda _: None
) -> Tally:
    """Tally of the numbered cases of one reader."""
    tally, lost = Tally(cases.reader.name), 0
    for number in numbers:
        answer = watch.answer(tally.reader, seed=seed, case=number)
        name = cases.name(number)
        if answer.outcome == "accepted" and name.startswith(NONSENSE):
            answer = replace(answer, outcome="failed", kind="accepted", error=name)
        tally.add(answer, number, name)
        lost += answer.kind in ("late", "crash", "memory")
        if lost >= MAX_LOST:
            tally.given_up = True
            break
        say(tally)
    return tally


def load_seeds(store: Path) -> dict[str, dict[str, Input]]:
    """Seeds by reader and name, which the first worker made."""
    return dict(pickle.loads(store.read_bytes()))


def table(tallies: Iterable[Tally]) -> str:
    """Markdown table of what became of all tries."""
    names = ("reader", "tries", "accepted", "refused", "failures", "slowest s", "peak MB")
    lines = [f"| {' | '.join(names)} |", "|---|--:|--:|--:|--:|--:|--:|"]
    total: Counter[str] = Counter()
    for t in tallies:
        row = (t.tries, t.outcomes["accepted"], t.outcomes["refused"], t.outcomes["failed"])
        total.update(dict(zip(("tries", "accepted", "refused", "failed"), row, strict=True)))
        more = " (given up)" if t.given_up else ""
        lines.append(f"| {t.reader}{more} | {' | '.join(map(str, row))} | {t.slowest_s:.2f} | {t.peak_mb:.0f} |")
    lines.append(f"| all | {' | '.join(str(total[k]) for k in ('tries', 'accepted', 'refused', 'failed'))} | | |")
    return "\n".join(lines)


# --- the smallest input -----------------------------------------------------------------------------------------------


def minimise(one: Input, seeds: Mapping[str, Input], fails: Callable[[Input], bool], tries: int = 200) -> Input:
    """A smaller input that still `fails`: files as in the seed where they do not matter, parts of the rest left out."""
    left = [tries]

    def still(candidate: Input) -> bool:
        left[0] -= 1
        return left[0] >= 0 and fails(candidate)

    seed = next((s for s in seeds.values() if s.entry == one.entry and set(s.files) & set(one.files)), None)
    for name in [n for n in one.files if seed is not None and seed.files.get(n) not in (None, one.files[n])]:
        assert seed is not None
        candidate = one.with_file(name, seed.files[name])
        if still(candidate):
            one = candidate
    for name in list(one.files):
        if len(one.files) > 1 and (seed is None or name not in seed.files) and still(one.without(name)):
            one = one.without(name)
    changed = [n for n, c in one.files.items() if isinstance(c, bytes) and (seed is None or seed.files.get(n) != c)]
    for name in changed:
        content = one.files[name]
        assert isinstance(content, bytes)
        smaller = _without_parts(content, partial(_with_content, one, name, still))
        one = one.with_file(name, smaller)
    for at in reversed(range(len(one.arguments))):
        candidate = replace(one, arguments=one.arguments[:at] + one.arguments[at + 1 :])
        if still(candidate):
            one = candidate
    return one


def _with_content(one: Input, name: str, fails: Callable[[Input], bool], content: bytes) -> bool:
    return fails(one.with_file(name, content))


def _without_parts(content: bytes, fails: Callable[[bytes], bool]) -> bytes:
    """Delta debugging: leave out halves, quarters and so on, as long as it fails."""
    size = len(content) // 2
    while size >= 1:
        at = 0
        while at < len(content):
            candidate = content[:at] + content[at + size :]
            if fails(candidate):
                content = candidate
            else:
                at += size
        size //= 2
    return content


def keep(watch: Watch, group: Group, cases: Cases, seed: int) -> None:
    """Minimise the example of a group, and write it to the corpus if it is small and not made by hand."""
    one = cases(seed, group.case)
    group.example = example(one, cases.seeds)
    if group.case < len(cases.by_hand):
        return  # it is in the code
    lost = group.answer.kind in ("late", "crash", "memory")
    if not lost or group.answer.kind == "crash":
        fails = partial(_fails_alike, watch, group)
        one = minimise(one, cases.seeds, fails, tries=12 if lost else 200)
    group.example = example(one, cases.seeds)
    failure = " ".join(filter(None, group.answer.group))
    text = dumps({"reader": group.reader, "failure": failure, **to_json(one, cases.seeds)})
    if len(text) > MAX_KEPT_BYTES:
        return
    folder = CORPUS / group.reader
    folder.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256(" ".join(group.answer.group).encode()).hexdigest()[:8]
    path = folder / f"{group.answer.kind}-{re.sub(r'[^A-Za-z0-9]+', '_', group.answer.error)[:24]}-{digest}.json"
    path.write_text(text)
    group.kept = str(path.relative_to(CORPUS.parent))


def _fails_alike(watch: Watch, group: Group, one: Input) -> bool:
    return watch.answer(group.reader, one).group == group.answer.group


def example(one: Input, seeds: Mapping[str, Input]) -> str:
    """A short look at an input: its arguments, and the files in which it differs from the seed most like it."""
    alike = max(seeds.values(), key=lambda s: sum(s.files.get(n) == c for n, c in one.files.items()))
    changed = {n: c for n, c in one.files.items() if alike.files.get(n) != c}
    missing = [f"without {n}" for n in alike.files if n not in one.files]
    looks = [f"{n}: {c[:150] if isinstance(c, bytes) else c}" for n, c in changed.items()]
    return "; ".join([" ".join(one.arguments), *missing, *looks]).removeprefix("; ")[:400]


def kept() -> list[Path]:
    """Files of the corpus."""
    return sorted(CORPUS.rglob("*.json"))


def read_kept(path: Path, seeds: Mapping[str, Mapping[str, Input]]) -> tuple[str, Input]:
    """Reader and input of a file of the corpus."""
    data = json.loads(path.read_text())
    return data["reader"], from_json(data, seeds[data["reader"]])


# --- all of it --------------------------------------------------------------------------------------------------------


def run(
    total: int, seed: int, readers: Iterable[str], jobs: int = 1, keeps: bool = True, every_s: float = 10.0
) -> list[Tally]:
    """Tallies of `total` cases over readers; progress goes to stderr."""
    plan = shares(total, readers)
    folder = Path(tempfile.mkdtemp(prefix="rangesim-fuzz-seeds-"))
    store, lock, last, done = folder / "seeds.pickle", Lock(), [time.monotonic()], Counter[str]()

    def say(tally: Tally) -> None:
        with lock:
            done[tally.reader] = tally.tries
            if time.monotonic() - last[0] > every_s:
                last[0] = time.monotonic()
                own = f"{tally.reader} {tally.tries} of {plan[tally.reader]}, {tally.outcomes['failed']} failures"
                sys.stderr.write(f"{sum(done.values())} of {sum(plan.values())}; {own}\n")
                sys.stderr.flush()

    with Watch(store) as first:
        first.start()
    seeds = load_seeds(store)

    def one_reader(name: str) -> Tally:
        cases = Cases(READERS[name], seeds[name])
        with Watch(store) as watch:
            tally = fuzz_reader(watch, cases, range(plan[name]), seed, say)
            for group in tally.groups.values():
                if keeps:
                    keep(watch, group, cases, seed)
                else:
                    group.example = example(cases(seed, group.case), cases.seeds)
        return tally

    try:
        if jobs == 1:
            return [one_reader(name) for name in plan]
        with ThreadPoolExecutor(jobs) as pool:
            return list(pool.map(one_reader, plan))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
