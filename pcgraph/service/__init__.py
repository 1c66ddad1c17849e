# SPDX-License-Identifier: Apache-2.0
"""The HTTP service of `pcgraph serve`: it segments clouds, and answers with cuts, objects and views (docs/service.md).

The server process handles HTTP only. Worker processes read clouds, segment them and write the answers to files. So a
cloud that crashes a parser, hangs, or needs too much memory ends one worker and nothing else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pcgraph.errors import PcgraphError

if TYPE_CHECKING:
    from fastapi import FastAPI

    from pcgraph.service.settings import ServiceSettings

__all__ = ["create_app"]


def create_app(settings: ServiceSettings | None = None) -> FastAPI:
    """The service as an ASGI application, for one process of uvicorn or another server.

    Its lifespan starts the worker processes, which compile the kernels first, and ends them.

    Parameters
    ----------
    settings : ServiceSettings, optional
        Limits, token, number of workers. Default: `ServiceSettings()`.

    Raises
    ------
    PcgraphError
        FastAPI, uvicorn or python-multipart is missing.
    ValueError
        The settings allow a host that is not loopback without a token.
    """
    from pcgraph.service.settings import ServiceSettings

    try:
        import fastapi  # noqa: F401
        import python_multipart  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError as error:
        raise PcgraphError(
            f"the service needs FastAPI, uvicorn and python-multipart, but {error.name} is missing: "
            "pip install rangesim[serve]"
        ) from None
    from pcgraph.service.app import application

    return application(ServiceSettings() if settings is None else settings)
