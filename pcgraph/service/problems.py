# SPDX-License-Identifier: Apache-2.0
"""Errors of the service: one shape of JSON for all of them, as RFC 9457 has it."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any


class Problem(Exception):
    """An answer other than the one that was asked for.

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
        """Title, status and detail, the body of the answer."""
        return {"title": HTTPStatus(self.status).phrase, "status": self.status, "detail": self.detail}


def busy(detail: str, seconds: int) -> Problem:
    """Problem of a server that has too much to do; the client may ask again after some seconds."""
    return Problem(503, detail, {"Retry-After": str(seconds)})
