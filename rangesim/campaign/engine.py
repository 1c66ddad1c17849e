# SPDX-License-Identifier: Apache-2.0
"""Carries out the items of a campaign on worker processes, and keeps their results.

The driver, this process, submits a bounded window of items, takes each result and writes it to the store. So the store
has one writer, and workers need no file system in common with it. Items that the store holds are not computed again:
after whatever ended a run, the same call goes on.

An item whose worker died again and again is under suspicion, but so are items that happened to wait on that worker. At
the end each suspect runs alone. If its worker dies again and again then, the item is the cause, and is quarantined.
"""

from __future__ import annotations

import queue
import statistics
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from pcgraph.plumbing import interrupts
from rangesim.campaign.by_value import pickled, source_of
from rangesim.campaign.in_worker import Job, Reply, all_versions, carry_out, replace_process
from rangesim.campaign.item_store import ItemStore, QuarantinedItem, check_key
from rangesim.campaign.workers import FIRST_ANSWER_S, WAIT_S, Workers, no_workers
from rangesim.errors import EnvironmentProblem
from rangesim.pipeline.stages import Progress, unwatched
from rangesim.settings.config import to_dict

if TYPE_CHECKING:
    from distributed import Client, Future

WINDOW_PER_WORKER = 4
"""Items that are submitted for each worker, so that none waits for the driver, and that 10^6 items need no memory."""
OWN_DEATHS = 3
"""Deaths of its worker, while it runs alone, that prove an item to be their cause."""
MAX_FUNCTION = 1 << 20
"""Bytes of a function with all that it takes along. It is sent with each item, and should cost less than the result."""
FIRST_LIMIT_S = 3600.0
"""Seconds that an item may take as long as it is not known how long items take."""
LIMIT_FACTOR = 30.0
"""An item may take this many times the median. Scenes of one campaign differ by a few times."""
MIN_LIMIT_S = 300.0
"""Seconds that every item may take, because the first one of a worker loads modules and compiles kernels."""
KNOWN_AFTER = 5
"""Items whose median tells how long items take."""
MIN_REPEATED = 20
"""Items that a run computes at least if it computes one of them twice, to see whether the bytes are the same. So the
second time costs at most 5 %."""
FIRST_FAILURES = 20
"""Failures without any success that end a run: the function is at fault, and not the items."""
MAX_LOSSES = 5
"""Times that the scheduler may be lost without an item done in between."""
POLL_S = 1.0
"""Seconds between two looks at the connection and at the number of workers, while no item ends."""


@dataclass(frozen=True)
class Outcome:
    """The fate of a run's items: computed, kept or quarantined.

    computed : count of items that this run has computed. kept : count that the store held already. quarantined : the
    items that failed, in this run or in an earlier one. warned : by category of warnings, the count of items of this
    run that issued one, and the first text. replaced : workers that were replaced because their memory had grown.
    rss : the most memory that a worker had after an item, bytes.
    """

    computed: int = 0
    kept: int = 0
    quarantined: tuple[QuarantinedItem, ...] = ()
    warned: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    replaced: int = 0
    rss: int = 0

    @property
    def exit_status(self) -> int:
        """Status of a command with this outcome: 1 if items failed, else 0."""
        return 1 if self.quarantined else 0

    def __str__(self) -> str:
        lines = [f"{self.computed} items computed, {self.kept} kept, {len(self.quarantined)} failed"]
        lines += [f"  {item.key}: {item.error}" for item in self.quarantined]
        lines += [f"  {count} items warned, {kind}: {text}" for kind, (count, text) in self.warned.items()]
        if self.replaced:
            lines.append(f"  {self.replaced} workers replaced, because their memory had grown")
        return "\n".join(lines)


