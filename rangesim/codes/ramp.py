# SPDX-License-Identifier: Apache-2.0
"""Intensity ramp: the brightness of a pixel, compared with white and black, is its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rangesim.codes.axis_code import AxisCode, AxisFrames
from rangesim.codes.code import Code, CodeThresholds
from rangesim.decoding.pixel_samples import MIN_PIXELS, evenly_spread
from rangesim.decoding.status import Status
from rangesim.settings.bounds import check_fields

RAMP, REVERSE = "ramp", "ramp_reverse"
"""Names of the two frames."""

MAX_SUM_ERROR = 0.03
"""Largest distance of ramp + reverse from white + black, on median over the pixels, as a fraction of white - black. A
gamma of 2.2 makes 0.5 in the middle of the ramp and 0 at its ends."""

MAX_OUTSIDE = 0.1
"""Largest distance of a ramp beyond white or black, as a fraction of white - black, and largest fraction of pixels with
more, if a gamma is the cause: a gamma leaves black and white where they are."""

GAMMAS = np.arange(0.4, 3.21, 0.1)
"""Exponents of projectors that are tried where the ramps do not add up to white and black."""


@dataclass(frozen=True)
class RampCode(Code):
    """A ramp from dark to bright and the reverse ramp; white and black make brightness a place.

    Two frames and white and black are few, but the place is as uncertain as size / sqrt(2) times the noise in units of
    white - black, and projector and camera must be linear. Light of interreflection moves the place: a ramp cannot tell
    it from direct light.

    References
    ----------
    Carrihill, Hummel: "Experiments with the intensity ratio depth sensor", Computer Vision, Graphics, and Image
    Processing 32 (1985).

    Examples
    --------
    >>> RampCode().patterns(4)
    array([[0.125, 0.375, 0.625, 0.875],
           [0.875, 0.625, 0.375, 0.125]], dtype=float32)
    """

    type_name: ClassVar[str] = "ramp"
    title: ClassVar[str] = "Structured light (intensity ramp)"

    def __post_init__(self) -> None:
        check_fields(self)

    def names(self, size: int) -> list[str]:
        return [RAMP, REVERSE]

    def patterns(self, size: int) -> np.ndarray:
        ramp = (np.arange(size) + 0.5) / size
        return np.stack([ramp, 1 - ramp]).astype(np.float32)

    def check_shown(self, size: int, shown: Sequence[str]) -> None:
        if RAMP not in shown and REVERSE not in shown:
            raise ValueError(
                f"expected an order with {RAMP} or {REVERSE}, got {', '.join(shown) or 'no frames'}: show one of them."
            )
        if not {"white", "black"} <= set(shown):
            missing = " and no ".join(level for level in ("white", "black") if level not in shown)
            raise ValueError(
                f"expected white and black among the frames, got no {missing}: show them, because a ramp tells no "
                "place without them."
            )

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        capture, contrast = seen.capture, np.maximum(seen.contrast.values, np.float32(1e-30))
        white, black = (image.astype(np.float32) for image in (seen.contrast.white, seen.contrast.black))
        shown = dict(zip(seen.names, seen.frames, strict=True))
        has_both = len(shown) == 2
        ramp = (shown[RAMP] if RAMP in shown else white + black - shown[REVERSE]).astype(np.float32)
        reverse = (shown[REVERSE] if REVERSE in shown else white + black - ramp).astype(np.float32)
        ratio = (ramp - reverse) / contrast  # -1 to 1
        coordinate = (0.5 * seen.size * (1 + ratio)).astype(np.float32)
        status = np.zeros(ratio.shape, dtype=np.uint8)
        noises = [noise for image in (ramp, reverse, white, black) if (noise := capture.noise(image)) is not None]
        sigma_px, allowed = None, thresholds.gray.relative_bit * contrast
        if noises:
            of_ramp, of_reverse, of_white, of_black = (np.square(noise) for noise in noises)
            with np.errstate(over="ignore"):  # a pixel without contrast has an infinite deviation
                if has_both:
                    variance = of_ramp + of_reverse + ratio**2 * (of_white + of_black)
                else:
                    side = 1 if RAMP in shown else -1
                    of_shown = of_ramp if RAMP in shown else of_reverse
                    variance = 4 * of_shown + (1 - side * ratio) ** 2 * of_black + (1 + side * ratio) ** 2 * of_white
                sigma_px = (0.5 * seen.size * np.sqrt(variance) / contrast).astype(np.float32)
            of_sum = np.sqrt(of_ramp + of_reverse + of_white + of_black)
            allowed = np.maximum(allowed, thresholds.gray.bit_sigmas * of_sum)
        elif capture.is_digital:
            allowed = np.maximum(allowed, thresholds.gray.bit_of_scale * capture.full_scale)
        status[np.abs(ramp + reverse - white - black) > allowed] = Status.CODE_ERROR
        status[~seen.contrast.is_enough] = Status.LOW_SIGNAL
        clipped = capture.saturated(np.stack([*seen.frames, seen.contrast.white]))
        status[clipped] = Status.SATURATED
        return AxisCode(coordinate, status, 1.0, sigma_px)

    def contradiction(self, seen: AxisFrames, code: AxisCode) -> str | None:
        if len(seen.names) < 2:
            return None
        used = evenly_spread(np.flatnonzero(seen.contrast.is_enough & (code.status != Status.SATURATED)))
        if len(used) < MIN_PIXELS:
            return None
        black, contrast = (x.ravel()[used].astype(np.float64) for x in (seen.contrast.black, seen.contrast.values))
        ramp, reverse = ((frame.ravel()[used] - black) / contrast for frame in seen.frames)
        noise = seen.capture.noise(seen.contrast.white)
        allowed = MAX_SUM_ERROR + (0.0 if noise is None else 2 * float(np.median(noise.ravel()[used] / contrast)))
        off = float(np.median(np.abs(ramp + reverse - 1)))
        if off <= allowed:
            return None
        outside = float(
            ((np.minimum(ramp, reverse) < -MAX_OUTSIDE) | (np.maximum(ramp, reverse) > 1 + MAX_OUTSIDE)).mean()
        )
        ramp, reverse = np.clip(ramp, 0, 1), np.clip(reverse, 0, 1)
        left = [float(np.median(np.abs(ramp ** (1 / gamma) + reverse ** (1 / gamma) - 1))) for gamma in GAMMAS]
        best = int(np.argmin(left))
        cause = "check the order of the frames, and that nothing moved and all have one exposure"
        if left[best] < 0.5 * off and outside < MAX_OUTSIDE:
            cause = f"a gamma of about {GAMMAS[best]:.1f} explains it: make projector and camera linear"
        return (
            f"the ramps along {seen.axis} contradict white and black: on median they miss their sum by "
            f"{100 * off:.0f} % of white - black; {cause}."
        )

    @property
    def details(self) -> str:
        return "intensity ramp and its reverse"

    def representative(self, size: int) -> list[str]:
        return [RAMP, REVERSE]
