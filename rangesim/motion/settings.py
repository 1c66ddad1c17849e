# SPDX-License-Identifier: Apache-2.0
"""Motion as plain data, as in experiment files; `rangesim.settings.config.to_dict` writes it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rangesim.motion.track import Motion, Track
from rangesim.settings.config import check_keys, from_dict, shown


def motion_from_dict(data: Any, place: str = "motion") -> Motion:
    """The motion of a table `objects`, a track for each shape name, and a track `rig`; both may be left out.

    A track is a table with a `type`: "constant-twist" (`ConstantTwist`) or "poses" (`PoseTrack`).

    Raises
    ------
    ValueError
        Unknown keys or kinds of track, or values that a track refuses; the message names the place.
    """
    if not isinstance(data, Mapping) or not isinstance(data.get("objects", {}), Mapping):
        raise ValueError(f"{place}: expected a table of settings, got {shown(data)}.")
    check_keys(data, ("objects", "rig"), place)
    objects = {name: _track(table, f"{place}.objects.{name}") for name, table in data.get("objects", {}).items()}
    rig = data.get("rig")
    return Motion(objects, None if rig is None else _track(rig, f"{place}.rig"))


def _track(table: Any, place: str) -> Track:
    return from_dict(Track, table, place)  # type: ignore[type-abstract]
