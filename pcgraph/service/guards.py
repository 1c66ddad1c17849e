# SPDX-License-Identifier: Apache-2.0
"""Checks of every request before its operation: the host, and the size and duration of the body."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse

from pcgraph.service.problems import Problem
from pcgraph.service.settings import ServiceSettings

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

AT_ONCE_SECONDS = 0.05
"""Seconds within which the rest of a short upload arrives, if an answer did not need it. Chosen by eye; not varied."""
LINGER_SECONDS = 10.0
"""Seconds for which the rest of a long refused upload is received and dropped after the answer. If the connection were
closed at once, the client's system would drop the answer, too. Chosen by eye; not varied."""
LOCAL_NAMES = ("localhost", "127.0.0.1", "[::1]")
"""Names of this computer for itself, in the header Host."""


def problem_response(problem: Problem) -> JSONResponse:
    """The HTTP response for a problem."""
    return JSONResponse(problem.to_dict(), problem.status, problem.headers, "application/problem+json")


class Guards:
    """ASGI middleware that refuses foreign hosts, bodies that are too large, and bodies that arrive too slowly.

    Without a token, only requests to this computer's own names are answered. Otherwise a stranger's web page could
    reach the service through the user's browser, with a host name that points to 127.0.0.1 (DNS rebinding).
    """

    def __init__(self, app: ASGIApp, settings: ServiceSettings) -> None:
        self._app, self._settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        body = _Body(receive, self._settings, headers)

        async def send_all(message: Message) -> None:
            if message["type"] == "http.response.start":
                await body.drop(AT_ONCE_SECONDS)
                if not body.complete:
                    MutableHeaders(scope=message)["Connection"] = "close"
            elif not message.get("more_body", False) and not body.complete:
                await send({**message, "more_body": True})  # the client has the whole answer and may stop
                await body.drop(LINGER_SECONDS)
                message = {"type": "http.response.body"}
            await send(message)

        problem = self._refusal(headers)
        if problem is None:
            await self._app(scope, body.receive, send_all)
        else:
            await problem_response(problem)(scope, body.receive, send_all)

    def _refusal(self, headers: Headers) -> Problem | None:
        host, origin = headers.get("host", ""), headers.get("origin")
        name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
        if self._settings.token is None and name.lower() not in (*LOCAL_NAMES, self._settings.host.lower()):
            return Problem(
                400, f"expected a request to {', '.join(LOCAL_NAMES)}: give the service a token to use others"
            )
        if self._settings.token is None and origin is not None and origin.partition("://")[2] != host:
            return Problem(403, "expected no request from another web site's page: give the service a token for that")
        length = headers.get("content-length", "")
        if length.isdecimal() and int(length) > self._settings.max_upload_bytes:
            return _too_large(self._settings)
        return None


class _Body:
    """The body of a request, with limits on its size and on the time that it takes."""

    def __init__(self, receive: Receive, settings: ServiceSettings, headers: Headers) -> None:
        self._receive, self._settings = receive, settings
        self._deadline = time.monotonic() + settings.max_upload_seconds
        self._n_bytes = 0
        self.complete = "content-length" not in headers and "transfer-encoding" not in headers  # there is none
        self._unasked = headers.get("expect", "").lower() == "100-continue"
        """Whether the client waits for a go-ahead to send the body; the first call of `receive` gives it."""

    async def receive(self) -> Message:
        if self.complete:
            return await self._receive()  # waits for the client to hang up
        self._unasked = False
        try:
            async with asyncio.timeout(max(0.0, self._deadline - time.monotonic())):
                message = await self._receive()
        except TimeoutError:
            raise Problem(
                408, f"expected the upload within {self._settings.max_upload_seconds:g} s: send it faster, or less"
            ) from None
        self._n_bytes += len(message.get("body", b""))
        self.complete = not message.get("more_body", False)
        if self._n_bytes > self._settings.max_upload_bytes:
            raise _too_large(self._settings)
        return message

    async def drop(self, seconds: float) -> None:
        """Receive and drop the rest of the body, at most for some seconds."""
        if self._unasked:
            return
        try:
            async with asyncio.timeout(seconds):
                while not self.complete:
                    self.complete = not (await self._receive()).get("more_body", False)
        except TimeoutError:
            return


def _too_large(settings: ServiceSettings) -> Problem:
    return Problem(413, f"expected an upload of at most {settings.max_upload_mb:g} MB: send fewer points")
