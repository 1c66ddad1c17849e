# SPDX-License-Identifier: Apache-2.0
"""What a worker process does with one item."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable
from typing import Any, NamedTuple


class Reply(NamedTuple):
    """What a worker process says of an item.

    content : the result; None if the item failed. error : one line about the failure, else empty. traceback : of the
    exception. seconds : that the item took. process : identifier of the process, unique on its host.
    """

    content: bytes | None
    error: str
    traceback: str
    seconds: float
    process: int


_function: tuple[bytes, Callable[[Any], Any]] | None = None
"""The function that this process carries out, with its pickle: a function that came by value keeps its globals, and so
what it has cached."""


def carry_out_item(function: bytes, argument: bytes) -> Reply:
    """Call the pickled function with the pickled argument, and return its result or its error."""
    import pickle

    global _function
    start = time.monotonic()
    content, error, trace = None, "", ""
    try:
        if _function is None or _function[0] != function:
            _function = function, pickle.loads(function)
        result = _function[1](pickle.loads(argument))
        if isinstance(result, bytes):
            content = result
        else:
            error = f"expected bytes of the function, got {type(result).__name__}"
    except BaseException as problem:  # noqa: BLE001  # an item that calls sys.exit has failed, too
        error = f"{type(problem).__name__}: {problem}"
        trace = "".join(traceback.format_exception(problem))
    return Reply(content, error, trace, time.monotonic() - start, os.getpid())
