# SPDX-License-Identifier: Apache-2.0
"""Colours of the report's maps, and scales that all sensors of a report share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesim.causes.cause import TITLES, Cause
from rangesim.decoding.status import Status
from rangesim.results.experiment_results import Measurement

NOTHING = len(Cause)
"""Number of the class "the pixel sees no surface of the scene". It follows the numbers of `Cause`."""
NO_DATA = (203, 206, 210)
"""Colour of pixels without a value, RGB 0..255."""
ERROR_KNEE_M = 1e-4
"""Error, in metres, below which the error scale is linear; above, it is logarithmic.

With a smaller value more of the colours show errors below 0.1 mm; with a larger one such errors look like none.
"""
ERROR_LIMIT_M = 0.1
"""Error, in metres, at the end of the error scale; larger errors have the same colour. With a larger value fewer
colours are left for small errors; with a smaller one more of the large errors look alike."""

STATUS_NAMES = {
    Status.OK: "measured",
    Status.LOW_SIGNAL: "too little light",
    Status.SATURATED: "saturated",
    Status.CODE_ERROR: "code error",
    Status.UNWRAPPING_FAILED: "phases disagree",
    Status.OUT_OF_RANGE: "out of range",
    Status.OCCLUDED: "occluded from a camera",
    Status.AMBIGUOUS: "ambiguous match",
}
"""Text of each status where a page or the command line shows it."""
STATUS_COLORS = np.array(
    [
        (231, 234, 237),
        (52, 104, 176),
        (240, 171, 0),
        (196, 56, 45),
        (125, 79, 163),
        (40, 44, 52),
        (118, 176, 220),
        (226, 130, 170),
    ],
    dtype=np.uint8,
)
"""(8, 3) uint8, colour of each status, RGB, in the order of `Status`."""
OUTCOME_NAMES = [*(TITLES[c] for c in Cause), "nothing there"]
"""Text of each value of `outcomes`."""
OUTCOME_COLORS = np.array(
    [
        (236, 238, 240),  # no cause: the reading is correct
        (212, 194, 255),  # geometry: blues
        (117, 126, 255),
        (3, 71, 254),
        (139, 72, 0),  # surfaces: browns, orange, sand
        (184, 135, 7),
        (255, 208, 163),
        (172, 0, 122),  # other light: reds; glint yellow
        (124, 76, 87),
        (255, 230, 59),
        (4, 174, 128),  # noise: greens
        (91, 126, 79),
        (167, 150, 170),  # decoder: violets
        (165, 103, 171),
        (121, 190, 111),  # pile-up: a green, as noise
        (115, 165, 237),  # occluded: a blue, as geometry
        (252, 157, 14),  # no texture: an orange, as surfaces
        (178, 90, 124),  # cover glass: a red, as other light
        (218, 15, 56),  # stray light: a red, as other light
        (161, 31, 189),  # out of range: a violet, as decoder
        (203, 206, 210),  # nothing there
    ],
    dtype=np.uint8,
)
"""(21, 3) uint8, colour of each value of `outcomes`, RGB.

Each family of causes has a hue. The colours were found by annealing: of the twelve causes that most results show, the
smallest CIEDE2000 of two is 13, and of all causes 9.7, with all cones and without red or without green ones; with all
cones they are 17 and 12.7. Each differs from the dark page by 18 or more (tests/test_report.py measures it).
"""
READING_COLORS = {"right": "#3aa76d", "wrong": "#b8322f", "missing": "#a7b0ba"}
"""Colour of right, wrong and missing readings in bars. They differ by a CIEDE2000 of 16 or more, also without red or
without green cones."""
MATERIAL_COLORS = {
    "matte": (196, 178, 150),
    "glossy": (221, 119, 60),
    "mirror": (86, 102, 122),
    "transparent": (86, 180, 210),
    "translucent": (150, 196, 140),
    "other": (170, 140, 180),
}
"""Colour of each material class, RGB 0..255."""


@dataclass(frozen=True)
class Tick:
    """A label of a colour bar. place : position along the bar, 0..1. label : text."""

    place: float
    label: str


def color_table(name: str) -> np.ndarray:
    """(256, 3) uint8 colours of one of matplotlib's colour maps, RGB."""
    from matplotlib import colormaps

    return np.rint(colormaps[name](np.arange(256) / 255)[:, :3] * 255).astype(np.uint8)


def depth_limits(measurements: tuple[Measurement, ...]) -> tuple[float, float]:
    """Nearest and farthest depth of the depth scale, metres, of the true surfaces of all measurements.

    The scale leaves out half a percent of the pixels at either end, and then gets a margin.
    """
    z = np.concatenate([m.true_m[np.isfinite(m.true_m)] for m in measurements])
    if z.size == 0:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(z, [0.5, 99.5]))
    margin = max(0.03 * (high - low), 1e-3 * high)
    return low - margin, high + margin


def depth_ticks(low: float, high: float, count: int = 5) -> list[Tick]:
    """Labels at round depths between two limits in metres; about `count` of them."""
    step = 10.0 ** np.floor(np.log10(high - low))
    step = next(step * f for f in (0.1, 0.2, 0.5, 1.0, 2.0) if (high - low) / (step * f) <= count + 1)
    values = np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step
    digits = max(0, int(np.ceil(-np.log10(step) - 1e-9)))
    return [Tick(float((v - low) / (high - low)), f"{v:.{digits}f}") for v in values]


def error_fraction(error_m: np.ndarray) -> np.ndarray:
    """Position of signed errors, in metres, on the error scale: 0 and 1 are its ends, 0.5 is no error."""
    decades = np.arcsinh(error_m / ERROR_KNEE_M / 2) / np.arcsinh(ERROR_LIMIT_M / ERROR_KNEE_M / 2)
    return np.asarray(0.5 + 0.5 * np.clip(decades, -1, 1))


def error_ticks() -> list[Tick]:
    """Labels at the decades of the error scale, in millimetres."""
    values = [-100, -10, -1, 0, 1, 10, 100]
    places = error_fraction(np.array(values) / 1e3)
    signs = [f"{v:+d}".replace("-", "−") if v else "0" for v in values]
    return [Tick(float(p), s) for p, s in zip(places, signs, strict=True)]


def outcomes(measurement: Measurement) -> np.ndarray:
    """(h, w) uint8, `Cause` of each pixel, or `NOTHING` where there is no surface; an index into `OUTCOME_NAMES` and
    `OUTCOME_COLORS`."""
    return np.where(np.isfinite(measurement.truth.z), measurement.causes.cause, NOTHING).astype(np.uint8)


def hexadecimal(color: np.ndarray) -> str:
    """Colour of three numbers 0..255 as CSS writes it, #rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*color)
