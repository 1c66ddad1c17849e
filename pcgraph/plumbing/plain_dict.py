# SPDX-License-Identifier: Apache-2.0
"""Results as dictionaries of plain values, which every JSON reader takes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np


class PlainDict:
    """A mixin for dataclasses: `to_dict` gives their attributes as plain values.

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
        """The attributes by name, in their units, as ``json.dumps(..., allow_nan=False)`` takes them.

        Arrays are nested lists. A number that is not finite is None.
        """
        return {field.name: plain(getattr(self, field.name)) for field in dataclasses.fields(self)}  # type: ignore[arg-type]


def plain(value: Any) -> Any:
    """A value, and all within it, as Python's own numbers, text, lists and dictionaries; None where not finite."""
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
