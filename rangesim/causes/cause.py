# SPDX-License-Identifier: Apache-2.0
"""The causes of failed pixels, and a map of them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from rangesim.settings.config import ShortRepr
from rangesim.signals import GroundTruth


class Cause(IntEnum):
    """Why a pixel failed: it has no reading, or one off by more than the tolerance. See `DEFINITIONS`.

    The order is that of the families: geometry, surface, other light, noise, decoder; what came later stands last.
    """

    NONE = 0
    SHADOWED = 1
    DEPTH_EDGE = 2
    MOTION = 3
    SPECULAR_AWAY = 4
    MIRRORED_GHOST = 5
    SEEN_THROUGH = 6
    MULTIPATH = 7
    CAUSTIC = 8
    GLINT = 9
    LOW_SIGNAL = 10
    AMBIENT = 11
    RANGE_AMBIGUITY = 12
    RESOLUTION = 13
    PILE_UP = 14


DEFINITIONS = {
    Cause.NONE: "Not failed: the reading is right, or there is no surface behind the pixel.",
    Cause.SHADOWED: "The projector does not see the point: something is in between, or it lies beside its image.",
    Cause.DEPTH_EDGE: "The pixel covers surfaces at different depths; it mixes them, or their codes contradict.",
    Cause.MOTION: "The surface moved while the frames were taken.",
    Cause.SPECULAR_AWAY: "A mirror or a glossy surface sent the light elsewhere.",
    Cause.MIRRORED_GHOST: "The light of another surface, seen in a mirror or in a gloss, took the place of its own.",
    Cause.SEEN_THROUGH: "The light went through the surface; what was read, if anything, lies behind or within.",
    Cause.MULTIPATH: "Light that came by way of further surfaces disturbed the reading.",
    Cause.CAUSTIC: "Light that lit the surface off a mirror or through glass disturbed the reading.",
    Cause.GLINT: "The detector saturated, or most of the light came straight from the lens of the projector.",
    Cause.LOW_SIGNAL: "Too little projector light for the detector's own noise.",
    Cause.AMBIENT: "Enough projector light, but ambient light fills the detector or swamps it with noise.",
    Cause.RANGE_AMBIGUITY: "The distance lies beyond the unambiguous range, or a wrong period was picked.",
    Cause.RESOLUTION: "Neither stray light nor noise: code, bins or baseline are too coarse for this depth.",
    Cause.PILE_UP: "Photons came in so many of the pulses that the first ones hid the rest; less light would be read.",
}
"""What each cause means, in a sentence."""

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
    Cause.RANGE_AMBIGUITY: "range ambiguity",
    Cause.RESOLUTION: "too coarse",
    Cause.PILE_UP: "pile-up",
}
"""Names for tables and legends."""


@dataclass(frozen=True, eq=False, repr=False)
class CauseMap(ShortRepr):
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

    def fractions(self, truth: GroundTruth) -> list[dict[str, Any]]:
        """Per material class of the first surface, "all" last: what failed, and why, as fractions of its pixels.

        Each entry is a dict of `material` (str), `failed` (fraction of the pixels of this class; None if it has none)
        and `causes` (name in `Cause`, in lower case -> fraction of the pixels of this class, largest first, none of
        them 0). `rangesim.report.failures_markdown` makes a table of them.
        """
        return [_row(name, self.cause[mask]) for name, mask in truth.classes().items()]


def _row(material: str, causes: np.ndarray) -> dict[str, Any]:
    counts = np.bincount(causes, minlength=len(Cause))
    found = sorted((c for c in Cause if c and counts[c]), key=lambda c: -counts[c])
    fractions = {c.name.lower(): float(counts[c] / causes.size) for c in found}
    return {"material": material, "failed": float(np.mean(causes > 0)) if causes.size else None, "causes": fractions}
