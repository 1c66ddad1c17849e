# SPDX-License-Identifier: Apache-2.0
"""Orders of frames: which of the frames that a code knows were shown, and in which order."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fnmatch import fnmatchcase

from rangesim.settings.config import nearest, shown

_REVERSED = re.compile(r"reversed\((.*)\)")
"""An entry whose frames come in reverse order."""


def in_order(names: list[str], order: Iterable[str]) -> list[str]:
    """The names of the frames that were shown, in the order in which they were shown.

    Parameters
    ----------
    names : all frames that the code knows, in its own order.
    order : entries such as "white", "columns_bit*" or "reversed(rows_bit*)". An entry stands for all names that match
        it and that no earlier entry has taken, in the code's own order, or in reverse. No entry at all: `names`.
        Frames that match no entry were not shown.

    Raises
    ------
    ValueError
        An entry that matches no name, or only names that earlier entries have taken.

    Examples
    --------
    >>> names = ["columns_bit1", "columns_bit1_inverse", "columns_bit0", "columns_bit0_inverse", "white", "black"]
    >>> in_order(names, ["white", "black", "columns_bit?"])
    ['white', 'black', 'columns_bit1', 'columns_bit0']
    >>> in_order(names, ["reversed(columns_bit?)"])
    ['columns_bit0', 'columns_bit1']
    """
    entries = tuple(order)
    if not entries:
        return list(names)
    result: list[str] = []
    taken: set[str] = set()
    for entry in entries:
        backwards = _REVERSED.fullmatch(entry)
        pattern = backwards[1] if backwards else entry
        matching = [name for name in names if fnmatchcase(name, pattern)]
        found = [name for name in matching if name not in taken]
        if not found:
            reason = "an earlier entry has taken them" if matching else f"there are {', '.join(names)}"
            raise ValueError(f"expected frames that match {shown(entry)}{nearest(entry, names)}: {reason}.")
        result += reversed(found) if backwards else found
        taken.update(found)
    return result
