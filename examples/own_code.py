# SPDX-License-Identifier: Apache-2.0
"""A structured-light code of your own, in one file: triangles instead of sinusoids.

Each period is shown as four triangle waves, shifted by quarters of the period. The two differences of opposite patterns
tell the place within the period: they are linear in it, so no arctangent is needed (Jia, Kofman, English: "Two-step
triangular-pattern phase-shifting method for three-dimensional object-shape measurement", Optical Engineering 46, 2007).
Two periods, of which the coarse one covers the projector, tell the place. Every command takes the code:

    rangesim run tabletop --sensor examples/own_code.py:TriangleWaves --sensor phase-shift --out out/triangles
    rangesim calibrate pose_*/ --sensor examples/own_code.py:TriangleWaves --projector 1280x800 --points 9x6
        --spacing 0.025 --out rig.json
    rangesim decode images --sensor examples/own_code.py:TriangleWaves --projector 1280x800 --axes columns,rows
        --calibration rig.json --out out/decoded

Usage: python examples/own_code.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rangesim import Status, StructuredLight, compare, decode, expose, load_scene, transport
from rangesim.codes import AxisCode, AxisFrames, Code, CodeThresholds
from rangesim.sensor import Background, FrameContent

SHIFTS = 4
"""Patterns of each period, shifted by quarters of it."""


@dataclass(frozen=True)
class TriangleWaves(Code):
    """Triangle waves of two periods: one as long as the axis, and one `ratio` times finer.

    Parameters
    ----------
    ratio : int, ratio of the two periods.
    """

    ratio: int = 16

    type_name: ClassVar[str] = "triangle-waves"
    title: ClassVar[str] = "Structured light (triangle waves)"

    def names(self, size: int) -> list[str]:
        return [f"{period}{shift}" for period in ("coarse", "fine") for shift in range(SHIFTS)]

    def patterns(self, size: int) -> np.ndarray:
        turns = np.outer((1, self.ratio), (np.arange(size) + 0.5) / size)
        shifted = turns[:, None] - np.arange(SHIFTS)[:, None] / SHIFTS
        return (np.abs(2 * (shifted % 1) - 1)).reshape(-1, size).astype(np.float32)

    def decode(self, seen: AxisFrames, thresholds: CodeThresholds) -> AxisCode:
        coarse, fine = (np.asarray(f, np.float32) for f in (seen.frames[:SHIFTS], seen.frames[SHIFTS:]))
        status = np.full(coarse.shape[1:], Status.OK, dtype=np.uint8)
        turn = place(fine)
        coordinate = (np.rint(place(coarse) * self.ratio - turn) + turn) * seen.size / self.ratio
        status[(coordinate < 0) | (coordinate > seen.size)] = Status.CODE_ERROR
        sigma_px = None
        for period_px, waves in ((seen.size, coarse), (seen.size / self.ratio, fine)):
            noise = seen.capture.noise(waves.mean(axis=0))
            if noise is not None:  # a quarter of the period is as long as the swing of a difference of two frames
                sigma_px = np.sqrt(2) * noise * (period_px / SHIFTS) / np.maximum(swing(waves), 1e-9)
                weak = sigma_px > thresholds.phase.max_sigma_rad / (2 * np.pi) * period_px
            elif seen.capture.is_digital:
                weak = swing(waves) < 2 * thresholds.phase.modulation_of_scale * seen.capture.full_scale
            else:
                weak = swing(waves) <= thresholds.phase.relative_modulation * waves.mean(axis=0)
            status[weak] = Status.LOW_SIGNAL
        status[seen.capture.saturated(seen.frames)] = Status.SATURATED
        return AxisCode(coordinate.astype(np.float32), status, seen.size / self.ratio, sigma_px)

    def least_signal(
        self, size: int, shown: Sequence[str], thresholds: CodeThresholds, background: Background
    ) -> np.ndarray:
        return thresholds.phase.least_signal(SHIFTS, 1 / np.pi, FrameContent(), background)

    @property
    def details(self) -> str:
        return f"{SHIFTS} triangle waves of two periods, ratio {self.ratio}"


def place(waves: np.ndarray) -> np.ndarray:
    """(h, w) place within the period, in turns, 0 to 1, of four triangle waves (4, h, w)."""
    first, second = waves[0] - waves[2], waves[1] - waves[3]
    quarter = second / np.maximum(np.abs(first) + np.abs(second), 1e-20)
    return np.asarray(0.25 * np.where(first >= 0, quarter, 2 - quarter) % 1)


def swing(waves: np.ndarray) -> np.ndarray:
    """(h, w) difference between the top and the bottom of the waves (4, h, w)."""
    return np.asarray(np.abs(waves[0] - waves[2]) + np.abs(waves[1] - waves[3]))


def main() -> None:
    sensor = StructuredLight(code=TriangleWaves())
    scene = load_scene("matte")
    size, baseline_m = sensor.default_emitter
    signals = transport(scene, scene.rig(baseline_m, size, width=320, height=240), [sensor], spp=16)
    image = decode(expose(signals, sensor, sensor.default_detector))
    for row in compare(image, signals.truth).rows():
        print(f"{row['name']}: {row['right']:.1%} right, median error {1e3 * row['median_abs_m']:.2f} mm")


if __name__ == "__main__":
    main()
