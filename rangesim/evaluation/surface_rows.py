# SPDX-License-Identifier: Apache-2.0
"""Rows of statistics, one for each surface of the ground truth: objects, their parts, material classes, and all."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rangesim.settings.config import nearest, shown
from rangesim.signals import ALL

OBJECTS, OBJECT, PART, MATERIAL = "objects", "object", "part", "material"
"""Kinds of rows besides "all": the mean over objects, one object, one shape of an object that has several, one material
class."""
KINDS = (OBJECTS, OBJECT, PART, MATERIAL, ALL)
"""Kinds of rows in the order of every table."""


def with_mean_over_objects(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, and before them their mean over the objects, in which every object weighs the same.

    Counts are added up. Every other value is the mean over the objects for which it is known, and so does not depend
    on how many pixels an object has. Without objects, no row is added.

    Parameters
    ----------
    rows : dicts with `kind` and `name`; the other values are whole numbers, numbers (None or NaN where they are not
        known), and mappings of names to fractions, in which a name that is left out stands for 0.
    """
    objects = [row for row in rows if row["kind"] == OBJECT]
    if not objects:
        return list(rows)
    keys = [key for key in objects[0] if key not in ("kind", "name")]
    mean = {key: _mean([row[key] for row in objects]) for key in keys}
    return [{"kind": OBJECTS, "name": OBJECTS, **mean}, *rows]


def _mean(values: Sequence[Any]) -> Any:
    """Mean of a value over objects; the sum of counts."""
    if isinstance(values[0], Mapping):
        total = {name: sum(each.get(name, 0.0) for each in values) / len(values) for each in values for name in each}
        return dict(sorted(total.items(), key=lambda item: -item[1]))
    if all(isinstance(value, int) for value in values):
        return sum(values)
    known = [value for value in values if value is not None and not math.isnan(value)]
    return math.fsum(known) / len(known) if known else values[0]


def index_of_row(keys: Iterable[tuple[str, str]], name: str, kind: str | None) -> int:
    """Index of the row of this name among rows of these kinds and names.

    Raises
    ------
    ValueError
        No row has this name, or rows of several kinds have it and `kind` does not say which.
    """
    keys = list(keys)
    found = [i for i, key in enumerate(keys) if key[1] == name and kind in (None, key[0])]
    if len(found) > 1:
        kinds = " or ".join(repr(keys[i][0]) for i in found)
        raise ValueError(f"expected the kind of row {shown(name)}, {kinds}, got none.")
    if not found:
        of_kind = "" if kind is None else f" of the kind {shown(kind)}"
        names = [key[1] for key in keys if kind in (None, key[0])]
        listed = ", ".join(names) or "none"
        raise ValueError(f"expected a row{of_kind} out of {listed}, got {shown(name)}{nearest(name, names)}.")
    return found[0]
