# SPDX-License-Identifier: Apache-2.0
"""Uploads: the cloud of a request is written to a file, whether the body is a file, a form with a file, or JSON."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fastapi import Request
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException

from pcgraph.service.models import MAX_NAME, Points, SegmentParameters, UploadQuery, did_you_mean
from pcgraph.service.problems import Problem

FILE_FIELD = "cloud"
"""Field of a form that holds the file, and the file's name while it is here."""
METADATA_FIELD = "metadata"
"""Field of a form that holds a second file, which some formats need: the metadata of an Ouster recording."""
METADATA_FILE = f"{FILE_FIELD}.json"
"""Name of that file while it is here: such formats look for it beside the first."""
RAW_TYPES = ("", "application/octet-stream", "application/x-www-form-urlencoded")
"""Content types of a body that is the file itself; the last one is the default of ``curl --data-binary``."""
MAX_JSON_BYTES = 1 << 20
"""Largest cloud in JSON, bytes, some 20 000 points, because the server process itself checks it. Chosen by eye; not
varied."""
MAX_FIELDS = 200
"""Largest count of fields in a form: every parameter once, and lists of columns. Chosen by eye; not varied."""


@dataclass(frozen=True)
class Upload:
    """A received upload.

    Attributes
    ----------
    name : str, or None
        The client's name of the file; None for a cloud in JSON.
    parameters : SegmentParameters
    """

    name: str | None
    parameters: SegmentParameters


async def receive_upload(request: Request, query: UploadQuery, folder: Path) -> Upload:
    """Write the cloud of a request to a file in a folder, and collect its parameters.

    Raises
    ------
    Problem
        The body has an unknown content type, or the form is damaged or has unknown fields.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    parameters = SegmentParameters(**query.model_dump(exclude={"name"}, exclude_unset=True))
    if kind == "multipart/form-data":
        return await _receive_form(request, parameters, folder)
    if kind != "application/json" and kind not in RAW_TYPES:
        raise Problem(
            415, f"expected multipart/form-data, application/octet-stream or application/json, got {kind[:80]}"
        )
    if kind != "application/json" and query.name is None:
        raise Problem(
            422, "expected the name of the file in the query, such as ?name=scan.laz: its suffix tells the format"
        )
    if kind == "application/json":
        (folder / FILE_FIELD).write_bytes(await _checked_json(request))
        return Upload(None, parameters)
    with (folder / FILE_FIELD).open("wb") as file:
        async for block in request.stream():
            await run_in_threadpool(file.write, block)
    return Upload(query.name, parameters)


async def _checked_json(request: Request) -> bytes:
    content = bytearray()
    async for block in request.stream():
        content += block
        if len(content) > MAX_JSON_BYTES:
            raise Problem(413, f"expected at most {MAX_JSON_BYTES} bytes of JSON: send a file, or NPZ with arrays")
    try:
        Points.model_validate_json(bytes(content))
    except ValidationError as error:
        raise Problem(422, said(error.errors(), list(Points.model_fields))) from None
    return bytes(content)


async def _receive_form(request: Request, parameters: SegmentParameters, folder: Path) -> Upload:
    try:
        async with request.form(max_files=2, max_fields=MAX_FIELDS) as form:  # removes its temporary files at the end
            file = form.get(FILE_FIELD)
            if not isinstance(file, UploadFile) or not file.filename:
                raise Problem(
                    422, f"expected a form with a file in the field {FILE_FIELD!r} that has a name, such as scan.laz"
                )
            fields = [(name, value) for name, value in form.multi_items() if value is not file]
            if isinstance(metadata := form.get(METADATA_FIELD), UploadFile):
                fields = [(name, value) for name, value in fields if value is not metadata]
                await _copy(metadata, folder / METADATA_FILE)
            parameters = with_fields(parameters, fields)
            await _copy(file, folder / FILE_FIELD)
            return Upload(file.filename[-MAX_NAME:], parameters)
    except HTTPException as error:  # as which Starlette raises what its parser says
        raise Problem(400, f"expected a whole form of type multipart/form-data: {error.detail}") from None


async def _copy(file: UploadFile, target: Path) -> None:
    with target.open("wb") as copy:
        await run_in_threadpool(shutil.copyfileobj, file.file, copy)


def with_fields(parameters: SegmentParameters, fields: list[tuple[str, Any]]) -> SegmentParameters:
    """The parameters, replaced by those in the fields of a form."""
    given: dict[str, Any] = {}
    for name, value in fields:
        is_list = name in ("viewpoint", "features", "columns")
        given[name] = [*given.get(name, []), value] if is_list else value
    try:
        read = SegmentParameters(**given)
    except ValidationError as error:
        raise Problem(422, said(error.errors(), list(SegmentParameters.model_fields))) from None
    return parameters.model_copy(update=read.model_dump(exclude_unset=True))


def said(errors: Any, known: list[str]) -> str:
    """One sentence about the first error that pydantic found; `known` are the names of the parameters."""
    first = errors[0]
    name = next((part for part in reversed(first["loc"]) if isinstance(part, str)), "body")
    if first["type"] == "extra_forbidden":
        return f"there is no parameter {name[:80]!r}{did_you_mean(name, known) or ': there are ' + ', '.join(known)}"
    if first["type"] == "value_error":  # one of our own sentences
        return f"{name}: {first['ctx']['error']}"
    return f"{name}: {first['msg'][:1].lower()}{first['msg'][1:]}, got {str(first.get('input'))[:80]!r}"
