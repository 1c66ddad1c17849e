# SPDX-License-Identifier: Apache-2.0
"""Where a ray that left a delta surface really meets the next one.

Mitsuba's `spawn_ray` starts rays a little off a surface, along its normal: about 0.1 mm at 1 m. So an oblique ray runs
beside its true line, by a twentieth of a projector pixel or more, and mirrors and glass pass the error on. Starting
the ray on its line instead would have it miss faces beside edges. So the ray is left where it is, and the point where
it ends is put right.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

CLEARANCE = 0.1
"""Of Mitsuba's own: how far off a delta surface rays start, so that thin glass keeps its far face."""
GRAZING = 0.05
"""Cosine below which the correction would be worse than the error."""


def on_its_line(si: Any, origin: Any, direction: Any) -> Any:
    """The point where the line from `origin` meets the tangent plane of the surface met beside it, `si`."""
    slope = dr.dot(direction, si.n)
    along = dr.dot(si.p - origin, si.n) / slope
    return dr.select(dr.abs(slope) > GRAZING, mi.Point3f(origin + direction * along), si.p)


def spawn_close(si: Any, met: Any, direction: Any) -> Any:
    """The ray that leaves a delta surface close by; `met` is where the ray before met it, on the safe side of edges."""
    ray = si.spawn_ray(direction)
    ray.o = met + CLEARANCE * (ray.o - si.p)
    return ray
