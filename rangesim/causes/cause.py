# SPDX-License-Identifier: Apache-2.0
"""Causes of failed pixels, and the map of the causes in an image."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from rangesim.evaluation.surface_rows import with_mean_over_objects
from rangesim.settings.config import ShortRepr
from rangesim.signals import GroundTruth, Surface


class Cause(IntEnum):
    """Cause of a failed pixel: one without a reading, or with an error larger than the tolerance.

    `DEFINITIONS` says what each means. The numbers follow the families geometry, surface, other light, noise and
    decoder. They are written to files, so a cause that is added later gets the next number.

    Examples
    --------
    >>> from rangesim.causes import Cause
    >>> Cause.MULTIPATH.name, int(Cause.MULTIPATH)
    ('MULTIPATH', 7)
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
    OCCLUDED = 15
    NO_TEXTURE = 16
    COVER_GLASS = 17
    STRAY_LIGHT = 18
    OUT_OF_RANGE = 19


DEFINITIONS = {
    Cause.NONE: "The pixel did not fail: its reading is right, or there is no surface behind it.",
    Cause.SHADOWED: "The emitter does not light the point: something is in between, or it lies outside the lit field.",
    Cause.DEPTH_EDGE: "The pixel covers surfaces at different depths and mixes their distances or their codes.",
    Cause.MOTION: "The surface moved while the frames were taken.",
    Cause.SPECULAR_AWAY: "A mirror or a glossy surface reflected the light elsewhere.",
    Cause.MIRRORED_GHOST: "Light of another surface, seen in a mirror or in gloss, replaced the light of this one.",
    Cause.SEEN_THROUGH: "The light passed through the surface; the reading, if any, lies behind it or within it.",
    Cause.MULTIPATH: "Light that was scattered by further surfaces disturbed the reading.",
    Cause.CAUSTIC: "Light that reached the surface by way of a mirror or through glass disturbed the reading.",
    Cause.GLINT: "The detector saturated, or most of the light came straight from the lens of the emitter.",
    Cause.LOW_SIGNAL: "There was too little light of the emitter for the noise of the detector.",
    Cause.AMBIENT: "The emitter's light sufficed, but ambient light filled the detector or added too much noise.",
    Cause.RANGE_AMBIGUITY: "The distance lies beyond the unambiguous range, or a wrong period was chosen.",
    Cause.RESOLUTION: "Neither stray light nor noise is to blame: code, bins or baseline are too coarse for the depth.",
    Cause.PILE_UP: "So many pulses brought photons that the first ones hid the others; less light would be read right.",
    Cause.OCCLUDED: "The second camera of a pair does not see the point: something is in between, or it lies outside.",
    Cause.NO_TEXTURE: "The surface shows no texture by which the images of two cameras could be matched.",
    Cause.COVER_GLASS: "Light off the window of the device disturbed the reading, or hid a surface close before it.",
    Cause.STRAY_LIGHT: "Light of the rest of the image, which the camera's lens scatters, disturbed the reading.",
    Cause.OUT_OF_RANGE: "The surface lies outside the working range of the device, which refuses readings there.",
}
"""Meaning of each cause, in one sentence, which the tables of docs/causes.md and of reports show."""

TITLES = {
    Cause.NONE: "right",
    Cause.SHADOWED: "shadowed from emitter",
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
    Cause.OCCLUDED: "occluded from a camera",
    Cause.NO_TEXTURE: "no texture",
    Cause.COVER_GLASS: "cover glass",
    Cause.STRAY_LIGHT: "stray light",
    Cause.OUT_OF_RANGE: "out of range",
}
"""Name of each cause in tables and legends."""


@dataclass(frozen=True, eq=False, repr=False)
class CauseMap(ShortRepr):
    """The cause of every failed pixel.

    cause : (h, w) uint8, values of `Cause`; `NONE` where the pixel did not fail.
    tolerance_m : float, metres; a pixel failed if |z - true z| of its reading is larger.
    """

    cause: np.ndarray
    tolerance_m: float

    @property
    def failed(self) -> np.ndarray:
        """(h, w) bool, whether there is a surface, but no reading of it within the tolerance."""
        return np.asarray(self.cause != Cause.NONE)

    def fractions(self, truth: GroundTruth) -> list[dict[str, Any]]:
        """Fractions of right pixels and of the causes of the others, per surface, in the rows of `compare`.

        Each entry is a dict with `kind` and `name` of the row, `right` (fraction of its pixels; None if there are none)
        and `causes` (name of the cause in lower case -> fraction of its pixels; the largest is first, and none is 0).
        Together they add up to 1. `rangesim.report.failures_markdown` makes a table of the entries.

        Parameters
        ----------
        truth : GroundTruth of the pass that the pixels were measured in.
        """
        return with_mean_over_objects([_row(surface, self.cause[surface.mask]) for surface in truth.surfaces()])


def _row(surface: Surface, causes: np.ndarray) -> dict[str, Any]:
    """Entry of `CauseMap.fractions` for a surface, from the causes (n,) of its pixels."""
    counts = np.bincount(causes, minlength=len(Cause))
    found = sorted((c for c in Cause if c and counts[c]), key=lambda c: -counts[c])
    fractions = {c.name.lower(): float(counts[c] / causes.size) for c in found}
    right = float(np.mean(causes == 0)) if causes.size else None
    return {"kind": surface.kind, "name": surface.name, "right": right, "causes": fractions}
