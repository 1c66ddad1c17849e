# SPDX-License-Identifier: Apache-2.0
"""The HTTP server of the service: uvicorn, with a time limit for the headers of a request."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from pcgraph.service.settings import ServiceSettings

if TYPE_CHECKING:
    from fastapi import FastAPI

HEADER_SECONDS = 10.0
"""Seconds within which the headers of a request must arrive, else the connection is closed. Chosen by eye; not
varied."""
KEEP_ALIVE_SECONDS = 65
"""Seconds for which an idle connection is kept: longer than clients keep it (httpx 5 s, nginx 60 s), because a request
that arrives while the server closes the connection is lost."""
GRACE_SECONDS = 5
"""Seconds for answers that are being sent when the server ends. Chosen by eye; not varied."""
MAX_CONNECTIONS = 1000
"""Largest count of connections at a time, because each takes a file descriptor, and most systems give a process
1024."""


class ImpatientProtocol(H11Protocol):  # type: ignore[misc]
    """HTTP/1.1 on one connection, closed if the headers of a request take too long."""

    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self._timer is not None:
            self._timer.cancel()

    def _watch(self) -> None:
        """Start the timer if a request is expected, and stop it as soon as the headers have arrived."""
        expected = self.cycle is None or self.cycle.response_complete
        if not expected and self._timer is not None:
            self._timer.cancel()
            self._timer = None
        elif expected and self._timer is None:
            self._timer = self.loop.call_later(HEADER_SECONDS, self.transport.close)


def run(app: FastAPI, settings: ServiceSettings, on_ready: Callable[[str], None]) -> int:
    """Serve until a signal comes; returns the exit status.

    Parameters
    ----------
    app : FastAPI
    settings : ServiceSettings
    on_ready : callable
        Called with the address as soon as requests are accepted.
    """
    server = _Server(
        uvicorn.Config(
            app,
            host=settings.host,
            port=settings.port,
            http=ImpatientProtocol,
            ws="none",
            lifespan="on",
            loop="asyncio",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            limit_concurrency=MAX_CONNECTIONS,
            timeout_keep_alive=KEEP_ALIVE_SECONDS,
            timeout_graceful_shutdown=GRACE_SECONDS,
        ),
        on_ready,
    )
    server.run()
    return 0 if server.started else 1


class _Server(uvicorn.Server):  # type: ignore[misc]
    def __init__(self, config: uvicorn.Config, on_ready: Callable[[str], None]) -> None:
        super().__init__(config)
        self._on_ready = on_ready

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        super().handle_exit(sig, frame)
        if not self.started:  # it compiles kernels, for which uvicorn would wait
            logging.getLogger("uvicorn.error").disabled = True  # what is said of the unfinished start is no news
            raise SystemExit(128 + sig)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            host, port, *_ = self.servers[0].sockets[0].getsockname()
            self._on_ready(f"http://{f'[{host}]' if ':' in host else host}:{port}")
