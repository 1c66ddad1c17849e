# SPDX-License-Identifier: Apache-2.0
"""Errors of the service, which all have the same form of JSON: that of RFC 9457."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any


class Problem(Exception):
    """An error as the answer to a request.

    Attributes
    ----------
    status : int
        HTTP status.
    detail : str
        One sentence for the user: what was expected, what came, what to do. It names no path of the server.
    headers : mapping, optional
        Further headers of the answer.
    """

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.headers = status, detail, dict(headers or {})

    def to_dict(self) -> dict[str, Any]:
        """Title, status and detail: the body of the answer."""
        return {"title": HTTPStatus(self.status).phrase, "status": self.status, "detail": self.detail}


def busy(detail: str, seconds: int) -> Problem:
    """Problem of a server that is too busy; the client may ask again after some seconds."""
    return Problem(503, detail, {"Retry-After": str(seconds)})
