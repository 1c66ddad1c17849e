# SPDX-License-Identifier: Apache-2.0
"""The operations of the service. Only `create_app` imports this module, because it needs FastAPI."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, FastAPI, Query, Request, Response
from fastapi import Path as PathParameter
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match, Route
from starlette.types import Scope

from pcgraph import __version__
from pcgraph.service.guards import Guards, problem_response
from pcgraph.service.jobs import SAVED, AnswerFile, Service
from pcgraph.service.models import (
    LABEL_FORMATS,
    BoxesModel,
    CutQuery,
    Health,
    LabelQuery,
    LabelsModel,
    ObjectsModel,
    Points,
    ProblemModel,
    SegmentationModel,
    SegmentParameters,
    TreeModel,
    UploadQuery,
    Wait,
    did_you_mean,
)
from pcgraph.service.problems import Problem
from pcgraph.service.settings import ServiceSettings
from pcgraph.service.store import Job
from pcgraph.service.uploads import FILE_FIELD, METADATA_FIELD, receive_upload, said

VIEW_POLICY = "sandbox allow-scripts allow-downloads"
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
"""Meaning of each status of a problem."""


def _declared(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Declarations for OpenAPI of the problems of an operation."""
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


# ---- Operations ----------------------------------------------------------------------------------------------------

_UPLOAD = {
    "requestBody": {
        "required": True,
        "description": "A form with the file in the field `cloud`; or the file itself, with its name in the query; or "
        "a small cloud as JSON. Every format that `pcgraph.read_cloud` reads is taken, .npz with arrays too.",
        "content": {
            "application/json": {
                "schema": {"$ref": "#/components/schemas/Points"},
                "example": {"points": [[0.1 * x, 0.1 * y, 2.0] for y in range(6) for x in range(6)]},
            },
            "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": [FILE_FIELD],
                    "properties": {
                        FILE_FIELD: {
                            "type": "string",
                            "format": "binary",
                            "description": "The file; the suffix of its name tells the format.",
                        },
                        METADATA_FIELD: {
                            "type": "string",
                            "format": "binary",
                            "description": "A second file, if the format needs one: the metadata of an Ouster "
                            "recording.",
                        },
                        **SegmentParameters.model_json_schema()["properties"],
                    },
                    "additionalProperties": False,
                }
            },
        },
    }
}
"""Description of an upload's body for OpenAPI; the parameters of the query may also be fields of a form."""


_LOCATION = {"Location": {"description": "Path of the segmentation.", "schema": {"type": "string"}}}
_OF_ID = {"segmentation_id": "$response.body#/id"}
_LINKS = {
    name: {"operationId": name, "parameters": _OF_ID}
    for name in ("state", "labels", "boxes", "objects", "tree", "view", "file", "remove")
}
"""Operations on a segmentation, as links for OpenAPI."""


