# SPDX-License-Identifier: Apache-2.0
"""Jobs of the service: segmentations from the upload to the result, and the files that answer requests about them."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from starlette.responses import FileResponse
from starlette.types import Receive, Scope, Send

from pcgraph.service.models import ProblemModel, SegmentationModel
from pcgraph.service.problems import Problem, busy
from pcgraph.service.settings import ServiceSettings
from pcgraph.service.store import Job, Store
from pcgraph.service.uploads import FILE_FIELD, Upload
from pcgraph.service.worker_pool import RETRY_SECONDS, WorkerPool

SAVED = "segmentation.npz"
"""Name of the file of the saved segmentation in a job's folder."""
JANITOR_SECONDS = 30.0
"""Seconds between two checks for segmentations that are too old. Chosen by eye; not varied."""


class Service:
    """The workers and the stored segmentations of one server."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.settings = settings
        self.store = Store(settings)
        self.segmenting = WorkerPool(settings.workers, settings)
        self.answering = WorkerPool(1, settings)
        self.n_uploads = 0

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Context with running workers; at its end they are ended, and all files are removed."""
        janitor = asyncio.create_task(self._make_room())
        try:
            await self.segmenting.start()
            await self.answering.start()
            yield
        finally:
            janitor.cancel()
            await self.segmenting.stop()
            await self.answering.stop()
            self.store.close()

    async def _make_room(self) -> None:
        while True:
            await asyncio.sleep(JANITOR_SECONDS)
            self.store.make_room()

    @contextlib.contextmanager
    def upload_slot(self) -> Any:
        """Context of one upload that is being received; Problem if there are too many at the same time."""
        if self.n_uploads >= self.settings.max_uploads:
            raise busy(f"{self.n_uploads} uploads are being received already: try again later", RETRY_SECONDS)
        self.n_uploads += 1
        try:
            yield
        finally:
            self.n_uploads -= 1

    def begin(self, upload: Upload, folder: Path) -> Job:
        """A new job that waits for a worker, and takes over the folder of its upload; Problem if too many wait."""
        job = self.store.new()
        job.title = Path(upload.name or "points").name
        folder = folder.rename(job.folder / "upload")
        task = {
            "task": "segment_upload",
            "upload": str(folder / FILE_FIELD),
            "name": upload.name,
            "saved": str(job.folder / SAVED),
            "max_points": self.settings.max_points,
            **upload.parameters.model_dump(exclude={"wait"}),
        }
        try:
            job.order = self.segmenting.put(task, lambda words: _note(job, words))
        except Problem:
            self.store.remove(job)
            raise
        job.order.answer.add_done_callback(lambda answer: self._end(job, folder, answer))
        return job

    def _end(self, job: Job, upload: Path, answer: asyncio.Future[dict[str, Any]]) -> None:
        if answer.cancelled():  # with the job, whose files are gone
            return
        shutil.rmtree(upload, ignore_errors=True)
        error = answer.exception()
        if isinstance(error, Problem):
            job.problem = error
        else:
            job.summary = answer.result()
        self.store.finish(job)

    async def answer(self, name: str, task: str, media_type: str, **arguments: Any) -> FileResponse:
        """The file that a worker writes to answer a request about a finished segmentation."""
        job = self.done(name)
        folder = self.store.answer_folder(job, SAVED)
        try:
            order = self.answering.put(
                {"task": task, "segmentation_id": job.id, "saved": str(folder / SAVED), **arguments}
            )
            try:
                written = await order.answer
            except asyncio.CancelledError:
                order.cancel()
                raise
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        name = f"{Path(job.title).stem}.{written['file']}"
        return AnswerFile(folder / written["file"], media_type=media_type, filename=name)

    def done(self, name: str) -> Job:
        """The job of an id; Problem if it is not done, or failed."""
        job = self.store.job(name)
        if job.problem is not None:
            raise Problem(409, f"this segmentation failed: {job.problem.detail}")
        if job.summary is None:
            raise Problem(
                409, f"this segmentation is {job.state}: ask again later", {"Retry-After": str(RETRY_SECONDS)}
            )
        return job

    def model(self, job: Job, root: str) -> SegmentationModel:
        """A job as clients see it."""
        own = f"{root}/segmentations/{job.id}"
        names = {name: name for name in ("labels", "boxes", "objects", "tree", "view")} | {"file": SAVED}
        problem = None if job.problem is None else ProblemModel(**job.problem.to_dict())
        return SegmentationModel(
            id=job.id,
            state=job.state,  # type: ignore[arg-type]
            stage=job.stage,
            ahead=None if job.order is None else self.segmenting.position(job.order),
            seconds=round(job.seconds, 3),
            summary=job.summary,  # type: ignore[arg-type]
            problem=problem,
            links={"self": own, **{key: f"{own}/{end}" for key, end in names.items()}},
        )


def _note(job: Job, words: str) -> None:
    if job.began is None:
        job.began = time.monotonic()
    job.stage = words


class AnswerFile(FileResponse):
    """An answer with a file from an answer folder; the folder is removed after the answer, also after an error.

    The file is sent as a whole, because it is made for one request: a later request for a range would not find it.
    """

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope = {**scope, "headers": [pair for pair in scope["headers"] if pair[0] != b"range"]}
        del self.headers["Accept-Ranges"]
        try:
            await super().__call__(scope, receive, send)
        finally:
            shutil.rmtree(Path(self.path).parent, ignore_errors=True)
