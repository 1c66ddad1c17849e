# SPDX-License-Identifier: Apache-2.0
"""The causes of failed pixels, and a map of them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from rangesim.comparison import ALL
from rangesim.signals import GroundTruth


class Cause(IntEnum):
    """Why a pixel failed: it has no reading, or one that is off by more than the tolerance.

    The order is that of the families: geometry, material, light, electronics and sensor.
    """

    NONE = 0
    """Not failed: the reading is right, or there is no surface behind the pixel."""
    SHADOWED = 1
    """The projector does not see the surface: something stands between, or the point lies beside its image."""
    DEPTH_EDGE = 2
    """The pixel covers surfaces at different depths and reads a mixture, or codes that contradict each other."""
    MOTION = 3
    """The surface moved while the frames were taken."""
    SPECULAR_AWAY = 4
    """A mirror or a glossy surface sent the light elsewhere."""
    MIRRORED_GHOST = 5
    """The light of another surface, seen in a mirror or in a glossy one, was read."""
    SEEN_THROUGH = 6
    """The light went through a transparent surface; what was read, if anything, lies behind it or within."""
    MULTIPATH = 7
    """Light that came by way of further matte surfaces disturbed the reading."""
    CAUSTIC = 8
    """Light that reached the surface off a mirror or through glass, with the code of another direction, was read."""
    GLINT = 9
    """The detector saturated, or most of the light came straight from the lens of the projector."""
    LOW_SIGNAL = 10
    """Too little projector light for the detector's own noise."""
    AMBIENT = 11
    """Enough projector light, but the noise of the ambient light swamps it."""
    WRAPPED = 12
    """The distance lies beyond the unambiguous range, or the wrong period was picked (time of flight)."""
    RESOLUTION = 13
    """Neither light nor noise: code, bins or baseline are too coarse to tell this depth to the tolerance."""


TITLES = {
    Cause.NONE: "right",
    Cause.SHADOWED: "shadowed from projector",
    Cause.DEPTH_EDGE: "depth edge",
    Cause.MOTION: "motion",
    Cause.SPECULAR_AWAY: "specular away",
    Cause.MIRRORED_GHOST: "mirrored ghost",
    Cause.SEEN_THROUGH: "seen through transparent",
    Cause.MULTIPATH: "multipath",
    Cause.CAUSTIC: "caustic confusion",
    Cause.GLINT: "glint or saturated",
    Cause.LOW_SIGNAL: "low signal",
    Cause.AMBIENT: "ambient-swamped",
    Cause.WRAPPED: "wrapped",
    Cause.RESOLUTION: "too coarse",
}
"""Names for tables and legends."""


@dataclass(frozen=True, eq=False)
class CauseMap:
    """The cause of every failed pixel.

    cause : (h, w) uint8, values of `Cause`; `NONE` where the pixel did not fail.
    tolerance_m : float, metres; a reading failed if |z - true z| is larger.
    """

    cause: np.ndarray
    tolerance_m: float

    @property
    def failed(self) -> np.ndarray:
        """(h, w) bool: there is a surface, but no reading of it to the tolerance."""
        return np.asarray(self.cause != Cause.NONE)

    def shares(self, truth: GroundTruth) -> list[dict[str, Any]]:
        """Per material class of the first surface, "all" last: what failed, and why, as shares of its pixels.

        Each is a dict of `material` (str), `failed` (share of the pixels of this class; None if it has none) and
        `causes` (name of the cause -> share of the pixels of this class, largest first, none of them 0).
        """
        seen = np.isfinite(truth.z)
        classes = {name: seen & (truth.material == i) for i, name in enumerate(truth.material_names)}
        rows = [_row(name, self.cause[mask]) for name, mask in classes.items() if mask.any()]
        return [*rows, _row(ALL, self.cause[seen])]


def _row(material: str, causes: np.ndarray) -> dict[str, Any]:
    counts = np.bincount(causes, minlength=len(Cause))
    found = sorted((c for c in Cause if c and counts[c]), key=lambda c: -counts[c])
    shares = {c.name.lower(): float(counts[c] / causes.size) for c in found}
    return {"material": material, "failed": float(np.mean(causes > 0)) if causes.size else None, "causes": shares}
