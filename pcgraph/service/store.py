# SPDX-License-Identifier: Apache-2.0
"""Store of the service's segmentations: their state in memory, and their files in a private folder.

The folder is removed when the server ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pcgraph.service.problems import Problem
from pcgraph.service.settings import ServiceSettings
from pcgraph.service.worker_pool import Order

try:
    import fcntl
except ImportError:  # Windows has no flock: there, what killed servers left is not cleared
    fcntl = None  # type: ignore[assignment]

_PREFIX = "pcgraph-serve-"
_NEW_PREFIX = ".pcgraph-serve-new-"
_LOCK = "lock"
MAX_JOBS = 10_000
"""Largest count of segmentations that are kept, with the failed ones, which have no files but take some memory. Chosen
by eye; not varied."""


@dataclass(eq=False)
class Job:
    """A segmentation of the service: queued, running, done or failed.

    Attributes
    ----------
    id : str
        Random name, too long to guess.
    folder : Path
        Folder with its files.
    title : str
        Name of the upload, for people.
    stage : str, or None
        What a worker is doing for it.
    order : Order, or None
        Its segmentation in the queue or in a worker; None while the upload arrives.
    began, ended : float, seconds of `time.monotonic`, or None
        Start and end of the work.
    summary : dict, or None
        Summary of the segmentation, if it is done.
    problem : Problem, or None
        Reason of the failure, if it failed.
    n_bytes : int
        Size of its files, bytes.
    used : float, seconds of `time.monotonic`
        Time of the last request about it.
    finished : Event
        Set when it is done or has failed.
    """

    id: str
    folder: Path
    title: str = ""
    stage: str | None = None
    order: Order | None = None
    began: float | None = None
    ended: float | None = None
    summary: dict[str, Any] | None = None
    problem: Problem | None = None
    n_bytes: int = 0
    used: float = field(default_factory=time.monotonic)
    finished: asyncio.Event = field(default_factory=asyncio.Event)

    @property
    def state(self) -> str:
        """State of the job: queued, running, done or failed."""
        if self.finished.is_set():
            return "failed" if self.problem else "done"
        return "queued" if self.began is None else "running"

    @property
    def seconds(self) -> float:
        """Time that a worker has spent on it, seconds."""
        if self.began is None:
            return 0.0
        return (time.monotonic() if self.ended is None else self.ended) - self.began


class Store:
    """Jobs by id. If there are too many, or their files are too large, those unused for longest are removed."""

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings
        self._jobs: dict[str, Job] = {}
        self.folder, self._lock = _private_folder(settings.folder or Path(tempfile.gettempdir()))

    def close(self) -> None:
        """Remove all files."""
        shutil.rmtree(self.folder, ignore_errors=True)
        os.close(self._lock)

    def __len__(self) -> int:
        return len(self._jobs)

    def new(self) -> Job:
        """A new job with an empty folder."""
        name = secrets.token_urlsafe(16)
        folder = self.folder / name
        folder.mkdir(mode=0o700)
        self._jobs[name] = Job(name, folder)
        return self._jobs[name]

    def job(self, name: str) -> Job:
        """The job of an id, which counts as a use; Problem if there is none."""
        found = self._jobs.get(name)
        if found is None:
            raise Problem(404, "there is no such segmentation: it was removed, or has not been used for too long")
        found.used = time.monotonic()
        return found

    def remove(self, job: Job) -> None:
        """Remove a job and its files, and end the work on it."""
        self._jobs.pop(job.id, None)
        if job.order is not None:
            job.order.cancel()
        shutil.rmtree(job.folder, ignore_errors=True)

    def finish(self, job: Job) -> None:
        """Mark a job as finished, whether done or failed, and make room."""
        job.ended = job.used = time.monotonic()  # what has waited for long is not the first to go
        job.stage = job.order = None
        job.n_bytes = sum(path.stat().st_size for path in job.folder.iterdir()) if job.folder.is_dir() else 0
        job.finished.set()
        self.make_room()

    def make_room(self) -> None:
        """Remove finished jobs that are too old, and those unused for longest if all are too many or too large."""
        oldest_first = sorted((job for job in self._jobs.values() if job.finished.is_set()), key=lambda job: job.used)
        n_bytes = sum(job.n_bytes for job in oldest_first)
        earliest = time.monotonic() - 60.0 * self._settings.max_age_minutes
        for job in oldest_first:
            too_large = n_bytes > self._settings.max_stored_gb * 1e9 and job.n_bytes > 0
            if too_large or len(self._jobs) > MAX_JOBS or job.used < earliest:
                n_bytes -= job.n_bytes
                self.remove(job)

    @contextlib.contextmanager
    def upload_folder(self) -> Iterator[Path]:
        """Context with a folder for the files of an upload; at its end the folder is removed, unless it was moved."""
        folder = self.folder / f"{secrets.token_urlsafe(16)}.upload"
        folder.mkdir(mode=0o700)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def answer_folder(self, job: Job, name: str) -> Path:
        """A new folder for an answer about a job, with a hard link to the job's file `name`.

        The link keeps the file until the answer is sent, even if the job is removed in the meantime.
        """
        folder = self.folder / f"{secrets.token_urlsafe(16)}.answer"
        folder.mkdir(mode=0o700)
        os.link(job.folder / name, folder / name)
        return folder


def _private_folder(parent: Path) -> tuple[Path, int]:
    """A new folder that other users cannot read, and its open lock; folders of killed servers are removed.

    The lock is taken before the folder gets its final name, so that no other server mistakes it for one of a killed
    server.
    """
    for left in parent.glob(f"{_PREFIX}*"):
        _remove_if_left(left)
    new = Path(tempfile.mkdtemp(prefix=_NEW_PREFIX, dir=parent))
    lock = os.open(new / _LOCK, os.O_RDWR | os.O_CREAT, 0o600)
    if fcntl is not None:
        fcntl.flock(lock, fcntl.LOCK_EX)
    return new.rename(new.with_name(_PREFIX + new.name.removeprefix(_NEW_PREFIX))), lock


def _remove_if_left(folder: Path) -> None:
    """Remove the folder of another server, unless that server is running or the folder belongs to another user."""
    if fcntl is None or folder.is_symlink() or folder.stat().st_uid != os.getuid():
        return
    with contextlib.suppress(OSError):  # its server runs, or another one removes it, too
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_NOFOLLOW)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(lock)
