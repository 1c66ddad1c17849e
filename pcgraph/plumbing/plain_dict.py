# SPDX-License-Identifier: Apache-2.0
"""Results as dictionaries of plain values, which any JSON reader accepts."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np


class PlainDict:
    """Mixin for dataclasses; `to_dict` returns their attributes as plain values.

    Examples
    --------
    >>> @dataclasses.dataclass
    ... class Ball(PlainDict):
    ...     center: np.ndarray
    ...     radius: float
    >>> Ball(np.array([0.5, np.nan]), np.inf).to_dict()
    {'center': [0.5, None], 'radius': None}
    """

    def to_dict(self) -> dict[str, Any]:
        """The attributes by name, in their units, for ``json.dumps(..., allow_nan=False)``.

        Arrays become nested lists. A number that is not finite becomes None.
        """
        return {field.name: plain(getattr(self, field.name)) for field in dataclasses.fields(self)}  # type: ignore[arg-type]


def plain(value: Any) -> Any:
    """The value as Python's own numbers, strings, lists and dictionaries; numbers that are not finite become None."""
    if isinstance(value, PlainDict):
        return value.to_dict()
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (float, np.generic, np.ndarray)):
        array = np.asarray(value)
        if array.dtype.kind != "f" or np.isfinite(array).all():
            return array.tolist()
        numbers = array.astype(object)
        numbers[~np.isfinite(array)] = None
        return numbers.tolist()
    return value