def run_items(
    function: Callable[[Any], bytes],
    items: Mapping[str, Any],
    store: ItemStore,
    workers: Workers | None = None,
    tell: Progress | None = None,
    on_done: Callable[[str], None] | None = None,
    retry: bool = False,
) -> Outcome:
    """Call `function` with each item that the store does not hold yet, on worker processes, and store the results.

    Parameters
    ----------
    function : returns the bytes of one item; it must depend on its argument alone. It and the files of the user that it
        comes from travel to the workers.
    items : argument of each key. It may be a lazy mapping: an argument is asked for when it is needed.
    store : where the results go. Its settings, the function and all versions are pinned by the first run.
    workers : None for as many processes on this machine as there are cores.
    tell : is called with what is done and with the fraction that is done, 0..1.
    on_done : is called with the key of each item that this run has computed, once its result is on the disk.
    retry : compute the items again that failed in an earlier run.

    Raises
    ------
    ValueError
        A key cannot be the name of an item; the function cannot be sent to a worker, is not deterministic or fails for
        all of the first items; or the directory holds a campaign of other settings.
    EnvironmentProblem
        Dask is missing, no worker can be reached, a worker has other versions, another process works in the same
        directory, or the disk is full. What is done is kept.

    Examples
    --------
    >>> outcome = run_items(sample_bytes, {"sample-0": 0}, ItemStore("out/set"))  # doctest: +SKIP
    """
    sent_function = pickled(function)
    if len(sent_function) > MAX_FUNCTION:
        raise ValueError(
            f"expected a function of at most {MAX_FUNCTION} bytes, got {len(sent_function)}: it goes to the workers "
            "with every item, so let it read large data from files."
        )
    made_with = all_versions()
    for key in items:
        check_key(key)
    with store.claimed():
        store.pin({"function": source_of(function), "versions": made_with})
        failed = [item.key for item in store.quarantined if item.key in items]
        if retry:
            for key in failed:
                store.discard(key)
            failed = []
        kept = sum(store.check_argument(key, items[key]) for key in items if key in store)
        run = _Run(sent_function, made_with, items, store, tell or unwatched, on_done, kept, len(failed))
        with interrupts.last_words(run.how_to_go_on):
            run.carry_out(workers or Workers())
        quarantined = tuple(item for item in store.quarantined if item.key in items)
        return Outcome(run.computed, kept, quarantined, run.warned, run.replaced, run.rss)


class _SchedulerLost(Exception):
    """The connection to the scheduler broke, and with it what was submitted."""


@dataclass
class _Run:
    """One run: the items, what became of them, and what was learnt about them.

    suspects : deaths that each suspect caused while it ran alone. seconds : that the latest items took.
    """

    function: bytes
    made_with: dict[str, str]
    items: Mapping[str, Any]
    store: ItemStore
    tell: Progress
    on_done: Callable[[str], None] | None
    kept: int
    failed: int
    computed: int = 0
    suspects: dict[str, int] = field(default_factory=dict)
    seconds: deque[float] = field(default_factory=lambda: deque(maxlen=1000))
    warned: dict[str, tuple[int, str]] = field(default_factory=dict)
    replaced: int = 0
    rss: int = 0
    repeated: bool = False
    began: float = field(default_factory=time.monotonic)
    ended_before: int = field(init=False)

    def __post_init__(self) -> None:
        self.ended_before = self.kept + self.failed

    @property
    def left(self) -> int:
        """Count of items that are neither stored nor quarantined."""
        return len(self.items) - self.kept - self.computed - self.failed

    def unfinished(self) -> Iterator[str]:
        """Keys of the items that are still to be computed, without the suspects."""
        for key in self.items:
            if key not in self.store and not self.store.is_quarantined(key) and key not in self.suspects:
                yield key

    def carry_out(self, workers: Workers) -> None:
        """Carry out all items; go on after the scheduler was lost."""
        answer_s, losses = FIRST_ANSWER_S, 0
        while self.left:
            self.report()
            left = self.left
            try:
                with workers.connected(self.left, answer_s) as client:
                    _Session(self, client, workers).carry_out()
            except _SchedulerLost as loss:
                losses = losses + 1 if self.left == left else 0
                if losses == MAX_LOSSES:
                    raise EnvironmentProblem(
                        f"the scheduler was lost {losses} times without an item done in between; {self.how_to_go_on()}."
                    ) from loss
                self.tell(f"waiting for the scheduler, {self.how_to_go_on()}", self._fraction())
                answer_s = WAIT_S
            except EnvironmentProblem as problem:
                raise EnvironmentProblem(f"{str(problem).rstrip('.')}; {self.how_to_go_on()}.") from problem

    def limit_s(self) -> float:
        """Seconds that an item may take."""
        if len(self.seconds) < KNOWN_AFTER:
            return FIRST_LIMIT_S
        return max(MIN_LIMIT_S, LIMIT_FACTOR * statistics.median(self.seconds))

    def keep(self, key: str, content: bytes) -> None:
        """Store the result of an item."""
        self.store.write(key, content, self.items[key])
        self.computed += 1
        self.suspects.pop(key, None)
        if self.on_done is not None:
            self.on_done(key)
        self.report()

    def quarantine(self, key: str, error: str, traceback: str, attempts: int) -> None:
        """Write down that an item failed."""
        self.store.quarantine(QuarantinedItem(key, error, to_dict(self.items[key]), traceback, attempts))
        self.failed += 1
        self.suspects.pop(key, None)
        self.report()
        if self.failed >= FIRST_FAILURES and not self.kept + self.computed:
            raise ValueError(
                f"the first {self.failed} items all failed, {key} by {error}; mend the function, and choose another "
                f"directory; the tracebacks are in {self.store.directory / 'quarantine'}."
            )

    def learn(self, reply: Reply) -> None:
        """Take note of the warnings, the time and the memory of an item."""
        self.seconds.append(reply.seconds)
        self.rss = max(self.rss, reply.rss)
        for kind, text in dict(reply.warned).items():
            count, first = self.warned.get(kind, (0, text))
            self.warned[kind] = count + 1, first

    def how_to_go_on(self) -> str:
        """Sentence that says what is kept, and how to go on."""
        return f"{self.kept + self.computed} of {len(self.items)} items are done and kept; run the same again to go on"

    def report(self) -> None:
        """Tell how much is done, and how long the rest will take at the speed so far."""
        ended = self.computed + self.failed + self.kept - self.ended_before
        text = f"{len(self.items) - self.left} of {len(self.items)} items"
        if ended and self.left:
            text += f", {duration((time.monotonic() - self.began) / ended * self.left)} left"
        if self.failed:
            text += f", {self.failed} failed"
        self.tell(text, self._fraction())

    def _fraction(self) -> float:
        return 1.0 - self.left / len(self.items) if self.items else 1.0


