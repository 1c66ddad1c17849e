# SPDX-License-Identifier: Apache-2.0
"""A structured-light code of your own, in one file: fringes of several periods, with their decoder.

Fringes alone, without Gray code: the coarsest period covers the projector, each finer one is unwrapped by the one
before (temporal phase unwrapping: Huntley and Saldner, Applied Optics 32, 1993).

    rangesim run tabletop --sensor examples/own_code.py:MultiFrequency --sensor gray-phase --out out/fringes

Usage: python examples/own_code.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from rangesim import Capture, Decoder, RangeImage, Sensor, Status, compare, decode, expose, load_scene, transport
from rangesim.decoding.phase_shift import PhaseThresholds, modulation_is_weak, phase_of
from rangesim.decoding.triangulate import TriangulationLimits, range_image_from_coordinates
from rangesim.response import Fringes
from rangesim.sensor import Background, Emitter, FrameContent, of_type


@dataclass(frozen=True)
class MultiFrequency(Sensor):
    """Fringes along the projector's columns. Frames: period by period, coarse to fine, `steps` phase shifts each.

    Parameters
    ----------
    width, height : pixels of the projector. ratio : of each period to the next finer one. periods : how many.
    steps : int >= 3, phase shifts.
    """

    width: int = 1280
    height: int = 800
    ratio: float = 8.0
    periods: int = 3
    steps: int = 4

    type_name: ClassVar[str] = "multi-frequency"

    @property
    def periods_px(self) -> list[float]:
        """Projector pixels, coarse to fine."""
        return [self.width / self.ratio**i for i in range(self.periods)]

    def responses(self) -> tuple[Fringes, ...]:
        return tuple(Fringes(0, period) for period in self.periods_px)

    def frames(self, channels: Sequence[np.ndarray], white: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        shifts = 2 * np.pi * np.arange(self.steps) / self.steps
        shown = [0.5 * (white + np.cos(s) * cosine + np.sin(s) * sine) for cosine, sine in channels for s in shifts]
        return (np.stack(shown) + ambient).astype(np.float32)

    def frame_names(self) -> list[str]:
        return [f"period{i}_phase{s}" for i in range(self.periods) for s in range(self.steps)]

    def check(self, width: int, height: int) -> None:
        if (width, height) != (self.width, self.height):
            raise ValueError(f"expected a projector of {self.width} x {self.height} pixels, got {width} x {height}.")

    @property
    def emitter(self) -> Emitter:
        return Emitter((self.width, self.height))

    @property
    def default_decoder(self) -> TemporalUnwrapping:
        return TemporalUnwrapping()

    @property
    def title(self) -> str:
        return "Structured light (fringes of several periods)"

    @property
    def details(self) -> str:
        return f"{self.steps}-step fringes of {', '.join(f'{p:g}' for p in self.periods_px)} px"

    def representative_frames(self, frames: np.ndarray) -> list[int]:
        return [i * self.steps for i in range(self.periods)][:3]


@dataclass(frozen=True)
class TemporalUnwrapping(Decoder):
    """The coarsest phase says where a pixel is, each finer one where more precisely.

    Parameters
    ----------
    phase : PhaseThresholds, for every period. triangulation : TriangulationLimits.
    """

    phase: PhaseThresholds = field(default_factory=PhaseThresholds)
    triangulation: TriangulationLimits = field(default_factory=TriangulationLimits)

    type_name: ClassVar[str] = "temporal-unwrapping"
    reads: ClassVar[type[Sensor]] = MultiFrequency

    def decode(self, capture: Capture) -> RangeImage:
        sensor = of_type(capture.sensor, MultiFrequency)
        phases = [phase_of(frames) for frames in np.split(capture.frames, sensor.periods)]
        column = phases[0].normalised * sensor.periods_px[0]
        for phase, period_px in zip(phases[1:], sensor.periods_px[1:], strict=True):
            column = (np.rint(column / period_px - phase.normalised) + phase.normalised) * period_px
        status = np.full(column.shape, Status.OK, dtype=np.uint8)
        status[(column < 0) | (column > sensor.width)] = Status.CODE_ERROR
        for phase in phases:
            status[modulation_is_weak(capture, phase, sensor.steps, self.phase)] = Status.LOW_SIGNAL
        status[capture.saturated(capture.frames)] = Status.SATURATED
        return range_image_from_coordinates(
            capture,
            column.astype(np.float32),
            None,
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
    size, baseline_m = sensor.emitter
    signals = transport(scene, scene.rig(baseline_m, size, width=320, height=240), [sensor], spp=16)
    image = decode(expose(signals, sensor, sensor.default_detector))
    for row in compare(image, signals.truth).rows():
        print(f"{row['material']}: {row['completeness']:.1%} read, median error {1e3 * row['median_abs_m']:.2f} mm")


if __name__ == "__main__":
    main()
