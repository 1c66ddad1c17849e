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
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rangesim.campaign.by_value import pickled
from rangesim.campaign.in_worker import Reply, carry_out_item
from rangesim.campaign.item_store import ItemStore, QuarantinedItem, check_key
from rangesim.campaign.workers import Workers
from rangesim.pipeline.stages import Progress, unwatched
from rangesim.settings.config import to_dict

if TYPE_CHECKING:
    from distributed import Client, Future

WINDOW_PER_WORKER = 4
"""Items that are submitted for each worker, so that none waits for the driver, and that 10^6 items need no memory."""
OWN_DEATHS = 3
"""Deaths of its worker, while it runs alone, that prove an item to be their cause."""


@dataclass(frozen=True)
class Outcome:
    """What became of the items of a run.

    computed : count of items that this run has computed. kept : count that the store held already. quarantined : the
    items that failed, in this run or in an earlier one.
    """

    computed: int = 0
    kept: int = 0
    quarantined: tuple[QuarantinedItem, ...] = ()

    @property
    def exit_status(self) -> int:
        """Status of a command with this outcome: 1 if items failed, else 0."""
        return 1 if self.quarantined else 0

    def __str__(self) -> str:
        lines = [f"{self.computed} items computed, {self.kept} kept, {len(self.quarantined)} failed"]
        lines += [f"  {item.key}: {item.error}" for item in self.quarantined]
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
    items : argument of each key. It may be a lazy mapping: an argument is asked for when its item is submitted.
    store : where the results go.
    workers : None for as many processes on this machine as there are cores.
    tell : is called with what is done and with the fraction that is done, 0..1.
    on_done : is called with the key of each item that this run has computed, once its result is on the disk.
    retry : compute the items again that failed in an earlier run.

    Raises
    ------
    ValueError
        A key cannot be the name of an item, or the function cannot be sent to a worker.
    EnvironmentProblem
        Dask is missing, no worker can be reached, another process works in the same directory, or the disk is full.
        What is done is kept.

    Examples
    --------
    >>> outcome = run_items(sample_bytes, {"sample-0": 0}, ItemStore("out/set"))  # doctest: +SKIP
    """
    sent_function = pickled(function)
    with store.claimed():
        left = _left(items, store, retry)
        run = _Run(items, store, tell or unwatched, on_done, total=len(items), left=left)
        if left:
            with (workers or Workers()).connected() as client:
                run.carry_out(client, sent_function, _unfinished(items, store))
        failed = tuple(item for item in store.quarantined if item.key in items)
        return Outcome(run.computed, len(items) - run.computed - len(failed), failed)


def _left(items: Mapping[str, Any], store: ItemStore, retry: bool) -> int:
    """Count of items that are still to be computed; with `retry`, also those that failed, which are then forgotten."""
    if retry:
        for item in store.quarantined:
            if item.key in items:
                store.discard(item.key)
    for key in items:
        check_key(key)
    return sum(1 for _ in _unfinished(items, store))


def _unfinished(items: Mapping[str, Any], store: ItemStore) -> Iterator[str]:
    return (key for key in items if key not in store and not store.is_quarantined(key))


@dataclass
class _Run:
    """The items of one run, and where each stands."""

    items: Mapping[str, Any]
    store: ItemStore
    tell: Progress
    on_done: Callable[[str], None] | None
    total: int
    left: int
    computed: int = 0
    failed: int = 0
    suspects: list[str] = field(default_factory=list)
    ended: queue.SimpleQueue[tuple[str, Future]] = field(default_factory=queue.SimpleQueue)
    running: dict[str, Future] = field(default_factory=dict)

    def carry_out(self, client: Client, function: bytes, keys: Iterator[str]) -> None:
        """Carry out the items of these keys, and at the end each suspect alone."""
        start = time.monotonic()
        self._tell(start)
        for key in keys:
            self._submit(client, function, key)
            while len(self.running) >= WINDOW_PER_WORKER * max(1, len(client.scheduler_info(-1)["workers"])):
                self._take(client, start)
        while self.running:
            self._take(client, start)
        deaths = dict.fromkeys(self.suspects, 0)
        while self.suspects:
            key = self.suspects.pop()
            self._submit(client, function, key)
            while self.running:
                deaths[key] += self._take(client, start)
            if key in self.suspects and deaths[key] >= OWN_DEATHS:
                self.suspects.remove(key)
                self._quarantine(
                    key, "its worker process died each time that it ran, also when it ran alone", "", deaths[key]
                )

    def _submit(self, client: Client, function: bytes, key: str) -> None:
        argument = pickled(self.items[key])
        future = client.submit(carry_out_item, function, argument, key=f"rangesim-{key}", pure=False)
        self.running[key] = future
        future.add_done_callback(lambda done: self.ended.put((key, done)))

    def _take(self, client: Client, start: float) -> int:
        """Take one item that has ended; return how many workers it is known to have taken along."""
        from distributed.scheduler import KilledWorker

        key, future = self.ended.get()
        if self.running.get(key) is not future:
            return 0
        del self.running[key]
        try:
            reply: Reply = future.result()
        except KilledWorker as death:
            self.suspects.append(key)
            return death.allowed_failures + 1
        future.release()
        if reply.content is None:
            self._quarantine(key, reply.error, reply.traceback, 1)
        else:
            self.store.write(key, reply.content)
            self.computed += 1
            if self.on_done is not None:
                self.on_done(key)
        self._tell(start)
        return 0

    def _quarantine(self, key: str, error: str, traceback: str, attempts: int) -> None:
        self.failed += 1
        self.store.quarantine(QuarantinedItem(key, error, to_dict(self.items[key]), traceback, attempts))

    def _tell(self, start: float) -> None:
        """Tell how much is done, and how long the rest will take at the speed so far."""
        ended = self.computed + self.failed
        done = self.total - self.left + ended
        text = f"{done} of {self.total} items"
        if ended:
            text += f", {_duration((time.monotonic() - start) / ended * (self.left - ended))} left"
        if self.failed:
            text += f", {self.failed} failed"
        self.tell(text, done / self.total if self.total else 1.0)


def _duration(seconds: float) -> str:
    """A duration in the one or two units that a reader cares for.

    Examples
    --------
    >>> _duration(7), _duration(200), _duration(9000), _duration(200000)
    ('7 s', '3 min', '2 h 30 min', '2 d 7 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    hours, rest = divmod(minutes, 60)
    return f"{hours} h {rest} min" if hours < 48 else f"{hours // 24} d {hours % 24} h"