class _Submitted(NamedTuple):
    """An item that is with the scheduler; `repeats` if the store holds its result, which this one has to equal."""

    key: str
    future: Future
    repeats: bool


class _Ended(NamedTuple):
    """News of a submitted item: its future has ended, or it is `where` after the seconds of its time limit."""

    number: int
    where: str | None = None
    limit_s: float = 0.0


class _Session:
    """The items that are with one scheduler, as long as the connection holds."""

    def __init__(self, run: _Run, client: Client, workers: Workers) -> None:
        self.run, self.client, self.workers = run, client, workers
        self.topic = f"rangesim-{uuid.uuid4().hex}"
        """Name of this session, which no other one at the same scheduler has."""
        self.submitted: dict[int, _Submitted] = {}
        self.number = 0
        self.news: queue.SimpleQueue[_Ended] = queue.SimpleQueue()
        self.replaced: set[str] = set()
        self.alone = False
        self.counted = -POLL_S
        self.count = 1
        self.sharing = 1
        self.seen_workers = time.monotonic()
        client.subscribe_topic(self.topic, self._hear)

    def carry_out(self) -> None:
        """Carry out the unfinished items, and at the end each suspect alone."""
        run = self.run
        if not run.repeated and run.left >= MIN_REPEATED:
            stored = next((key for key in run.items if key in run.store), None)
            if stored is not None:
                self._submit(stored, repeats=True)
        for key in run.unfinished():
            self._submit(key)
            while len(self.submitted) >= WINDOW_PER_WORKER * self._workers():
                self._take()
        self._drain()
        self.alone = True
        while run.suspects:
            key = next(iter(run.suspects))
            start = time.monotonic()
            self._submit(key)
            self._drain()
            if (deaths := run.suspects.get(key, 0)) >= OWN_DEATHS:
                took = duration((time.monotonic() - start) / deaths)
                error = f"its worker process died {deaths} times while nothing else ran, every {took}"
                run.quarantine(key, error, "", deaths)

    def _submit(self, key: str, repeats: bool = False) -> None:
        run, number = self.run, self.number
        self.number += 1
        argument = pickled(run.items[key])
        job = Job(self.topic, number, run.function, argument, run.made_with, run.limit_s(), self.sharing)
        future = self.client.submit(carry_out, job, key=(self.topic, number))
        self.submitted[number] = _Submitted(key, future, repeats)
        run.repeated |= repeats
        future.add_done_callback(lambda _: self.news.put(_Ended(number)))

    def _hear(self, event: tuple[float, dict[str, Any]]) -> None:
        """Take note of an item that hangs, in Dask's thread."""
        told = event[1]
        self.news.put(_Ended(told["number"], told["where"], told["limit_s"]))

    def _drain(self) -> None:
        while self.submitted:
            self._take()

    def _take(self) -> None:
        """Take the next item that has ended, if one ends soon."""
        try:
            news = self.news.get(timeout=POLL_S)
        except queue.Empty:
            if self.client.status != "running":
                raise _SchedulerLost from None
            self._workers()
            return
        if (item := self.submitted.pop(news.number, None)) is None:
            return  # it was judged before
        if news.where is not None:
            item.future.cancel()
            error = f"did not end within {news.limit_s:g} s, its time limit"
            self.run.quarantine(item.key, error, news.where, 1)
        elif (reply := self._reply(item)) is not None:
            self._judge(item, reply)

    def _reply(self, item: _Submitted) -> Reply | None:
        """The reply to an item that has ended; None if its worker has died."""
        from concurrent.futures import CancelledError

        from distributed.scheduler import KilledWorker

        try:
            reply: Reply = item.future.result()
        except KilledWorker as death:
            if not item.repeats:
                deaths = death.allowed_failures + 1 if self.alone else 0
                self.run.suspects[item.key] = self.run.suspects.get(item.key, 0) + deaths
            return None
        except (CancelledError, OSError) as error:
            raise _SchedulerLost from error
        except Exception as error:
            raise EnvironmentProblem(
                f"a worker cannot take items ({type(error).__name__}: {error}): install the same versions there"
            ) from error
        item.future.release()
        if reply.unfit:
            raise EnvironmentProblem(f"the worker at {reply.worker} does not fit: {reply.unfit}")
        return reply

    def _judge(self, item: _Submitted, reply: Reply) -> None:
        """Store or quarantine an item, and look after its worker."""
        run = self.run
        run.learn(reply)
        if item.repeats:
            if reply.content != run.store.read(item.key):
                gave = "other bytes" if reply.content is not None else reply.error
                raise ValueError(
                    f"item {item.key} gave {gave} when it was computed again: the function must depend on its "
                    "argument alone (no time, no unseeded random numbers), and a campaign stays on processors of one "
                    "kind; mend that, and choose another directory."
                )
        elif reply.content is None:
            run.quarantine(item.key, reply.error, reply.traceback, 1)
        else:
            run.keep(item.key, reply.content)
            if not run.repeated and run.left + run.computed >= MIN_REPEATED:
                self._submit(item.key, repeats=True)
        if reply.has_grown and reply.worker not in self.replaced:
            self.replaced.add(reply.worker)
            run.replaced += 1
            self.client.run(replace_process, workers=[reply.worker], wait=False)

    def _workers(self) -> int:
        """Count of workers, at least 1, not older than a second; EnvironmentProblem if there is none for long."""
        now = time.monotonic()
        if now - self.counted >= POLL_S:
            hosts = [worker["host"] for worker in self.client.scheduler_info(-1)["workers"].values()]
            self.counted, self.count = now, len(hosts)
            self.sharing = max([1, *(hosts.count(host) for host in set(hosts))])
            if hosts:
                self.seen_workers = now
            elif now - self.seen_workers > WAIT_S:
                raise EnvironmentProblem(no_workers(self.workers.scheduler))
        return max(1, self.count)


def duration(seconds: float) -> str:
    """A duration in the one or two units that a reader cares for.

    Examples
    --------
    >>> duration(7), duration(200), duration(9000), duration(200000)
    ('7 s', '3 min', '2 h 30 min', '2 d 7 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    hours, rest = divmod(minutes, 60)
    return f"{hours} h {rest} min" if hours < 48 else f"{hours // 24} d {hours % 24} h"
