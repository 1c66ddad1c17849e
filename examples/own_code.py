# SPDX-License-Identifier: Apache-2.0
"""A structured-light code of your own, in one file: fringes of several periods, with their decoder.

The frames are fringes alone, without Gray code. The coarsest period covers the projector, and each finer one is
unwrapped by the one before (temporal phase unwrapping: Huntley and Saldner, Applied Optics 32, 1993). Every command
takes it:

    rangesim run tabletop --sensor examples/own_code.py:MultiFrequency --sensor gray-phase --out out/fringes
    rangesim calibrate pose_*/ --sensor examples/own_code.py:MultiFrequency --projector 1280x800 --points 9x6
        --spacing 0.025 --out rig.json
    rangesim decode images --sensor examples/own_code.py:MultiFrequency --projector 1280x800 --axes columns,rows
        --calibration rig.json --out out/decoded

Usage: python examples/own_code.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from rangesim import Capture, Decoder, Sensor, Status, compare, decode, expose, load_scene, transport
from rangesim.decoding.phase_shift import PhaseThresholds, modulation_is_weak, phase_of, phase_sigma
from rangesim.decoding.triangulation import ProjectorCoordinates, TriangulationLimits
from rangesim.response import Fringes
from rangesim.sensor import Background, Emitter, FrameContent, of_type


@dataclass(frozen=True)
class MultiFrequency(Sensor):
    """Fringes of several periods. Frames: axis by axis, period by period, coarse to fine, `steps` phase shifts each.

    Parameters
    ----------
    width, height : int, pixels of the projector.
    ratio : float, ratio of each period to the next finer one. periods : int, number of periods.
    steps : int >= 3, number of phase shifts.
    axes : "columns" suffices to triangulate; calibration needs "rows" as well.
    """

    width: int = 1280
    height: int = 800
    ratio: float = 8.0
    periods: int = 3
    steps: int = 4
    axes: tuple[str, ...] = ("columns",)

    type_name: ClassVar[str] = "multi-frequency"

    def periods_px(self, axis: str) -> list[float]:
        """Periods along an axis, projector pixels, coarse to fine."""
        size = self.width if axis == "columns" else self.height
        return [size / self.ratio**i for i in range(self.periods)]

    def responses(self) -> tuple[Fringes, ...]:
        return tuple(Fringes(int(axis == "rows"), period) for axis in self.axes for period in self.periods_px(axis))

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        shifts = 2 * np.pi * np.arange(self.steps) / self.steps
        shown = [0.5 * (white + np.cos(s) * cosine + np.sin(s) * sine) for cosine, sine in channels for s in shifts]
        return (np.stack(shown) + ambient).astype(np.float32)

    def frame_names(self) -> list[str]:
        return [f"{axis}{i}_phase{s}" for axis in self.axes for i in range(self.periods) for s in range(self.steps)]

    def for_projector(self, width: int, height: int, axes: Sequence[str] | None = None) -> MultiFrequency:
        return replace(self, width=width, height=height, axes=self.axes if axes is None else tuple(axes))

    def check(self, width: int, height: int) -> None:
        if (width, height) != (self.width, self.height):
            raise ValueError(f"expected a projector of {self.width} x {self.height} pixels, got {width} x {height}.")

    @property
    def default_emitter(self) -> Emitter:
        return Emitter((self.width, self.height))

    @property
    def default_decoder(self) -> TemporalUnwrapping:
        return TemporalUnwrapping()

    @property
    def title(self) -> str:
        return "Structured light (fringes of several periods)"

    @property
    def details(self) -> str:
        return f"{self.steps}-step fringes of {', '.join(f'{p:g}' for p in self.periods_px(self.axes[0]))} px"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        return [i * self.steps for i in range(self.periods)][:3]


@dataclass(frozen=True)
class TemporalUnwrapping(Decoder):
    """Decodes a place from the coarsest phase, and refines it by each finer one.

    Parameters
    ----------
    phase : PhaseThresholds of every period. triangulation : TriangulationLimits.
    """

    phase: PhaseThresholds = field(default_factory=PhaseThresholds)
    triangulation: TriangulationLimits = field(default_factory=TriangulationLimits)

    type_name: ClassVar[str] = "temporal-unwrapping"
    reads: ClassVar[type[Sensor]] = MultiFrequency

    def coordinates(self, capture: Capture) -> ProjectorCoordinates:
        sensor = of_type(capture.sensor, MultiFrequency)
        status = np.full(capture.frames.shape[1:], Status.OK, dtype=np.uint8)
        coordinate: dict[str, np.ndarray] = {}
        sigma_px: dict[str, np.ndarray] = {}
        for axis, frames in zip(sensor.axes, np.split(capture.frames, len(sensor.axes)), strict=True):
            periods_px = sensor.periods_px(axis)
            phases = [phase_of(shifted) for shifted in np.split(frames, sensor.periods)]
            place = phases[0].normalised * periods_px[0]
            for phase, period_px in zip(phases[1:], periods_px[1:], strict=True):
                place = (np.rint(place / period_px - phase.normalised) + phase.normalised) * period_px
            status[(place < 0) | (place > periods_px[0])] = Status.CODE_ERROR
            for phase in phases:
                sigma = phase_sigma(capture, phase, sensor.steps)  # after the loop, that of the finest period
                status[modulation_is_weak(capture, phase, sigma, self.phase)] = Status.LOW_SIGNAL
            coordinate[axis] = place
            if sigma is not None:
                sigma_px[axis] = sigma * periods_px[-1] / (2 * np.pi)
        status[capture.saturated(capture.frames)] = Status.SATURATED
        return ProjectorCoordinates(
            column=coordinate.get("columns"),
            row=coordinate.get("rows"),
            column_sigma_px=sigma_px.get("columns"),
            row_sigma_px=sigma_px.get("rows"),
            status=status,
            confidence=2 * phases[-1].modulation / capture.full_scale,
            intensity=phases[-1].mean - np.float32(capture.black_level),
            limits=self.triangulation,
        )

    def least_signal(self, sensor: Sensor, background: Background) -> np.ndarray:
        least = self.phase.least_signal(of_type(sensor, MultiFrequency).steps, 0.5, FrameContent(), background)
        return np.maximum(least, background.floor(0.0))


def main() -> None:
    sensor = MultiFrequency()
    scene = load_scene("matte")
    size, baseline_m = sensor.default_emitter
    signals = transport(scene, scene.rig(baseline_m, size, width=320, height=240), [sensor], spp=16)
    image = decode(expose(signals, sensor, sensor.default_detector))
    for row in compare(image, signals.truth).rows():
        print(f"{row['material']}: {row['completeness']:.1%} read, median error {1e3 * row['median_abs_m']:.2f} mm")


if __name__ == "__main__":
    main()