def _service(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


Here = Annotated[Service, Depends(_service)]
Id = Annotated[str, PathParameter(min_length=1, max_length=64, description="Its id, as the upload's answer says.")]
open_router = APIRouter()
"""Operations without a token."""
router = APIRouter()
"""Operations that need the token, if there is one."""


@open_router.get("/health", operation_id="health", responses=_declared())
async def health(service: Here) -> Health:
    """State of the service. It needs no token, and answers only after the kernels are compiled."""
    pools = (service.segmenting, service.answering)
    return Health(
        ready=all(pool.n_ready for pool in pools),
        version=__version__,
        workers=sum(pool.n_ready for pool in pools),
        queued=service.segmenting.n_waiting,
        segmentations=len(service.store),
    )


@router.post(
    "/segmentations",
    operation_id="segment",
    status_code=201,
    response_model=SegmentationModel,
    responses={
        201: {"description": "The cloud is segmented.", "headers": _LOCATION, "links": _LINKS},
        202: {
            "model": SegmentationModel,
            "description": "The cloud waits or is being segmented: ask at `Location`.",
            "headers": _LOCATION,
            "links": _LINKS,
        },
        **_declared(415, 500, 503, 504),
    },
    openapi_extra=_UPLOAD,
)
async def segment(request: Request, service: Here, query: Annotated[UploadQuery, Query()]) -> Response:
    """Segment a cloud.

    The answer comes when the segmentation is done, or after `wait` seconds if that is earlier. If a client hangs up
    before the answer, its segmentation is ended, because it has no id.
    """
    with service.upload_slot(), service.store.upload_folder() as folder:
        upload = await receive_upload(request, query, folder)
        job = service.begin(upload, folder)
    try:
        if not await _finished(job, upload.parameters.wait, request):
            service.store.remove(job)
    except asyncio.CancelledError:
        service.store.remove(job)
        raise
    if job.problem is not None:
        service.store.remove(job)
        raise job.problem
    model = service.model(job, request.scope.get("root_path", ""))
    location = {"Location": model.links["self"]}
    return JSONResponse(model.model_dump(mode="json"), 201 if model.state == "done" else 202, location)


async def _finished(job: Job, seconds: float, request: Request) -> bool:
    """Wait until a job has finished, at most for some seconds; False if the client hangs up."""
    finished = asyncio.create_task(job.finished.wait())
    hung_up = asyncio.create_task(_hung_up(request))
    try:
        await asyncio.wait({finished, hung_up}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        return not hung_up.done()
    finally:
        finished.cancel()
        hung_up.cancel()


async def _hung_up(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


@router.get(
    "/segmentations/{segmentation_id}", operation_id="state", responses=_declared(404), response_model=SegmentationModel
)
async def state(request: Request, service: Here, segmentation_id: Id, wait: Annotated[Wait, Query()] = 0.0) -> Any:
    """State of a segmentation, and its summary if it is done.

    With `wait`, the answer comes when the segmentation is done, or after `wait` seconds if that is earlier.
    """
    job = service.store.job(segmentation_id)
    await _finished(job, wait, request)
    return service.model(job, request.scope.get("root_path", ""))


@router.delete("/segmentations/{segmentation_id}", operation_id="remove", status_code=204, responses=_declared(404))
async def remove(service: Here, segmentation_id: Id) -> None:
    """Remove a segmentation; if it is not done, end it first."""
    service.store.remove(service.store.job(segmentation_id))


@router.get(
    "/segmentations/{segmentation_id}/labels",
    operation_id="labels",
    response_class=FileResponse,
    responses={
        200: {
            "description": "The labels, in the format that was asked for.",
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
                "application/json": {"schema": {"$ref": "#/components/schemas/LabelsModel"}},
            },
        },
        **_declared(404, 409, 500, 503, 504),
    },
)
async def labels(service: Here, segmentation_id: Id, query: Annotated[LabelQuery, Query()]) -> FileResponse:
    """Labels of the points: the objects, or a cut of the tree at any level; nothing is segmented again.

    `n` is a number of segments, and `altitude` a level of the tree. Without both, the labels are the objects.
    """
    if query.format not in LABEL_FORMATS:
        hint = did_you_mean(query.format, list(LABEL_FORMATS))
        raise Problem(422, f"expected format as one of {', '.join(LABEL_FORMATS)}, got {query.format[:80]!r}{hint}")
    _check_cut(query)
    media_type = "application/json" if query.format == "json" else "application/octet-stream"
    arguments = query.model_dump(exclude={"format"})
    return await service.answer(segmentation_id, "write_labels", media_type, file_format=query.format, **arguments)


def _check_cut(query: CutQuery) -> None:
    if query.n is not None and query.altitude is not None:
        raise Problem(422, "expected n or altitude, got both: choose one")


@router.get(
    "/segmentations/{segmentation_id}/boxes",
    operation_id="boxes",
    response_model=BoxesModel,
    responses=_declared(404, 409, 500, 503, 504),
)
async def boxes(service: Here, segmentation_id: Id, query: Annotated[CutQuery, Query()]) -> Response:
    """Oriented boxes around the objects, or around the segments of a cut at any level."""
    _check_cut(query)
    return await service.answer(segmentation_id, "write_boxes", "application/json", **query.model_dump())


@router.get(
    "/segmentations/{segmentation_id}/objects",
    operation_id="objects",
    response_model=ObjectsModel,
    responses=_declared(404, 409, 500, 503, 504),
)
async def objects(service: Here, segmentation_id: Id) -> Response:
    """Objects on the largest horizontal plane, with boxes and shapes, as `pcgraph.detection.objects_on` finds them."""
    return await service.answer(segmentation_id, "write_objects", "application/json")


@router.get(
    "/segmentations/{segmentation_id}/tree",
    operation_id="tree",
    response_model=TreeModel,
    responses=_declared(404, 409, 500, 503, 504),
)
async def tree(service: Here, segmentation_id: Id) -> Response:
    """The segmentation tree: parents, altitudes and sizes of its nodes."""
    return await service.answer(segmentation_id, "write_tree", "application/json")


@router.get(
    "/segmentations/{segmentation_id}/view",
    operation_id="view",
    response_class=HTMLResponse,
    responses=_declared(404, 409, 500, 503, 504),
)
async def view(service: Here, segmentation_id: Id) -> Response:
    """The viewer: one HTML page that works offline."""
    title = service.done(segmentation_id).title
    page = await service.answer(segmentation_id, "write_view", "text/html", title=title)
    page.headers["Content-Disposition"] = "inline"
    page.headers["Content-Security-Policy"] = VIEW_POLICY
    return page


@router.get(
    f"/segmentations/{{segmentation_id}}/{SAVED}",
    operation_id="file",
    response_class=FileResponse,
    responses={
        200: {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}},
        **_declared(404, 409),
    },
)
async def file(service: Here, segmentation_id: Id) -> Response:
    """The saved segmentation with its cloud, for `pcgraph.load_segmentation`."""
    job = service.done(segmentation_id)
    path = service.store.answer_folder(job, SAVED) / SAVED
    return AnswerFile(path, media_type="application/octet-stream", filename=f"{Path(job.title).stem}.{SAVED}")


# ---- The application -----------------------------------------------------------------------------------------------


def application(settings: ServiceSettings) -> FastAPI:
    """The service as an ASGI application; see `pcgraph.service.create_app`."""

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.state.service = Service(settings)
        async with app.state.service.running():
            yield

    app = FastAPI(
        title="pcgraph",
        version=__version__,
        description="Segments point clouds: objects, parts, supervoxels, the graph and the tree between them.",
        lifespan=lifespan,
        redirect_slashes=False,
        docs_url=None,  # FastAPI's pages load their scripts from another web site
        redoc_url=None,
    )
    app.add_middleware(Guards, settings=settings)
    for kind, respond in _RESPONDERS.items():
        app.add_exception_handler(kind, respond)
    app.include_router(open_router)
    app.include_router(router, dependencies=[] if settings.token is None else [Depends(_check_token)])
    _describe(app)
    return app


def _check_token(
    service: Here, given: Annotated[HTTPAuthorizationCredentials | None, Depends(HTTPBearer(auto_error=False))]
) -> None:
    """Raise a 401 unless the request has the token; the time of the comparison does not depend on the token."""
    token = service.settings.token or ""
    if given is None or not hmac.compare_digest(given.credentials.encode(), token.encode()):
        raise Problem(
            401,
            "expected the token of the service in the header: Authorization: Bearer TOKEN",
            {"WWW-Authenticate": "Bearer"},
        )


async def _of_problem(request: Request, error: Exception) -> Response:
    assert isinstance(error, Problem)
    return problem_response(error)


async def _of_validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    known = UploadQuery if request.method == "POST" else LabelQuery  # the operations that refuse unknown names
    return problem_response(Problem(422, said(error.errors(), list(known.model_fields))))


async def _of_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    detail, headers = f"{error.detail}: {request.method} {request.url.path[:200]}", dict(error.headers or {})
    if error.status_code == 405:
        headers["Allow"] = ", ".join(sorted(_methods(request.scope)))
    return problem_response(Problem(error.status_code, detail, headers))


def _methods(scope: Scope) -> set[str]:
    """Methods of a path. FastAPI has one route for each method, and its own header `Allow` names only the first."""
    routes = [route for one in (open_router, router) for route in one.routes if isinstance(route, Route)]
    return {m for route in routes if route.matches(scope)[0] != Match.NONE for m in route.methods or ()}


async def _of_disconnect(request: Request, error: Exception) -> Response:
    return problem_response(Problem(400, "the upload was cut off"))  # nobody hears it


async def _of_bug(request: Request, error: Exception) -> Response:
    return problem_response(Problem(500, "the service failed at this request; its log says where"))  # uvicorn logs it


_RESPONDERS = {
    Problem: _of_problem,
    RequestValidationError: _of_validation,
    HTTPException: _of_http,
    ClientDisconnect: _of_disconnect,
    Exception: _of_bug,
}
"""Functions that answer exceptions with a problem, by class."""


def _describe(app: FastAPI) -> None:
    """Add the schemas to the OpenAPI document that FastAPI does not find in the operations."""
    document = app.openapi()
    schemas = document["components"]["schemas"]
    for model in (ProblemModel, Points, LabelsModel):
        schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
        schemas[model.__name__] = schema
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
