# SPDX-License-Identifier: Apache-2.0
"""The operations of the service. FastAPI is imported here at the top: this file is loaded only by `create_app`."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.background import BackgroundTask
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from pcgraph import __version__
from pcgraph.service.guards import Guards, problem_response
from pcgraph.service.models import (
    LABEL_FORMATS,
    Health,
    LabelQuery,
    LabelsModel,
    ObjectsModel,
    Points,
    ProblemModel,
    SegmentationModel,
    SegmentParameters,
    UploadQuery,
    Wait,
    did_you_mean,
)
from pcgraph.service.problems import Problem, busy
from pcgraph.service.settings import ServiceSettings
from pcgraph.service.store import Job, Store
from pcgraph.service.tasks import SAVED
from pcgraph.service.uploads import FILE_FIELD, Upload, receive_upload, said
from pcgraph.service.worker_pool import RETRY_SECONDS, WorkerPool

_log = logging.getLogger("pcgraph.service")

JANITOR_SECONDS = 30.0
"""Time between two looks for segmentations that are too old. Chosen by eye; not varied."""
VIEW_POLICY = "sandbox allow-scripts"
"""Content-Security-Policy of the viewer page: its script, which shows names of strangers, cannot call the service."""
PROBLEMS = {
    400: "The request is damaged, or names a host that is not this computer.",
    401: "The token is missing or wrong.",
    403: "The request comes from another web site's page.",
    404: "There is no such segmentation.",
    405: "There is no such method here.",
    408: "The upload arrived too slowly.",
    409: "The segmentation is not done yet, or it failed.",
    413: "The cloud is too large.",
    415: "The body is of another type.",
    422: "The cloud or a parameter is not as expected.",
    500: "The worker process ended, or the service failed.",
    503: "Too many requests are waiting: try again after `Retry-After` seconds.",
    504: "The worker took too long.",
}
"""What each status of a problem means."""


class Service:
    """Workers and stored segmentations of one server."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.settings = settings
        self.store = Store(settings)
        self.segmenting = WorkerPool(settings.workers, settings)
        self.answering = WorkerPool(1, settings)
        self.n_uploads = 0

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Start the workers; at the end, end them and remove all files."""
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
        """One of the uploads that are received at a time."""
        if self.n_uploads >= self.settings.max_uploads:
            raise busy(f"{self.n_uploads} uploads arrive already: try again later", RETRY_SECONDS)
        self.n_uploads += 1
        try:
            yield
        finally:
            self.n_uploads -= 1

    def begin(self, upload: Upload, path: Path) -> Job:
        """A job that waits for a worker; Problem if too many wait."""
        job = self.store.new()
        job.title = Path(upload.name or "points").name
        path = path.rename(job.folder / "upload")
        task = {
            "task": "segment_upload",
            "upload": str(path),
            "name": upload.name,
            "folder": str(job.folder),
            "max_points": self.settings.max_points,
            **upload.parameters.model_dump(exclude={"wait"}),
        }
        try:
            job.order = self.segmenting.put(task, lambda words: _note(job, words))
        except Problem:
            self.store.remove(job)
            raise
        job.order.answer.add_done_callback(lambda answer: self._end(job, path, answer))
        return job

    def _end(self, job: Job, upload: Path, answer: asyncio.Future[dict[str, Any]]) -> None:
        if answer.cancelled():  # with the job, whose files are gone
            return
        upload.unlink(missing_ok=True)
        error = answer.exception()
        if isinstance(error, Problem):
            job.problem = error
        else:
            job.summary = answer.result()
        self.store.finish(job)

    async def answer(self, name: str, task: str, media_type: str, **arguments: Any) -> FileResponse:
        """A file that a worker writes about a finished segmentation."""
        job = self.done(name)
        folder = self.store.answer_folder(job, SAVED)
        try:
            order = self.answering.put(
                {"task": task, "segmentation_id": job.id, "folder": str(folder), **arguments}
            )
            try:
                written = await order.answer
            except asyncio.CancelledError:
                order.cancel()
                raise
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return _file(folder / written["file"], media_type, f"{Path(job.title).stem}.{written['file']}")

    def done(self, name: str) -> Job:
        """A job that is done; Problem if it is not, or failed."""
        job = self.store.job(name)
        if job.problem is not None:
            raise Problem(409, f"this segmentation failed: {job.problem.detail}")
        if job.summary is None:
            raise Problem(409, f"this segmentation is {job.state}: ask again later", {"Retry-After": str(RETRY_SECONDS)})
        return job

    def model(self, job: Job, root: str) -> SegmentationModel:
        """A job as clients see it."""
        own = f"{root}/segmentations/{job.id}"
        names = {"labels": "labels", "objects": "objects", "tree": "tree", "view": "view", "file": SAVED}
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
        job.began = asyncio.get_running_loop().time()
    job.stage = words


def _file(path: Path, media_type: str, name: str, headers: dict[str, str] | None = None) -> FileResponse:
    """An answer with a file of an answer's folder, which is removed after it."""
    remove = BackgroundTask(shutil.rmtree, path.parent, ignore_errors=True)
    return FileResponse(path, media_type=media_type, filename=name, headers=headers, background=remove)


def _declared(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Problems of an operation, as OpenAPI declares them."""
    schema = {"$ref": "#/components/schemas/ProblemModel"}
    return {
        status: {
            "description": PROBLEMS[status],
            "content": {
                "application/problem+json": {
                    "schema": schema,
                    "example": {**Problem(status, PROBLEMS[status]).to_dict()},
                }
            },
        }
        for status in (400, 401, 403, 408, 413, 422, *statuses)
    }
